/// The controller inside a robot's 1 kHz loop: measured force in, commanded motion out. C++17, no other library.
///
///     torch_pbd::Admittance<2> controller(torch_pbd::Schedule::load("letter.csv"));
///     controller.start(seconds(), {robot.position()});
///     while (true) {
///         const torch_pbd::Faults faults = controller.tick(seconds(), robot.force());
///         robot.move(controller.position(), controller.velocity());
///         if (faults & torch_pbd::kStopped) break;
///     }
///
/// It is `torch_pbd.control.RealTimeAdmittance` of Python, tick by tick, to 1e-12 of the motion. Ticks allocate nothing
/// and throw nothing.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <memory>
#include <optional>

#include "clock.hpp"
#include "limits.hpp"
#include "linalg.hpp"
#include "schedule.hpp"
#include "steps.hpp"
#include "table.hpp"

namespace torch_pbd {

/// Options of `Admittance`, those of `RealTimeAdmittance`, where they are explained at length.
///
/// Those of two numbers have a second one for the rotations of poses, in Nm and rad.
struct Options {
    /// Virtual mass in kg; none is the schedule's, or 1 kg. Refused where the schedule's damping is for another one.
    std::optional<double> mass;
    double rate = 1000.0;  ///< of the loop, in 1/s
    double max_step = 0.01;  ///< longest tick in s; over a longer one the robot has braked; after three it stops
    Limit force_limit{200.0, 20.0};  ///< range of the sensor in N and Nm, as the length of a vector
    Limit deadband{0.0, 0.0};  ///< force on an axis, in N and Nm, that counts as none
    std::optional<Limit> spring_limit;  ///< largest pull of the spring in N and Nm; none is `force_limit`
    Limit velocity_limit{infinity, infinity};  ///< of the command, in units/s and rad/s
    Limit acceleration_limit{infinity, infinity};  ///< of the command, in units/s^2 and rad/s^2
    int hold_ticks = 10;  ///< ticks on end with a force that is not finite before the robot stops
    int max_bad_ticks = 10;  ///< ticks on end with a time that is wrong before the robot stops
    std::optional<Limit> stop_deceleration;  ///< of a stop, in units/s^2 and rad/s^2
    double soft_start = 1.0;  ///< time of the approach to the schedule at `start`, in s
    Limit approach_speed{0.5, 1.0};  ///< largest speed of the approach, in units/s and rad/s
    bool catches_up = false;  ///< after a late tick, `on_gap="resume"`
    Limit force_rate_limit{infinity, infinity};  ///< fastest change of the force, in N/s and Nm/s
};

/// Robot of N axes that moves as M a = f + K (x_d - x) + D (v_d - v), one tick at a time.
///
/// Places have M numbers: as many as there are axes, or one more where the last three axes are those of an orientation.
/// A tick is solved exactly over the time that really passed, with force and schedule held over it. Constructor and
/// `start` check what they are given, and throw std::invalid_argument. One thread at a time may use an object.
template <std::size_t N, std::size_t M = N>
class Admittance {
public:
    static constexpr bool kIsPose = M != N;
    using Position = Vector<n_positions<N, M>>;

    /// Where the robot is at the start, and where in the schedule.
    struct Start {
        std::optional<Position> position{};  ///< none is that of the schedule
        Vector<N> velocity{};  ///< in units/s and rad/s
        double at = 0.0;  ///< time in the schedule, in s; `schedule_time` goes on after a stop
        Vector<N> force_bias{};  ///< reading of the sensor while nothing touches it, in N and Nm
        std::optional<Quaternion> orientation{};  ///< of poses: unit quaternion w x y z; none is that of the schedule
    };

    explicit Admittance(const Schedule& schedule, const Options& options = {})
        : timer_(checked(options.rate, 0.0 < options.rate && options.rate < infinity, "rate", "above 0"),
                 options.max_step, options.max_bad_ticks),
          channel_(options.force_limit, options.deadband, options.force_rate_limit, options.hold_ticks),
          limits_(options.velocity_limit, options.acceleration_limit),
          table_(std::make_shared<const ScheduleTable<N, M>>(schedule, virtual_mass(schedule, options.mass),
                                                             options.rate, pull_limit(options))),
          clock_(table_, options.soft_start, options.approach_speed, limits_.acceleration, options.catches_up) {
        const Limit stop = checked<N, M>(options.stop_deceleration.value_or(kDeceleration), "stop_deceleration");
        deceleration_ =
            std::min(options.stop_deceleration ? clock_.least(stop) : std::max(clock_.least(stop), clock_.acceleration),
                     clock_.least(limits_.acceleration));
        // Impulse responses of velocity to force integrate, in absolute values, to 2 / damping at most along each mode,
        // for any mass: twice what damping alone lets them do, where not all modes are met at their worst at once.
        const Limit answer = 2.0 * table_->mobility(options.force_limit + pull_limit(options));
        for (std::size_t b = 0; b < kBlocks.size(); ++b)
            speed_due_[b] =
                limits_.speed[b] < infinity ? limits_.speed[b] : clock_.speed / clock_.scale(b) + answer[b];
        desired_ = clock_.begin(0.0, 0.0, {}, {}, {}, state_.place);
    }

    /// Begins where the schedule does, at rest, at `now` s of a monotonic clock.
    void start(double now) { start(now, Start{}); }

    /// Begins, or begins again: faults, forces and motion are forgotten.
    void start(double now, const Start& from) {
        checked(from.at, 0.0 <= from.at && from.at <= table_->end, "at", "a time of the schedule, in s");
        check_finite(from.position.value_or(Position{}), "position");
        check_finite(from.velocity, "velocity");
        check_finite(from.force_bias, "force_bias");
        std::optional<Quaternion> orientation = from.orientation;
        if (orientation) {
            const double length = linalg::norm(*orientation);
            checked(length, kIsPose && std::abs(length - 1.0) <= kOff, "the length of orientation", "1, of a pose");
            orientation = (1.0 / length) * *orientation;
        }
        top_speed_ = speed_due_;
        for (std::size_t b = 0; b < kBlocks.size(); ++b) {
            const double along = linalg::norm(from.velocity, kBlocks[b]);
            checked(along, along <= limits_.speed[b], b == 0 ? "the speed" : "the angular speed",
                    "velocity_limit at most");
            top_speed_[b] = std::max(top_speed_[b], along);
        }
        timer_.begin(now);
        channel_.begin(from.force_bias);
        scale_ = {1.0, 1.0};
        desired_ = clock_.begin(now, from.at, from.position, orientation, from.velocity, state_.place);
        state_.velocity = from.velocity;
        is_started_ = true;
        is_stopped_ = false;
        faults_ = 0;
    }

    /// Moves on to `now` s, with the external force in N as measured now, which acts since the last tick.
    ///
    /// Returns the faults, 0 if none; `position` and `velocity` are then the command. Before `start` the robot is
    /// stopped. (Python raises there, and at the third tick after `start` that is late, at which this stops too.)
    Faults tick(double now, const Vector<N>& force) noexcept {
        if (!is_started_) return kStopped;
        const double step = now - timer_.last;
        const bool is_regular = timer_.is_regular && 0.0 < step && step <= timer_.max_step;
        Faults faults = channel_.take(force, is_regular ? step : timer_.step);
        is_stopped_ = is_stopped_ || channel_.is_lost;
        faults |= is_regular ? live(now, step) : live_irregular(now);
        if (is_stopped_) faults |= kStopped;
        faults_ |= faults;
        return faults;
    }

    /// Position to command, in units.
    Position position() const { return position_of(state_); }
    /// Orientation to command, a unit quaternion w x y z from the tool to the world; of poses.
    Quaternion orientation() const { return orientation_of(state_); }
    const Vector<N>& velocity() const { return state_.velocity; }  ///< to command, in units/s and rad/s
    Faults faults() const { return faults_; }  ///< all since `start`

    /// External force that acted in the last tick, in N and Nm.
    const Vector<N>& force() const { return channel_.push; }
    Position desired_position() const { return position_of(desired_); }  ///< of the last tick
    /// Desired orientation of the last tick; of poses.
    Quaternion desired_orientation() const {
        const Quaternion turned = orientation_of(desired_);
        return (1.0 / linalg::norm(turned)) * turned;
    }
    const Vector<N>& desired_velocity() const { return desired_.velocity; }  ///< of the last tick
    /// Stiffness of the last tick in N/m and Nm/rad, as `spring_limit` let it be.
    Matrix<N> stiffness() const { return table_->scaled_stiffness(scale_, clock_.index); }
    const Matrix<N>& damping() const { return table_->damping[clock_.index]; }  ///< of the last tick
    double schedule_time() const { return clock_.time_at(timer_.last); }  ///< in s

private:
    static constexpr auto kBlocks = blocks<N, M>;
    // From an approach at 0.5 m/s and 1 rad/s a robot is at rest in 0.1 s, after 25 mm and 3 degrees.
    static constexpr Limit kDeceleration{5.0, 10.0};
    // Share of the newest tick in how long a tick lasts: neither one short tick nor one long counts for much.
    static constexpr double kSmoothing = 0.1;
    static constexpr double kOff = 1e-3;  // of a quaternion's length: four rounded digits

    static double virtual_mass(const Schedule& schedule, std::optional<double> given) {
        if (!schedule.inertia.empty()) {
            checked(given.value_or(1.0), !given, "mass", "left out: the schedule has the inertia of its damping");
            return 1.0;
        }
        const double mass = given.value_or(schedule.mass.value_or(1.0));
        checked(mass, 1e-50 <= mass && mass <= 1e50, "mass", "from 1e-50 to 1e50 kg");
        return checked(mass, !schedule.mass || mass == *schedule.mass, "mass", "that of the schedule's damping");
    }

    static Limit pull_limit(const Options& options) {
        return checked<N, M>(options.spring_limit.value_or(options.force_limit), "spring_limit");
    }

    template <std::size_t K>
    static void check_finite(const Vector<K>& values, const char* name) {
        for (const double value : values) checked(value, std::isfinite(value), name, "finite");
    }

    static Position position_of(const State<N, M>& state) {
        Position position;
        std::copy(state.place.begin(), state.place.begin() + position.size(), position.begin());
        return position;
    }

    static Quaternion orientation_of(const State<N, M>& state) {
        static_assert(kIsPose, "positions have no orientation");
        return places::orientation_of(state.place);
    }

    Faults live(double now, double step) {
        if (is_stopped_) {
            brake(now, step, deceleration_);
            return 0;
        }
        const State<N, M> before = state_;
        Vector<N> push = channel_.push;
        desired_ = clock_.row(timer_.last, step);
        if (clock_.boost) push = push + table_->forced(*clock_.boost, clock_.index);
        scale_ = table_->advance(clock_.index, desired_, push, state_, step);
        if (clock_.boost)
            clock_.spare(table_->accelerated(channel_.push, clock_.index), before.velocity, state_.velocity, step);
        Faults faults = 0;
        if (scale_ != Limit{1.0, 1.0}) faults = kSpringLimited;
        // No block is beyond its own top speed where all together are within the least of them.
        const double least = kIsPose ? std::min(top_speed_[0], top_speed_[1]) : top_speed_[0];
        if (limits_.is_any || linalg::norm(state_.velocity) > least)
            faults |= limits_.apply(state_, before, step, top_speed_);
        timer_.last = now;
        timer_.step += kSmoothing * (step - timer_.step);
        return faults;
    }

    Faults live_irregular(double now) {
        double shift;
        const Faults fault = timer_.read(now, shift);
        clock_.shift(shift);
        is_stopped_ = is_stopped_ || timer_.is_failed();
        if (!fault) return live(now, now - timer_.last);
        if (fault == kClock) now = timer_.last + timer_.step;
        // In 1 + sqrt(2) times as long as it brakes the robot can be back: after a longer gap, without commands, it
        // rests where it was told to be last, and is not thrown from there.
        const double passed = now - timer_.last;
        const double speed = std::max(clock_.norm(state_.velocity), clock_.speed_at(timer_.last));
        const bool can_be_back = fault == kLate && passed * deceleration_ > 3.0 * speed;
        brake(now, passed, can_be_back ? infinity : deceleration_);
        return fault;
    }

    void brake(double now, double passed, double deceleration) {
        const double speed = clock_.norm(state_.velocity);
        clock_.brake(timer_.last, passed, deceleration, speed);
        state_ = braked(state_, speed, deceleration, passed);
        timer_.last = now;
    }

    TickTimer timer_;
    ForceChannel<N, M> channel_;
    CommandLimits<N, M> limits_;
    std::shared_ptr<const ScheduleTable<N, M>> table_;
    ScheduleClock<N, M> clock_;
    double deceleration_;
    Limit speed_due_{}, top_speed_{}, scale_{1.0, 1.0};
    State<N, M> state_{}, desired_{};
    bool is_started_ = false, is_stopped_ = false;
    Faults faults_ = 0;
};

/// Robot whose schedule has three positions and an orientation: twists and wrenches of six, in world axes.
using PoseAdmittance = Admittance<6, 7>;

}  // namespace torch_pbd

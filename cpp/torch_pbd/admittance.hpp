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
#include <limits>
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
    int max_bad_ticks = 10;  ///< ticks with a time that is wrong before the robot stops, but for one in ten good ones
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
        : rate_(checked(options.rate, 0.0 < options.rate && options.rate < infinity, "rate", "above 0")),
          longest_(checked(options.max_step, 1.0 / rate_ < options.max_step && options.max_step < infinity, "max_step",
                           "above 1 / rate, finite") + kCoarse / rate_),
          max_bad_ticks_(options.max_bad_ticks),
          channel_(options.force_limit, options.deadband, options.force_rate_limit, options.hold_ticks),
          speed_limit_(checked<N, M>(options.velocity_limit, "velocity_limit", false, true)),
          acceleration_limit_(checked<N, M>(options.acceleration_limit, "acceleration_limit", false, true)),
          table_(std::make_shared<const ScheduleTable<N, M>>(schedule, virtual_mass(schedule, options.mass),
                                                             rate_, pull_limit(options))),
          clock_(table_, options.soft_start, options.approach_speed, acceleration_limit_, options.catches_up) {
        checked(max_bad_ticks_, max_bad_ticks_ >= 1, "max_bad_ticks", "at least 1");
        const Limit stop = checked<N, M>(options.stop_deceleration.value_or(kDeceleration), "stop_deceleration");
        deceleration_ =
            std::min(options.stop_deceleration ? clock_.least(stop) : std::max(clock_.least(stop), clock_.acceleration),
                     clock_.least(acceleration_limit_));
        // Impulse responses of velocity to force integrate, in absolute values, to 2 / damping at most along each mode,
        // for any mass: twice what damping alone lets them do, where not all modes are met at their worst at once.
        const Limit answer = 2.0 * table_->mobility(options.force_limit + pull_limit(options));
        for (std::size_t b = 0; b < kBlocks.size(); ++b)
            speed_due_[b] =
                speed_limit_[b] < infinity ? speed_limit_[b] : clock_.speed / clock_.scale(b) + answer[b];
        desired_ = clock_.begin(0.0, 0.0, {}, {}, {}, state_.place);
    }

    /// Begins where the schedule does, at rest, at `now` s of a monotonic clock.
    void start(double now) { start(now, Start{}); }

    /// Begins, or begins again: faults, forces and motion are forgotten.
    void start(double now, const Start& from) {
        const double resolution = std::nextafter(std::abs(now), infinity) - std::abs(now);
        checked(now, resolution * rate_ <= kCoarse, "now", "small enough to tell ticks apart: give seconds");
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
        least_top_ = infinity;
        for (std::size_t b = 0; b < kBlocks.size(); ++b) {
            const double along = linalg::norm(from.velocity, kBlocks[b]);
            checked(along, along <= speed_limit_[b], b == 0 ? "the speed" : "the angular speed",
                    "velocity_limit at most");
            top_speed_[b] = std::max(top_speed_[b], along);
            const bool is_limited = speed_limit_[b] < infinity || acceleration_limit_[b] < infinity;
            least_top_ = std::min(least_top_, is_limited ? -1.0 : top_speed_[b]);
        }
        last_ = newest_ = now;
        step_ = 1.0 / rate_;
        is_regular_ = false;
        n_bad_ = n_late_ = n_good_ = 0.0;
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
        const double step = now - last_;
        const bool is_regular = is_regular_ && 0.0 < step && step <= longest_;
        Faults faults = channel_.take(force, is_regular ? step : step_);
        is_stopped_ = is_stopped_ || channel_.is_lost;
        faults |= is_regular ? live(now, step) : live_irregular(now);
        if (is_stopped_) faults |= kStopped;
        faults_ |= faults;
        return faults;
    }

    /// Position to command, in units.
    Position position() const { return places::part<n_positions<N, M>>(state_.place, 0); }
    /// Orientation to command, a unit quaternion w x y z from the tool to the world; of poses.
    Quaternion orientation() const {
        static_assert(kIsPose, "positions have no orientation");
        return places::part<4>(state_.place);
    }
    const Vector<N>& velocity() const { return state_.velocity; }  ///< to command, in units/s and rad/s
    Faults faults() const { return faults_; }  ///< all since `start`

    /// External force that acted in the last tick, in N and Nm.
    const Vector<N>& force() const { return channel_.push; }
    /// Desired position of the last tick.
    Position desired_position() const { return places::part<n_positions<N, M>>(desired_.place, 0); }
    /// Desired orientation of the last tick; of poses.
    Quaternion desired_orientation() const {
        static_assert(kIsPose, "positions have no orientation");
        const Quaternion turned = places::part<4>(desired_.place);
        return (1.0 / linalg::norm(turned)) * turned;
    }
    const Vector<N>& desired_velocity() const { return desired_.velocity; }  ///< of the last tick
    /// Stiffness of the last tick in N/m and Nm/rad, as `spring_limit` let it be.
    Matrix<N> stiffness() const { return table_->scaled_stiffness(scale_, clock_.index); }
    const Matrix<N>& damping() const { return table_->damping[clock_.index]; }  ///< of the last tick
    double schedule_time() const { return clock_.time_at(last_); }  ///< in s

private:
    static constexpr auto kBlocks = blocks<N, M>;
    // From an approach at 0.5 m/s and 1 rad/s a robot is at rest in 0.1 s, after 25 mm and 3 degrees.
    static constexpr Limit kDeceleration{5.0, 10.0};
    // Share of the newest tick in how long a tick lasts: neither one short tick nor one long counts for much.
    static constexpr double kSmoothing = 0.1;
    // A reading must tell ticks apart to 1 %, which of their length is rounding: times since 1970 in s do, in ns not.
    static constexpr double kCoarse = 0.01;
    static constexpr double kMadeUp = 0.1;  // share of a bad or late tick that a good one makes up for
    static constexpr int kLateOnEnd = 3;  // one late tick is a stall, two may be; three are a loop that is too slow
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

    Faults live(double now, double step) {
        if (is_stopped_) {
            brake(now, deceleration_);
            return 0;
        }
        const State<N, M> before = state_;
        Vector<N> push = channel_.push;
        desired_ = clock_.row(last_, step);
        if (clock_.boost) push = push + table_->forced(*clock_.boost, clock_.index);
        scale_ = table_->advance(clock_.index, desired_, push, state_, step);
        if (clock_.boost)
            clock_.spare(table_->accelerated(channel_.push, clock_.index), before.velocity, state_.velocity, step);
        Faults faults = scale_ == Limit{1.0, 1.0} ? 0u : kSpringLimited;
        // No block is beyond its own top speed where all together are within the least of them.
        if (linalg::norm(state_.velocity) > least_top_)
            faults |= keep_within(state_, before, step, top_speed_, acceleration_limit_);
        last_ = now;
        step_ += kSmoothing * (step - step_);
        ++n_good_;
        return faults;
    }

    Faults live_irregular(double now) {
        const Faults fault = read(now);
        is_stopped_ = is_stopped_ || n_bad_ >= max_bad_ticks_ || n_late_ >= kLateOnEnd;
        if (!fault) return live(now, now - last_);
        if (fault == kClock) now = last_ + step_;  // a tick is then taken to be as long as they are
        // In 1 + sqrt(2) times as long as it brakes the robot can be back: after a longer gap, without commands, it
        // rests where it was told to be last, and is not thrown from there.
        const double speed = std::max(clock_.norm(state_.velocity), clock_.speed_at(last_));
        const bool can_be_back = fault == kLate && (now - last_) * deceleration_ > 3.0 * speed;
        brake(now, can_be_back ? infinity : deceleration_);
        return fault;
    }

    /// Fault of a tick that is not like the last one.
    Faults read(double now) {
        if (is_regular_) {
            const double made_up = kMadeUp * n_good_;
            n_bad_ = std::max(0.0, n_bad_ - made_up);
            n_late_ = std::max(0.0, n_late_ - made_up);
            n_good_ = 0.0;
            is_regular_ = false;
            newest_ = last_;
        }
        if (!(newest_ < now && now < infinity)) {
            ++n_bad_;
            return kClock;
        }
        // The clock has lost what bad ticks have lived through.
        if (newest_ < last_ && now < last_ + 0.5 * step_) {
            clock_.shift(now - step_ - last_);
            last_ = now - step_;
        }
        newest_ = now;
        if (now - last_ > longest_) {
            ++n_late_;
            return kLate;
        }
        is_regular_ = true;
        return 0;
    }

    /// Brakes all axes alike until `now`, or until standing still.
    void brake(double now, double deceleration) {
        const double passed = now - last_, speed = clock_.norm(state_.velocity);
        clock_.brake(last_, passed, deceleration, speed);
        const double braking = std::min(passed, speed / deceleration);
        const double left = braking == passed ? 1.0 - deceleration * passed / speed : 0.0;
        const Vector<N> before = state_.velocity;
        state_.velocity = left * before;
        state_.place = places::moved<N>(state_.place, 0.5 * braking * (before + state_.velocity));
        last_ = now;
    }

    double rate_, longest_;  ///< tick
    int max_bad_ticks_;
    ForceChannel<N, M> channel_;
    Limit speed_limit_, acceleration_limit_;
    std::shared_ptr<const ScheduleTable<N, M>> table_;
    ScheduleClock<N, M> clock_;
    double deceleration_, least_top_;
    Limit speed_due_{}, top_speed_{}, scale_{1.0, 1.0};
    State<N, M> state_{}, desired_{};
    double last_ = std::numeric_limits<double>::quiet_NaN();  ///< until when the motion is known
    double newest_ = 0.0, step_ = 0.0;  ///< reading of the clock, and how long ticks last
    double n_bad_ = 0.0, n_late_ = 0.0, n_good_ = 0.0;  ///< ticks, the good ones since the last that was not
    bool is_started_ = false, is_stopped_ = false, is_regular_ = false;
    Faults faults_ = 0;
};

/// Robot whose schedule has three positions and an orientation: twists and wrenches of six, in world axes.
using PoseAdmittance = Admittance<6, 7>;

}  // namespace torch_pbd

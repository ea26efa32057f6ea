/// The controller inside a robot's 1 kHz loop: measured force in, commanded motion out. C++17, no other library.
///
///     torch_pbd::Admittance<2> controller(torch_pbd::Schedule::load("letter.csv"));
///     controller.start(seconds(), robot.position());
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
#include <cstddef>
#include <limits>
#include <memory>
#include <optional>
#include <stdexcept>

#include "clock.hpp"
#include "limits.hpp"
#include "linalg.hpp"
#include "schedule.hpp"
#include "steps.hpp"
#include "table.hpp"

namespace torch_pbd {

/// Options of `Admittance`, those of `RealTimeAdmittance`, where they are explained at length.
struct Options {
    /// Virtual mass in kg; none is the schedule's, or 1 kg. Refused where the schedule's damping is for another one.
    std::optional<double> mass;
    double rate = 1000.0;  ///< of the loop, in 1/s
    double max_step = 0.01;  ///< longest tick in s; over a longer one the robot has braked; after three it stops
    double force_limit = 200.0;  ///< range of the sensor in N, as the length of the vector
    double deadband = 0.0;  ///< force on an axis, in N, that counts as none
    std::optional<double> spring_limit;  ///< largest pull of the spring in N; none is `force_limit`
    std::optional<double> velocity_limit;  ///< of the command, in units/s
    std::optional<double> acceleration_limit;  ///< of the command, in units/s^2
    int hold_ticks = 10;  ///< ticks on end with a force that is not finite before the robot stops
    int max_bad_ticks = 10;  ///< ticks on end with a time that is wrong before the robot stops
    std::optional<double> stop_deceleration;  ///< of a stop, in units/s^2
    double soft_start = 1.0;  ///< time of the approach to the schedule at `start`, in s
    double approach_speed = 0.5;  ///< largest speed of the approach, in units/s
    bool catches_up = false;  ///< after a late tick, `on_gap="resume"`
    std::optional<double> force_rate_limit;  ///< fastest change of the force, in N/s
};

/// Robot of N axes that moves as M a = f + K (x_d - x) + D (v_d - v), one tick at a time.
///
/// A tick is solved exactly over the time that really passed, with force and schedule held over it. Constructor and
/// `start` check what they are given, and throw std::invalid_argument. One thread at a time may use an object.
template <std::size_t N>
class Admittance {
public:
    explicit Admittance(const Schedule& schedule, const Options& options = {})
        : mass_(virtual_mass(schedule, options.mass)),
          timer_(checked(options.rate, options.rate > 0.0, "rate", "above 0"), options.max_step, options.max_bad_ticks),
          channel_(mass_, options.force_limit, options.deadband, options.force_rate_limit, options.hold_ticks),
          limits_(options.velocity_limit, options.acceleration_limit),
          table_(std::make_shared<const ScheduleTable<N>>(schedule, mass_, options.rate)),
          clock_(table_, options.soft_start, options.approach_speed, limits_.acceleration, options.catches_up) {
        const double pull =
            options.spring_limit ? positive_or_infinite(options.spring_limit, "spring_limit") : options.force_limit;
        pull_limit_ = pull / mass_;
        const double stop = options.stop_deceleration
                                ? positive_or_infinite(options.stop_deceleration, "stop_deceleration")
                                : std::max(kDeceleration, clock_.acceleration);
        deceleration_ = std::min(stop, limits_.acceleration);
        // Impulse responses of velocity to force integrate, in absolute values, to 2 / damping at most, for any mass.
        const double damping = table_->least_damping;
        const double answer = damping > 0.0 ? 2.0 * (options.force_limit + pull) / damping : infinity;
        speed_due_ = options.velocity_limit ? limits_.speed : clock_.speed + answer;
        state_ = desired_ = clock_.begin(0.0, 0.0, std::nullopt, {});
        state_.velocity = {};
    }

    /// Begins, or begins again, at `now` s of a monotonic clock: faults, forces and motion are forgotten.
    ///
    /// No position is where the schedule is. `at` is the time in the schedule to begin at, in s; `schedule_time` goes
    /// on after a stop. `force_bias` is the reading of the sensor while nothing touches it, in N.
    void start(double now, const std::optional<Vector<N>>& position = {}, const Vector<N>& velocity = {},
               double at = 0.0, const Vector<N>& force_bias = {}) {
        checked(at, 0.0 <= at && at <= table_->end, "at", "a time of the schedule, in s");
        for (std::size_t i = 0; i < N; ++i) {
            checked(position ? (*position)[i] : 0.0, true, "position", "finite");
            checked(velocity[i], true, "velocity", "finite");
            checked(force_bias[i], true, "force_bias", "finite");
        }
        const double speed = linalg::norm(velocity);
        checked(speed, speed <= limits_.speed, "the speed", "velocity_limit at most");
        timer_.begin(now);
        channel_.begin(force_bias);
        scale_ = 1.0;
        desired_ = clock_.begin(now, at, position, velocity);
        state_ = {position.value_or(desired_.position), velocity};
        top_speed_ = std::max(speed_due_, speed);
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

    const Vector<N>& position() const { return state_.position; }  ///< command, in units
    const Vector<N>& velocity() const { return state_.velocity; }  ///< command, in units/s
    Faults faults() const { return faults_; }  ///< all since `start`
    double mass() const { return mass_; }  ///< in kg

    /// External force that acted in the last tick, in N.
    Vector<N> force() const { return linalg::scaled(mass_, channel_.push); }
    const Vector<N>& desired_position() const { return desired_.position; }  ///< of the last tick, in units
    const Vector<N>& desired_velocity() const { return desired_.velocity; }  ///< of the last tick, in units/s
    /// Stiffness of the last tick in N/m, as `spring_limit` let it be.
    Matrix<N> stiffness() const { return linalg::scaled(scale_, table_->stiffness[clock_.index]); }
    const Matrix<N>& damping() const { return table_->damping[clock_.index]; }  ///< of the last tick, in N s/m
    double schedule_time() const { return clock_.time_at(timer_.last); }  ///< in s

private:
    static double virtual_mass(const Schedule& schedule, std::optional<double> given) {
        const double mass = given.value_or(schedule.mass.value_or(1.0));
        checked(mass, 1e-50 <= mass && mass <= 1e50, "mass", "from 1e-50 to 1e50 kg");
        return checked(mass, !schedule.mass || mass == *schedule.mass, "mass", "that of the schedule's damping");
    }

    Faults live(double now, double step) {
        if (is_stopped_) {
            brake(now, step, deceleration_);
            return 0;
        }
        const State<N> before = state_;
        const Vector<N>& push = channel_.push;
        desired_ = clock_.row(timer_.last, step);
        const Vector<N> boosted = clock_.is_boosted ? linalg::sum(push, clock_.boost) : push;
        scale_ = table_->advance(clock_.index, desired_, boosted, state_, step, pull_limit_);
        if (clock_.is_boosted) clock_.spare(push, before.velocity, state_.velocity, step);
        Faults faults = 0;
        if (scale_ != 1.0) faults = kSpringLimited;
        if (limits_.is_any() || linalg::norm(state_.velocity) > top_speed_)
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
        const double speed = std::max(linalg::norm(state_.velocity), clock_.speed_at(timer_.last));
        const bool can_be_back = fault == kLate && passed * deceleration_ > 3.0 * speed;
        brake(now, passed, can_be_back ? infinity : deceleration_);
        return fault;
    }

    void brake(double now, double passed, double deceleration) {
        clock_.brake(timer_.last, passed, deceleration, linalg::norm(state_.velocity));
        state_ = braked(state_, deceleration, passed);
        timer_.last = now;
    }

    static constexpr double kDeceleration = 5.0;  // units/s^2: from 0.5 m/s to rest in 0.1 s and 25 mm
    // Share of the newest tick in how long a tick lasts: neither one short tick nor one long counts for much.
    static constexpr double kSmoothing = 0.1;

    double mass_;
    TickTimer timer_;
    ForceChannel<N> channel_;
    CommandLimits<N> limits_;
    std::shared_ptr<const ScheduleTable<N>> table_;
    ScheduleClock<N> clock_;
    double pull_limit_, deceleration_, speed_due_, top_speed_ = infinity, scale_ = 1.0;
    State<N> state_, desired_;
    bool is_started_ = false, is_stopped_ = false;
    Faults faults_ = 0;
};

}  // namespace torch_pbd

/// Limits of the force that comes in and of the command that goes out, and the faults of a tick where they acted.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <limits>
#include <optional>
#include <sstream>
#include <stdexcept>
#include <string>

#include "linalg.hpp"
#include "steps.hpp"

namespace torch_pbd {

inline constexpr double infinity = std::numeric_limits<double>::infinity();

/// Faults of a tick, the same numbers as `TickStatus` of Python; 0 where there was none.
enum Fault : unsigned {
    kForceInvalid = 1,  ///< the force was NaN or infinite: the median of the last good ones acts, fading
    kForceSaturated = 2,  ///< the force was longer than `force_limit` and was shortened to it
    kClock = 4,  ///< `now` did not increase, or is not finite: the robot brakes over a tick as long as they are
    kLate = 8,  ///< more than `max_step` after the last tick: the robot has braked, and goes on from there
    kSpringLimited = 16,  ///< the stiffness was scaled down for `spring_limit`
    kAccelerationLimited = 32,  ///< `acceleration_limit` acted
    kVelocityLimited = 64,  ///< `velocity_limit` acted
    kStopped = 128,  ///< force or clock were bad for too long: the robot brakes, then stands still, until `start`
    kForceRateLimited = 256,  ///< the force changed faster than `force_rate_limit`
};
using Faults = unsigned;

/// Refuses a number: one sentence that says which it was, and what it must be.
inline double checked(double value, bool is_good, const char* name, const char* must) {
    if (is_good && std::isfinite(value)) return value;
    std::ostringstream message;
    message << name << " is " << value << ", must be " << must << ".";
    throw std::invalid_argument(message.str());
}

/// A finite number above 0, or infinity where none is given.
inline double positive_or_infinite(std::optional<double> value, const char* name) {
    return value ? checked(*value, *value > 0.0, name, "a finite number above 0") : infinity;
}

/// The force that acts, per kg of virtual mass.
///
/// A lost force is replaced by the median of the last good ones, on each axis, which fades to nothing over
/// `hold_ticks`: neither a wild reading before the loss nor an old push can carry the robot away.
template <std::size_t N>
class ForceChannel {
public:
    ForceChannel(double mass, double force_limit, double deadband, std::optional<double> rate_limit, int hold_ticks)
        : mass_(mass),
          limit_(positive_or_infinite(force_limit, "force_limit") / mass),
          deadband_(checked(deadband, deadband >= 0.0, "deadband", "a finite number of at least 0") / mass),
          rate_limit_(positive_or_infinite(rate_limit, "force_rate_limit") / mass),
          hold_ticks_(static_cast<int>(checked(hold_ticks, hold_ticks >= 0, "hold_ticks", "at least 0"))) {}

    /// Forgets all forces; before the first there was none.
    void begin(const Vector<N>& bias) {
        push = {};
        bias_ = bias;
        n_lost_ = 0;
        is_lost = false;
        recent_ = {};
    }

    /// Lets a force as measured act, as far as it may, `step` s after the last one.
    Faults take(const Vector<N>& force, double step) {
        Vector<N> measured;
        for (std::size_t i = 0; i < N; ++i) {
            measured[i] = (force[i] - bias_[i]) / mass_;
            measured[i] -= std::max(-deadband_, std::min(deadband_, measured[i]));
        }
        const double length = linalg::norm(measured);
        Faults faults = 0;
        if (!(length < infinity)) {
            bridge();
            return kForceInvalid;
        }
        if (length > limit_) {
            for (double& part : measured) part = part / length * limit_;
            faults = kForceSaturated;
        }
        const double change = linalg::distance(measured, push), most = rate_limit_ * step;
        if (change > most) {
            for (std::size_t i = 0; i < N; ++i) measured[i] = push[i] + most / change * (measured[i] - push[i]);
            faults |= kForceRateLimited;
        }
        push = measured;
        n_lost_ = 0;
        recent_[newest_ = (newest_ + 1) % recent_.size()] = push;
        return faults;
    }

    Vector<N> push{};
    bool is_lost = false;  ///< for more than `hold_ticks` on end

private:
    void bridge() {
        is_lost = ++n_lost_ > hold_ticks_;
        const double share = std::max(0.0, 1.0 - n_lost_ / (hold_ticks_ + 1.0));
        for (std::size_t i = 0; i < N; ++i) {
            std::array<double, kRecent> parts;
            for (std::size_t k = 0; k < kRecent; ++k) parts[k] = recent_[k][i];
            std::nth_element(parts.begin(), parts.begin() + kRecent / 2, parts.end());
            push[i] = share * parts[kRecent / 2];
        }
    }

    // A median of five is a good force after one or two wild ones, and 2 ms late at 1 kHz.
    static constexpr std::size_t kRecent = 5;
    double mass_, limit_, deadband_, rate_limit_;
    int hold_ticks_, n_lost_ = 0;
    Vector<N> bias_{};
    std::array<Vector<N>, kRecent> recent_{};
    std::size_t newest_ = 0;
};

/// Largest speed and acceleration of the command; infinite where none is given.
template <std::size_t N>
class CommandLimits {
public:
    CommandLimits(std::optional<double> velocity_limit, std::optional<double> acceleration_limit)
        : speed(positive_or_infinite(velocity_limit, "velocity_limit")),
          acceleration(positive_or_infinite(acceleration_limit, "acceleration_limit")) {}

    bool is_any() const { return speed < infinity || acceleration < infinity; }

    /// Brings a state that a tick of `step` s led to within limits; returns which of them acted.
    Faults apply(State<N>& state, const State<N>& last, double step, double top_speed) const {
        // The change of velocity is shortened first, then the velocity: the second never undoes the first.
        const double change = linalg::distance(state.velocity, last.velocity), most = acceleration * step;
        Faults faults = 0;
        if (change > most) {
            for (std::size_t i = 0; i < N; ++i)
                state.velocity[i] = last.velocity[i] + most / change * (state.velocity[i] - last.velocity[i]);
            faults |= kAccelerationLimited;
        }
        const double reached = linalg::norm(state.velocity);
        if (reached > top_speed) {
            state.velocity = linalg::scaled(top_speed / reached, state.velocity);
            faults |= kVelocityLimited;
        } else if (linalg::distance(state.position, last.position) > top_speed * step) {
            faults |= kVelocityLimited;  // a swing within one tick, from rest to rest, is too fast as well
        }
        if (faults) state.position = drift(last.position, last.velocity, state.velocity, step);
        return faults;
    }

    double speed, acceleration;
};

}  // namespace torch_pbd

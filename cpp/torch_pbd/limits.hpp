/// Limits of the force and the time that come in, and of the command that goes out, and the faults where they acted.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <limits>
#include <sstream>
#include <stdexcept>

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

/// Option that positions and rotations have each their own of; without an orientation the second is not used.
using Limit = Vector<2>;

/// Refuses a number: one sentence that says which it was, and what it must be.
inline double checked(double value, bool is_good, const char* name, const char* must) {
    if (is_good && !std::isnan(value)) return value;
    std::ostringstream message;
    message << name << " is " << value << ", must be " << must << ".";
    throw std::invalid_argument(message.str());
}

/// Option of positions, and if there are rotations, of these: above 0, or from 0 on, and finite if it must be.
template <std::size_t N, std::size_t M>
Limit checked(Limit limit, const char* name, bool may_be_zero = false, bool may_be_infinite = false) {
    for (std::size_t b = 0; b < blocks<N, M>.size(); ++b) {
        const double value = limit[b];
        checked(value, value > 0.0 || (may_be_zero && value == 0.0), name, may_be_zero ? "of at least 0" : "above 0");
        checked(value, value < infinity || may_be_infinite, name, "finite");
    }
    return limit;
}

/// The force that acts, and of poses the torque.
///
/// One that is lost is replaced by the median of the last good ones, on each axis, which fades to nothing over
/// `hold_ticks`: neither a wild reading before the loss nor an old push can carry the robot away.
template <std::size_t N, std::size_t M>
class ForceChannel {
public:
    ForceChannel(Limit limit, Limit deadband, Limit rate_limit, int hold_ticks)
        : limit_(checked<N, M>(limit, "force_limit")),
          deadband_(checked<N, M>(deadband, "deadband", true)),
          rate_limit_(checked<N, M>(rate_limit, "force_rate_limit", false, true)),
          hold_ticks_(static_cast<int>(checked(hold_ticks, hold_ticks >= 0, "hold_ticks", "at least 0"))) {}

    /// Forgets all forces; before the first there was none.
    void begin(const Vector<N>& bias) {
        push = {};
        bias_ = bias;
        channels_ = {};
        is_lost = false;
    }

    /// Lets a force as measured act, as far as it may, `step` s after the last one.
    Faults take(const Vector<N>& force, double step) {
        Faults faults = 0;
        for (std::size_t b = 0; b < channels_.size(); ++b) {
            const Block block = blocks<N, M>[b];
            Channel& channel = channels_[b];
            Vector<N> acting = force - bias_;
            for (double& part : acting) part -= std::clamp(part, -deadband_[b], deadband_[b]);
            const double length = linalg::norm(acting, block);
            if (length < infinity) {
                if (length > limit_[b]) {
                    acting = (limit_[b] / length) * acting;
                    faults |= kForceSaturated;
                }
                const double change = linalg::norm(acting - push, block), most = rate_limit_[b] * step;
                if (change > most) {
                    acting = push + (most / change) * (acting - push);
                    faults |= kForceRateLimited;
                }
                channel.n_lost = 0;
            } else {
                is_lost = ++channel.n_lost > hold_ticks_ || is_lost;
                acting = std::max(0.0, 1.0 - channel.n_lost / (hold_ticks_ + 1.0)) * median(channel.recent);
                faults |= kForceInvalid;
            }
            std::copy(acting.begin() + block.begin, acting.begin() + block.end, push.begin() + block.begin);
            if (channel.n_lost == 0) {
                channel.newest = (channel.newest + 1) % kRecent;
                channel.recent[channel.newest] = push;
            }
        }
        return faults;
    }

    Vector<N> push{};
    bool is_lost = false;  ///< for more than `hold_ticks` on end

private:
    // A median of five is a good force after one or two wild ones, and 2 ms late at 1 kHz.
    static constexpr std::size_t kRecent = 5;
    struct Channel {
        int n_lost = 0;
        std::array<Vector<N>, kRecent> recent{};
        std::size_t newest = 0;
    };

    static Vector<N> median(const std::array<Vector<N>, kRecent>& recent) {
        Vector<N> middle;
        for (std::size_t i = 0; i < N; ++i) {
            std::array<double, kRecent> parts;
            for (std::size_t k = 0; k < kRecent; ++k) parts[k] = recent[k][i];
            std::nth_element(parts.begin(), parts.begin() + kRecent / 2, parts.end());
            middle[i] = parts[kRecent / 2];
        }
        return middle;
    }

    Limit limit_, deadband_, rate_limit_;
    int hold_ticks_;
    Vector<N> bias_{};
    std::array<Channel, blocks<N, M>.size()> channels_{};
};

/// Brings a state that a tick of `step` s led to within the largest speed and acceleration; returns which acted.
template <std::size_t N, std::size_t M>
Faults keep_within(State<N, M>& state, const State<N, M>& last, double step, Limit top_speed, Limit acceleration) {
    Vector<N> move = places::deviation<N>(state.place, last.place), &velocity = state.velocity;
    Faults all = 0;
    for (std::size_t b = 0; b < blocks<N, M>.size(); ++b) {
        // The change of velocity is shortened first, then the velocity: the second never undoes the first.
        const Block block = blocks<N, M>[b];
        const double change = linalg::norm(velocity - last.velocity, block), most = acceleration[b] * step;
        Faults faults = 0;
        if (change > most) {
            for (std::size_t i = block.begin; i < block.end; ++i)
                velocity[i] = last.velocity[i] + most / change * (velocity[i] - last.velocity[i]);
            faults |= kAccelerationLimited;
        }
        const double along = linalg::norm(velocity, block);
        if (along > top_speed[b]) {
            for (std::size_t i = block.begin; i < block.end; ++i) velocity[i] *= top_speed[b] / along;
            faults |= kVelocityLimited;
        } else if (linalg::norm(move, block) > top_speed[b] * step) {
            faults |= kVelocityLimited;  // a swing within one tick, from rest to rest, is too fast as well
        }
        if (faults)
            for (std::size_t i = block.begin; i < block.end; ++i)
                move[i] = 0.5 * step * (last.velocity[i] + velocity[i]);
        all |= faults;
    }
    if (all) state.place = places::moved(last.place, move);
    return all;
}

}  // namespace torch_pbd

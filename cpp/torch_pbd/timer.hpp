/// The clock of the loop: how long a tick took, where the clock says so.
#pragma once

#include <cmath>
#include <limits>

#include "limits.hpp"

namespace torch_pbd {

/// Ticks of at most `max_step` s; `last` is until when the motion is known, `step` how long ticks last.
class TickTimer {
public:
    TickTimer(double rate, double longest, int max_bad_ticks)
        : max_step(checked(longest, 1.0 / rate < longest && longest < infinity, "max_step", "above 1 / rate, finite")),
          rate_(rate),
          max_bad_ticks_(static_cast<int>(checked(max_bad_ticks, max_bad_ticks >= 1, "max_bad_ticks", "at least 1"))) {}

    /// Counts from `now`.
    void begin(double now) {
        // A reading must tell ticks apart to 1 %: times since 1970 in s do, in ns they do not.
        const double resolution = std::nextafter(std::abs(now), infinity) - std::abs(now);
        checked(now, resolution * rate_ <= 0.01, "now", "small enough to tell ticks apart: give seconds");
        last = newest_ = now;
        step = 1.0 / rate_;
        is_regular = false;
        n_bad_ = n_late_ = 0;
    }

    /// Whether bad or late ticks are too many on end for the robot to go on.
    bool is_failed() const { return n_bad_ >= max_bad_ticks_ || n_late_ >= kLateOnEnd; }

    /// Fault of a tick that is not like the last one; `shift` is the time by which `last` was put forward.
    ///
    /// Where the clock does not say how long a tick took, it is taken to be as long as they are.
    Faults read(double now, double& shift) {
        shift = 0.0;
        if (is_regular) {
            is_regular = false;
            newest_ = last;
        }
        if (!(newest_ < now && now < infinity)) {
            ++n_bad_;
            return kClock;
        }
        // The clock has lost what bad ticks have lived through.
        if (n_bad_ && now < last + 0.5 * step) {
            shift = now - step - last;
            last = now - step;
        }
        newest_ = now;
        n_bad_ = 0;
        if (now - last > max_step) {
            ++n_late_;
            return kLate;
        }
        is_regular = true;
        n_late_ = 0;
        return 0;
    }

    double last = std::numeric_limits<double>::quiet_NaN();
    double step = 0.0, max_step;
    bool is_regular = false;

private:
    static constexpr int kLateOnEnd = 3;  // one late tick is a stall, two may be; three are a loop that is too slow
    double newest_ = 0.0, rate_;
    int max_bad_ticks_, n_bad_ = 0, n_late_ = 0;
};

}  // namespace torch_pbd

/// The two clocks of the loop: its own, and where it is in its schedule; realtime/clock.py line by line.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <limits>
#include <memory>
#include <optional>
#include <utility>
#include <vector>

#include "limits.hpp"
#include "linalg.hpp"
#include "steps.hpp"
#include "table.hpp"

namespace torch_pbd {

/// Ticks of at most `max_step` s; `last` is until when the motion is known, `step` how long ticks last.
class TickTimer {
public:
    TickTimer(double rate, double longest, int max_bad_ticks)
        : max_step(checked(longest, longest > 1.0 / rate, "max_step", "more than 1 / rate: give some ticks")),
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

/// Schedule time, which runs at a pace from 0 to 1, or a little more to catch up, and the motion desired then.
///
/// At a pace r the desired velocity is r x' and its acceleration r^2 x'' + r' x'. The second term is at most `gain`,
/// also towards the end of a schedule that ends while moving: there r^2 <= 2 gain times the integral of dt / |x'| over
/// what is left. `boost` is that term, to be fed forward, so that no change of pace displaces the robot. At a pace of 1
/// schedule time is a difference of two times of the loop's clock, which adds up no rounding.
///
/// The desired motion stays within `acceleration`, and with it a robot that nobody pushes: an approach from elsewhere
/// takes what the schedule's own acceleration leaves, and a change of pace what both leave; nothing is caught up
/// meanwhile; and the pace rises no faster than the pull of the spring leaves room for (see `spare`). The end of the
/// schedule does not slow an approach, which has a pace of its own, `free_`, and is `ahead_` of the schedule then.
template <std::size_t N>
class ScheduleClock {
public:
    ScheduleClock(std::shared_ptr<const ScheduleTable<N>> table, double soft_start, double approach_speed,
                  double acceleration_limit, bool catches_up)
        : table_(std::move(table)),
          soft_start_(checked(soft_start, soft_start >= 0.0, "soft_start", "a finite number of at least 0")),
          approach_speed_(checked(approach_speed, approach_speed > 0.0, "approach_speed", "a finite number above 0")),
          catches_up_(catches_up) {
        const std::vector<double>& speeds = table_->speeds;
        const double own = table_->acceleration, fastest = *std::max_element(speeds.begin(), speeds.end());
        // Acceleration of a soft start that comes up to speed; without one, a second is as long as its default.
        const double soft = std::max(fastest, approach_speed) / (soft_start > 0.0 ? soft_start : 1.0);
        // One half of a limit is left for the schedule's own acceleration.
        gain_ = std::min(std::max(kShare * own, soft), 0.5 * acceleration_limit);
        speed = kSpeed * fastest + approach_speed;
        acceleration = std::max((1.0 + kShare) * own + gain_, kSharpest / kSteepest * soft);
        // What the schedule's own acceleration leaves to an approach; a critically damped spring overshoots it by 13 %.
        room_ = std::max(gain_, acceleration - (1.0 + kShare) * own);
        const double room = own > 0.0 ? (acceleration - gain_) / own : infinity;
        fastest_ = catches_up ? std::min(kSpeed, std::sqrt(room)) : 1.0;
        find_ends();
    }

    /// Starts at a time of the schedule, whose motion it is, as fast as the velocity of the robot is the desired one.
    ///
    /// A desired position that begins elsewhere comes to the schedule's by minimum jerk.
    State<N> begin(double now, double at, const std::optional<Vector<N>>& position, const Vector<N>& velocity) {
        at_ = at;
        origin_ = now - at;
        lag_ = 0.0;
        is_soft_ = false;
        clear_boost();
        spare_ = gain_;
        ahead_ = 0.0;
        end_share_ = 1.0;
        double squared_limit;
        const State<N> row = desired(at, squared_limit);
        distance_ = position ? linalg::difference(row.position, *position) : Vector<N>{};
        const double way = linalg::norm(distance_);
        double room = room_;
        blend_ = time_of(way, room);
        // An approach that meets the slow end of its schedule leaves one half of `gain` to it.
        if (at + blend_ > slow_from_) {
            room -= 0.5 * gain_;
            end_share_ = 0.5;
            blend_ = time_of(way, room);
            squared_limit *= end_share_;
        }
        is_soft_ = !linalg::is_zero(distance_) && soft_start_ > 0.0;
        // At a pace of 1 the approach leaves this much less than `gain` to changes of pace.
        if (is_soft_) taken_ = std::clamp(gain_ + kSharpest * way / blend_ / blend_ - room_, 0.0, gain_);
        // The pace at which the desired motion is nearest to that of the robot.
        const double square = linalg::dot(row.velocity, row.velocity), along = linalg::dot(row.velocity, velocity);
        free_ = std::min(1.0, square > 0.0 && soft_start_ > 0.0 ? std::max(0.0, along / square) : 1.0);
        pace_ = std::min(free_, std::sqrt(squared_limit));
        is_steady_ = pace_ == 1.0 && !is_soft_;
        return row;
    }

    /// Schedule time at the end of the last tick, in s.
    double time_at(double now) const { return std::min(now - origin_, table_->end); }

    /// Desired speed at the end of the last tick.
    double speed_at(double now) {
        double squared_limit;
        const State<N> row = desired(now - origin_, squared_limit);
        if (!is_soft_) return pace_ * linalg::norm(row.velocity);
        return linalg::norm(linalg::sum(linalg::scaled(pace_, row.velocity), linalg::scaled(free_, slope_)));
    }

    /// Motion that is desired in a tick, whose gains are those of the row `index`.
    State<N> row(double begin, double step) {
        if (is_steady_) {
            const double nearest = std::max(0.0, (begin - origin_) * table_->rate + 0.5);
            if (nearest < static_cast<double>(tail_)) {
                index = static_cast<std::size_t>(nearest);
                return table_->rows[index];
            }
            if (begin - origin_ >= table_->end) {
                index = table_->last();
                clear_boost();
                return table_->rows[index];
            }
        }
        return ramped(begin, step);
    }

    /// Lets schedule time, while `passed` s pass, brake at most so fast, and then stand.
    ///
    /// From the robot's speed, where that is lower: a desired position that went on faster would pull the spring.
    void brake(double begin, double passed, double deceleration, double robot_speed) {
        const double desired_speed = speed_at(begin), slower = std::min(desired_speed, robot_speed);
        double ran = 0.0;
        if (desired_speed > 0.0) {
            const double pace = pace_ * slower / desired_speed, free = free_ * slower / desired_speed;
            const double left = slower > 0.0 ? std::max(0.0, 1.0 - deceleration * passed / slower) : 0.0;
            const double braking = 0.5 * std::min(passed, slower / deceleration);
            ran = braking * (1.0 + left) * pace;
            ahead_ += braking * (1.0 + left) * free - ran;
            pace_ = pace * left;
            free_ = free * left;
        }
        shift(passed - ran);
        lag_ = std::max(0.0, lag_ + (catches_up_ ? passed - ran : 0.0));
        clear_boost();
        is_steady_ = false;
        // The spring pulls at the braked robot as hard as before, and a rise of the pace would add to it: the next tick
        // tells how much it may.
        spare_ = 0.0;
    }

    /// Lets the pace rise by what a tick's change of velocity leaves, where the boost and a push do not cause it.
    ///
    /// While a push is not taken out, a robot that is shaken comes back to its schedule seconds later.
    void spare(const Vector<N>& push, const Vector<N>& before, const Vector<N>& after, double step) {
        const Vector<N> boosted = linalg::sum(before, linalg::scaled(step, boost));
        spare_ = acceleration + linalg::norm(push) - linalg::distance(after, boosted) / step;
    }

    /// Lets so much time of the loop's clock pass without schedule time.
    void shift(double time) { origin_ += time; }

    double speed, acceleration;  ///< most that the desired motion takes
    std::size_t index = 0;
    Vector<N> boost{};
    bool is_boosted = false;

private:
    /// Largest squares of the pace before the end, where it acts, and from when on.
    void find_ends() {
        const std::size_t last = table_->last();
        const std::vector<double>& speeds = table_->speeds;
        squared_limits_.assign(last + 1, 0.0);
        double left = 0.0;  // integral of dt / |x'| to the end; where the schedule rests it is long, not endless
        for (std::size_t i = last; i-- > 0;) {
            const double mean = std::max(0.5 * (speeds[i + 1] + speeds[i]), 1e-9 * speed);
            left += (table_->time(i + 1) - table_->time(i)) / mean;
            squared_limits_[i] = 2.0 * gain_ * left;
        }
        const auto count = [this](double least) {
            return static_cast<std::size_t>(std::count_if(squared_limits_.begin(), squared_limits_.end(),
                                                          [least](double limit) { return limit >= least; }));
        };
        tail_ = count(fastest_ * fastest_);
        // Where a schedule that ends while moving is slower if it may take one half of `gain` for that.
        const std::size_t fast = count(2.0);
        const bool ends_moving = speeds.back() * table_->rate > gain_;
        slow_from_ = ends_moving ? table_->time(fast > 0 ? fast - 1 : last) : infinity;
    }

    State<N> ramped(double begin, double step) {
        const double time = begin - origin_, last_pace = pace_;
        double squared_limit;
        State<N> row = desired(time, squared_limit);
        const Vector<N> motion = row.velocity;
        // Most ticks of an approach: at a pace of 1 nothing changes it, for nothing is caught up.
        if (is_soft_ && last_pace == 1.0 && free_ == 1.0 && 1.0 <= squared_limit) {
            clear_boost();
            spare_ = 0.0;
            row.velocity = linalg::sum(motion, slope_);
            return row;
        }
        double motion_speed = linalg::norm(motion), last_free = last_pace, gain = gain_;
        if (is_soft_) {
            last_free = free_;
            gain -= taken_ * last_free * last_free;
            // Where the schedule is slower than its approach, `gain` is for the changes of both.
            motion_speed =
                last_pace < last_free ? motion_speed + linalg::norm(slope_) : linalg::norm(linalg::sum(motion, slope_));
        }
        const auto [faster, free] = freely(last_free, gain, motion_speed, step);
        const double pace = pace_ = std::min({last_pace + faster, free, std::sqrt(squared_limit)});
        // Where the pace is even nothing says what is spare, and the first tick of a rise finds out.
        is_boosted = pace != last_pace || (free != last_free && is_soft_);
        if (is_boosted) {
            boost = linalg::scaled((pace - last_pace) / step, motion);
        } else {
            clear_boost();
            spare_ = 0.0;
        }
        row.velocity = linalg::scaled(pace, motion);
        if (is_soft_) {
            if (is_boosted) boost = linalg::sum(boost, linalg::scaled((free - last_free) / step, slope_));
            ahead_ += 0.5 * step * (free + last_free - pace - last_pace);
            row.velocity = linalg::sum(row.velocity, linalg::scaled(free, slope_));
        }
        free_ = is_soft_ ? free : pace;
        const double lost = step - 0.5 * step * (pace + last_pace);
        origin_ += lost;
        if (lag_ > 0.0) lag_ = std::max(0.0, lag_ + lost);
        // Time is put onto a row where the ramp ends: without ramps a tick takes the nearest one.
        if (pace == 1.0 && last_pace != 1.0) {
            const double then = time + step - lost;
            origin_ += then - std::nearbyint(then * table_->rate) / table_->rate;
        }
        if (!is_soft_ && (time >= table_->end || (pace == 1.0 && last_pace == 1.0 && lag_ == 0.0))) {
            clear_boost();
            is_steady_ = true;
        }
        return row;
    }

    struct Pace {
        double faster, free;
    };

    /// Largest rise of the pace in a tick, and the pace after it where the end of the schedule does not limit it.
    Pace freely(double pace, double gain, double motion_speed, double step) const {
        // The pace changes by `rise` a second at most. From a pace of 1 + p, p^2 / (2 rise) of the lag is made up for
        // by the time it is down to 1 again: the p of the whole lag is the one to go for, once an approach is over.
        const double rise = motion_speed > 0.0 ? gain / motion_speed : infinity;
        double goal = 1.0;
        if (lag_ > 0.0 && !is_soft_) goal = std::min(fastest_, 1.0 + std::sqrt(2.0 * rise * lag_));
        const double change = rise * step;
        double faster = change;
        if (spare_ < gain && motion_speed > 0.0)
            faster = std::min(gain, std::max(kLeastSpare * gain_, spare_)) / motion_speed * step;
        return {faster, std::min(pace + faster, std::max(goal, pace - change))};
    }

    /// Motion at a time and a pace of 1, between a row and the next, and the square of the largest pace.
    ///
    /// An approach under way changes the position, and its own velocity at a pace of 1 is `slope_`.
    State<N> desired(double time, double& squared_limit) {
        State<N> row;
        if (time >= table_->end) {
            index = table_->last();
            row = table_->rows[index];
            squared_limit = infinity;
        } else {
            index = std::min(static_cast<std::size_t>(std::max(0.0, time * table_->rate + kOnRow)), table_->last() - 1);
            const double start = static_cast<double>(index) / table_->rate, stop = table_->time(index + 1);
            const double share = time < stop ? (time - start) / (stop - start) : 1.0;
            row = table_->rows[index];
            const State<N>& after = table_->rows[index + 1];
            for (std::size_t i = 0; i < N; ++i) {
                row.position[i] += share * (after.position[i] - row.position[i]);
                row.velocity[i] += share * (after.velocity[i] - row.velocity[i]);
            }
            const double low = squared_limits_[index], high = squared_limits_[index + 1];
            squared_limit = low + share * (high - low);
        }
        if (!is_soft_) return row;
        const double phase = (time + ahead_ - at_) / blend_;
        is_soft_ = phase < 1.0;
        if (is_soft_) {
            // Rest of a way of 1 by minimum jerk, and its slope over the phase.
            const double left = 1.0 - phase * phase * phase * (10.0 - 15.0 * phase + 6.0 * (phase * phase));
            const double slope = 30.0 * (phase * phase) * ((1.0 - phase) * (1.0 - phase)) / blend_;
            row.position = linalg::difference(row.position, linalg::scaled(left, distance_));
            slope_ = linalg::scaled(slope, distance_);
            squared_limit *= end_share_;
        }
        return row;
    }

    /// Time of an approach within its largest speed and this acceleration.
    double time_of(double way, double room) const {
        return std::max({soft_start_, kSteepest * way / approach_speed_, std::sqrt(kSharpest * way / room)});
    }

    void clear_boost() {
        is_boosted = false;
        boost = {};
    }

    // The desired motion may be 1.5 times as fast as the schedule, and accelerate so much more: one half of that
    // changes the pace, the other is left for the square of the pace while it catches up.
    static constexpr double kSpeed = 1.5, kShare = 0.25;
    // Share of `gain` that a rise of the pace may always take, so that nobody who shakes the robot makes its schedule
    // stand.
    static constexpr double kLeastSpare = 0.1;
    // Share of a row: time that was put onto a row takes that row, to whichever side it was rounded.
    static constexpr double kOnRow = 1e-6;
    // A minimum jerk of 1 over a time of 1 has a velocity of 15/8 and an acceleration of 10 / sqrt(3).
    static constexpr double kSteepest = 1.875, kSharpest = 5.7735;

    std::shared_ptr<const ScheduleTable<N>> table_;
    double soft_start_, approach_speed_;
    bool catches_up_;
    double gain_, room_, fastest_, slow_from_;
    std::vector<double> squared_limits_;
    std::size_t tail_;
    double at_ = 0.0, origin_ = 0.0, lag_ = 0.0, spare_ = 0.0, ahead_ = 0.0, end_share_ = 1.0, blend_ = 1.0;
    double taken_ = 0.0, free_ = 1.0, pace_ = 1.0;
    bool is_soft_ = false, is_steady_ = false;
    Vector<N> distance_{}, slope_{};
};

}  // namespace torch_pbd

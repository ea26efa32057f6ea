/// The clock of the schedule: where the loop is in it, and the motion desired then; realtime/clock.py line by line.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <memory>
#include <optional>
#include <utility>
#include <vector>

#include "limits.hpp"
#include "linalg.hpp"
#include "steps.hpp"
#include "table.hpp"

namespace torch_pbd {

/// Schedule time, which runs at a pace from 0 to 1, or a little more to catch up, and the motion desired then.
///
/// At a pace r the desired velocity is r x', and its acceleration r^2 x'' + r' x': the second term is `gain` at most,
/// and `boost` is what of it is fed forward. What an approach takes, and why, is said in realtime/clock.py.
template <std::size_t N, std::size_t M>
class ScheduleClock {
public:
    ScheduleClock(std::shared_ptr<const ScheduleTable<N, M>> table, double soft_start, Limit approach_speed,
                  Limit acceleration_limit, bool catches_up)
        : table_(std::move(table)),
          soft_start_(checked(soft_start, 0.0 <= soft_start && soft_start < infinity, "soft_start", "of at least 0")),
          approach_(checked<N, M>(approach_speed, "approach_speed")),
          approach_speed_(approach_[0]),
          catches_up_(catches_up) {
        double own = 0.0, fastest = 0.0, spin = 0.0;
        const std::size_t last = table_->last();
        // Velocity of the schedule at a row, also at the last one.
        const auto motion = [&](std::size_t i) {
            return i == last ? table_->velocity_at_end : table_->rows[i].velocity;
        };
        for (std::size_t i = 0; i <= last; ++i) {
            fastest = std::max(fastest, norm(motion(i)));
            if (i > 0)
                own = std::max(own, norm(motion(i) - motion(i - 1)) / (table_->time(i) - table_->time(i - 1)));
            if constexpr (M != N) spin = std::max(spin, linalg::norm(motion(i), blocks<N, M>[1]));
        }
        const double limit = least(acceleration_limit);
        if (spin * approach_speed_ > kShare * limit) approach_speed_ = kShare * limit / spin;
        // Acceleration of a soft start that comes up to speed; without one, a second is as long as its default.
        const double soft = std::max(fastest, approach_speed_) / (soft_start > 0.0 ? soft_start : 1.0);
        // One half of a limit is left for the schedule's own acceleration.
        gain_ = std::min(std::max(kShare * own, soft), 0.5 * limit);
        speed = kSpeed * fastest + approach_speed_;
        acceleration = std::max((1.0 + kShare) * own + gain_, kSharpest / kSteepest * soft);
        // What the schedule's own acceleration, with what the robot overshoots it by, leaves to an approach.
        room_ = std::max(gain_, acceleration - (1.0 + kShare) * own);
        const double room = own > 0.0 ? (acceleration - gain_) / (kOvershoot * own) : infinity;
        fastest_ = catches_up ? std::min(kSpeed, std::sqrt(room)) : 1.0;
        acceleration += approach_speed_ * spin;
        // Largest squares of the pace before the end, where it acts, and from when on.
        squared_limits_.assign(last + 1, 0.0);
        double left = 0.0;  // integral of dt / |x'| to the end; where the schedule rests it is long, not endless
        for (std::size_t i = last; i-- > 0;) {
            const double mean = std::max(0.5 * (norm(motion(i + 1)) + norm(motion(i))), 1e-9 * speed);
            left += (table_->time(i + 1) - table_->time(i)) / mean;
            squared_limits_[i] = 2.0 * gain_ * left;
        }
        const auto count = [this](double most) {
            const auto is_fast = [most](double square) { return square >= most; };
            return static_cast<std::size_t>(std::count_if(squared_limits_.begin(), squared_limits_.end(), is_fast));
        };
        tail_ = count(fastest_ * fastest_);
        // Where a schedule that ends while moving is slower if it may take one half of `gain` for that.
        const std::size_t fast = count(2.0);
        const bool ends_moving = norm(motion(last)) * table_->rate > gain_;
        slow_from_ = ends_moving ? table_->time(fast > 0 ? fast - 1 : last) : infinity;
    }

    /// Norm of velocities: their length, or of poses the larger one of that of positions and lever times rotations.
    double norm(const Vector<N>& twist) const {
        double most = 0.0;
        for (std::size_t b = 0; b < blocks<N, M>.size(); ++b)
            most = std::max(most, scale(b) * linalg::norm(twist, blocks<N, M>[b]));
        return most;
    }

    /// What speeds of a block count in this norm: what a soft start does not tell apart counts as equally fast.
    double scale(std::size_t block) const { return approach_[0] / approach_[block]; }

    /// Smaller one of the speeds or accelerations of positions and rotations, as the norm tells them.
    double least(Limit limit) const {
        double smallest = infinity;
        for (std::size_t b = 0; b < blocks<N, M>.size(); ++b) smallest = std::min(smallest, scale(b) * limit[b]);
        return smallest;
    }

    /// Starts at a time of the schedule, whose motion it tells, as fast as the robot's velocity is the desired one.
    ///
    /// No position or orientation is where the schedule is; `place` is then where the robot is. If the desired place
    /// begins elsewhere, it comes to the schedule's by minimum jerk, and turns about one axis.
    State<N, M> begin(double now, double at, const std::optional<Vector<n_positions<N, M>>>& position,
                      const std::optional<Quaternion>& orientation, const Vector<N>& velocity, Vector<M>& place) {
        at_ = at;
        origin_ = now - at;
        lag_ = ahead_ = 0.0;
        is_soft_ = false;
        boost.reset();
        spare_ = gain_;
        end_share_ = 1.0;
        double squared_limit;
        const State<N, M> row = desired(at, squared_limit);
        place = row.place;
        if (position) std::copy(position->begin(), position->end(), place.begin());
        if constexpr (M != N)
            if (orientation) places::set_tail(place, *orientation);
        distance_ = places::deviation<N>(row.place, place);
        place = places::moved(place, Vector<N>{});  // between two rows quaternions are shorter than 1
        const double way = norm(distance_);
        double room = room_;
        blend_ = time_of(way, room);
        // An approach that meets the slow end of its schedule leaves one half of `gain` to it.
        if (at + blend_ > slow_from_) {
            room -= 0.5 * gain_;
            end_share_ = 0.5;
            blend_ = time_of(way, room);
            squared_limit *= end_share_;
        }
        is_soft_ = distance_ != Vector<N>{} && soft_start_ > 0.0;
        // At a pace of 1 the approach leaves this much less than `gain` to changes of pace.
        if (is_soft_) taken_ = std::clamp(gain_ + kSharpest * way / blend_ / blend_ - room_, 0.0, gain_);
        // The pace at which the desired motion is nearest to that of the robot.
        double square = 0.0, along = 0.0;
        for (std::size_t b = 0; b < blocks<N, M>.size(); ++b) {
            for (std::size_t i = blocks<N, M>[b].begin; i < blocks<N, M>[b].end; ++i) {
                const double scaled = scale(b) * scale(b) * row.velocity[i];
                square += scaled * row.velocity[i];
                along += scaled * velocity[i];
            }
        }
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
        const State<N, M> row = desired(now - origin_, squared_limit);
        if (!is_soft_) return pace_ * norm(row.velocity);
        return norm(pace_ * row.velocity + free_ * slope_);
    }

    /// Motion that is desired in a tick, whose gains are those of the row `index`.
    State<N, M> row(double begin, double step) {
        if (is_steady_) {
            const double nearest = std::max(0.0, (begin - origin_) * table_->rate + 0.5);
            if (nearest < static_cast<double>(tail_)) {
                index = static_cast<std::size_t>(nearest);
                return table_->rows[index];
            }
            if (begin - origin_ >= table_->end) {
                index = table_->last();
                boost.reset();
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
        boost.reset();
        is_steady_ = false;
        // The spring pulls at the braked robot as hard as before, and a rise of the pace would add to it: the next tick
        // tells how much it may.
        spare_ = 0.0;
    }

    /// Lets the pace rise by what a tick's change of velocity leaves, where boost and an acceleration do not cause it.
    ///
    /// The acceleration is that of a push from outside: while it is not taken out, a robot that is shaken comes back to
    /// its schedule seconds later.
    void spare(const Vector<N>& pushed, const Vector<N>& before, const Vector<N>& after, double step) {
        spare_ = acceleration + norm(pushed) - norm(after - before - step * *boost) / step;
    }

    /// Lets so much time of the loop's clock pass without schedule time.
    void shift(double time) { origin_ += time; }

    double speed, acceleration;  ///< most that the desired motion takes
    std::size_t index = 0;
    std::optional<Vector<N>> boost;

private:
    State<N, M> ramped(double begin, double step) {
        const double time = begin - origin_, last_pace = pace_;
        double squared_limit;
        State<N, M> row = desired(time, squared_limit);
        const Vector<N> moving = row.velocity;
        double motion_speed = norm(moving), last_free = last_pace, gain = gain_;
        if (is_soft_) {
            last_free = free_;
            gain -= taken_ * last_free * last_free;
            // Where the schedule is slower than its approach, `gain` is for the changes of both.
            motion_speed = last_pace < last_free ? motion_speed + norm(slope_) : norm(moving + slope_);
        }
        const auto [faster, free] = freely(last_free, gain, motion_speed, step);
        const double pace = pace_ = std::min({last_pace + faster, free, std::sqrt(squared_limit)});
        // Where the pace is even nothing says what is spare, and the first tick of a rise finds out.
        boost.reset();
        if (pace != last_pace || (free != last_free && is_soft_))
            boost = ((pace - last_pace) / step) * moving;
        else
            spare_ = 0.0;
        row.velocity = pace * moving;
        if (is_soft_) {
            if (boost) boost = *boost + ((free - last_free) / step) * slope_;
            ahead_ += 0.5 * step * (free + last_free - pace - last_pace);
            row.velocity = row.velocity + free * slope_;
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
            boost.reset();
            is_steady_ = true;
        }
        return row;
    }

    /// Largest rise of the pace in a tick, and the pace after it where the end of the schedule does not limit it.
    std::pair<double, double> freely(double pace, double gain, double motion_speed, double step) const {
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
    State<N, M> desired(double time, double& squared_limit) {
        State<N, M> row;
        if (time >= table_->end) {
            index = table_->last();
            row = table_->rows[index];
            squared_limit = infinity;
        } else {
            index = std::min(static_cast<std::size_t>(std::max(0.0, time * table_->rate + kOnRow)), table_->last() - 1);
            const double start = static_cast<double>(index) / table_->rate, stop = table_->time(index + 1);
            const double share = time < stop ? (time - start) / (stop - start) : 1.0;
            row = table_->rows[index];
            const State<N, M>& after = table_->rows[index + 1];
            // Of quaternions that are so near, lengths and angles change evenly enough, and lengths do not matter.
            row.place = row.place + share * (after.place - row.place);
            row.velocity = row.velocity + share * (after.velocity - row.velocity);
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
            const Vector<N> away = -left * distance_;
            row.place = places::moved(row.place, away);
            if constexpr (M != N)
                places::set_tail(row.velocity,
                                 rotations::rotated(places::part<3>(row.velocity), places::part<3>(away)));
            slope_ = slope * distance_;
            squared_limit *= end_share_;
        }
        return row;
    }

    /// Time of an approach within its largest speed and this acceleration.
    double time_of(double way, double room) const {
        return std::max({soft_start_, kSteepest * way / approach_speed_, std::sqrt(kSharpest * way / room)});
    }

    // The reasons for these are beside those of realtime/clock.py.
    static constexpr double kSpeed = 1.5, kShare = 0.25, kLeastSpare = 0.1, kOnRow = 1e-6;
    static constexpr double kOvershoot = 1.1353352832366128;  // 1 + e^-2
    static constexpr double kSteepest = 1.875, kSharpest = 5.7735;

    std::shared_ptr<const ScheduleTable<N, M>> table_;
    double soft_start_;
    Limit approach_;
    double approach_speed_;  ///< in the norm
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

/// The schedule in rows of equal time, ready for a tick.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <stdexcept>
#include <string>
#include <vector>

#include "limits.hpp"
#include "linalg.hpp"
#include "schedule.hpp"
#include "steps.hpp"

namespace torch_pbd {

/// A schedule in rows `1 / rate` apart, the last one at `end` s, with no velocity.
///
/// Between its own rows the schedule is what `Schedule.resample` of Python says: gains on straight lines, positions on
/// the cubic through positions and velocities, and velocities its derivative.
template <std::size_t N>
class ScheduleTable {
public:
    ScheduleTable(const Schedule& schedule, double mass, double ticks_per_second)
        : rate(ticks_per_second), mass_(mass) {
        if (schedule.n_outputs != N)
            throw std::invalid_argument("the schedule has " + std::to_string(schedule.n_outputs) +
                                        " outputs, must have " + std::to_string(N) + ".");
        if (!schedule.orientation.empty() || !schedule.inertia.empty())
            throw std::invalid_argument("the schedule has orientations or a mass matrix, of which this loop has none.");
        end = schedule.time.back() - schedule.time.front();
        fill(schedule, grid());
        is_shared_ = share_axes();
        if (!is_shared_) modes_.clear();
    }

    /// Moves a state on by `step` s with the gains of a row; returns the scale of its stiffness.
    double advance(std::size_t row, const State<N>& desired, const Vector<N>& push, State<N>& state, double step,
                   double pull_limit) const {
        if (is_shared_) return torch_pbd::advance(modes_[row], desired, push, state, step, pull_limit);
        const Matrix<N> k = linalg::scaled(1.0 / mass_, stiffness[row]), d = linalg::scaled(1.0 / mass_, damping[row]);
        return advance_coupled(k, d, tops_[row], desired, push, state, step, pull_limit);
    }

    double rate, end;
    std::vector<State<N>> rows;
    std::vector<Matrix<N>> stiffness, damping;  ///< N/m and N s/m
    std::vector<double> speeds;  ///< of the desired motion, those before the last row was stopped
    double acceleration = 0.0;  ///< largest, of the same
    double least_damping = 0.0;  ///< smallest eigenvalue, in N s/m

    std::size_t last() const { return rows.size() - 1; }

    /// Time of a row, in s.
    double time(std::size_t row) const { return row == last() ? end : static_cast<double>(row) / rate; }

private:
    /// Times of the rows: every `1 / rate`, where 10 s at 1 kHz are 10001 rows, however 10 * 1000 is rounded.
    std::vector<double> grid() const {
        constexpr double rounding = 1e-3, most = 4e6;  // of a tick; rows: an hour at 1 kHz
        const double ticks = end * rate, counted = std::max(1.0, std::ceil(ticks - rounding));
        checked(rate, counted + 1.0 <= most, "rate", "low enough for a table of 4,000,000 rows");
        // A schedule shorter than a tick of the loop is begun and ended.
        std::vector<double> times(static_cast<std::size_t>(counted) + 1, end);
        for (std::size_t i = 0; i + 1 < times.size(); ++i) times[i] = static_cast<double>(i) / rate;
        return times;
    }

    void fill(const Schedule& schedule, const std::vector<double>& times) {
        rows.resize(times.size());
        stiffness.resize(times.size());
        damping.resize(times.size());
        speeds.resize(times.size());
        const std::vector<double>& knots = schedule.time;
        std::size_t knot = 0;
        for (std::size_t i = 0; i < times.size(); ++i) {
            while (knot + 2 < knots.size() && knots[knot + 1] - knots[0] <= times[i]) ++knot;
            const double h = (knots[knot + 1] - knots[0]) - (knots[knot] - knots[0]);
            const double s = (times[i] - (knots[knot] - knots[0])) / h;
            for (std::size_t a = 0; a < N; ++a) {
                hermite(&schedule.position[knot * N + a], &schedule.velocity[knot * N + a], s, h, rows[i], a);
                for (std::size_t b = 0; b < N; ++b) {
                    const std::size_t place = (knot * N + a) * N + b;
                    stiffness[i][a][b] = blend(schedule.stiffness[place], schedule.stiffness[place + N * N], s);
                    damping[i][a][b] = blend(schedule.damping[place], schedule.damping[place + N * N], s);
                }
            }
            speeds[i] = linalg::norm(rows[i].velocity);
            if (i > 0)
                acceleration = std::max(
                    acceleration, linalg::distance(rows[i].velocity, rows[i - 1].velocity) / (times[i] - times[i - 1]));
        }
        rows.back().velocity = {};
    }

    /// Straight line from start to end, exact at both and where they agree.
    static double blend(double start, double end, double share) {
        return share < 0.5 ? start + share * (end - start) : end - (1.0 - share) * (end - start);
    }

    /// Cubic between two rows of one output at a share s of the h s between them, and its derivative.
    static void hermite(const double* position, const double* velocity, double s, double h, State<N>& row,
                        std::size_t output) {
        const double x = position[0], next_x = position[N], v = velocity[0], next_v = velocity[N];
        const double bend = h * s * (1.0 - s) * ((1.0 - s) * v - s * next_v);
        row.position[output] = blend(x, next_x, s * s * (3.0 - 2.0 * s)) + bend;
        row.velocity[output] = blend(v, next_v, s) + 3.0 * s * (1.0 - s) * (2.0 * ((next_x - x) / h) - v - next_v);
    }

    /// Finds the axes that stiffness and damping share; false where they share none in some row.
    ///
    /// Axes of the sum are those of both, also where equal values of one leave its own undetermined. A weight other
    /// than 1 tells apart two axes of which one is as stiff as the other is damped.
    bool share_axes() {
        constexpr double rounding = 1e-9, tiny = std::numeric_limits<double>::min();
        modes_.resize(rows.size());
        bool is_shared = true;
        double least = infinity;
        for (std::size_t i = 0; i < rows.size(); ++i) {
            const Matrix<N> k = linalg::scaled(1.0 / mass_, stiffness[i]), d = linalg::scaled(1.0 / mass_, damping[i]);
            const double k_most = std::max(linalg::largest(k), tiny), d_most = std::max(linalg::largest(d), tiny);
            Matrix<N> both;
            for (std::size_t a = 0; a < N; ++a)
                for (std::size_t b = 0; b < N; ++b) both[a][b] = k[a][b] / k_most + 0.6 * d[a][b] / d_most;
            Modes<N>& modes = modes_[i];
            modes.axes = linalg::eigh(both).axes;
            for (std::size_t a = 0; a < N; ++a) {
                const Vector<N> force = linalg::product(k, modes.axes[a]), drag = linalg::product(d, modes.axes[a]);
                for (std::size_t b = 0; b < N; ++b) {
                    if (a == b) continue;
                    is_shared = is_shared && std::abs(linalg::dot(modes.axes[b], force)) <= rounding * k_most &&
                                std::abs(linalg::dot(modes.axes[b], drag)) <= rounding * d_most;
                }
                modes.stiffness[a] = std::max(linalg::dot(modes.axes[a], force), 0.0);
                modes.decay[a] = 0.5 * std::max(linalg::dot(modes.axes[a], drag), 0.0);
                least = std::min(least, 2.0 * modes.decay[a]);
            }
            modes.top = *std::max_element(modes.stiffness.begin(), modes.stiffness.end());
        }
        if (!is_shared) least = find_tops();
        least_damping = mass_ * least;
        return is_shared;
    }

    /// Largest stiffness of each row, per kg; returns the smallest damping.
    double find_tops() {
        double least = infinity;
        for (std::size_t i = 0; i < rows.size(); ++i) {
            const Vector<N> k = linalg::eigh(linalg::scaled(1.0 / mass_, stiffness[i])).values;
            const Vector<N> d = linalg::eigh(linalg::scaled(1.0 / mass_, damping[i])).values;
            tops_.push_back(*std::max_element(k.begin(), k.end()));
            least = std::min(least, *std::min_element(d.begin(), d.end()));
        }
        return least;
    }

    double mass_;
    bool is_shared_;
    std::vector<Modes<N>> modes_;
    std::vector<double> tops_;
};

}  // namespace torch_pbd

/// The schedule in rows of equal time, ready for a tick.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <limits>
#include <stdexcept>
#include <string>
#include <vector>

#include "limits.hpp"
#include "linalg.hpp"
#include "places.hpp"
#include "schedule.hpp"
#include "steps.hpp"

namespace torch_pbd {

/// A schedule in rows `1 / rate` apart, the last one at `end` s, with no velocity.
///
/// Between its own rows the schedule is what `Schedule.resample` of Python says: gains and masses on straight lines,
/// positions on the cubic through positions and velocities, orientations on that of the rotation vector from the row
/// before. Gains of the modes are per kg of a mass that is the same in all directions, `unit`.
template <std::size_t N, std::size_t M>
class ScheduleTable {
public:
    ScheduleTable(const Schedule& schedule, double mass, double ticks_per_second, Limit pull_limit)
        : rate(ticks_per_second), unit(mass), has_mass(!schedule.inertia.empty()) {
        if (schedule.n_outputs != N || schedule.n_positions != n_positions<N, M>)
            throw std::invalid_argument("the schedule has " + std::to_string(schedule.n_positions) + " positions of " +
                                        std::to_string(schedule.n_outputs) + " outputs, must have " +
                                        std::to_string(n_positions<N, M>) + " of " + std::to_string(N) + ".");
        end = schedule.time.back() - schedule.time.front();
        times_ = grid();
        rows.resize(times_.size());
        stiffness.resize(times_.size());
        damping.resize(times_.size());
        modes_.resize(times_.size());
        springs_.resize(times_.size());
        std::size_t knot = 0;
        for (std::size_t i = 0; i < times_.size(); ++i) {
            const std::vector<double>& knots = schedule.time;
            while (knot + 2 < knots.size() && knots[knot + 1] - knots[0] <= times_[i]) ++knot;
            fill(schedule, knot, i);
            if (!share_axes(schedule, knot, i)) is_shared_ = false;
            springs_[i] = {stiffest(i, 0, pull_limit), blocks<N, M>.size() > 1 ? stiffest(i, 1, pull_limit) : 0.0};
            const double limit = pull_limit.position;
            modes_[i].top = std::max(springs_[i].position, springs_[i].rotation) * (limit * limit / unit);
        }
        is_apart_ = are_apart();
        velocity_at_end = rows.back().velocity;
        rows.back().velocity = {};
    }

    /// Moves a state on by `step` s with the gains of a row; tells the scales of its springs.
    ///
    /// The angular velocity is integrated over the tick as that of a fixed axis would be, and turns the robot in world
    /// axes. The deviation is then told anew from where both are, so that the transport of it by the desired rotation,
    /// which turns e by w_d x e, comes out by itself.
    ///
    /// Where positions and rotations have springs apart, each has a potential, a limit and a scale of its own: twisted
    /// beyond its torque, a tool keeps its stiffness along the way. Where a limit acts, modes are no longer shared.
    Limit advance(std::size_t row, const State<N, M>& desired, const Vector<N>& push, State<N, M>& state, double step,
                  double pull_limit) const {
        const Vector<N> off = places::deviation<N>(state.place, desired.place);
        const Modes<N>& modes = modes_[row];
        Limit scale{1.0, 1.0};
        if (is_apart_)
            scale = {spring_scale(pull(row, off, 0), 1.0), spring_scale(pull(row, off, blocks<N, M>.size() - 1), 1.0)};
        const Drive<N> drive{push, off, desired.velocity, step, is_apart_ ? infinity : pull_limit};
        double whole;
        const Vector<N> move = is_shared_ && scale.position == 1.0 && scale.rotation == 1.0
                                   ? along_modes(modes, drive, state.velocity, whole)
                                   : coupled(modes, has_mass, linalg::scaled(1.0 / unit, scaled_stiffness(scale, row)),
                                             linalg::scaled(1.0 / unit, damping[row]), drive, state.velocity, whole);
        state.place = places::moved(state.place, move);
        return is_apart_ ? scale : Limit{whole, whole};
    }

    /// Stiffness of a row in N/m and Nm/rad, in a tick that scaled it.
    Matrix<N> scaled_stiffness(Limit scale, std::size_t row) const {
        Matrix<N> scaled = stiffness[row];
        for (std::size_t b = 0; b < blocks<N, M>.size(); ++b)
            for (std::size_t i = blocks<N, M>[b].begin; i < blocks<N, M>[b].end; ++i)
                scaled[i] = linalg::scaled(scale[b], scaled[i]);
        return scaled;
    }

    /// Push, as ticks take it, that causes an acceleration: a force, or that per kg.
    Vector<N> forced(const Vector<N>& acceleration, std::size_t row) const {
        if (!has_mass) return acceleration;
        return linalg::transposed_product(modes_[row].tells, linalg::product(modes_[row].tells, acceleration));
    }

    /// Acceleration that such a push causes.
    Vector<N> accelerated(const Vector<N>& push, std::size_t row) const {
        if (!has_mass) return push;
        return linalg::transposed_product(modes_[row].shapes, linalg::product(modes_[row].shapes, push));
    }

    /// Largest norm, over the rows, of each block of D^-1, times what acts on the blocks: velocities of positions and
    /// rotations under steady forces and torques where damping alone acts. Infinite where it is singular.
    Limit mobility(Limit force) const {
        constexpr double singular = 1e-12;  // relative to the largest entry, units of lengths and angles apart
        Matrix<2> most{};
        for (const Matrix<N>& gain : damping) {
            const auto [values, axes] = linalg::eigh(gain);
            const double scale = linalg::largest(gain), least = *std::min_element(values.begin(), values.end());
            if (!(least > singular * scale)) return {infinity, infinity};
            Matrix<N> inverse{};
            for (std::size_t i = 0; i < N; ++i)
                for (std::size_t j = 0; j < N; ++j)
                    for (std::size_t k = 0; k < N; ++k) inverse[j][k] += axes[i][j] * axes[i][k] / values[i];
            for (std::size_t b = 0; b < blocks<N, M>.size(); ++b)
                for (std::size_t c = 0; c < blocks<N, M>.size(); ++c)
                    most[b][c] = std::max(most[b][c], spectral_norm(inverse, blocks<N, M>[b], blocks<N, M>[c]));
        }
        const Vector<2> reached = linalg::product(most, Vector<2>{force.position, force.rotation});
        return {reached[0], reached[1]};
    }

    std::size_t last() const { return rows.size() - 1; }
    double time(std::size_t row) const { return times_[row]; }  ///< in s

    double rate, unit, end;
    bool has_mass;  ///< that is a matrix
    std::vector<State<N, M>> rows;
    std::vector<Matrix<N>> stiffness, damping;  ///< N/m and N s/m
    Vector<N> velocity_at_end;  ///< before the last row was stopped

private:
    /// Times of the rows: every `1 / rate`, where 10 s at 1 kHz are 10001 rows, however 10 * 1000 is rounded.
    std::vector<double> grid() const {
        constexpr double rounding = 1e-3, most = 4e6;  // of a tick; rows: an hour at 1 kHz
        const double counted = std::max(1.0, std::ceil(end * rate - rounding));
        checked(rate, counted + 1.0 <= most, "rate", "low enough for a table of 4,000,000 rows");
        // A schedule shorter than a tick of the loop is begun and ended.
        std::vector<double> times(static_cast<std::size_t>(counted) + 1, end);
        for (std::size_t i = 0; i + 1 < times.size(); ++i) times[i] = static_cast<double>(i) / rate;
        return times;
    }

    /// Interval of the schedule from a knot on, and where a row is in it.
    struct Place {
        double share, step;
    };

    Place place(const Schedule& schedule, std::size_t knot, std::size_t row) const {
        const double first = schedule.time[0], start = schedule.time[knot] - first;
        const double step = (schedule.time[knot + 1] - first) - start;
        return {(times_[row] - start) / step, step};
    }

    void fill(const Schedule& schedule, std::size_t knot, std::size_t row) {
        const Place at = place(schedule, knot, row);
        constexpr std::size_t p = n_positions<N, M>;
        const double *position = &schedule.position[knot * p], *velocity = &schedule.velocity[knot * N];
        State<N, M>& state = rows[row];
        for (std::size_t i = 0; i < p; ++i)
            cubic(position[i], position[p + i], velocity[i], velocity[N + i], at, state.place[i], state.velocity[i]);
        if constexpr (M != N) {
            const double* q = &schedule.orientation[knot * 4];
            turn({q[0], q[1], q[2], q[3]}, {q[4], q[5], q[6], q[7]}, velocity, at, state);
        }
        stiffness[row] = blended(schedule.stiffness, knot, at.share);
        damping[row] = blended(schedule.damping, knot, at.share);
    }

    /// Cubic of the rotation vector y from the first row, R = R_row Exp(y).
    static void turn(const Quaternion& start, const Quaternion& end, const double* velocity, Place at,
                     State<N, M>& state) {
        using namespace rotations;
        const Vector<3> way = log(multiply(conjugate(start), end));
        const auto rate = [&](const double* twist) {
            return turned(conjugate(start), {twist[N - 3], twist[N - 2], twist[N - 1]});
        };
        const Vector<3> begins = rate(velocity), ends = left_jacobian_inverse(way, rate(velocity + N));
        Vector<3> vector, slope;
        for (std::size_t i = 0; i < 3; ++i) cubic(0.0, way[i], begins[i], ends[i], at, vector[i], slope[i]);
        places::set_tail(state.place, multiply(start, exp(vector)));
        places::set_tail(state.velocity, turned(start, left_jacobian(vector, slope)));
    }

    /// Cubic from the first to the last value with the rates at start and end, and its derivative.
    static void cubic(double first, double last, double start, double end, Place at, double& value, double& slope) {
        const auto [s, h] = at;
        const double bend = h * s * (1.0 - s) * ((1.0 - s) * start - s * end);
        value = blend(first, last, s * s * (3.0 - 2.0 * s)) + bend;
        slope = blend(start, end, s) + 3.0 * s * (1.0 - s) * (2.0 * (last - first) / h - start - end);
    }

    /// Straight line from start to end, exact at both and where they agree.
    static double blend(double start, double end, double share) {
        return share < 0.5 ? start + share * (end - start) : end - (1.0 - share) * (end - start);
    }

    static Matrix<N> blended(const std::vector<double>& matrices, std::size_t knot, double share) {
        const double *start = &matrices[knot * N * N], *end = start + N * N;
        Matrix<N> result;
        for (std::size_t i = 0; i < N; ++i)
            for (std::size_t j = 0; j < N; ++j) result[i][j] = blend(start[N * i + j], end[N * i + j], share);
        return result;
    }

    /// Finds the modes that stiffness and damping share; false where they share none.
    ///
    /// With M = L L' they are P = L'^-1 Q, P' M = Q' L', where Q are the axes of L^-1 K L'^-1 and L^-1 D L'^-1. Axes of
    /// the sum are those of both, also where equal values of one leave its own undetermined. A weight other than 1
    /// tells apart two axes of which one is as stiff as the other is damped.
    bool share_axes(const Schedule& schedule, std::size_t knot, std::size_t row) {
        constexpr double rounding = 1e-9, tiny = std::numeric_limits<double>::min();
        Modes<N>& modes = modes_[row];
        Matrix<N> k = linalg::scaled(1.0 / unit, stiffness[row]), d = linalg::scaled(1.0 / unit, damping[row]);
        if (has_mass) {
            const double share = place(schedule, knot, row).share;
            const Matrix<N> factor = linalg::cholesky(blended(schedule.inertia, knot, share));
            modes.tells = linalg::transposed(factor);
            modes.shapes = linalg::inverse_lower(factor);
            for (Matrix<N>* gain : {&k, &d})
                *gain = linalg::product(linalg::product(modes.shapes, *gain), linalg::transposed(modes.shapes));
        }
        const double k_most = std::max(linalg::largest(k), tiny), d_most = std::max(linalg::largest(d), tiny);
        Matrix<N> both;
        for (std::size_t a = 0; a < N; ++a)
            for (std::size_t b = 0; b < N; ++b)
                both[a][b] = 0.5 * ((k[a][b] + k[b][a]) / k_most + 0.6 * (d[a][b] + d[b][a]) / d_most);
        const Matrix<N> axes = linalg::eigh(both).axes;
        for (std::size_t a = 0; a < N; ++a) {
            const Vector<N> force = linalg::product(k, axes[a]), drag = linalg::product(d, axes[a]);
            for (std::size_t b = 0; b < N; ++b) {
                if (a != b && !(std::abs(linalg::dot(axes[b], force)) <= rounding * k_most &&
                                std::abs(linalg::dot(axes[b], drag)) <= rounding * d_most))
                    return false;
            }
            modes.stiffness[a] = std::max(linalg::dot(axes[a], force), 0.0);
            modes.decay[a] = 0.5 * std::max(linalg::dot(axes[a], drag), 0.0);
        }
        modes.tells = has_mass ? linalg::product(axes, modes.tells) : axes;
        modes.shapes = has_mass ? linalg::product(axes, modes.shapes) : axes;
        return true;
    }

    /// Largest stiffness of a block over its squared limit.
    ///
    /// |K e|^2 <= k_max e'K e in each block, with k_max that of the block, also where others are displaced, for
    /// |B'K e|^2 <= |B'K B| e'K e for any B.
    double stiffest(std::size_t row, std::size_t b, Limit pull_limit) const {
        return spectral_norm(stiffness[row], blocks<N, M>[b], blocks<N, M>[b]) / (pull_limit[b] * pull_limit[b]);
    }

    /// Square of the largest pull of the spring of a block, over that of its limit.
    double pull(std::size_t row, const Vector<N>& off, std::size_t b) const {
        const Block block = blocks<N, M>[b];
        double sum = 0.0;
        for (std::size_t i = block.begin; i < block.end; ++i)
            for (std::size_t j = block.begin; j < block.end; ++j) sum += off[i] * stiffness[row][i][j] * off[j];
        return springs_[row][b] * sum;
    }

    /// Whether no stiffness couples positions and rotations.
    bool are_apart() const {
        constexpr double rounding = 1e-9;
        if (M == N) return false;
        Matrix<N> most{};
        for (const Matrix<N>& gain : stiffness)
            for (std::size_t i = 0; i < N; ++i)
                for (std::size_t j = 0; j < N; ++j) most[i][j] = std::max(most[i][j], std::abs(gain[i][j]));
        for (std::size_t i = 0; i < N - 3; ++i)
            for (std::size_t j = N - 3; j < N; ++j)
                if (!(most[i][j] <= rounding * std::sqrt(most[i][i]) * std::sqrt(most[j][j]))) return false;
        return true;
    }

    /// Largest singular value of a block of a matrix.
    static double spectral_norm(const Matrix<N>& matrix, Block rows_of, Block columns) {
        Matrix<N> square{};
        for (std::size_t i = columns.begin; i < columns.end; ++i)
            for (std::size_t j = columns.begin; j < columns.end; ++j)
                for (std::size_t k = rows_of.begin; k < rows_of.end; ++k) square[i][j] += matrix[k][i] * matrix[k][j];
        const Vector<N> values = linalg::eigh(square).values;
        return std::sqrt(*std::max_element(values.begin(), values.end()));
    }

    bool is_shared_ = true, is_apart_ = false;
    std::vector<double> times_;
    std::vector<Limit> springs_;  ///< largest stiffness over squared limit
    std::vector<Modes<N>> modes_;
};

}  // namespace torch_pbd

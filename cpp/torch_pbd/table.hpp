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
#include "schedule.hpp"
#include "steps.hpp"

namespace torch_pbd {

/// A schedule in rows `1 / rate` apart, the last one at `end` s, with no velocity.
///
/// Between its own rows the schedule is what `Schedule.resample` of Python says: gains and masses on straight lines,
/// positions on the cubic through positions and velocities, orientations on that of the rotation vector from the row
/// before. The mass is the inertia of the schedule, or one mass in all directions.
template <std::size_t N, std::size_t M>
class ScheduleTable {
public:
    ScheduleTable(const Schedule& schedule, double mass, double ticks_per_second, Limit pull_limit)
        : rate(ticks_per_second), one_mass_(schedule.inertia.empty() ? mass : 0.0) {
        if (schedule.n_outputs != N || schedule.n_positions != n_positions<N, M>)
            throw std::invalid_argument("the schedule has " + std::to_string(schedule.n_positions) + " positions of " +
                                        std::to_string(schedule.n_outputs) + " outputs, must have " +
                                        std::to_string(n_positions<N, M>) + " of " + std::to_string(N) + ".");
        const auto units = schedule.labels.find("units");
        for (const char* other : {"\"km\"", "\"dm\"", "\"cm\"", "\"mm\"", "\"um\"", "\"deg\""})
            if (units != schedule.labels.end() && units->second == other)
                throw std::invalid_argument("units of schedule is " + units->second + ", must be m or rad.");
        const std::vector<double>& knots = schedule.time;
        end = knots.back() - knots.front();
        constexpr double rounding = 1e-3, most = 4e6;  // of a tick; rows: an hour at 1 kHz
        // A schedule shorter than a tick of the loop is begun and ended; 10 s at 1 kHz are 10001 rows, however
        // 10 * 1000 is rounded.
        const double n_ticks = std::max(1.0, std::ceil(end * rate - rounding));
        checked(rate, n_ticks + 1.0 <= most, "rate", "low enough for a table of 4,000,000 rows");
        const std::size_t n = static_cast<std::size_t>(n_ticks) + 1;
        rows.resize(n);
        stiffness.resize(n);
        damping.resize(n);
        modes_.resize(n);
        springs_.resize(n);
        std::size_t knot = 0;
        for (std::size_t row = 0; row < n; ++row) {
            const double now = time(row);
            while (knot + 2 < knots.size() && knots[knot + 1] - knots[0] <= now) ++knot;
            const double start = knots[knot] - knots[0], step = (knots[knot + 1] - knots[0]) - start;
            const Place at{knot, (now - start) / step, step};
            set_motion(schedule, at, rows[row]);
            stiffness[row] = blended(schedule.stiffness, at);
            damping[row] = blended(schedule.damping, at);
            Matrix<N> inertia{};
            for (std::size_t i = 0; i < N; ++i) inertia[i][i] = mass;
            if (!schedule.inertia.empty()) inertia = blended(schedule.inertia, at);
            if (!share_modes(inertia, row)) is_shared_ = false;
            // |K e|^2 <= k_max e'K e in each block, with k_max that of the block, also where others are displaced, for
            // |B'K e|^2 <= |B'K B| e'K e for any B.
            for (std::size_t b = 0; b < kBlocks.size(); ++b) {
                const double stiffest = spectral_norm(stiffness[row], kBlocks[b], kBlocks[b]);
                springs_[row][b] = stiffest / (pull_limit[b] * pull_limit[b]);
            }
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
    Limit advance(std::size_t row, const State<N, M>& desired, const Vector<N>& push, State<N, M>& state,
                  double step) const {
        const Drive<N> drive{push, places::deviation<N>(state.place, desired.place), desired.velocity, step};
        const Limit scale = scales(row, drive.off);
        // Where one of two springs is limited, modes are no longer shared.
        const Vector<N> move =
            is_shared_ && scale[0] == scale[kBlocks.size() - 1]
                ? along_modes(modes_[row], scale[0], drive, state.velocity)
                : coupled(modes_[row], scaled_stiffness(scale, row), damping[row], drive, state.velocity);
        state.place = places::moved(state.place, move);
        return scale;
    }

    /// Stiffness of a row in N/m and Nm/rad, in a tick that scaled it.
    Matrix<N> scaled_stiffness(Limit scale, std::size_t row) const {
        Matrix<N> scaled = stiffness[row];
        for (std::size_t b = 0; b < kBlocks.size(); ++b)
            for (std::size_t i = kBlocks[b].begin; i < kBlocks[b].end; ++i) scaled[i] = scale[b] * scaled[i];
        return scaled;
    }

    /// Force that causes an acceleration.
    Vector<N> forced(const Vector<N>& acceleration, std::size_t row) const {
        if (one_mass_ > 0.0) return one_mass_ * acceleration;
        return linalg::product(linalg::squared(modes_[row].tells), acceleration);
    }

    /// Acceleration that a force causes.
    Vector<N> accelerated(const Vector<N>& force, std::size_t row) const {
        if (one_mass_ > 0.0) return (1.0 / one_mass_) * force;
        return linalg::product(linalg::squared(modes_[row].shapes), force);
    }

    /// Largest norm, over the rows, of each block of D^-1, times what acts on the blocks: velocities of positions and
    /// rotations under steady forces and torques where damping alone acts. Infinite where it is singular.
    Limit mobility(Limit force) const {
        constexpr double singular = 1e-12;  // relative to the largest entry, units of lengths and angles apart
        Matrix<2> most{};
        for (const Matrix<N>& gain : damping) {
            const auto [values, axes] = linalg::eigh(gain);
            if (!(*std::min_element(values.begin(), values.end()) > singular * linalg::largest(gain)))
                return {infinity, infinity};
            Matrix<N> inverse{};
            for (std::size_t i = 0; i < N; ++i)
                for (std::size_t j = 0; j < N; ++j) inverse[j] = inverse[j] + (axes[i][j] / values[i]) * axes[i];
            for (std::size_t b = 0; b < kBlocks.size(); ++b)
                for (std::size_t c = 0; c < kBlocks.size(); ++c)
                    most[b][c] = std::max(most[b][c], spectral_norm(inverse, kBlocks[b], kBlocks[c]));
        }
        const Vector<2> reached = linalg::product(most, Vector<2>{force[0], force[1]});
        return {reached[0], reached[1]};
    }

    std::size_t last() const { return rows.size() - 1; }
    double time(std::size_t row) const { return row == last() ? end : static_cast<double>(row) / rate; }  ///< in s

    double rate, end;
    std::vector<State<N, M>> rows;
    std::vector<Matrix<N>> stiffness, damping;  ///< N/m and N s/m
    Vector<N> velocity_at_end;  ///< before the last row was stopped

private:
    static constexpr auto kBlocks = blocks<N, M>;

    /// Place between the rows of the schedule: the row before, the share of the interval, and its length in s.
    struct Place {
        std::size_t knot;
        double share, step;
    };

    static void set_motion(const Schedule& schedule, Place at, State<N, M>& state) {
        using namespace rotations;
        constexpr std::size_t p = n_positions<N, M>;
        const double *position = &schedule.position[at.knot * p], *velocity = &schedule.velocity[at.knot * N];
        for (std::size_t i = 0; i < p; ++i)
            cubic(position[i], position[p + i], velocity[i], velocity[N + i], at, state.place[i], state.velocity[i]);
        if constexpr (M != N) {
            // Cubic of the rotation vector y from the first row, R = R_row Exp(y).
            const double* q = &schedule.orientation[at.knot * 4];
            const Quaternion start{q[0], q[1], q[2], q[3]}, end{q[4], q[5], q[6], q[7]};
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
    }

    /// Cubic from the first to the last value with the rates at start and end, and its derivative.
    static void cubic(double first, double last, double start, double end, Place at, double& value, double& slope) {
        const double s = at.share, h = at.step;
        const double bend = h * s * (1.0 - s) * ((1.0 - s) * start - s * end);
        value = blend(first, last, s * s * (3.0 - 2.0 * s)) + bend;
        slope = blend(start, end, s) + 3.0 * s * (1.0 - s) * (2.0 * (last - first) / h - start - end);
    }

    /// Straight line from start to end, exact at both and where they agree.
    static double blend(double start, double end, double share) {
        return share < 0.5 ? start + share * (end - start) : end - (1.0 - share) * (end - start);
    }

    static Matrix<N> blended(const std::vector<double>& matrices, Place at) {
        const double *start = &matrices[at.knot * N * N], *end = start + N * N;
        Matrix<N> result;
        for (std::size_t i = 0; i < N; ++i)
            for (std::size_t j = 0; j < N; ++j) result[i][j] = blend(start[N * i + j], end[N * i + j], at.share);
        return result;
    }

    /// Finds the modes that stiffness and damping share; false where they share none.
    ///
    /// With M = L L', by the axes of M, they are P = L'^-1 Q, P' M = Q' L', where Q are the axes of L^-1 K L'^-1 and of
    /// L^-1 D L'^-1. Axes of the sum are those of both, also where equal values of one leave its own undetermined. A
    /// weight other than 1 tells apart two axes of which one is as stiff as the other is damped.
    bool share_modes(const Matrix<N>& mass, std::size_t row) {
        constexpr double rounding = 1e-9, tiny = std::numeric_limits<double>::min();
        using linalg::product;
        Modes<N>& modes = modes_[row];
        const auto [masses, main] = linalg::eigh(mass);
        for (std::size_t i = 0; i < N; ++i) {
            modes.tells[i] = std::sqrt(masses[i]) * main[i];
            modes.shapes[i] = (1.0 / std::sqrt(masses[i])) * main[i];
        }
        const auto per_mass = [&](const Matrix<N>& gain) {
            if (one_mass_ > 0.0) return (1.0 / one_mass_) * gain;
            const Matrix<N> scaled = product(product(modes.shapes, gain), linalg::transposed(modes.shapes));
            return 0.5 * (scaled + linalg::transposed(scaled));
        };
        const Matrix<N> k = per_mass(stiffness[row]), d = per_mass(damping[row]);
        const double k_most = std::max(linalg::largest(k), tiny), d_most = std::max(linalg::largest(d), tiny);
        const Matrix<N> axes = linalg::eigh((1.0 / k_most) * k + (0.6 / d_most) * d).axes;
        for (std::size_t a = 0; a < N; ++a) {
            const Vector<N> force = product(k, axes[a]), drag = product(d, axes[a]);
            for (std::size_t b = 0; b < N; ++b) {
                if (a != b && !(std::abs(linalg::dot(axes[b], force)) <= rounding * k_most &&
                                std::abs(linalg::dot(axes[b], drag)) <= rounding * d_most))
                    return false;
            }
            modes.stiffness[a] = std::max(linalg::dot(axes[a], force), 0.0);
            modes.decay[a] = 0.5 * std::max(linalg::dot(axes[a], drag), 0.0);
        }
        modes.tells = product(axes, modes.tells);
        modes.shapes = product(axes, modes.shapes);
        return true;
    }

    /// Scales of the springs at a deviation: of positions and rotations each its own where nothing couples them.
    ///
    /// Each has a potential and a limit then: twisted beyond its torque, a tool keeps its stiffness along the way.
    Limit scales(std::size_t row, const Vector<N>& off) const {
        const auto scale = [](double pull) { return pull > 1.0 ? 1.0 / std::sqrt(pull) : 1.0; };
        const auto [top, other] = springs_[row];
        if (is_apart_)
            return {scale(top * pull(row, off, kBlocks.front())), scale(other * pull(row, off, kBlocks.back()))};
        double stretch = 0.0;  // e'K e, which modes tell to more digits
        const Vector<N> y = linalg::product(modes_[row].tells, off);
        for (std::size_t i = 0; i < N; ++i) stretch += modes_[row].stiffness[i] * y[i] * y[i];
        const double whole = scale(std::max(top, other) * (is_shared_ ? stretch : pull(row, off, {0, N})));
        return {whole, whole};
    }

    /// e'K e of a block.
    double pull(std::size_t row, const Vector<N>& off, Block block) const {
        double sum = 0.0;
        for (std::size_t i = block.begin; i < block.end; ++i) {
            double force = 0.0;
            for (std::size_t j = block.begin; j < block.end; ++j) force += stiffness[row][i][j] * off[j];
            sum += off[i] * force;
        }
        return sum;
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

    double one_mass_;  ///< in all directions, in kg; 0 where the schedule has an inertia
    bool is_shared_ = true, is_apart_ = false;
    std::vector<Limit> springs_;  ///< largest stiffness over squared limit
    std::vector<Modes<N>> modes_;
};

}  // namespace torch_pbd

/// Places and moves, and one tick of the admittance, solved exactly; realtime/steps.py, which derives it, and what of
/// rotations.py a table needs.
///
/// A place is a position, of as many numbers as there are axes, or a pose: a position, and a unit quaternion w x y z.
/// Moves, velocities and forces have N components: of poses those of positions first, then three of a rotation in
/// world axes.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <utility>

#include "linalg.hpp"

namespace torch_pbd {

using linalg::Block;

/// Components that share a unit: positions, and the rotation of a pose, whose place has one number more.
template <std::size_t N, std::size_t M>
inline constexpr std::array<Block, M == N ? 1 : 2> blocks = [] {
    if constexpr (M == N)
        return std::array<Block, 1>{{{0, N}}};
    else
        return std::array<Block, 2>{{{0, N - 3}, {N - 3, N}}};
}();

/// Number of positions of a place.
template <std::size_t N, std::size_t M>
inline constexpr std::size_t n_positions = M == N ? N : N - 3;

using Quaternion = Vector<4>;

namespace rotations {

inline Vector<3> cross(const Vector<3>& a, const Vector<3>& b) {
    return {a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]};
}

inline Quaternion conjugate(const Quaternion& q) { return {q[0], -q[1], -q[2], -q[3]}; }

/// Rotation by `b`, then by `a`.
inline Quaternion multiply(const Quaternion& a, const Quaternion& b) {
    return {
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3], a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1], a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0]};
}

/// Quaternion of a rotation vector.
inline Quaternion exp(const Vector<3>& vector) {
    const double angle = linalg::norm(vector), share = angle > 0.0 ? std::sin(0.5 * angle) / angle : 0.0;
    return {std::cos(0.5 * angle), share * vector[0], share * vector[1], share * vector[2]};
}

/// Rotation vector of a quaternion of any length and sign, the shorter way: pi long at most.
inline Vector<3> log(const Quaternion& q) {
    const Vector<3> axis{q[1], q[2], q[3]};
    const double sine = linalg::norm(axis);
    if (sine == 0.0) return {};
    return std::copysign(2.0 * std::atan2(sine, std::abs(q[0])) / sine, q[0]) * axis;
}

/// x + b v x x + c v x (v x x).
inline Vector<3> mixed(const Vector<3>& v, const Vector<3>& x, double b, double c) {
    const Vector<3> once = cross(v, x);
    return x + b * once + c * cross(v, once);
}

/// Vector turned by a unit quaternion.
inline Vector<3> turned(const Quaternion& q, const Vector<3>& x) {
    return mixed({q[1], q[2], q[3]}, x, 2.0 * q[0], 2.0);
}

/// (1 - cos t) / t^2, without its cancellation.
inline double flatness(double angle) {
    const double share = angle > 0.0 ? std::sin(0.5 * angle) / angle : 0.5;
    return 2.0 * share * share;
}

/// Vector turned by a rotation vector; O. Rodrigues, 1840.
inline Vector<3> rotated(const Vector<3>& x, const Vector<3>& rotation) {
    const double angle = linalg::norm(rotation);
    return mixed(rotation, x, angle > 0.0 ? std::sin(angle) / angle : 1.0, flatness(angle));
}

/// Angular velocity in world axes of a rotation vector v that changes at a rate.
inline Vector<3> left_jacobian(const Vector<3>& v, const Vector<3>& rate) {
    const double t = linalg::norm(v);
    return mixed(v, rate, flatness(t), t < 1e-4 ? 1.0 / 6.0 : (t - std::sin(t)) / (t * t * t));
}

/// Rate of a rotation vector v that turns at an angular velocity in world axes.
inline Vector<3> left_jacobian_inverse(const Vector<3>& v, const Vector<3>& turning) {
    const double t = linalg::norm(v);
    return mixed(v, turning, -0.5, t < 1e-4 ? 1.0 / 12.0 : (1.0 - 0.5 * t / std::tan(0.5 * t)) / (t * t));
}

}  // namespace rotations

namespace places {

using namespace rotations;

/// K components of a vector, the last ones if not from another on: the rotation of a twist, the quaternion of a place.
template <std::size_t K, std::size_t N>
Vector<K> part(const Vector<N>& vector, std::size_t begin = N - K) {
    Vector<K> result;
    std::copy_n(vector.begin() + begin, K, result.begin());
    return result;
}

template <std::size_t M, std::size_t K>
void set_tail(Vector<M>& vector, const Vector<K>& tail) {
    std::copy(tail.begin(), tail.end(), vector.end() - K);
}

/// Move that leads from a goal to a place: x - x_d, and the rotation vector Log(R R_d').
///
/// It takes the shorter way round, and is blind to the lengths and signs of quaternions.
template <std::size_t N, std::size_t M>
Vector<N> deviation(const Vector<M>& place, const Vector<M>& goal) {
    Vector<N> move;
    for (std::size_t i = 0; i < n_positions<N, M>; ++i) move[i] = place[i] - goal[i];
    if constexpr (M != N) {
        const Quaternion turned = part<4>(place), still = part<4>(goal);
        // Products of equal quaternions are not zero to the last bit.
        const bool is_equal = turned == still;
        set_tail(move, is_equal ? Vector<3>{} : log(multiply(turned, conjugate(still))));
    }
    return move;
}

/// Place that a move leads to: x + dx, and Exp(dr) R, a unit quaternion again.
template <std::size_t N, std::size_t M>
Vector<M> moved(Vector<M> place, const Vector<N>& move) {
    for (std::size_t i = 0; i < n_positions<N, M>; ++i) place[i] += move[i];
    if constexpr (M != N) {
        const Quaternion turned = multiply(exp(part<3>(move)), part<4>(place));
        set_tail(place, (1.0 / linalg::norm(turned)) * turned);
    }
    return place;
}

}  // namespace places

/// Place, of M numbers, and velocity.
template <std::size_t N, std::size_t M>
struct State {
    Vector<M> place;
    Vector<N> velocity;
};

/// Impulse response of y'' + 2 a y' + k y = 0 (y = 0, y' = 1 at first) after a time, and its integral.
///
/// No exponential overflows, no difference of nearly equal numbers is left, near critical damping and k = 0 too.
inline std::pair<double, double> responses(double stiffness, double decay, double step) {
    constexpr double critical = 1e-7;  // of (w h)^2: below, two terms of a series in it have all digits
    constexpr double short_lag = 0.01;  // of a h: below, five terms have
    const double lag = decay * step, bend = stiffness * step * step - lag * lag;
    if (bend < -critical) {
        const double root = std::sqrt(-bend) / step, fast = decay + root, slow = stiffness / fast;
        const double lost_fast = -std::expm1(-fast * step), lost_slow = -std::expm1(-slow * step);
        const double reach = slow != 0.0 ? lost_slow / slow : step;
        return {0.5 * (lost_fast - lost_slow) / root, 0.5 * (reach - lost_fast / fast) / root};
    }
    const double lost = -std::expm1(-lag);
    if (bend > critical) {
        const double angle = std::sqrt(bend), half = std::sin(0.5 * angle);
        const double impulse = (1.0 - lost) * std::sin(angle) * step / angle;
        return {impulse, (lost - decay * impulse + 2.0 * (1.0 - lost) * (half * half)) / stiffness};
    }
    const double impulse = (1.0 - lost) * step * (1.0 - bend / 6.0);
    if (lag > short_lag) return {impulse, (lost - decay * impulse + 0.5 * bend * (1.0 - lost)) / stiffness};
    const double series = 0.5 - lag * (1.0 / 3.0 - lag * (1.0 / 8.0 - lag * (1.0 / 30.0 - lag / 144.0))) -
                          bend * (1.0 / 24.0 - lag / 30.0);
    return {impulse, step * step * series};
}

/// Modes that stiffness and damping share, and their gains.
///
/// Modes, the columns of P, are such that P' M P = 1, while P' K P and P' D P are diagonal. Where they share none, P is
/// the inverse of the transposed factor L of M = L L'.
template <std::size_t N>
struct Modes {
    Vector<N> stiffness, decay;  ///< of each mode, and half its damping
    Matrix<N> tells, shapes;  ///< rows of P' M, which tell y from e = P y, and those of P'
};

/// What moves a robot in a tick: forces, and what the spring's ends are.
template <std::size_t N>
struct Drive {
    Vector<N> push, off, desired_velocity;  ///< external force, e = x - x_d, v_d
    double step;
};

/// Move in a tick, each mode by itself, with a stiffness scaled; changes the velocity.
///
/// With f of a mode that of P' f, each y follows y'' + 2 a y' + k y = f + 2 a v_d. With the responses S and B of
/// `responses` and q = f + 2 a v_d - k y, y grows by S v + B q and v by S q - (2 a S + k B) v: increments, which keep
/// their digits in short ticks.
template <std::size_t N>
Vector<N> along_modes(const Modes<N>& modes, double scale, const Drive<N>& drive, Vector<N>& velocity) {
    using linalg::dot;
    const Vector<N> before = velocity;
    Vector<N> move{};
    for (std::size_t i = 0; i < N; ++i) {
        const Vector<N>&tell = modes.tells[i], &shape = modes.shapes[i];
        const double k = scale * modes.stiffness[i], a = modes.decay[i], v = dot(tell, before);
        const auto [s, b] = responses(k, a, drive.step);
        const double f = dot(shape, drive.push) + 2.0 * a * dot(tell, drive.desired_velocity);
        const double q = f - k * dot(tell, drive.off);
        const double dy = s * v + b * q, dv = s * q - (2.0 * a * s + k * b) * v;
        for (std::size_t j = 0; j < N; ++j) {
            move[j] += dy * shape[j];
            velocity[j] += dv * shape[j];
        }
    }
    return move;
}

/// As `along_modes` for matrices that share none: exp(X) - 1 of the whole system, time in ticks.
template <std::size_t N>
Vector<N> coupled(const Modes<N>& modes, const Matrix<N>& stiffness, const Matrix<N>& damping, const Drive<N>& drive,
                  Vector<N>& velocity) {
    using linalg::product;
    const double step = drive.step;
    const Matrix<N> inverse = linalg::squared(modes.shapes);  // of the mass
    const Matrix<N> k = product(inverse, stiffness), d = product(inverse, damping);
    const Vector<N> f = product(inverse, drive.push + product(damping, drive.desired_velocity));
    Matrix<2 * N + 1> rate{};
    Vector<2 * N + 1> start{};
    start[2 * N] = 1.0;
    for (std::size_t i = 0; i < N; ++i) {
        rate[i][N + i] = 1.0;
        for (std::size_t j = 0; j < N; ++j) {
            rate[N + i][j] = -step * step * k[i][j];
            rate[N + i][N + j] = -step * d[i][j];
        }
        rate[N + i][2 * N] = step * step * f[i];
        start[i] = drive.off[i];
        start[N + i] = step * velocity[i];
    }
    const Vector<2 * N + 1> change = product(linalg::expm1(rate), start);
    Vector<N> move;
    for (std::size_t i = 0; i < N; ++i) {
        move[i] = change[i];
        velocity[i] += change[N + i] / step;
    }
    return move;
}

}  // namespace torch_pbd

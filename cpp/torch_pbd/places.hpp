/// Positions and poses: differences and moves; realtime/places.py, and what of rotations.py a table needs.
///
/// A place is a position, of as many numbers as there are axes, or a pose: a position, and a unit quaternion w x y z.
/// Moves, velocities and forces have N components: of poses those of positions first, then three of a rotation in
/// world axes.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>

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

template <std::size_t N>
Vector<3> rotation_of(const Vector<N>& twist) {
    return {twist[N - 3], twist[N - 2], twist[N - 1]};
}

template <std::size_t M>
Quaternion orientation_of(const Vector<M>& place) {
    return {place[M - 4], place[M - 3], place[M - 2], place[M - 1]};
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
        const Quaternion turned = orientation_of(place), still = orientation_of(goal);
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
        const Quaternion turned = multiply(exp(rotation_of(move)), orientation_of(place));
        set_tail(place, (1.0 / linalg::norm(turned)) * turned);
    }
    return place;
}

}  // namespace places
}  // namespace torch_pbd

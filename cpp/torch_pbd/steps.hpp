/// One tick of the admittance, solved exactly; the comments that derive it are those of realtime/steps.py.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>

#include "linalg.hpp"
#include "places.hpp"

namespace torch_pbd {

/// Place, of M numbers, and velocity.
template <std::size_t N, std::size_t M>
struct State {
    Vector<M> place;
    Vector<N> velocity;
};

/// Impulse response of y'' + 2 a y' + k y = 0 (y = 0, y' = 1 at first) after a time, and its integral.
struct Responses {
    double impulse, integral;
};

/// No exponential overflows, no difference of nearly equal numbers is left, near critical damping and k = 0 too.
inline Responses responses(double stiffness, double decay, double step) {
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
    const double step = drive.step;
    const Matrix<N> k = linalg::transposed(stiffness), d = linalg::transposed(damping);
    Matrix<2 * N + 1> rate{};
    const auto set_column = [&](std::size_t column, double factor, const Vector<N>& force) {
        const Vector<N> acceleration = linalg::transposed_product(modes.shapes, linalg::product(modes.shapes, force));
        for (std::size_t i = 0; i < N; ++i) rate[N + i][column] = factor * acceleration[i];
    };
    Vector<2 * N + 1> start{};
    start[2 * N] = 1.0;
    for (std::size_t i = 0; i < N; ++i) {
        rate[i][N + i] = 1.0;
        set_column(i, -step * step, k[i]);
        set_column(N + i, -step, d[i]);
        start[i] = drive.off[i];
        start[N + i] = step * velocity[i];
    }
    set_column(2 * N, step * step, drive.push + linalg::product(damping, drive.desired_velocity));
    const Vector<2 * N + 1> change = linalg::product(linalg::expm1(rate), start);
    Vector<N> move;
    for (std::size_t i = 0; i < N; ++i) {
        move[i] = change[i];
        velocity[i] += change[N + i] / step;
    }
    return move;
}

/// State after braking for `step` s, all axes alike, from a speed, or until standing still.
template <std::size_t N, std::size_t M>
State<N, M> braked(const State<N, M>& state, double speed, double deceleration, double step) {
    const double braking = std::min(step, speed / deceleration);
    const double left = braking == step ? 1.0 - deceleration * step / speed : 0.0;
    const Vector<N> slower = left * state.velocity;
    return {places::moved<N>(state.place, 0.5 * braking * (state.velocity + slower)), slower};
}

}  // namespace torch_pbd

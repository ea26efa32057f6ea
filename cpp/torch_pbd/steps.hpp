/// One tick of the admittance, solved exactly; the comments that derive it are those of realtime/steps.py.
#pragma once

#include <cmath>
#include <cstddef>

#include "linalg.hpp"

namespace torch_pbd {

template <std::size_t N>
struct State {
    Vector<N> position, velocity;
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

/// Stiffness of each axis per kg, half its damping per kg, and the axes, which both share.
template <std::size_t N>
struct Modes {
    double top;  ///< largest stiffness
    Vector<N> stiffness, decay;
    Matrix<N> axes;
};

/// Scale of the stiffness at which the spring pulls at `limit` most, from the largest pull that e'K e allows.
inline double spring_scale(double pull, double limit) { return pull > limit * limit ? limit / std::sqrt(pull) : 1.0; }

/// Moves the state on by `step` s, each axis by itself; returns the scale of the stiffness.
///
/// Along an axis, y = x - x_d follows y'' + 2 a y' + k y = f + 2 a v_d, all per kg. With the responses S and P of
/// `responses` and q = f + 2 a v_d - k y, y grows by S v + P q and v by S q - (2 a S + k P) v: increments, which keep
/// their digits in short ticks.
template <std::size_t N>
double advance(const Modes<N>& modes, const State<N>& desired, const Vector<N>& push, State<N>& state, double step,
               double pull_limit) {
    using linalg::dot;
    const Vector<N> off = linalg::product(modes.axes, linalg::difference(state.position, desired.position));
    double pull = 0.0;
    for (std::size_t i = 0; i < N; ++i) pull += modes.stiffness[i] * off[i] * off[i];
    const double scale = spring_scale(modes.top * pull, pull_limit);
    const State<N> before = state;
    for (std::size_t i = 0; i < N; ++i) {
        const Vector<N>& axis = modes.axes[i];
        const double k = scale * modes.stiffness[i], a = modes.decay[i], v = dot(axis, before.velocity);
        const auto [s, p] = responses(k, a, step);
        const double q = dot(axis, push) + 2.0 * a * dot(axis, desired.velocity) - k * off[i];
        const double dx = s * v + p * q, dv = s * q - (2.0 * a * s + k * p) * v;
        for (std::size_t j = 0; j < N; ++j) {
            state.position[j] += dx * axis[j];
            state.velocity[j] += dv * axis[j];
        }
    }
    return scale;
}

/// As `advance` for matrices, per kg, that share no axes: exp(X) - 1 of the whole system, time in ticks.
template <std::size_t N>
double advance_coupled(const Matrix<N>& stiffness, const Matrix<N>& damping, double top, const State<N>& desired,
                       const Vector<N>& push, State<N>& state, double step, double pull_limit) {
    const Vector<N> off = linalg::difference(state.position, desired.position);
    const double scale = spring_scale(top * linalg::dot(off, linalg::product(stiffness, off)), pull_limit);
    const Vector<N> held = linalg::sum(push, linalg::product(damping, desired.velocity));
    Matrix<2 * N + 1> rate{};
    Vector<2 * N + 1> start{};
    start[2 * N] = 1.0;
    for (std::size_t i = 0; i < N; ++i) {
        rate[i][N + i] = 1.0;
        for (std::size_t j = 0; j < N; ++j) {
            rate[N + i][j] = -(step * step) * scale * stiffness[i][j];
            rate[N + i][N + j] = -step * damping[i][j];
        }
        rate[N + i][2 * N] = step * step * held[i];
        start[i] = off[i];
        start[N + i] = step * state.velocity[i];
    }
    const Vector<2 * N + 1> change = linalg::product(linalg::expm1(rate), start);
    for (std::size_t i = 0; i < N; ++i) {
        state.position[i] += change[i];
        state.velocity[i] += change[N + i] / step;
    }
    return scale;
}

/// Position after a time in which the velocity changes evenly.
template <std::size_t N>
Vector<N> drift(const Vector<N>& position, const Vector<N>& before, const Vector<N>& after, double time) {
    Vector<N> result;
    for (std::size_t i = 0; i < N; ++i) result[i] = position[i] + 0.5 * time * (before[i] + after[i]);
    return result;
}

/// State after braking for `step` s, or until standing still.
template <std::size_t N>
State<N> braked(const State<N>& state, double deceleration, double step) {
    const double speed = linalg::norm(state.velocity), braking = std::min(step, speed / deceleration);
    const double left = braking == step ? 1.0 - deceleration * step / speed : 0.0;
    const Vector<N> slower = linalg::scaled(left, state.velocity);
    return {drift(state.position, state.velocity, slower, braking), slower};
}

}  // namespace torch_pbd

"""Rotations against scipy, and the formulas of the chart against finite differences."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from torch_pbd import rotations
from torch_pbd.rotations import Chart


def as_scipy(quaternion):
    return Rotation.from_quat(quaternion, scalar_first=True)


@pytest.fixture(params=["any", "small", "none", "half turn"])
def vector(request, rng):
    directions = rng.normal(size=(40, 3))
    length = {"any": rng.uniform(0.0, 3.1, (40, 1)), "small": 1e-5, "none": 0.0, "half turn": np.pi - 1e-9}
    return length[request.param] * directions / np.linalg.norm(directions, axis=1, keepdims=True)


def test_exp_and_log_are_those_of_scipy(vector):
    quaternion = rotations.exp(vector)
    np.testing.assert_allclose(as_scipy(quaternion).as_matrix(), Rotation.from_rotvec(vector).as_matrix(), atol=1e-14)
    for each in (quaternion, -quaternion):
        np.testing.assert_allclose(rotations.log(each), vector, rtol=1e-12, atol=1e-15)


def test_products_and_matrices_are_those_of_scipy(rng):
    first, second = as_quaternions(rng, 30), as_quaternions(rng, 30)
    product = rotations.multiply(first, second)
    np.testing.assert_allclose(
        as_scipy(product).as_matrix(), (as_scipy(first) * as_scipy(second)).as_matrix(), atol=1e-14
    )
    np.testing.assert_allclose(rotations.matrix(first), as_scipy(first).as_matrix(), atol=1e-14)
    back = rotations.from_matrix(rotations.matrix(first))
    np.testing.assert_allclose(back, np.where(first[:, :1] < 0, -first, first), atol=1e-14)
    identity = np.broadcast_to([1.0, 0.0, 0.0, 0.0], (30, 4))
    np.testing.assert_allclose(rotations.multiply(first, rotations.conjugate(first)), identity, atol=1e-15)


@pytest.mark.parametrize("axis", np.eye(3))
def test_half_turns_come_back_from_their_matrices(axis):
    turned = rotations.from_matrix(Rotation.from_rotvec(np.pi * axis).as_matrix())
    np.testing.assert_allclose(as_scipy(turned).as_matrix(), Rotation.from_rotvec(np.pi * axis).as_matrix(), atol=1e-14)


def test_jacobians_are_the_rates_of_rotation(vector, rng):
    # exp(v + h u) = exp(h Jl u) exp(v) = exp(v) exp(h Jr u), to first order in h.
    h, direction = 1e-6, rng.normal(size=vector.shape)
    after, before = rotations.exp(vector + h * direction), rotations.exp(vector - h * direction)
    world = rotations.log(rotations.multiply(after, rotations.conjugate(before))) / (2.0 * h)
    body = rotations.log(rotations.multiply(rotations.conjugate(before), after)) / (2.0 * h)
    np.testing.assert_allclose((rotations.left_jacobian(vector) @ direction[..., None])[..., 0], world, atol=1e-8)
    np.testing.assert_allclose((rotations.left_jacobian(-vector) @ direction[..., None])[..., 0], body, atol=1e-8)


def test_chart_gives_velocity_and_acceleration_of_a_rotation_over_time(rng):
    chart = Chart(as_quaternions(rng, 1)[0])
    a, b, c = rng.normal(size=(3, 3)) * 0.4
    h, time = 1e-4, np.linspace(-1.0, 1.0, 21)[:, np.newaxis]

    def at(t):
        return a + b * t + c * np.sin(2.0 * t), b + 2.0 * c * np.cos(2.0 * t), -4.0 * c * np.sin(2.0 * t)

    turn = rotations.multiply(chart.exp(at(time + h)[0]), rotations.conjugate(chart.exp(at(time - h)[0])))
    velocity = chart.velocity(*at(time)[:2])
    np.testing.assert_allclose(velocity, rotations.log(turn) / (2.0 * h), atol=1e-6)
    later, earlier = chart.velocity(*at(time + h)[:2]), chart.velocity(*at(time - h)[:2])
    np.testing.assert_allclose(chart.acceleration(*at(time)), (later - earlier) / (2.0 * h), atol=1e-6)
    np.testing.assert_allclose(chart.log(chart.exp(at(time)[0])), at(time)[0], atol=1e-13)


def test_acceleration_is_continuous_where_its_series_begins(rng):
    chart, direction = Chart(np.array([1.0, 0.0, 0.0, 0.0])), np.array([0.6, 0.0, 0.8])
    rate, second = rng.normal(size=(2, 3))
    for length in (1e-4, 1e-3):
        below, above = (chart.acceleration(scale * length * direction, rate, second) for scale in (1 - 1e-9, 1 + 1e-9))
        np.testing.assert_allclose(below, above, rtol=1e-10)


def test_mean_is_blind_to_signs_and_turns_with_the_world(rng):
    spread = rotations.multiply(as_quaternions(rng, 1), rotations.exp(0.6 * rng.normal(size=(50, 3))))
    mean = rotations.mean(spread)
    signs = rng.choice([-1.0, 1.0], size=(50, 1))
    np.testing.assert_allclose(rotations.mean(signs * spread), mean, atol=1e-14)
    np.testing.assert_allclose(as_scipy(mean).as_matrix(), as_scipy(spread).mean().as_matrix(), atol=0.05)  # chordal
    world = as_quaternions(rng, 1)[0]
    turned = rotations.mean(rotations.multiply(world, spread))
    off = rotations.log(rotations.multiply(rotations.conjugate(turned), rotations.multiply(world, mean)))
    np.testing.assert_allclose(off, 0.0, atol=1e-13)
    np.testing.assert_allclose(Chart(mean).log(spread).mean(axis=0), 0.0, atol=1e-14)  # what makes it Frechet's


def test_signs_are_made_continuous(rng):
    path = rotations.exp(np.linspace(0.0, 9.0, 200)[:, np.newaxis] * [0.0, 0.6, 0.8])
    flipped = rng.choice([-1.0, 1.0], size=(200, 1)) * path
    found = rotations.continuous(flipped)
    np.testing.assert_array_equal(found, np.sign(flipped[0, 0]) * np.sign(path[0, 0]) * path)


def as_quaternions(rng, n):
    quaternion = rng.normal(size=(n, 4))
    return quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)

"""Alignment against closed forms: curves that differ by a known warp of time."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from torch_pbd.data import Demonstrations, load_demonstrations
from torch_pbd.data.alignment import dtw_path, dtw_warps

AMOUNTS = np.array([-0.6, -0.4, 0.15, 0.2, 0.25, 0.4])  # of warping; their mean is 0, none of them is


def curve(s):
    """A closed form with features along all of it."""
    return np.column_stack([np.sin(2 * np.pi * s), np.cos(3 * np.pi * s) + s])


def warped(n=400, units=None, scale=(1.0, 1.0)):
    """The point ``curve(u)`` is reached at time u + a u (1 - u), in a duration that differs too."""
    u = np.linspace(0, 1, n)
    times = [(3 + k) * (u + a * u * (1 - u)) for k, a in enumerate(AMOUNTS)]
    return Demonstrations(times, [curve(u) * scale] * len(AMOUNTS), units=units)


def test_phase_alignment_is_linear_in_time():
    demonstrations = warped()
    aligned = demonstrations.align("phase", n=11)
    assert aligned.is_aligned
    assert aligned.time_unit == "1"
    np.testing.assert_array_equal(aligned.times[0], np.linspace(0, 1, 11))
    for (time, position), after in zip(demonstrations, aligned.positions, strict=True):
        for i, column in enumerate(position.T):
            expected = np.interp(np.linspace(0, time[-1], 11), time, column)
            np.testing.assert_allclose(after[:, i], expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("units", "scale"),
    [(None, (1.0, 1.0)), ("m", (1e3, 1e3)), (["m", "N"], (1e-3, 1e3)), (["m", "N"], (0.0, 1.0))],
)
def test_warping_brings_copies_of_one_curve_back_with_their_mean_timing(units, scale):
    # The warps of the copies average to the identity, so the answer is curve(s) at phase s. A match is good
    # to about half a step of the grid, 1/400, at speeds up to 3 pi: the bounds follow from that.
    demonstrations = warped(units=units, scale=scale)
    linear = demonstrations.align("phase", n=200).to_array()
    together = demonstrations.align("dtw", n=200).to_array()
    expected = curve(np.linspace(0, 1, 200)) * scale
    error = np.abs(together - expected).max(axis=(0, 1)) / np.maximum(scale, 1e-300)
    spread = linear.std(axis=0).max(axis=0) / np.maximum(scale, 1e-300)
    assert (spread[np.array(scale) > 0] > 0.4).all()
    assert (together.std(axis=0).max(axis=0) < 0.05 * linear.std(axis=0).max(axis=0) + 1e-300).all()
    assert (error < 0.05).all()


def test_warping_keeps_ends_and_never_runs_back(rng):
    warps = dtw_warps(np.cumsum(rng.normal(size=(8, 60, 2)), axis=1))
    np.testing.assert_array_equal(warps[:, [0, -1]], np.tile([0.0, 1.0], (8, 1)))
    assert (np.diff(warps, axis=1) >= 0).all()
    demonstrations = warped()
    ends = demonstrations.align("dtw").to_array()[:, [0, -1]]
    np.testing.assert_array_equal(ends, [position[[0, -1]] for position in demonstrations.positions])


def test_warping_leaves_alone_what_differs_in_place_only():
    offsets = 0.01 * np.arange(5)
    s = np.linspace(0, 1, 100)
    positions = [np.column_stack([s, offset + 0 * s]) for offset in offsets]
    aligned = Demonstrations(s, positions).align("dtw", n=100)
    np.testing.assert_allclose(aligned.to_array(), positions, rtol=0, atol=1e-12)


def test_warping_does_not_depend_on_the_choice_of_units(rng):
    positions = np.cumsum(rng.normal(size=(5, 40, 2)), axis=1)
    scale = np.array([1e3, 2.0])  # m to mm, N to half newtons
    aligned = Demonstrations(np.arange(40), positions, units=["m", "N"]).align("dtw")
    rescaled = Demonstrations(np.arange(40), positions * scale, units=["mm", "N/2"]).align("dtw")
    np.testing.assert_allclose(rescaled.to_array() / scale, aligned.to_array(), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("positions", [np.zeros((3, 9, 2)), np.ones((1, 9, 2)), np.ones((3, 9, 1)) * 0.1])
def test_warping_of_what_stands_still(positions):
    aligned = Demonstrations(np.arange(9.0), positions, units="m").align("dtw")
    np.testing.assert_allclose(aligned.to_array(), positions, rtol=1e-12)


def test_default_number_of_points_is_the_median_length_up_to_200():
    lengths = [10, 20, 70]
    short = Demonstrations([np.arange(n) for n in lengths], [np.zeros((n, 1)) for n in lengths])
    assert short.align().n_steps == (20, 20, 20)
    assert warped(n=400).align().n_steps[0] == 200


def test_unknown_method_is_refused():
    with pytest.raises(ValueError, match=r"method is 'DTW', must be one of 'phase', 'dtw'"):
        warped(n=5).align("DTW")


def cheapest_by_recursion(cost):
    """Cost of the best path, cell by cell, from the definition."""
    total = np.full(cost.shape, np.inf)
    for i, j in np.ndindex(cost.shape):
        before = [total[p] for p in [(i - 1, j - 1), (i - 1, j), (i, j - 1)] if min(p) >= 0]
        total[i, j] = cost[i, j] + (min(before) if before else 0.0)
    return total[-1, -1]


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 9), st.integers(1, 9), st.integers(1, 3), st.integers(0, 2**32 - 1))
def test_path_is_the_cheapest(n, m, d, seed):
    rng = np.random.default_rng(seed)
    a, b = 1.0 * rng.integers(-2, 3, size=(n, d)), 1.0 * rng.integers(-2, 3, size=(m, d))  # integers: many ties
    path = dtw_path(a, b)
    np.testing.assert_array_equal(path[[0, -1]], [[0, 0], [n - 1, m - 1]])
    steps = np.diff(path, axis=0)
    assert {tuple(step) for step in steps} <= {(1, 1), (1, 0), (0, 1)}
    cost = ((a[:, None] - b[None]) ** 2).sum(-1)
    assert cost[path[:, 0], path[:, 1]].sum() == cheapest_by_recursion(cost)
    np.testing.assert_array_equal(dtw_path(a, a), np.column_stack([np.arange(n)] * 2))


@pytest.mark.parametrize("name", ["letter_A", "kuka_cshape_top", "snooker_skilled", "mouse_choice_1"])
def test_warping_lowers_the_spread_of_recorded_movements(recordings, name):
    recorded = load_demonstrations(recordings / f"{name}.npz")
    linear, together = recorded.align("phase", n=50), recorded.align("dtw", n=50)
    assert together.to_array().var(axis=0).sum() < linear.to_array().var(axis=0).sum()
    for before, after in zip(recorded.positions, together.positions, strict=True):
        np.testing.assert_array_equal(after[[0, -1]], before[[0, -1]])

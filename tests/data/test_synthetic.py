"""Made demonstrations against the laws they are drawn from."""

import numpy as np
import pytest

from torch_pbd.data import (
    make_handwriting_demonstrations,
    make_paper_simulation,
    make_tunnel_demonstrations,
    paper_covariance,
    paper_mean,
    tunnel_center,
    tunnel_half_width,
)

WITHIN, WANDER, CORRECTION, TREMOR, BLENDED = 0.85, 0.12, 0.04, 1e-4, 0.15 * 0.6


def tunnel_deviation(y, common_start=False, common_goal=False):
    """Standard deviation of x over demonstrations in m, in closed form but for two quadratures."""
    # Mean square of tanh over the uniform lanes, by the midpoint rule, and the normal numbers, by Gauss and Hermite.
    lanes = (np.arange(400) + 0.5) / 400 * 1.2 - 0.6
    node, weight = np.polynomial.hermite_e.hermegauss(40)
    lane = lanes[:, np.newaxis] + np.hypot(WANDER, CORRECTION) * node
    square = np.square(np.tanh(lane)).mean(axis=0) @ weight / weight.sum()
    across = WITHIN * tunnel_half_width(y)
    for distance in [y] * common_start + [0.6 - y] * common_goal:
        s = np.clip(distance / BLENDED, 0.0, 1.0)
        across = across * (s**3 * (10.0 - 15.0 * s + 6.0 * s**2))
    return np.sqrt(np.square(across) * square + TREMOR**2)


VARIANTS = ["plain", "unequal", "dropped", "jitter", "outlier", "two_path"]


def test_paper_mean_at_known_points():
    mean = paper_mean([[0.0], [10 * np.pi], [20.0]])
    expected = [[0, 0], [30, 30 * np.tanh(np.pi / 2)], [30 * np.sin(1), 30 * np.tanh(1)]]
    np.testing.assert_allclose(mean, expected, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize(
    ("reading", "variances"),
    [
        ("printed", [150 * np.exp(4), 150, 150 * np.exp(-4)]),  # 8190 down to 2.7
        ("bell", [150 * np.exp(-4), 150, 150 * np.exp(-4)]),
        ("bowl", [150 * np.exp(4), 150, 150 * np.exp(4)]),
    ],
)
def test_paper_covariance_at_known_points(reading, variances):
    covariance = paper_covariance([-100.0, 0.0, 100.0], reading)
    np.testing.assert_allclose(covariance[:, 0, 0], variances, rtol=1e-12)
    np.testing.assert_array_equal(covariance[:, 1, 1], [50, 150, 250])
    np.testing.assert_array_equal(covariance[:, 0, 1], 0)


@pytest.mark.parametrize("reading", ["printed", "bell", "bowl"])
def test_paper_draws_follow_the_law_and_are_independent(reading):
    n_inputs, n_demos = 5, 20_000
    X, y, groups = make_paper_simulation(n_inputs, n_demos, reading=reading, random_state=0)
    xi = np.linspace(-100, 100, n_inputs)
    np.testing.assert_array_equal(X.reshape(n_demos, n_inputs), np.tile(xi, (n_demos, 1)))
    np.testing.assert_array_equal(groups.reshape(n_demos, n_inputs), np.tile(np.arange(n_demos)[:, None], n_inputs))
    scale = np.sqrt(np.diagonal(paper_covariance(xi, reading), axis1=1, axis2=2))
    z = ((y.reshape(n_demos, n_inputs, 2) - paper_mean(xi)) / scale).reshape(n_demos, -1)
    # whitened draws are standard normal; 5 standard errors of 20 000 draws
    np.testing.assert_allclose(z.mean(axis=0), 0, atol=5 / np.sqrt(n_demos))
    np.testing.assert_allclose(np.cov(z.T), np.eye(2 * n_inputs), atol=5 * np.sqrt(2 / n_demos))


def test_paper_arguments_are_checked():
    with pytest.raises(ValueError, match=r"xi\[1\] is -150\.0, must be above -150"):
        paper_covariance([0.0, -150.0])
    with pytest.raises(ValueError, match="reading is 'Bell', must be one of"):
        make_paper_simulation(reading="Bell")
    with pytest.raises(ValueError, match=r"xi has shape \(3, 2\)"):
        paper_mean(np.zeros((3, 2)))
    with pytest.raises(ValueError, match="n_demos is 0"):
        make_paper_simulation(n_demos=0)


@pytest.mark.parametrize(
    "make",
    [
        make_paper_simulation,
        lambda **seed: make_tunnel_demonstrations(**seed).stack(),
        lambda **seed: make_handwriting_demonstrations(timing=0.0, **seed).stack(),
    ],
)
@pytest.mark.parametrize("seeded", [lambda: 3, lambda: np.random.default_rng(3), lambda: np.random.RandomState(3)])
def test_draws_depend_on_their_seed_only(make, seeded):
    before = np.random.get_state()[1].copy()  # noqa: NPY002
    first, second = make(random_state=seeded()), make(random_state=seeded())
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a, b)
    assert not np.array_equal(first[1], make(random_state=4)[1])
    np.testing.assert_array_equal(np.random.get_state()[1], before)  # noqa: NPY002


def test_tunnel_geometry():
    np.testing.assert_allclose(tunnel_half_width([0, 0.2, 0.325, 0.45, 0.6]), [0.12, 0.12, 0.065, 0.01, 0.01])
    np.testing.assert_allclose(tunnel_center([0, 0.15, 0.3, 0.45]), [0, 0.02, 0, -0.02], atol=1e-15)
    assert (np.diff(tunnel_half_width(np.linspace(0.2, 0.45, 100))) < 0).all()


def test_spread_in_the_tunnel_falls_from_35_mm_to_3_mm():
    x = make_tunnel_demonstrations(4000, rate=2.0, random_state=0).to_array()[:, :, 0]
    # law: 0.85 w tanh(lane + noise), lane uniform, noise normal with the variance of both bands
    lane = (np.arange(2000) + 0.5) / 2000 * 1.2 - 0.6
    nodes, weights = np.polynomial.hermite_e.hermegauss(40)
    noise = np.hypot(0.12, 0.04) * nodes
    variance = (np.tanh(lane[:, None] + noise) ** 2 @ weights).mean() / weights.sum()
    for step, half_width, stated in [(0, 0.12, 0.035), (-1, 0.01, 0.0029)]:
        expected = np.hypot(0.85 * half_width * np.sqrt(variance), 1e-4)
        np.testing.assert_allclose(x[:, step].std(), expected, rtol=0.04)  # standard error 1 %
        np.testing.assert_allclose(stated, expected, rtol=0.02)


def test_hand_keeps_inside_the_tunnel_and_moves_along_it():
    demonstrations = make_tunnel_demonstrations(20, random_state=1)
    assert (demonstrations.names, demonstrations.units) == (("x", "y"), ("m", "m"))
    assert demonstrations.is_aligned
    assert demonstrations.n_steps[0] == 1001
    for time, position in demonstrations:
        x, y = position.T
        np.testing.assert_allclose(y, 0.06 * time, rtol=0, atol=2e-5)
        assert (np.abs(x - tunnel_center(y)) < tunnel_half_width(y)).all()
        np.testing.assert_allclose(position / 5e-6, np.round(position / 5e-6), rtol=0, atol=1e-6)


@pytest.mark.parametrize(("rate", "step_bound"), [(100.0, 2e-3), (1000.0, 2e-4)])
def test_paths_are_curves_and_not_noise(rate, step_bound):
    """Band-limited: steps shrink with the sampling interval, which white noise would not."""
    x = make_tunnel_demonstrations(3, rate=rate, random_state=0).to_array()[:, :, 0]
    assert np.abs(np.diff(x, axis=1)).max() < step_bound


def test_common_start_has_no_spread_but_the_tremor():
    demonstrations = make_tunnel_demonstrations(300, rate=10.0, random_state=0, common_start=True)
    x = demonstrations.to_array()[:, :, 0]
    np.testing.assert_allclose(x[:, 0].std(), 1e-4, rtol=0.25)  # standard error 4 %, waves are few
    free = make_tunnel_demonstrations(300, rate=10.0, random_state=0).to_array()[:, :, 0]
    np.testing.assert_array_equal(x[:, 15:], free[:, 15:])


@pytest.mark.parametrize("ends", [{}, {"common_goal": True}, {"common_start": True, "common_goal": True}])
def test_the_deviation_is_that_of_many_demonstrations(ends):
    demonstrations = make_tunnel_demonstrations(2000, rate=10.0, random_state=0, **ends).to_array()
    found, at = demonstrations[:, :, 0].std(axis=0), demonstrations[0, :, 1].clip(0.0, 0.6)
    np.testing.assert_allclose(found, tunnel_deviation(at, **ends), rtol=0.06)  # standard error 1.6 %, 101 steps


def test_a_common_goal_has_no_spread_but_the_tremor():
    assert tunnel_deviation(0.6, common_goal=True) == pytest.approx(1e-4)
    assert tunnel_deviation(0.6) / tunnel_deviation(0.6, common_goal=True) > 25.0
    x = make_tunnel_demonstrations(6, rate=10.0, random_state=0, common_goal=True).to_array()[:, :, 0]
    free = make_tunnel_demonstrations(6, rate=10.0, random_state=0).to_array()[:, :, 0]
    np.testing.assert_array_equal(x[:, :85], free[:, :85])


@pytest.mark.parametrize("variant", VARIANTS)
def test_variants_differ_in_what_they_say(variant):
    made = make_tunnel_demonstrations(6, random_state=2, variant=variant)
    lengths, steps = made.n_steps, np.diff(made.times[0])
    assert made.is_aligned == (variant in {"plain", "outlier", "two_path"})
    assert (len(set(lengths)) > 1) == (variant in {"unequal", "dropped"})
    even = np.ptp(steps) < 1e-9
    assert even == (variant not in {"dropped", "jitter"})
    outside = [(np.abs(x - tunnel_center(y)) > tunnel_half_width(y)).any() for x, y in (p.T for p in made.positions)]
    assert outside == [False] * 5 + [variant == "outlier"]
    for time, position in made:
        np.testing.assert_allclose(position[[0, -1], 1], [0, 0.6], atol=1e-3)
        assert time[0] == 0


def test_two_paths_leave_the_middle_empty():
    start = make_tunnel_demonstrations(40, random_state=0, variant="two_path").to_array()[:, 0, 0]
    assert (start > 0).sum() == 20
    assert np.abs(start).min() > 0.005


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"variant": "odd"}, "variant is 'odd', must be one of 'plain'"),
        ({"n_demos": 0}, "n_demos is 0, must be an integer of at least 1"),
        ({"duration": -1.0, "rate": -100.0}, "duration is -1.0 s"),
        ({"rate": np.nan}, "rate is nan Hz"),
        ({"duration": 1e-3}, "number of steps, is 0.1"),
    ],
)
def test_tunnel_arguments_are_checked(arguments, words):
    with pytest.raises(ValueError, match=words):
        make_tunnel_demonstrations(**arguments)

"""Recordings with stamps too near to each other, and with holes: refused in words, or a path and gains that are safe.

Numbers in the names are those of the list of faults that the project keeps. Movements are made from known paths and
standard deviations. ``--hypothesis-profile=thorough`` tries 2,000 sets of recordings instead of a few.
"""

import warnings
from functools import cache

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import torch_pbd
from torch_pbd import (
    CholeskyCovRegressor,
    Demonstrations,
    DMPController,
    GMMBaseline,
    HeteroscedasticGPRegressor,
    WishartProcessRegressor,
)
from torch_pbd.control.primitive.smoothing import merge_bursts, smooth, tabulate_unsampled, unsampled

HOLE = (1.5, 3.2)  # of 4 s
BURSTS = np.repeat(np.arange(0.0, 2.01, 0.05), 5)
REGRESSORS = {
    "CD": CholeskyCovRegressor(max_iter=50),
    "WP": WishartProcessRegressor(max_iter=50),
    "GMM": GMMBaseline(n_components=2, n_restarts=0),
    "HGP": HeteroscedasticGPRegressor(),
}
THOROUGH = settings.get_current_profile_name() == "thorough"


def path(share):
    return np.stack(
        [0.4 * share**3 * (10.0 - 15.0 * share + 6.0 * share**2), 0.1 * np.sin(2.0 * np.pi * share)], axis=1
    )


def recordings(holes, n=201, lasting=4.0, seed=0, **labels):
    """One demonstration for each hole (from, to) or None; their standard deviation is 1 cm at any time."""
    rng = np.random.default_rng(seed)
    times, positions = [], []
    for hole in holes:
        time = np.linspace(0.0, lasting, n)
        angle, sides = 2.0 * np.pi * time / lasting, rng.normal(size=(2, 2))
        off = 0.01 * (np.cos(angle)[:, None] * sides[0] + np.sin(angle)[:, None] * sides[1])
        position = path(time / lasting) + off + 1e-4 * rng.normal(size=(n, 2))
        keep = np.ones(n, bool) if hole is None else (time <= hole[0] + 1e-9) | (time >= hole[1] - 1e-9)
        times.append(time[keep])
        positions.append(position[keep])
    return Demonstrations(times, positions, **labels)


def beyond(positions, demonstrations):
    """How far a path leaves the recorded range of an output, in such ranges."""
    samples = np.concatenate(demonstrations.positions)
    low, high = samples.min(axis=0), samples.max(axis=0)
    return float((np.maximum(low - positions, positions - high) / (high - low)).max())


def fitted(demonstrations, **parameters):
    """A controller, and what its fit warned of."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model = DMPController(**{"covariance": REGRESSORS["GMM"], "n_steps": 40, **parameters}).fit(demonstrations)
    told = [str(warning.message) for warning in caught]
    return model, [message for message in told if "tell no units" not in message and "cut while moving" not in message]


@cache
def with_hole(name):
    return fitted(recordings([HOLE] * 6, units="m"), covariance=REGRESSORS[name])


def nudged(step, n=5, gap=0.05):
    clean = np.arange(0.0, 2.0 + 0.5 * gap, gap)
    time = np.repeat(clean, n) + np.tile(np.arange(n) * step, len(clean))
    return clean, time, [path(time / 2.0) + shift for shift in (-0.01, 0.0, 0.01)]


@pytest.mark.parametrize("step", [1e-9, 1e-7, 1e-6])
@pytest.mark.parametrize("n", [2, 5, 30])
def test_62_nudged_stamps_are_as_their_means(step, n):
    clean, time, positions = nudged(step, n)
    noise = 1e-3 * np.random.default_rng(0).normal(size=(len(time), 2))
    recorded = Demonstrations([time] * 3, [position + noise for position in positions])
    with pytest.warns(
        UserWarning, match=rf"{3 * (n - 1) * len(clean)} samples come less than .* were merged.*"
    ) as told:
        merged = merge_bursts(recorded)
    assert len(told) == 1
    assert f"{(n - 1) * len(clean)} of {n * len(clean)} in demonstration 0" in str(told[0].message)
    np.testing.assert_allclose(merged.times[1], time.reshape(-1, n).mean(axis=1), atol=1e-12)
    np.testing.assert_allclose(merged.positions[1], (positions[1] + noise).reshape(-1, n, 2).mean(axis=1), atol=1e-12)
    assert merge_bursts(merged) is merged


def test_62_a_controller_of_bursts_is_that_of_their_means():
    time = BURSTS + np.arange(205) * 1e-9
    positions = [path(time / 2.0) + shift for shift in (-0.01, 0.0, 0.005, 0.02)]
    burst, told = fitted(Demonstrations([time] * 4, positions))
    assert sum("were merged" in message for message in told) == 1
    clean, none = fitted(Demonstrations([np.arange(0.0, 2.01, 0.05)] * 4, [p[2::5] for p in positions]))
    assert not none
    mine, theirs = burst.schedule(100.0), clean.schedule(100.0)
    np.testing.assert_allclose(mine.position, theirs.position, atol=1e-6)
    np.testing.assert_allclose(mine.stiffness, theirs.stiffness, rtol=1e-4, atol=0.1)
    with pytest.warns(UserWarning, match="were merged"):
        assert len(burst.smooth(Demonstrations([time + 1e3] * 4, positions)).time) == 40


@pytest.mark.parametrize("cutoff", [None, 400.0])
def test_62_a_path_that_leaves_the_recorded_range_is_refused(cutoff):
    _, time, positions = nudged(1e-4, 2)
    noise = 1e-3 * np.random.default_rng(0).normal(size=(len(time), 2))
    with pytest.raises(
        ValueError, match=r"demonstration 0, smoothed, leaves the recorded range of output 1, 0\.\d+, by"
    ):
        fitted(Demonstrations([time] * 3, [position + noise for position in positions]), cutoff=cutoff)


def test_62_the_range_is_that_of_the_raw_samples():
    recorded = recordings([None] * 3)
    samples = np.concatenate(recorded.positions)
    bounds = smooth(
        recorded.times, recorded.positions, 0.5, 50, 4.0
    ).bounds  # a cutoff that takes most of the movement away
    np.testing.assert_array_equal(bounds, [samples.min(axis=0), samples.max(axis=0)])


def test_62_very_uneven_times_are_smoothed_by_the_closed_form():
    """Reinsch's: g solves (R + lam Q' W^-1 Q) g = Q' y, and the smoothed values are y - lam W^-1 Q g."""
    rng = np.random.default_rng(1)
    time = np.cumsum(10.0 ** rng.uniform(-1.2, 0.0, 80))
    time, position = (time - time[0]) / np.ptp(time), rng.normal(size=80).cumsum()
    recorded = Demonstrations([time] * 2, [position] * 2)
    between, weight = np.diff(time), np.gradient(time)
    assert between.max() < 7.5 * max(np.median(between), 1.0 / 200.0)  # no hole
    q, r = np.zeros((80, 78)), np.zeros((78, 78))
    for j in range(78):
        q[j : j + 3, j] = 1.0 / between[j], -1.0 / between[j] - 1.0 / between[j + 1], 1.0 / between[j + 1]
        r[j, j] = (between[j] + between[j + 1]) / 3.0
        if j:
            r[j, j - 1] = r[j - 1, j] = between[j] / 6.0
    lam = 1.0 / (2.0 * np.pi * 8.0) ** 4
    curvature = np.linalg.solve(r + lam * q.T @ (q / weight[:, None]), q.T @ position)
    expected = position - lam * (q @ curvature) / weight
    removed = smooth(recorded.times, recorded.positions, 8.0, 50, 1.0).noise_scale
    np.testing.assert_allclose(removed, np.sqrt(np.mean((position - expected) ** 2)), rtol=1e-6)


@pytest.mark.parametrize("name", REGRESSORS)
def test_63_a_hole_in_every_recording_is_soft_told_once_and_bridged_in_range(name):
    model, told = with_hole(name)
    assert sum("Fewer than two of 6 demonstrations have samples at [1.5 to 3.2] s" in message for message in told) == 1
    schedule = model.schedule(100.0)
    middle, known = slice(165, 306), np.r_[0:150, 321:401]
    assert np.linalg.eigvalsh(schedule.stiffness)[middle].max() <= 50.0 + 0.1 * 950.0
    assert schedule.type1[middle].min() > 0.9
    assert schedule.type1[known].max() < 0.05
    off = np.linalg.norm(schedule.position - path(schedule.time / 4.0), axis=1)
    assert beyond(schedule.position, recordings([HOLE] * 6)) < 0.1
    assert off.max() < 0.05  # a cubic over 1.7 s of a sine of 4 s and 10 cm: 1.4 cm; the mean of six: 1 cm


@pytest.mark.parametrize("variant", [{"variability": "forcing"}, {"phase_input": "log_s"}, {"phase_input": "s"}])
def test_63_whatever_is_learned_over_whatever(variant):
    model, _ = fitted(recordings([HOLE] * 6), **variant)
    assert np.linalg.eigvalsh(model.schedule(50.0).stiffness)[82:154].max() <= 145.0


def test_63_in_a_hole_the_prior_is_the_prior_and_refusing_refuses():
    recorded, prior = recordings([HOLE] * 6), np.array([[4e-4, 1e-4], [1e-4, 9e-4]])
    for given_prior in (prior, lambda X: np.tile(prior, (len(X), 1, 1))):
        model, _ = fitted(recorded, covariance=CholeskyCovRegressor(prior=given_prior, max_iter=20), on_unknown="prior")
        np.testing.assert_allclose(model.schedule(50.0).covariance[90], prior, rtol=1e-6)
    refusing, _ = fitted(recorded, on_unknown="raise")
    refusing.predict_stiffness([[1.4], [3.3]])
    with pytest.raises(ValueError, match=r"There are no data at time 2 s: the Type I uncertainty is 1\.00"):
        refusing.predict_stiffness([[2.0]])
    with pytest.raises(ValueError, match="There are no data at time"):
        refusing.schedule(100.0)


class Spy(GMMBaseline):
    """Remembers the rows that it was fitted to."""

    def fit(self, X, y, groups=None):
        type(self).rows = np.asarray(X)[:, 0].copy()
        return super().fit(X, y)


def test_63_the_regressor_sees_as_many_demonstrations_as_were_sampled():
    holes = [HOLE, HOLE, HOLE, (0.4, 1.0), None, None]
    model, told = fitted(recordings(holes), covariance=Spy(n_components=2, n_restarts=0), n_steps=101)
    assert not any("Fewer than two" in message for message in told)
    times, counts = np.unique(np.round(Spy.rows, 6), return_counts=True)
    np.testing.assert_allclose(times, np.linspace(0.0, 4.0, 101), atol=1e-6)
    edge = 3.75 * 0.02  # up to which half is known
    expected = [6 - sum(h is not None and h[0] + edge < t < h[1] - edge for h in holes) for t in times]
    np.testing.assert_array_equal(counts, expected)
    full, _ = fitted(recordings([None] * 6), n_steps=101)
    assert np.abs(model.schedule(50.0).position - full.schedule(50.0).position).max() < 0.005


@pytest.mark.parametrize("name", ["CD", "WP"])
def test_63_where_four_of_eight_were_sampled_the_covariance_is_that_of_four(name):
    # CD by what follows the empirical factors, and not their logarithms, which are smoother.
    regressor = CholeskyCovRegressor(diagonal="raw") if name == "CD" else REGRESSORS[name]
    model, told = fitted(recordings([None] * 4 + [HOLE] * 4), covariance=regressor, n_steps=60)
    assert not told
    whole = recordings([None] * 8).to_array()
    for steps, numbers in [(slice(100, 136, 5), slice(4)), (slice(10, 61, 10), slice(8))]:
        expected = [np.linalg.eigvalsh(np.cov(at.T)) for at in whole[numbers, steps].transpose(1, 0, 2)]
        found = np.linalg.eigvalsh(model.covariance_.predict_cov(np.linspace(0.0, 4.0, 201)[steps, None]))
        np.testing.assert_allclose(found / expected, 1.0, atol=0.6)


def test_63_where_fewer_were_sampled_the_default_regressor_is_less_certain():
    deviations = []
    for holes in ([None] * 8, [None] * 4 + [HOLE] * 4):
        model, told = fitted(recordings(holes), covariance=REGRESSORS["HGP"])
        assert not told
        deviations.append(np.sqrt(np.linalg.eigvalsh(model.schedule(25.0).covariance[45:75])))
    assert (deviations[1] > deviations[0]).all()
    np.testing.assert_allclose(deviations[1] / 0.01, 1.4, atol=0.6)  # 1 cm is the truth


def test_63_from_one_recording_alone_nothing_is_known_of_how_they_vary():
    model, told = fitted(recordings([None, HOLE]))
    assert sum("Fewer than two of 2 demonstrations have samples at [1.5 to 3.2] s" in message for message in told) == 1
    assert np.linalg.eigvalsh(model.predict_stiffness([[2.3]])).max() <= 145.0


def test_63_a_dropout_of_three_samples_is_no_hole():
    full, _ = fitted(recordings([None] * 5), covariance=REGRESSORS["CD"])
    dropped, told = fitted(recordings([(1.98, 2.06)] * 5), covariance=REGRESSORS["CD"])
    assert not told
    assert dropped.unsampled_.max() == 0.0
    X = np.linspace(1.8, 2.2, 21)[:, None]
    np.testing.assert_allclose(dropped.predict_stiffness(X), full.predict_stiffness(X), atol=0.1 * 1000.0)


@pytest.mark.parametrize("n", [25, 101, 5001])
def test_63_what_is_known_depends_on_the_distance_to_samples_alone(n):
    time = np.linspace(7.0, 9.0, n)
    at = np.linspace(7.0, 9.0, 1001)
    np.testing.assert_array_equal(unsampled(time, at), 0.0)
    longest = max(10.0 * 2.0 / (n - 1), 2.0 / 20.0)
    keep = np.abs(time - 8.0) >= 0.5 * longest - 1e-9
    found = unsampled(time[keep], at)
    assert found[500] == 1.0
    np.testing.assert_allclose(found, found[::-1], atol=1e-6)
    np.testing.assert_array_equal(unsampled(1e3 * time[keep] - 5.0, 1e3 * at - 5.0) > 0.5, found > 0.5)
    with pytest.warns(UserWarning, match="Fewer than two of 3"):
        table = tabulate_unsampled(Demonstrations([time[keep]] * 3, [np.zeros(keep.sum())] * 3), 2.0, "soft")
    np.testing.assert_allclose(table[::4], found, atol=1e-6)


def test_63_origins_and_units_change_nothing():
    plain, _ = fitted(recordings([HOLE] * 4, units="m"))
    recorded = recordings([HOLE] * 4)
    times = [1e3 * (time + 60.0 * k) for k, time in enumerate(recorded.times)]
    moved, told = fitted(Demonstrations(times, [1e3 * p for p in recorded.positions], units="mm", time_unit="ms"))
    assert any("[1.5e+03 to 3.2e+03] ms" in message for message in told)
    mine, theirs = moved.schedule(50.0), plain.schedule(50.0)
    np.testing.assert_allclose(mine.position, theirs.position, atol=1e-5)
    np.testing.assert_allclose(mine.type1, theirs.type1, atol=1e-4)
    np.testing.assert_allclose(mine.stiffness, theirs.stiffness, rtol=1e-2, atol=1.0)


def test_63_a_model_file_knows_of_holes(tmp_path):
    model, _ = with_hole("CD")
    torch_pbd.save(model, tmp_path / "hole.safetensors")
    assert torch_pbd.load(tmp_path / "hole.safetensors").schedule(50.0) == model.schedule(50.0)
    whole, _ = fitted(recordings([None] * 4))
    torch_pbd.save(whole, tmp_path / "whole.safetensors")
    assert torch_pbd.load(tmp_path / "whole.safetensors").schedule(50.0) == whole.schedule(50.0)


KINDS = ["nudged", "near", "jitter", "dropped", "hole", "origin", "milliseconds", "repeated"]


def unlucky(seed, kinds, everyone):
    """Recordings with ill luck of these kinds; share of the movement of each, spacing, and where all have a hole."""
    rng = np.random.default_rng(seed)
    n, lasting = int(np.exp(rng.uniform(np.log(20), np.log(300)))), 10.0 ** rng.uniform(-0.3, 1.5)
    swing, scale = rng.normal(size=(2, 2)), 10.0 ** rng.uniform(-3.0, 3.0, 2)
    start, length = rng.uniform(0.15, 0.5), rng.uniform(0.05, 0.3)
    shares, times, positions = [], [], []
    for _ in range(int(rng.integers(2, 6))):
        share = np.linspace(0.0, 1.0, n)
        if "jitter" in kinds:
            share[1:-1] += rng.uniform(-0.3, 0.3, n - 2) / (n - 1)
        if "dropped" in kinds:
            share = np.delete(share, 1 + rng.choice(n - 2, size=n // 20, replace=False))
        if "hole" in kinds and (everyone or rng.random() < 0.5):
            share = share[(share <= start) | (share >= start + length)]
        shares.append(share)
        for kind, step in [("nudged", 10.0 ** rng.uniform(-9.0, -6.0)), ("near", 0.1 * 10.0 ** rng.uniform(-2, 0) / n)]:
            if kind in kinds:
                share = np.sort(np.concatenate([share, share[:-1] + step]))
        curve = np.stack([share**2 * (3.0 - 2.0 * share), np.sin(2.0 * np.pi * share)], axis=1) @ swing
        curve += 0.02 * rng.normal(size=2) + 0.02 * rng.normal(size=2) * share[:, None]
        positions.append(scale * (curve + 1e-4 * rng.normal(size=curve.shape)))
        time = lasting * (1e3 if "milliseconds" in kinds else 1.0) * share
        time += rng.uniform(-1e3, 1e3) if "origin" in kinds else 0.0
        if "repeated" in kinds:
            time[5] = time[4]
        times.append(time)
    return times, positions, shares, 1.0 / (n - 1)


@settings(
    max_examples=2000 if THOROUGH else 4,
    deadline=None,
    derandomize=not THOROUGH,
    database=None,
    suppress_health_check=list(HealthCheck),
)
@given(
    seed=st.integers(0, 2**32 - 1),
    kinds=st.sets(st.sampled_from(KINDS), max_size=3),
    everyone=st.booleans(),
    cutoff=st.sampled_from(["auto", "auto", "auto", None]),
    name=st.sampled_from(["GMM", "CD", "HGP"] if THOROUGH else ["GMM", "CD"]),
)
def test_62_63_a_refusal_in_words_or_a_path_in_range_and_soft_where_nothing_was_sampled(
    seed, kinds, everyone, cutoff, name
):
    times, positions, shares, spacing = unlucky(seed, kinds, everyone)
    try:
        recorded = Demonstrations(times, positions)
        model, _ = fitted(recorded, covariance=REGRESSORS[name], cutoff=cutoff)
    except ValueError as error:
        allowed = ["must increase strictly"] if "repeated" in kinds else []
        allowed += ["leaves the recorded range of output"] if cutoff is None or kinds & {"near", "milliseconds"} else []
        if not any(words in str(error) for words in allowed):
            raise
        return
    assert "repeated" not in kinds
    schedule = model.schedule(400.0 / model.duration_, limits=None)
    assert beyond(schedule.position, recorded) <= 0.1 + 1e-6
    assert np.isfinite(schedule.stiffness).all()
    at = schedule.time / model.duration_
    distance = np.min([np.abs(at[:, None] - share).min(axis=1) for share in shares], axis=0)
    unknown = distance > 1.3 * max(5.0 * spacing, 1.0 / 40.0)  # jitter and dropouts move the median spacing
    if unknown.any() and "near" not in kinds:
        assert np.linalg.eigvalsh(schedule.stiffness)[unknown].max() <= 145.0
    if not kinds & {"hole", "dropped", "jitter", "near"}:
        np.testing.assert_array_equal(model.unsampled_, 0.0)

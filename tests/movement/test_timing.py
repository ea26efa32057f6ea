"""Movements of unknown timing: against dense brute force, made data whose timing is known, and the laws of mixtures."""

import math

import numpy as np
import pytest
import torch
from scipy.stats import f, kstest, multivariate_t
from scipy.stats import t as student

import torch_pbd
from torch_pbd import Demonstrations, DMPController, GMMBaseline, TrajectoryRegressor, load_demonstrations
from torch_pbd.exceptions import ModelFileError
from torch_pbd.movement.timing import Timing, phase_of, register, time_of
from torch_pbd.persistence import read_archive, write_archive

GRID = np.linspace(0.0, 1.0, 40)


def paced(time, pace):
    return phase_of(torch.as_tensor(time, dtype=torch.float64), torch.tensor(pace, dtype=torch.float64)).numpy()


def movement(seed, duration, pace, n=40):
    """Times and positions (n, 2) of a movement of this timing, with a small smooth deviation."""
    rng = np.random.default_rng(seed)
    s = paced(np.linspace(0.0, 1.0, n), pace)
    waves = np.stack([np.sin(np.pi * k * s) for k in (1, 2, 3)], axis=1)
    y = np.stack([np.sin(3.0 * s), np.cos(5.0 * s)], axis=1) + 0.03 * waves @ rng.normal(size=(3, 2))
    return np.linspace(0.0, duration, n), y


@pytest.fixture(scope="module")
def shown():
    rng = np.random.default_rng(7)
    paces = 0.4 * rng.normal(size=10)  # zero in the mean, as the mean curve has no pace of its own
    timing = zip(2.0 * np.exp(0.2 * rng.normal(size=10)), paces - paces.mean(), strict=True)
    return Demonstrations(*zip(*(movement(k, *own) for k, own in enumerate(timing)), strict=True))


@pytest.fixture(scope="module")
def model(shown):
    return TrajectoryRegressor(GMMBaseline(n_components=4, n_restarts=0), timing="warp").fit(shown)


def test_phase_and_time_are_inverse_and_increase():
    s = torch.linspace(0.0, 1.0, 50, dtype=torch.float64)
    for pace in (-6.0, -1.0, -1e-7, 0.0, 1e-4, 2.0):
        u = time_of(s, torch.tensor(pace, dtype=torch.float64))
        np.testing.assert_allclose(phase_of(u, torch.tensor(pace, dtype=torch.float64)), s, atol=1e-9)
        assert (u.diff() > 0).all()
        slope = np.diff(paced([0.0, 1e-6, 1.0 - 1e-6, 1.0], pace))[[0, 2]]
        assert slope[0] / slope[1] == pytest.approx(np.exp(pace), rel=1e-4)


def test_paces_that_made_the_curves_are_found():
    paces = np.array([-0.8, -0.3, 0.0, 0.3, 0.8])
    curves = np.stack([movement(0, 1.0, pace, n=100)[1] for pace in paces])
    np.testing.assert_allclose(register(torch.from_numpy(curves)), paces, atol=0.05)


def test_the_next_movement_is_as_likely_as_said():
    rng, squares = np.random.default_rng(0), []
    root = np.array([[0.2, 0.0], [0.3, 0.4]])
    for _ in range(2000):
        values = rng.normal(size=(6, 2)) @ root.T
        timing = Timing.learn(*torch.from_numpy(np.stack([np.exp(values[:5, 0]), values[:5, 1]])))
        z = np.linalg.solve(timing.root.numpy(), values[5] - timing.location.numpy())
        squares.append(z @ z / 2.0)
    assert kstest(squares, f(2, 3).cdf).pvalue > 0.01  # as of Student's t of 5 - 2 degrees of freedom


@pytest.mark.parametrize("width", [1.0, 0.1, 0.01])
def test_the_posterior_is_that_of_a_fine_grid(width):
    location, root = torch.tensor([0.5, 0.1]).double(), torch.tensor([[0.2, 0.0], [0.1, 0.5]]).double()
    timing, last = Timing(location, root, 8.0), 1.6

    def likelihood(duration, pace):  # a ridge, as a part of a movement leaves: fast and late, or slow and early
        ridge = duration.log() - 0.6 - 0.4 * (pace - 0.3)
        return -0.5 * (ridge / (0.2 * width)).square() - 0.5 * ((pace - 0.3) / (0.6 * width)).square()

    sides = torch.linspace(0.0, 1.4, 1401).double(), torch.linspace(-2.5, 3.0, 2201).double()
    log_t, pace = (each.flatten() for each in torch.meshgrid(*sides, indexing="ij"))
    prior = multivariate_t(location, root @ root.mT, df=8.0).logpdf(torch.stack([log_t, pace], 1))
    runs = log_t >= np.log(last)
    weight = torch.where(runs, (torch.from_numpy(prior) + likelihood(log_t.exp(), pace)).exp(), 0.0)
    nodes = timing.posterior(likelihood, last)
    for own, brute in ((nodes.duration.log(), log_t), (nodes.pace, pace)):
        mean = float((weight / weight.sum()) @ brute)
        std = float((weight / weight.sum()) @ (brute - mean) ** 2) ** 0.5
        assert float(nodes.weight @ own) == pytest.approx(mean, abs=0.05 * std)
        assert float(nodes.weight @ (own - mean) ** 2) ** 0.5 == pytest.approx(std, rel=0.1)
    below = timing.posterior(lambda duration, _: torch.zeros_like(duration), last).log_integral
    of_prior = np.where(runs, np.exp(prior), 0.0).sum()
    assert nodes.log_integral - below == pytest.approx(float((weight.sum() / of_prior).log()), abs=0.05)


def test_the_posterior_of_a_whole_movement_is_found_against_its_end():
    # Student's t of many samples, narrow beside the time of the last one and with long tails.
    timing, last = Timing(torch.tensor([0.7, 0.0]).double(), torch.tensor([[0.2, 0.0], [-0.1, 0.5]]).double(), 5.0), 2.0

    def likelihood(duration, pace):
        ridge = (duration.log() - math.log(last) - 0.1 * (pace - 0.3)) / 0.004
        return -41.5 * torch.log1p(ridge.square() + ((pace - 0.3) / 0.05).square())

    log_t, pace = (torch.linspace(math.log(last), math.log(last) + 0.02, 801), torch.linspace(0.1, 0.5, 801))
    values = torch.cartesian_prod(log_t.double(), pace.double())
    prior = multivariate_t(timing.location, timing.root @ timing.root.mT, df=5.0).logpdf(values)
    weight = torch.from_numpy(prior) + likelihood(values[:, 0].exp(), values[:, 1])
    nodes = timing.posterior(likelihood, last)
    below = timing.posterior(lambda duration, _: torch.zeros_like(duration), last).log_integral
    of_prior = student.sf((math.log(last) - 0.7) / 0.2, 5.0)
    expected = float(weight.logsumexp(0)) + math.log(0.02 / 800 * 0.4 / 800 / of_prior)
    assert nodes.log_integral - below == pytest.approx(expected, abs=0.05)


def test_where_durations_do_not_differ_the_posterior_is_of_the_pace():
    timing = Timing.learn(torch.full((6,), 2.0).double(), torch.tensor([-0.5, -0.2, 0.0, 0.1, 0.2, 0.4]).double())

    def likelihood(_, pace):
        return -0.5 * ((pace - 0.3) / 0.05).square()

    nodes, below = (timing.posterior(each, 2.0) for each in (likelihood, lambda _, pace: torch.zeros_like(pace)))
    pace = torch.linspace(-20.0, 20.0, 400001).double()
    prior = (1.0 + (pace / timing.root[1, 1]).square() / timing.df) ** (-0.5 * (timing.df + 1.0))
    weight = prior * likelihood(None, pace).exp()
    np.testing.assert_allclose(nodes.duration, 2.0)
    assert float(nodes.weight @ nodes.pace) == pytest.approx(float(weight @ pace / weight.sum()), abs=0.002)
    expected = float((weight.sum() / prior.sum()).log())
    assert nodes.log_integral - below.log_integral == pytest.approx(expected, abs=0.05)


def test_the_posterior_of_a_model_is_that_of_a_dense_grid(model):
    time, y = movement(31, 2.3, -0.2)
    # Five samples, a twelfth of the mean duration and more apart: all count.
    X, value, ahead = time[:16:3, np.newaxis], y[:16:3].copy(), np.array([[0.9], [1.4]])
    value[1, 0] = np.nan
    known = model.condition(X, value, noise_scale=0.02)
    given = ~np.isnan(value).ravel()
    timing, flat = model._timing, []
    z = np.linspace(-3.5, 3.5, 23)
    for one in z:
        for two in z:
            duration, pace = timing.location.numpy() + timing.root.numpy() @ [one, two]
            if np.exp(duration) < X[-1]:
                continue
            at = np.append(X, ahead)
            [(plain, phases)] = model._over_phase(at, torch.tensor([np.exp(duration)]), torch.tensor([pace]))
            np.testing.assert_allclose(phases, paced(at / np.exp(duration), pace))
            mean, covariance = plain.predict_joint(phases[: len(X), np.newaxis])
            own = (covariance.reshape(12, 12) + 0.02**2 * np.eye(12))[np.ix_(given, given)]
            law = multivariate_t(mean.ravel()[given], own * (plain.df_ - 2.0) / plain.df_, df=plain.df_)
            prior = multivariate_t(np.zeros(2), np.eye(2), df=timing.df).logpdf([one, two])
            flat.append((prior + law.logpdf(value.ravel()[given]), *phases[len(X) :]))
    log_weight, first, second = np.array(flat).T
    weight = np.exp(log_weight - log_weight.max())
    mean, std = known.predict_phase(ahead)
    for k, phases in enumerate((first, second)):
        brute = np.average(phases, weights=weight)
        spread = np.sqrt(np.average(np.square(phases - brute), weights=weight))
        assert mean[k] == pytest.approx(brute, abs=0.05 * spread)
        assert std[k] == pytest.approx(spread, rel=0.1)


@pytest.mark.parametrize("factor", [0.8, 1.0, 1.25])
def test_a_retimed_movement_is_found_and_foretold(shown, model, factor):
    average = np.mean([time[-1] for time in shown.times])
    time, y = movement(40, factor * average, 0.0)
    seen = time <= time[-1] / 3.0
    known = model.condition(time[seen, np.newaxis], y[seen])
    now = time[seen][-1]
    true = now / time[-1]
    mean, std = known.predict_phase([[now], [10.0 * average]])
    taken = abs(now / average - true)
    assert abs(mean[0] - true) < max(0.35 * taken, 0.02)
    assert abs(mean[0] - true) < 3.0 * std[0]
    np.testing.assert_allclose((mean[1], std[1]), (1.0, 0.0), atol=1e-12)
    rest = ~seen
    foretold = known.predict(time[rest, np.newaxis])
    untimed = TrajectoryRegressor(GMMBaseline(n_components=4, n_restarts=0)).fit(shown)
    taken = untimed.condition(time[seen, np.newaxis] / average, y[seen]).predict(
        np.minimum(time[rest, np.newaxis] / average, 1.0)
    )
    error = [np.sqrt(np.square(each - y[rest]).mean()) for each in (foretold, taken)]
    assert error[0] < (0.6 * error[1] if factor != 1.0 else 0.1)
    np.testing.assert_allclose(known.predict(time[seen, np.newaxis]), y[seen], atol=1e-6)


def test_again_and_again_is_once(model):
    time, y = movement(50, 1.8, 0.3)
    once = model.condition(time[:20, np.newaxis], y[:20])
    again = model
    for part in (slice(12, 20), slice(0, 5), slice(5, 12)):
        again = again.condition(time[part, np.newaxis], y[part])
    at = time[20:, np.newaxis]
    np.testing.assert_allclose(again.predict_phase(at), once.predict_phase(at), atol=1e-9)
    np.testing.assert_allclose(again.predict_joint(at)[1], once.predict_joint(at)[1], atol=1e-7)


@pytest.mark.parametrize("is_known", [False, True])
def test_the_mixture_is_one_law(model, is_known):
    time, y = movement(60, 1.9, 0.2)
    known = model.condition(time[:12, np.newaxis], y[:12]) if is_known else model
    X = time[15::8, np.newaxis]
    mean, covariance = known.predict_joint(X)
    own_mean, own = known.predict(X, return_cov=True)
    np.testing.assert_allclose(own_mean, mean, atol=1e-9)
    np.testing.assert_allclose(own, covariance[np.arange(len(X)), :, np.arange(len(X))], atol=1e-9)
    n = 4000
    draws = known.sample_demonstrations(X, n, random_state=0).reshape(n, -1)
    deviation = np.sqrt(np.diagonal(covariance.reshape(mean.size, -1)))
    assert (np.abs(draws.mean(0) - mean.ravel()) < 5.0 * deviation / np.sqrt(n)).all()
    np.testing.assert_allclose(draws.std(0), deviation, rtol=0.15)
    uncertainty = known.predict_uncertainty(X)
    assert ((uncertainty.type1 >= 0.0) & (uncertainty.type1 <= 1.0)).all()
    if is_known:
        assert known.score_demonstrations(X, y[15::8])[0] > model.score_demonstrations(X, y[15::8])[0] + 1.0


@pytest.mark.slow
def test_auto_takes_timing_where_left_out_demonstrations_have_it(shown):
    own = TrajectoryRegressor(GMMBaseline(n_components=2, n_restarts=0), timing="auto")
    own.fit(shown[:6].resample(20))
    assert own.timing_ == "warp"
    assert own.timing_gain_ > 0.3
    assert own.predict_phase([[1.0]])[1] > 0.0
    rng = np.random.default_rng(3)  # straight lines at one pace and of one duration, in noise: nothing is to be found
    lines = [np.linspace(0.0, 1.0, 30)[:, np.newaxis] + 0.5 * rng.normal(size=(30, 1)) for _ in range(6)]
    none = TrajectoryRegressor(GMMBaseline(n_components=1, n_restarts=0), timing="auto")
    none.fit(Demonstrations([np.linspace(0.0, 2.0, 30)] * 6, lines))
    assert (none.timing_, none.timing_gain_ <= 0.0) == ("none", True)
    np.testing.assert_allclose(none.predict_phase([[0.5], [2.0]]), [[0.25, 1.0], [0.0, 0.0]], atol=1e-12)


def test_single_rows_have_the_law_of_the_mixture(model):
    """Once they were drawn from a Student's t of the mixture's moments, whose tails are others."""
    late = np.array([[1.9]])
    std = model.predict(late, return_std=True)[1]
    drawn = model.sample_y(late, 40_000, random_state=0)[0]
    np.testing.assert_allclose(np.cov(drawn), model.predict_cov(late)[0], rtol=0.08, atol=0.02 * std.max() ** 2)
    x = np.sort(model.sample_demonstrations(late, 40_000, random_state=1)[:, 0, 0])
    np.testing.assert_allclose(np.quantile(drawn[0], [0.01, 0.5, 0.99]), np.quantile(x, [0.01, 0.5, 0.99]), atol=0.03)


def test_without_timing_nothing_changes(shown):
    plain, named = (
        TrajectoryRegressor(GMMBaseline(n_restarts=0), **own).fit(shown) for own in ({}, {"timing": "none"})
    )
    np.testing.assert_array_equal(
        plain.predict_joint(GRID[:, np.newaxis])[1], named.predict_joint(GRID[:, np.newaxis])[1]
    )
    assert (named.input_, named.timing_) == ("phase", "none")
    with pytest.raises(ValueError, match="timing is 'none', must be 'warp' or 'auto'"):
        named.predict_phase([[0.5]])


def test_files_hold_the_timing(shown, model, tmp_path):
    path = tmp_path / "m.safetensors"
    torch_pbd.save(model, path)
    loaded = torch_pbd.load(path)
    time, y = movement(80, 2.2, 0.0)
    known = [each.condition(time[:10, np.newaxis], y[:10]) for each in (model, loaded)]
    np.testing.assert_array_equal(*(each.predict_phase(time[:, np.newaxis]) for each in known))
    np.testing.assert_array_equal(*(each.predict_joint(time[10::9, np.newaxis])[1] for each in known))
    with pytest.raises(TypeError, match="was conditioned"):
        torch_pbd.save(known[0], path)
    header, arrays = read_archive(path)
    for change in (
        {"timing_df": np.array(-1.0)},
        {"timing_root": -arrays["timing_root"]},
        {"timing_location": np.ones(3)},
    ):
        write_archive(path, header, arrays | change)
        with pytest.raises(ModelFileError):
            torch_pbd.load(path)


def test_what_timing_cannot_do_is_refused(shown, model):
    few = shown[:3]
    with pytest.raises(ValueError, match="groups has 3 demonstrations, must have 4 or more to learn how timing varies"):
        TrajectoryRegressor(GMMBaseline(n_restarts=0), timing="warp").fit(few)
    X, y, groups = shown.stack("phase")
    with pytest.raises(ValueError, match=r"the first time of a demonstration.* is .*, must be 0 or a little later"):
        TrajectoryRegressor(GMMBaseline(n_restarts=0), timing="warp").fit(X + 5.0, y, groups=groups)
    with pytest.raises(
        ValueError, match=r"X reaches 50, must be at most .*: no movement like those shown lasts longer"
    ):
        model.condition([[50.0]], [[0.0, 0.0]])
    with pytest.raises(ValueError, match=r"X has a time of -0\.5, must be at least 0: count from the movement's start"):
        model.predict([[-0.5]])
    with pytest.raises(ValueError, match="timing of covariance is 'warp', must be 'none'"):
        DMPController(TrajectoryRegressor(timing="warp")).fit(shown)


def test_aligned_by_dynamic_time_warping_is_told(shown):
    with pytest.warns(UserWarning, match="aligned by dynamic time warping"):
        TrajectoryRegressor(GMMBaseline(n_restarts=0)).fit(shown.align("dtw", n=30))


def test_a_running_letter_is_found(recordings):
    # Letters last equally long, and differ in pace: the phase by alignment of the whole letter is the truth.
    letters = load_demonstrations(recordings / "letter_C.npz").resample(50)
    train, left_out = letters.split(2)
    known = TrajectoryRegressor(timing="warp").fit(train)
    X, y, _ = left_out.stack()
    known = known.condition(X[:17], y[:17])
    mean, _ = known.predict_phase(X[16:17])
    curve = np.mean(train.positions, axis=0)
    path = torch_pbd.data.alignment.dtw_path(y, curve)
    true = path[path[:, 0] == 16, 1].mean() / 49.0
    assert abs(mean[0] - true) < 0.5 * abs(16.0 / 49.0 - true)

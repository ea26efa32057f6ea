"""The joint law of whole movements: against dense algebra, a dense reference, and the laws of probability."""

import copy
import importlib.util
import pickle

import numpy as np
import pandas as pd
import pytest
import torch
from scipy.interpolate import CubicSpline
from scipy.linalg import block_diag
from scipy.stats import chi2, multivariate_normal, multivariate_t
from sklearn.base import clone
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import MinMaxScaler

from torch_pbd import (
    CholeskyCovRegressor,
    Demonstrations,
    GMMBaseline,
    HeteroscedasticGPRegressor,
    TrajectoryRegressor,
    load_demonstrations,
)
from torch_pbd.data import make_tunnel_demonstrations
from torch_pbd.data.demonstrations import Demonstration
from torch_pbd.kernels import correlation
from torch_pbd.movement import output_kernel, time_kernel_fit
from torch_pbd.movement.time_kernel_fit import fit_time_kernel, smoothest_first
from torch_pbd.movement.timed import sampled

GRID = np.linspace(0.0, 1.0, 30)


def movements(n_demos=6, seed=0, grid=GRID):
    """Smooth deviations of two outputs from a mean, wider in the middle: (n_demos, n, 2)."""
    rng = np.random.default_rng(seed)
    kernel = np.exp(-0.5 * np.square((grid[:, np.newaxis] - grid) / 0.2)) + 1e-6 * np.eye(len(grid))
    root = np.linalg.cholesky(kernel)
    width = 0.2 + np.sin(np.pi * grid)[:, np.newaxis]
    mean = np.stack([np.sin(3.0 * grid), np.cos(2.0 * grid)], axis=1)
    return mean + width * (root @ rng.standard_normal((n_demos, len(grid), 2)))


def stacked(demos, grid=GRID):
    n_demos, n, d = demos.shape
    return np.tile(grid, n_demos)[:, np.newaxis], demos.reshape(-1, d), np.repeat(np.arange(n_demos), n)


@pytest.fixture(scope="module")
def model():
    X, y, groups = stacked(movements())
    return TrajectoryRegressor(shrinkage=0.4).fit(X, y, groups=groups)


def sample_series(kernel, length_scale, n_demos=8, seed=3):
    """Draws of a kernel's process of unit variance: (n_demos, n, 2)."""
    unit = correlation(*2 * [torch.from_numpy(GRID)[:, None]], torch.tensor([length_scale]).double(), kernel)
    root = torch.linalg.cholesky(unit + 1e-6 * torch.eye(len(GRID)))
    normal = torch.from_numpy(np.random.default_rng(seed).standard_normal((n_demos, len(GRID), 2)))
    return root @ normal


def fitted_kernel(residual, *kernels):
    """Time kernel of residuals whose deviations are one, and squares of the demonstrations left out in turn."""
    grid = torch.from_numpy(GRID)
    return fit_time_kernel(grid, residual, torch.ones_like(residual[0]), list(kernels), None)


def found_kernel(residual, *kernels):
    return fitted_kernel(residual, *kernels)[0]


@pytest.mark.parametrize("shrinkage", ["auto", 0.5])
@pytest.mark.parametrize("order", [[1, 0], [0, 1]])
def test_a_smooth_output_that_varies_with_a_rough_one_is_drawn_as_smooth_in_any_order_of_columns(order, shrinkage):
    """Given the rough one first, what trembles in it came into the other by their covariance."""
    slow = movements(8)[..., 0]
    demos = np.stack([slow, slow + 0.1 * np.random.default_rng(0).standard_normal(slow.shape)], axis=2)
    X, y, groups = stacked(demos[..., order])
    model = TrajectoryRegressor(shrinkage=shrinkage).fit(X, y, groups=groups)
    drawn = model.sample_demonstrations(X[:30], 500, 0)
    bends = [np.sqrt(np.square(np.diff(part, 2, axis=1)).mean((0, 1))) for part in (drawn, demos[..., order])]
    assert (bends[0] / bends[1])[order.index(0)] < 1.5
    # What is told of each output is in the order of the columns.
    nugget = np.median(model.nugget_scale_, axis=0)
    assert nugget[order.index(0)] < 0.3 * nugget[order.index(1)]


def test_a_step_of_noise_does_not_decide_on_the_order():
    series = sample_series("squared_exponential", 0.3)
    rough = series[..., :1] + 0.1 * torch.from_numpy(np.random.default_rng(0).standard_normal((8, len(GRID), 1)))
    series[:, -1:] = torch.from_numpy(np.random.default_rng(1).standard_normal((8, 1, 2)))
    assert smoothest_first(torch.cat([rough, series[..., 1:]], dim=2)).tolist() == [1, 0]
    assert smoothest_first(series[:, :2]).tolist() == [0, 1]


def whole_correlation(along):
    """Correlation (n d, n d) of all entries, of that of each output (d, n, n)."""
    d, n, _ = along.shape
    whole = np.zeros((n, d, n, d))
    for output in range(d):
        whole[:, output, :, output] = along[output]
    return whole.reshape(n * d, n * d)


def dense(model, X):
    """Mean (n d,) and covariance (n d, n d)."""
    mean, covariance = model.predict_joint(X)
    return mean.ravel(), covariance.reshape(mean.size, mean.size)


def test_the_law_is_that_of_the_dense_reference(recordings, monkeypatch):
    file = recordings.parent / "oracles" / "trajectory_dense.py"
    if not file.is_file():
        pytest.skip("no dense reference beside the recordings")
    spec = importlib.util.spec_from_file_location("trajectory_dense", file)
    oracle = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(oracle)
    # It has one time kernel for all outputs: here there is one.
    demos, X = movements()[..., :1], GRID[:, np.newaxis]
    X_fit, y, groups = stacked(demos)
    regressor = HeteroscedasticGPRegressor().fit(X_fit, y, groups=groups)
    moments = regressor.predict(X, return_cov=True)
    mean, covariance, df, found = oracle.joint(GRID, demos, *moments, regressor.predict_df(X))
    # It has its own smallest nugget, and chooses the shrinkage as if that left the marginals what they are.
    monkeypatch.setattr(output_kernel, "_LEAST", min(oracle.NUGGETS))
    monkeypatch.setattr(output_kernel, "_NUGGETS", oracle.NUGGETS)
    monkeypatch.setattr(output_kernel, "_RATIOS", ())  # and one length scale, of its grid
    monkeypatch.setattr(output_kernel, "_BETWEEN", (1.0,))
    own = TrajectoryRegressor(time_kernel="matern52", shrinkage=1.0 - found["weight"]).fit(X_fit, y, groups=groups)
    assert own.length_scale_ == pytest.approx(found["length"])
    assert own.df_ == max(3.0, 0.5 * df)
    np.testing.assert_allclose(dense(own, X)[1], covariance, rtol=1e-6, atol=1e-8 * covariance.max())
    np.testing.assert_allclose(dense(own, X)[0], mean, rtol=1e-12)


def test_the_law_is_that_of_its_definition_in_an_order_that_is_not_that_of_the_columns():
    noise = np.array([0.1, 0.5, 0.0]) * np.random.default_rng(0).standard_normal((8, len(GRID), 3))
    X, y, groups = stacked(np.concatenate([movements(8), movements(8, seed=1)[..., :1]], axis=2) + noise)
    model = TrajectoryRegressor(GMMBaseline(n_restarts=0), shrinkage=0.4).fit(X, y, groups=groups)
    X, order, kernel = X[:30], model.module_.order.numpy(), model.module_.time_kernel
    assert order.tolist() == [2, 0, 1]
    residual, along = kernel.residual.reshape(8, -1).numpy(), kernel.correlation(kernel.grid, kernel.grid).numpy()
    whole = 0.6 * whole_correlation(along) + 0.4 * residual.T @ residual / 8
    factor = []
    for i, covariance in enumerate(model.predict_cov(X)[:, order][:, :, order]):
        own = whole[3 * i : 3 * i + 3, 3 * i : 3 * i + 3]
        factor.append(np.linalg.cholesky(covariance) @ np.linalg.inv(np.linalg.cholesky(own)))
    expected = (block_diag(*factor) @ whole @ block_diag(*factor).T).reshape(30, 3, 30, 3)
    own = model.predict_joint(X)[1][:, order][..., order]
    np.testing.assert_allclose(own, expected, rtol=1e-9, atol=1e-9 * expected.max())


def test_marginals_are_those_of_the_regressor(model):
    X = np.linspace(-0.1, 1.1, 23)[:, np.newaxis]
    mean, covariance = model.predict_joint(X)
    own_mean, own = model.predict(X, return_cov=True)
    np.testing.assert_array_equal(own, model.regressor_.predict_cov(X))
    np.testing.assert_array_equal(own_mean, model.regressor_.predict(X))
    np.testing.assert_allclose(mean, own_mean, rtol=1e-12)
    blocks = covariance[np.arange(len(X)), :, np.arange(len(X))]
    np.testing.assert_allclose(blocks, own, rtol=1e-10, atol=1e-10 * own.max())


@pytest.mark.parametrize("known", [None, "steps", "entries"])
def test_structured_algebra_is_the_dense(model, known):
    X, y = GRID[1::2, np.newaxis], movements(1, seed=3)[0, 1::2]
    if known == "steps":
        model = model.condition([[0.2], [0.55]], [[0.3, 0.9], [0.8, 0.1]])
    elif known == "entries":
        model = model.condition([[0.2], [0.55]], [[0.3, np.nan], [0.8, 0.1]], noise_scale=[0.05, 0.1])
    mean, covariance = dense(model, X)
    scale = covariance * (model.df_ - 2.0) / model.df_
    expected = multivariate_t(mean, scale, df=model.df_).logpdf(y.ravel())
    np.testing.assert_allclose(model.score_demonstrations(X, y), [expected], rtol=1e-9)
    assert model.score(X, y) == pytest.approx(expected / len(X), rel=1e-9)


@pytest.mark.parametrize("known", [None, "steps", "entries", "both"])
def test_draws_have_the_joint_covariance(model, known):
    X, model = np.linspace(0.0, 1.0, 7)[:, np.newaxis], copy.copy(model)
    model.df_ = 12.0  # with less than four, covariances of draws have no error
    if known in ("steps", "both"):
        model = model.condition([[0.5]], [[0.9, 0.4]])
    if known in ("entries", "both"):
        model = model.condition([[0.2], [0.7]], [[0.3, np.nan], [0.8, 0.1]], noise_scale=0.1)
    mean, covariance = dense(model, X)
    n = 10_000
    draws = model.sample_demonstrations(X, n, random_state=0).reshape(n, -1)
    variance = np.diagonal(covariance).clip(0.0)
    # Of a t with nu degrees of freedom the fourth moment is (nu - 2) / (nu - 4) times the normal one.
    excess = (model.df_ - 2.0) / (model.df_ - 4.0)
    error = np.sqrt((excess * (np.outer(variance, variance) + 2 * covariance**2) - covariance**2).clip(0.0) / n)
    assert (np.abs(np.cov(draws.T) - covariance) <= 5.0 * error + 1e-12 * variance.max()).all()
    assert (np.abs(draws.mean(0) - mean) <= 5.0 * np.sqrt(variance / n) + 1e-12).all()


def gaussian_conditional(mean, covariance, rows, values, variances):
    gain = np.linalg.solve(covariance[np.ix_(rows, rows)] + np.diag(variances), covariance[rows]).T
    return mean + gain @ (values - mean[rows]), covariance - gain @ covariance[rows]


def test_conditioning_is_that_of_a_normal_law(model):
    # Whole steps, steps with an output that is not given, with noise, off the grid, and again.
    times = np.array([0.113, 0.113 + 0.2, 0.42, 0.871])
    values = np.array([[0.2, 0.9], [np.nan, 0.7], [0.9, 0.5], [0.4, np.nan]])
    X = np.concatenate([np.linspace(0.0, 1.0, 9), times])[:, np.newaxis]
    once = model.condition(times[:2, np.newaxis], values[:2])
    twice = once.condition(times[2:, np.newaxis], values[2:], noise_scale=[0.1, 0.2])
    given = [(9, 0, 0.0), (9, 1, 0.0), (10, 1, 0.0), (11, 0, 0.1), (11, 1, 0.2), (12, 0, 0.1)]
    rows = [2 * step + output for step, output, _ in given]
    flat = np.concatenate([np.zeros((9, 2)), values])[[g[0] for g in given], [g[1] for g in given]]
    mean, covariance = gaussian_conditional(*dense(model, X), rows, flat, np.square([g[2] for g in given]))
    size = np.abs(dense(model, X)[1]).max()
    np.testing.assert_allclose(dense(twice, X)[0], mean, rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(dense(twice, X)[1], covariance, rtol=1e-7, atol=1e-9 * size)
    np.testing.assert_allclose(twice.predict(X).ravel(), mean, rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(
        twice.predict_cov(X), dense(twice, X)[1].reshape(13, 2, 13, 2)[range(13), :, range(13)], atol=1e-9 * size
    )
    np.testing.assert_allclose(once.predict(times[:1, np.newaxis]), values[:1], atol=1e-9)
    np.testing.assert_allclose(once.sample_demonstrations(times[:1, np.newaxis], 5, 0), np.tile(values[:1], (5, 1, 1)))
    # The original is as it was, and the order of what is given does not matter.
    np.testing.assert_array_equal(model.predict(X), model.regressor_.predict(X))
    other = model.condition(times[2:, np.newaxis], values[2:], noise_scale=[0.1, 0.2])
    other = other.condition(times[:2, np.newaxis], values[:2])
    np.testing.assert_allclose(dense(other, X)[1], covariance, rtol=1e-7, atol=1e-9 * size)


def test_conditioning_keeps_what_is_missing_and_narrows_the_rest(model):
    X = np.linspace(0.0, 1.0, 5)[:, np.newaxis]
    known = model.condition([[0.5]], [[1.0, 0.5]])
    np.testing.assert_array_equal(known.predict_uncertainty(X).type1, model.predict_uncertainty(X).type1)
    before, after = model.predict_uncertainty(X).type2, known.predict_uncertainty(X).type2
    assert (np.linalg.eigvalsh(before - after) >= -1e-9 * before.max()).all()
    assert np.abs(after[2]).max() < 1e-9 * before.max()


def test_a_movement_that_was_seen_halfway_is_foretold(recordings):
    demonstrations = load_demonstrations(recordings / "letter_G.npz").align(n=50)
    train, left_out = demonstrations.split(3)
    fitted = TrajectoryRegressor().fit(train)
    X, y, _ = left_out.stack()
    known = fitted.condition(X[:25], y[:25])
    ahead = slice(25, 30)
    error = [np.square(model.predict(X[ahead]) - y[ahead]).mean() for model in (known, fitted)]
    assert error[0] < 0.3 * error[1]
    assert known.score_demonstrations(X[25:], y[25:])[0] > fitted.score_demonstrations(X[25:], y[25:])[0]
    # Rows as if independent lose some nats a step.
    assert fitted.score(X, y) > fitted.regressor_.score(X, y) + 2.0


def test_steps_that_a_recording_has_not_are_left_out_of_it_not_drawn_through(monkeypatch):
    monkeypatch.setattr(output_kernel, "_RATIOS", ())  # without tremor
    demos = movements(8)
    time = [GRID] * 7 + [np.delete(GRID, slice(8, 20))]
    hole = [*demos[:7], np.delete(demos[7], slice(8, 20), axis=0)]
    without = TrajectoryRegressor(HeteroscedasticGPRegressor()).fit(Demonstrations([GRID] * 7, list(demos[:7])))
    fitted = TrajectoryRegressor(HeteroscedasticGPRegressor()).fit(Demonstrations(time, hole))
    # A straight line through the hole would be a far smoother series than the others, or a jump.
    np.testing.assert_allclose(fitted.length_scale_, without.length_scale_, rtol=0.4)
    assert np.median(fitted.nugget_scale_) < 0.05


@pytest.mark.parametrize(("noise", "lost"), [(0.0, 3.5), (0.005, 0.25)])
def test_samples_at_times_of_their_own_are_no_noise_and_their_noise_does_not_grow(noise, lost):
    """Chords between samples lose five nats a step of smooth movements, and splines draw noisy ones far too rough."""
    rng, fine = np.random.default_rng(0), np.linspace(0.0, 1.0, 101)
    root = np.linalg.cholesky(np.exp(-0.5 * np.square((fine[:, None] - fine) / 0.15)) + 1e-9 * np.eye(101))
    mean = np.stack([np.sin(5.0 * fine), np.cos(4.0 * fine)], axis=1)
    curves = [CubicSpline(fine, mean + 0.1 * root @ rng.standard_normal((101, 2))) for _ in range(9)]

    def recorded(times):
        return [c(time) + noise * rng.standard_normal((len(time), 2)) for c, time in zip(curves, times, strict=True)]

    def fitted(times):
        rows = np.concatenate(times[:8])[:, None], np.concatenate(recorded(times)[:8])
        return TrajectoryRegressor().fit(*rows, groups=np.repeat(range(8), 40))

    at = fine[::2]
    *shown, new = recorded([at] * 9)
    even = fitted([np.linspace(0.0, 1.0, 40)] * 9)
    times = [np.sort(np.append(rng.uniform(0.0, 1.0, 38), [0.0, 1.0])) for _ in range(9)]
    times[3][20] = times[3][19] + 1e-9  # as of stamps that jitter
    own = fitted(times)
    draws = own.sample_demonstrations(at[:, None], 100, random_state=0)
    assert 0.8 < np.diff(draws, n=2, axis=1).std() / np.diff(shown, n=2, axis=1).std() < 1.5
    likely = [model.score(at[:, None], new, groups=np.zeros(51)) for model in (even, own)]
    assert likely[1] > likely[0] - lost


def test_a_burst_of_samples_is_thinned_not_lost():
    """With a tenth of the samples' usual distance between those of a burst, in the middle or at the end."""
    grid, coarse, fine = np.linspace(0.0, 3.0, 200), 0.1, 0.1 / 10.5
    middle = np.concatenate([np.arange(0.0, 1.3, coarse), np.arange(1.3, 1.38, fine), np.arange(1.4, 3.01, coarse)])
    end = np.concatenate([np.arange(0.0, 2.8, coarse), np.arange(2.8, 2.99, fine)])
    for time in (middle, end):
        found = sampled(Demonstration(time, np.sin(3.0 * time)[:, np.newaxis]), grid)[:, 0]
        within = grid <= time[-1]
        np.testing.assert_allclose(found[within], np.sin(3.0 * grid)[within], atol=0.01)


def test_nuggets_take_missing_steps_for_missing():
    residual = torch.from_numpy(movements(6, seed=2) - movements(6, seed=2).mean(0))
    holed = residual.clone()
    holed[0, 10:15] = torch.nan
    whole, part = (found_kernel(values, "squared_exponential") for values in (residual, holed))
    torch.testing.assert_close(part.scales[:, 0], whole.scales[:, 0], rtol=0.4, atol=0.0)
    assert not part.residual.isnan().any()
    # What stands in the hole is near to what was cut out of it.
    assert (part.residual[0, 10:15] - whole.residual[0, 10:15]).abs().max() < 0.3


def test_the_length_scale_that_made_the_movements_is_found(monkeypatch):
    monkeypatch.setattr(output_kernel, "_RATIOS", ())  # without tremor
    found = found_kernel(sample_series("squared_exponential", 0.19, n_demos=30), "squared_exponential")
    assert found.scales[:, 0].tolist() == pytest.approx([0.19, 0.19], rel=0.02)  # those of the grid are 0.164 and 0.222


@pytest.mark.parametrize("kernel", ["squared_exponential", "matern52"])
def test_the_likelier_kernel_is_that_of_the_movements(kernel):
    series = sample_series(kernel, 0.2)
    assert found_kernel(series, "matern52", "squared_exponential").kernel == kernel


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("kernel", ["squared_exponential", "matern52"])
def test_a_step_of_noise_does_not_decide_on_the_kernel(kernel, seed, monkeypatch):
    """Where movements end at one point noise is left: one nugget for all steps would have to be as large."""
    monkeypatch.setattr(output_kernel, "_RATIOS", ())  # without tremor
    series = sample_series(kernel, 0.3, seed=seed)
    series[:, -1:] = torch.from_numpy(np.random.default_rng(seed).standard_normal((8, 1, 2)))
    assert found_kernel(series, "matern52", "squared_exponential").kernel == kernel


def test_two_length_scales_are_found_where_movements_have_them():
    # Slow deviations, and a tenth of their variance that changes four times as fast.
    slow, fast = sample_series("matern52", 0.6, n_demos=24), sample_series("matern52", 0.15, n_demos=24).flip(0)
    found = found_kernel(0.9**0.5 * slow + 0.1**0.5 * fast, "matern52")
    for (long, short), fine in zip(found.scales.tolist(), found.fine, strict=True):
        assert (long, short) == (pytest.approx(0.6, rel=0.4), pytest.approx(0.15, rel=0.4))
        assert 0.03 < float(fine[0]) < 0.5  # it is 0.11 of the slow part's


def test_each_output_has_the_correlation_of_its_own_movements():
    lengths = (0.6, 0.1)
    series = [sample_series("matern52", length, n_demos=24)[..., :1] for length in lengths]
    found = found_kernel(torch.cat(series, dim=2), "matern52")
    for own, length in zip(found.correlation(found.grid, found.grid), lengths, strict=True):
        truth = correlation(*2 * [found.grid[:, None]], torch.tensor([length]).double(), "matern52")
        assert (own - truth).abs().max() < 0.15


def test_a_tremor_is_of_one_size_in_the_units_of_the_outputs():
    # Deviations grow from a fifth to five, and a tremor has a standard deviation of 0.1 everywhere.
    grid = np.linspace(0.0, 1.0, 30)
    size = 0.2 * 25.0**grid
    slow, fast = (sample_series("matern52", length, 24, seed)[..., :1].numpy() for seed, length in ((3, 0.4), (4, 0.1)))
    demos = size[:, None] * slow + 0.1 * fast
    X, y, groups = stacked(demos, grid)
    model = TrajectoryRegressor().fit(X, y.ravel(), groups=groups)
    drawn = model.sample_demonstrations(grid[:, None], n_samples=400, random_state=0).reshape(400, 30, 1)
    thirds = [np.split(np.diff(each, 2, axis=1)[:, 2:-2], 3, axis=1) for each in (drawn, demos)]
    for of_drawn, of_demos in zip(*thirds, strict=True):
        assert 0.7 < of_drawn.std() / of_demos.std() < 1.4


@pytest.mark.parametrize("kernel", ["squared_exponential", "matern52"])
def test_share_and_squares_are_those_of_demonstrations_left_out(kernel):
    # Dense: the law of z under the others, with the blocks of the diagonal brought to one.
    series = torch.cat([sample_series("matern52", 0.4, 4)[..., :1], sample_series("matern52", 0.2, 4)[..., 1:]], dim=2)
    found, square = fitted_kernel(series, kernel)
    along, residual = found.correlation(found.grid, found.grid).numpy(), found.residual.numpy()
    (n_demos, n, d), shares = residual.shape, np.array([1.0, 0.9, 0.75, 0.6, 0.45, 0.3, 0.2, 0.1, 0.05])
    values, squares = [], []
    for share in shares:
        total = 0.0
        for own in range(n_demos):
            others = np.delete(residual, own, axis=0).reshape(n_demos - 1, -1)
            whole = share * whole_correlation(along) + (1.0 - share) * others.T @ others / (n_demos - 1)
            blocks = [np.linalg.inv(np.linalg.cholesky(whole[i : i + d, i : i + d])) for i in range(0, n * d, d)]
            unit = block_diag(*blocks) @ whole @ block_diag(*blocks).T
            total += multivariate_normal(np.zeros(n * d), unit, allow_singular=True).logpdf(residual[own].ravel())
            if share == found.share:
                squares.append(residual[own].ravel() @ np.linalg.solve(unit, residual[own].ravel()))
        values.append(total)
    assert found.share == shares[np.argmax(values)]
    assert len(set(values)) == len(shares)
    np.testing.assert_allclose(square, squares, rtol=1e-10)


def test_degrees_of_freedom_are_the_likeliest_of_demonstrations():
    rng = np.random.default_rng(0)
    for true, most, few, many in ((5.0, 20.0, 3.5, 7.5), (1e9, 20.0, 20.0, 20.0), (5.0, 4.0, 4.0, 4.0)):
        # Four demonstrations in ten have fewer steps than others.
        rows = [
            rng.standard_normal(20 if k % 10 < 4 else 40) * np.sqrt((true - 2) / rng.chisquare(true))
            for k in range(200)
        ]
        square, size = (torch.tensor([each(row) for row in rows]) for each in (lambda row: row @ row, len))
        found = time_kernel_fit.movement_df(square, size, most)
        assert few <= found <= many

        def value(df, rows=rows):
            return sum(multivariate_t(np.zeros(len(z)), (df - 2) / df * np.eye(len(z)), df=df).logpdf(z) for z in rows)

        assert value(found) >= max(value(min(most, 1.1 * found)), value(max(3.0, found / 1.1)))


@pytest.mark.filterwarnings("ignore:The demonstrations are identical")
def test_outputs_that_do_not_vary_say_nothing_of_sizes():
    demos = np.stack([sample_series("matern52", 0.3, 12, seed)[..., 0].numpy() for seed in (1, 2)], axis=2)
    still = np.concatenate([demos, np.ones_like(demos)], axis=2)
    found = []
    for each in (demos, still, np.ones_like(demos) + demos[:1]):
        X, y, groups = stacked(each)
        found.append(TrajectoryRegressor(CholeskyCovRegressor()).fit(X, y, groups=groups).df_)
    assert found[1] == pytest.approx(found[0], rel=0.2)
    assert found[2] == 200.0  # one movement, shown again and again


def test_demonstrations_count_by_the_inverse_square_that_their_size_is_expected_to_have():
    series = sample_series("matern52", 0.3, 12)
    series[::4] *= 4.0
    series[0, 5:17] = series[1, 20:25] = torch.nan
    grid, deviation = torch.from_numpy(GRID), torch.ones_like(series[0])
    found, _ = time_kernel_fit.fit_weighted(grid, series, deviation, ["matern52"], None, 20.0, is_even=False)
    square, size = fitted_kernel(series, "matern52")[1], (~series.isnan()).sum((1, 2))
    df, expected = time_kernel_fit.movement_df(square, size, 20.0), []
    # Brute force over the chi-squared variable of Student's t, by which a normal movement is multiplied.
    chi = np.linspace(0.0, 300.0, 30_001)[1:]
    inverse = chi / (df - 2.0)
    for own, n in zip(square.numpy(), size.numpy(), strict=True):
        posterior = chi2(df).logpdf(chi) + 0.5 * (n * np.log(inverse) - own * inverse)
        expected.append(np.average(inverse, weights=np.exp(posterior - posterior.max())))
    weight = (found.residual / series).square().nanmean(1).numpy()  # up to a factor for each output
    np.testing.assert_allclose(weight / weight[-1], np.outer(expected, [1.0, 1.0]) / expected[-1], rtol=1e-6)


def test_fewest_degrees_of_freedom_are_those_that_a_file_may_have():
    square, size = torch.tensor([1e-3, 1e-3, 1e6] * 5).double(), torch.full((15,), 50)
    assert time_kernel_fit.movement_df(square, size, 10.69069069069069) == 3.0


def test_large_demonstrations_widen_the_law_and_do_not_make_draws_of_all_rough(monkeypatch):
    """One in five is four times as far from the others, and trembles: most of a mean square is theirs."""
    demos = np.stack([sample_series("squared_exponential", 0.3, 30, seed)[..., 0].numpy() for seed in (1, 2)], axis=2)
    demos[::5] = 4.0 * (demos[::5] + 0.05 * np.random.default_rng(0).standard_normal(demos[::5].shape))
    X, y, groups = stacked(demos)
    rough = []
    for even in (30.0, 0.0):  # with weights, and without
        monkeypatch.setattr(time_kernel_fit, "_EVEN", even)
        model = TrajectoryRegressor(CholeskyCovRegressor()).fit(X, y, groups=groups)
        assert model.df_ < 8.0
        rough.append(np.median(np.square(np.diff(model.sample_demonstrations(X[:30], 500, 0), 2, axis=1)).mean((1, 2))))
    assert rough[0] < 0.3 * rough[1]


def test_the_module_is_differentiable_and_the_law_of_the_estimator(model):
    x = torch.tensor([[0.1], [0.45], [0.8]], dtype=torch.float64, requires_grad=True)
    mean, covariance = model.module_(x)
    np.testing.assert_allclose(covariance.detach(), model.predict_joint(x.detach().numpy())[1], rtol=1e-9)
    assert torch.autograd.gradcheck(lambda t: model.module_(t)[1], x, atol=1e-6)
    mean.sum().backward()
    assert torch.isfinite(x.grad).all()


def test_a_state_is_the_whole_module(model):
    X, y, groups = stacked(movements(seed=5))
    other = TrajectoryRegressor(shrinkage=0.4).fit(X, y, groups=groups).module_
    loaded = copy.deepcopy(model.module_)
    loaded.load_state_dict(other.state_dict())
    x = torch.tensor([[0.1], [0.5]], dtype=torch.float64)
    torch.testing.assert_close(loaded(x)[1], other(x)[1])


def test_many_noisy_observations_do_not_take_memory_for_each_step(model):
    """A factor of all entries was once repeated for each step: 30 GB here."""
    X, noise = np.linspace(0.0, 0.5, 1000)[:, np.newaxis], 1e-2
    known = model.condition(X, model.predict(X), noise_scale=noise)
    np.testing.assert_allclose(known.predict([[0.2], [0.4]]), model.predict([[0.2], [0.4]]), atol=1e-9)
    assert (known.predict_cov([[0.2]])[0].diagonal() < noise**2 + model.nugget_scale_.max() ** 2).all()


@pytest.mark.filterwarnings("error")
def test_names_of_columns_and_rounded_phases_say_nothing():
    X, y, groups = stacked(movements())
    frame = pd.DataFrame({"time": X[:, 0]})
    model = TrajectoryRegressor(CholeskyCovRegressor()).fit(frame, y, groups=groups)
    for each in (model, model.condition(frame[:1], y[:1])):
        each.predict(frame), each.predict_df(frame)
    # Phases of recordings of several lengths are equal but for rounding.
    times = [np.linspace(0.0, duration, 31) for duration in (1.1, 1.3, 0.7, 1.7, 2.3)]
    times[0] = np.delete(times[0], [12, 13, 14])
    places = [np.sin(3.0 * time / time[-1])[:, np.newaxis] + 0.1 * k for k, time in enumerate(times)]
    TrajectoryRegressor(CholeskyCovRegressor()).fit(Demonstrations(times, places))


def test_it_is_an_estimator(model):
    X, y, groups = stacked(movements())
    again = pickle.loads(pickle.dumps(model))
    np.testing.assert_array_equal(again.predict_joint(X[:5])[1], model.predict_joint(X[:5])[1])
    assert clone(model).get_params() == model.get_params()
    known = pickle.loads(pickle.dumps(model.condition([[0.5]], [[1.0, 0.5]])))
    np.testing.assert_allclose(known.predict([[0.5]]), [[1.0, 0.5]])
    pipe = make_pipeline(MinMaxScaler((0.0, 2.0)), TrajectoryRegressor(CholeskyCovRegressor(), shrinkage=0.0))
    pipe.fit(X, y, trajectoryregressor__groups=groups)
    assert pipe.predict(X).shape == y.shape
    one = TrajectoryRegressor(CholeskyCovRegressor()).fit(X, y[:, 0], groups=groups)
    assert one.predict(X[:4]).shape == (4,)
    assert one.condition([[0.5]], [1.0]).predict([[0.5]]) == pytest.approx([1.0])


def test_units_and_origin_of_time_are_no_matter():
    demos = movements()
    X, y, groups = stacked(demos)
    first = TrajectoryRegressor(CholeskyCovRegressor()).fit(X, y, groups=groups)
    second = TrajectoryRegressor(CholeskyCovRegressor()).fit(1e3 + 50.0 * X, 1e-3 * y, groups=groups)
    assert second.length_scale_ == pytest.approx(50.0 * first.length_scale_)
    at = np.array([[0.2], [0.6]])
    np.testing.assert_allclose(
        second.predict_joint(1e3 + 50.0 * at)[1], 1e-6 * first.predict_joint(at)[1], rtol=1e-4, atol=1e-10
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"groups": None}, "groups is None, must be the demonstration of each row"),
        ({"y": None}, "y is None, must be the positions"),
        ({"groups": np.zeros(180, dtype=int)}, "groups has one demonstration, must have two or more"),
        ({"X": np.zeros((180, 2)) + GRID[:, np.newaxis].repeat(6, 0)}, "X has 2 columns, must have one"),
        ({"X": np.tile(np.repeat(GRID[:15], 2), 6)[:, np.newaxis]}, "X has a time twice in demonstration 0"),
    ],
)
def test_what_cannot_be_a_movement_is_refused(arguments, message):
    X, y, groups = stacked(movements())
    arguments = {"X": X, "y": y, "groups": groups, **arguments}
    with pytest.raises(ValueError, match=message):
        TrajectoryRegressor(CholeskyCovRegressor()).fit(arguments["X"], arguments["y"], groups=arguments["groups"])


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"time_kernel": "rbf"}, "time_kernel is 'rbf', must be one of 'auto'"),
        ({"shrinkage": 1.5}, "shrinkage is 1.5, must be a finite number of at least 0"),
        ({"timing": "dtw"}, "timing is 'dtw', must be one of"),
        ({"regressor": "HGP"}, "regressor is 'HGP', must be a covariance regressor or None"),
    ],
)
def test_parameters_are_checked(parameters, message):
    X, y, groups = stacked(movements())
    with pytest.raises(ValueError, match=message):
        TrajectoryRegressor(**parameters).fit(X, y, groups=groups)


def test_demonstrations_are_no_rows_of_a_model_of_arrays(model):
    with pytest.raises(ValueError, match="X is Demonstrations, but the fit was of arrays"):
        model.score_demonstrations(make_tunnel_demonstrations(random_state=0))


def test_what_is_known_twice_is_refused(model):
    known = model.condition([[0.5]], [[1.0, 0.5]])
    with pytest.raises(ValueError, match="given twice, or is known already"):
        known.condition([[0.5]], [[1.0, np.nan]])
    with pytest.raises(ValueError, match="given twice"):
        model.condition([[0.5], [0.5]], [[1.0, 0.5], [1.0, 0.5]])
    known.condition([[0.5]], [[1.1, 0.5]], noise_scale=0.1)
    with pytest.raises(ValueError, match="known without noise: leave it out"):
        known.score_demonstrations([[0.4], [0.5]], [[1.0, 0.5], [1.0, 0.5]])
    with pytest.raises(ValueError, match="y has shape"):
        model.condition([[0.5]], [[1.0, 0.5, 2.0]])


def largest_tensor(work):
    """Number of entries of the largest tensor that ``work`` makes."""
    largest = 0

    class Watch(torch.overrides.TorchFunctionMode):
        def __torch_function__(self, function, types, args=(), kwargs=None):
            nonlocal largest
            result = function(*args, **(kwargs or {}))
            largest = max(largest, result.numel() if isinstance(result, torch.Tensor) else 0)
            return result

    with Watch():
        work()
    return largest


@pytest.mark.filterwarnings("ignore:y has 6 demonstrations")
@pytest.mark.parametrize(("n", "every"), [(400, 10), pytest.param(1000, 1, marks=pytest.mark.slow)])
def test_many_steps_of_fourteen_outputs_need_no_matrix_of_all(n, every):
    rng = np.random.default_rng(0)
    grid, n_demos, d = np.linspace(0.0, 1.0, n), 6, 14
    phases = rng.normal(size=(n_demos, 1, d)) * 0.1
    demos = np.sin(2.0 * np.pi * (grid[:, np.newaxis] + phases)) + 0.1 * rng.normal(size=(n_demos, 1, d))
    X, y, groups = stacked(demos[:, ::every], grid[::every])  # what is asked of many steps may be learned from few
    model = TrajectoryRegressor(GMMBaseline(n_components=3, n_restarts=0)).fit(X, y, groups=groups)
    at = grid[:, np.newaxis]

    def work():
        model.sample_demonstrations(at, 2, 0)
        known = model.condition(at[: n // 2 : 2], demos[0, : n // 2 : 2])
        known.predict_cov(at)
        model.score_demonstrations(at, demos[0])

    assert largest_tensor(work) <= 0.1 * (n * 14) ** 2


def test_rows_of_a_bent_movement_need_no_matrix_of_all(model):
    bent = model.condition([[0.5]], [[1.0, 0.5]])
    at, some = np.linspace(0.0, 1.0, 3000)[:, np.newaxis], slice(None, None, 300)

    def work():
        covariance, uncertainty = bent.predict_cov(at), bent.predict_uncertainty(at)
        np.testing.assert_allclose(covariance[some], bent.predict_cov(at[some]), rtol=1e-9)
        for part, alone in zip(uncertainty, bent.predict_uncertainty(at[some]), strict=True):
            np.testing.assert_allclose(part[some], alone, rtol=1e-9, atol=1e-12)

    assert largest_tensor(work) <= 0.5 * 3000**2


def test_what_is_kept_of_a_law_is_of_this_fit_and_not_pickled():
    X, y, groups = stacked(movements())
    regressor, at = GMMBaseline(n_restarts=0), GRID[:, np.newaxis]
    own = TrajectoryRegressor(regressor, shrinkage=0.4).fit(X, y, groups=groups)
    size, first = len(pickle.dumps(own)), own.sample_demonstrations(at, random_state=0)
    bent = own.condition([[0.5]], [[1.0, 0.5]])
    np.testing.assert_array_equal(bent.predict(at), own.condition([[0.5]], [[1.0, 0.5]]).predict(at[::-1])[::-1])
    assert len(pickle.dumps(own)) == size
    np.testing.assert_array_equal(own.sample_demonstrations(at, random_state=0), first)
    # Of times that are partly new, half the law is worked out, and the same.
    times = np.linspace(0.2, 0.9, 22)[:, np.newaxis]
    own.predict_joint(at)
    for mixed in (np.concatenate([at, times[:3]]), at[3:9], times):
        for part, fresh in zip(
            own.predict_joint(mixed), pickle.loads(pickle.dumps(own)).predict_joint(mixed), strict=True
        ):
            np.testing.assert_allclose(part, fresh, rtol=1e-9, atol=1e-12)
    own.fit(X, 2.0 * y, groups=groups)
    np.testing.assert_allclose(own.sample_demonstrations(at, random_state=0), 2.0 * first, rtol=1e-6, atol=1e-8)

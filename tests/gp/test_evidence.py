import math
import warnings

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_normal
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, Matern, WhiteKernel
from threadpoolctl import threadpool_limits

from torch_pbd.exceptions import NotPositiveDefiniteError
from torch_pbd.gp.evidence import EvidenceSearch, negative_log_evidence
from torch_pbd.gp.observations import Hyperparameters, Observations, condition, spacing
from torch_pbd.gp.search import fit_together
from torch_pbd.optim.batch import Status
from torch_pbd.optim.descent import minimize

LENGTH_BOUNDS = (0.02, 10.0)
SIGNALS = {
    "sine": lambda t: np.sin(6 * t),
    "tanh": lambda t: np.tanh(8 * (t - 0.4)),
    "noise": np.zeros_like,
}


def tensor(array):
    return torch.tensor(array, dtype=torch.float64)


def once(x, y):
    """Observations of rows of y, one at each input."""
    return Observations(tensor(x), tensor(np.atleast_2d(y)), torch.ones(len(x), dtype=torch.float64))


def fit_hyperparameters(observations, search):
    """Hyperparameters, loss and report of one search."""
    return fit_together([(observations, search)])[0][:3]


def noisy(signal, n, rng, n_processes=10):
    """A signal on a grid, with noise of its own for each process."""
    t = np.linspace(0, 1, n)
    return t[:, None], SIGNALS[signal](t) + 0.1 * rng.normal(size=(n_processes, n))


def best_of_scikit_learn(kernel, x, y, *, alpha=0.0, n_restarts=5):
    model = GaussianProcessRegressor(kernel, alpha=alpha, n_restarts_optimizer=n_restarts, random_state=0)
    with warnings.catch_warnings(), threadpool_limits(1):  # eight times as fast as with two threads
        warnings.simplefilter("ignore", ConvergenceWarning)  # an optimum at a bound
        return -model.fit(x, y).log_marginal_likelihood_value_


def amplitude_times(correlation):
    return ConstantKernel(1.0, (1e-6, 1e5)) * correlation


WHITE = WhiteKernel(0.1, (1e-9, 1e5))


@pytest.mark.parametrize(
    ("kernel", "oracle"), [("squared_exponential", RBF), ("matern52", lambda length: Matern(length, nu=2.5))]
)
@pytest.mark.parametrize("length_scale", [[0.3], [0.3, 2.0]])
def test_evidence_is_that_of_scikit_learn(kernel, oracle, length_scale, rng):
    x, y = rng.uniform(size=(12, len(length_scale))), rng.normal(size=12)
    counts = rng.integers(1, 9, size=12).astype(float)
    amplitude, noise_scale = 1.7, 0.4
    hyperparameters = Hyperparameters(
        tensor([length_scale]), tensor([amplitude]), tensor([noise_scale**2 / amplitude**2])
    )
    for n in (np.ones(12), counts):
        observations = Observations(tensor(x), tensor(y[None]), tensor(n))
        model = GaussianProcessRegressor(
            ConstantKernel(amplitude**2) * oracle(length_scale), alpha=noise_scale**2 / n, optimizer=None
        ).fit(x, y)
        found = negative_log_evidence(observations, hyperparameters, kernel)
        np.testing.assert_allclose(found, [-model.log_marginal_likelihood_value_], rtol=1e-9)


def test_evidence_of_means_is_that_of_all_rows_but_for_their_scatter(rng):
    x, counts, amplitude, noise_scale = np.linspace(0, 1, 4), np.array([1, 2, 5, 3]), 1.3, 0.5
    rows = [rng.normal(size=n) for n in counts]
    gram = amplitude**2 * RBF(0.4)(x[:, None])
    index = np.repeat(np.arange(4), counts)
    covariance = gram[np.ix_(index, index)] + noise_scale**2 * np.eye(counts.sum())
    all_rows = -multivariate_normal(cov=covariance).logpdf(np.concatenate(rows))
    scatter = sum(
        0.5 * ((n - 1) * math.log(2 * math.pi * noise_scale**2) + math.log(n) + n * row.var() / noise_scale**2)
        for n, row in zip(counts, rows, strict=True)
    )
    means = Observations(tensor(x[:, None]), tensor([[float(row.mean()) for row in rows]]), tensor(counts))
    hyperparameters = Hyperparameters(tensor([[0.4]]), tensor([amplitude]), tensor([(noise_scale / amplitude) ** 2]))
    assert negative_log_evidence(means, hyperparameters).item() == pytest.approx(all_rows - scatter, rel=1e-9)


def test_evidence_is_not_a_number_only_where_the_kernel_matrix_is_singular(generator):
    inputs = torch.linspace(0, 1, 30, dtype=torch.float64)[:, None]
    targets = torch.randn(2, 30, dtype=torch.float64, generator=generator)
    hyperparameters = Hyperparameters(tensor([[5.0], [0.02]]), tensor([1.0, 1.0]), tensor([0.0, 0.0]))
    found = negative_log_evidence(Observations(inputs, targets, torch.ones(30).double()), hyperparameters)
    assert found.isnan().tolist() == [True, False]


@pytest.mark.parametrize(
    ("signal", "n"),
    [
        pytest.param(signal, (50, 10)[(place + other) % 2], marks=[pytest.mark.slow] if other else [])
        for other in (0, 1)
        for place, signal in enumerate(SIGNALS)
    ],
)
def test_search_finds_an_evidence_as_high_as_scikit_learn_with_restarts(signal, n, rng):
    x, y = noisy(signal, n, rng)
    found, loss, _ = fit_hyperparameters(once(x, y), EvidenceSearch(length_scale_bounds=LENGTH_BOUNDS))
    expected = [best_of_scikit_learn(amplitude_times(RBF(0.3, LENGTH_BOUNDS)) + WHITE, x, row) for row in y]
    assert (loss.numpy() - expected).max() < 1e-3  # nats
    # The loss that is returned is that of the hyperparameters that are returned.
    np.testing.assert_allclose(negative_log_evidence(once(x, y), found), loss, rtol=1e-9, atol=1e-9)


def smooth_draw(length_scale, n, rng):
    t = np.linspace(0, 1, n)[:, None]
    return np.linalg.cholesky(RBF(length_scale)(t) + 1e-9 * np.eye(n)) @ rng.normal(size=n)


@pytest.mark.parametrize("noise", [0.1, 0.01])
def test_search_at_growing_resolution_misses_no_short_length_scale(noise, rng):
    """At 150 inputs the search begins with 32 nodes, which carry a sixth of the range."""
    n, t = 150, np.linspace(0, 1, 150)
    signals = {
        "slow": np.sin(6 * t),
        "slow, with a faint wiggle": np.sin(3 * t) + 0.2 * np.sin(2 * np.pi * 25 * t),
        "fast": np.sin(2 * np.pi * 15 * t),
        "near the spacing": np.sin(3 * t) + 0.3 * np.sin(2 * np.pi * 45 * t),
        "a draw": smooth_draw(0.05, n, rng),
        "a short draw": smooth_draw(0.02, n, rng),
    }
    y = np.stack(list(signals.values())) + noise * rng.normal(size=(len(signals), n))
    bounds = (0.75 / (n - 1), 10.0)
    # One by one: together, a process that needs a finer level would take the others along.
    search = EvidenceSearch(length_scale_bounds=bounds)
    loss = torch.cat([fit_hyperparameters(once(t[:, None], row), search)[1] for row in y])
    # Its restarts seldom find the optimum at a short length scale: it is started at one too.
    starts = [amplitude_times(RBF(scale, bounds)) + WHITE for scale in (0.3, 0.02)]
    expected = [min(best_of_scikit_learn(kernel, t[:, None], row, n_restarts=1) for kernel in starts) for row in y]
    assert dict(zip(signals, loss.numpy() - expected < 1e-3, strict=True)) == dict.fromkeys(signals, True)


@pytest.mark.parametrize("share", [0.5, 1.0])
def test_of_many_processes_those_that_need_it_go_to_a_finer_level(share, rng):
    """So many that not all of them are taken along; at a share of one no process stays at the coarsest level."""
    n, b, t = 300, 12, np.linspace(0, 1, 300)
    fast = np.arange(b) < share * b
    y = np.where(fast[:, None], np.sin(2 * np.pi * 20 * t), np.sin(5 * t)) + 0.1 * rng.normal(size=(b, n))
    bounds = (0.75 / (n - 1), 10.0)
    found, loss, _ = fit_hyperparameters(once(t[:, None], y), EvidenceSearch(length_scale_bounds=bounds))
    np.testing.assert_allclose(negative_log_evidence(once(t[:, None], y), found), loss, rtol=1e-9, atol=1e-8)
    assert (found.length_scale[:, 0].numpy() < 0.05).tolist() == fast.tolist()


@pytest.mark.parametrize("kernel", ["squared_exponential", "matern32", "matern52"])
def test_search_with_a_length_scale_for_each_input_is_as_good_as_scikit_learn(kernel, rng):
    x = rng.uniform(size=(40, 2))
    y = np.sin(6 * x[:, 0]) + 0.1 * rng.normal(size=(2, 40))
    search = EvidenceSearch(kernel, LENGTH_BOUNDS)
    found, loss, _ = fit_hyperparameters(once(x, y), search)
    start = [0.3, 0.3]
    oracle = {
        "squared_exponential": RBF(start, LENGTH_BOUNDS),
        "matern32": Matern(start, LENGTH_BOUNDS, nu=1.5),
        "matern52": Matern(start, LENGTH_BOUNDS, nu=2.5),
    }[kernel]
    expected = [best_of_scikit_learn(amplitude_times(oracle) + WHITE, x, row, n_restarts=2) for row in y]
    assert (loss.numpy() - expected).max() < 1e-3
    assert (found.length_scale[:, 1] > 5 * found.length_scale[:, 0]).all()  # y does not depend on the second input


@pytest.mark.parametrize("noise_scale", [0.05, 0.2])
def test_search_under_a_fixed_noise_is_as_good_as_scikit_learn(noise_scale, rng):
    x, y = noisy("sine", 20, rng, n_processes=3)
    fixed = torch.full((3,), noise_scale, dtype=torch.float64)
    search = EvidenceSearch(length_scale_bounds=LENGTH_BOUNDS, noise_scale=fixed)
    found, loss, _ = fit_hyperparameters(once(x, y), search)
    kernel = amplitude_times(RBF(0.3, LENGTH_BOUNDS))
    expected = [best_of_scikit_learn(kernel, x, row, alpha=noise_scale**2) for row in y]
    assert (loss.numpy() - expected).max() < 1e-3
    torch.testing.assert_close(found.amplitude * found.noise_ratio.sqrt(), fixed, rtol=1e-9, atol=0)


def test_a_fixed_noise_far_below_the_signal_does_not_bind_the_amplitude(rng):
    t = np.linspace(0, 1, 8)
    y = np.sin(6 * t + rng.uniform(size=(3, 1)))
    exact, tiny = (
        fit_hyperparameters(once(t[:, None], y), EvidenceSearch(noise_scale=torch.full((3,), noise).double()))[0]
        for noise in (0.0, 1e-7)
    )
    torch.testing.assert_close(tiny.amplitude, exact.amplitude, rtol=1e-2, atol=0)
    torch.testing.assert_close(tiny.length_scale, exact.length_scale, rtol=1e-2, atol=0)


def test_search_with_a_fixed_length_scale_is_as_good_as_scikit_learn(rng):
    x, y = noisy("tanh", 20, rng, n_processes=3)
    found, loss, _ = fit_hyperparameters(once(x, y), EvidenceSearch(length_scale=tensor([0.25])))
    kernel = amplitude_times(RBF(0.25, "fixed")) + WHITE
    expected = [best_of_scikit_learn(kernel, x, row) for row in y]
    assert found.length_scale.tolist() == [[0.25]] * 3
    assert (loss.numpy() - expected).max() < 1e-3


def test_search_without_noise_interpolates(rng):
    t = np.linspace(0, 1, 10)
    observations = once(t[:, None], np.sin(6 * t + rng.uniform(size=(4, 1))))
    found, _, _ = fit_hyperparameters(observations, EvidenceSearch(noise_scale=torch.zeros(4).double()))
    gp, _ = condition(observations, found)
    assert found.noise_ratio.tolist() == [0.0] * 4
    # A kernel matrix without noise is solved to about its condition times 1e-16.
    torch.testing.assert_close(gp(observations.inputs).mT, observations.targets, rtol=0, atol=1e-5)


def test_with_all_fixed_only_the_amplitude_is_found_and_it_is_the_closed_form(rng):
    x, y = np.linspace(0, 1, 6)[:, None], rng.normal(size=6)
    search = EvidenceSearch(length_scale=tensor([0.1]), noise_scale=tensor([0.0]))
    found, _, _ = fit_hyperparameters(once(x, y), search)
    assert found.amplitude.item() ** 2 == pytest.approx(y @ np.linalg.solve(RBF(0.1)(x), y) / 6, rel=1e-9)


@pytest.mark.parametrize("noise_scale", [None, 0.0, 0.1])
def test_targets_that_are_all_zero_give_finite_hyperparameters_and_zeros(noise_scale, rng):
    x, y = noisy("sine", 10, rng, n_processes=2)
    y[0] = 0.0
    fixed = None if noise_scale is None else torch.full((2,), noise_scale).double()
    found, loss, _ = fit_hyperparameters(once(x, y), EvidenceSearch(length_scale_bounds=(0.1, 1.0), noise_scale=fixed))
    for value in (found.length_scale, found.amplitude, found.noise_ratio, loss):
        assert value.isfinite().all()
    gp, _ = condition(once(x, y), found)
    mean = gp(tensor([[0.33], [5.0]]))
    assert mean[:, 0].tolist() == [0.0, 0.0]
    assert gp.type1(tensor([[0.33], [5.0]])).isfinite().all()


def test_the_processes_of_a_batch_do_not_disturb_each_other(rng):
    x, y = noisy("sine", 10, rng, n_processes=40)  # more than are fitted in one block
    y[3] *= 1e6
    y[4] = 0.0
    together, loss, _ = fit_hyperparameters(once(x, y), EvidenceSearch())
    for row in (0, 3, 4, 31, 32, 39):
        alone, loss_alone, _ = fit_hyperparameters(once(x, y[row]), EvidenceSearch())
        # Batched products may round otherwise: the same optimum to the tolerance of the search.
        assert loss[row].item() == pytest.approx(loss_alone.item(), abs=1e-6)
        torch.testing.assert_close(together.amplitude[row], alone.amplitude[0], rtol=1e-2, atol=0)


def test_a_noise_that_is_fixed_belongs_to_its_process(rng):
    x, y = noisy("sine", 10, rng, n_processes=40)
    fixed = torch.linspace(0.05, 0.5, 40, dtype=torch.float64)
    found, _, _ = fit_hyperparameters(once(x, y), EvidenceSearch(noise_scale=fixed))
    torch.testing.assert_close(found.amplitude * found.noise_ratio.sqrt(), fixed, rtol=1e-9, atol=0)


def test_noise_fixed_at_zero_for_some_processes_only_is_an_error(rng):
    x, y = noisy("sine", 10, rng, n_processes=3)
    with pytest.raises(ValueError, match="two searches"):
        fit_hyperparameters(once(x, y), EvidenceSearch(noise_scale=tensor([0.0, 0.3, 0.0])))


def test_targets_in_another_unit_change_the_amplitude_alone(rng):
    x, y = noisy("tanh", 20, rng, n_processes=3)
    found, loss, _ = fit_hyperparameters(once(x, y), EvidenceSearch())
    scaled, scaled_loss, _ = fit_hyperparameters(once(x, 1000 * y), EvidenceSearch())
    # Where two searches stop differs by the tolerance of the search, 1e-6 of the loss.
    torch.testing.assert_close(scaled.amplitude, 1000 * found.amplitude, rtol=1e-2, atol=0)
    torch.testing.assert_close(scaled.length_scale, found.length_scale, rtol=1e-2, atol=0)
    np.testing.assert_allclose(scaled_loss, loss + 20 * math.log(1000), rtol=1e-6)


def test_more_restarts_are_never_worse(rng):
    x, y = noisy("noise", 10, rng, n_processes=20)
    losses = [fit_hyperparameters(once(x, y), EvidenceSearch(n_restarts=n))[1] for n in (0, 2, 5)]
    assert (losses[0] >= losses[1] - 1e-3).all()
    assert (losses[1] >= losses[2] - 1e-3).all()


def test_a_search_that_is_cut_short_says_so(rng):
    x, y = noisy("sine", 20, rng)
    _, _, report = fit_hyperparameters(once(x, y), EvidenceSearch(max_iter=1))
    assert report.status is Status.MAX_ITER
    assert report.loss_curve[0] >= report.loss_curve[1] == report.loss


def test_a_search_without_any_sound_start_is_an_error(rng):
    x, y = noisy("sine", 50, rng)
    search = EvidenceSearch(length_scale=tensor([100.0]), noise_scale=torch.zeros(10).double())
    with pytest.raises(NotPositiveDefiniteError, match="shorter length_scale"):
        fit_hyperparameters(once(x, y), search)


def total_variation(values):
    return np.abs(np.diff(values)).sum(-1)


@pytest.mark.parametrize("noise_scale", [None, 0.0])
def test_a_bound_at_the_spacing_keeps_needles_out(noise_scale, rng):
    """White noise can be explained by a process that is zero between any two inputs."""
    n_processes, n = 40, 12
    x, y = np.linspace(0, 1, n)[:, None], rng.normal(size=(n_processes, n))
    fixed = None if noise_scale is None else torch.full((n_processes,), noise_scale).double()
    between = tensor(0.5 * (x[1:] + x[:-1]))
    dense = tensor(np.linspace(0, 1, 2001)[:, None])
    needles, variation = [], []
    for shortest in (1e-3, 0.75 * spacing(tensor(x))):
        search = EvidenceSearch(length_scale_bounds=(shortest, 10.0), noise_scale=fixed)
        gp, _ = condition(once(x, y), fit_hyperparameters(once(x, y), search)[0])
        with torch.no_grad():
            at, off, curve = gp(tensor(x)).mT, gp(between).mT, gp(dense).mT
        needles.append(((off.abs().amax(1) < 1e-3) & (at.abs().amax(1) > 0.1)).sum())
        variation.append((total_variation(curve.numpy()) / total_variation(y)).max())
    assert needles[0] >= 5
    assert needles[1] == 0
    assert variation[1] < 1.3 < variation[0]


def test_lbfgs_on_the_evidence_reaches_the_optimum_of_the_search(rng):
    x, y = noisy("sine", 40, rng, n_processes=3)
    found, expected, _ = fit_hyperparameters(once(x, y), EvidenceSearch(length_scale_bounds=LENGTH_BOUNDS, tol=1e-6))
    logs = torch.cat([found.length_scale, found.amplitude[:, None], found.noise_ratio[:, None]], dim=1).log()
    for row in range(3):
        z = (logs[row] + 0.3).requires_grad_()

        def loss(z=z, row=row):
            scale, amplitude, ratio = z.exp().split(1)
            return negative_log_evidence(once(x, y[row]), Hyperparameters(scale[None], amplitude, ratio)).sum()

        report = minimize(loss, [z], tol=1e-7)
        assert report.loss == pytest.approx(expected[row].item(), abs=1e-6)
        torch.testing.assert_close(z.detach(), logs[row], rtol=0, atol=1e-2)


def test_a_process_that_ends_at_the_shortest_length_scale_of_a_level_goes_on_at_the_next(rng):
    """Its best point on the grid is no shorter, and its residual white; by the next level it gains 1.3 nats."""
    t = np.linspace(0, 1, 300)
    y = np.sin(12 * np.pi * t**2) + 0.0016 * rng.normal(size=300)
    bounds = (0.75 / 299, 10.0)
    found, _, _ = fit_hyperparameters(once(t[:, None], y), EvidenceSearch(length_scale_bounds=bounds))
    assert 0.04 < found.length_scale.item() < 0.049  # the level of 88 nodes ends at 0.05


def test_a_restart_finds_what_the_deepest_valley_of_the_grid_does_not():
    """The grid has one length scale for all inputs: with one for each another valley may be the deepest."""
    rng = np.random.RandomState(10)
    x = rng.uniform(size=(80, 3))
    y = np.sin(x @ [1.26, 1.13, 0.21] + 0.42) + np.sin(7 * x[:, 0]) * np.cos(5 * x[:, 1]) + 0.54 * rng.normal(size=80)
    alone, again = (fit_hyperparameters(once(x, y), EvidenceSearch(n_restarts=n))[1] for n in (0, 2))
    assert (again < alone - 5.0).all()


def test_jobs_of_different_bounds_find_together_what_each_finds_alone():
    """A trend with a wiggle: from a grid of length scales beyond its bound a process would start at the bound."""
    t = np.linspace(0, 1, 40)
    observations = once(
        t[:, None], 3 * t**2 + 0.1 * np.sin(8 * np.pi * t) + 0.05 * np.random.default_rng(2).normal(size=40)
    )
    jobs = [
        (observations, EvidenceSearch(length_scale_bounds=(0.02, longest), n_restarts=0)) for longest in (10.0, 0.35)
    ]
    for together, job in zip(fit_together(jobs), jobs, strict=True):
        assert together.loss.item() == pytest.approx(fit_together([job])[0].loss.item(), abs=1e-3)

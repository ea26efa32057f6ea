import numpy as np
import pytest
import torch
from scipy.stats import chi

from torch_pbd.gp.observations import neighbourhoods
from torch_pbd.models.training import TrainingSet, empirical_tril, mean_over_geometric, pooled_tril

COUNTS = {
    "equal": [5] * 8,
    "ragged": [1, 2, 3, 4, 5, 6, 7, 8, 9, 20, 33],
    "ones": [1] * 30,
    "skewed": [1000] + [1] * 50,
}


def tensor(array):
    return torch.tensor(array, dtype=torch.float64)


def training_set(counts, d, rng):
    """Rows in random order; each input's at its own place and scale."""
    index = rng.permutation(np.repeat(np.arange(len(counts)), counts))
    inputs = np.sort(rng.uniform(size=len(counts)))[:, None]
    y = index[:, None] + (1 + index[:, None]) * rng.normal(size=(len(index), d)) @ rng.normal(size=(d, d))
    return TrainingSet(tensor(inputs[index]), tensor(y), tensor(inputs), torch.tensor(index))


def rows_of(training, values):
    return [values[(training.index == i).numpy()] for i in range(len(training.inputs))]


@pytest.mark.parametrize("counts", COUNTS.values(), ids=COUNTS)
@pytest.mark.parametrize("d", [1, 2, 9])
def test_counts_means_and_scatter_are_those_of_numpy(counts, d, rng):
    training = training_set(counts, d, rng)
    residual = rng.normal(size=(len(training.y), d))
    root = training.scatter_root(tensor(residual)).numpy()
    assert training.counts.tolist() == counts
    assert root.shape[-1] <= d
    for i, (y, w) in enumerate(zip(rows_of(training, training.y), rows_of(training, residual), strict=True)):
        np.testing.assert_allclose(training.means[i], y.numpy().mean(0), rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(root[i] @ root[i].T, w.T @ w, rtol=1e-9, atol=1e-11)


def test_a_scatter_of_very_different_units_keeps_its_small_output(rng):
    training = training_set([6, 50], 2, rng)
    residual = rng.normal(size=(56, 2)) * [1.0, 1e-12]
    root = training.scatter_root(tensor(residual)).numpy()
    for i, w in enumerate(rows_of(training, residual)):
        assert np.square(root[i, 1]).sum() == pytest.approx(np.square(w[:, 1]).sum(), rel=1e-9)


def test_the_scatter_is_differentiable(rng):
    training = training_set([1, 2, 7], 2, rng)
    residual = tensor(rng.normal(size=(10, 2))).requires_grad_()

    def scatter(residual):
        root = training.scatter_root(residual)
        return root @ root.mT

    assert torch.autograd.gradcheck(scatter, residual)


@pytest.mark.parametrize("d", [1, 2, 9])
@pytest.mark.parametrize("n_rows", [10, 50])
def test_empirical_factors_are_those_of_numpy(d, n_rows, rng):
    training = training_set([n_rows, n_rows + 1, 2 * n_rows], d, rng)
    tril = empirical_tril(training)
    for i, y in enumerate(rows_of(training, training.y)):
        expected = np.linalg.cholesky(np.atleast_2d(np.cov(y.numpy().T)))
        # The covariance of ten rows in nine outputs has a condition of 1e6 or so, which NumPy's product squares.
        np.testing.assert_allclose(tril[i], expected, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("d", [1, 2, 9])
@pytest.mark.parametrize("n_inputs", [1, 4])
def test_the_pooled_covariance_is_the_weighted_average(d, n_inputs, rng):
    training = training_set([12] * n_inputs + [1, 3], d, rng)
    groups = [y.numpy() for y in rows_of(training, training.y)]
    scatter = sum((y - y.mean(0)).T @ (y - y.mean(0)) for y in groups)
    tril = pooled_tril(training).numpy()
    np.testing.assert_allclose(tril @ tril.T, scatter / sum(len(y) - 1 for y in groups), rtol=1e-9)


@pytest.mark.parametrize("d", [1, 2, 9])
def test_where_no_input_repeats_the_pooled_covariance_is_that_of_all_rows(d, rng):
    training = training_set([1] * 30, d, rng)
    tril = pooled_tril(training).numpy()
    np.testing.assert_allclose(tril @ tril.T, np.atleast_2d(np.cov(training.y.numpy().T)), rtol=1e-9)


def test_the_pooled_covariance_of_one_row_is_zero():
    one = torch.ones(1, 2, dtype=torch.float64)
    training = TrainingSet(one, one, one, torch.zeros(1, dtype=torch.long))
    assert (pooled_tril(training) == 0).all()


@pytest.mark.parametrize(("d", "n_rows"), [(1, 1), (2, 2), (9, 3), (9, 9)])
def test_few_rows_are_shrunk_to_the_pooled_covariance(d, n_rows, rng):
    training = training_set([n_rows, 40, n_rows, 40], d, rng)
    pooled = pooled_tril(training).numpy()
    pooled = pooled @ pooled.T
    tril = empirical_tril(training).numpy()
    for i, y in enumerate(rows_of(training, training.y)):
        residual = (y - y.mean(0)).numpy()
        scatter, degrees = residual.T @ residual, len(y) - 1
        if len(y) == n_rows:
            scatter, degrees = scatter + (d + 1) * pooled, degrees + d + 1
        np.testing.assert_allclose(tril[i] @ tril[i].T, scatter / degrees, rtol=1e-9, atol=1e-10 * scatter.max())
        assert (np.diag(tril[i]) > 0).all()


@pytest.mark.parametrize(("d", "n_rows"), [(1, 2), (2, 3), (2, 6), (9, 10), (9, 30)])
def test_bias_correction_divides_by_the_mean_of_a_chi_distribution(d, n_rows, rng):
    """The entries of the factor's diagonal are chi distributed (Bartlett), K - 1 to K - d degrees of freedom."""
    training = training_set([n_rows] * 3, d, rng)
    raw, corrected = empirical_tril(training), empirical_tril(training, bias_correction=True)
    degrees = n_rows - 1
    expectation = chi(degrees - np.arange(d)).mean() / np.sqrt(degrees)
    np.testing.assert_allclose(corrected * tensor(expectation), raw, rtol=1e-9, atol=1e-14)


@pytest.mark.parametrize("max_inputs", [1, 4, 7])
def test_merging_keeps_all_rows_and_their_total(max_inputs, rng):
    training = training_set([1, 2, 3, 4, 5, 6, 7, 8], 2, rng)
    merged = training.merged(max_inputs)
    assert len(merged.inputs) <= max_inputs
    assert merged.x is training.x
    assert merged.y is training.y
    assert merged.counts.sum() == training.counts.sum() == 36
    weight = merged.counts[:, None]
    torch.testing.assert_close((weight * merged.means).sum(0), training.y.sum(0), rtol=1e-9, atol=1e-9)
    torch.testing.assert_close((weight * merged.inputs).sum(0), training.x.sum(0), rtol=1e-9, atol=0)


def test_merging_takes_the_rows_of_a_neighbourhood_together(rng):
    training = training_set([1, 2, 3, 4, 5, 6, 7, 8], 2, rng)
    merged = training.merged(4)
    group = neighbourhoods(training.inputs, 4)
    for number in range(4):
        rows = (group[training.index] == number).numpy()
        assert (merged.index.numpy()[rows] == number).all()
        assert merged.counts[number] == rows.sum()
        np.testing.assert_allclose(merged.inputs[number], training.x.numpy()[rows].mean(0), rtol=1e-9)


def test_inputs_that_fit_are_not_merged(rng):
    training = training_set([2, 2, 2], 1, rng)
    assert training.merged(3) is training


@pytest.mark.parametrize("counts", [[700, 1, 999], [1] * 1700])
def test_the_residual_is_that_of_all_rows_whatever_they_share(counts, rng):
    """The mean is evaluated for a bounded number of inputs at a time, and once where rows repeat one."""
    training, asked = training_set(counts, 2, rng), []

    def mean(x):
        asked.append(len(x))
        return torch.cat([x.sin(), x.square()], dim=1)

    expected = training.y - torch.cat([training.x.sin(), training.x.square()], dim=1)
    torch.testing.assert_close(training.residual(mean), expected, rtol=0, atol=0)
    assert sum(asked) == len(counts)
    assert max(asked) <= 1024
    torch.testing.assert_close(training.merged(2).residual(mean), expected, rtol=0, atol=0)


def test_the_mean_over_the_geometric_mean_is_that_of_chi_variables():
    counts, n_outputs = [2, 3, 4, 7, 50], 3
    index = torch.repeat_interleave(torch.arange(5), torch.tensor(counts))
    inputs = torch.arange(5, dtype=torch.float64)[:, None]
    training = TrainingSet(inputs[index], torch.zeros(len(index), n_outputs, dtype=torch.float64), inputs, index)
    expected = np.ones((5, n_outputs))
    for i, count in enumerate(counts[2:], start=2):
        laws = [chi(count - 1 - column) for column in range(n_outputs)]
        expected[i] = [law.mean() / np.exp(law.expect(np.log)) for law in laws]
    np.testing.assert_allclose(mean_over_geometric(training), expected, rtol=1e-6)

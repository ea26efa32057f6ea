import numpy as np
import pytest
import torch
from scipy.linalg import block_diag

from torch_pbd.kernels import correlation
from torch_pbd.models.heteroscedastic.processes import ProcessFamily
from torch_pbd.models.heteroscedastic.regression import NoiseCorrelation, bidiagonal
from torch_pbd.models.heteroscedastic.search import Search, SearchOptions
from torch_pbd.models.heteroscedastic.steps import fit_mean
from torch_pbd.models.training import TrainingSet


def search_of(family, d):
    return Search(family, d, SearchOptions())


def rows_at(inputs, means, counts):
    """So many rows at each input, all of them the mean there."""
    index = torch.arange(len(inputs)).repeat_interleave(counts)
    return TrainingSet(inputs[index], means[index], inputs, index)


def prior_gram(family, theta, x, other):
    """Kernel matrix of all outputs at inputs, one output after another."""
    amplitude, length_scale = family.amplitude_of(theta), family.length_scale_of(theta)
    blocks = correlation(x, other, length_scale, family.kernel).numpy()
    return block_diag(*(float(a) ** 2 * block for a, block in zip(amplitude, blocks, strict=True)))


@pytest.mark.parametrize("whitened", [None, "by bands", "by matrices"])
@pytest.mark.parametrize("d", [1, 3])
def test_the_mean_is_a_dense_regression_of_all_outputs_under_their_noise(d, whitened, inputs, rng):
    """Kernel matrix over outputs and inputs, noise of blocks that differ between inputs: generalized least squares."""
    n = len(inputs)
    family = ProcessFamily(inputs, 0.3, 1.2, 0.0, kernel="matern32", exact=True)
    tril = np.tril(rng.normal(size=(n, d, d)), -1) + np.eye(d) * rng.uniform(0.2, 1.5, size=(n, 1, d))
    counts = rng.integers(1, 6, size=n)
    along = np.exp(-np.abs((inputs - inputs.T).numpy()) / 0.2) if whitened else np.eye(n)
    whitener = torch.tensor(np.linalg.inv(np.linalg.cholesky(along))).expand(d, n, n)
    whitener = bidiagonal(whitener) if whitened == "by bands" else whitener
    roots = block_diag(*(tril / np.sqrt(counts)[:, np.newaxis, np.newaxis]))
    noise = roots @ np.kron(along, np.eye(d)) @ roots.T
    means = np.sin(3.0 * inputs.numpy() + np.arange(d)) + 0.3 * rng.normal(size=(n, d))
    noise_along = NoiseCorrelation(whitener, torch.ones(d, n).double()) if whitened else None
    rows = rows_at(inputs, torch.tensor(means), torch.tensor(counts))
    found = fit_mean(search_of(family, d), rows, torch.tensor(tril), noise_along)
    order = np.arange(n * d).reshape(d, n).T.ravel()  # input by input instead of output by output
    x = torch.tensor(rng.uniform(-0.8, 0.8, size=(5, 1)))
    theta = found.processes.theta.detach()
    gram = prior_gram(family, theta, inputs, inputs)[np.ix_(order, order)]
    cross = prior_gram(family, theta, inputs, x)[order]
    gain = np.linalg.solve(gram + noise, cross).T
    expected = (gain @ means.ravel()).reshape(d, 5).T
    covariance = (prior_gram(family, theta, x, x) - gain @ cross).reshape(d, 5, d, 5)
    mean, error = found.at(x)
    # The kernel matrix of the inducing inputs has a jitter of 1e-13, over noise of 1e-2.
    np.testing.assert_allclose(mean, expected, rtol=0, atol=1e-7)
    np.testing.assert_allclose(error, np.stack([covariance[:, t, :, t] for t in range(5)]), rtol=0, atol=1e-7)


def test_away_from_the_inducing_inputs_the_error_is_the_whole_prior_variance(inputs):
    family = ProcessFamily(inputs[::3], 0.3, 1.2, 0.0)
    tril = 0.1 * torch.eye(2, dtype=torch.float64).expand(9, 2, 2)
    means = torch.cat([torch.sin(4.0 * inputs), torch.cos(9.0 * inputs)], dim=1)
    found = fit_mean(search_of(family, 2), rows_at(inputs, means, torch.full((9,), 4)), tril, None)
    mean, error = found.at(torch.tensor([[50.0]], dtype=torch.float64))
    assert torch.equal(mean, torch.zeros(1, 2).double())
    torch.testing.assert_close(
        error[0], torch.diag(family.amplitude_of(found.processes.theta).square()), rtol=1e-12, atol=0
    )


def test_hyperparameters_of_an_output_do_not_depend_on_the_others(inputs, rng):
    family = ProcessFamily(inputs, 0.3, 1.2, 0.0, exact=True)
    means = torch.tensor(np.sin(3.0 * inputs.numpy() + np.arange(2)) + 0.1 * rng.normal(size=(9, 2)))
    tril = 0.2 * torch.eye(2, dtype=torch.float64).expand(9, 2, 2)
    counts = torch.ones(9, dtype=torch.long)
    both = fit_mean(search_of(family, 2), rows_at(inputs, means, counts), tril, None)
    for i in (0, 1):
        alone = fit_mean(search_of(family, 1), rows_at(inputs, means[:, [i]], counts), tril[:, :1, :1], None)
        torch.testing.assert_close(alone.processes.theta[0], both.processes.theta[i], rtol=0, atol=1e-6)

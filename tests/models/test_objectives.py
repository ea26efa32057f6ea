import math

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_normal
from sklearn.gaussian_process.kernels import RBF

from torch_pbd.models import VARIANCE_FLOOR, with_floor
from torch_pbd.models.costs import LatentValues, Likelihood
from torch_pbd.models.links import CholeskyLink, WishartLink, padded
from torch_pbd.models.training import TrainingSet
from torch_pbd.optim.descent import minimize

COUNTS = {"aligned": [7] * 5, "ragged": [1, 2, 3, 10, 1], "not aligned": [1] * 12}


def tensor(array):
    return torch.tensor(array, dtype=torch.float64)


def wishart_root(deviation, prior_root, matrix):
    return WishartLink(prior_root, scale_matrix_tril=matrix).root(deviation)


def gaussian_nll(root, scatter_root, counts):
    return Likelihood(CholeskyLink(torch.eye(root.shape[1]).to(root), False), scatter_root, counts, 1.0).at_root(root)


def training_set(counts, d, rng):
    index = rng.permutation(np.repeat(np.arange(len(counts)), counts))
    inputs = np.linspace(0, 1, len(counts))[:, None]
    return TrainingSet(
        tensor(inputs[index]), tensor(rng.normal(size=(len(index), d))), tensor(inputs), tensor(index).long()
    )


@pytest.mark.parametrize("counts", COUNTS.values(), ids=COUNTS)
@pytest.mark.parametrize("d", [1, 2, 9])
def test_likelihood_is_the_sum_over_all_rows_of_scipy(counts, d, rng):
    training = training_set(counts, d, rng)
    root = rng.normal(size=(len(counts), d, 3 * d))
    residual = training.y.numpy()
    expected = -sum(
        multivariate_normal(cov=root[i] @ root[i].T).logpdf(w)
        for i, w in zip(training.index.tolist(), residual, strict=True)
    )
    found = gaussian_nll(tensor(root), training.scatter_root(training.y), training.counts)
    # The floor of 1e-12 of the trace weighs in with its ratio to the smallest eigenvalue.
    assert found.item() == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("d", [1, 2, 9])
def test_the_floor_is_relative_to_the_variances_and_positive_without_any(d, rng):
    for root in (rng.normal(size=(3, d, d)), np.zeros((3, d, d))):
        floored = with_floor(tensor(1e6 * root))
        added = (floored @ floored.mT).numpy() - 1e12 * root @ root.swapaxes(-1, -2)
        expected = VARIANCE_FLOOR * (1 + 1e12 * np.square(root).sum((1, 2)))
        # Seen beside numbers of 1e12, which are rounded at 1e-3.
        np.testing.assert_allclose(added, expected[:, None, None] * np.eye(d), rtol=1e-9, atol=0.05 * root.max())


def loss_of(training):
    scatter_root = training.scatter_root(training.y)
    return lambda root: gaussian_nll(root, scatter_root, training.counts)


@pytest.mark.parametrize("d", [1, 2])
def test_the_likelihood_of_a_wishart_process_is_differentiable(d, rng):
    training = training_set([1, 2, 5], d, rng)
    loss = loss_of(training)
    prior_root = padded(2.0 * torch.eye(d).double(), d + 1)
    deviation = tensor(rng.normal(size=(3, (d + 1) * d))).requires_grad_()
    matrix = tensor(np.eye(d) + 0.3 * rng.normal(size=(d, d))).requires_grad_()
    assert torch.autograd.gradcheck(lambda u, m: loss(wishart_root(u, prior_root, m)), (deviation, matrix))


@pytest.mark.parametrize("log_diagonal", [False, True])
@pytest.mark.parametrize("d", [1, 2])
def test_the_likelihood_of_a_cholesky_factor_is_differentiable(log_diagonal, d, rng):
    training = training_set([1, 2, 5], d, rng)
    loss = loss_of(training)
    prior_tril = 2.0 * torch.eye(d).double()
    deviation = tensor(0.5 * rng.normal(size=(3, d * (d + 1) // 2))).requires_grad_()
    assert torch.autograd.gradcheck(lambda u: loss(CholeskyLink(prior_tril, log_diagonal).root(u)), deviation)


@pytest.mark.parametrize("d", [1, 2, 9])
def test_the_literal_start_of_the_paper_has_a_finite_gradient(d, rng):
    """All vectors of the Wishart process at eight: a covariance of rank one."""
    training = training_set([1, 2, 15], d, rng)
    loss = loss_of(training)
    deviation = torch.zeros(3, (d + 1) * d, dtype=torch.float64).requires_grad_()
    matrix = torch.eye(d).double().requires_grad_()
    value = loss(wishart_root(deviation, torch.full((d, d + 1), 8.0).double(), matrix))
    assert value.isfinite()
    from_deviation, from_matrix = torch.autograd.grad(value, (deviation, matrix))
    assert from_deviation.isfinite().all()
    assert from_deviation.abs().max() > 0
    assert (from_matrix == 0).all()  # it multiplies the deviations, and the prior is held


@pytest.mark.parametrize("scale", [0.0, 1e-200, 1e100])
def test_likelihoods_and_gradients_are_finite_at_covariances_of_any_size(scale, rng):
    training = training_set([1, 2, 5], 2, rng)
    root = tensor(scale * rng.normal(size=(3, 2, 2))).requires_grad_()
    value = loss_of(training)(root)
    assert value.isfinite()
    assert torch.autograd.grad(value, root)[0].isfinite().all()


@pytest.mark.parametrize("d", [1, 2, 9])
def test_a_covariance_that_collapses_has_a_likelihood_that_is_bounded(d):
    """Two rows that the mean interpolates: without the floor the best covariance is zero."""
    none = torch.zeros(2, d, 1, dtype=torch.float64)
    lowest = 2 * 0.5 * d * math.log(2 * math.pi * VARIANCE_FLOOR)
    losses = []
    for scale in (1.0, 1e-3, 1e-9, 1e-100, 0.0):
        losses.append(gaussian_nll(scale * torch.eye(d).double().expand(2, d, d), none, torch.ones(2).double()).item())
    assert losses == sorted(losses, reverse=True)
    assert losses[-1] == pytest.approx(lowest, rel=1e-9)


def test_training_on_two_rows_ends_at_the_bound():
    latent = LatentValues(tensor([[0.0], [1.0]]), torch.zeros(1, 2).double(), tensor([1.0]), tensor([[0.1]]))
    none, counts = torch.zeros(2, 1, 1).double(), torch.ones(2).double()
    cost = Likelihood(CholeskyLink(torch.ones(1, 1).double(), True), none, counts, 1.0)
    report = minimize(lambda: cost(latent()), latent.trained(), max_iter=200, tol=1e-8)
    lowest = math.log(2 * math.pi * VARIANCE_FLOOR)
    assert report.converged
    assert lowest <= report.loss < lowest + 1e-3


@pytest.mark.parametrize("train_hyperparameters", [False, True])
def test_the_posterior_mode_under_gaussian_noise_is_the_mean_of_a_gaussian_process(train_hyperparameters, rng):
    x, y, noise_scale, amplitude = np.linspace(0, 1, 8)[:, None], rng.normal(size=(8, 2)), 0.3, np.array([1.5, 0.7])
    latent = LatentValues(
        tensor(x),
        torch.zeros(2, 8).double(),
        tensor(amplitude),
        tensor([[0.2]]),
        train_hyperparameters=train_hyperparameters,
    )
    latent.log_amplitude.requires_grad_(False)
    latent.log_length_scale.requires_grad_(False)

    def loss():
        likelihood = 0.5 * (latent() - tensor(y)).square().sum() / noise_scale**2
        return likelihood + 0.5 * latent.whitened.square().sum()

    report = minimize(loss, latent.trained(), max_iter=500, tol=1e-10)
    assert report.converged
    for row in range(2):
        gram = amplitude[row] ** 2 * RBF(0.2)(x)
        expected = gram @ np.linalg.solve(gram + noise_scale**2 * np.eye(8), y[:, row])
        # L-BFGS stops where the loss no longer falls in its twelfth digit: half as many for the place.
        np.testing.assert_allclose(latent().detach()[:, row], expected, rtol=0, atol=1e-5)

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_normal
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import DotProduct
from torch.distributions import MultivariateNormal, kl_divergence

from torch_pbd.models.heteroscedastic.regression import LinearEvidence, weights_factor

SIZES = [(12, 3), (3, 12), (1, 1)]  # rows and features


@pytest.mark.parametrize(("n", "p"), SIZES)
def test_posterior_of_the_weights_is_that_of_scikit_learn(n, p, rng):
    """A Gaussian process with a linear kernel, asked at the unit vectors, is its own weights."""
    design, response = rng.normal(size=(n, p)), rng.normal(size=n)
    peer = GaussianProcessRegressor(DotProduct(sigma_0=0.0, sigma_0_bounds="fixed"), alpha=1.0, optimizer=None)
    mean, covariance = peer.fit(design, response).predict(np.eye(p), return_cov=True)
    found = LinearEvidence.fit(torch.tensor(design), torch.tensor(response)).weights
    np.testing.assert_allclose(found.mean, mean, rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(found.root @ found.root.mT, covariance, rtol=1e-9, atol=1e-11)
    assert torch.equal(found.root, found.root.triu())
    factor, _ = weights_factor(torch.tensor(design), torch.tensor(response))
    np.testing.assert_allclose(factor.mT @ factor, np.eye(p) + design.T @ design, rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize(("n", "p"), SIZES)
def test_log_evidence_is_the_marginal_density_but_for_what_no_design_changes(n, p, rng):
    designs = rng.normal(size=(6, n, p)) * np.geomspace(0.01, 30.0, 6)[:, np.newaxis, np.newaxis]
    response = rng.normal(size=n)
    expected = [multivariate_normal(cov=np.eye(n) + design @ design.T).logpdf(response) for design in designs]
    found = LinearEvidence.fit(torch.tensor(designs), torch.tensor(response).expand(6, n)).value.numpy()
    np.testing.assert_allclose(found - 0.5 * n * np.log(2.0 * np.pi), expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("scale", [1.0, 1e5], ids=["by Cholesky", "by QR"])
def test_gradient_of_the_log_evidence_is_that_of_autograd(scale, generator):
    design = torch.randn(2, 7, 3, dtype=torch.float64, generator=generator).mul(scale).requires_grad_()
    response = torch.randn(2, 7, dtype=torch.float64, generator=generator)
    linear = LinearEvidence.fit(design, response)
    (expected,) = torch.autograd.grad(linear.value.sum(), design)
    with torch.no_grad():
        found = LinearEvidence.fit(design, response).gradient(design, response)
    torch.testing.assert_close(found, expected, rtol=1e-7, atol=1e-9 * float(expected.abs().max()))


def test_divergence_from_the_prior_is_that_of_torch(rng):
    linear = LinearEvidence.fit(torch.tensor(rng.normal(size=(9, 4))), torch.tensor(rng.normal(size=9)))
    weights = linear.weights
    prior = MultivariateNormal(torch.zeros(4, dtype=torch.float64), torch.eye(4, dtype=torch.float64))
    expected = kl_divergence(MultivariateNormal(weights.mean, weights.root @ weights.root.mT), prior)
    assert float(linear.divergence_from_prior()) == pytest.approx(float(expected), rel=1e-9)

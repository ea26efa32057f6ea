"""The law of few demonstrations, against closed forms."""

import numpy as np
import pytest
import torch
from scipy.integrate import quad
from scipy.linalg import expm, logm
from scipy.special import polygamma
from scipy.stats import invgamma

from torch_pbd.models.heteroscedastic.posterior import (
    as_inverse_gamma,
    log_correlation_moments,
    shrink_correlation,
    under_expected_noise,
)


def pair(correlation, deviations=(2.0, 0.01)):
    """Roots (n, 2, 2) of covariances of two outputs."""
    correlation = torch.as_tensor(correlation, dtype=torch.float64)
    rows = [torch.stack([torch.ones_like(correlation), 0.0 * correlation], -1)]
    rows.append(torch.stack([correlation, (1.0 - correlation.square()).sqrt()], -1))
    return torch.stack(rows, 1) * torch.tensor(deviations, dtype=torch.float64)[:, None]


def test_of_two_outputs_fishers_z_is_shrunk_and_the_variances_stay():
    correlation = torch.tensor([-0.95, 0.0, 0.3, 0.999], dtype=torch.float64)
    degrees = torch.tensor([3.0, 5.0, 20.0, 8.0], dtype=torch.float64)
    root = shrink_correlation(pair(correlation), degrees, torch.ones(2, 2).double(), torch.tensor(0.5).double())
    covariance = root @ root.mT
    deviation = covariance.diagonal(dim1=1, dim2=2).sqrt()
    torch.testing.assert_close(
        deviation, torch.tensor([2.0, 0.01], dtype=torch.float64).expand(4, 2), rtol=1e-12, atol=0
    )
    found = covariance[:, 0, 1] / deviation.prod(1)
    expected = torch.tanh(0.5 / (0.5 + 1.0 / degrees) * torch.atanh(correlation))
    torch.testing.assert_close(found, expected, rtol=1e-10, atol=1e-12)


def test_draws_scatter_as_the_posterior_of_fishers_z():
    z, degrees, prior = 0.8, 4.0, 0.3
    drawn = z + np.random.default_rng(0).normal(size=50_000) / degrees**0.5
    arguments = torch.tensor([degrees]).double(), None, torch.tensor(prior).double(), pair(np.tanh(drawn))[:, None]
    root = shrink_correlation(pair([np.tanh(z)]), *arguments)[:, 0]
    covariance = root @ root.mT
    found = torch.atanh(covariance[:, 0, 1] / covariance.diagonal(dim1=1, dim2=2).sqrt().prod(1)).numpy()
    part = prior / (prior + 1.0 / degrees)
    assert found.mean() == pytest.approx(part * z, abs=5.0 * (part / degrees / 50_000) ** 0.5)
    assert found.var() == pytest.approx(part / degrees, rel=0.05)


def test_the_variance_of_fishers_z_is_what_its_errors_leave_over():
    rng, degrees = np.random.default_rng(0), 6.0
    root = pair(np.tanh(rng.normal(size=40_000) * (0.4 + 1.0 / degrees) ** 0.5))
    n = torch.full((40_000,), degrees).double()
    assert float(log_correlation_moments(root, n, 1e9, 6)[1]) == pytest.approx(0.4, abs=0.02)
    noise = pair(np.tanh(0.2 * rng.normal(size=100)))
    assert float(log_correlation_moments(noise, n[:100], 1e9, 6)[1]) == 0.0
    uniform = quad(lambda r: 0.5 * np.arctanh(r) ** 2, -1.0, 1.0)[0]
    one_output = torch.ones(100, 1, 1).double()
    for root, places in ((noise, 0.0), (one_output, 7.0)):  # of no pairs of outputs
        assert float(log_correlation_moments(root, n[:100], places, 6)[1]) == pytest.approx(uniform, rel=1e-9)


def test_of_three_outputs_correlations_shrink_to_none_and_not_at_all():
    root = torch.linalg.cholesky(torch.tensor([[4.0, 1.0, -1.0], [1.0, 1.0, 0.3], [-1.0, 0.3, 2.0]]).double())[None]
    degrees = torch.tensor([5.0]).double()
    for variance, expected in ((0.0, (root @ root.mT).diagonal(dim1=1, dim2=2).diag_embed()), (1e15, root @ root.mT)):
        found = shrink_correlation(root, degrees, None, torch.tensor(variance).double())
        torch.testing.assert_close(found @ found.mT, expected, rtol=1e-10, atol=1e-12)


def test_of_many_outputs_the_error_of_the_mean_is_taken_off_and_the_rest_shrunk_the_less():
    rng, weight = np.random.default_rng(0), 0.5 / (0.5 + 1.0 / 5.0)
    correlation, error = np.corrcoef(rng.normal(size=(6, 9))), 0.1 * np.corrcoef(rng.normal(size=(6, 9)))
    root, more = torch.tensor(np.linalg.cholesky(correlation))[None], 2.0  # of 2.5 coefficients in the mean
    arguments = torch.tensor([5.0]).double(), torch.tensor(error), torch.tensor(0.5).double()
    found = shrink_correlation(root, *arguments)[0].numpy()
    expected = expm((weight * logm(correlation) + more * (logm(correlation) - error)) / (1.0 + more))
    deviation = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(found @ found.T, expected / np.outer(deviation, deviation), rtol=1e-10, atol=1e-12)


def test_shrinking_has_a_gradient_where_outputs_are_independent():
    degrees = torch.tensor([5.0], dtype=torch.float64, requires_grad=True)
    variance, slant = torch.tensor(0.5).double(), torch.tensor([[[0.0, 0.2], [-0.1, 0.0]]]).double()

    def gram(step, degrees):
        root = shrink_correlation(torch.eye(2).double()[None] + step * slant, degrees, None, variance)
        return root @ root.mT

    step = torch.zeros((), dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(gram, (step, degrees))


def test_the_error_of_a_mean_under_louder_noise_is_that_of_its_posterior():
    """K rows of covariance Sigma beside the prior N(0, A): the precision is inv(A) + K inv(Sigma)."""
    sigma, prior = np.array([[2.0, 0.6], [0.6, 0.5]]), np.array([1.5, 0.4])
    n_demos, degrees = 3, 5.0
    before, after = (
        np.linalg.inv(np.diag(1.0 / prior) + n_demos * np.linalg.inv(scale * sigma))
        for scale in (1.0, degrees / (degrees - 2.0))
    )
    arguments = torch.tensor(np.linalg.cholesky(before))[None], torch.tensor([degrees]).double(), torch.tensor(prior)
    root = under_expected_noise(*arguments)[0].numpy()
    np.testing.assert_allclose(root @ root.T, after, rtol=1e-12)


@pytest.mark.parametrize("degrees", [4.0, 6.0, 20.0])
def test_a_variance_is_expected_as_an_inverse_gammas_mean(degrees):
    """The degrees that a log variance stands for are found to a percent."""
    law = invgamma(degrees / 2.0, scale=degrees / 2.0)
    location = np.log(degrees / 2.0) - polygamma(0, degrees / 2.0)  # of the logarithm
    variance = torch.tensor(polygamma(1, degrees / 2.0))
    assert float(torch.exp(location + 0.5 * as_inverse_gamma(variance))) == pytest.approx(law.mean(), rel=0.05)

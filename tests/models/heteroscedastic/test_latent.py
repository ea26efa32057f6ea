import numpy as np
import pytest
import torch

from torch_pbd.models.heteroscedastic.posterior import FactorMoments, LatentCovariance
from torch_pbd.models.heteroscedastic.regression import Weights


@pytest.fixture
def latent(family, rng):
    """A posterior of three outputs whose weights are correlated."""

    def weights(*batch, size):
        root = 0.3 * np.triu(rng.normal(size=(*batch, size, size)))
        return Weights(torch.tensor(0.5 * rng.normal(size=(*batch, size))), torch.tensor(root))

    theta = torch.tensor([[-1.0, 0.3], [0.2, -0.5], [-0.5, 0.0]], dtype=torch.float64)
    coefficients = [weights(size=10), weights(size=20)]
    processes, rows = family.prepared(theta), family.prepared(theta[1:])
    return LatentCovariance(processes, weights(3, size=10), rows, coefficients)


def test_a_draw_has_the_mean_and_the_variances_of_the_moments(latent, inputs):
    """Exactly: a draw's log variances and coefficients are linear in the normal numbers it is made of."""
    sizes = [10, 10, 10, 10, 20]
    zeros = [torch.zeros(size, dtype=torch.float64) for size in sizes]

    def processes(normal):
        factor = latent.draw(inputs, normal)
        return factor.tril(-1) + torch.diag_embed(2.0 * factor.diagonal(dim1=1, dim2=2).log())

    centre, variance = processes(zeros), torch.zeros(9, 3, 3, dtype=torch.float64)
    for which, size in enumerate(sizes):
        for unit in torch.eye(size, dtype=torch.float64):
            normal = [unit if k == which else zero for k, zero in enumerate(zeros)]
            variance += (processes(normal) - centre).square()
    moments = latent.at(inputs)
    torch.testing.assert_close(centre, moments.below + torch.diag_embed(moments.log_variance), rtol=1e-9, atol=1e-9)
    expected = moments.below_variance + torch.diag_embed(moments.log_variance_variance)
    torch.testing.assert_close(variance, expected, rtol=1e-7, atol=1e-8)  # the inputs carry all but 1e-10
    torch.testing.assert_close(moments.tril(), latent.draw(inputs, zeros), rtol=1e-9, atol=1e-9)


def test_far_from_the_inducing_inputs_the_moments_are_those_of_the_prior(latent, family):
    """But for the constant, which the data tell everywhere."""
    moments = latent.at(torch.tensor([[100.0]], dtype=torch.float64))
    amplitude = family.amplitude_of(latent.log_variances.theta).square()
    constant = 2.0**2 * latent.log_variance.root[:, -1].square().sum(-1)
    torch.testing.assert_close(moments.log_variance_variance[0], amplitude + constant, rtol=1e-9, atol=0)


def moments_of(rng, n=4, d=3, variance=0.5):
    lower = np.tril(np.ones((d, d)), -1)
    return FactorMoments(
        torch.tensor(rng.normal(size=(n, d))),
        torch.tensor(variance * rng.uniform(0.2, 1.0, size=(n, d))),
        torch.tensor(lower * rng.normal(size=(n, d, d))),
        torch.tensor(lower * rng.uniform(0.1, 1.0, size=(n, d, d))),
    )


def test_the_root_is_that_of_the_expected_covariance(rng):
    """Of 400 000 factors drawn from the moments: entries to five standard errors."""
    moments = moments_of(rng, n=2)
    root = moments.expected_root(1e12)
    covariance = (root @ root.mT).numpy()
    n_draws = 400_000
    for t in range(2):
        factor = moments.below[t].numpy() + moments.below_variance[t].sqrt().numpy() * rng.normal(size=(n_draws, 3, 3))
        logs = moments.log_variance[t].numpy() + moments.log_variance_variance[t].sqrt().numpy() * rng.normal(
            size=(n_draws, 3)
        )
        factor[:, np.arange(3), np.arange(3)] = np.exp(0.5 * logs)
        draws = factor @ factor.transpose(0, 2, 1)
        error = draws.std(0) / np.sqrt(n_draws)
        assert (np.abs(draws.mean(0) - covariance[t]) < 5.0 * error).all()
        assert error.max() < 0.02 * covariance[t].max()


def test_a_variance_that_is_not_known_enters_only_up_to_the_cap(rng):
    """The variances of the logarithms v become v / (1 + v / most)."""
    moments = moments_of(rng, variance=50.0)
    capped = moments.log_variance_variance / (1.0 + moments.log_variance_variance / 2.0)
    same = FactorMoments(moments.log_variance, capped, moments.below, moments.below_variance)
    torch.testing.assert_close(moments.expected_root(2.0), same.expected_root(1e300), rtol=1e-12, atol=0)
    first = moments.expected_root(2.0)[:, 0].square().sum(-1)
    assert (first <= (moments.log_variance[:, 0] + 1.0).exp()).all()


def test_without_uncertainty_the_root_is_the_factor(rng):
    moments = moments_of(rng, variance=0.0)
    moments = FactorMoments(moments.log_variance, 0 * moments.log_variance, moments.below, 0 * moments.below)
    expected = torch.cat([moments.tril(), torch.zeros(4, 3, 3).double()], dim=-1)
    torch.testing.assert_close(moments.expected_root(2.0), expected, rtol=1e-12, atol=0)

import math

import numpy as np
import pytest
import torch
from gp.oracle import negative_log_evidence
from sklearn.gaussian_process.kernels import RBF

from torch_pbd.gp.evidence import Evidence
from torch_pbd.gp.observations import Basis, Hyperparameters, Observations, condition, levels_on_nodes, neighbourhoods
from torch_pbd.kernels import correlation


@pytest.fixture
def observations(generator):
    """Two processes at 300 inputs of a line, in no order, with a gap and counts of their own."""
    x = torch.rand(300, 1, generator=generator, dtype=torch.float64)
    x = torch.where(x > 0.6, x + 0.5, x) / 1.5
    counts = torch.randint(1, 9, (300,), generator=generator).double()
    targets = torch.sin(9.0 * x.mT) + 0.1 * torch.randn(2, 300, generator=generator, dtype=torch.float64)
    return Observations(x, targets, counts)


def levels(observations):
    return levels_on_nodes(observations.inputs, "squared_exponential", 300)


@pytest.mark.parametrize("number", [0, 1, 2, 3])
def test_nodes_carry_the_kernel_down_to_their_shortest_length_scale(number, observations):
    shortest, n_nodes = levels(observations)[number]
    basis = Basis(observations, n_nodes)
    for factor, bound in [(1.0, 1e-12), (3.0, 1e-13), (0.3, None)]:
        scale = torch.full((1, 1), factor * shortest, dtype=torch.float64)
        projected = basis.covariance(correlation(basis.nodes, basis.nodes, scale)[0])
        found = basis.orthogonal @ projected @ basis.orthogonal.mT / observations.counts.sqrt()
        found = (found / observations.counts.sqrt()[:, None]).numpy()
        error = np.abs(found - RBF(scale.item())(observations.inputs)).max()
        assert error < bound if bound is not None else error > 1e-6  # below it they do not


def at(evidence, length_scale, noise_ratio):
    rows = torch.arange(len(noise_ratio))
    return evidence(torch.tensor(length_scale, dtype=torch.float64), torch.tensor(noise_ratio).double(), rows)


@pytest.mark.parametrize("noise_scale", [None, 0.3])
def test_evidence_on_nodes_is_that_of_all_inputs(noise_scale, observations):
    held = None if noise_scale is None else torch.tensor([0.3, 0.2], dtype=torch.float64)
    full = Evidence(Basis(observations), observations.targets, "squared_exponential", held)
    for shortest, n_nodes in levels(observations):
        fewer = Evidence(Basis(observations, n_nodes), observations.targets, "squared_exponential", held)
        where = ([[1.1 * shortest], [2.0]], [1e-4, 3.0])
        (loss, gradient), (expected, expected_gradient) = at(fewer, *where), at(full, *where)
        torch.testing.assert_close(loss, expected, rtol=1e-10, atol=1e-8)
        torch.testing.assert_close(gradient, expected_gradient, rtol=1e-7, atol=1e-6)
        scales, ratios = torch.tensor([[0.2], [2.0]]).double(), torch.tensor([1e-4, 3.0]).double()
        torch.testing.assert_close(fewer.table(scales, ratios), full.table(scales, ratios), rtol=1e-9, atol=1e-8)


@pytest.mark.parametrize("kernel", ["squared_exponential", "matern32", "matern52"])
@pytest.mark.parametrize("n_features", [1, 3])
def test_gradient_is_that_of_autograd(kernel, n_features, generator):
    x = torch.rand(12, n_features, generator=generator, dtype=torch.float64)
    counts = torch.randint(1, 5, (12,), generator=generator).double()
    observations = Observations(x, torch.randn(3, 12, generator=generator, dtype=torch.float64), counts)
    log_scale = (-torch.rand(3, n_features, generator=generator, dtype=torch.float64)).requires_grad_()
    log_ratio = torch.tensor([-6.0, -1.0, 2.0], dtype=torch.float64, requires_grad=True)
    evidence = Evidence(Basis(observations), observations.targets, kernel, None)
    rows = torch.arange(3)
    loss, gradient = evidence(log_scale.exp().detach(), log_ratio.exp().detach(), rows)
    variance = evidence.best_variance(log_scale.exp().detach(), log_ratio.exp().detach(), rows)
    # The best amplitude changes nothing to first order, so that it may be held.
    expected = negative_log_evidence(
        observations, Hyperparameters(log_scale.exp(), variance.sqrt(), log_ratio.exp()), kernel
    )
    torch.testing.assert_close(loss, expected.detach(), rtol=1e-10, atol=0)
    by_scale, by_ratio = torch.autograd.grad(expected.sum(), (log_scale, log_ratio))
    torch.testing.assert_close(gradient[:, :-1], by_scale, rtol=1e-8, atol=1e-9)
    torch.testing.assert_close(gradient[:, -1], by_ratio, rtol=1e-8, atol=1e-9)


def test_gradient_under_a_held_noise_is_that_of_differences(observations):
    held = torch.tensor([0.3, 0.2], dtype=torch.float64)
    evidence = Evidence(Basis(observations, 32), observations.targets, "squared_exponential", held)
    scale, ratio, step = [[0.3], [0.9]], np.array([1e-2, 3.0]), 1e-5
    above, below = (at(evidence, scale, list(ratio * math.exp(sign * step)))[0] for sign in (1.0, -1.0))
    expected = (above - below) / (2.0 * step)
    torch.testing.assert_close(at(evidence, scale, list(ratio))[1][:, -1], expected, rtol=1e-6, atol=1e-5)


def test_neighbours_taken_together_are_observations_of_their_mean_and_noise_beside(observations):
    """A process that is constant within neighbourhoods has exactly the merged evidence."""
    index = neighbourhoods(observations.inputs, 20)
    basis = Basis(observations, max_inputs=20)
    scale, ratio = torch.tensor([[0.2]] * 2).double(), torch.tensor([0.1, 0.1]).double()
    found = Evidence(basis, observations.targets, "squared_exponential", None)(scale, ratio, torch.arange(2))[0]
    gram = correlation(basis.nodes, basis.nodes, scale)[:, index][:, :, index]
    covariance = gram + 0.1 * torch.diag_embed(1.0 / observations.counts)
    variance = (observations.targets * torch.linalg.solve(covariance, observations.targets)).sum(1) / 300
    normal = torch.distributions.MultivariateNormal(torch.zeros(300).double(), variance[:, None, None] * covariance)
    torch.testing.assert_close(found, -normal.log_prob(observations.targets), rtol=1e-9, atol=0)


def test_processes_on_nodes_predict_what_those_on_all_inputs_do(observations):
    scale, amplitude = torch.tensor([[0.2], [0.5]]).double(), torch.tensor([1.3, 0.7]).double()
    hyperparameters = Hyperparameters(scale, amplitude, torch.tensor([1e-2, 0.3]).double())
    values = observations.targets + 2.0
    basis = Basis(observations, 32)
    fewer, _ = condition(observations, hyperparameters, values=values, basis=basis)
    every, _ = condition(observations, hyperparameters, values=values, basis=Basis(observations))
    x = torch.linspace(-1.0, 2.0, 200, dtype=torch.float64)[:, None]
    torch.testing.assert_close(fewer(x), every(x), rtol=1e-9, atol=1e-10)
    torch.testing.assert_close(fewer.values(x), every.values(x), rtol=1e-9, atol=1e-10)
    # Without noise the matrices are singular to rounding: what is between and beyond depends on their jitter.
    assert fewer.type1(observations.inputs).max() < 1e-5
    beyond = fewer.type1(torch.linspace(1.1, 6.0, 50, dtype=torch.float64)[:, None])
    assert (beyond.diff() > -1e-9).all()
    assert beyond[-1] > 0.999

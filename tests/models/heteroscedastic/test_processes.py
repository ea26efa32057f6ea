import numpy as np
import pytest
import torch
from scipy.optimize import minimize

from torch_pbd.gp.inducing import FeatureMap
from torch_pbd.kernels import correlation
from torch_pbd.models.heteroscedastic import ProcessFamily, SearchOptions
from torch_pbd.models.heteroscedastic.linear import log_evidence
from torch_pbd.models.heteroscedastic.processes import search


def tensor(values):
    return torch.tensor(values, dtype=torch.float64)


def test_inner_products_of_the_design_are_the_kernel_and_the_constant(family, inputs):
    theta = tensor([[-1.0, 0.3], [0.2, -0.5]])
    design = family.design(inputs, theta)
    kernel = correlation(inputs, inputs, family.length_scale_of(theta), "matern52")
    expected = family.amplitude_of(theta).square()[:, None, None] * kernel + 2.0**2
    torch.testing.assert_close(design @ design.mT, expected, rtol=1e-8, atol=1e-8)


def test_nothing_is_unexplained_at_inducing_inputs_and_all_far_away(family, inputs):
    theta = tensor([[-1.0, 0.3], [0.2, -0.5]])
    x = torch.cat([inputs, tensor([[1e3]])])
    unexplained = family.unexplained(family.design(x, theta), theta)
    assert float(unexplained[:, :-1].max()) < 1e-8
    torch.testing.assert_close(unexplained[:, -1], family.amplitude_of(theta).square(), rtol=1e-12, atol=0)


def test_hyperparameters_stay_within_what_the_inducing_inputs_resolve(inputs):
    family = ProcessFamily(FeatureMap(inputs), 0.5, 1.0, 0.0)
    theta = tensor([[-50.0, -1e3], [0.0, 1e3]])
    assert family.length_scale_of(theta)[0].item() == pytest.approx(family.features.shortest_length_scale(), rel=1e-9)
    torch.testing.assert_close(family.amplitude_of(theta).log(), tensor([-4.0, 4.0]), rtol=1e-9, atol=0)


def evidence_of(family, inputs, response):
    def evidence(theta, rows):
        return log_evidence(5.0 * family.design(inputs, theta), 5.0 * response[rows])

    return evidence


def curves(inputs, rng):
    """A fast one and a slow one, with noise of a fifth."""
    x = inputs[:, 0].numpy()
    return tensor(np.stack([np.sin(12.0 * x), np.sin(2.0 * x)]) + 0.2 * rng.normal(size=(2, len(x))))


@pytest.fixture
def many_inputs():
    return torch.linspace(-0.5, 0.5, 40, dtype=torch.float64)[:, None]


def test_the_search_ends_where_that_of_scipy_does(many_inputs, rng):
    family = ProcessFamily(FeatureMap(many_inputs, exact=True), 0.3, 1.2, 0.0)
    evidence = evidence_of(family, many_inputs, curves(many_inputs, rng))
    theta = search(family, evidence, None, (2, 1), many_inputs, SearchOptions(100, 1e-5))
    for i in (0, 1):

        def loss(point, i=i):
            point = tensor(point)[None]
            return -float(evidence(point, torch.tensor([i])) + family.log_prior(point))

        ends = [minimize(loss, start, method="Nelder-Mead") for start in ([-2.0, 0.0], [-0.5, 0.0], [0.5, 1.0])]
        best = min(ends, key=lambda end: end.fun)
        assert loss(theta[i].tolist()) < best.fun + 1e-4
        np.testing.assert_allclose(theta[i], best.x, rtol=0, atol=1e-2)


def test_a_shared_length_scale_is_that_of_the_joint_evidence(many_inputs, rng):
    family = ProcessFamily(FeatureMap(many_inputs, exact=True), 0.3, 1.2, 0.0, shared=True)
    evidence = evidence_of(family, many_inputs, curves(many_inputs, rng))
    theta = search(family, evidence, None, (2, 1), many_inputs, SearchOptions(100, 1e-5))
    assert theta[0, 0] == theta[1, 0]
    assert theta[0, 1] != theta[1, 1]

    def loss(point):
        both = tensor([[point[0], point[1]], [point[0], point[2]]])
        return -float((evidence(both, torch.arange(2)) + family.log_prior(both)).sum())

    best = minimize(loss, [-1.0, 0.0, 0.0], method="Nelder-Mead", options={"maxiter": 2000})
    assert loss([theta[0, 0], theta[0, 1], theta[1, 1]]) < best.fun + 1e-4

from dataclasses import replace

import pytest
import torch

from torch_pbd.kernels import KERNELS
from torch_pbd.models.heteroscedastic.processes import FixedFeatures, ProcessFamily


def tensor(values):
    return torch.tensor(values, dtype=torch.float64)


def family_on(inducing, kernel="squared_exponential", period=None, **options):
    return ProcessFamily(inducing, 0.5, 1.0, 0.0, kernel=kernel, period=period, **options)


def maps(kernel, n_features, period, generator):
    inducing = torch.rand(12, n_features, dtype=torch.float64, generator=generator)
    x = torch.rand(7, n_features, dtype=torch.float64, generator=generator)
    family = family_on(inducing, kernel, None if period is None else tensor(period))
    return family, FixedFeatures(family, x), x


CASES = [(1, None), (2, None), (2, [1.3, torch.inf])]


# Information of which features that carry less than 1e-12 of the variance may be left out.
MUCH = tensor([2e5, 2e5])


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize(("n_features", "period"), CASES)
def test_values_are_those_of_the_map_but_for_a_rotation(kernel, n_features, period, generator):
    family, fixed, x = maps(kernel, n_features, period, generator)
    theta = tensor([[-2.3, -1.2, 0.0], [-1.6, -3.0, 0.3]])[:, -n_features - 1 :]
    found, expected = fixed.design_vjp(theta, MUCH)[0], family.prepared(theta)(x)
    torch.testing.assert_close(found @ found.mT, expected @ expected.mT, rtol=0, atol=1e-8)


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize(("n_features", "period"), CASES)
def test_gradient_in_the_hyperparameters_is_that_of_autograd(kernel, n_features, period, generator):
    """Of a function of the inner products; through the map's Cholesky factor by autograd."""
    family, fixed, x = maps(kernel, n_features, period, generator)
    theta = tensor([[-2.3, -1.2, 0.0], [-1.6, -3.0, 0.3]])[:, -n_features - 1 :].requires_grad_()
    weight = torch.randn(7, 7, dtype=torch.float64, generator=generator)

    def of_products(values):
        return (weight * (values @ values.mT).sin()).sum()

    (expected,) = torch.autograd.grad(of_products(family.prepared(theta)(x)), theta)
    values, vjp = fixed.design_vjp(theta.detach(), MUCH)
    values.requires_grad_()
    (gradient,) = torch.autograd.grad(of_products(values), values)
    torch.testing.assert_close(vjp(gradient), expected, rtol=1e-6, atol=1e-6)


def test_features_that_carry_next_to_nothing_are_left_out():
    """The longer the length scale the more of them; what is left carries all but about what was allowed."""
    inducing = torch.linspace(-0.5, 0.5, 60, dtype=torch.float64)[:, None]
    x = torch.linspace(-0.5, 0.5, 200, dtype=torch.float64)[:, None]
    sizes = []
    for scale in (0.05, 0.2, 0.8):
        fixed = FixedFeatures(replace(family_on(inducing), fixed_length_scale=tensor([scale])), x)
        values = fixed.design_vjp(torch.zeros(1, 2).double(), tensor([20.0]))[0][0]  # may leave out 1e-8
        sizes.append(values.shape[1])
        assert float((1.0 - values.square().sum(1)).max()) < 2e-7  # measured: 1.3e-7, between inducing inputs
    assert sizes[0] > sizes[1] > sizes[2]
    assert sizes[2] < 12


def test_inducing_inputs_are_taken_farthest_first():
    family = family_on(tensor([[0.0], [0.1], [0.5], [0.9], [1.0]]))
    assert family.farthest_first.tolist()[:3] in ([2, 0, 4], [2, 4, 0])
    around = family_on(tensor([[0.0], [0.5], [0.9]]), period=tensor([1.0]))  # 0.9 is next to 0.0
    assert sorted(around.farthest_first.tolist()[:2])[1] == 1 or around.farthest_first.tolist()[1] == 1


def test_where_nothing_can_be_told_one_feature_is_left():
    """Observations without information, as of outputs that all vanish, are no error."""
    family = family_on(tensor([[0.0], [0.5], [1.0]]))
    values, vjp = FixedFeatures(family, tensor([[0.2]])).design_vjp(tensor([[-1.2, 0.0]]), tensor([1e-11]))
    assert values.shape == (1, 1, 1)
    assert torch.isfinite(vjp(torch.ones_like(values))).all()

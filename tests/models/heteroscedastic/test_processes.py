import pytest
import torch

from torch_pbd.kernels import correlation
from torch_pbd.models.heteroscedastic.processes import FixedFeatures, ProcessFamily


def tensor(values):
    return torch.tensor(values, dtype=torch.float64)


def test_inner_products_of_the_design_are_the_kernel_and_the_constant(family, inputs):
    theta = tensor([[-1.0, 0.3], [0.2, -0.5]])
    design = family.prepared(theta)(inputs)
    kernel = correlation(inputs, inputs, family.length_scale_of(theta), "matern52")
    expected = family.amplitude_of(theta).square()[:, None, None] * kernel + 2.0**2
    torch.testing.assert_close(design @ design.mT, expected, rtol=1e-8, atol=1e-8)


def test_nothing_is_unexplained_at_inducing_inputs_and_all_far_away(family, inputs):
    theta = tensor([[-1.0, 0.3], [0.2, -0.5]])
    x = torch.cat([inputs, tensor([[1e3]])])
    processes = family.prepared(theta)
    unexplained = processes.unexplained(processes(x))
    assert float(unexplained[:, :-1].max()) < 1e-8
    torch.testing.assert_close(unexplained[:, -1], family.amplitude_of(theta).square(), rtol=1e-12, atol=0)


def test_hyperparameters_stay_within_what_the_inducing_inputs_resolve(inputs):
    family = ProcessFamily(inputs, 0.5, 1.0, 0.0)
    theta = tensor([[-50.0, -1e3], [0.0, 1e3]])
    assert family.length_scale_of(theta)[0].item() == pytest.approx(family.shortest_length_scale, rel=1e-9)
    torch.testing.assert_close(family.amplitude_of(theta).log(), tensor([-4.0, 4.0]), rtol=1e-9, atol=0)


@pytest.mark.parametrize("fixed_length_scale", [None, [0.4]])
def test_a_design_that_leaves_out_what_cannot_be_told_has_the_kernel_and_its_gradient(
    fixed_length_scale, inputs, generator
):
    """Gradient of a function of the kernel, by autograd through all features."""
    held = None if fixed_length_scale is None else tensor(fixed_length_scale)
    many = torch.linspace(-0.5, 0.5, 30, dtype=torch.float64)[:, None]
    family = ProcessFamily(many, 0.5, 1.0, 2.0, held)
    theta = tensor([[-1.0, 0.3], [0.2, -0.5]]).requires_grad_()
    weight = torch.randn(9, 9, dtype=torch.float64, generator=generator)

    def of_kernel(design):
        return (weight * (design @ design.mT).sin()).sum((-2, -1))

    whole = family.prepared(theta)(inputs)
    (expected,) = torch.autograd.grad(of_kernel(whole).sum(), theta)
    design, vjp = FixedFeatures(family, inputs).design_vjp(theta.detach(), tensor([1e3, 1e3]))
    assert design.shape[-1] < 20
    torch.testing.assert_close(design @ design.mT, whole @ whole.mT, rtol=0, atol=1e-7)
    values = design.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(of_kernel(values).sum(), values)
    torch.testing.assert_close(vjp(gradient), expected, rtol=1e-5, atol=1e-5)


def test_gradient_of_the_prior(family):
    theta = tensor([[-1.0, 0.3], [0.2, -0.5]]).requires_grad_()
    (expected,) = torch.autograd.grad(family.log_prior(theta)[0].sum(), theta)
    torch.testing.assert_close(family.log_prior(theta.detach())[1], expected, rtol=1e-12, atol=0)

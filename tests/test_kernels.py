from typing import get_args

import numpy as np
import pytest
import torch
from sklearn.gaussian_process.kernels import RBF, ExpSineSquared, Matern

from torch_pbd import CholeskyCovRegressor, HeteroscedasticGPRegressor
from torch_pbd.data import make_paper_simulation
from torch_pbd.kernels import KERNELS, Kernel, KernelName, correlation

ORACLES = {
    "squared_exponential": RBF,
    "matern32": lambda length_scale: Matern(length_scale, nu=1.5),
    "matern52": lambda length_scale: Matern(length_scale, nu=2.5),
}


def tensor(array):
    return torch.tensor(array, dtype=torch.float64)


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("length_scale", [[0.3], [0.3, 2.0]])
def test_correlation_is_that_of_scikit_learn(kernel, length_scale, rng):
    x, other = rng.normal(size=(20, len(length_scale))), rng.normal(size=(15, len(length_scale)))
    found = correlation(tensor(x), tensor(other), tensor(length_scale), kernel)
    # Entries down to 1e-300, whose exponents carry the rounding of distances.
    np.testing.assert_allclose(found, ORACLES[kernel](length_scale)(x, other), rtol=1e-9, atol=1e-200)


@pytest.mark.parametrize("kernel", KERNELS)
def test_each_length_scale_of_a_batch_is_on_its_own(kernel, generator):
    x = torch.randn(6, 2, dtype=torch.float64, generator=generator)
    length_scale = tensor([[[0.3, 2.0], [1.0, 1.0]], [[5.0, 0.1], [0.2, 0.2]], [[1.0, 3.0], [2.0, 1.0]]])
    batch = correlation(x, x, length_scale, kernel)
    assert batch.shape == (3, 2, 6, 6)
    for i in range(3):
        for j in range(2):
            assert torch.equal(batch[i, j], correlation(x, x, length_scale[i, j], kernel))


@pytest.mark.parametrize("kernel", KERNELS)
def test_correlation_does_not_depend_on_the_unit_or_the_origin_of_x(kernel, generator):
    x = torch.randn(7, 2, dtype=torch.float64, generator=generator)
    length_scale, unit, origin = tensor([0.5, 1.5]), tensor([1000.0, 0.1]), tensor([3.0, -7.0])
    moved = correlation(unit * x + origin, unit * x + origin, unit * length_scale, kernel)
    # Adding the origin rounds the third input at 1e-15 of it.
    torch.testing.assert_close(moved, correlation(x, x, length_scale, kernel), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("e", [1, 2])
def test_correlation_is_differentiable_where_points_coincide(kernel, e, generator):
    other = torch.randn(4, e, dtype=torch.float64, generator=generator)
    x = torch.cat([other[:2], torch.randn(2, e, dtype=torch.float64, generator=generator)]).requires_grad_()
    length_scale = (0.5 + torch.rand(3, e, dtype=torch.float64, generator=generator)).requires_grad_()
    assert torch.autograd.gradcheck(
        lambda x, length_scale: correlation(x, other, length_scale, kernel), (x, length_scale)
    )


@pytest.mark.parametrize("kernel", KERNELS)
def test_a_point_has_correlation_one_with_itself_and_the_gradient_there_is_zero(kernel):
    x = tensor([[0.3, -2.0]]).requires_grad_()
    value = correlation(x, x.detach(), tensor([0.1, 10.0]), kernel)
    (gradient,) = torch.autograd.grad(value.sum(), x)
    assert value.item() == pytest.approx(1.0, rel=1e-14)
    assert gradient.tolist() == [[0.0, 0.0]]


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("far", [1e5, 1e200, 1e300])
def test_far_inputs_have_a_correlation_and_a_gradient_of_exactly_zero(kernel, far):
    x = tensor([[far], [-far]]).requires_grad_()
    length_scale = tensor([0.5]).requires_grad_()
    value = correlation(x, tensor([[0.0], [1.0]]), length_scale, kernel)
    gradients = torch.autograd.grad(value.sum(), (x, length_scale))
    assert (value == 0).all()
    assert all((gradient == 0).all() for gradient in gradients)


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_dtype_is_that_of_the_inputs(kernel, dtype):
    x = torch.zeros(3, 1, dtype=dtype)
    assert correlation(x, x, torch.ones(1, dtype=dtype), kernel).dtype == dtype


def test_on_a_circle_the_squared_exponential_is_the_periodic_kernel_of_scikit_learn(rng):
    """Whose length scale is of the angle's chord: ``2 pi / period`` times ours, which is in units of x."""
    x, other = rng.uniform(-5.0, 5.0, size=(20, 1)), rng.uniform(-5.0, 5.0, size=(15, 1))
    for period, length_scale in [(1.0, 0.1), (2.5, 1.0)]:
        expected = ExpSineSquared(2.0 * np.pi * length_scale / period, period)(x, other)
        found = correlation(tensor(x), tensor(other), tensor([length_scale]), period=tensor([period]))
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-200)


@pytest.mark.parametrize("kernel", KERNELS)
def test_a_period_repeats_its_own_input_only_and_is_not_seen_by_neighbours(kernel, rng):
    x, other = rng.uniform(-0.5, 0.5, size=(8, 2)), rng.uniform(-0.5, 0.5, size=(6, 2))
    length_scale, period = tensor([0.3, 0.7]), tensor([2.0, np.inf])
    found = correlation(tensor(x), tensor(other), length_scale, kernel, period)
    turned = correlation(tensor(x) + tensor([4.0, 0.0]), tensor(other), length_scale, kernel, period)
    torch.testing.assert_close(turned, found, rtol=1e-9, atol=1e-12)
    # The chord of an arc r is r (1 - (pi r / period)^2 / 6 + ...): wide circles are straight.
    straight = correlation(tensor(x), tensor(other), length_scale, kernel)
    wide = correlation(tensor(x), tensor(other), length_scale, kernel, tensor([1e4, np.inf]))
    torch.testing.assert_close(wide, straight, rtol=1e-6, atol=0)
    matrix = correlation(tensor(x), tensor(x), length_scale, kernel, period)
    assert torch.linalg.eigvalsh(matrix).min() > 0


@pytest.mark.parametrize("kernel", KERNELS)
def test_correlation_on_a_circle_is_differentiable(kernel, generator):
    other = torch.randn(4, 2, dtype=torch.float64, generator=generator)
    x = torch.cat([other[:2], 1.5 + other[2:]]).requires_grad_()
    length_scale = torch.tensor([[0.5, 1.0]], dtype=torch.float64, requires_grad=True)
    period = tensor([1.0, np.inf])
    assert torch.autograd.gradcheck(lambda x, scale: correlation(x, other, scale, kernel, period), (x, length_scale))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("kernel", KERNELS)
def test_infinitely_many_periods_away_the_correlation_is_a_number(kernel, dtype):
    """1e300 of an input whose unit is 1e-9."""
    x = torch.tensor([[torch.inf], [-torch.inf], [torch.finfo(dtype).max]], dtype=dtype)
    period, length_scale = torch.tensor([0.1], dtype=dtype), torch.ones(1, dtype=dtype)
    found = correlation(x, torch.zeros(1, 1, dtype=dtype), length_scale, kernel, period)
    assert ((found > 0) & (found <= 1)).all()


@pytest.mark.parametrize("kernel", KERNELS)
def test_the_slope_is_the_derivative_of_the_value(kernel):
    square_distance = torch.linspace(0.01, 30.0, 50, dtype=torch.float64, requires_grad=True)
    value = KERNELS[kernel].value(square_distance)
    (expected,) = torch.autograd.grad(value.sum(), square_distance)
    found = KERNELS[kernel].slope(square_distance.detach(), value.detach())
    torch.testing.assert_close(found, expected, rtol=1e-12, atol=0)


def test_the_names_of_signatures_are_those_of_the_table():
    assert set(get_args(KernelName)) == set(KERNELS)


@pytest.mark.parametrize("estimator", [CholeskyCovRegressor, HeteroscedasticGPRegressor])
def test_a_kernel_is_one_entry_of_the_table(estimator, monkeypatch):
    """Another name gives the bits of the kernel behind it; another kernel, a rational quadratic, is fitted too."""
    monkeypatch.setitem(KERNELS, "alias", KERNELS["matern52"])
    monkeypatch.setitem(
        KERNELS, "rational_quadratic", Kernel(lambda s: 1.0 / (1.0 + 0.5 * s), lambda _, k: -0.5 * k**2)
    )
    X, y, _ = make_paper_simulation(random_state=0)
    kernels = ("squared_exponential", "matern52", "alias", "rational_quadratic")
    smooth, rough, alias, other = (estimator(kernel=kernel).fit(X, y) for kernel in kernels)
    np.testing.assert_array_equal(alias.predict_cov(X), rough.predict_cov(X))
    assert other.converged_
    assert not np.array_equal(other.predict_cov(X), rough.predict_cov(X))
    ratio = np.linalg.slogdet(other.predict_cov(X))[1] - np.linalg.slogdet(smooth.predict_cov(X))[1]
    assert np.abs(ratio).max() < 0.5  # the data tell the covariance, whatever the kernel

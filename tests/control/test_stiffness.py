"""Stiffness from covariance: values of eq. (20), laws of a spectral function, gradients, and what is refused."""

import math
import re

import numpy as np
import pytest
import torch

from torch_pbd.control.stiffness import StiffnessLaw

LAW = StiffnessLaw(sigma_low=0.01, sigma_high=0.03, bounds="sigma")
SMOOTH = StiffnessLaw(sigma_low=0.01, sigma_high=0.03, bounds="sigma", smooth=True)


def tensor(*values):
    return torch.tensor(values, dtype=torch.float64)


def rotations(*batch, d, generator):
    return torch.linalg.qr(torch.randn(*batch, d, d, dtype=torch.float64, generator=generator)).Q


def covariances(*batch, d, generator, scale=(1e-3, 0.1)):
    """Of random axes, standard deviations log-uniform between the two of ``scale``."""
    low, high = map(math.log, scale)
    scales = torch.exp(low + (high - low) * torch.rand(*batch, d, dtype=torch.float64, generator=generator))
    axes = rotations(*batch, d=d, generator=generator)
    covariance = axes * scales.square().unsqueeze(-2) @ axes.mT
    return 0.5 * (covariance + covariance.mT)


def rotated(matrix, rotation):
    return 0.5 * (rotation @ matrix @ rotation.mT + (rotation @ matrix @ rotation.mT).mT)


def test_values_are_those_of_equation_20():
    scales = tensor(0.0, 0.005, 0.01, 0.015, 0.02, 0.03, 0.5)
    expected = tensor(1000.0, 1000.0, 1000.0, 762.5, 525.0, 50.0, 50.0)
    torch.testing.assert_close(LAW(torch.diag(scales.square())), torch.diag(expected), rtol=1e-12, atol=1e-11)
    share = 0.25  # of the way from sigma_low to sigma_high, at 0.015
    smooth = 1000.0 - 950.0 * (3.0 * share**2 - 2.0 * share**3)
    assert SMOOTH(tensor([0.015**2])).item() == pytest.approx(smooth, rel=1e-12)


def test_read_as_variances_the_papers_bounds_are_their_roots(generator):
    covariance = covariances(50, d=2, generator=generator, scale=(0.01, 0.05))
    variance = StiffnessLaw(sigma_low=3.5e-4, sigma_high=1.2e-3, bounds="variance")(covariance)
    sigma = StiffnessLaw(sigma_low=0.0187082869, sigma_high=0.0346410162, bounds="sigma")
    torch.testing.assert_close(variance, sigma(covariance), rtol=1e-7, atol=1e-5)  # the roots have nine digits
    assert variance.diagonal(dim1=-2, dim2=-1).std() > 100.0


def test_quantiles_are_those_of_numpy_over_all_axes(generator):
    covariance = covariances(5, 7, d=3, generator=generator)
    law = StiffnessLaw()
    scales = np.sqrt(np.linalg.eigvalsh(covariance.numpy()))
    fitted = law.fitted(covariance)
    np.testing.assert_allclose([fitted.sigma_low, fitted.sigma_high], np.quantile(scales, [0.1, 0.9]), rtol=1e-9)
    torch.testing.assert_close(law(covariance), fitted(covariance), rtol=1e-12, atol=0)


@pytest.mark.parametrize("law", [LAW, SMOOTH])
@pytest.mark.parametrize("d", [1, 2, 9])
def test_a_turned_covariance_gives_the_turned_stiffness(law, d, generator):
    covariance, rotation = covariances(50, d=d, generator=generator), rotations(50, d=d, generator=generator)
    stiffness = law(covariance)
    assert torch.equal(stiffness, stiffness.mT)
    # A scale of 1e-3 beside one of 0.1 is known to 1e-12 of the latter squared
    torch.testing.assert_close(law(rotated(covariance, rotation)), rotated(stiffness, rotation), rtol=0, atol=1e-6)
    eigenvalues = torch.linalg.eigvalsh(stiffness)
    assert eigenvalues.min() >= 50.0 - 1e-9
    assert eigenvalues.max() <= 1000.0 + 1e-9
    torch.testing.assert_close(law(covariance[3]), stiffness[3], rtol=1e-12, atol=1e-9)


def lipschitz(law):
    """Largest change of the stiffness for one of the covariance, both in the Frobenius norm.

    (k_max - k_min) / (s_high - s_low) / (2 s_low), half as much again if smooth: F. Kittaneh, Linear Algebra and its
    Applications 71, 1985, of spectral functions.
    """
    slope = (law.stiffness_max - law.stiffness_min) / (law.sigma_high - law.sigma_low) / (2.0 * law.sigma_low)
    return 1.5 * slope if law.smooth else slope


def test_the_stiffness_is_continuous_where_the_axes_jump():
    """Two eigenvalues cross without meeting: the axes turn by 90 degrees within 1e-6 of the way."""
    way = torch.linspace(-1, 1, 4001).double()
    variance = 0.02**2 * torch.stack([1.0 + 0.2 * way, 1.0 - 0.2 * way], dim=-1)
    covariance = torch.diag_embed(variance)
    covariance[:, 0, 1] = covariance[:, 1, 0] = 0.02**2 * 1e-7
    axes = torch.linalg.eigh(covariance).eigenvectors
    turn = 1.0 - (axes[1:] * axes[:-1]).sum(-2).abs().min()
    assert turn > 0.25  # of 1 for a right angle: one sample lies within the turn
    step = torch.linalg.matrix_norm(LAW(covariance).diff(dim=0))
    bound = lipschitz(LAW) * torch.linalg.matrix_norm(covariance.diff(dim=0))
    assert (step <= bound).all()
    assert step.max() <= 1.5 * step.median()


@pytest.mark.parametrize("law", [LAW, SMOOTH])
def test_no_pair_of_covariances_is_above_the_lipschitz_bound(law, generator):
    first = covariances(100_000, d=2, generator=generator, scale=(3e-3, 0.05))
    size = 10.0 ** (-6.0 * torch.rand(100_000, 1, 1, dtype=torch.float64, generator=generator))
    second = first + size * (covariances(100_000, d=2, generator=generator, scale=(3e-3, 0.05)) - first)
    change = torch.linalg.matrix_norm(law(first) - law(second))
    ratio = change / torch.linalg.matrix_norm(first - second) / lipschitz(law)
    assert ratio.max() <= 1.0
    assert ratio.max() > 0.5


def test_the_lipschitz_bound_is_attained():
    """Just above the lower bound; of a smooth law, midway between bounds that are close together."""
    close = StiffnessLaw(sigma_low=0.02, sigma_high=0.020002, bounds="sigma", smooth=True)
    for law, scale in {LAW: 0.01, close: 0.020001}.items():
        scales = scale * tensor(1.0, 1.0 + 1e-7)
        change = law(scales.square()[:, None, None]).diff(dim=0).abs().item()
        assert change / scales.square().diff().item() == pytest.approx(lipschitz(law), rel=1e-3)
    paper = StiffnessLaw(sigma_low=3.5e-4, sigma_high=1.2e-3, bounds="sigma")
    assert lipschitz(paper) == pytest.approx(1.6e9, rel=0.01)


@pytest.mark.parametrize("smooth", [False, True])
@pytest.mark.parametrize("scales", [(20, 20), (15, 15, 25), (20, 5, 20), (12, 50), (20,)])
def test_gradients_are_those_of_finite_differences(smooth, scales, generator):
    law = StiffnessLaw(sigma_low=10.0, sigma_high=30.0, bounds="sigma", smooth=smooth)  # in mm
    diagonal = torch.diag(tensor(*scales).square())
    for axes in (torch.eye(len(scales)).double(), rotations(d=len(scales), generator=generator)):
        covariance = rotated(diagonal, axes).requires_grad_()
        # gradcheck moves one entry at a time: of the lower triangle and its mirror
        assert torch.autograd.gradcheck(lambda m: law(m.tril() + m.tril(-1).mT), covariance, rtol=1e-6)


@pytest.mark.parametrize("law", [LAW, SMOOTH, StiffnessLaw(sigma_low=0.0, sigma_high=0.03, bounds="sigma")])
@pytest.mark.parametrize("scales", [(0.0, 0.0), (0.01, 0.01), (0.03, 0.03), (0.5, 0.5), (0.0, 0.03), (0.0, 0.5)])
def test_gradients_are_finite_at_kinks_at_zero_and_where_all_axes_are_soft(law, scales):
    covariance = torch.diag(tensor(*scales).square()).requires_grad_()
    law(covariance).sum().backward()
    assert torch.isfinite(covariance.grad).all()
    if min(scales) > law.sigma_high:
        assert torch.equal(law(covariance).detach(), 50.0 * torch.eye(2).double())
        assert (covariance.grad == 0.0).all()


@pytest.mark.parametrize("bounds", ["sigma", "variance", "quantile"])
def test_in_millimetres_the_stiffness_is_the_same(bounds, generator):
    covariance = covariances(20, d=2, generator=generator)
    law = larger = StiffnessLaw()
    if bounds != "quantile":
        factor = {"sigma": 1e3, "variance": 1e6}[bounds]
        law = StiffnessLaw(sigma_low=0.01, sigma_high=0.9, bounds=bounds)
        larger = StiffnessLaw(sigma_low=0.01 * factor, sigma_high=0.9 * factor, bounds=bounds)
    torch.testing.assert_close(larger(1e6 * covariance), law(covariance), rtol=1e-9, atol=1e-8)


@pytest.mark.parametrize("covariance", [np.zeros((4, 2, 2)), np.tile(1e-4 * np.eye(2), (4, 1, 1)), [[2e-3]]])
def test_covariances_that_do_not_vary_are_told_of_and_stiff(covariance):
    d = np.shape(covariance)[-1]
    with pytest.warns(UserWarning, match="do not vary"):
        stiffness = StiffnessLaw()(covariance)
    assert torch.equal(stiffness, 1000.0 * torch.eye(d).double().expand(np.shape(covariance)))


def test_the_output_that_does_not_vary_is_named():
    covariance = np.diag([1e-4, 1e-3]) * np.linspace(1.0, 2.0, 5)[:, None, None]
    covariance[:, 1, 1] = 1e-3
    with pytest.warns(UserWarning, match="The covariances of output 1 do not vary"):
        StiffnessLaw([50.0, 50.0], 1000.0)(covariance)


def test_arrays_give_what_tensors_give_and_are_left_alone(generator):
    covariance = covariances(6, d=2, generator=generator)
    array = covariance.numpy().copy()
    array.setflags(write=False)
    assert torch.equal(StiffnessLaw()(array), StiffnessLaw()(covariance))
    np.testing.assert_array_equal(array, covariance.numpy())
    assert LAW(covariance.float()).dtype == torch.float32


GOOD = np.tile(1e-4 * np.eye(2), (3, 1, 1))


def changed(index, value):
    array = GOOD.copy()
    array[index] = value
    return array


@pytest.mark.parametrize(
    ("covariance", "words"),
    [
        (changed((2, 0, 0), np.nan), "the largest entry of covariance[2] is nan, must be finite"),
        (changed((1, 1, 1), np.inf), "the largest entry of covariance[1] is inf, must be finite"),
        (changed((1, 0, 1), 1e-6), "the asymmetry of covariance[1] is 1e-06, must be zero"),
        (changed((2, 0, 0), -1e-7), "the smallest eigenvalue of covariance[2] is -1e-07"),
        (GOOD[0, 0], "covariance has shape (2,)"),
        (GOOD[:, :, :1], "covariance has shape (3, 2, 1)"),
        (np.zeros((0, 2, 2)), "covariance is empty, must have at least one matrix"),
    ],
)
def test_what_is_not_a_covariance_is_refused_by_index(covariance, words):
    with pytest.raises(ValueError, match=re.escape(words)):
        StiffnessLaw()(covariance)


def test_rounding_errors_are_no_errors():
    covariance = tensor([1.0, 1.0 - 1e-12], [1.0, 1.0 - 1e-12])  # not quite symmetric, nor quite positive
    assert torch.isfinite(LAW(covariance)).all()


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        ({"stiffness_min": 0.0}, "stiffness_min is 0"),
        ({"stiffness_min": 2000.0}, "stiffness_max is 1000.0 N/m, must be a finite number of at least 2000"),
        ({"stiffness_max": math.nan}, "stiffness_max is nan"),
        (
            {"bounds": "sigma", "sigma_low": 0.9, "sigma_high": 0.1},
            "sigma_high is 0.1, must be a finite number above 0.9",
        ),
        ({"sigma_low": 0.01, "sigma_high": 0.03}, "are standard deviations: give bounds='sigma' with them"),
        ({"bounds": "sigma", "sigma_low": 0.1}, "sigma_high is None, must be a finite number above 0.1"),
        (
            {"bounds": "variance", "sigma_low": -1e-3, "sigma_high": 1.0},
            "sigma_low is -0.001, must be a finite number of at least 0",
        ),
        ({"bounds": "sigma", "sigma_low": 0.1, "sigma_high": math.inf}, "sigma_high is inf"),
    ],
)
def test_parameters_are_checked(parameters, words):
    with pytest.raises(ValueError, match=re.escape(words)):
        StiffnessLaw(**parameters)

"""Damping from stiffness: one damping ratio in every mode of mass and stiffness."""

import math
import re

import numpy as np
import pytest
import scipy.linalg
import scipy.stats
import torch

from torch_pbd.control.matrices import damping_from_stiffness, required_damping_ratio


def definite(*batch, d, generator, low=50.0, high=1000.0):
    """Symmetric matrices of random axes, eigenvalues log-uniform between ``low`` and ``high``."""
    axes = torch.linalg.qr(torch.randn(*batch, d, d, dtype=torch.float64, generator=generator)).Q
    share = torch.rand(*batch, d, dtype=torch.float64, generator=generator)
    matrix = axes * (low * (high / low) ** share).unsqueeze(-2) @ axes.mT
    return 0.5 * (matrix + matrix.mT)


@pytest.mark.parametrize("d", [1, 2, 9])
def test_with_one_mass_it_is_the_root_of_mass_times_stiffness(d, generator):
    stiffness = definite(4, d=d, generator=generator)
    expected = [2.0 * 0.7 * scipy.linalg.sqrtm(3.0 * each.numpy()) for each in stiffness]
    for mass in (3.0, 3.0 * torch.eye(d).double()):
        damping = damping_from_stiffness(stiffness, mass, 0.7)
        assert torch.equal(damping, damping.mT)
        np.testing.assert_allclose(damping, expected, rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(damping_from_stiffness(stiffness.numpy(), 3.0, 0.7), damping_from_stiffness(
        stiffness, 3.0, 0.7
    ))  # fmt: skip


@pytest.mark.parametrize("ratio", [0.1, 0.7, 1.5])
@pytest.mark.parametrize("d", [2, 3])
def test_every_mode_of_an_uneven_mass_has_the_damping_ratio(d, ratio, generator):
    """The roots of ``det(s^2 M + s D + K)`` are ``-zeta w +- w sqrt(zeta^2 - 1)`` for each ``K x = w^2 M x``."""
    stiffness = definite(d=d, generator=generator)
    mass = definite(d=d, generator=generator, low=0.5, high=20.0)
    damping = damping_from_stiffness(stiffness, mass, ratio)
    frequency = np.sqrt(scipy.linalg.eigh(stiffness.numpy(), mass.numpy(), eigvals_only=True))
    spread = np.sqrt(complex(ratio**2 - 1.0))
    expected = np.concatenate([frequency * (-ratio + spread), frequency * (-ratio - spread)])
    inverse = np.linalg.inv(mass.numpy())
    companion = np.block([[np.zeros((d, d)), np.eye(d)], [-inverse @ stiffness.numpy(), -inverse @ damping.numpy()]])
    roots = np.linalg.eigvals(companion)
    order = [abs(roots - each).argmin() for each in expected]
    assert sorted(order) == list(range(2 * d))
    np.testing.assert_allclose(roots[order], expected, rtol=1e-9)


@pytest.mark.parametrize("ratio", [0.3, 0.7, 1.0, 1.6])
def test_every_mode_of_an_arm_has_the_damping_ratio_along_its_way(ratio, rng):
    """Poses in N/m and Nm/rad, an inertia for each row: 6-19 kg and 0.1-0.9 kg m2, coupled; to 1e-9.

    ``x' D x / (2 sqrt(x' M x x' K x))`` of the modes ``K x = w^2 M x``, and no coupling between them.
    """
    scale = np.repeat([[6.0, 19.0], [0.1, 0.9]], 3, axis=0)
    axes = scipy.stats.special_ortho_group.rvs(6, size=40, random_state=0)
    shared = axes * rng.uniform(0.4, 1.0, size=(40, 1, 6)) @ axes.swapaxes(1, 2)
    sizes = np.sqrt(np.exp(rng.uniform(*np.log(scale.T), size=(40, 6))))
    mass = sizes[:, :, None] * shared * sizes[:, None]
    stiffness = np.zeros((40, 6, 6))
    turned = scipy.stats.special_ortho_group.rvs(3, size=80, random_state=1)
    for block, (low, high), turn in (
        (slice(0, 3), (10.0, 3000.0), turned[:40]),
        (slice(3, 6), (1.0, 300.0), turned[40:]),
    ):
        values = np.exp(rng.uniform(*np.log([low, high]), size=(40, 1, 3)))
        stiffness[:, block, block] = turn * values @ turn.swapaxes(1, 2)
    mass, stiffness = (0.5 * (matrix + matrix.swapaxes(1, 2)) for matrix in (mass, stiffness))
    damping = damping_from_stiffness(stiffness, mass, ratio).numpy()
    for each, inertia, spring in zip(damping, mass, stiffness, strict=True):
        squared, modes = scipy.linalg.eigh(spring, inertia)  # x' M x = 1
        modal = modes.T @ each @ modes / (2.0 * np.sqrt(np.sqrt(np.outer(squared, squared))))
        np.testing.assert_allclose(modal, ratio * np.eye(6), rtol=0, atol=1e-9)


def test_the_papers_damping_is_the_root_of_the_stiffness_whatever_the_mass(generator):
    stiffness = definite(4, d=2, generator=generator)
    paper = damping_from_stiffness(stiffness, 4.0, "paper")
    for each, matrix in zip(paper, stiffness, strict=True):
        np.testing.assert_allclose(each, scipy.linalg.sqrtm(matrix.numpy()), rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(paper, damping_from_stiffness(stiffness, 4.0, 0.25), rtol=1e-9, atol=1e-11)


def test_it_is_differentiable_in_stiffness_and_mass(generator):
    stiffness = definite(2, d=2, generator=generator, low=1.0, high=5.0).requires_grad_()
    mass = definite(d=2, generator=generator, low=0.5, high=2.0).requires_grad_()

    def symmetric(matrix):
        return matrix.tril() + matrix.tril(-1).mT

    assert torch.autograd.gradcheck(
        lambda k, m: damping_from_stiffness(symmetric(k), symmetric(m), 0.7), (stiffness, mass)
    )
    assert torch.autograd.gradcheck(lambda k: damping_from_stiffness(symmetric(k), 2.0, "paper"), stiffness)


@pytest.mark.parametrize("mass", [2.0, torch.diag(torch.tensor([2.0, 1.0]).double())])
def test_a_free_axis_is_undamped_and_has_a_finite_gradient(mass):
    stiffness = torch.diag(torch.tensor([0.0, 100.0]).double()).requires_grad_()
    damping = damping_from_stiffness(stiffness, mass)
    assert damping[0].abs().max() == 0.0
    damping.sum().backward()
    assert torch.isfinite(stiffness.grad).all()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"mass": 0.0}, "mass is 0.0 kg, must be a finite number above 0"),
        ({"mass": math.nan}, "mass is nan"),
        ({"mass": torch.diag(torch.tensor([1.0, 0.0]))}, "the smallest eigenvalue of mass is 0.0, must be above zero"),
        ({"mass": torch.tensor([[1.0, 0.5], [0.0, 1.0]])}, "the asymmetry of mass is 0.5"),
        ({"damping_ratio": -0.1}, "damping_ratio is -0.1"),
        ({"damping_ratio": math.inf}, "damping_ratio is inf"),
        ({"stiffness": -np.eye(2)}, "the smallest eigenvalue of stiffness is -1.0, must be zero or more"),
        ({"stiffness": np.full((3, 2, 2), np.nan)}, "the largest entry of stiffness[0] is nan, must be finite"),
    ],
)
def test_what_makes_no_damping_is_refused(arguments, words):
    with pytest.raises(ValueError, match=re.escape(words)):
        damping_from_stiffness(**{"stiffness": np.eye(2), **arguments})


@pytest.mark.parametrize("ratio", [1.01, 2.0, 20.0, 33.9, 100.0, 193.0, 195.0, 500.0, 800.0])
def test_the_required_ratio_is_where_a_common_function_begins_to_fall_everywhere(ratio):
    """Its derivative is searched for its sign over all weights b and all stiffnesses, not only at the ends."""
    weight = np.linspace(0.0, 1.0, 4001)[1:-1, None, None]
    scale = np.geomspace(ratio**-0.25, ratio**0.25, 201)[None, :, None]

    def falls(zeta):
        # dV/dt of V = y^2 + 2 b y v + v^2 with y'' = -s^2 y - 2 zeta s y', at the angles of (y, v).
        diagonal = -2.0 * weight * scale**2, 2.0 * weight - 4.0 * zeta * scale
        off = 1.0 - 2.0 * weight * zeta * scale - scale**2
        negative = (diagonal[1] < 0.0) & (diagonal[0] * diagonal[1] > off**2)
        return bool(negative.all(axis=1).any())

    required = required_damping_ratio(ratio)
    assert falls(1.002 * required)
    assert not falls(0.998 * required)
    assert falls(3.0 * required)


def test_the_required_ratio_of_the_paper_and_of_critical_damping():
    assert required_damping_ratio(20.0) == pytest.approx(0.8209, abs=1e-4)
    assert required_damping_ratio(33.97) == pytest.approx(1.0, abs=1e-4)
    assert required_damping_ratio(1.0) == 0.0
    assert required_damping_ratio(1160.0) == math.inf
    with pytest.raises(ValueError, match=r"stiffness_ratio is 0\.5, must be a finite number of at least 1"):
        required_damping_ratio(0.5)


def test_the_required_ratio_is_its_closed_form():
    """Its proof is in test_stability: a function that falls from this ratio on, and below it none that does."""
    for ratio, expected in {1.0: 0.0, 2.0: 0.174, 10.0: 0.608, 20.0: 0.821, 33.97: 1.0, 100.0: 1.423}.items():
        assert required_damping_ratio(ratio) == pytest.approx(expected, abs=5e-4)
    critical = (math.sqrt(3.0) + 2.0) ** 4  # where one formula takes over from the other, at 3^(1/2)
    for ratio in (critical * (1.0 - 1e-9), critical * (1.0 + 1e-9)):
        assert required_damping_ratio(ratio) == pytest.approx(math.sqrt(3.0), rel=1e-6)
    last = (math.sqrt(2.0) + 1.0) ** 8
    assert required_damping_ratio(0.999 * last) > 30.0
    assert required_damping_ratio(1.001 * last) == math.inf
    for wrong in (0.99, math.nan, math.inf):
        with pytest.raises(ValueError, match="stiffness_ratio is "):
            required_damping_ratio(wrong)

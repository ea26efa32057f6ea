"""Laws of blocks: poses, joints, what couples them; and the law of minimal intervention against scipy's regulator."""

import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.linalg import block_diag, solve_continuous_are

from torch_pbd import CholeskyCovRegressor, DMPController
from torch_pbd.control import RotationLimits, Schedule, StiffnessLaw, damping_from_stiffness, lqt
from torch_pbd.data import make_tunnel_demonstrations

ROTATION = RotationLimits(2.0, 60.0, sigma_low=0.02, sigma_high=0.3)
POSE = StiffnessLaw(50.0, 1000.0, 0.002, 0.03, "sigma", rotation=ROTATION)
LAWS = {
    "block": POSE,
    "coupled": StiffnessLaw(50.0, 1000.0, 0.002, 0.03, "sigma", rotation=ROTATION, cross_terms=True),
    "smooth": StiffnessLaw(50.0, 1000.0, 0.002, 0.03, "sigma", smooth=True, rotation=ROTATION, cross_terms=True),
    "quantile": StiffnessLaw(50.0, 1000.0, rotation=RotationLimits(2.0, 60.0), cross_terms=True),
    "precision": StiffnessLaw(50.0, 1000.0, rotation=RotationLimits(2.0, 60.0), kind="precision"),
    "coupled precision": StiffnessLaw(
        50.0, 1000.0, rotation=RotationLimits(2.0, 60.0), kind="precision", cross_terms=True
    ),
}
INERTIA = np.array([8.0, 12.0, 6.0, 0.4, 0.2, 0.1])


def pose_covariances(n, rng, coupling=1.0):
    """Of positions from 0.3 to 100 mm and rotations from 3 mrad to 1 rad, correlated by random numbers."""
    scales = np.exp(rng.uniform(np.log([3e-4] * 3 + [3e-3] * 3), np.log([0.1] * 3 + [1.0] * 3), size=(n, 6)))
    root = rng.normal(size=(n, 6, 9))
    whole = root @ root.mT / 9.0
    whole[:, :3, 3:] *= coupling
    whole[:, 3:, :3] *= coupling
    return scales[:, :, None] * whole * scales[:, None]


def arm_mass(rng):
    root = rng.normal(size=(6, 9))
    correlation = root @ root.T / 9.0 + np.eye(6)
    return np.sqrt(INERTIA)[:, None] * correlation * np.sqrt(INERTIA)


@pytest.mark.parametrize("name", LAWS)
def test_the_stiffness_is_within_its_limits_as_a_matrix(name, rng):
    law, mass = LAWS[name], arm_mass(rng)
    stiffness = law(pose_covariances(4000, rng), mass).numpy()
    low, high = map(np.array, law.limits(6))
    metric = np.sqrt(high - low)
    share = (stiffness - np.diag(low)) / metric[:, None] / metric
    eigenvalues = np.linalg.eigvalsh(share)
    assert eigenvalues.min() >= -1e-10
    assert eigenvalues.max() <= 1.0 + 1e-10
    assert eigenvalues.std() > 0.2
    np.testing.assert_array_equal(stiffness, stiffness.mT)
    assert (np.abs(stiffness[:, :3, 3:]).max() > 1.0) == law.cross_terms


@pytest.mark.parametrize("name", ["coupled", "smooth", "quantile", "coupled precision"])
def test_without_cross_covariances_cross_terms_change_nothing(name, rng):
    law, covariance = LAWS[name], pose_covariances(50, rng, coupling=0.0)
    mass = block_diag(arm_mass(rng)[:3, :3], arm_mass(rng)[3:, 3:])
    plain = StiffnessLaw(
        50.0, 1000.0, law.sigma_low, law.sigma_high, law.bounds, law.smooth, kind=law.kind, rotation=law.rotation
    )
    torch.testing.assert_close(law(covariance, mass), plain(covariance, mass), rtol=1e-9, atol=1e-9)


def test_blocks_have_the_laws_of_positions_and_of_rotations_alone(rng):
    covariance = pose_covariances(50, rng)
    stiffness = StiffnessLaw(rotation=RotationLimits())(covariance)
    torch.testing.assert_close(
        stiffness[:, :3, :3], StiffnessLaw()(covariance[:, :3, :3].copy()), rtol=1e-12, atol=1e-12
    )
    torch.testing.assert_close(
        stiffness[:, 3:, 3:], StiffnessLaw(2.5, 50.0)(covariance[:, 3:, 3:]), rtol=1e-12, atol=1e-12
    )
    assert float(stiffness[:, :3, 3:].abs().max()) == 0.0


@pytest.mark.parametrize("name", LAWS)
def test_no_length_and_no_angle_is_special(name, rng):
    """In mm and degrees: m = 1000 mm, rad = 57.3 deg; forces stay N, torques Nm, so gains are per mm and per degree."""
    law, covariance, mass = LAWS[name], pose_covariances(50, rng), arm_mass(rng)
    unit = np.array([1e3] * 3 + [np.rad2deg(1.0)] * 3)
    sigma = [None, None] if law.bounds == "quantile" else [1e3 * law.sigma_low, 1e3 * law.sigma_high]
    angle = law.rotation
    own = [None, None] if law.bounds == "quantile" else [unit[3] * angle.sigma_low, unit[3] * angle.sigma_high]
    limits = [value / unit[3] ** 2 for value in (angle.stiffness_min, angle.stiffness_max)]
    scaled = StiffnessLaw(
        50e-6, 1e-3, *sigma, law.bounds, law.smooth,
        kind=law.kind, rotation=RotationLimits(*limits, *own), cross_terms=law.cross_terms,
    )  # fmt: skip
    result = scaled(unit[:, None] * covariance * unit, mass / unit[:, None] / unit)
    expected = law(covariance, mass) / torch.tensor(unit[:, None] * unit)
    # Relative to the gains on the diagonal: eigenvalues that are held have no digits off it.
    size = expected.diagonal(dim1=-2, dim2=-1).sqrt()
    error = (result - expected) / size[:, :, None] / size[:, None]
    assert float(error.abs().max()) < 1e-9


@pytest.mark.parametrize("name", LAWS)
def test_turned_blocks_give_turned_stiffness(name, rng):
    law, covariance, mass = LAWS[name], pose_covariances(50, rng), arm_mass(rng)
    turn = block_diag(*(np.linalg.qr(rng.normal(size=(3, 3)))[0] for _ in range(2)))
    turned = law(turn @ covariance @ turn.T, turn @ mass @ turn.T).numpy()
    size = np.array([1000.0] * 3 + [60.0] * 3) ** 0.5
    error = (turned - turn @ law(covariance, mass).numpy() @ turn.T) / size[:, None] / size
    assert np.abs(error).max() < 1e-9


@pytest.mark.parametrize("name", LAWS)
def test_a_law_that_was_fitted_gives_the_same(name, rng):
    law, covariance, mass = LAWS[name], pose_covariances(50, rng), arm_mass(rng)
    fitted = law.fitted(covariance, mass=mass)
    torch.testing.assert_close(fitted(covariance, mass), law(covariance, mass), rtol=1e-9, atol=1e-9)
    assert fitted.bounds == "sigma"
    assert fitted.rotation.sigma_high > fitted.rotation.sigma_low > 0.0


@pytest.mark.parametrize("name", ["block", "coupled", "smooth", "coupled precision"])
def test_gradients_of_coupled_laws_are_those_of_finite_differences(name, rng):
    law, mass = LAWS[name], arm_mass(rng)
    scales = np.array([0.01, 0.012, 0.02, 0.1, 0.15, 0.2])
    root = rng.normal(size=(6, 20))
    unitless = torch.tensor(root @ root.T / 20.0).requires_grad_()
    law = law.fitted(scales[:, None] * pose_covariances(50, rng) * scales, mass=mass) if law.bounds != "sigma" else law
    stretch = torch.tensor(scales)
    assert torch.autograd.gradcheck(
        lambda m: law(stretch[:, None] * (m.tril() + m.tril(-1).mT) * stretch, mass), unitless, rtol=1e-5
    )


def test_joints_have_limits_of_their_own(rng):
    covariance = np.stack([0.02 * np.eye(3), 0.5 * np.eye(3), np.diag([1e-4, 0.1, 2.0])])
    covariance[:, 0, 1] = covariance[:, 1, 0] = 1e-4
    law = StiffnessLaw([10.0, 20.0, 30.0], [100.0, 200.0, 300.0], 0.05, 1.0, "sigma")
    stiffness = law(covariance).numpy()
    scales = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    share = np.clip((scales - 0.05) / 0.95, 0.0, 1.0)
    expected = np.array([100.0, 200.0, 300.0]) - share * np.array([90.0, 180.0, 270.0])
    np.testing.assert_allclose(stiffness, expected[:, :, None] * np.eye(3), rtol=1e-12, atol=1e-12)
    assert law.limits(3) == ((10.0, 20.0, 30.0), (100.0, 200.0, 300.0))
    coupled = StiffnessLaw([10.0, 20.0, 30.0], [100.0, 200.0, 300.0], 0.05, 1.0, "sigma", cross_terms=True)
    assert float(coupled(covariance)[0, 0, 1].abs()) > 1e-3
    fitted = StiffnessLaw(10.0, (100.0, 200.0, 300.0)).fitted(covariance)
    np.testing.assert_allclose(fitted.sigma_high, np.quantile(scales, 0.9, axis=0), rtol=1e-12)
    with pytest.raises(ValueError, match="covariance is of 2 outputs, must be of 3, as the law is"):
        law(np.eye(2))


def regulator(covariance, mass, effort):
    """Gains of scipy's Riccati solver for the cost e' covariance^-1 e + effort f' mass^-1 f."""
    d = len(mass)
    state, control = np.zeros((2 * d, 2 * d)), np.zeros((2 * d, d))
    state[:d, d:], control[d:] = np.eye(d), np.linalg.inv(mass)
    weight = block_diag(np.linalg.inv(covariance), np.zeros((d, d)))
    cost = solve_continuous_are(state, control, weight, effort * np.linalg.inv(mass))
    gains = np.linalg.solve(effort * np.linalg.inv(mass), control.T @ cost)
    return gains[:, :d], gains[:, d:]


@pytest.mark.parametrize("d", [1, 2, 6])
def test_minimal_intervention_is_the_optimal_regulator(d, rng):
    for _ in range(5):
        covariance, mass = pose_covariances(1, rng)[0][:d, :d] + 1e-6 * np.eye(d), arm_mass(rng)[:d, :d]
        law = StiffnessLaw(1e-3, 1e7, kind="precision", effort=2e-3, bounds="sigma", sigma_low=0.0, sigma_high=1.0)
        stiffness = law(covariance, mass).numpy()
        expected, damping = regulator(covariance, mass, 2e-3)
        size = np.sqrt(np.diagonal(expected))[:, None] * np.sqrt(np.diagonal(expected))
        np.testing.assert_allclose(stiffness / size, expected / size, rtol=0, atol=1e-8)
        own = damping_from_stiffness(stiffness, mass, 0.5**0.5).numpy()
        size = np.sqrt(np.diagonal(damping))[:, None] * np.sqrt(np.diagonal(damping))
        np.testing.assert_allclose(own / size, damping / size, rtol=0, atol=1e-8)


def test_a_schedule_takes_the_law_with_the_inertia_of_each_row(rng):
    """The regulator of scipy row by row; with one mass and its own law, the schedule of the controller itself."""
    n, still = 7, np.zeros((7, 3))
    mass = np.stack([arm_mass(rng) for _ in range(n)])
    gains = {"stiffness": np.tile(np.eye(6), (n, 1, 1)), "damping": np.tile(np.eye(6), (n, 1, 1))}
    covariance = pose_covariances(n, rng) + 1e-6 * np.eye(6)
    rows = {"velocity": np.zeros((n, 6)), "covariance": covariance, "type1": np.zeros(n)}
    orientation = np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))
    schedule = Schedule(0.1 * np.arange(n), still, **rows, **gains, orientation=orientation)
    law = StiffnessLaw(1e-3, 1e7, 0.0, 1.0, "sigma", kind="precision", effort=2e-3)
    made = schedule.with_inertia(mass, 0.5**0.5, law=law)
    assert made.stiffness_limits == (1e-3, 1e7)
    for own, damping, sigma, each in zip(made.stiffness, made.damping, covariance, mass, strict=True):
        for found, expected in zip((own, damping), regulator(sigma, each, 2e-3), strict=True):
            size = np.sqrt(np.diagonal(expected))[:, None] * np.sqrt(np.diagonal(expected))
            np.testing.assert_allclose(found / size, expected / size, rtol=0, atol=1e-8)

    pose = StiffnessLaw(kind="precision", rotation=RotationLimits(), cross_terms=True)
    held = schedule.with_inertia(mass, law=pose)
    low, high = (np.array(limit) for limit in pose.limits(6))
    unit = np.sqrt(high)[:, None] * np.sqrt(high)
    for bound, sign in ((np.diag(low), 1.0), (np.diag(high), -1.0)):
        assert np.linalg.eigvalsh(sign * (held.stiffness - bound) / unit).min() > -1e-10
    half = replace(schedule, type1=np.full(n, 0.5)).with_inertia(mass, law=pose)
    np.testing.assert_allclose(half.stiffness, 0.5 * (held.stiffness + np.diag(low)), rtol=1e-12)
    with pytest.raises(ValueError, match="law is 'precision', must be a StiffnessLaw or None"):
        schedule.with_inertia(mass, law="precision")


def test_the_law_and_the_mass_of_a_controller_give_its_own_schedule():
    shown = make_tunnel_demonstrations(4, rate=25.0, random_state=0)
    law = StiffnessLaw(kind="precision")
    controller = DMPController(CholeskyCovRegressor(), n_steps=40, mass=3.0, stiffness_law=law).fit(shown)
    schedule = controller.schedule(20.0)
    again = schedule.with_inertia(3.0, law=controller.law_)
    np.testing.assert_allclose(again.stiffness, schedule.stiffness, rtol=1e-9)
    np.testing.assert_allclose(again.damping, schedule.damping, rtol=1e-9)
    assert again.stiffness_limits == schedule.stiffness_limits
    lighter = schedule.with_inertia(1.0, law=law)  # matched anew: the stiffness is of no mass
    np.testing.assert_allclose(lighter.stiffness, schedule.with_inertia(9.0, law=law).stiffness, rtol=1e-9)


def test_of_one_mass_it_is_the_inverse_root_of_the_covariance_and_matches_at_the_upper_quantile(rng):
    covariance = pose_covariances(200, rng)[:, :3, :3]
    law = StiffnessLaw(kind="precision").fitted(covariance, mass=2.0)
    scale = torch.tensor([law.sigma_high**2, (0.3 * law.sigma_high) ** 2, 0.0], dtype=torch.float64)
    # At sigma_high the least stiffness; at a third of it, three times that; of no variance, the largest.
    torch.testing.assert_close(
        law(torch.diag(scale), 2.0).diagonal(),
        torch.tensor([50.0, 50.0 / 0.3, 1000.0], dtype=torch.float64),
        rtol=1e-9,
        atol=1e-9,
    )


def test_tracking_what_does_not_change_is_the_stationary_regulator(rng):
    covariance, mass = pose_covariances(1, rng)[0] + 1e-6 * np.eye(6), arm_mass(rng)
    expected = regulator(covariance, mass, 1e-3)
    for horizon in (None, 0.05):
        found = lqt(np.tile(covariance, (30, 1, 1)), mass, 0.01, effort=1e-3, horizon=horizon)
        for gain, own in zip(found, expected, strict=True):
            size = np.sqrt(np.diagonal(own))[:, None] * np.sqrt(np.diagonal(own))
            assert np.abs((gain.numpy() - own) / size).max() < 1e-7


def test_tracking_sees_what_is_ahead_and_no_further_than_its_horizon():
    variance = np.where(np.arange(200) < 100, 1e-2, 1e-4)[:, None, None]
    near, far = (lqt(variance, 1.0, 0.01, effort=1e-3, horizon=h)[0][:, 0, 0].numpy() for h in (0.2, None))
    still = 1.0 / np.sqrt(1e-3 * variance[:, 0, 0])  # m^1/2 / (r^1/2 sigma)
    np.testing.assert_allclose(near[:79], still[:79], rtol=1e-9)
    assert far[90] > 1.3 * still[90]
    np.testing.assert_allclose(near[[95, 150]], far[[95, 150]], rtol=0.05)
    # Riccati of small steps: backward Euler of the same equation, to first order.
    cost = np.array([[still[-1] * np.sqrt(2.0 * still[-1]), still[-1]], [still[-1], np.sqrt(2.0 * still[-1])]]) * 1e-3
    state, control = np.array([[0.0, 1.0], [0.0, 0.0]]), np.diag([0.0, 1e3])
    for row in range(198, 89, -1):
        for _ in range(200):
            slope = state.T @ cost + cost @ state - cost @ control @ cost + np.diag([1.0 / variance[row, 0, 0], 0.0])
            cost = cost + 5e-5 * slope
    assert far[90] == pytest.approx(1e3 * cost[1, 0], rel=2e-3)


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        ({"stiffness_min": [1.0, 0.0]}, "stiffness_min of output 1 is 0.0, must be a finite number above 0"),
        (
            {"stiffness_min": [1.0, 2.0], "stiffness_max": [3.0] * 3},
            "limits have 2 and 3 numbers, must have one, or one for each output",
        ),
        (
            {"rotation": RotationLimits(sigma_low=0.1, sigma_high=0.2)},
            "sigma_low=0.1 and sigma_high=0.2 of rotations are standard",
        ),
        (
            {"bounds": "sigma", "sigma_low": 0.1, "sigma_high": 0.2, "rotation": RotationLimits()},
            "sigma_low of rotations",
        ),
        ({"kind": "precision", "smooth": True}, "smooth is True, must be False with kind='precision'"),
        ({"kind": "precision", "effort": -1.0}, "effort is -1.0 kg/N^2, must be a finite number above 0"),
    ],
)
def test_parameters_of_blocks_are_checked(parameters, words):
    with pytest.raises(ValueError, match=re.escape(words)):
        StiffnessLaw(**parameters)


def test_what_a_law_needs_is_asked_for():
    with pytest.raises(
        ValueError, match=r"stiffness_max of rotations is 1\.0 Nm/rad, must be a finite number of at least 2"
    ):
        RotationLimits(2.0, 1.0)
    with pytest.raises(ValueError, match="mass is None, must be given"):
        StiffnessLaw(kind="precision")(np.diag([1.0, 2.0, 3.0]))
    with pytest.raises(ValueError, match="mass has shape"):
        StiffnessLaw(kind="precision")(np.diag([1.0, 2.0, 3.0]), np.eye(2))
    with pytest.raises(ValueError, match="3 outputs, must be of one or more and then 3 of rotation"):
        POSE(np.eye(3))
    with pytest.raises(ValueError, match="effort has 2 numbers, must be one, or 1"):
        StiffnessLaw(kind="precision", effort=(1.0, 2.0))(np.diag([1.0, 2.0]), 1.0)
    with pytest.raises(ValueError, match="be positive definite: lqt has no limits"):
        lqt(np.zeros((3, 2, 2)), 1.0, 0.01)

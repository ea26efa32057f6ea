"""Poses and joints: what is learned in a chart is followed at the pose, and no frame, unit or sign matters."""

import copy
import re

import numpy as np
import pandas as pd
import pytest

import torch_pbd
from torch_pbd import (
    CholeskyCovRegressor,
    Demonstrations,
    DMPController,
    GMMBaseline,
    KMPBaseline,
    ProMPBaseline,
    TrajectoryRegressor,
)
from torch_pbd.control import RotationLimits, StiffnessLaw
from torch_pbd.control.primitive.outputs import Outputs
from torch_pbd.data import make_pose_demonstrations, make_tunnel_demonstrations
from torch_pbd.rotations import conjugate, exp, log, matrix, multiply

NAMES = ["x", "y", "z", "qw", "qx", "qy", "qz"]
WORLD, TOOL = exp(np.array([0.7, -1.1, 0.4])), exp(np.array([-0.3, 0.9, 1.7]))
SIZE = np.sqrt([1000.0] * 3 + [50.0] * 3)
QUICK = CholeskyCovRegressor(max_iter=5)  # where the regressor does not matter


def fitted(demonstrations, regressor=QUICK, **options):
    return DMPController(regressor, n_steps=40, **options).fit(demonstrations)


def poses(unit="m", **changes):
    """The made task, its poses (p, q) changed by a function, in a unit of length."""
    made = make_pose_demonstrations(8, rate=50.0, random_state=0)
    change = changes.get("by", lambda p, q: (p, q))
    scale = {"m": 1.0, "mm": 1e3}[unit]
    rows = [change(p, q) for p, q in zip(*made.to_poses(), strict=True)]
    columns = [np.hstack([scale * p, q]) for p, q in rows]
    return Demonstrations(made.times, columns, names=NAMES, units=unit, rotation=NAMES[3:])


def in_world(p, q):
    return p @ matrix(WORLD).T + np.array([0.3, -2.0, 5.0]), multiply(WORLD, q)


CHANGES = {
    "signs": {"by": lambda p, q: (p, q * np.where(np.arange(len(q)) % 7 == 3, -1.0, 1.0)[:, None])},
    "world": {"by": in_world},
    "tool": {"by": lambda p, q: (p, multiply(q, TOOL))},
    "mm": {"unit": "mm"},
}


@pytest.fixture(scope="module")
def controller():
    return fitted(poses())


@pytest.fixture(scope="module")
def bendable():
    return fitted(poses(), TrajectoryRegressor(QUICK))


def angles(first, second):
    return np.linalg.norm(log(multiply(conjugate(first), second)), axis=-1)


def coordinates(controller, demonstrations):
    z = controller.outputs_.encode(controller.varying(controller.smooth(demonstrations)))
    return z - z.mean(axis=(0, 1))


def assert_no_frame_matters(one, change):
    other = fitted(poses(**CHANGES[change]), one.covariance, stiffness_law=one.stiffness_law)
    # What the regressor is given is the same.
    z, same = coordinates(other, poses(**CHANGES[change])), coordinates(one, poses())
    np.testing.assert_allclose(z, same, rtol=0, atol=1e-10)
    mine, its = one.schedule(50.0), other.schedule(50.0)
    turn = np.eye(6)
    if change == "world":
        turn[:3, :3] = turn[3:, 3:] = matrix(WORLD)
    error = (turn.T @ its.stiffness @ turn - mine.stiffness) / SIZE[:, None] / SIZE
    assert np.abs(error).max() < 1e-6
    scale = np.sqrt(np.diagonal(mine.covariance, axis1=1, axis2=2))
    error = (turn.T @ its.covariance @ turn - mine.covariance) / scale[:, :, None] / scale[:, None]
    assert np.abs(error).max() < 1e-6
    np.testing.assert_allclose(its.velocity @ turn, mine.velocity, rtol=0, atol=1e-6)
    assert angles(its.orientation, mine.orientation).std() < 1e-6


COUPLED = StiffnessLaw(rotation=RotationLimits(), cross_terms=True)


@pytest.fixture(scope="module")
def coupled():
    return fitted(poses(), stiffness_law=COUPLED)


@pytest.mark.parametrize("change", CHANGES)
def test_signs_frames_tools_and_millimetres_change_nothing(coupled, change):
    assert_no_frame_matters(coupled, change)


@pytest.mark.slow
@pytest.mark.parametrize("change", CHANGES)
def test_nor_do_they_with_the_regressor_we_recommend(change):
    assert_no_frame_matters(fitted(poses(), None), change)


def test_the_reproduced_poses_are_the_mean_of_the_demonstrations(controller):
    time = np.linspace(0.0, controller.duration_, 40)
    position, orientation = controller.predict_pose(time[:, None])
    shown = controller.smooth(poses(), 40).position
    np.testing.assert_allclose(position, shown[:, :, :3].mean(axis=0), atol=1e-3)
    vectors = [
        log(multiply(conjugate(orientation), each)) for each in map(controller.outputs_._chart.exp, shown[..., 3:])
    ]
    assert np.abs(np.mean(vectors, axis=0)).max() < 0.02
    np.testing.assert_allclose(np.linalg.norm(orientation, axis=1), 1.0, rtol=1e-14)
    with pytest.raises(ValueError, match="have no rotation"):
        fitted(make_tunnel_demonstrations(4, rate=20.0, random_state=0)).predict_pose([[0.0]])


def test_the_schedule_moves_as_its_twists_and_accelerations_say(controller):
    rate = 200.0
    schedule = controller.schedule(rate)
    assert (schedule.n_outputs, schedule.position.shape[1], schedule.units) == (6, 3, "m")
    assert schedule.names == ("x", "y", "z", "rx", "ry", "rz")
    # Of central differences: turned from the row before to the row after, in the axes of the world.
    turned = log(multiply(schedule.orientation[2:], conjugate(schedule.orientation[:-2]))) * rate / 2.0
    np.testing.assert_allclose(schedule.velocity[1:-1, 3:], turned, rtol=0, atol=2e-3 * np.abs(turned).max())
    for rows, slope in ((schedule.position, schedule.velocity[:, :3]), (schedule.velocity, schedule.acceleration)):
        found = (rows[2:-1] - rows[:-3]) * rate / 2.0  # the last interval is shorter
        np.testing.assert_allclose(found, slope[1:-2], rtol=0, atol=5e-3 * np.abs(slope).max())


@pytest.mark.parametrize("options", [{}, {"settle": 1.0, "speed": 0.7}, {"goal": [0.1, 0.7], "start": [0.02, 0.05]}])
@pytest.mark.parametrize("adaptation", ["safe", "additive"])
def test_positions_alone_have_their_acceleration_too(adaptation, options):
    cut = make_tunnel_demonstrations(4, rate=20.0, random_state=0)  # 0.06 m/s to the last
    controller = fitted(cut, adaptation=adaptation)
    schedule = controller.schedule(200.0, **options)
    found = np.gradient(schedule.velocity, schedule.time, axis=0)
    error = np.abs(found - schedule.acceleration)[1:-1]
    assert np.quantile(error, 0.99) < 2e-3 * np.abs(schedule.acceleration).max()
    assert error.max() < 0.1 * np.abs(schedule.acceleration).max()  # the brake has corners in it
    assert schedule.orientation is None


def test_covariances_are_those_of_deviations_at_the_pose(rng):
    """Against the deviations themselves: at 100 degrees from the reference the chart is off by 43 degrees."""
    root = 1e-4 * rng.normal(size=(6, 6))
    outputs = Outputs(3, None, exp(np.array([0.2, 0.9, -0.5])), np.eye(6))
    path = np.hstack([np.zeros(3), 1.8 * np.array([0.6, 0.0, 0.8])])
    steps = path + np.concatenate([root.T, -root.T])
    positions, orientations = outputs.poses(steps)
    desired = outputs.poses(path)[1]
    deviation = np.hstack([positions, log(multiply(orientations, conjugate(desired)))])
    found = outputs.covariance((root @ root.T)[None], path[None])[0]
    np.testing.assert_allclose(found, deviation.T @ deviation / 2.0, rtol=1e-6, atol=1e-14)


def test_gains_are_of_blocks_unless_cross_terms_are_asked_for(controller, coupled):
    schedule = controller.schedule(50.0)
    for matrices in (schedule.stiffness, schedule.covariance):
        assert np.abs(matrices[:, :3, 3:]).max() == 0.0
    assert schedule.stiffness_limits == ((50.0,) * 3 + (2.5,) * 3, (1000.0,) * 3 + (50.0,) * 3)
    for block, low, high in ((slice(0, 3), 50.0, 1000.0), (slice(3, 6), 2.5, 50.0)):
        own = np.linalg.eigvalsh(schedule.stiffness[:, block, block])
        assert low - 1e-9 <= own.min() < 2.0 * low
        assert 0.9 * high < own.max() <= high + 1e-9
    assert np.abs(coupled.schedule(50.0).covariance[:, :3, 3:]).max() > 0.0
    assert np.abs(coupled.schedule(50.0).stiffness[:, :3, 3:]).max() > 1.0


def test_starts_and_goals_are_poses_or_outputs(controller):
    _, at = controller.predict_pose([[0.0], [controller.duration_]])
    start = np.r_[controller.start_[:3] + 0.05, multiply(exp(np.array([0.2, 0.0, 0.1])), at[0])]
    goal = np.r_[controller.goal_[:3] - 0.05, -multiply(exp(np.array([0.0, 0.3, 0.0])), at[1])]
    moved = controller.schedule(100.0, start=start, goal=goal)
    for row, pose in ((0, start), (-1, goal)):
        np.testing.assert_allclose(moved.position[row], pose[:3], rtol=0, atol=1e-9)
        assert angles(moved.orientation[row], pose[3:]) < 1e-9
    outputs = controller.outputs_.rows(goal, "goal")
    assert moved == controller.schedule(100.0, start=start, goal=outputs)


@pytest.mark.parametrize(
    ("goal", "words"),
    [
        (np.zeros(5), "goal has shape (5,), must have 7 columns, position and quaternion w x y z, or the 6"),
        (np.r_[np.zeros(3), 0.5, 0.0, 0.0, 0.0], "the norm of the quaternion of goal is 0.5, must be 1"),
        (np.r_[np.nan, np.zeros(5)], "goal[0] is nan, must be finite"),
        (np.r_[np.zeros(5), np.nan], "goal has a part of the rotation, must have all of it, or NaN for all of it"),
        ("turned over", "in degrees, is 170"),
        ("turned over", "is the quaternion in the order w x y z?"),
    ],
)
def test_goals_that_are_no_poses_of_this_task_are_refused(controller, goal, words):
    if isinstance(goal, str):
        away = np.r_[np.zeros(3), np.deg2rad(170.0), 0.0, 0.0]
        goal = np.concatenate(controller.outputs_.poses(away))
    with pytest.raises(ValueError, match=re.escape(words)):
        controller.schedule(50.0, goal=goal)


def test_a_movement_of_poses_is_bent_through_poses(bendable):
    at = 0.5 * bendable.duration_
    position, orientation = (part[0] for part in bendable.predict_pose([[at]]))
    via = np.r_[position + np.array([0.02, 0.0, 0.01]), multiply(exp(np.array([0.0, 0.1, 0.05])), orientation)]
    times = np.linspace(0.0, bendable.duration_, 9)
    for free in (slice(0, 0), slice(3, 7), slice(0, 3)):
        point = via.copy()
        point[free] = np.nan
        bent = bendable.condition([at], [point])
        found = [part[0] for part in bent.predict_pose([[at]])]
        if free != slice(0, 3):
            np.testing.assert_allclose(found[0], via[:3], rtol=0, atol=1e-6)
            assert np.linalg.eigvalsh(bent.predict_stiffness([[at]])[0, :3, :3]).min() > 999.0
        if free != slice(3, 7):
            assert angles(found[1], via[3:]) < 1e-6
            assert np.linalg.eigvalsh(bent.predict_stiffness([[at]])[0, 3:, 3:]).min() > 49.9
        # A schedule keeps its start and its goal, which move what is free at the point too.
        planned, ends = bendable.schedule(1.0 / times[1], via=[(at, point)]), np.array([0.0, bendable.duration_])
        kept = np.hstack(bendable.predict_pose(ends[:, np.newaxis]))
        bent = bendable.condition(np.insert(ends, 1, at), np.insert(kept, 1, point, axis=0))
        np.testing.assert_allclose(planned.orientation[4], bent.predict_pose([[at]])[1][0], rtol=0, atol=1e-6)
    blurred = bendable.condition([at], [via], noise_scale=[0.01] * 3 + [0.05] * 3)
    assert 0.0 < angles(blurred.predict_pose([[at]])[1][0], via[3:]) < angles(orientation, via[3:])
    with pytest.raises(
        ValueError, match=r"noise_scale is 0\.1, must be 0, or 6 numbers, the last three in rad: m and rad have no"
    ):
        bendable.condition([at], [via], noise_scale=0.1)


@pytest.mark.parametrize("noise", [0.0, [0.01, 0.02, 0.03, 0.1, 0.1, 0.1]])
def test_positions_of_a_pose_may_be_free_one_by_one(bendable, noise):
    """Against the formula of conditioning, on the joint law of three times in the outputs themselves."""
    at, times = 0.5 * bendable.duration_, np.array([0.3, 0.45]) * bendable.duration_
    joint = bendable.covariance_.predict_joint(np.append(times, at)[:, None])[1]
    axes = bendable.outputs_.axes
    joint = np.einsum("ac,icjd,bd->iajb", axes, joint, axes)
    change, given = np.array([0.02, -0.01]), [0, 2]
    point = np.r_[bendable.predict([[at]])[0], np.nan][:7]
    point[1], point[3:], point[given] = np.nan, np.nan, point[given] + change
    own = joint[2, given][:, 2, given] + np.diag(np.square(np.broadcast_to(noise, 6))[given])
    gain = joint[:2, :, 2, given] @ np.linalg.inv(own)
    bent = bendable.condition([at], [point], noise_scale=noise)
    found = bent.predict(times[:, None]) - bendable.predict(times[:, None])
    np.testing.assert_allclose(found, gain @ change, rtol=0, atol=1e-4)  # of a spline between knots
    explained = gain @ joint[:2, :, 2, given].transpose(0, 2, 1)
    left = np.stack([joint[i, :, i] for i in range(2)]) - explained
    np.testing.assert_allclose(bent.predict_cov(times[:, None]), left, rtol=1e-6, atol=1e-9)
    if noise == 0.0:
        planned = bendable.schedule(50.0, via=[(at, point)]).resample(times=[at, at + 0.1])
        np.testing.assert_allclose(planned.position[0, given], point[given], rtol=0, atol=1e-4)


@pytest.mark.parametrize("model", [ProMPBaseline(n_basis=8), KMPBaseline(n_reference=20)], ids=["ProMP", "KMP"])
def test_so_they_may_with_other_models_of_movements(model):
    bendable = fitted(poses(), model)
    at = 0.5 * bendable.duration_
    point = np.r_[bendable.predict([[at]])[0, :1] + 0.02, np.full(6, np.nan)]
    bent = bendable.condition([at], [point])
    assert bent.predict([[at]])[0, 0] == pytest.approx(point[0], abs=2e-3)
    before, after = (np.diagonal(own.predict_cov([[at]])[0]) for own in (bendable, bent))
    assert after[0] < 0.01 * before[0]
    assert (after[1:] > 0.1 * before[1:]).all()
    stiffness = bent.predict_stiffness([[at]])[0]
    assert stiffness[0, 0] > 995.0 > np.linalg.eigvalsh(stiffness[:3, :3])[0]


def test_likely_goals_of_poses_bend_the_movement(bendable):
    goal = bendable.goal_ + bendable.outputs_.decode(np.r_[1e-3, np.zeros(5)])
    reached = bendable.schedule(50.0, goal=goal)
    np.testing.assert_allclose(bendable.outputs_.poses(goal)[0], reached.position[-1], rtol=0, atol=1e-6)


def test_a_rotation_that_does_not_vary_has_no_part_in_units():
    """Held by a fixture: no floor of it may be one of lengths, or a gain would depend on their unit."""
    still = {"by": lambda p, q: (p, np.broadcast_to(TOOL, q.shape))}
    found = []
    for unit in ("m", "mm"):
        with pytest.warns(UserWarning, match="The covariances of rotations do not vary"):
            found.append(fitted(poses(unit, **still)).schedule(20.0))
    np.testing.assert_allclose(found[0].stiffness, found[1].stiffness, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found[0].covariance, found[1].covariance, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(
        found[0].stiffness[:, 3:, 3:], np.tile(50.0 * np.eye(3), (len(found[0]), 1, 1)), atol=1e-9
    )
    assert np.ptp(np.linalg.eigvalsh(found[0].stiffness[:, :3, :3])) > 500.0
    assert np.abs(found[0].velocity[:, 3:]).max() < 1e-12


@pytest.mark.parametrize("kind", ["array", "function"])
def test_priors_are_of_the_outputs(kind, rng):
    root = rng.normal(size=(6, 9)) * np.array([0.01] * 3 + [0.2] * 3)[:, None]
    covariance = root @ root.T
    prior = covariance if kind == "array" else lambda X: np.tile(covariance, (len(X), 1, 1))
    controller = fitted(poses(), CholeskyCovRegressor(max_iter=2, prior=prior))
    np.testing.assert_allclose(controller.predict_cov([[1e5]])[0], covariance, rtol=1e-6, atol=1e-9)
    assert "prior" in controller.schedule(10.0).provenance["covariance"]["CholeskyCovRegressor"]


def test_a_controller_of_poses_plans_the_same_from_its_file(controller, tmp_path):
    torch_pbd.save(controller, tmp_path / "skill.safetensors")
    again = torch_pbd.load(tmp_path / "skill.safetensors")
    assert again.schedule(50.0, settle=0.5) == controller.schedule(50.0, settle=0.5)
    law = StiffnessLaw(20.0, 400.0, kind="precision", rotation=RotationLimits(5.0, 40.0), cross_terms=True)
    inertia = np.diag([6.0, 7.0, 8.0, 0.3, 0.2, 0.1])
    precise = fitted(poses(), stiffness_law=law, mass=inertia)
    torch_pbd.save(precise, tmp_path / "skill.safetensors")
    again = torch_pbd.load(tmp_path / "skill.safetensors")
    assert again.stiffness_law == law
    assert again.schedule(50.0) == precise.schedule(50.0)
    np.testing.assert_array_equal(again.schedule(50.0).mass[3], inertia)


def test_an_effort_is_of_metres_whatever_was_recorded():
    law = StiffnessLaw(kind="precision", rotation=RotationLimits(), effort=1e-3)
    one, other = (fitted(poses(unit), stiffness_law=law, mass=5.0) for unit in ("m", "mm"))
    np.testing.assert_allclose(one.schedule(20.0).stiffness, other.schedule(20.0).stiffness, rtol=1e-9, atol=1e-9)


def test_a_wrist_is_light_unless_told_otherwise(controller):
    """Of an admittance without feed-forward the lag is D v / K: with a kilogram and a square metre of it 6 degrees."""
    inertia = np.diag([1.0] * 3 + [0.17**2] * 3)
    np.testing.assert_allclose(controller.mass_, inertia, rtol=1e-12)
    schedule = controller.schedule(200.0)
    np.testing.assert_array_equal(schedule.mass[7], controller.mass_)
    assert "mass=1 kg and 0.0289 kg m^2, " in repr(schedule)
    modes = np.linalg.eigvals(np.linalg.solve(inertia, schedule.stiffness))
    expected = 2.0 * np.sqrt(modes).sum(axis=1).real  # trace of M^-1 D at a damping ratio of 1
    np.testing.assert_allclose(np.trace(np.linalg.solve(inertia, schedule.damping), axis1=1, axis2=2), expected)
    lag = [
        np.linalg.norm(own.simulate(rate=200.0).deviation[:, 3:], axis=1)
        for own in (controller, copy.copy(controller).set_params(mass=1.0))
    ]
    assert np.rad2deg(lag[0].max()) < 1.0 < 5.0 < np.rad2deg(lag[1].max())
    positions = fitted(make_tunnel_demonstrations(4, rate=20.0, random_state=0))
    assert (positions.mass_, positions.schedule(20.0).mass) == (1.0, 1.0)


def test_laws_and_masses_of_other_outputs_are_refused():
    recorded = make_tunnel_demonstrations(4, rate=20.0, random_state=0)
    for options, shown, words in (
        (
            {"stiffness_law": StiffnessLaw()},
            poses(),
            "rotation of stiffness_law is None, must be limits of stiffness in",
        ),
        ({"stiffness_law": StiffnessLaw(rotation=RotationLimits())}, recorded, "must be None for positions"),
        ({"stiffness_law": StiffnessLaw([50.0] * 4, 99.0)}, recorded, "covariance is of 2 outputs, must be of 4"),
        ({"mass": np.eye(3)}, poses(), r"mass has shape (3, 3), must be a number or have shape (6, 6)"),
    ):
        with pytest.raises(ValueError, match=re.escape(words)):
            fitted(shown, **options)


def test_rotations_in_a_table_are_refused_by_their_names():
    X, y, groups = poses().stack()
    with pytest.raises(ValueError, match=r"y has columns rx, ry, rz, as rotations of .*: give Demonstrations\."):
        DMPController(QUICK).fit(X, pd.DataFrame(y, columns=poses().names), groups=groups)


def test_rotations_alone_are_refused_by_what_was_recorded():
    made = poses()
    alone = Demonstrations(made.times, made.to_poses()[1], names=NAMES[3:], units="rad", rotation=NAMES[3:])
    with pytest.raises(ValueError, match="have a rotation alone, rx, ry, rz"):
        fitted(alone)


def test_recordings_that_were_cut_while_turning_are_told_of():
    """The second half of each, at places that go nowhere."""
    made = make_pose_demonstrations(8, rate=50.0, random_state=0)
    turns = [turn[len(turn) // 2 :] for turn in made.to_poses()[1]]
    rows = [np.hstack([np.outer(np.linspace(0.1 * k, 0.0, len(q)), np.ones(3)), q]) for k, q in enumerate(turns)]
    times = [time[len(time) // 2 :] - time[len(time) // 2] for time in made.times]
    turning = Demonstrations(times, rows, names=NAMES, units="m", rotation=NAMES[3:])
    with pytest.warns(UserWarning, match=r"The movement starts at [0-9.]+ rad/s .* cut while moving"):
        fitted(turning)


def test_a_reproduction_that_is_off_says_which_part_is():
    of_rotation = pytest.warns(UserWarning, match=r"is [0-9.]+ rad of rotation off the mean of the demonstrations")
    with pytest.warns(UserWarning, match=r"is [0-9.]+ off the mean of the demonstrations"), of_rotation:
        fitted(poses(), GMMBaseline(n_components=1), phase_input="s")


def test_joints_are_followed_in_radians_whatever_they_were_recorded_in():
    made = poses()
    law = StiffnessLaw([10.0, 20.0], [100.0, 200.0])
    shown = [
        Demonstrations(made.times, [scale * p[:, :2] for p in made.positions], names=["j1", "j2"], units=unit)
        for unit, scale in (("rad", 1.0), ("deg", np.rad2deg(1.0)))
    ]
    found = [fitted(joints, stiffness_law=law).schedule(20.0) for joints in shown]
    np.testing.assert_allclose(found[0].stiffness, found[1].stiffness, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(found[0].covariance, found[1].covariance, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(found[0].position, found[1].position, rtol=1e-9, atol=1e-9)
    assert {schedule.units for schedule in found} == {"rad"}
    assert "N/m" not in repr(found[1])
    by_effort = StiffnessLaw([10.0, 20.0], [100.0, 200.0], kind="precision", effort=0.01)
    efforts = [fitted(joints, stiffness_law=by_effort).law_.effort for joints in shown]
    np.testing.assert_allclose(efforts, [[0.01, 0.01], [0.01 * np.deg2rad(1.0) ** 2] * 2], rtol=1e-12)
    assert np.abs(found[0].stiffness[:, 0, 1]).max() == 0.0
    assert found[0].stiffness_limits == ((10.0, 20.0), (100.0, 200.0))

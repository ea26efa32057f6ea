"""The arm under torque control against the plant with its inertia: pushes by force and torque at once."""

from dataclasses import replace

import numpy as np
import pytest
from arm_tasks import compared, damping_ratios, deviations, made_schedule, on_arm, push, random_wrench

from torch_pbd import rotations
from torch_pbd.robots import RobotStoppedError, inverse_kinematics, panda, panda_mjcf
from torch_pbd.robots.kinematics import arm
from torch_pbd.robots.mujoco import run

mujoco = pytest.importorskip("mujoco")


@pytest.fixture(scope="module")
def model():
    return panda()


@pytest.fixture(scope="module")
def task(model):
    """Schedule with the inertia of the arm, and joint angles."""
    return on_arm(made_schedule(duration=1.5), model)


@pytest.fixture(scope="module")
def undisturbed(model, task):
    return run(model, *task)


def test_an_arm_that_is_not_pushed_is_on_its_way(model, task, undisturbed):
    """To 0.06 mm and 0.12 mrad: what is left is the tick, and a fourth of it leaves a fourth."""
    schedule, joints = task
    far = np.abs(undisturbed.deviation).max()
    assert far < 1.5e-4
    finer = schedule.resample(times=np.arange(2000) / 4000.0)
    path = inverse_kinematics(model, finer.position, finer.orientation, "tool", start=joints[0])
    quicker = panda()
    quicker.opt.timestep = 2.5e-4
    found = run(quicker, finer, path).deviation
    ratio = np.abs(found).max() / np.abs(undisturbed.deviation[schedule.time < 0.5]).max()
    assert ratio == pytest.approx(0.25, abs=0.05)


def test_without_acceleration_in_the_schedule_it_is_taken_from_the_velocity(model, task, undisturbed):
    schedule, joints = task
    derived = run(model, replace(schedule, acceleration=None), joints)
    np.testing.assert_allclose(derived.deviation, undisturbed.deviation, rtol=0, atol=1e-5)


def test_peaks_and_paths_of_pushes_are_those_of_the_plant(model, task, rng):
    schedule, joints = task
    for onset in (0.1, 0.6):
        wrench = push(schedule, onset, random_wrench(rng), 0.6)
        found = run(model, schedule, joints, wrench=wrench)
        assert not found.saturated.any()
        (position, position_path), (rotation, rotation_path) = compared(found.deviation, deviations(schedule, wrench))
        assert max(position, rotation) < 0.05
        assert max(position_path, rotation_path) < 0.08
        assert damping_ratios(schedule, found.mass).min() >= 0.95


def test_damping_made_for_one_kilogram_rings(model, task):
    """What `with_inertia` is for: the same stiffness, with the damping of 1 kg and 1 kg m^2."""
    schedule, joints = task
    light = replace(schedule.with_inertia(1.0), mass=schedule.mass)
    found = run(model, light, joints, wrench=push(schedule, 0.5, [12.0, 0.0, 0.0, 0.0, 0.0, 0.0], 0.2))
    assert damping_ratios(light, found.mass).min() < 0.5
    along, after = found.deviation[:, 0], schedule.time > 0.6
    assert along[after].min() < -0.1 * along.max()  # back beyond the way
    calm = run(model, schedule, joints, wrench=found.wrench).deviation[:, 0]
    assert calm[after].min() > -0.03 * calm.max()


@pytest.mark.parametrize("mass", [None, 1.0, np.diag([1.0] * 3 + [0.03] * 3)])
def test_damping_that_is_not_for_an_arm_is_told(model, task, mass):
    schedule, joints = task
    with pytest.warns(UserWarning, match="the arm moves with its own inertia"):
        run(model, replace(schedule, mass=mass).resample(times=schedule.time[:3]), joints[:3])


def test_a_constant_wrench_is_held_by_the_stiffness(model, task):
    """At rest: K e = f, by force and torque; and the true rotation is Exp(e) of the desired one, in world axes."""
    schedule, joints = task
    still = replace(
        schedule,
        **{name: np.tile(getattr(schedule, name)[:1], (len(schedule), 1)) for name in ("position", "orientation")},
        velocity=np.zeros_like(schedule.velocity),
        acceleration=None,
        stiffness=np.tile(schedule.stiffness[400], (len(schedule), 1, 1)),
    ).with_inertia(schedule.mass[0])
    wrench = np.array([4.0, -3.0, 5.0, 0.8, -0.6, 0.5])
    found = run(model, still, np.tile(joints[0], (len(still), 1)), wrench=np.tile(wrench, (len(still), 1)))
    np.testing.assert_allclose(still.stiffness[0] @ found.deviation[-1], wrench, rtol=1e-3, atol=1e-3)
    turned = rotations.multiply(rotations.exp(found.deviation[-1, 3:]), still.orientation[-1])
    assert abs(turned @ found.orientation[-1]) == pytest.approx(1.0, abs=1e-12)


def test_joints_follow_another_posture_and_the_tool_does_not_feel_it(model, task, undisturbed):
    schedule, joints = task
    free = np.linalg.svd(arm(model, "tool").at(joints[0]).jacobian)[2][-1]
    near = joints[0] + 0.3 * free
    pose = schedule.position, schedule.orientation
    other = inverse_kinematics(model, *pose, "tool", start=joints[0], posture=near)
    assert np.linalg.norm(other - joints, axis=1).min() > 0.1
    found = run(model, schedule, other)
    np.testing.assert_allclose(found.joints, other, rtol=0, atol=1e-3)
    assert np.abs(found.deviation).max() < 2.0 * np.abs(undisturbed.deviation).max()


def test_weak_motors_are_told(task, undisturbed):
    assert not undisturbed.saturated.any()
    most = np.abs(undisturbed.torque[:, 0]).max()
    text = panda_mjcf().replace(
        'joint="joint1" ctrlrange="-87 87"', f'joint="joint1" ctrlrange="{-most / 2} {most / 2}"'
    )
    found = run(mujoco.MjModel.from_xml_string(text), *task)
    np.testing.assert_array_equal(found.saturated, np.abs(found.torque[:, 0]) > most / 2)
    assert found.saturated.any()


def test_a_joint_at_its_limit_stops_the_arm(task):
    schedule, joints = task
    low = arm(panda(), "tool").limits[0, 3]
    narrow = mujoco.MjModel.from_xml_string(panda_mjcf().replace(f'range="{low}', f'range="{joints[700, 3]}'))
    with pytest.raises(RobotStoppedError, match="a joint reached its limit"):
        run(narrow, schedule, joints, wrench=push(schedule, 0.2, [-12.0, 0.0, 0.0, 0.0, 0.0, 0.0]))


def test_what_an_arm_cannot_follow_is_refused(model, task):
    schedule, joints = task
    with pytest.raises(ValueError, match=r"a multiple of the model's 0\.001 s: resample it"):
        run(model, schedule.resample(300.0), joints)
    with pytest.raises(ValueError, match=r"joints has shape \(5, 7\)"):
        run(model, schedule, joints[:5])
    with pytest.raises(ValueError, match=r"mm and .* rad from the first pose"):
        run(model, schedule.transform(np.eye(3), [0.02, 0.0, 0.0]), joints)
    flat = replace(schedule, orientation=None, **{
        name: getattr(schedule, name)[:, :3, :3] for name in ("stiffness", "damping", "covariance", "mass")
    }, velocity=schedule.velocity[:, :3], acceleration=None)  # fmt: skip
    with pytest.raises(ValueError, match="must have positions"):
        run(model, flat, joints)
    free = panda_mjcf().replace("<worldbody>", "<worldbody><body><freejoint/><geom size='.1' mass='1'/></body>")
    with pytest.raises(ValueError, match="one motor for each and no others"):
        run(mujoco.MjModel.from_xml_string(free), schedule, joints)

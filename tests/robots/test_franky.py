"""The adapter with franky's types and a recorded session; and, slow, against franky-sim over libfranka's protocol."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest
from arm_tasks import made_schedule, on_arm

from torch_pbd import rotations
from torch_pbd.robots import HOME, RobotLimits, RobotStoppedError, panda
from torch_pbd.robots.franky import run
from torch_pbd.robots.kinematics import arm

franky, mujoco = pytest.importorskip("franky"), pytest.importorskip("mujoco")


class Session:
    """What the tracker does, with a clock of its own: the robot's, which jumps where told."""

    def __init__(self, robot, *, gains, gains_time_constant, period, **options):
        self.robot, self.period, self.options = robot, period, options
        self.gains, self.targets, self.n_stops = [gains], [], 0
        robot.session = self

    def tick(self):
        self.robot.milliseconds += self.robot.jumps.pop(self.robot.milliseconds, 1000 * self.period)
        return self.period if self.robot.milliseconds < self.robot.end else None

    def set_gains(self, *, gains):
        self.gains.append(gains)

    def set_target(self, *target):
        if self.robot.broken:
            raise self.robot.broken
        self.targets.append((self.robot.milliseconds, *target))

    def stop(self):
        self.n_stops += 1
        if self.robot.words:
            raise franky.ControlException(self.robot.words)


class Model:
    """Jacobian of the arm in MuJoCo, whatever frames are given."""

    def __init__(self):
        self.arm = arm(panda(), "tool")

    def zero_jacobian(self, frame, joints, *frames):
        return self.arm.at(joints).jacobian


class Robot:
    """Stands at the first pose, though its joints move; reports its own time."""

    joints, rates = np.array(HOME), np.array([0.4, -0.3, 0.5, 0.2, -0.6, 0.7, -0.1])

    def __init__(self, schedule, jumps=(), end=1e9, broken=None, words=""):
        self.pose = franky.Affine(schedule.position[0], np.roll(schedule.orientation[0], -1))
        self.milliseconds, self.jumps, self.end, self.session = 7000, dict(jumps), end, None
        self.broken, self.words, self.model = broken, words, Model()

    @property
    def current_pose(self):
        return SimpleNamespace(end_effector_pose=self.pose)

    @property
    def state(self):
        time, frames = franky.Duration(round(self.milliseconds)), {"F_T_EE": None, "EE_T_K": None}
        return SimpleNamespace(time=time, O_T_EE=self.pose, q=self.joints, dq=self.rates, **frames)


@pytest.fixture(autouse=True)
def session(monkeypatch):
    monkeypatch.setattr(franky, "CartesianImpedanceTracker", Session)


@pytest.fixture(scope="module")
def schedule():
    return on_arm(made_schedule(duration=2.0, rate=200.0), panda())[0]


def test_targets_are_those_of_the_robots_time_and_gains_are_ahead(schedule):
    robot = Robot(schedule)
    found = run(robot, schedule, translational_error_clip=[0.2] * 3)
    session = robot.session
    assert session.n_stops == 1
    assert session.options == {"translational_error_clip": [0.2] * 3}
    assert len(found.time) == len(session.targets) == 400
    middles = schedule.resample(times=found.time + 0.0025)  # of the time for which they hold
    # Less J' q', by MuJoCo's derivative of the Jacobian.
    data = mujoco.MjData(robot.model.arm._model)
    data.qpos[:], data.qvel[:] = robot.joints, robot.rates
    mujoco.mj_forward(robot.model.arm._model, data)
    bias = robot.model.arm.bias(data)
    assert np.abs(bias).max() > 0.1
    for number in (0, 57, 200, 399):
        _, pose, twist, acceleration = session.targets[number]
        np.testing.assert_allclose(pose.translation, middles.position[number], rtol=0, atol=1e-12)
        turn = rotations.multiply(np.roll(pose.quaternion, 1), rotations.conjugate(middles.orientation[number]))
        assert np.linalg.norm(rotations.log(turn)) < 1e-12
        sent = [np.hstack([part.linear, part.angular]) for part in (twist, acceleration)]
        np.testing.assert_allclose(sent[0], middles.velocity[number], rtol=0, atol=1e-12)
        np.testing.assert_allclose(sent[1], middles.acceleration[number] - bias, rtol=0, atol=1e-6)
        gains, ahead = session.gains[number + 1], min(number + 20, 399)  # by 0.1 s, franky's time constant
        np.testing.assert_allclose(gains.stiffness, middles.stiffness[ahead], rtol=1e-12, atol=1e-9)
        np.testing.assert_allclose(gains.damping, middles.damping[ahead], rtol=1e-12, atol=1e-9)
    desired = schedule.resample(times=[*found.time, 2.0]).position[:-1]
    np.testing.assert_allclose(found.deviation[:, :3], schedule.position[0] - desired, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"jumps": {8000: 150}}, r"no target came for 0\.15 s, must come within 0\.1 s"),
        ({"end": 8200}, "no longer under control"),
        ({"end": 8200, "words": "cartesian_reflex"}, "ControlException: cartesian_reflex"),
        ({"broken": franky.NetworkException("libfranka: lost")}, "NetworkException: libfranka: lost"),
    ],
)
def test_any_fault_stops_the_arm_and_is_told(schedule, options, message):
    robot, faults = Robot(schedule, **options), []
    with pytest.raises(RobotStoppedError, match=message):
        run(robot, schedule)
    assert robot.session.n_stops == 1
    robot = Robot(schedule, **options)
    found = run(robot, schedule, on_fault=faults.append)
    assert robot.session.n_stops == len(faults) == 1
    assert len(found.time) < 200


def test_a_keyboards_stop_stops_the_arm_and_goes_on(schedule):
    robot = Robot(schedule, broken=KeyboardInterrupt(), words="already at rest")
    with pytest.raises(KeyboardInterrupt):
        run(robot, schedule, on_fault=pytest.fail)
    assert robot.session.n_stops == 1


@pytest.mark.parametrize(
    ("change", "limits", "message"),
    [
        (lambda s: s.transform(np.eye(3), [0.0, 0.02, 0.0]), {}, r"20 mm and .* rad from the first pose"),
        (
            lambda s: s,
            {"speed": 0.1},
            r"the speed\[\d+\] is .* m/s, must be at most RobotLimits.speed, 0.1 m/s: slow down",
        ),
        (lambda s: s, {"angular_speed": 0.1}, r"the angular speed\[\d+\] is .* rad/s, must"),
        (lambda s: s, {"angular_acceleration": 0.1}, r"the angular acceleration\[\d+\] is .* rad/s\^2"),
        (
            lambda s: s,
            {"stiffness": (10.0, 900.0)},
            r"stiffness\[\d+, 2\] is .* N/m, .* RobotLimits.stiffness, 10 to 900",
        ),
        (lambda s: s, {"rotational_stiffness": (30.0, 300.0)}, r"the eigenvalue of stiffness.* 30 to 300 Nm/rad"),
    ],
)
def test_what_is_beyond_limits_is_refused_before_anything_moves(schedule, change, limits, message):
    robot = Robot(schedule)
    with pytest.raises(ValueError, match=message):
        run(robot, change(schedule), limits=RobotLimits(**limits))
    assert robot.session is None
    with pytest.raises(ValueError, match="limits is 3, must be a RobotLimits"):
        run(robot, schedule, limits=3)


def test_without_franky_the_command_to_install_it_is_told(schedule, monkeypatch):
    monkeypatch.setitem(sys.modules, "franky", None)
    with pytest.raises(ModuleNotFoundError, match=r"a Franka arm needs franky, .* pip install 'torch_pbd\[robot\]'"):
        run(None, schedule)


@pytest.mark.slow
def test_franky_against_franky_sim(monkeypatch):
    """A learned task, 300 N/m at least. What differs from the plant is friction, which no model has.

    Without it, what is left is the weight of the fingers, which libfranka's model has not, and targets some ms late.
    """
    pytest.importorskip("franky_sim")
    import franky_pushes

    monkeypatch.undo()  # the real session
    for case, most, tolerance in zip(
        franky_pushes.CASES[1:], ([10.0, 30.0], [50.0, 150.0]), (0.08, 0.25), strict=False
    ):
        found = franky_pushes.measured(case)
        calm = franky_pushes.peaks(found.calm)
        assert (calm < most).all()
        for i, push in enumerate(found.pushed):
            effect, plant = (
                franky_pushes.peaks(motion)[i] for motion in (found.pushed[push] - found.calm, found.plant[push])
            )
            assert effect == pytest.approx(plant, rel=tolerance)
    assert calm[0] > 10.0  # of the last, with friction

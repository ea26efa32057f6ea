"""The adapter against a fake that has the calls of ur_rtde 1.6.5, recorded; there is no robot to test it with here."""

import math
from datetime import timedelta
from types import SimpleNamespace

import numpy as np
import pytest
from arm_tasks import made_schedule

from torch_pbd import rotations
from torch_pbd.control import RealTimeAdmittance
from torch_pbd.robots import RobotLimits, RobotStoppedError, ur_rtde

STEP = 0.002


class Robot:
    """Control and receive interface in one: goes at once where it is sent, and has a clock of its own."""

    def __init__(self, schedule, force=lambda t: [0.0] * 6, refused=math.inf, stopped=math.inf, reach=math.inf):
        self.pose = [*schedule.position[0], *rotations.log(schedule.orientation[0])]
        self.force, self.refused, self.stopped, self.reach = force, refused, stopped, reach
        self.now, self.calls, self.targets = 100.0, [], []

    def clock(self):
        return self.now

    def getStepTime(self):  # noqa: N802
        return STEP

    def isPoseWithinSafetyLimits(self, pose):  # noqa: N802
        return pose[0] < self.reach

    def zeroFtSensor(self):  # noqa: N802
        return self.calls.append("zero") is None

    def initPeriod(self):  # noqa: N802
        return timedelta(seconds=self.now)

    def waitPeriod(self, start):  # noqa: N802
        self.now = start.total_seconds() + STEP

    def servoL(self, pose, speed, acceleration, time, lookahead_time, gain):  # noqa: N802
        self.calls.append((time, lookahead_time, gain))
        self.targets.append(pose)
        self.pose = pose
        return self.now - 100.0 < self.refused

    def servoStop(self, a=10.0):  # noqa: N802
        return self.calls.append("stop") is None

    def getActualTCPPose(self):  # noqa: N802
        return self.pose

    def getActualTCPForce(self):  # noqa: N802
        return self.force(self.now - 100.0)

    def isProtectiveStopped(self):  # noqa: N802
        return self.now - 100.0 > self.stopped

    def isEmergencyStopped(self):  # noqa: N802
        return False


@pytest.fixture(scope="module")
def schedule():
    return made_schedule(duration=2.0, rate=500.0).with_inertia(np.diag([2.0] * 3 + [0.1] * 3))


@pytest.fixture
def run(monkeypatch):
    def start(robot, *args, **options):
        monkeypatch.setattr(ur_rtde, "time", SimpleNamespace(monotonic=robot.clock))
        return ur_rtde.run(robot, robot, *args, **options)

    return start


def pushed(t):
    share = math.sin(math.pi * min(max((t - 1.0) / 0.8, 0.0), 1.0)) ** 2
    return [8.0 * share, 0.0, 0.0, 0.0, 0.0, 0.8 * share]


def test_targets_are_those_of_the_loop(schedule, run):
    robot = Robot(schedule, force=pushed)
    found = run(robot, schedule, gain=500.0, soft_start=0.5)
    loop = RealTimeAdmittance(schedule, rate=500.0, soft_start=0.5)
    loop.start(100.0, schedule.position[0], orientation=schedule.orientation[0])
    for number, target in enumerate(robot.targets):
        now = 100.0 + STEP * number
        loop.tick(now, pushed(now - 100.0))
        np.testing.assert_allclose(target[:3], loop.position, rtol=0, atol=1e-9)
        turn = rotations.multiply(rotations.exp(np.array(target[3:])), rotations.conjugate(np.array(loop.orientation)))
        assert np.linalg.norm(rotations.log(turn)) < 1e-9
    assert robot.calls[0] == "zero"
    assert robot.calls[1] == (STEP, 0.05, 500.0)
    assert robot.calls[-1] == "stop"
    assert np.abs(found.deviation[:, 0]).max() > 5e-3
    assert found.time[-1] == pytest.approx(2.0, abs=0.01)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"refused": 0.5}, "refused a pose"),
        ({"stopped": 0.5}, "protective or an emergency stop"),
        ({"force": lambda t: [math.nan] * 6 if t > 0.5 else [0.0] * 6}, "the loop stopped, its faults were .*FORCE"),
    ],
)
def test_any_fault_stops_the_arm_and_is_told(schedule, run, options, message):
    robot = Robot(schedule, **options)
    with pytest.raises(RobotStoppedError, match=message):
        run(robot, schedule)
    assert robot.calls.count("stop") == 1
    robot, faults = Robot(schedule, **options), []
    assert 0 < len(run(robot, schedule, on_fault=faults.append).time) < 300
    assert len(faults) == robot.calls.count("stop") == 1


def test_what_is_beyond_limits_is_refused_before_anything_moves(schedule, run):
    for options, change, message in (
        ({}, {"limits": RobotLimits(speed=0.1)}, "slow down"),
        ({"reach": 0.4}, {}, r"the position at 1\.\d+ s is .* within the robot's safety limits"),
        ({}, {"gain": 50.0}, "gain is 50"),
    ):
        robot = Robot(schedule, **options)
        with pytest.raises(ValueError, match=message):
            run(robot, schedule, **change)
        assert robot.calls == []
    robot = Robot(schedule.transform(np.eye(3), [0.0, 0.0, 0.05]))
    with pytest.raises(ValueError, match="50 mm"):
        run(robot, schedule)
    assert robot.calls == []


def test_the_fakes_calls_are_those_of_the_library():
    library = pytest.importorskip("rtde_control"), pytest.importorskip("rtde_receive")
    interfaces = library[0].RTDEControlInterface, library[1].RTDEReceiveInterface
    for name in (name for name in vars(Robot) if name[0] != "_" and name != "clock"):
        assert any(hasattr(interface, name) for interface in interfaces), name
    assert (
        "arg0: list[float], arg1: float, arg2: float, arg3: float, arg4: float, arg5: float"
        in interfaces[0].servoL.__doc__
    )

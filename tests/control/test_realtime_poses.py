"""The controller of the loop with full mass matrices, and on poses."""

import math
from dataclasses import replace

import numpy as np
import pytest
from control.loops import MASS, arm_inertia, as_schedule, make_pose_schedule, make_schedule, pose_motion
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from torch_pbd.control import AdmittancePlant
from torch_pbd.control.realtime import RealTimeAdmittance, TickStatus, steps

EXACT = {"soft_start": 0.0}


def turn_of(quaternion):
    return Rotation.from_quat(quaternion, scalar_first=True)


def linear(schedule):
    """The same rows with the rotations left out: six positions, of which the last three stand still."""
    position = np.concatenate([schedule.position, np.zeros_like(schedule.position)], axis=1)
    velocity = np.concatenate([schedule.velocity[:, :3], np.zeros_like(schedule.position)], axis=1)
    gains = schedule.stiffness, schedule.damping
    return as_schedule(schedule.time, *gains, position, velocity, mass=schedule.mass)


def solved(schedule, row, state, force, step):
    """Position and velocity after a tick by scipy, from the augmented system of eq. (15) with the row's mass."""
    d = len(force)
    inverse = np.linalg.inv(schedule.mass[row])
    rate = np.zeros((2 * d + 1, 2 * d + 1))
    rate[:d, d:-1] = np.eye(d)
    rate[d:-1, :d], rate[d:-1, d:-1] = -inverse @ schedule.stiffness[row], -inverse @ schedule.damping[row]
    held = schedule.stiffness[row] @ schedule.position[row] + schedule.damping[row] @ schedule.velocity[row]
    rate[d:-1, -1] = inverse @ (force + held)
    return (expm(rate * step) @ np.append(state, 1.0))[:-1]


@pytest.mark.parametrize("coupled", [0.0, 1.0])
def test_a_tick_with_an_inertia_is_the_matrix_exponential(coupled, rng):
    schedule = linear(make_pose_schedule(2.0, coupled=coupled))
    controller = RealTimeAdmittance(schedule, force_limit=1e6, **EXACT)
    state, last = 1e-2 * rng.normal(size=12), 0.0
    controller.start(0.0, state[:6], state[6:])
    for now in np.cumsum(rng.uniform(2e-4, 3e-3, size=120)).tolist():
        force = rng.normal(size=6) * [5.0, 5.0, 5.0, 0.5, 0.5, 0.5]
        state = solved(schedule, round(1000 * last), state, force, now - last)
        last = now
        assert controller.tick(now, force) == 0
        np.testing.assert_allclose(controller.position, state[:6], rtol=0, atol=1e-12)
        np.testing.assert_allclose(controller.velocity, state[6:], rtol=0, atol=1e-10)
        np.testing.assert_allclose(controller.force, force, rtol=1e-12)


def test_damping_made_for_an_inertia_needs_no_matrix_exponential(monkeypatch):
    monkeypatch.delattr(steps, "_expm1")
    for inertia in (arm_inertia, arm_inertia(np.zeros(1))[0], 3.0):
        controller = RealTimeAdmittance(make_pose_schedule(0.05, inertia=inertia))
        controller.start(0.0)
        assert controller.tick(0.001, [1.0] * 6) == 0


@pytest.mark.parametrize("d", [1, 2, 3])
@pytest.mark.parametrize("coupled", [0.0, 1.0])
def test_a_matrix_of_equal_masses_is_one_mass(d, coupled):
    schedule, ends = make_schedule(d, duration=1.0, coupled=coupled), []
    for mass in (MASS, MASS * np.eye(d)):
        controller = RealTimeAdmittance(schedule, mass=mass, spring_limit=3.0)  # acts; pace and approach too
        controller.start(0.0, np.full(d, 0.2))
        for i in range(1, 900):
            controller.tick(i / 1000, [1.0] * d)
        assert TickStatus.SPRING_LIMITED in controller.faults
        ends.append([*controller.position, *controller.velocity, controller.schedule_time])
    np.testing.assert_allclose(ends[0], ends[1], rtol=1e-9, atol=1e-12)


def test_an_inertia_moves_as_the_plant_of_torch(rng):
    schedule = make_schedule(3, duration=0.4).with_inertia(np.diag([2.0, 5.0, 9.0]) + 1.0)
    push = 20.0 * np.sin(np.outer(np.arange(401) / 100, rng.uniform(1.0, 3.0, size=3)))
    rows = schedule.position, schedule.velocity, schedule.stiffness, schedule.damping
    told = AdmittancePlant(mass=schedule.mass[0]).simulate(*rows, push, dt=0.001).numpy().position
    controller, went = RealTimeAdmittance(schedule, **EXACT), []
    controller.start(0.0, velocity=schedule.velocity[0])
    for i in range(1, 300):  # the end is slowed
        controller.tick(i / 1000, push[i - 1])
        went.append(controller.position)
    np.testing.assert_allclose(went, told[1:300], rtol=0, atol=1e-9 * np.ptp(told))


def test_another_inertia_than_that_of_the_schedule_is_told():
    schedule, inertia = make_pose_schedule(0.01), arm_inertia(np.zeros(1))[0]
    for mass in (inertia, 5.0):
        with pytest.warns(UserWarning, match="but damping_ratio was met for the 6 x 6 inertia of the schedule"):
            RealTimeAdmittance(schedule, mass=mass)
    with pytest.warns(UserWarning, match="but damping_ratio was met for mass=1 kg"):
        RealTimeAdmittance(make_pose_schedule(0.01, inertia=1.0), mass=inertia)
    RealTimeAdmittance(make_pose_schedule(0.01, inertia=inertia), mass=inertia)
    RealTimeAdmittance(schedule)
    for mass, words in [
        (np.eye(3), r"mass has shape \(3, 3\), must have shape \(6, 6\)"),
        (-inertia, "smallest eigenvalue of mass is .* positive definite"),
    ]:
        with pytest.raises(ValueError, match=words):
            RealTimeAdmittance(schedule, mass=mass)


def law(schedule, force):
    """Right-hand side of M w' = f + K e + D (v_d - v) on rotations as they are, of (x, R, v) at a time."""
    stiffness, damping, inverse = schedule.stiffness[0], schedule.damping[0], np.linalg.inv(schedule.mass[0])

    def rate(time, state):
        position, orientation, velocity = (part[0] for part in pose_motion(np.array([time])))
        turn = Rotation.from_matrix(state[3:12].reshape(3, 3))
        off = np.append(state[:3] - position, (turn * turn_of(orientation).inv()).as_rotvec())
        acceleration = inverse @ (force(time) - stiffness @ off - damping @ (state[12:] - velocity))
        spin = np.cross(np.eye(3), state[15:]) @ turn.as_matrix()
        return np.concatenate([state[12:15], spin.ravel(), acceleration])

    return rate


def test_on_poses_the_law_is_met_in_the_limit_of_short_ticks():
    """Also by half a radian from a tool that turns at a radian per second: the transport of e is in it."""
    inertia = arm_inertia(np.zeros(1))[0]

    def force(time):
        return np.array([20.0, -10.0, 5.0, 4.0, -6.0, 5.0]) * math.sin(3.0 * time) ** 2

    errors = {}
    for rate in (250.0, 500.0):
        moving = make_pose_schedule(3.0, rate=rate, inertia=inertia)
        gains = {name: np.repeat(getattr(moving, name)[:1], len(moving), axis=0) for name in ("stiffness", "damping")}
        schedule = replace(moving, **gains)
        # The desired pose stands still in a tick, which lags by half a tick: the middle of ticks has none.
        middle = pose_motion(schedule.time + 0.5 / rate)
        schedule = replace(schedule, position=middle[0], orientation=middle[1], velocity=middle[2])
        controller = RealTimeAdmittance(schedule, rate=rate, **EXACT)
        position, orientation, velocity = (part[0] for part in pose_motion(np.zeros(1)))
        controller.start(0.0, position, velocity, orientation=orientation)
        start = np.concatenate([position, turn_of(orientation).as_matrix().ravel(), velocity])
        times = np.arange(1, round(1.2 * rate)) / rate
        told = solve_ivp(law(schedule, force), (0.0, 1.2), start, "DOP853", times, rtol=1e-8, atol=1e-9).y.T
        away, worst = 0.0, np.zeros(3)
        for time, state in zip(times, told, strict=True):
            assert controller.tick(time, force(time - 0.5 / rate)) == 0
            turn = Rotation.from_matrix(state[3:12].reshape(3, 3))
            off = (turn_of(controller.orientation) * turn.inv()).magnitude()
            moved = np.linalg.norm(controller.position - state[:3])
            slower = np.linalg.norm(controller.velocity - state[12:])
            worst = np.maximum(worst, [moved, off, slower])
            away = max(away, (turn * turn_of(controller.desired_orientation).inv()).magnitude())
        errors[rate] = worst
    assert away > 0.3
    assert (errors[500.0] < [5e-6, 3e-4, 1e-3]).all()
    assert (errors[500.0] < 0.55 * errors[250.0]).all()

"""The controller of the loop with full mass matrices, and on poses."""

import math
import tracemalloc
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
    monkeypatch.delattr(steps, "expm1")
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
        with pytest.warns(UserWarning, match="but damping_ratio was met for the inertia of the schedule"):
            RealTimeAdmittance(schedule, mass=mass)
    with pytest.warns(UserWarning, match="but damping_ratio was met for mass=1 kg"):
        RealTimeAdmittance(make_pose_schedule(0.01, inertia=1.0), mass=inertia)
    RealTimeAdmittance(make_pose_schedule(0.01, inertia=inertia), mass=inertia)
    RealTimeAdmittance(schedule)
    for mass, words in [
        (np.eye(3), r"mass has shape \(3, 3\), must have shape \(6, 6\)"),
        (-inertia, "smallest eigenvalue of mass.* is .* positive definite"),
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


def went(controller, times, forces=None):
    """Positions, rotations and twists after ticks, with what was before them."""
    trace = [(controller.position, controller.orientation, controller.velocity)]
    for i, now in enumerate(times):
        controller.tick(now, [0.0] * 6 if forces is None else forces[i])
        trace.append((controller.position, controller.orientation, controller.velocity))
    positions, orientations, velocities = (np.array(values) for values in zip(*trace, strict=True))
    return positions, turn_of(orientations), velocities


def test_the_world_may_be_turned_and_quaternions_have_no_sign(rng):
    turn, shift = Rotation.from_rotvec([0.5, -1.0, 2.0]), np.array([3.0, -2.0, 1.0])
    whole = np.kron(np.eye(2), turn.as_matrix())
    schedule = make_pose_schedule(0.5)
    start = [0.2, 0.1, 0.0], rng.normal(size=6) * 0.1, Rotation.from_rotvec([0.2, 0.4, -0.3]).as_quat(scalar_first=True)
    forces = rng.normal(size=(400, 6)) * [20.0, 20.0, 20.0, 2.0, 2.0, 2.0]
    times = np.arange(1, 401) / 1000
    plain = RealTimeAdmittance(schedule, spring_limit=(4.0, 1.0))
    plain.start(0.0, start[0], start[1], orientation=start[2])
    positions, turns, velocities = went(plain, times, forces)
    turned = RealTimeAdmittance(schedule.transform(turn.as_matrix(), shift), spring_limit=(4.0, 1.0))
    there = (turn * turn_of(start[2])).as_quat(scalar_first=True)
    for sign in (1.0, -1.0):
        turned.start(0.0, turn.apply(start[0]) + shift, whole @ start[1], orientation=sign * there)
        others = went(turned, times, forces @ whole.T)
        np.testing.assert_allclose(others[0], turn.apply(positions) + shift, rtol=0, atol=1e-12)
        np.testing.assert_allclose(
            (others[1] * turns.inv()).as_rotvec(), turn.as_rotvec() + 0.0 * others[0], atol=1e-12
        )
        np.testing.assert_allclose(others[2], velocities @ whole.T, rtol=0, atol=1e-11)
    assert plain.faults == turned.faults == TickStatus.SPRING_LIMITED


def test_the_command_is_one_motion_also_in_an_approach_to_a_tool_that_turns():
    """The velocity is what position and orientation do, of the command and of what is desired; both stay unit."""
    schedule = make_pose_schedule(2.0)
    controller = RealTimeAdmittance(schedule)
    first = turn_of(schedule.orientation[0])
    start = (Rotation.from_rotvec([0.6, -0.8, 0.3]) * first).as_quat(scalar_first=True)
    controller.start(0.0, schedule.position[0] + [0.1, 0.0, 0.2], orientation=start)
    last = np.array(controller.position), turn_of(start), np.zeros(6)
    desired, passed = [], []
    for i in range(1, 4500):
        assert controller.tick(i / 1000, [0.0] * 6) == 0
        here = np.array(controller.position), turn_of(controller.orientation), np.array(controller.velocity)
        rate = 1000.0 * np.append(here[0] - last[0], (here[1] * last[1].inv()).as_rotvec())
        np.testing.assert_allclose(rate, 0.5 * (here[2] + last[2]), rtol=0, atol=1e-4)
        last = here
        passed.append(controller.schedule_time)
        desired.append((controller.desired_position, controller.desired_orientation, controller.desired_velocity))
    for quaternion in (controller.orientation, controller.desired_orientation):
        np.testing.assert_allclose(math.hypot(*quaternion), 1.0, rtol=1e-15)
    places, turns, velocities = (np.array(values) for values in zip(*desired, strict=True))
    turns = turn_of(turns)
    rates = 1000.0 * np.append(np.diff(places, axis=0), (turns[1:] * turns[:-1].inv()).as_rotvec(), axis=1)
    off = np.abs(rates - 0.5 * (velocities[1:] + velocities[:-1])).max(axis=1)
    is_within = np.array(passed[1:]) < 1.998  # the last row has no velocity
    assert np.count_nonzero(off[is_within] > 2e-3) <= 1  # where schedule time is put onto a row
    np.testing.assert_allclose((turns[0] * turn_of(start).inv()).as_rotvec(), 0.0, atol=1e-9)
    np.testing.assert_allclose(places[-1], schedule.position[-1], rtol=0, atol=1e-12)
    np.testing.assert_allclose((turns[-1] * turn_of(schedule.orientation[-1]).inv()).as_rotvec(), 0.0, atol=1e-9)


def test_an_approach_to_a_tool_that_stands_turns_about_one_axis_by_minimum_jerk():
    schedule = make_pose_schedule(2.0, still=True)
    controller = RealTimeAdmittance(schedule, soft_start=0.5, approach_speed=(10.0, 10.0))
    way = np.array([1.2, -0.9, 0.8])
    start = (Rotation.from_rotvec(-way) * turn_of(schedule.orientation[0])).as_quat(scalar_first=True)
    controller.start(0.0, orientation=start)
    assert controller.position == tuple(schedule.position[0])
    for i in range(1, 520):
        controller.tick(i / 1000, [0.0] * 6)
        t = min((i - 1) / 500, 1.0)
        passed = (10.0 * t**3 - 15.0 * t**4 + 6.0 * t**5) * way
        turned = (turn_of(controller.desired_orientation) * turn_of(start).inv()).as_rotvec()
        np.testing.assert_allclose(turned, passed, rtol=0, atol=1e-12)
        slope = (30.0 * t**2 - 60.0 * t**3 + 30.0 * t**4) / 0.5 * way
        np.testing.assert_allclose(controller.desired_velocity, [0.0, 0.0, 0.0, *slope], rtol=0, atol=1e-12)


def test_wrenches_are_limited_bridged_and_taken_off_each_by_itself():
    controller = RealTimeAdmittance(make_pose_schedule(0.5), force_limit=(20.0, 2.0), deadband=(1.0, 0.1))
    controller.start(0.0, force_bias=[0.5, 0.0, 0.0, 0.2, 0.0, 0.0])
    assert controller.tick(0.001, [3.5, 0.5, -4.0, 1.2, 0.05, -0.3]) == 0
    np.testing.assert_allclose(controller.force, [2.0, 0.0, -3.0, 0.9, 0.0, -0.2], rtol=1e-12)
    assert controller.tick(0.002, [0.0, 31.0, -41.0, 0.2, 0.0, 0.0]) == TickStatus.FORCE_SATURATED
    np.testing.assert_allclose(controller.force, [0.0, 12.0, -16.0, 0.0, 0.0, 0.0], atol=1e-12)
    controller = RealTimeAdmittance(make_pose_schedule(0.5), hold_ticks=3)
    controller.start(0.0)
    for i in range(1, 6):
        controller.tick(i / 1000, [1.0, 2.0, 3.0, 0.1, 0.2, 0.3])
    assert controller.tick(0.006, [2.0, 2.0, 2.0, math.nan, 0.0, 0.0]) == TickStatus.FORCE_INVALID
    np.testing.assert_allclose(controller.force, [2.0, 2.0, 2.0, 0.075, 0.15, 0.225], rtol=1e-12)
    for i in range(7, 9):
        assert controller.tick(i / 1000, [2.0, 2.0, 2.0, 0.0, math.inf, 0.0]) == TickStatus.FORCE_INVALID
    assert TickStatus.STOPPED in controller.tick(0.009, [2.0, 2.0, 2.0, 0.0, math.inf, 0.0])
    limited = RealTimeAdmittance(make_pose_schedule(0.5), force_rate_limit=(1e3, 10.0))
    limited.start(0.0)
    assert limited.tick(0.001, [0.0, 0.0, 0.9, 3.0, 0.0, 0.0]) == TickStatus.FORCE_RATE_LIMITED
    np.testing.assert_allclose(limited.force, [0.0, 0.0, 0.9, 0.01, 0.0, 0.0], rtol=1e-12)


@pytest.mark.parametrize("coupled", [0.0, 1.0])
@pytest.mark.parametrize("crossed", [False, True])
def test_the_pulls_of_force_and_torque_are_limited(coupled, crossed):
    schedule = make_pose_schedule(0.5, still=True, coupled=coupled)
    if crossed:  # then one scale is that of both
        cross = np.zeros((6, 6))
        cross[0, 4] = cross[4, 0] = 30.0
        schedule = replace(schedule, stiffness=schedule.stiffness + cross).with_inertia(schedule.mass)
    controller = RealTimeAdmittance(schedule, soft_start=0.0, spring_limit=(40.0, 6.0))
    whole = schedule.stiffness[0]
    for rotation, shift, limited in [
        ([0.0, 1.0, 1.0], [0.3, 0.0, 0.1], (True, True)),
        ([0.02, 0.01, 0.0], [0.6, 0.8, 0.0], (True, False)),
        ([0.0, 2.0, 1.0], [0.0, 0.0, 0.0], (False, True)),
    ]:
        turned = (Rotation.from_rotvec(rotation) * turn_of(schedule.orientation[0])).as_quat(scalar_first=True)
        controller.start(0.0, schedule.position[0] + shift, orientation=turned)
        controller.tick(0.001, [0.0] * 6)
        assert controller.faults == TickStatus.SPRING_LIMITED
        pull = controller.stiffness @ [*shift, *rotation]
        shares = np.linalg.norm(pull[:3]) / 40.0, np.linalg.norm(pull[3:]) / 6.0
        assert max(shares) <= 1.0 + 1e-9
        assert max(shares) > 0.5
        scales = np.diag(controller.stiffness)[[0, 3]] / np.diag(whole)[[0, 3]]
        np.testing.assert_allclose(controller.stiffness[:3, :3], scales[0] * whole[:3, :3], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(controller.stiffness[3:, 3:], scales[1] * whole[3:, 3:], rtol=1e-9, atol=1e-9)
        assert scales[0] == pytest.approx(scales[1]) if crossed else tuple(scales < 1.0 - 1e-9) == limited
        # The tick is that of the stiffness it tells.
        gains = {"stiffness": controller.stiffness[None], "damping": schedule.damping, "mass": schedule.mass}
        told = as_schedule([0.0, 1.0], *(gains[name].repeat(2, 0)[:2] for name in ("stiffness", "damping")))
        told = replace(told, mass=gains["mass"][:2])
        state = solved(told, 0, np.concatenate([shift, rotation, np.zeros(6)]), np.zeros(6), 0.001)
        np.testing.assert_allclose(controller.velocity, state[6:], rtol=1e-9, atol=1e-12)


def test_speeds_and_accelerations_of_the_command_are_limited_each_by_itself(rng):
    limits = {"velocity_limit": (0.2, 0.6), "acceleration_limit": (6.0, 25.0)}
    controller = RealTimeAdmittance(make_pose_schedule(1.0), **limits)
    schedule = make_pose_schedule(1.0)
    turned = (Rotation.from_rotvec([0.3, 0.0, 0.2]) * turn_of(schedule.orientation[0])).as_quat(scalar_first=True)
    controller.start(0.0, schedule.position[0] + [0.1, 0.0, 0.0], orientation=turned)
    last, seen = 0.0, []
    for now in np.cumsum(rng.uniform(1e-4, 5e-3, size=500)).tolist():
        place, turn, velocity = np.array(controller.position), turn_of(controller.orientation), controller.velocity
        wrench = rng.normal(size=6) * rng.choice([[0.0, 0.0], [100.0, 0.0], [0.0, 10.0]]).repeat(3)
        seen.append(controller.tick(now, wrench))
        step, changes = now - last, np.subtract(controller.velocity, velocity)
        turning = (turn_of(controller.orientation) * turn.inv()).magnitude()
        for block, moved, speed, rise in [
            (slice(0, 3), np.linalg.norm(controller.position - place), 0.2, 6.0),
            (slice(3, 6), turning, 0.6, 25.0),
        ]:
            assert np.linalg.norm(changes[block]) <= rise * step * (1 + 1e-9)
            assert np.linalg.norm(controller.velocity[block]) <= speed * (1 + 1e-9)
            assert moved <= speed * step * (1 + 1e-9)
        last = now
    assert TickStatus.VELOCITY_LIMITED in controller.faults
    assert TickStatus.ACCELERATION_LIMITED in controller.faults


def test_a_stop_brings_both_to_rest_together():
    controller = RealTimeAdmittance(make_pose_schedule(3.0), stop_deceleration=(2.0, 5.0), max_bad_ticks=1)
    controller.start(0.0)
    _, _, velocities = went(controller, np.arange(1, 1301) / 1000)
    before = velocities[-1]
    assert controller.tick(1.3, [0.0] * 6) == TickStatus.CLOCK | TickStatus.STOPPED
    _, _, velocities = went(controller, 1.3 + np.arange(1, 1000) / 1000)
    speeds = np.array([np.linalg.norm(velocities[:, block], axis=1) for block in (slice(0, 3), slice(3, 6))])
    falls = -1000.0 * np.diff(speeds, axis=1)
    # Its speeds count as equal where they are as the default approach speeds, 0.5 m/s and 1 rad/s.
    np.testing.assert_allclose(np.max(falls[:, 0] * [1.0, 0.5]), 2.0, rtol=1e-6)
    assert (falls.max(axis=1) <= np.array([2.0, 5.0]) * (1 + 1e-6)).all()
    moving = speeds[0] > 0.0
    assert 10 < np.count_nonzero(moving) < 900
    np.testing.assert_array_equal(moving, speeds[1] > 0.0)
    np.testing.assert_allclose(
        velocities[5] / np.linalg.norm(velocities[5]), before / np.linalg.norm(before), rtol=1e-9
    )


@pytest.mark.parametrize(
    ("option", "value", "words"),
    [
        ("force_limit", 200.0, "force_limit is 200.0, must be a pair for poses, in N and Nm"),
        ("force_limit", (10.0, -1.0), r"force_limit\[1\] is -1.0 Nm, must be a finite number above 0"),
        ("deadband", (0.0, math.nan), r"deadband\[1\] is nan Nm, must be a finite number of at least 0"),
        ("velocity_limit", (1.0,), "velocity_limit is .*, must be a pair for poses, in units/s and rad/s"),
    ],
)
def test_limits_of_poses_are_pairs(option, value, words):
    with pytest.raises(ValueError, match=words):
        RealTimeAdmittance(make_pose_schedule(0.01), **{option: value})
    with pytest.raises(ValueError, match=r"velocity_limit is .*, must be a finite number above 0"):
        RealTimeAdmittance(make_schedule(3, duration=0.01), velocity_limit=(1.0, 2.0))


def test_a_start_of_a_pose_is_checked():
    controller = RealTimeAdmittance(make_pose_schedule(0.1), velocity_limit=(1.0, 2.0))
    for arguments, words in [
        ({"orientation": [1.0, 0.0, 0.0]}, r"orientation has shape \(3,\), must have shape \(4,\)"),
        ({"orientation": [0.9, 0.0, 0.0, 0.0]}, "length of orientation is 0.9, .* give a unit quaternion w x y z"),
        ({"position": [0.0] * 6}, r"position has shape \(6,\), must have shape \(3,\)"),
        ({"velocity": [0.0] * 3}, r"velocity has shape \(3,\), must have shape \(6,\)"),
        ({"velocity": [0.0, 0.0, 0.0, 2.0, 1.0, 0.0]}, "angular speed is .* at most 2: slow it down"),
    ]:
        with pytest.raises(ValueError, match=words):
            controller.start(0.0, **arguments)
    with pytest.raises(ValueError, match="orientation is given, must be None for a schedule without: leave it out"):
        RealTimeAdmittance(make_schedule(3, duration=0.01)).start(0.0, orientation=[1.0, 0.0, 0.0, 0.0])
    controller.start(0.0)
    with pytest.raises(ValueError, match=r"force is .*, must be 6 numbers in N and Nm"):
        controller.tick(0.001, [0.0] * 3)
    assert controller.tick(0.001, [0.0] * 6) == 0


@pytest.mark.parametrize("coupled", [0.0, 1.0])
def test_ticks_of_poses_keep_no_memory(coupled):
    controller = RealTimeAdmittance(make_pose_schedule(0.3, coupled=coupled), velocity_limit=(0.1, 0.3))
    controller.start(0.0, np.full(3, 0.1), orientation=[1.0, 0.0, 0.0, 0.0])

    def ticks(n, m):
        for i in range(n, m):
            controller.tick(i / 1000 + (i % 100 == 0), [math.nan if i % 7 == 0 else 1.0] * 6)

    ticks(1, 300)
    tracemalloc.start()
    ticks(300, 500)
    before = tracemalloc.get_traced_memory()[0]
    ticks(500, 1000)  # a float kept in each would be 12 kB
    grown = tracemalloc.get_traced_memory()[0] - before
    tracemalloc.stop()
    assert grown < 2000


def test_free_motion_of_a_pose_loses_energy_whatever_the_ticks_if_rotations_are_equally_stiff(rng):
    """Springs that are stiffer about one axis are no potentials: energy then changes with angles, to second order."""
    base, limited = make_pose_schedule(0.01, still=True, inertia=arm_inertia(np.zeros(1))[0]), 0
    rest = turn_of(base.orientation[0])
    for ratio in (0.05, 0.3, 1.0):
        stiffness = np.diag([*np.exp(rng.uniform(np.log(50.0), np.log(2000.0), size=3)), *[30.0] * 3])
        schedule = replace(base, stiffness=stiffness[None].repeat(len(base), 0)).with_inertia(base.mass, ratio)
        limits = np.array([0.1 * stiffness[:3, :3].max(), 15.0])  # beyond 0.1 m and 0.5 rad
        fast = {"velocity_limit": (1e3, 1e3), "max_step": 2.0, "soft_start": 0.0}
        controller = RealTimeAdmittance(schedule, spring_limit=tuple(limits), **fast)
        turned = Rotation.from_rotvec([1.0, -1.5, 0.7]) * rest
        velocity = rng.normal(size=6)
        controller.start(0.0, base.position[0] + 0.2, velocity, orientation=turned.as_quat(scalar_first=True))
        now, energies = 0.0, []
        for step in np.exp(rng.uniform(np.log(1e-4), np.log(0.3), size=200)):
            off = np.append(
                controller.position - base.position[0], (turn_of(controller.orientation) * rest.inv()).as_rotvec()
            )
            energy = 0.5 * np.array(controller.velocity) @ base.mass[0] @ controller.velocity
            for block, limit in zip(schedule.blocks, limits, strict=True):
                most = stiffness[block, block].max()
                stretch = off[block] @ stiffness[block, block] @ off[block]
                pull = math.sqrt(most * stretch)
                energy += limit * (pull - 0.5 * limit) / most if pull > limit else 0.5 * stretch
            energies.append(energy)
            limited += TickStatus.SPRING_LIMITED in controller.tick(now := now + step, [0.0] * 6)
        energies = np.array(energies)
        assert (np.diff(energies) <= 1e-12 * energies[0]).all()
        assert energies[-1] < 0.5 * energies[0]
    assert limited > 20

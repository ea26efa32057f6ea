"""The controller of the loop after stalls, bad clocks, spikes, losses, and where its schedule is cut while moving.

Numbers in the names are those of the list of faults that the project keeps.
"""

import math
import warnings
from dataclasses import replace

import numpy as np
import pytest
from control.loops import MASS, as_schedule, constant, make_schedule, one_axis

from torch_pbd import DMPController, GMMBaseline
from torch_pbd.control import AdmittancePlant
from torch_pbd.control.realtime import RealTimeAdmittance, TickStatus
from torch_pbd.data import make_tunnel_demonstrations

SPEED, DECELERATION = 0.4, 5.0  # of cut(), which is cut from a movement; the default of stop_deceleration
RISE = 0.5  # m/s^2: approach_speed / soft_start by default, more than 0.4 m/s in 1 s


def cut(duration=3.0, speed=SPEED, **more):
    """A motion of even speed: 100 N/m, critically damped, 1 kg."""
    time = np.arange(round(1000 * duration) + 1) / 1000
    gain = np.ones((len(time), 1, 1))
    rows = {"position": speed * time[:, None], "velocity": np.full((len(time), 1), speed)}
    return as_schedule(time, 100 * gain, 20 * gain, **rows, **more)


def wave(duration=3.0):
    """A motion of 0.4 m/s and 1.6 m/s^2 at most, cut while moving; 100 N/m, critically damped, 1 kg."""
    schedule = cut(duration)
    position, velocity = (a * f(4.0 * schedule.time)[:, None] for a, f in ((0.1, np.sin), (0.4, np.cos)))
    return replace(schedule, position=position, velocity=velocity)


def went(controller, times, forces=None):
    """Positions, velocities and schedule times after ticks, with what was before them."""
    d = len(controller.position)
    trace = [(controller.position, controller.velocity, controller.schedule_time)]
    for i, now in enumerate(times):
        controller.tick(now, [0.0] * d if forces is None else forces[i])
        trace.append((controller.position, controller.velocity, controller.schedule_time))
    return [np.array(values) for values in zip(*trace, strict=True)]


def accelerations(times, positions, velocities):
    """Of the velocities, and of differences of the positions, at the ticks."""
    steps = np.diff(times)[:, None]
    mean = np.diff(positions, axis=0) / steps
    between = 0.5 * (steps[1:] + steps[:-1])
    return [np.linalg.norm(a, axis=1) for a in (np.diff(velocities, axis=0) / steps, np.diff(mean, axis=0) / between)]


def test_73_a_schedule_that_is_cut_while_moving_is_come_up_to_and_ends_at_rest():
    controller, ticks = RealTimeAdmittance(cut()), np.arange(6001) / 1000
    controller.start(0.0)
    positions, velocities, _ = went(controller, ticks[1:])
    for each in accelerations(ticks, positions, velocities):
        assert each.max() <= RISE * 1.05  # the spring's answer to one tick's step comes besides
    # Even acceleration to 0.4 m/s takes 0.8 s and half the way of that; braking too.
    cruise = slice(1000, 2900)
    np.testing.assert_allclose(velocities[cruise, 0], SPEED, rtol=2e-3)
    np.testing.assert_allclose(positions[cruise, 0], SPEED * (ticks[cruise] - 0.4), rtol=0, atol=1e-3)
    assert positions.max() <= SPEED * 3.0 + 0.001 * SPEED  # the way of a tick; 14.7 mm where it ends at full speed
    np.testing.assert_allclose(positions[-1], SPEED * 3.0, rtol=1e-9)
    assert controller.desired_velocity == (0.0,)
    assert controller.schedule_time == 3.0


def test_73_a_robot_that_moves_with_the_schedule_is_not_slowed_at_its_start():
    controller, ticks = RealTimeAdmittance(cut()), np.arange(2001) / 1000
    controller.start(0.0, velocity=[SPEED])
    positions, _, passed = went(controller, ticks[1:])
    np.testing.assert_allclose(passed, ticks, rtol=1e-12)
    np.testing.assert_allclose(positions[:, 0], SPEED * ticks, rtol=0, atol=5e-4)  # a tick of v_d, held
    half = RealTimeAdmittance(cut())
    half.start(0.0, velocity=[0.5 * SPEED])
    half.tick(0.001, [0.0])
    np.testing.assert_allclose(half.desired_velocity, 0.5 * SPEED + 0.001 * RISE, rtol=1e-9)


def test_73_a_start_within_the_schedule_has_no_jerk_either():
    schedule = make_schedule(duration=1.0)
    controller = RealTimeAdmittance(schedule, mass=MASS)
    own = np.linalg.norm(np.diff(schedule.velocity, axis=0), axis=1).max() * 1000
    for at in (0.123, 0.5004, 0.7):
        controller.start(0.0, at=at)
        ticks = np.arange(1500) / 1000
        positions, velocities, passed = went(controller, ticks[1:])
        assert passed[0] == at
        assert accelerations(ticks, positions, velocities)[0][:5].max() <= 0.3 * own
        controller.start(0.0, controller.position, at=controller.schedule_time)  # the end, where it stands


@pytest.mark.parametrize("away", [-0.5, 0.01, 0.2])
@pytest.mark.parametrize(
    ("schedule", "limit"),
    [(cut(), 3.0792 * RISE), (wave(), 1.25 * 1.6 + RISE)],  # what a soft start takes; what a schedule does with one
    ids=["cut", "wave"],
)
def test_73_an_approach_and_its_schedule_stay_within_limits_together(schedule, limit, away):
    controller = RealTimeAdmittance(schedule)
    for at in (0.0, 0.35, 1.15, 2.9, 2.999):  # the last ones are at the end in mid-approach
        row = round(1000 * at)
        controller.start(0.0, schedule.position[row] + away, at=at)
        ticks = np.arange(6001) / 1000
        positions, velocities, passed = went(controller, ticks[1:])
        for each in accelerations(ticks, positions, velocities):
            assert each.max() <= limit, f"at {at}"
        assert passed[-1] == 3.0
        np.testing.assert_allclose(positions[-1], schedule.position[-1], rtol=0, atol=1e-4)


def test_74_nothing_is_caught_up_while_an_approach_is_under_way():
    controller = RealTimeAdmittance(wave(20.0), on_gap="resume")
    controller.start(0.0, [0.2])
    ticks = np.append(np.arange(201), np.arange(400, 15_000)) / 1000
    positions, velocities, passed = went(controller, ticks[1:])
    paces = np.diff(passed) / np.diff(ticks)
    is_over = passed[:-1] >= 1.5  # 0.2 m by minimum jerk within 0.5 m/s^2: sqrt(10 / sqrt(3) 0.2 / 0.5) s
    assert paces[~is_over].max() <= 1.0 + 1e-9
    assert 1.1 < paces[is_over].max() <= 1.5 + 1e-9
    np.testing.assert_allclose(ticks[-1] - passed[-1], ticks[200] - passed[200], rtol=0, atol=5e-3)
    assert accelerations(ticks, positions, velocities)[0][202:].max() <= 1.25 * 1.6 + RISE


@pytest.mark.parametrize("gap", [0.012, 0.05, 1.0, 4.0])
@pytest.mark.parametrize("on_gap", ["pause", "resume"])
def test_74_after_a_gap_the_robot_is_not_thrown_after_the_schedule(on_gap, gap):
    controller = RealTimeAdmittance(cut(20.0), on_gap=on_gap)
    controller.start(0.0)
    before, after = 1500, 1501
    end = 4000 + 2500 * gap if on_gap == "resume" else 4000
    ticks = np.append(np.arange(1501), np.arange(1500, end) + 1000 * gap) / 1000
    positions, velocities, passed = went(controller, ticks[1:])
    for each in accelerations(ticks, positions, velocities):
        assert each.max() <= DECELERATION * (1 + 1e-9)
        assert each[after + 1 :].max() <= 1.06 * RISE
    braking = 0.5 * SPEED * SPEED / DECELERATION  # m
    assert 0.0 <= positions[after, 0] - positions[before, 0] <= braking + 1e-6
    if gap >= 1.0:
        assert (positions[after], velocities[after]) == (positions[before], 0.0)
        np.testing.assert_allclose(passed[after], passed[before], rtol=1e-12)
    assert velocities.max() <= SPEED * (1.0 if on_gap == "pause" else 1.5) * (1 + 2e-3)
    lag = (ticks - passed)[[before, -1]]
    if on_gap == "resume":
        np.testing.assert_allclose(lag[1], lag[0], rtol=0, atol=2e-3)
    else:
        least = gap - SPEED / DECELERATION  # what it brakes for counts
        assert lag[0] + least <= lag[1] <= lag[0] + gap + SPEED / RISE
    assert controller.faults == TickStatus.LATE


def test_74_a_push_is_answered_as_in_the_simulation():
    schedule = DMPController(GMMBaseline()).fit(make_tunnel_demonstrations(random_state=0)).schedule(rate=200.0)
    push = np.zeros_like(schedule.position)
    push[320:480, 0] = 5.0
    rows = (schedule.position, schedule.velocity, schedule.stiffness, schedule.damping)
    run = AdmittancePlant(mass=1.0).simulate(*rows, push, dt=0.005).numpy()
    controller = RealTimeAdmittance(schedule, rate=200.0, max_step=0.02)
    controller.start(0.0, velocity=schedule.velocity[0])
    positions, _, _ = went(controller, np.arange(1, len(push)) / 200, push)
    moved = np.abs(run.position - schedule.position).max()
    assert moved > 0.02
    body = slice(0, 1960)  # the tunnel ends while moving: its end is slowed
    np.testing.assert_allclose(positions[body], run.position[body], rtol=0, atol=0.01 * moved)
    assert controller.faults == 0


def test_74_the_command_never_outgrows_what_force_and_schedule_can_cause():
    swing = constant(100.0, 2.0)  # ratio 0.1: at resonance 20 N move it at 10 m/s, a square wave at 12.7
    controller = RealTimeAdmittance(swing, force_limit=20.0, spring_limit=1e3)
    controller.start(0.0)
    times = np.arange(1, 6001) / 1000
    _, velocities, _ = went(controller, times, 1e3 * np.sign(np.sin(10.0 * times))[:, None])
    assert 12.0 < np.abs(velocities).max() < 13.0
    assert controller.faults == TickStatus.FORCE_SATURATED
    controller = RealTimeAdmittance(replace(swing, stiffness=100.0 * np.array([[[1.0]], [[1e9]]])))
    controller.start(0.0, velocity=[1.0])
    _, velocities, _ = went(controller, times, np.full((6000, 1), 200.0))
    assert np.abs(velocities).max() <= 2.0 * 400.0 / 2.0 + 0.5 + 1.0


@pytest.mark.parametrize("mass", [0.2, 10.0])
def test_74_the_speed_that_a_force_can_cause_does_not_depend_on_the_mass(mass):
    controller = RealTimeAdmittance(constant(1e-6, 10.0), mass=mass, force_limit=200.0, spring_limit=1.0)
    controller.start(0.0)
    times = np.arange(1, 12_001) / 1000
    _, velocities, _ = went(controller, times, np.full((len(times), 1), 200.0))
    assert velocities[-1] == pytest.approx(20.0, rel=1e-4)  # F / D
    assert controller.faults == 0


CLOCKS = {
    "back": lambda now: now - 5.0,
    "still": lambda now: 1.0,
    "nan": lambda now: math.nan,
    "inf": lambda now: math.inf,
}


@pytest.mark.parametrize("clock", CLOCKS)
def test_75_a_clock_that_fails_stops_the_robot_and_velocity_is_what_position_does(clock):
    controller = RealTimeAdmittance(cut(), max_bad_ticks=10)
    controller.start(0.0, velocity=[SPEED])
    went(controller, np.arange(1, 1001) / 1000)
    at_failure = controller.position[0]
    trace = [(controller.position[0], controller.velocity[0])]
    for i in range(1001, 1400):
        status = controller.tick(CLOCKS[clock](i / 1000), [0.0])
        assert status == (TickStatus.CLOCK if i < 1010 else TickStatus.CLOCK | TickStatus.STOPPED)
        trace.append((controller.position[0], controller.velocity[0]))
    positions, velocities = np.array(trace).T
    n = np.arange(400)
    np.testing.assert_allclose(velocities, np.maximum(velocities[0] - 0.001 * DECELERATION * n, 0.0), atol=1e-12)
    np.testing.assert_allclose(np.diff(positions), 0.0005 * (velocities[1:] + velocities[:-1]), rtol=0, atol=2e-6)
    np.testing.assert_allclose(positions[-1] - at_failure, 0.5 * velocities[0] ** 2 / DECELERATION, rtol=1e-6)


@pytest.mark.parametrize("back", [0.0005, 0.002, 0.0055])
def test_75_a_clock_that_steps_back_by_some_ticks_is_bridged(back):
    controller, ticks = RealTimeAdmittance(cut()), np.arange(2501) / 1000
    controller.start(0.0, velocity=[SPEED])
    told = ticks - np.where(ticks > 1.0004, back, 0.0)
    positions, velocities, _ = went(controller, told[1:])
    for each in accelerations(ticks, positions, velocities) if back >= 0.001 else ():
        assert each.max() <= DECELERATION * (1 + 1e-6)
    assert controller.faults == (TickStatus.CLOCK if back >= 0.001 else 0)
    np.testing.assert_allclose(velocities[-100:], SPEED, rtol=1e-3)


@pytest.mark.parametrize(("every", "stops"), [(2, True), (10, True), (20, False), (50, False)])
def test_75_a_clock_that_repeats_stamps_until_the_robot_stands_stops_it(every, stops):
    controller = RealTimeAdmittance(cut())
    controller.start(0.0)
    went(controller, [(i - (i % every == 0)) / 1000 for i in range(1, 2001)])
    assert controller.faults == TickStatus.CLOCK | TickStatus.STOPPED * stops
    assert (controller.schedule_time > 0.5) == (not stops)


@pytest.mark.parametrize(("good", "stops"), [(1, True), (9, True), (10, False)])
def test_79_a_loop_that_is_late_until_the_robot_stands_stops_it(good, stops):
    controller = RealTimeAdmittance(cut())
    controller.start(0.0)
    went(controller, np.cumsum(np.tile([0.011, *[0.001] * good], 100)))
    assert controller.faults == TickStatus.LATE | TickStatus.STOPPED * stops


def test_76_a_spike_before_a_loss_is_not_held():
    controller = one_axis()
    controller.start(0.0)
    good = [1.0, 1.2, 0.9, 1.1, 1.0]
    for i, force in enumerate([*good, 180.0, -180.0], start=1):
        controller.tick(i / 1000, [force])
    before = controller.velocity[0]
    held = []
    for i in range(8, 18):
        assert controller.tick(i / 1000, [math.nan]) == TickStatus.FORCE_INVALID
        held.append(controller.force[0])
    np.testing.assert_allclose(
        held, np.median([0.9, 1.1, 1.0, 180.0, -180.0]) * (1 - np.arange(1, 11) / 11), rtol=1e-12
    )
    assert abs(controller.velocity[0] - before) <= 0.001 * sum(held) + 0.01 * 10.0 * abs(before)
    assert controller.tick(0.018, [math.nan]) == TickStatus.FORCE_INVALID | TickStatus.STOPPED
    assert controller.force == (0.0,)


def test_76_the_rate_of_force_is_limited_where_it_is_asked_for():
    controller = RealTimeAdmittance(constant(100.0 * np.eye(2), 10.0 * np.eye(2)), force_rate_limit=2000.0)
    controller.start(0.0)
    acting = []
    for i in range(1, 6):
        status = controller.tick(i / 1000, [3.0, 4.0])
        assert status == (TickStatus.FORCE_RATE_LIMITED if i < 3 else 0)
        acting.append(math.hypot(*controller.force))
    np.testing.assert_allclose(acting, [2.0, 4.0, 5.0, 5.0, 5.0], rtol=1e-12)
    np.testing.assert_allclose(np.array(controller.force) / 5.0, [0.6, 0.8], rtol=1e-12)
    assert controller.tick(0.006, [180.0, 0.0]) == TickStatus.FORCE_RATE_LIMITED
    assert math.dist(controller.force, [3.0, 4.0]) == pytest.approx(2.0)


def test_77_another_mass_than_that_of_the_schedule_is_told():
    with pytest.warns(
        UserWarning, match=r"mass is another, but damping_ratio was met for mass=1 kg, off by up to 1900%"
    ):
        RealTimeAdmittance(cut(mass=1.0), mass=20.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for schedule, mass in [(cut(mass=2.0), 2.0), (cut(mass=2.0), None), (cut(mass=None), 3.0), (cut(), 3.0)]:
            RealTimeAdmittance(schedule, mass=mass)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"now": 0.0, "position": [0.0], "at": 1e306}, r"at is 1e\+306 s, .* at least 0 and at most 3"),
        ({"now": 0.0, "at": 3.0001}, "at most 3"),
        ({"now": 0.0, "at": 10**400}, "at is .* must be a finite number"),
        ({"now": 1e300}, "small enough to tell ticks of 0.001 s apart: give seconds"),
        ({"now": 1_767_225_600_000_000_000}, "give seconds"),  # unix time in ns
        ({"now": 0.0, "position": [1e300]}, r"position\[0\] is 1e\+300, must be finite"),
        ({"now": 0.0, "velocity": [10**400]}, "velocity holds a number too large"),
    ],
)
def test_78_a_start_that_is_refused_leaves_the_controller_free(arguments, words):
    controller = RealTimeAdmittance(cut())
    with pytest.raises(ValueError, match=words):
        controller.start(**arguments)
    controller.start(1_767_225_600.0, at=3.0)  # unix time in s has digits enough
    assert controller.tick(1_767_225_600.001, [0.0]) == 0


def test_79_a_loop_that_is_always_too_slow_is_refused_with_its_step():
    controller = one_axis()
    controller.start(0.0)
    for i in (1, 2):
        assert controller.tick(0.011 * i, [5.0]) == TickStatus.LATE
    with pytest.raises(ValueError, match=r"max_step is 0.01 s, must be longer .* all 3 since start .* 0.011 s: give"):
        controller.tick(0.033, [-7.0])
    assert (controller.position, controller.velocity, controller.force) == ((0.0,), (0.0,), (5.0,))
    controller = one_axis(max_step=0.033)
    controller.start(0.0)
    assert [controller.tick(0.011 * i, [5.0]) for i in range(1, 5)] == [0] * 4
    assert controller.position[0] > 0.0


@pytest.mark.parametrize("origin", [0.0, 1234.567, 1_767_225_600.0])
def test_79_ticks_of_max_step_are_not_late_however_they_are_rounded(origin):
    controller = one_axis(max_step=0.01)
    controller.start(origin)
    assert not any(controller.tick(origin + 0.01 * i, [5.0]) for i in range(1, 100))
    assert controller.tick(origin + 1.0001, [5.0]) == TickStatus.LATE


def test_79_a_loop_that_has_become_too_slow_stops_the_robot():
    controller = RealTimeAdmittance(cut())
    controller.start(0.0, velocity=[SPEED])
    went(controller, np.arange(1, 501) / 1000)
    statuses = [controller.tick(0.5 + 0.011 * i, [0.0]) for i in range(1, 4)]
    assert statuses == [TickStatus.LATE, TickStatus.LATE, TickStatus.LATE | TickStatus.STOPPED]
    went(controller, 0.533 + np.arange(1, 100) / 1000)
    assert controller.velocity == (0.0,)


@pytest.mark.parametrize(
    ("option", "value"),
    [("on_gap", "skip"), ("max_bad_ticks", 0), ("max_bad_ticks", 2.5), ("force_rate_limit", 0.0)],
)
def test_56_the_options_of_bad_times_and_forces_are_checked(option, value):
    with pytest.raises(ValueError, match=f"^{option} is "):
        RealTimeAdmittance(cut(0.01), **{option: value})

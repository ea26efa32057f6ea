"""What the controller of the loop does with bad forces, clocks, schedules and callers.

Numbers in the names are those of the list of faults that the project keeps.
"""

import math
import re
import subprocess
import sys
import threading
import tracemalloc

import numpy as np
import pytest
from control.loops import MASS, USED, as_schedule, constant, make_schedule, one_axis, run

from torch_pbd.control.realtime import RealTimeAdmittance, TickStatus

EXACT = {"soft_start": 0.0, "spring_limit": 1e9}  # nothing but the law itself


def test_60_time_in_the_schedule_does_not_add_up_rounding():
    controller, step = RealTimeAdmittance(constant(100.0, 10.0, duration=10.0), soft_start=0.0), 1e-3 / 3
    controller.start(1e5)
    for i in range(1, 10_001):
        controller.tick(1e5 + i * step, [0.0])
        assert controller.schedule_time == (1e5 + i * step) - 1e5
    controller.tick(2e5, [0.0])  # 28 h later: schedule time has stood
    np.testing.assert_allclose(controller.schedule_time, 10_000 * step, rtol=0, atol=1e-9)
    controller.start(0.0, at=0.25)
    assert controller.schedule_time == 0.25


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_52_a_short_loss_of_force_is_bridged_by_the_median_of_the_last_good_ones(bad):
    schedule = make_schedule(duration=1.0)
    times = np.arange(1, 900) / 1000
    forces = 5.0 * np.sin(np.stack([30.0 * times, 20.0 * times], axis=1))
    for is_lost in ([500], range(500, 510), [*range(500, 510), *range(511, 521)]):
        lost, bridged = forces.copy(), forces.copy()
        lost[is_lost, 1] = bad
        good = [i for i in range(len(times)) if i not in is_lost]
        for i in is_lost:
            last = [j for j in good if j < i][-5:]
            bridged[i] = np.median(forces[last], axis=0) * (1.0 - (i - last[-1]) / 11.0)  # fading over 10 ticks
        ends = []
        for told in (lost, bridged):
            controller = RealTimeAdmittance(schedule, mass=MASS)
            controller.start(0.0)
            ends.append(run(controller, times, told))
        np.testing.assert_allclose(ends[0][:2], ends[1][:2], rtol=1e-12)
        assert ends[0][2] == [TickStatus.FORCE_INVALID * (i in is_lost) for i in range(len(times))]


def test_52_a_long_loss_of_force_stops_the_robot_until_it_is_started_again():
    controller = one_axis(acceleration_limit=50.0, stop_deceleration=2.0, velocity_limit=1.0)
    controller.start(0.0, velocity=[-0.3])
    now, velocities, positions = 0.0, [-0.3], [0.0]
    for i in range(1, 1500):
        now = i / 1000
        status = controller.tick(now, [math.nan] if 5 <= i < 1005 else [1.0])
        velocities.append(controller.velocity[0])
        positions.append(controller.position[0])
        assert (TickStatus.STOPPED in status) == (i >= 15)
    at_stop = velocities[14]
    np.testing.assert_allclose(np.diff(velocities[14:])[:100], 0.002, rtol=1e-9)
    assert velocities[-1] == 0.0
    np.testing.assert_allclose(positions[-1] - positions[14], 0.5 * at_stop * abs(at_stop) / 2.0, rtol=1e-9)
    assert positions[300] == positions[-1]
    controller.start(now, controller.position, at=controller.schedule_time)
    assert controller.tick(now + 0.001, [1.0]) == 0
    assert controller.faults == 0
    assert controller.velocity[0] != 0.0


def test_53_ticks_that_time_forbids_brake_the_robot_over_a_tick():
    controller = one_axis()
    controller.start(0.0, [0.1], [0.5])
    assert controller.tick(0.001, [2.0]) == 0
    for now in (0.001, 0.0005, math.nan, math.inf, -math.inf):
        position, velocity = controller.position[0], controller.velocity[0]
        assert controller.tick(now, [2.0]) == TickStatus.CLOCK
        np.testing.assert_allclose(controller.velocity, velocity - 5.0 * 0.001, rtol=1e-12)
        np.testing.assert_allclose(controller.position, position + 0.001 * (velocity - 0.0025), rtol=1e-12)
    steady = one_axis()
    steady.start(0.0, controller.position, controller.velocity)
    assert controller.tick(0.007, [2.0]) == steady.tick(0.001, [2.0]) == 0  # the bad ones took 5 ms
    np.testing.assert_allclose(controller.position, steady.position, rtol=1e-12)
    np.testing.assert_allclose(controller.velocity, steady.velocity, rtol=1e-9)
    position, passed = controller.position, controller.schedule_time
    assert controller.tick(1.007, [2.0]) == TickStatus.LATE
    assert (controller.position, controller.velocity) == (position, (0.0,))
    np.testing.assert_allclose(controller.schedule_time, passed, rtol=1e-9)
    assert controller.tick(1.008, [2.0]) == 0
    assert controller.faults == TickStatus.CLOCK | TickStatus.LATE


@pytest.mark.parametrize("length", [30.0, 1e200, 1e307])
def test_54_a_force_beyond_the_sensor_is_shortened_to_its_range(length):
    controllers = []
    for force in (np.array([0.6, -0.8]) * length, [12.0, -16.0]):
        controller = RealTimeAdmittance(make_schedule(), mass=MASS, force_limit=20.0)
        controller.start(0.0)
        expected = TickStatus.FORCE_SATURATED if force[0] != 12.0 else 0
        assert controller.tick(0.001, force) == expected
        controllers.append(controller)
    np.testing.assert_allclose(controllers[0].force, [12.0, -16.0], rtol=1e-12)
    np.testing.assert_allclose(controllers[0].velocity, controllers[1].velocity, rtol=1e-12)


def test_54_the_command_keeps_its_limits_and_says_so(rng):
    controller = RealTimeAdmittance(make_schedule(duration=2.0), mass=MASS, velocity_limit=0.4, acceleration_limit=30.0)
    controller.start(0.0, [0.2, -0.1])
    last, seen = 0.0, TickStatus(0)
    for now in np.cumsum(rng.uniform(1e-4, 5e-3, size=600)).tolist():
        position, velocity = controller.position, controller.velocity
        force = 150.0 * rng.normal() * np.array([1.0, 0.5]) if rng.random() < 0.2 else np.zeros(2)
        seen |= controller.tick(now, force)
        assert math.dist(controller.velocity, velocity) <= 30.0 * (now - last) * (1 + 1e-9)
        assert math.hypot(*controller.velocity) <= 0.4 * (1 + 1e-9)
        assert math.dist(controller.position, position) <= 0.4 * (now - last) * (1 + 1e-9)
        last = now
    assert TickStatus.VELOCITY_LIMITED | TickStatus.ACCELERATION_LIMITED in seen
    assert controller.faults == seen


def test_54_a_swing_within_one_tick_keeps_the_velocity_limit_too():
    controller = RealTimeAdmittance(constant(1e4, 0.0), max_step=0.05, velocity_limit=1.0, **EXACT)
    controller.start(0.0, [0.1])
    assert controller.tick(math.pi / 100, [0.0]) == TickStatus.VELOCITY_LIMITED  # half a period, from rest to rest
    assert 0.1 - controller.position[0] <= math.pi / 100


@pytest.mark.parametrize("soft_start", [0.0, 1.0])
@pytest.mark.parametrize("coupled", [0.0, 1.0])
def test_57_a_robot_one_metre_away_is_not_pulled_beyond_the_limit(soft_start, coupled):
    schedule = make_schedule(duration=2.0, coupled=coupled)
    controller = RealTimeAdmittance(schedule, mass=MASS, spring_limit=40.0, soft_start=soft_start)
    here = schedule.position[0] + [0.6, 0.8]
    controller.start(0.0, here)
    fastest, limited = 0.0, 0
    for i in range(1, 4000):
        before = np.array(controller.position)
        push = 100.0 * (1800 < i < 1900)  # someone holds it off later
        limited += TickStatus.SPRING_LIMITED in controller.tick(i / 1000, [push, 0.0])
        pull = controller.stiffness @ (np.array(controller.desired_position) - before)
        assert np.linalg.norm(pull) <= 40.0 * (1 + 1e-9)
        fastest = max(fastest, math.hypot(*controller.velocity)) if i < 1500 else fastest
    assert limited > 0
    np.testing.assert_allclose(controller.position, schedule.position[-1], rtol=0, atol=0.005)
    if soft_start:
        assert fastest < 0.85  # 0.5 m/s of approach, and what the schedule itself moves at
        controller.start(0.0, here)
        controller.tick(0.001, [0.0, 0.0])
        np.testing.assert_allclose(controller.desired_position, here, rtol=1e-12)


def changed(name, row, value, **more):
    """Arrays of a schedule, of which one row, or more, is another."""
    schedule = make_schedule(duration=0.01)
    arrays = {key: getattr(schedule, key).copy() for key in ("time", *USED)}
    arrays[name][row] = value
    return arrays | more


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        (changed("stiffness", 3, np.nan), "stiffness[3, 0, 0] is nan, must be finite"),
        (changed("position", 2, np.inf), "position[2, 0] is inf, must be finite"),
        (changed("time", 4, 0.003), "time[4] is 0.003 s, must be later"),
        (changed("stiffness", 5, [[100.0, 9.0], [8.0, 100.0]]), "the asymmetry of stiffness[5] is 1.0"),
        (changed("damping", 6, [[1.0, 2.0], [2.0, 1.0]]), "smallest eigenvalue of damping[6] is -1.0"),
        (changed("stiffness", 7, [[1e4, 0.0], [0.0, 0.0]], damping=np.zeros((11, 2, 2))), "damping[7] is 0.0"),
        (
            changed("stiffness", 0, 49.0 * np.eye(2), stiffness_limits=(50, 1e4)),
            "beyond stiffness_limits[0] is",
        ),
        (changed("stiffness", 9, 1.1e4 * np.eye(2), stiffness_limits=(50, 1e4)), "beyond stiffness_limits[9] is"),
        (changed("time", 0, 0.0, position=np.zeros((11, 3))), "velocity has shape (11, 2), must"),
        (changed("time", 0, 0.0, position=np.zeros(11)), "must have"),
        (changed("time", 10, 1e7), "lower it"),
    ],
)
def test_55_a_schedule_that_cannot_be_followed_is_refused(rows, words):
    with pytest.raises(ValueError, match=re.escape(words)):
        RealTimeAdmittance(as_schedule(**rows))


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("mass", 0.0),
        ("mass", True),
        ("rate", math.inf),
        ("max_step", math.nan),
        ("max_step", 0.001),
        ("force_limit", -1.0),
        ("spring_limit", 0.0),
        ("velocity_limit", "1"),
        ("acceleration_limit", 0.0),
        ("stop_deceleration", 0.0),
        ("hold_ticks", -1),
        ("hold_ticks", 1.5),
        ("soft_start", -1.0),
    ],
)
def test_56_a_parameter_out_of_range_is_named(option, value):
    with pytest.raises(ValueError, match=f"(?s)^{option} is .* must be"):
        RealTimeAdmittance(make_schedule(duration=0.01), **{option: value})


def test_59_calls_that_make_no_sense_say_so():
    controller = RealTimeAdmittance(make_schedule(duration=0.01), velocity_limit=1.0)
    for force in ([1.0, math.nan], [1.0]):
        with pytest.raises(RuntimeError, match=r"call start\(now\)"):
            controller.tick(0.0, force)
    assert (controller.force, controller.faults) == ((0.0, 0.0), 0)
    for arguments, words in [
        ((math.nan,), "now is nan"),
        ((0.0, [0.0]), r"position has shape \(1,\), must have shape \(2,\)"),
        ((0.0, [0.0, math.nan]), r"position\[1\] is nan"),
        ((0.0, None, ["a", "b"]), "velocity holds text"),
        ((0.0, None, [0.8, 0.8]), "the speed is .* at most 1: slow it down"),
    ]:
        with pytest.raises(ValueError, match=words):
            controller.start(*arguments)
    with pytest.raises(ValueError, match=r"at is -1\.0"):
        controller.start(0.0, at=-1.0)
    controller.start(0.0)
    for force in ([1.0], [1.0, 2.0, 3.0], None, [None, 1.0], 5.0):
        with pytest.raises(ValueError, match="2 numbers in N"):
            controller.tick(0.001, force)
    assert controller.tick(0.001, [1.0, 2.0]) == 0  # nothing had changed, and the turn was given back


def test_59_two_threads_in_one_tick_are_told_apart():
    controller, told = one_axis(), []

    class Slow:
        """A force during whose reading another thread calls."""

        def __iter__(self):
            def other():
                for call in (lambda: controller.tick(0.002, [0.0]), lambda: controller.start(0.0)):
                    with pytest.raises(RuntimeError, match="two threads"):
                        call()
                    told.append(True)

            thread = threading.Thread(target=other)
            thread.start()
            thread.join()
            return iter([1.0])

    assert controller.tick(0.001, Slow()) == 0
    assert told == [True, True]
    assert controller.tick(0.002, [1.0]) == 0


def test_59_controllers_share_a_schedule_and_start_again_alike():
    schedule = make_schedule()
    first, second = (RealTimeAdmittance(schedule, mass=MASS) for _ in range(2))
    first.start(0.0, [0.1, 0.0])
    second.start(5.0)
    for i in range(1, 200):
        first.tick(i / 1000, [1.0, 2.0])
        second.tick(5.0 + i / 1000, [-3.0, math.nan])
    assert schedule == make_schedule()
    once = first.position, first.velocity
    for controller in (first, second):
        controller.start(0.0, [0.1, 0.0])
        for i in range(1, 200):
            controller.tick(i / 1000, [1.0, 2.0])
        assert (controller.position, controller.velocity, controller.faults) == (*once, 0)


@pytest.mark.parametrize(
    ("d", "coupled", "n_ticks"),
    [(1, 0.0, 5000), (2, 0.0, 5000), (2, 1.0, 2000), pytest.param(3, 0.0, 20_000, marks=pytest.mark.slow)],
)
def test_60_ticks_keep_no_memory(d, coupled, n_ticks):
    controller = RealTimeAdmittance(make_schedule(d, coupled=coupled), mass=MASS, velocity_limit=0.1)
    controller.start(0.0, np.full(d, 0.1))

    def ticks(n, m):
        for i in range(n, m):
            controller.tick(i / 1000 + (i % 100 == 0), [math.nan if i % 7 == 0 else 1.0] * d)

    ticks(1, 500)
    tracemalloc.start()
    ticks(500, 1000)
    before = tracemalloc.get_traced_memory()[0]
    ticks(1000, 1000 + n_ticks)
    grown = tracemalloc.get_traced_memory()[0] - before
    tracemalloc.stop()
    assert grown < 2000


def test_61_runs_without_torch():
    program = """
import sys
import numpy as np
from torch_pbd.control.realtime import RealTimeAdmittance
from torch_pbd.control.schedule import Schedule
rows, still = np.stack([np.diag([100.0, 200.0])] * 2), np.zeros((2, 2))
controller = RealTimeAdmittance(Schedule([0.0, 1.0], still, still, rows, rows, rows, [0.0, 0.0]))
controller.start(0.0)
for i in range(1, 100):
    controller.tick(i / 1000, (1.0, 2.0))
print([name for name in ("torch", "scipy", "sklearn") if name in sys.modules])
"""
    ran = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert ran.stdout.strip() == "[]"

"""The controller of the loop: exact ticks. What it does with what is bad is in tests/faults/test_control.py."""

import itertools
import math
from dataclasses import replace

import mpmath
import numpy as np
import pytest
import torch
from control.loops import MASS, USED, constant, make_schedule, one_axis
from scipy.interpolate import CubicHermiteSpline
from scipy.linalg import expm

from torch_pbd.control.realtime import RealTimeAdmittance, TickStatus, steps

EXACT = {"soft_start": 0.0, "spring_limit": 1e9}  # nothing but the law itself


def solved(schedule, row, state, force, step):
    """Position and velocity by scipy, from the augmented system of eq. (15)."""
    d = len(force)
    rate = np.zeros((2 * d + 1, 2 * d + 1))
    rate[:d, d:-1] = np.eye(d)
    rate[d:-1, :d], rate[d:-1, d:-1] = -schedule.stiffness[row] / MASS, -schedule.damping[row] / MASS
    held = schedule.stiffness[row] @ schedule.position[row] + schedule.damping[row] @ schedule.velocity[row]
    rate[d:-1, -1] = (force + held) / MASS
    return (expm(rate * step) @ np.append(state, 1.0))[:-1]


@pytest.mark.parametrize("rate", [1000.0, 100.0])
@pytest.mark.parametrize(("d", "coupled"), [(1, 0.0), (2, 0.0), (2, 1e-5), (2, 1.0), (3, 0.0), (3, 1.0)])
def test_each_tick_is_the_matrix_exponential(d, coupled, rate, rng):
    schedule = make_schedule(d, rate=rate, duration=400 / rate, coupled=coupled, offset=7.0)  # whose end is slowed
    controller = RealTimeAdmittance(schedule, mass=MASS, rate=rate, max_step=5 / rate, **EXACT)
    start = 1e-3 * rng.normal(size=2 * d)
    controller.start(3.0, start[:d], start[d:])
    times = 3.0 + np.cumsum(rng.uniform(0.1, 1.9, size=170)) / rate
    state, last, largest = start, 3.0, np.zeros(2)
    for now in times.tolist():
        row, force = round((last - 3.0) * rate), 5.0 * rng.normal(size=d)
        state = solved(schedule, row, state, force, now - last)
        last = now
        assert controller.tick(now, force) == 0
        largest = np.maximum(largest, np.abs(state).reshape(2, d).max(axis=1))
        np.testing.assert_allclose(controller.position, state[:d], rtol=0, atol=1e-9 * largest[0])
        np.testing.assert_allclose(controller.velocity, state[d:], rtol=0, atol=1e-9 * largest[1])
        for name in ("stiffness", "damping", "position", "velocity"):
            used, told = getattr(controller, USED[name]), getattr(schedule, name)
            np.testing.assert_allclose(used, told[row], rtol=0, atol=1e-11 * np.abs(told).max())
        np.testing.assert_allclose(controller.force, force, rtol=1e-12)


RATIOS = [0.0, 1e-6, 0.5, 1 - 1e-6, 1 - 1e-12, 1.0, 1 + 1e-12, 1 + 1e-6, 3.0, 1e3, 1e9]
CORNERS = [(k, 2.0 * ratio * math.sqrt(MASS * k)) for k in (1e-12, 1e-3, 50.0, 1e4) for ratio in RATIOS]
CORNERS += [(0.0, damping) for damping in (1e-12, 1e-3, 0.5, 100.0, 1e12)]


@pytest.mark.parametrize("step", [1e-6, 1e-3, 0.01, 1.0])
def test_one_tick_keeps_its_digits_in_every_corner(step):
    for k, damping in CORNERS:
        controller = RealTimeAdmittance(constant(k, damping, velocity=0.2), mass=MASS, max_step=2.0, **EXACT)
        with mpmath.workdps(60):
            push = 6 + mpmath.mpf(damping) / MASS * 0.2
            rows = [[0, 1, 0], [-mpmath.mpf(k) / MASS, -mpmath.mpf(damping) / MASS, push], [0] * 3]
            response = mpmath.expm(mpmath.matrix(rows) * step)
            moves = [response * mpmath.matrix(start) for start in ([0, 0, 1], [0.3, -0.7, 1])]
        for start, moved, atol in [((0.0, 0.0), moves[0], 1e-14 * step), ((0.3, -0.7), moves[1], 1e-14)]:
            controller.start(0.0, start[:1], start[1:])
            controller.tick(step, [3.0])
            reached = [controller.position[0], controller.velocity[0]]
            np.testing.assert_allclose(
                reached, np.array(moved[:2], float), rtol=1e-11, atol=atol, err_msg=f"{k} {damping}"
            )


@pytest.mark.parametrize(("d", "coupled"), [(1, 0.0), (2, 0.0), (2, 1.0), (3, 0.0)])
def test_free_motion_loses_energy_whatever_the_ticks_and_the_spring_limit(d, coupled, rng):
    limited = 0
    for _ in range(20):
        axes = np.linalg.qr(rng.normal(size=(d, d)))[0]
        values = np.exp(rng.uniform(0.0, np.log(1e4), size=d))
        stiffness = axes @ np.diag(values) @ axes.T
        damping = axes @ np.diag(0.4 * np.sqrt(values)) @ axes.T + coupled * np.diag(3.0 * np.arange(d))
        limit = 0.1 * values.max()  # acts beyond some 0.1 m
        controller = RealTimeAdmittance(constant(stiffness, damping), max_step=2.0, soft_start=0.0, spring_limit=limit)
        controller.start(0.0, rng.normal(size=d), rng.normal(size=d))
        now, energies = 0.0, []
        for step in np.exp(rng.uniform(np.log(1e-4), np.log(1.0), size=60)):
            stretch = values.max() * np.array(controller.position) @ stiffness @ np.array(controller.position)
            potential = limit * np.sqrt(stretch) - 0.5 * limit**2 if stretch > limit**2 else 0.5 * stretch
            energies.append(0.5 * np.sum(np.square(controller.velocity)) + potential / values.max())
            limited += TickStatus.SPRING_LIMITED in controller.tick(now := now + step, [0.0] * d)
        energies = np.array(energies)
        assert (np.diff(energies) <= 1e-12 * energies[:-1]).all()
        assert energies[-1] < energies[0]
    assert limited > 20


@pytest.mark.parametrize(("d", "coupled"), [(1, 0.0), (2, 0.0), (2, 1.0), (3, 0.0)])
def test_a_tick_with_a_limited_spring_is_that_of_the_stiffness_it_tells(d, coupled):
    schedule = make_schedule(d, coupled=coupled)
    controller = RealTimeAdmittance(schedule, mass=MASS, soft_start=0.0, spring_limit=5.0)
    start = np.append(schedule.position[0] + 0.2, np.full(d, -0.3))
    controller.start(0.0, start[:d], start[d:])
    assert controller.tick(0.008, [3.0] * d) == TickStatus.SPRING_LIMITED
    limited = replace(schedule, stiffness=np.stack([controller.stiffness, *schedule.stiffness[1:]]))
    reached = solved(limited, 0, start, np.full(d, 3.0), 0.008)
    np.testing.assert_allclose([*controller.position, *controller.velocity], reached, rtol=1e-11, atol=0)


def test_axes_that_are_shared_need_no_matrix_exponential(monkeypatch):
    monkeypatch.delattr(steps, "expm1")
    turned = np.array([[0.6, -0.8], [0.8, 0.6]])
    for stiffness, damping in [
        (100.0 * np.eye(2), turned @ np.diag([1.0, 9.0]) @ turned.T),  # whose own axes are open
        (turned @ np.diag([50.0, 1000.0]) @ turned.T, 5.0 * np.eye(2)),
    ]:
        controller = RealTimeAdmittance(constant(stiffness, damping), mass=MASS, **EXACT)
        controller.start(0.0, [0.01, 0.02])
        controller.tick(0.01, [1.0, -2.0])
        here = solved(constant(stiffness, damping), 0, [0.01, 0.02, 0.0, 0.0], np.array([1.0, -2.0]), 0.01)
        np.testing.assert_allclose([*controller.position, *controller.velocity], here, rtol=1e-11, atol=0)


def test_slower_rows_are_interpolated():
    schedule = make_schedule(rate=100.0)
    controller = RealTimeAdmittance(schedule, mass=MASS, soft_start=0.0)
    controller.start(0.0, at=0.1237)
    controller.tick(0.001, [0.0, 0.0])
    for name in ("stiffness", "damping"):
        told = getattr(schedule, name)
        between = 0.6 * told[12] + 0.4 * told[13]  # 0.124 s is the nearest millisecond
        np.testing.assert_allclose(getattr(controller, name), between, rtol=1e-9, atol=1e-12)
    motion = CubicHermiteSpline(schedule.time, schedule.position, schedule.velocity)
    np.testing.assert_allclose(controller.desired_position, motion(0.124), rtol=1e-9)
    np.testing.assert_allclose(controller.desired_velocity, motion(0.124, 1), rtol=1e-9)


def test_bias_and_deadband_keep_a_drifting_sensor_from_moving_the_robot():
    still = one_axis(deadband=0.2)
    still.start(0.0, force_bias=[0.5])
    for i in range(1, 1000):
        still.tick(i / 1000, [0.5 + 0.19 * math.sin(i)])
    assert still.position == (0.0,)
    pushed, plain = one_axis(deadband=0.2), one_axis()
    pushed.start(0.0, force_bias=[0.5])
    plain.start(0.0)
    for i in range(1, 1000):
        pushed.tick(i / 1000, [-2.7])  # 3.2 N less the deadband
        plain.tick(i / 1000, [-3.0])
    np.testing.assert_allclose(pushed.position, plain.position, rtol=1e-12)
    with pytest.raises(ValueError, match=r"force_bias\[0\] is nan, must be finite"):
        still.start(0.0, force_bias=[math.nan])
    with pytest.raises(ValueError, match=r"deadband is -1\.0 N, must be a finite number of at least 0"):
        one_axis(deadband=-1.0)


def test_after_the_end_the_last_row_holds_without_velocity():
    schedule = make_schedule(duration=0.05)
    controller = RealTimeAdmittance(schedule, mass=MASS, soft_start=0.0)
    controller.start(0.0)
    for i in range(1, 3000):
        controller.tick(i / 1000, [0.0, 0.0])
    assert controller.desired_velocity == (0.0, 0.0)
    np.testing.assert_array_equal(controller.stiffness, schedule.stiffness[-1])
    np.testing.assert_allclose(controller.position, schedule.position[-1], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(controller.velocity, 0.0, rtol=0, atol=1e-12)


@pytest.mark.parametrize("duration", [1e-9, 1e-7, 1e-4, 9.999e-4])
def test_a_schedule_shorter_than_a_tick_is_run(duration):
    controller = RealTimeAdmittance(constant(100.0, 20.0, position=0.1, duration=duration))
    controller.start(0.0, [0.1])
    for i in range(1, 100):
        assert controller.tick(i / 1000, [0.0]) == 0
    np.testing.assert_allclose(controller.position, 0.1, rtol=1e-12)
    assert controller.schedule_time == duration


def test_a_soft_start_follows_minimum_jerk_and_then_the_schedule():
    controller = one_axis(soft_start=0.5, approach_speed=1.875 / 0.5)  # as fast as that is over 1 m
    controller.start(0.0, [1.0])
    for i in range(1, 1001):
        controller.tick(i / 1000, [0.0])
        t = min((i - 1) / 500, 1.0)
        left = 1.0 - 10.0 * t**3 + 15.0 * t**4 - 6.0 * t**5
        np.testing.assert_allclose(controller.desired_position[0], left, rtol=0, atol=1e-12)
        slope = (-30.0 * t**2 + 60.0 * t**3 - 30.0 * t**4) / 0.5
        np.testing.assert_allclose(controller.desired_velocity[0], slope, rtol=0, atol=1e-12)


def test_a_row_of_a_schedule_is_decomposed_once_on_its_way_into_the_loop(monkeypatch):
    rows = make_schedule(duration=0.5)
    n, decomposed = len(rows), []

    def counted(function):
        def call(matrices, *args, **options):
            decomposed.append(math.prod(np.shape(matrices)[:-2]))
            return function(matrices, *args, **options)

        return call

    for library, name in itertools.product((np.linalg, torch.linalg), ("eigh", "eigvalsh", "eig", "eigvals")):
        monkeypatch.setattr(library, name, counted(getattr(library, name)))
    limits = (50.0 * (1 - 1e-12), 1e4 * (1 + 1e-12))
    schedule = replace(rows, stiffness_limits=limits)
    assert sum(decomposed) == 0  # Cholesky factors say that the gains are sound
    RealTimeAdmittance(schedule)
    assert sum(decomposed) == n  # the axes along which ticks are solved


def test_prints_on_one_line():
    controller = RealTimeAdmittance(make_schedule(duration=0.2), mass=MASS)
    controller.start(0.0, at=0.1)
    controller.tick(0.5, [0.0, 0.0])
    assert repr(controller) == (
        "RealTimeAdmittance(n_axes=2, mass=0.5 kg, rate=1000 Hz, schedule_time=0.1..0.2 s, faults=LATE)"
    )


def test_status_prints_well():
    assert str(TickStatus(0)) == "fine"
    assert str(TickStatus.LATE | TickStatus.STOPPED) == "LATE|STOPPED"
    assert not TickStatus(0)

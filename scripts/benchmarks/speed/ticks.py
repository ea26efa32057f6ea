"""Ticks of the real-time controller, of a bare loop that solves the same, and of torch without preparation."""

import gc
import math
import random
import time
import tracemalloc
from collections.abc import Callable, Iterable

import numpy as np
import torch

from torch_pbd.control import RealTimeAdmittance, Schedule

RATE, MASS, BLOCK = 1000.0, 1.0, 10_000

Tick = tuple[float, tuple[float, float]]


def turning_schedule() -> Schedule:
    """11 s of a curve, the last of which no block reaches; 200..1000 N/m, axes turning at 1 rad/s, critical damping."""
    phase = np.arange(1.1 * BLOCK + 1) / RATE
    axes = np.moveaxis(np.array([[np.cos(phase), -np.sin(phase)], [np.sin(phase), np.cos(phase)]]), -1, 0)
    eigenvalues = 600.0 + 400.0 * np.stack([np.sin(phase), np.cos(2.0 * phase)], axis=1)
    stiffness, damping = (
        axes * values[:, None, :] @ axes.mT for values in (eigenvalues, 2.0 * np.sqrt(MASS * eigenvalues))
    )
    position = np.stack([0.1 * phase, np.sin(phase)], axis=1)
    velocity = np.stack([0.1 + 0 * phase, np.cos(phase)], axis=1)
    return Schedule(phase, position, velocity, stiffness, damping, covariance=stiffness, type1=0.0 * phase)


def ticks(seed: int, n_ticks: int = BLOCK) -> list[Tick]:
    """Times of a loop that wakes up 0..0.2 ms late, and a force of some newtons."""
    draw = random.Random(seed)
    return [((i + 0.2 * draw.random()) / RATE, (draw.gauss(0, 5), draw.gauss(0, 5))) for i in range(1, n_ticks + 1)]


def controlled(controller: RealTimeAdmittance, block: Iterable[Tick], took: list[int]) -> tuple[float, ...]:
    """Where the controller arrives; nanoseconds of this thread for each tick, with one reading of the clock."""
    clock, tick = time.thread_time_ns, controller.tick
    controller.start(0.0, velocity=controller._table.row(0)[2:4])  # else the schedule would come up to speed first
    for now, force in block:
        before = clock()
        tick(now, force)
        took.append(clock() - before)
    return controller.position


def bare(controller: RealTimeAdmittance, block: Iterable[Tick], took: list[int]) -> tuple[float, ...]:
    """The same for a loop that looks up the same row and does the same arithmetic, in place and of two axes only.

    For critical damping and floats that are floats already: no checks, no calls, no limits.
    """
    clock, expm1 = time.thread_time_ns, math.expm1
    table = controller._table
    packed, unpack, size, end = table.packed, table.layout.unpack_from, table.layout.size, table.last
    (x, y, vx, vy), last = unpack(packed, 0)[:4], 0.0
    for now, (fx, fy) in block:
        before = clock()
        step = now - last
        index = int(last * RATE + 0.5)
        gx, gy, gvx, gvy, _, k1, k2, a1, a2, c, s, _ = unpack(packed, (index if index < end else end) * size)
        ex, ey = x - gx, y - gy
        v1, v2 = c * vx + s * vy, c * vy - s * vx
        q1 = (c * fx + s * fy) / MASS + 2.0 * a1 * (c * gvx + s * gvy) - k1 * (c * ex + s * ey)
        q2 = (c * fy - s * fx) / MASS + 2.0 * a2 * (c * gvy - s * gvx) - k2 * (c * ey - s * ex)
        lost1, lost2 = -expm1(-a1 * step), -expm1(-a2 * step)
        kick1, kick2 = (1.0 - lost1) * step, (1.0 - lost2) * step
        ramp1, ramp2 = (lost1 - a1 * kick1) / k1, (lost2 - a2 * kick2) / k2
        dx1, dx2 = kick1 * v1 + ramp1 * q1, kick2 * v2 + ramp2 * q2
        dv1 = kick1 * q1 - (2.0 * a1 * kick1 + k1 * ramp1) * v1
        dv2 = kick2 * q2 - (2.0 * a2 * kick2 + k2 * ramp2) * v2
        x, y = x + c * dx1 - s * dx2, y + s * dx1 + c * dx2
        vx, vy = vx + c * dv1 - s * dv2, vy + s * dv1 + c * dv2
        last = now
        took.append(clock() - before)
    return x, y


def eager(n_ticks: int, took: list[int], *, n_inputs: int = 200) -> None:
    """What a tick costs that asks torch: a step of the primitive, 5 means at one phase, eigenvectors, K and D.

    Of the five Gaussian processes (200 inputs) two are the forcing and three the factor of the covariance; nothing asks
    for a gradient, and weights and all that does not change are made before.
    """
    clock, inputs = time.thread_time_ns, torch.linspace(0.0, 1.0, n_inputs, dtype=torch.float64)
    weights = torch.randn(n_inputs, 5, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) / n_inputs
    row, column = torch.tril_indices(2, 2)
    position, scaled, goal = torch.zeros(3, 2, dtype=torch.float64).unbind()
    phase = torch.ones((), dtype=torch.float64)
    alpha, beta, gamma, step = 25.0, 6.25, 0.7, 1.0 / RATE
    for _ in range(n_ticks):
        before = clock()
        mean = torch.exp(-0.5 * ((phase - inputs) / 0.1).square()) @ weights
        scaled = scaled + step * (alpha * (beta * (goal - position) - scaled) + mean[:2])
        position = position + step * scaled
        phase = phase - step * gamma * phase
        factor = torch.zeros(2, 2, dtype=torch.float64)
        factor[row, column] = mean[2:]
        variance, axes = torch.linalg.eigh(factor @ factor.mT)
        values = (1000.0 - 1e4 * variance.clamp_min(0.0).sqrt()).clamp(50.0, 1000.0)
        stiffness = axes * values @ axes.mT
        damping = axes * (2.0 * (MASS * values).sqrt()) @ axes.mT
        took.append(clock() - before)
    assert bool(torch.isfinite(stiffness).all() and torch.isfinite(damping).all())


def blocks(n_blocks: int, n_ticks: int, *, n_eager: int) -> dict[str, list[int]]:
    """Nanoseconds of each tick of the three; they take turns, the first two must arrive at the same place."""
    controller = RealTimeAdmittance(turning_schedule(), mass=MASS)
    took: dict[str, list[int]] = {"bare": [], "tick": [], "eager": []}
    ways: list[tuple[str, Callable[..., tuple[float, ...]]]] = [("bare", bare), ("tick", controlled)]
    for seed in range(n_blocks):
        block = ticks(seed, n_ticks)
        there = {name: work(controller, block, took[name]) for name, work in ways}
        if not np.allclose(there["tick"], there["bare"], rtol=1e-9, atol=0.0):
            raise RuntimeError(f"the controller and the bare loop part: {there}")
        eager(n_eager, took["eager"])
        ways.reverse()
    return took


def clock_cost(n_readings: int = 20_000) -> float:
    """Nanoseconds that one reading of the clock adds to each of these times."""
    clock, took = time.thread_time_ns, []
    for _ in range(n_readings):
        before = clock()
        took.append(clock() - before)
    return float(np.median(took))


def pose_schedule() -> Schedule:
    """11 s of a tool that circles and turns, 300..900 N/m and 20..60 Nm/rad, with the inertia of an arm that turns."""
    phase = np.arange(1.1 * BLOCK + 1) / RATE
    zero, one = 0.0 * phase, 1.0 + 0.0 * phase
    turn = np.stack([np.cos(phase), -np.sin(phase), zero, np.sin(phase), np.cos(phase), zero, zero, zero, one], axis=1)
    whole = np.zeros((len(phase), 6, 6))
    whole[:, :3, :3] = whole[:, 3:, 3:] = turn.reshape(-1, 3, 3)
    values = np.array([300.0, 600.0, 900.0, 20.0, 40.0, 60.0])
    stiffness = whole * values @ whole.mT
    coupling = 0.3 * np.diag(np.sqrt([5.0 * 0.1, 8.0 * 0.3, 19.0 * 0.9]), 3)
    inertia = np.diag([5.0, 8.0, 19.0, 0.1, 0.3, 0.9]) + coupling + coupling.T
    position = np.stack([0.1 * np.cos(phase), 0.1 * np.sin(phase), 0.01 * phase], axis=1)
    velocity = np.stack([-0.1 * np.sin(phase), 0.1 * np.cos(phase), 0.01 * one, zero, zero, one], axis=1)
    orientation = np.stack([np.cos(0.5 * phase), zero, zero, np.sin(0.5 * phase)], axis=1)
    gains = (0.5 * (stiffness + stiffness.mT),) * 3
    rows = Schedule(phase, position, velocity, *gains, type1=zero, orientation=orientation)
    return rows.with_inertia(whole @ inertia @ whole.mT)


def pose_ticks(n_ticks: int) -> list[int]:
    """Nanoseconds of each tick of a pose under a wrench of some newtons, with one reading of the clock."""
    schedule, draw = pose_schedule(), random.Random(0)
    controller, clock, took = RealTimeAdmittance(schedule), time.thread_time_ns, []
    for block in range(0, n_ticks, BLOCK):
        controller.start(0.0, velocity=schedule.velocity[0])
        for i in range(1, min(BLOCK, n_ticks - block) + 1):
            now = (i + 0.2 * draw.random()) / RATE
            wrench = [draw.gauss(0, 5), draw.gauss(0, 5), draw.gauss(0, 5), draw.random(), draw.random(), draw.random()]
            before = clock()
            controller.tick(now, wrench)
            took.append(clock() - before)
    return took


def memory_kept(n_ticks: int, *, is_pose: bool = False) -> int:
    """Bytes that ticks leave behind."""
    controller = RealTimeAdmittance(pose_schedule() if is_pose else turning_schedule())
    force = (1.0, 2.0, 3.0, 0.1, 0.2, 0.3) if is_pose else (1.0, 2.0)
    controller.start(0.0, at=10.0)  # most ticks are after the end, where a million of them begin to count
    for i in range(1, 4000):
        controller.tick(i / RATE, force)
    gc.collect()
    tracemalloc.start()
    for i in range(4000, 5000):
        controller.tick(i / RATE, force)
    before = tracemalloc.get_traced_memory()[0]
    for i in range(5000, 5000 + n_ticks):
        controller.tick(i / RATE, force)
    kept = tracemalloc.get_traced_memory()[0] - before
    tracemalloc.stop()
    return kept

"""Time of one tick of the real-time controller, against a bare loop that solves the same tick.

``python scripts/benchmarks/tick.py`` prints microseconds of 10^6 ticks and the memory that further ticks keep.
The bare loop looks up the same packed row and does the same exact arithmetic for two axes, in place and for critical
damping only, with floats that are floats already: no checks, no calls, no limits, nothing kept but the state. Both
run in alternating blocks of 10 s, the garbage collector as it is, and must arrive at the same place; each time
includes one reading of the clock.
"""

import gc
import math
import random
import time
import tracemalloc
from collections.abc import Iterable
from types import SimpleNamespace

import numpy as np

from torch_pbd.control import RealTimeAdmittance

N_BLOCKS, BLOCK = 100, 10_000
RATE, MASS = 1000.0, 1.0

Tick = tuple[float, tuple[float, float]]


def turning_schedule() -> SimpleNamespace:
    """10 s of a curve; stiffness 200..1000 N/m, its axes turning at 1 rad/s; critical damping."""
    phase = np.arange(BLOCK + 1) / RATE
    axes = np.moveaxis(np.array([[np.cos(phase), -np.sin(phase)], [np.sin(phase), np.cos(phase)]]), -1, 0)
    eigenvalues = 600.0 + 400.0 * np.stack([np.sin(phase), np.cos(2.0 * phase)], axis=1)
    stiffness, damping = (
        axes * values[:, None, :] @ axes.mT for values in (eigenvalues, 2.0 * np.sqrt(MASS * eigenvalues))
    )
    position, velocity = (
        np.stack([0.1 * phase, np.sin(phase)], axis=1),
        np.stack([0.1 + 0 * phase, np.cos(phase)], axis=1),
    )
    return SimpleNamespace(
        time=phase, position=position, velocity=velocity, stiffness=stiffness, damping=damping, stiffness_limits=None
    )


def ticks(seed: int) -> list[Tick]:
    """Times of a loop that wakes up 0..0.2 ms late, and a force of some newtons."""
    draw = random.Random(seed)
    return [((i + 0.2 * draw.random()) / RATE, (draw.gauss(0, 5), draw.gauss(0, 5))) for i in range(1, BLOCK + 1)]


def controlled(controller: RealTimeAdmittance, block: Iterable[Tick], took: list[int]) -> tuple[float, ...]:
    clock, tick = time.perf_counter_ns, controller.tick
    controller.start(0.0)
    for now, force in block:
        before = clock()
        tick(now, force)
        took.append(clock() - before)
    return controller.position


def bare(controller: RealTimeAdmittance, block: Iterable[Tick], took: list[int]) -> tuple[float, ...]:
    clock, expm1 = time.perf_counter_ns, math.expm1
    table = controller._table
    packed, unpack, size, end = table.packed, table.layout.unpack_from, table.layout.size, table.last
    (x, y), vx, vy, last = unpack(packed, 0)[:2], 0.0, 0.0, 0.0
    for now, (fx, fy) in block:
        before = clock()
        step = now - last
        index = int(last * RATE + 0.5)
        gx, gy, gvx, gvy, _, k1, k2, a1, a2, c, s, _, _ = unpack(packed, (index if index < end else end) * size)
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


def memory_kept(controller: RealTimeAdmittance, n_ticks: int) -> int:
    """Bytes that ticks leave behind."""
    controller.start(0.0)
    for i in range(1, 1000):
        controller.tick(i / RATE, (1.0, 2.0))
    gc.collect()
    tracemalloc.start()
    for i in range(1000, 2000):
        controller.tick(i / RATE, (1.0, 2.0))
    before = tracemalloc.get_traced_memory()[0]
    for i in range(2000, 2000 + n_ticks):
        controller.tick(i / RATE, (1.0, 2.0))
    kept = tracemalloc.get_traced_memory()[0] - before
    tracemalloc.stop()
    return kept


if __name__ == "__main__":
    controller = RealTimeAdmittance(turning_schedule(), mass=MASS)
    took: dict[str, list[int]] = {"bare": [], "tick": []}
    for seed in range(N_BLOCKS):
        block = ticks(seed)
        there = [bare(controller, block, took["bare"]), controlled(controller, block, took["tick"])]
        np.testing.assert_allclose(there[0], there[1], rtol=1e-9)
    quantiles = {name: np.percentile(values, [50.0, 99.9]) / 1000.0 for name, values in took.items()}
    print(f"{N_BLOCKS * BLOCK:,} ticks of 2 axes, in microseconds")
    print(f"{'':14}{'p50':>8}{'p99.9':>8}")
    print("{:14}{:8.2f}{:8.2f}".format("bare loop", *quantiles["bare"]))
    print("{:14}{:8.2f}{:8.2f}".format("tick", *quantiles["tick"]))
    print("{:14}{:8.2f}{:8.2f}".format("ratio", *quantiles["tick"] / quantiles["bare"]))
    print(f"memory kept by 100,000 more ticks: {memory_kept(controller, 100_000)} bytes")

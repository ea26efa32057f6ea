"""Ticks of the real-time controller: time, memory, error of their stiffness; the certificate; and rollouts."""

from time import process_time

import numpy as np
from scipy.linalg import expm

from speed import rollouts
from speed.rows import Findings, Plan, Row
from speed.ticks import BLOCK, blocks, clock_cost, memory_kept, pose_ticks
from torch_pbd import DMPController, HeteroscedasticGPRegressor
from torch_pbd.control import RealTimeAdmittance, Schedule
from torch_pbd.data import make_tunnel_demonstrations


def measure(plan: Plan) -> Findings:
    """Ticks in CPU time of their thread, less what the reading of its clock takes."""
    n_ticks = plan.size(1_000_000, 1000)
    kept = memory_kept(n_ticks)
    rows = [
        *_ticks(plan),
        Row(f"kept by {n_ticks:,} ticks", [float(kept)], "bytes", bar=("<=", 0.0)),
        *_pose_ticks(plan),
        *_stiffness_error(plan),
        *_certificate(plan),
        *rollouts.measure(plan),
    ]
    return Findings("control", rows)


def _ticks(plan: Plan) -> list[Row]:
    n_blocks, n_ticks = plan.size(100, 2), plan.size(BLOCK, 200)
    took = blocks(n_blocks, n_ticks, n_eager=plan.size(50, 20))
    cost = clock_cost()
    seconds = {name: (np.array(values) - cost) * 1e-9 for name, values in took.items()}
    parts = min(n_blocks, 10)

    def quantile(name: str, share: float) -> list[float]:
        return [float(np.quantile(part, share)) for part in np.array_split(seconds[name], parts)]

    worst = float(np.quantile(seconds["tick"], 0.999))
    what = f"a tick, d = 2, of {n_blocks * n_ticks:,}"
    bare = "a bare loop of the same arithmetic"
    return [
        Row(
            f"{what}: median", quantile("tick", 0.5), bar=("<=", 5e-6), note=f"less {cost:.0f} ns of the clock, as all"
        ),
        Row(f"{what}: 99.9th percentile", [worst], bar=("<=", 50e-6)),
        Row(f"{what}: median", quantile("tick", 0.5), other=quantile("bare", 0.5), other_name=bare),
        Row(f"{what}: 99.9th percentile", quantile("tick", 0.999), other=quantile("bare", 0.999), other_name=bare),
        Row(
            f"{what}: median",
            quantile("tick", 0.5),
            other=quantile("eager", 0.5),
            other_name="a tick of eager torch",
            bar=(">=", 40.0),
        ),
    ]


def _pose_ticks(plan: Plan) -> list[Row]:
    n_ticks = plan.size(100_000, 200)
    seconds = (np.array(pose_ticks(n_ticks)) - clock_cost()) * 1e-9
    what = f"a tick of a pose, d = 6, with an inertia, of {n_ticks:,}"
    return [
        Row(f"{what}: median", [float(np.median(seconds))], bar=("<=", 40e-6)),
        Row(f"{what}: 99.9th percentile", [float(np.quantile(seconds, 0.999))]),
        Row(f"{what}: kept", [float(memory_kept(n_ticks, is_pose=True))], "bytes", bar=("<=", 0.0)),
    ]


def _stiffness_error(plan: Plan) -> list[Row]:
    """Of the demo's schedule at 1 kHz, against the model asked at that very time, largest entry of the difference."""
    rate = 1000.0 if not plan.quick else 50.0
    demonstrations = make_tunnel_demonstrations(6, rate=25.0 if not plan.quick else 4.0, random_state=plan.seed)
    controller = DMPController(HeteroscedasticGPRegressor()).fit(demonstrations)
    schedule = controller.schedule(rate)
    table = RealTimeAdmittance(schedule, rate=rate, max_step=10.0 / rate)._table.stiffness[:-1]
    start = controller.start_time_

    def error(after: float) -> list[float]:
        time = start + schedule.time[:-1, np.newaxis] + after / rate
        return [float(np.abs(table - controller.predict_stiffness(time)).max())]

    along = np.linalg.eigvalsh(table)
    note = f"K is {along.min():.0f} to {along.max():.0f} N/m along its axes, and held over a tick"
    return [
        Row("error of K at the table's times, demo", error(0.0), "N/m", bar=("<=", 0.01)),
        Row("error of K half a tick later, demo", error(0.5), "N/m", note=note),
        Row("error of K at the end of a tick, demo", error(1.0), "N/m", note="just before the next row"),
    ]


def _certificate(plan: Plan) -> list[Row]:
    """CPU time of all that is certified of a hand's 27 joints at 1 kHz, whose gains rise, fall and turn."""
    n, rng = plan.size(2701, 50), np.random.default_rng(plan.seed)
    time = np.arange(n) * 1e-3
    skew = rng.normal(size=(27, 27))
    axes = expm(0.3 * np.sin(time)[:, np.newaxis, np.newaxis] * (skew - skew.T))
    share = 0.5 + 0.5 * np.sin(0.5 * time[:, np.newaxis] + rng.uniform(0.0, 6.0, 27))
    stiffness = axes * (50.0 * 20.0**share)[:, np.newaxis] @ axes.swapaxes(1, 2)
    still, type1 = np.zeros((n, 27)), np.zeros(n)
    schedule = Schedule(time, still, still, stiffness, stiffness, stiffness, type1, units="rad").with_inertia(1.0)
    took = []
    for _ in range(plan.n_repetitions + 1):
        start = process_time()
        schedule.certify()
        took.append(process_time() - start)
    return [Row(f"certificate of 27 outputs at {n:,} rows, CPU", took[1:], bar=("<=", 2.0))]

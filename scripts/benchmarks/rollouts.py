"""Simulated plant-steps a second, at 1, 10^3 and 10^5 rollouts, beside the loop that one would write first.

``python scripts/benchmarks/rollouts.py`` prints one table. A plant-step is a tick of 1 ms of one robot of two axes.
``simulate_many`` runs 1001 ticks with pushes over 8 % of them, with quantiles at every tick and at every tenth. The
naive loop asks, for each plant and at each tick, five Gaussian processes of 200 inputs for a mean and a Cholesky
factor, takes the eigenvalues of the covariance for stiffness and damping, and makes an Euler step; it runs as few ticks
as tell its rate. The bare loop is one ``torch.addmm`` of states (R, 4) a tick, without forces and without anything
noted: what the machine gives at that time. One thread, seconds of the processor, medians of alternating repetitions.
"""

import time
from collections.abc import Callable
from statistics import median
from typing import Any

import numpy as np
import torch

from torch_pbd.control import Schedule, StiffnessLaw, damping_from_stiffness, simulate_many

SIZES = (1, 1000, 100_000)
N_TICKS, RATE = 1001, 1000.0
NAIVE_TICKS = {1: 300, 1000: 30, 100_000: 2}
BARE_TICKS = {1: 1000, 1000: 500, 100_000: 20}


def turning_schedule() -> Schedule:
    """1 s of a curve; stiffness 200..1000 N/m, its axes turning at 1 rad/s; critical damping for 1 kg."""
    phase = np.arange(N_TICKS) / RATE
    axes = np.moveaxis(np.array([[np.cos(phase), -np.sin(phase)], [np.sin(phase), np.cos(phase)]]), -1, 0)
    eigenvalues = 600.0 + 400.0 * np.stack([np.sin(phase), np.cos(2.0 * phase)], axis=1)
    gains = (axes * values[:, None] @ axes.mT for values in (eigenvalues, 2.0 * np.sqrt(eigenvalues)))
    stiffness, damping = (0.5 * (gain + gain.mT) for gain in gains)
    position = np.stack([0.1 * phase, np.sin(phase)], axis=1)
    velocity = np.stack([0.1 + 0.0 * phase, np.cos(phase)], axis=1)
    covariance = np.broadcast_to(np.eye(2), stiffness.shape)
    return Schedule(phase, position, velocity, stiffness, damping, covariance, 0.0 * phase, mass=1.0)


class NaiveLoop:
    """What each plant asks for at each of its ticks."""

    def __init__(self) -> None:
        generator = torch.Generator().manual_seed(0)
        self._inputs = torch.linspace(0.0, 1.0, 200, dtype=torch.float64)
        self._weights = 0.1 * torch.randn(200, 5, dtype=torch.float64, generator=generator)
        self._law = StiffnessLaw(200.0, 1000.0, sigma_low=0.01, sigma_high=0.2, bounds="sigma")

    def __call__(self, n_rollouts: int, n_ticks: int) -> None:
        """Run so many ticks of so many plants."""
        position, velocity = torch.zeros(2, n_rollouts, 2, dtype=torch.float64)
        force = torch.ones(n_rollouts, 2, dtype=torch.float64)
        for tick in range(n_ticks):
            phase = torch.full((n_rollouts, 1), tick / n_ticks, dtype=torch.float64)
            means = torch.exp(-50.0 * (phase - self._inputs).square()) @ self._weights
            factor = torch.zeros(n_rollouts, 2, 2, dtype=torch.float64)
            factor[:, [0, 1, 1], [0, 0, 1]] = means[:, :3]
            stiffness = self._law(factor @ factor.mT)
            damping = damping_from_stiffness(stiffness)
            pull = stiffness @ (means[:, 3:] - position).unsqueeze(-1) - damping @ velocity.unsqueeze(-1)
            velocity = velocity + (force + pull.squeeze(-1)) / RATE
            position = position + velocity / RATE


def bare_loop(n_rollouts: int, n_ticks: int) -> None:
    """One product of matrices a tick."""
    transition = torch.eye(4, dtype=torch.float64) * 0.999
    state, drift = torch.ones(2, n_rollouts, 4, dtype=torch.float64)
    for _ in range(n_ticks):
        state = torch.addmm(drift, state, transition)


def measure(n_repetitions: int = 5) -> dict[str, Any]:
    """Millions of plant-steps a second, by contender and number of rollouts, and what follows from them.

    Parameters
    ----------
    n_repetitions : int, default=5
        Of each, of which the median is taken.

    Returns
    -------
    dict
        "rates": {contender: {rollouts: M/s}}; "times_naive": how many times the naive rate; "growth": exponent of the
        time of ``simulate_many`` in the number of rollouts, from 10^3 to 10^5.
    """
    schedule, naive = turning_schedule(), NaiveLoop()

    def simulated(every: int) -> Callable[[int], int]:
        def run(n_rollouts: int) -> int:
            simulate_many(schedule, n_rollouts, duration=0.08, every=every, random_state=0)
            return N_TICKS

        return run

    def naively(n_rollouts: int) -> int:
        naive(n_rollouts, NAIVE_TICKS[n_rollouts])
        return NAIVE_TICKS[n_rollouts]

    def barely(n_rollouts: int) -> int:
        bare_loop(n_rollouts, BARE_TICKS[n_rollouts])
        return BARE_TICKS[n_rollouts]

    contenders = {
        "simulate_many": simulated(1), "simulate_many, every=10": simulated(10), "bare loop": barely, "naive": naively,
    }  # fmt: skip
    n_threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        found = {size: _rates(contenders, size, n_repetitions) for size in SIZES}
    finally:
        torch.set_num_threads(n_threads)
    rates = {name: {size: found[size][name] for size in SIZES} for name in contenders}
    fastest = rates["simulate_many, every=10"]
    return {
        "rates": rates,
        "times_naive": {size: fastest[size] / rates["naive"][size] for size in SIZES},
        "growth": float(1.0 - np.log(fastest[SIZES[2]] / fastest[SIZES[1]]) / np.log(SIZES[2] / SIZES[1])),
    }


def _rates(contenders: dict[str, Callable[[int], int]], n_rollouts: int, n_repetitions: int) -> dict[str, float]:
    took: dict[str, list[float]] = {name: [] for name in contenders}
    for repetition in range(n_repetitions + 1):
        for name, run in contenders.items():
            start = time.process_time()
            n_ticks = run(n_rollouts)
            if repetition:  # the first warms up
                took[name].append((time.process_time() - start) / (n_ticks * n_rollouts))
    return {name: 1e-6 / median(values) for name, values in took.items()}


def report(measured: dict[str, Any]) -> str:
    """Table of what :func:`measure` found."""
    lines = ["M plant-steps/s" + " " * 11 + "".join(f"{size:>12,}" for size in SIZES) + "  rollouts"]
    for name, rates in measured["rates"].items():
        lines.append(f"{name:26}" + "".join(f"{rates[size]:12.4g}" for size in SIZES))
    lines.append(f"{'times the naive loop':26}" + "".join(f"{measured['times_naive'][size]:12.4g}" for size in SIZES))
    lines.append(f"time grows as rollouts^{measured['growth']:.2f} from {SIZES[1]:,} to {SIZES[2]:,}")
    return "\n".join(lines)


if __name__ == "__main__":
    print(report(measure()))

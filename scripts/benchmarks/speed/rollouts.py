"""Simulated plant-steps a second, beside the loop that one would write first and the least a machine can do.

A plant-step is a tick of 1 ms of one robot of two axes. ``simulate_many`` runs 1001 ticks with pushes over 8 % of them,
with quantiles at every tick and at every tenth. The naive loop asks, for each plant and at each tick, five Gaussian
processes of 200 inputs for a mean and a Cholesky factor, takes the eigenvalues of the covariance for stiffness and
damping, and makes an Euler step; it runs as few ticks as tell its rate. The bare loop is one ``torch.addmm`` of states
(R, 4) a tick, without forces and without anything noted: what the machine gives at that time.
"""

from collections.abc import Callable

import numpy as np
import torch

from speed.rows import Bar, Plan, Row
from speed.timing import alternate, median
from torch_pbd.control import Schedule, StiffnessLaw, damping_from_stiffness, simulate_many

N_TICKS, RATE = 1001, 1000.0
BARE_TICKS = 20
NAIVE_TICKS = {1: 300, 1000: 30, 100_000: 2}


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


def pushed(n_rollouts: int, every: int = 10) -> None:
    """Push so many robots, for a second."""
    simulate_many(turning_schedule(), n_rollouts, duration=0.08, every=every, random_state=0)


def measure(plan: Plan) -> list[Row]:
    """Seconds for a plant-step at growing numbers of rollouts."""
    naive, rows = NaiveLoop(), list[Row]()
    sizes = (1, 1000, 100_000) if not plan.quick else (1, 100)
    for size in sizes:
        few = NAIVE_TICKS.get(size, 10)
        contenders: dict[str, Callable[[], object]] = {
            "every tick": lambda n=size: pushed(n, 1),
            "every 10 ticks": lambda n=size: pushed(n, 10),
            "naive": lambda n=size, t=few: naive(n, t),
            "bare": lambda n=size: bare_loop(n, BARE_TICKS),
        }
        times = alternate(contenders, min(3, plan.n_repetitions))
        n_ticks = {"naive": few, "bare": BARE_TICKS}
        steps = {k: [t / (size * n_ticks.get(k, N_TICKS)) for t in values] for k, values in times.items()}
        rate = {name: f"{1e-6 / median(values):.3g}" for name, values in steps.items()}
        what, most = f"a plant-step of {size:,} rollouts", size == sizes[-1] and not plan.quick
        note = f"{rate['every 10 ticks']} million a second; with quantiles at every tick {rate['every tick']}"
        rows.append(Row(what, steps["every 10 ticks"], bar=("<=", 1e-8) if most else None, note=note))
        bar: Bar | None = (">=", 500.0) if most else None
        rows.append(Row(what, steps["every 10 ticks"], other=steps["naive"], other_name="the naive loop", bar=bar))
        rows.append(Row(what, steps["every 10 ticks"], other=steps["bare"], other_name="a bare product of matrices"))
    return rows

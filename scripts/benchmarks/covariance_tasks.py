"""Data for covariance.py: made ones whose law is known, and the recordings of a folder."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torch_pbd.data import load_demonstrations, make_paper_simulation, paper_covariance, paper_mean

Floats = NDArray[np.float64]
Groups = NDArray[np.intp]
Law = Callable[[Floats], tuple[Floats, Floats]]

LOW, HIGH = -100.0, 100.0
MAX_ALIGNED_STEPS = 100
PHASE_STEPS = 50


@dataclass(frozen=True)
class Task:
    """A training set, and the law it was drawn from on a grid."""

    X: Floats
    """(n, e)"""
    y: Floats
    """(n, d)"""
    groups: Groups | None
    """(n,): number of the demonstration; None where rows form none."""
    X_test: Floats
    """(m, e)"""
    mean: Floats
    """(m, d), at ``X_test``."""
    covariance: Floats
    """(m, d, d), at ``X_test``."""


class Recording(NamedTuple):
    """Recorded demonstrations on one grid."""

    name: str
    X: Floats
    y: Floats
    groups: Groups


def eq14(reading: str, xi: Floats) -> tuple[Floats, Floats]:
    """Eq. (14) in one of its readings."""
    return paper_mean(xi), paper_covariance(xi, reading)


def oscillating(xi: Floats) -> tuple[Floats, Floats]:
    """Entries of the factor: L11 = 12 + 8 sin(xi/20), L21 = 8 sin(xi/30), L22 = 9 + 6 cos(xi/25)."""
    x = xi.ravel()
    factor = np.zeros((len(x), 2, 2))
    factor[:, 0, 0] = 12.0 + 8.0 * np.sin(x / 20.0)
    factor[:, 1, 0] = 8.0 * np.sin(x / 30.0)
    factor[:, 1, 1] = 9.0 + 6.0 * np.cos(x / 25.0)
    return paper_mean(xi), factor @ factor.mT


def rotating_tunnel(xi: Floats) -> tuple[Floats, Floats]:
    """Standard deviations 2 + 18 / (1 + exp(xi/8)) and 3 along axes turned by 0.6 sin(xi/40)."""
    x = xi.ravel()
    scales = np.column_stack([2.0 + 18.0 / (1.0 + np.exp(x / 8.0)), np.full(len(x), 3.0)])
    return paper_mean(xi), _turned(0.6 * np.sin(x / 40.0), scales**2)


def plane(x: Floats) -> tuple[Floats, Floats]:
    """Law of two inputs: variances 150 exp(-(x1/50)^2) + 5 and x2 + 150 along axes turned by pi x1/200."""
    first, second = x.T
    mean = np.column_stack([30.0 * np.sin(first / 40.0), 30.0 * np.tanh(second / 40.0)])
    variances = np.column_stack([150.0 * np.exp(-((first / 50.0) ** 2)) + 5.0, second + 150.0])
    return mean, _turned(np.pi * first / 200.0, variances)


def _turned(angle: Floats, variances: Floats) -> Floats:
    cos, sin = np.cos(angle), np.sin(angle)
    axes = np.stack([np.stack([cos, -sin], axis=-1), np.stack([sin, cos], axis=-1)], axis=-2)
    return (axes * variances[:, np.newaxis]) @ axes.mT


def draw(law: Law, X: Floats, random: np.random.Generator) -> Floats:
    """One independent draw a row."""
    mean, covariance = law(X)
    return mean + (np.linalg.cholesky(covariance) @ random.normal(size=(*mean.shape, 1)))[..., 0]


def line() -> Floats:
    """201 inputs from -100 to 100."""
    return np.linspace(LOW, HIGH, 201)[:, np.newaxis]


def aligned(law: Law, seed: int) -> Task:
    """Ten inputs, 50 independent draws at each; demonstration k has the k-th of each input."""
    X = np.tile(np.linspace(LOW, HIGH, 10), 50)[:, np.newaxis]
    y = draw(law, X, np.random.default_rng(seed))
    return Task(X, y, np.repeat(np.arange(50), 10), line(), *law(line()))


def aligned_eq14(reading: str, seed: int) -> Task:
    """The paper's simulation."""
    simulation = make_paper_simulation(reading=reading, random_state=seed)
    return Task(*simulation, line(), *eq14(reading, line()))


def unaligned(law: Law, seed: int) -> Task:
    """500 draws at inputs that never repeat."""
    random = np.random.default_rng(seed)
    X = np.sort(random.uniform(LOW, HIGH, size=(500, 1)), axis=0)
    return Task(X, draw(law, X, random), None, line(), *law(line()))


def two_inputs(seed: int) -> Task:
    """500 draws at inputs uniform over a square."""
    random = np.random.default_rng(seed)
    X = random.uniform(LOW, HIGH, size=(500, 2))
    axis = np.linspace(LOW, HIGH, 31)
    grid = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    return Task(X, draw(plane, X, random), None, grid, *plane(grid))


def smooth(law: Law, length: float, seed: int) -> Task:
    """Six curves mu + L z of 100 steps, z two independent Gaussian processes of that length scale."""
    random = np.random.default_rng(seed)
    xi = np.linspace(LOW, HIGH, 100)[:, np.newaxis]
    mean, covariance = law(xi)
    gram = np.exp(-0.5 * np.square((xi - xi.T) / length)) + 1e-8 * np.eye(len(xi))
    z = np.einsum("ts,ksd->ktd", np.linalg.cholesky(gram), random.normal(size=(6, 100, 2)))
    y = mean + np.einsum("tij,ktj->kti", np.linalg.cholesky(covariance), z)
    return Task(np.tile(xi, (6, 1)), y.reshape(-1, 2), np.repeat(np.arange(6), 100), line(), *law(line()))


_TRUTHS: dict[str, Law] = {
    "printed": partial(eq14, "printed"),
    "oscillating": oscillating,
    "tunnel": rotating_tunnel,
}
TASKS: dict[str, Callable[[int], Task]] = {
    "printed-aligned": partial(aligned_eq14, "printed"),
    "printed-unaligned": partial(unaligned, partial(eq14, "printed")),
    "bell-aligned": partial(aligned_eq14, "bell"),
    "bell-unaligned": partial(unaligned, partial(eq14, "bell")),
    "two-inputs": two_inputs,
    "oscillating-aligned": partial(aligned, oscillating),
    "oscillating-unaligned": partial(unaligned, oscillating),
    "tunnel-aligned": partial(aligned, rotating_tunnel),
    "tunnel-unaligned": partial(unaligned, rotating_tunnel),
    **{f"{name}-smooth-{at}": partial(smooth, law, float(at)) for name, law in _TRUTHS.items() for at in (10, 30, 60)},
}
"""Every made task, by name: maps a seed to the data."""


def load_recordings(folder: str | Path, names: list[str] | None = None) -> list[Recording]:
    """Files of a folder by name: by time where demonstrations are aligned, at most 100 steps; else by phase, 50.

    Parameters
    ----------
    folder : str or Path
    names : list of str, default=None
        Which, without suffix; None for all.

    Raises
    ------
    FileNotFoundError
        If one of ``names`` is not there.
    """
    files = {file.stem: file for file in sorted(Path(folder).glob("*.npz"))}
    missing = [name for name in names or [] if name not in files]
    if missing:
        raise FileNotFoundError(f"{folder} has no {missing[0]}.npz; it has: {', '.join(files) or 'none'}.")
    return [_load(files[name]) for name in files if names is None or name in names]


def _load(file: Path) -> Recording:
    demonstrations = load_demonstrations(file)
    if not demonstrations.is_aligned:
        return Recording(file.stem, *demonstrations.align("phase", n=PHASE_STEPS).stack())
    time, positions = demonstrations.times[0], demonstrations.to_array()
    kept = np.unique(np.linspace(0, len(time) - 1, min(len(time), MAX_ALIGNED_STEPS)).round().astype(int))
    n_demos, groups = len(positions), np.repeat(np.arange(len(positions)), len(kept))
    X = np.tile(time[kept], n_demos)[:, np.newaxis]
    return Recording(file.stem, X, positions[:, kept].reshape(len(X), -1), groups)

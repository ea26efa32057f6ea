"""Random demonstrations of any size, units, type and ill luck, from a short recipe that can be told again."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

INPUTS = ("aligned", "unaligned", "ragged", "ties", "clustered")
"""How inputs repeat: on one grid; never; a grid for each demonstration; integers; within 1e-9 of each other."""
COLUMNS = ("free", "free", "free", "constant", "nearly constant", "copy")
OUTPUTS = ("free", "free", "free", "constant", "nearly constant", "copy", "opposite", "ties", "heavy", "outlier")
GROUPS = ("demonstrations", "none", "random", "singletons", "unbalanced")
DTYPES = ("float64", "float64", "float64", "float32", "float16", "int64", "bool")
LAYOUTS = ("C", "F", "strided", "read-only")
UNITS = (-9, -6, -3, 0, 0, 3, 6, 9)
"""Decimal exponents of the unit of a column."""
OFFSETS = (0.0, 0.0, 0.0, 1.0, 1e3, 1e6)
"""Of a column, in deviations."""


@dataclass(frozen=True)
class Recipe:
    """What demonstrations are made of; :meth:`data` gives the same ones always.

    Parameters
    ----------
    seed : int
        Of all numbers.
    n_demos, n_steps, n_outputs, n_features : int
        K, T, d, e.
    inputs : str
        One of ``INPUTS``.
    columns, outputs : tuple of str
        Kind of each column of X (of ``COLUMNS``), and of y (of ``OUTPUTS``).
    x_units, y_units : tuple of int
        Decimal exponent of each column's unit.
    x_offsets, y_offsets : tuple of float
        Of each column, in its own unit.
    twice : int
        Rows that are there once more.
    dtypes, layouts : tuple of str
        Of X and of y.
    groups : str
        One of ``GROUPS``: which rows are told to be of one demonstration.
    """

    seed: int
    n_demos: int
    n_steps: int
    n_outputs: int
    n_features: int
    inputs: str = "aligned"
    columns: tuple[str, ...] = ("free",)
    outputs: tuple[str, ...] = ("free",)
    x_units: tuple[int, ...] = (0,)
    y_units: tuple[int, ...] = (0,)
    x_offsets: tuple[float, ...] = (0.0,)
    y_offsets: tuple[float, ...] = (0.0,)
    twice: int = 0
    dtypes: tuple[str, str] = ("float64", "float64")
    layouts: tuple[str, str] = ("C", "C")
    groups: str = "none"

    def data(self) -> tuple[NDArray[Any], NDArray[Any], NDArray[np.intp] | None]:
        """X (n, e), y (n, d) and groups (n,), or None."""
        rng = np.random.default_rng(self.seed)
        X, demo = self._inputs(rng)
        y = self._outputs(rng, X, demo)
        X = _columns(rng, X, self.columns)
        if self.twice:
            rows = rng.integers(len(X), size=self.twice)
            X, y, demo = np.vstack([X, X[rows]]), np.vstack([y, y[rows]]), np.append(demo, demo[rows])
        X = _stored(X, self.x_offsets, self.x_units, self.dtypes[0], self.layouts[0])
        y = _stored(y, self.y_offsets, self.y_units, self.dtypes[1], self.layouts[1])
        return X, y, _groups(rng, demo, self.groups)

    def plain(self) -> "Recipe":
        """The same of float64 in units of their own, from their own origin."""
        e, d = self.n_features, self.n_outputs
        return replace(
            self,
            x_units=(0,) * e,
            y_units=(0,) * d,
            x_offsets=(0.0,) * e,
            y_offsets=(0.0,) * d,
            dtypes=("float64", "float64"),
        )

    def _inputs(self, rng: np.random.Generator) -> tuple[Floats, NDArray[np.intp]]:
        size = (self.n_steps, self.n_features)
        demo = np.repeat(np.arange(self.n_demos), self.n_steps)
        if self.inputs == "ragged":
            lengths = rng.integers(1, self.n_steps + 1, size=self.n_demos)
            lengths[0] = self.n_steps
            grids = [np.linspace(-1.0, 1.0, n)[:, None] * rng.uniform(0.9, 1.1, size=size[1]) for n in lengths]
            return np.vstack(grids), np.repeat(np.arange(self.n_demos), lengths)
        grid = rng.uniform(-1.0, 1.0, size=size)
        grid[:, 0] = np.linspace(-1.0, 1.0, self.n_steps)
        X = np.tile(grid, (self.n_demos, 1))
        if self.inputs == "unaligned":
            X = rng.uniform(-1.0, 1.0, size=X.shape)
        elif self.inputs == "ties":
            X = np.round(2.0 * X)
        elif self.inputs == "clustered":
            X = X + 1e-9 * rng.normal(size=X.shape)
        return X, demo

    def _outputs(self, rng: np.random.Generator, X: Floats, demo: NDArray[np.intp]) -> Floats:
        slope, bend = rng.normal(size=(X.shape[1], self.n_outputs)), rng.normal(size=(self.n_outputs, self.n_outputs))
        own = rng.normal(size=(self.n_demos, self.n_outputs))[demo] * 10.0 ** rng.uniform(-3.0, 0.0)
        noise = rng.normal(size=(len(X), self.n_outputs)) * 10.0 ** rng.uniform(-6.0, 0.5, size=self.n_outputs)
        noise = noise + 0.3 * np.sin(2.0 * X[:, :1]) * (noise @ np.tril(bend, -1).T)
        y = np.sin(X @ slope) + own + noise
        for i, kind in enumerate(self.outputs):
            y[:, i] = as_kind(rng, y, i, kind)
        return y


def as_kind(rng: np.random.Generator, y: Floats, i: int, kind: str) -> Floats:
    """Output i of y (n, d), made of that kind."""
    if kind == "constant":
        return np.full(len(y), rng.choice([0.0, 0.5, -3.0]))
    if kind == "nearly constant":
        return np.asarray(0.5 + 1e-12 * rng.normal(size=len(y)))
    if kind in ("copy", "opposite"):
        return y[:, 0] if kind == "copy" else -2.0 * y[:, 0]
    if kind == "ties":
        return np.asarray(np.round(y[:, i]))
    if kind == "heavy":
        return np.asarray(y[:, i] + rng.standard_t(1.5, size=len(y)))
    if kind == "outlier":
        return np.where(np.arange(len(y)) == rng.integers(len(y)), 1e6, y[:, i])
    return y[:, i]


def _columns(rng: np.random.Generator, X: Floats, kinds: tuple[str, ...]) -> Floats:
    X = X.copy()
    for i, kind in enumerate(kinds):
        if kind == "constant":
            X[:, i] = 0.7
        elif kind == "nearly constant":
            X[:, i] = 0.7 + 1e-13 * rng.normal(size=len(X))
        elif kind == "copy" and i:
            X[:, i] = 2.0 * X[:, 0]
    return X


def _stored(
    values: Floats, offsets: tuple[float, ...], units: tuple[int, ...], dtype: str, layout: str
) -> NDArray[Any]:
    """Values in their units, of a type and a layout in memory; what the type cannot hold is cut off."""
    if dtype == "bool":
        stored: NDArray[Any] = values > np.median(values, axis=0)
    elif dtype == "float64":
        stored = (values + np.array(offsets)) * 10.0 ** np.array(units)
    elif dtype == "int64":
        stored = np.clip((values + np.array(offsets)) * 10.0 ** np.abs(units), -1e15, 1e15).astype(np.int64)
    else:  # few digits: no offset, and units whose squares the type holds
        largest = float(np.finfo(dtype).max)
        stored = np.clip(values * 10.0 ** np.clip(units, -2, 2), -largest, largest).astype(dtype)
    if layout == "F":
        stored = np.asfortranarray(stored)
    elif layout == "strided":
        stored = np.repeat(stored, 2, axis=0)[::-2][::-1]
    elif layout == "read-only":
        stored.setflags(write=False)
    return stored


def _groups(rng: np.random.Generator, demo: NDArray[np.intp], kind: str) -> NDArray[np.intp] | None:
    if kind == "none":
        return None
    if kind == "random":
        return rng.integers(1 + len(demo) // 3, size=len(demo))
    if kind == "singletons":
        return np.arange(len(demo))
    return np.minimum(demo, 1) if kind == "unbalanced" else demo


def random_recipe(seed: int, *, most_steps: int = 60, most_outputs: int = 6) -> Recipe:
    """A recipe of everything at once, as probable as it is in what it is drawn from."""
    rng = np.random.default_rng(seed)
    d, e = int(rng.integers(1, most_outputs + 1)), int(rng.integers(1, 4))

    def some(values: Any, n: int) -> tuple[Any, ...]:
        return tuple(values[i] for i in rng.integers(len(values), size=n))

    return Recipe(
        seed,
        n_demos=1 + int(20 * rng.random() ** 2),
        n_steps=2 + int((most_steps - 1) * rng.random() ** 2),
        n_outputs=d,
        n_features=e,
        inputs=some(INPUTS, 1)[0],
        columns=some(COLUMNS, e),
        outputs=some(OUTPUTS, d),
        x_units=some(UNITS, e),
        y_units=some(UNITS, d),
        x_offsets=some(OFFSETS, e),
        y_offsets=some(OFFSETS, d),
        twice=int(rng.integers(0, 4)),
        dtypes=(some(DTYPES[:-1], 1)[0], some(DTYPES, 1)[0]),
        layouts=(some(LAYOUTS, 1)[0], some(LAYOUTS, 1)[0]),
        groups=some(GROUPS, 1)[0],
    )

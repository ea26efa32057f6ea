"""Figures of demonstrations and of what a model learned from them; each takes data and an Axes."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import ArrayLike, NDArray

from torch_pbd import checks
from torch_pbd.control.schedule.schedule import Schedule
from torch_pbd.control.simulation.rollout import Rollout
from torch_pbd.data import Demonstrations
from torch_pbd.estimators.base import CovarianceRegressor

Floats = NDArray[np.float64]

# Okabe and Ito's colours, which colour-blind readers tell apart.
DATA, EMPIRICAL, MODEL, PRIOR, TRUTH = "#999999", "#E69F00", "#0072B2", "#CC79A7", "#009E73"
SERIES = (MODEL, EMPIRICAL, TRUTH, PRIOR, "#56B4E9", "#D55E00", "#000000")
LINES = ("-", "--", ":", "-.")

_N_BARS = 30  # inputs up to which error bars are drawn; of more they would touch, and lines are
_LONGEST_UNIT = 8  # letters; a longer one is a description
_FLAT = 3.0  # ratio of the sides of a plane from which on equal scales would leave a sliver


def figure_grid(n_rows: int, n_columns: int, size: tuple[float, float], **options: Any) -> tuple[Figure, Any]:
    """Figure of ``size`` in inches and its Axes (n_rows, n_columns); pyplot does not know it, so nothing needs closing.

    ``options`` are those of ``Figure.subplots``.
    """
    figure = Figure(figsize=size)
    return figure, figure.subplots(n_rows, n_columns, squeeze=False, **options)


def legend_below(figure: Figure, ax: Axes, n_columns: int = 4) -> None:
    """Draw the legend of one Axes, which holds for all, below the figure."""
    figure.legend(*ax.get_legend_handles_labels(), loc="outside lower center", ncols=n_columns, fontsize=9)


def equal_scales(ax: Axes) -> None:
    """Give both axes of a plane one scale, unless it is so long that nothing would be seen across it."""
    width, height = (abs(high - low) for low, high in (ax.get_xlim(), ax.get_ylim()))
    if width < _FLAT * height and height < _FLAT * width:
        ax.set_aspect("equal", adjustable="datalim")


def readable_unit(unit: str | None) -> tuple[str, float]:
    """Unit of a deviation, and what to multiply it by: metres are shown in millimetres."""
    return ("mm", 1000.0) if unit == "m" else (short_unit(unit), 1.0)


def short_unit(unit: str | None) -> str:
    """Unit for a label or a column; "unit" where there is none, or only a description."""
    return unit if unit and len(unit) <= _LONGEST_UNIT else "unit"


def schedule_names(schedule: Schedule) -> Sequence[str]:
    """Names of the outputs of a schedule."""
    return schedule.names or [f"y{i}" for i in range(schedule.position.shape[1])]


def output_label(demonstrations: Demonstrations, output: int) -> str:
    """Name of an output for an axis, with its unit in brackets if it has one."""
    unit = demonstrations.units[output] if demonstrations.units is not None else "1"
    in_brackets = f" [{unit}]" if 0 < len(unit) <= _LONGEST_UNIT and unit != "1" else ""
    return f"{demonstrations.names[output]}{in_brackets}"


def plot_demonstrations(
    demonstrations: Demonstrations, outputs: Sequence[int], ax: Axes, *, label: str | None = "demonstrations"
) -> list[Line2D]:
    """Draw every demonstration: one output over time, or two outputs against each other.

    Parameters
    ----------
    demonstrations : Demonstrations
    outputs : sequence of one or two int
        Indices of the outputs.
    ax : matplotlib.axes.Axes
    label : str or None, default="demonstrations"
        In the legend, once.

    Returns
    -------
    list of Line2D, one a demonstration
    """
    checks.instance(demonstrations, "demonstrations", Demonstrations)
    outputs = list(outputs) if isinstance(outputs, np.ndarray | range) and np.ndim(outputs) else outputs
    _check_outputs(outputs, demonstrations.n_outputs)
    _check_axes("ax", [ax])
    lines: list[Line2D] = []
    for time, position in demonstrations:
        columns = position[:, list(outputs)].T
        across, up = (time, columns[0]) if len(outputs) == 1 else columns
        lines += ax.plot(across, up, color=DATA, lw=0.7, alpha=0.8, label=None if lines else label, zorder=1)
    unit = demonstrations.time_unit
    labels = ["phase" if unit == "1" else f"time [{unit}]", *(output_label(demonstrations, one) for one in outputs)]
    ax.set(xlabel=labels[-2], ylabel=labels[-1])
    return lines


def plot_std_band(
    x: ArrayLike,
    mean: ArrayLike,
    std: ArrayLike,
    ax: Axes,
    *,
    n_std: float = 2.0,
    color: str = MODEL,
    label: str | None = None,
) -> tuple[Line2D, PolyCollection]:
    """Draw a mean (n,) over x (n,) with a band of ``n_std`` standard deviations (n,) on either side."""
    _check_axes("ax", [ax])
    across, middle, half = (checks.finite(*named).ravel() for named in ((x, "x"), (mean, "mean"), (std, "std")))
    checks.require(half >= 0.0, half, "std", "at least zero", "give standard deviations")
    (line,) = ax.plot(across, middle, color=color, lw=1.5, label=label, zorder=3)
    band = ax.fill_between(
        across, middle - n_std * half, middle + n_std * half, color=color, alpha=0.22, lw=0, zorder=2
    )
    return line, band


def plot_covariance_ellipses(
    mean: ArrayLike,
    covariance: ArrayLike,
    ax: Axes,
    *,
    n_std: float = 2.0,
    color: str = MODEL,
    label: str | None = None,
    linestyle: str = "-",
) -> LineCollection:
    """Draw the ``n_std`` ellipses of covariances (n, 2, 2) around means (n, 2)."""
    _check_axes("ax", [ax])
    centres = checks.array(mean, "mean", ("n", 2))
    matrices = checks.array(covariance, "covariance", (len(centres), 2, 2))
    checks.semidefinite(matrices, "covariance")
    angle = np.linspace(0.0, 2.0 * np.pi, 73)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    values, axes = np.linalg.eigh(matrices)
    roots = axes * np.sqrt(np.clip(values, 0.0, None))[:, np.newaxis, :]
    curves = centres[:, np.newaxis, :] + n_std * (roots @ circle).transpose(0, 2, 1)
    ellipses = LineCollection(list(curves), colors=color, linewidths=1.1, linestyles=linestyle, label=label, zorder=3)
    ax.add_collection(ellipses)
    ax.autoscale_view()
    return ellipses


def plot_model_bands(
    model: CovarianceRegressor,
    X: ArrayLike,
    y: ArrayLike,
    axes: Sequence[Axes],
    *,
    beyond: float = 0.25,
    true_std: Any = None,
) -> None:
    """Draw what a model of one input learned, over the data and beyond their range: one Axes an output.

    The empirical mean and two standard deviations at repeated inputs are drawn beside it.

    Parameters
    ----------
    model : fitted covariance regressor
    X : array-like of shape (n_samples, 1)
    y : array-like of shape (n_samples, n_outputs)
    axes : sequence of n_outputs matplotlib Axes
    beyond : float, default=0.25
        How far to draw on either side, in ranges of X.
    true_std : callable, default=None
        Maps x (n, 1) to (mean, std), both (n, n_outputs), where the truth is known.
    """
    inputs, targets = checks.array(X, "X", ("n", 1)), checks.finite(y, "y")
    targets = targets.reshape(len(inputs), -1)
    _check_axes("axes", axes, targets.shape[1])
    beyond = checks.number(beyond, "beyond", remedy="how far to draw, in ranges of X")
    low, high = inputs.min(), inputs.max()
    query = np.linspace(low - beyond * (high - low), high + beyond * (high - low), 401)[:, np.newaxis]
    mean, covariance = model.predict(query, return_cov=True)
    mean = mean.reshape(len(query), -1)
    std = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    position, empirical_mean, empirical_std = _empirical_bands(inputs[:, 0], targets)
    for output, ax in enumerate(axes):
        plot_std_band(query, mean[:, output], std[:, output], ax, label="model: mean, 2 sd")
        if true_std is not None:
            centre, deviation = true_std(query)
            draw_edges(query[:, 0], centre[:, output], deviation[:, output], ax, "truth: 2 sd", TRUTH)
        if 0 < len(position) <= _N_BARS:
            style: dict[str, Any] = {"fmt": ".", "ms": 4, "capsize": 2, "lw": 1.2, "label": "empirical: mean, 2 sd"}
            middle, half = empirical_mean[:, output], 2.0 * empirical_std[:, output]
            ax.errorbar(position, middle, half, color=EMPIRICAL, zorder=4, **style)
        elif len(position):
            draw_edges(position, empirical_mean[:, output], empirical_std[:, output], ax, "empirical: 2 sd")
        for edge in (low, high):
            ax.axvline(edge, color=DATA, lw=0.8, ls=":", label="end of the data" if edge == low else None)


def draw_edges(x: Floats, mean: Floats, std: Floats, ax: Axes, label: str, color: str = EMPIRICAL) -> None:
    """Draw lines two standard deviations above and below a mean."""
    style = "--" if color == TRUTH else "-"
    lines = ax.plot(x, np.stack([mean + 2.0 * std, mean - 2.0 * std], axis=1), style, color=color, lw=1.0, zorder=2.5)
    lines[0].set_label(label)


def _empirical_bands(position: Floats, targets: Floats) -> tuple[Floats, Floats, Floats]:
    """Mean and standard deviation at the inputs that repeat."""
    distinct, index, counts = np.unique(position, return_inverse=True, return_counts=True)
    means = np.stack([np.bincount(index, column) / counts for column in targets.T], axis=1)
    squares = np.stack([np.bincount(index, column) for column in ((targets - means[index]) ** 2).T], axis=1)
    repeated = counts > 1
    std = np.sqrt(squares[repeated] / (counts[repeated, np.newaxis] - 1))
    return distinct[repeated], means[repeated], std


def plot_stiffness(schedule: Schedule, ax: Axes) -> list[Line2D]:
    """Draw the stiffness of each output over time, the diagonal of the matrix, within its limits.

    Parameters
    ----------
    schedule : Schedule
    ax : matplotlib.axes.Axes

    Returns
    -------
    list of Line2D, one an output
    """
    checks.instance(schedule, "schedule", Schedule)
    _check_axes("ax", [ax])
    lines: list[Line2D] = []
    for output, name in enumerate(schedule_names(schedule)):
        color, dashes = SERIES[output % len(SERIES)], LINES[output // len(SERIES) % len(LINES)]
        gain = schedule.stiffness[:, output, output]
        lines += ax.plot(schedule.time, gain, color=color, ls=dashes, lw=1.5, label=name)
    if schedule.stiffness_limits is not None:
        for limit in schedule.stiffness_limits:
            ax.axhline(limit, color=DATA, lw=0.8, ls=":")
    ax.set_xlabel("time [s]")
    ax.set_ylabel(f"stiffness [N/{short_unit(schedule.units)}]")
    return lines


def plot_pushes(
    rollout: Rollout, schedule: Schedule, output: int, axes: Sequence[Axes], *, unpushed: Rollout | None = None
) -> None:
    """Draw what pushes did to one output: deviation, external force and stiffness over time, the paper's Figure 8.

    Parameters
    ----------
    rollout : Rollout
        One run, as NumPy arrays.
    schedule : Schedule
        That the run followed.
    output : int
    axes : sequence of three matplotlib Axes, one above the other
    unpushed : Rollout, default=None
        The same run without pushes, drawn dashed: how far the robot lags behind by itself.
    """
    checks.instance(rollout, "rollout", Rollout)
    checks.instance(schedule, "schedule", Schedule)
    _check_outputs([output], schedule.n_outputs)
    _check_axes("axes", axes, 3)
    unit, scale = readable_unit(schedule.units)
    name = schedule_names(schedule)[output]
    above, middle, below = axes
    above.plot(rollout.time, scale * rollout.deviation[:, output], color=MODEL, lw=1.5, label="pushed")
    if unpushed is not None:
        above.plot(
            unpushed.time, scale * unpushed.deviation[:, output], "--", color=TRUTH, lw=1.1, label="without pushes"
        )
        above.legend(fontsize=8)
    above.set_ylabel(f"{name} - desired [{unit}]")
    middle.plot(rollout.time, rollout.force[:, output], color=EMPIRICAL, lw=1.5)
    middle.set_ylabel("external force [N]")
    below.plot(rollout.time, rollout.stiffness[:, output, output], color=TRUTH, lw=1.5)
    below.set_ylabel(f"stiffness [N/{short_unit(schedule.units)}]")
    below.set_xlabel("time [s]")
    for ax in axes:
        ax.axhline(0.0, color=DATA, lw=0.8)
        ax.margins(x=0.0)


def _check_outputs(outputs: Any, n_outputs: int) -> None:
    known = isinstance(outputs, Sequence) and all(isinstance(one, int | np.integer) for one in outputs)
    if not known or len(outputs) not in (1, 2) or not all(0 <= one < n_outputs for one in outputs):
        raise ValueError(f"outputs is {outputs!r}, must be one or two numbers from 0 to {n_outputs - 1}.")


def _check_axes(name: str, axes: Any, least: int = 1) -> None:
    known = np.ndim(axes) == 1 and all(hasattr(ax, "plot") for ax in axes)
    if not known or len(axes) < least:
        raise ValueError(f"{name} is {axes!r}, must be {least} matplotlib Axes.")

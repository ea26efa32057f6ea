"""Figures of demonstrations and of what a model learned from them; each takes data and an Axes."""

from collections.abc import Sequence
from numbers import Real
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.lines import Line2D
from numpy.typing import ArrayLike, NDArray

from torch_pbd import checks
from torch_pbd.control.schedule.schedule import Schedule
from torch_pbd.control.simulation.rollout import Rollout
from torch_pbd.data import Demonstrations
from torch_pbd.estimators.base import CovarianceRegressor
from torch_pbd.labels import axis_label, output_label, readable_unit, schedule_names, short_unit

Floats = NDArray[np.float64]

# Okabe and Ito's colours, which colour-blind readers tell apart.
DATA, EMPIRICAL, MODEL, PRIOR, TRUTH = "#999999", "#E69F00", "#0072B2", "#CC79A7", "#009E73"
SERIES = (MODEL, EMPIRICAL, TRUTH, PRIOR, "#56B4E9", "#D55E00", "#000000")
LINES = ("-", "--", ":", "-.")


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
    _check_axes("ax", [ax], 1)
    lines: list[Line2D] = []
    for time, position in demonstrations:
        columns = position[:, list(outputs)].T
        across, up = (time, columns[0]) if len(outputs) == 1 else columns
        lines += ax.plot(across, up, color=DATA, lw=0.7, alpha=0.8, label=None if lines else label, zorder=1)
    if len(outputs) == 1:
        ax.set_xlabel(axis_label("time" if demonstrations.time_unit != "1" else "phase", demonstrations.time_unit))
        ax.set_ylabel(output_label(demonstrations, outputs[0]))
    else:
        ax.set_xlabel(output_label(demonstrations, outputs[0]))
        ax.set_ylabel(output_label(demonstrations, outputs[1]))
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
    _check_axes("ax", [ax], 1)
    across, middle, half = (checks.finite(*named).ravel() for named in ((x, "x"), (mean, "mean"), (std, "std")))
    for name, values in (("mean", middle), ("std", half)):
        if len(values) != len(across):
            raise ValueError(f"{name} has {len(values)} values, must have {len(across)}: one for each of x.")
    if (half < 0.0).any():
        raise ValueError(f"std has a value of {half.min():g}, must not be negative: give standard deviations.")
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
    _check_axes("ax", [ax], 1)
    centres, matrices = checks.finite(mean, "mean"), checks.finite(covariance, "covariance")
    if matrices.ndim != 3 or matrices.shape[1:] != (2, 2) or centres.shape != matrices.shape[:2]:
        shapes = f"covariance has shape {matrices.shape} and mean {centres.shape}"
        raise ValueError(f"{shapes}, must have (n, 2, 2) and (n, 2): take two outputs.")
    scale = np.abs(matrices).max(axis=(1, 2))
    if (np.abs(matrices - matrices.mT).max(axis=(1, 2)) > 1e-8 * scale).any():
        raise ValueError("covariance must be symmetric: symmetrize it.")
    if (np.linalg.eigvalsh(matrices)[:, 0] < -1e-8 * scale).any():
        raise ValueError("covariance must be positive semidefinite: an ellipse has no negative axis.")
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
    if not hasattr(model, "predict_cov"):
        raise ValueError(f"model is {model!r}, must be a fitted covariance regressor.")
    inputs, targets = checks.finite(X, "X"), checks.finite(y, "y")
    if inputs.ndim != 2 or inputs.shape[1] != 1 or not targets.ndim or len(targets) != len(inputs):
        raise ValueError(f"X has shape {inputs.shape} and y {targets.shape}, must have (n, 1) and (n, n_outputs).")
    targets = targets.reshape(len(targets), -1)
    _check_axes("axes", axes, targets.shape[1])
    if not isinstance(beyond, Real) or not checks.is_finite(beyond):
        raise ValueError(f"beyond is {beyond!r}, must be a finite number: how far to draw, in ranges of X.")
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
            for sign in (-2.0, 2.0):
                edge = centre[:, output] + sign * deviation[:, output]
                ax.plot(query, edge, "--", color=TRUTH, lw=1.1, label="truth: 2 sd" if sign > 0 else None, zorder=3)
        if len(position):
            _draw_empirical(position, empirical_mean[:, output], empirical_std[:, output], ax)
        for edge in (low, high):
            ax.axvline(edge, color=DATA, lw=0.8, ls=":", label="end of the data" if edge == low else None)


def _draw_empirical(position: Floats, mean: Floats, std: Floats, ax: Axes) -> None:
    """Error bars at a few inputs, lines at many."""
    if len(position) <= 30:
        ax.errorbar(
            position, mean, 2.0 * std, fmt=".", ms=4, color=EMPIRICAL, capsize=2, lw=1.2, zorder=4,
            label="empirical: mean, 2 sd",
        )  # fmt: skip
        return
    for sign in (-2.0, 2.0):
        ax.plot(
            position,
            mean + sign * std,
            color=EMPIRICAL,
            lw=1.0,
            zorder=4,
            label="empirical: 2 sd" if sign > 0 else None,
        )


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
    _check_axes("ax", [ax], 1)
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


def _check_axes(name: str, axes: Any, least: int) -> None:
    known = np.ndim(axes) == 1 and all(hasattr(ax, "plot") for ax in axes)
    if not known or len(axes) < least:
        raise ValueError(f"{name} is {axes!r}, must be {least} matplotlib Axes.")

"""Parts of figures; each function takes data and the Axes to draw into."""

from collections.abc import Sequence
from itertools import cycle
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.lines import Line2D
from numpy.typing import ArrayLike

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.plotting import style

_N_BARS = 30  # inputs up to which error bars are drawn; of more they would touch, and lines are


def plot_demonstrations(
    demonstrations: Any, outputs: Sequence[int | str], ax: Axes, *, label: str | None = "demonstrations"
) -> list[Line2D]:
    """Draw every demonstration: one output over time, or two or three outputs against each other.

    Parameters
    ----------
    demonstrations : Demonstrations
    outputs : sequence of one to three int or str
        Outputs by number or by name.
    ax : matplotlib.axes.Axes
        Axes to draw into, with projection "3d" for three outputs.
    label : str or None, default="demonstrations"
        Label of all demonstrations in the legend.

    Returns
    -------
    list of Line2D, one per demonstration
    """
    style.check_kind(demonstrations, "demonstrations", "Demonstrations")
    chosen = style.chosen_outputs(outputs, demonstrations.names, 3)
    style.check_axes("ax", [ax])
    if len(chosen) == 3 and not hasattr(ax, "set_zlabel"):
        raise checks.refusal(ax, "ax", "Axes of projection='3d' for three outputs", "or choose outputs=")
    lines: list[Line2D] = []
    for time, position in demonstrations:
        columns = position[:, chosen].T
        drawn = (time, *columns) if len(chosen) == 1 else columns
        lines += ax.plot(*drawn, color=style.DATA, lw=1.0, alpha=0.8, label=None if lines else label, zorder=1)
    labels = [style.time_label(demonstrations.time_unit), *(style.output_label(demonstrations, one) for one in chosen)]
    labels = labels if len(chosen) == 1 else labels[1:]
    ax.set(**dict(zip(("xlabel", "ylabel", "zlabel"), labels, strict=False)))
    return lines


def plot_std_band(
    x: ArrayLike,
    mean: ArrayLike,
    std: ArrayLike,
    ax: Axes,
    *,
    n_std: float = 2.0,
    color: str = style.MODEL,
    label: str | None = None,
) -> tuple[Line2D, PolyCollection]:
    """Draw a mean (n,) over x (n,) with a band of ``n_std`` standard deviations (n,) on either side."""
    style.check_axes("ax", [ax])
    across = checks.array(x, "x", None).ravel()
    middle, half = (checks.array(part, name, (len(across),)) for part, name in ((mean, "mean"), (std, "std")))
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
    color: str = style.MODEL,
    label: str | None = None,
) -> LineCollection:
    """Draw the ``n_std`` ellipses of covariances (n, 2, 2) around means (n, 2); dashed in the colour of the truth."""
    curves, dash = style.ellipses(mean, covariance, ax, n_std, 2)[:, 0], style.dash_of(color)
    drawn = LineCollection(list(curves), colors=color, linewidths=1.1, linestyles=dash, label=label, zorder=3)
    ax.add_collection(drawn)
    ax.autoscale_view()
    return drawn


def plot_model_bands(
    model: Any,
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
        Margin drawn on either side, in ranges of X.
    true_std : callable, default=None
        Map from x (n, 1) to the true (mean, std), both (n, n_outputs).
    """
    inputs, targets = checks.array(X, "X", ("n", 1)), checks.array(y, "y", None)
    targets = targets.reshape(len(inputs), -1)
    style.check_axes("axes", axes, targets.shape[1])
    beyond = checks.number(beyond, "beyond", remedy="how far to draw, in ranges of X")
    low, high = inputs.min(), inputs.max()
    query = np.linspace(low - beyond * (high - low), high + beyond * (high - low), 401)[:, np.newaxis]
    mean, covariance = model.predict(query, return_cov=True)
    mean = mean.reshape(len(query), -1)
    std = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    # The divisor K - 1 is that of the empirical covariances that models are compared with.
    distinct, index, counts = np.unique(inputs[:, 0], return_inverse=True, return_counts=True)
    repeated = counts > 1
    position, divisor = distinct[repeated], counts[repeated] - 1
    for output, ax in enumerate(axes):
        plot_std_band(query, mean[:, output], std[:, output], ax, label="model: mean, 2 sd")
        if true_std is not None:
            centre, deviation = true_std(query)
            draw_edges(query[:, 0], centre[:, output], deviation[:, output], ax, "truth: 2 sd", style.TRUTH)
        average = np.bincount(index, targets[:, output]) / counts
        squares = np.bincount(index, (targets[:, output] - average[index]) ** 2)[repeated]
        middle, half = average[repeated], np.sqrt(squares / divisor)
        if 0 < len(position) <= _N_BARS:
            look: dict[str, Any] = {"fmt": ".", "ms": 4, "capsize": 2, "lw": 1.2, "label": "empirical: mean, 2 sd"}
            ax.errorbar(position, middle, 2.0 * half, color=style.EMPIRICAL, zorder=4, **look)
        elif len(position):
            draw_edges(position, middle, half, ax, "empirical: 2 sd")
        for edge in (low, high):
            ax.axvline(edge, color=style.DATA, lw=0.8, ls=":", label="end of the data" if edge == low else None)


def draw_edges(x: Floats, mean: Floats, std: Floats, ax: Axes, label: str, color: str = style.EMPIRICAL) -> None:
    """Draw lines two standard deviations above and below a mean."""
    edges = np.stack([mean + 2.0 * std, mean - 2.0 * std], axis=1)
    ax.plot(x, edges, style.dash_of(color), color=color, lw=1.0, zorder=2.5)[0].set_label(label)


def plot_stiffness(schedule: Any, ax: Axes, block: slice | None = None) -> list[Line2D]:
    """Draw the stiffness of each output over time, the diagonal of the matrix, within its limits.

    For poses, whose tool turns, it is the stiffness along the principal axes of a block.

    Parameters
    ----------
    schedule : Schedule
    ax : matplotlib.axes.Axes
    block : slice, default=None
        One of ``schedule.blocks``; None is the first, the positions.

    Returns
    -------
    list of Line2D, one an output
    """
    style.check_kind(schedule, "schedule", "Schedule")
    style.check_axes("ax", [ax])
    block = schedule.blocks[0] if block is None else block
    kind, gains, labels, colors = _along_axes(schedule, schedule.stiffness, block)
    # The most precise axis of a pose, which has the first label, is the stiffest.
    gains = gains if len(schedule.blocks) == 1 else gains[:, ::-1]
    lines = plot_outputs(schedule.time, gains, ax, labels, colors)
    limits = [np.broadcast_to(limit, schedule.n_outputs)[block] for limit in schedule.stiffness_limits or ()]
    for i, limit in enumerate(np.unique(limits)):
        ax.axhline(limit, color=style.DATA, lw=0.8, ls=":", label=None if i else "limits of the stiffness")
    ax.set(xlabel="time [s]", ylabel=f"stiffness [{kind.stiffness_unit}]", ylim=(0.0, None))
    return lines


def draw_blocks(schedule: Any, bands: Sequence[Axes]) -> None:
    """Draw the standard deviations of each block of a schedule over time, and then the stiffness of each."""
    n = len(schedule.blocks)
    for block, spread, gains in zip(schedule.blocks, bands[:n], bands[n:], strict=True):
        kind, variance, labels, colors = _along_axes(schedule, schedule.covariance, block)
        plot_outputs(schedule.time, kind.scale * np.sqrt(variance.clip(0.0)), spread, labels, colors)
        spread.set(ylabel=f"1 sd [{kind.unit}]", ylim=(0.0, None))
        plot_stiffness(schedule, gains, block)


def _along_axes(schedule: Any, matrices: Floats, block: slice) -> tuple[style.Kind, Any, list[str], Sequence[str]]:
    """Kind of a block, values (n, k) of matrices (n, d, d) along its axes, and labels and colours of these.

    Axes are the outputs or, for poses, the principal axes, that of the least value first.
    """
    kind, own = style.kind_of(schedule.units, block), matrices[:, block, block]
    if len(schedule.blocks) == 1:
        names = [f"{kind.where} {name}" for name in style.schedule_names(schedule)]
        return kind, np.diagonal(own, axis1=1, axis2=2), names, style.SERIES
    # One name is one dash in both blocks.
    in_space = schedule.position.shape[1] == 3
    others = ["middle axis", "freest axis"] if in_space else [f"axis {i + 2}" for i in range(own.shape[1] - 1)]
    return kind, np.linalg.eigvalsh(own), ["most precise axis", *others], [style.MODEL]


def plot_rollout(
    rollout: Any,
    axes: Sequence[Axes],
    *,
    outputs: Sequence[int | str] | None = None,
    names: Sequence[str] | None = None,
    unpushed: Any = None,
) -> None:
    """Draw what pushes did: deviation, external force and stiffness over time, the paper's Figure 8.

    Parameters
    ----------
    rollout : Rollout
        One run, as NumPy arrays.
    axes : sequence of three matplotlib Axes, one above the other
        Axes to draw into; for poses six, three of positions and then three of rotations.
    outputs : sequence of int or str, default=None
        Outputs to draw, by number or by name; None is the first six.
    names : sequence of str, default=None
        Names of the outputs; None calls them y0, y1, ..., and of poses x, y, z, rx, ry, rz.
    unpushed : Rollout, default=None
        The same run without pushes, drawn thin: how far the robot lags behind by itself.
    """
    style.check_kind(rollout, "rollout", "Rollout")
    if np.ndim(rollout.position) != 2:
        must = "of one run, (n_ticks, n_outputs): take one of the batch"
        raise checks.refusal(tuple(np.shape(rollout.position)), "the shape of the rollout's position", must)
    p, d = rollout.position.shape[-1], rollout.velocity.shape[-1]
    style.check_axes("axes", axes, 3 if p == d else 6)
    names = names or (style.POSE_NAMES if d == p + 3 == 6 else [f"y{i}" for i in range(d)])
    if len(names) != d:
        raise checks.refusal(names, "names", f"{d}, one for each output")
    chosen = style.chosen_outputs(outputs, names, 6)
    for i, block in enumerate((slice(0, p), slice(p, d))[: 1 + (d > p)]):
        kind, (above, middle, below) = style.kind_of(rollout.units, block), axes[3 * i : 3 * i + 3]
        own = [output for output in chosen if (output >= p) == bool(i)]
        labels = [names[output].removeprefix("r") if i else names[output] for output in own]
        along = [f"{kind.where} {label}" for label in labels]
        plot_outputs(rollout.time, kind.scale * rollout.deviation[:, own], above, along)
        if unpushed is not None:
            lines = above.plot(unpushed.time, kind.scale * unpushed.deviation[:, own], color=style.DATA, lw=1.0)
            lines[0].set_label("without pushes")
        above.set_ylabel(f"deviation [{kind.unit}]")
        pushes = [f"{kind.push} {label}" for label in labels]
        plot_outputs(rollout.time, rollout.force[:, own], middle, pushes, [style.FORCE])
        middle.set_ylabel(f"external {kind.push} [{kind.push_unit}]")
        plot_outputs(rollout.time, np.diagonal(rollout.stiffness, axis1=1, axis2=2)[:, own], below, along)
        below.set(xlabel="time [s]", ylabel=f"stiffness [{kind.stiffness_unit}]", ylim=(0.0, None))
        for ax in (above, middle):
            ax.axhline(0.0, color=style.DATA, lw=0.6, zorder=0)


def plot_outputs(
    time: Floats, columns: Floats, ax: Axes, labels: Sequence[str], colors: Sequence[str] = style.SERIES
) -> list[Line2D]:
    """Draw a line for each column (n, d) over time (n,), which differ by their dashes too."""
    lines: list[Line2D] = []
    looks = zip(cycle(style.LINES), cycle(colors), strict=False)
    for column, label, (dash, color) in zip(columns.T, labels, looks, strict=False):
        lines += ax.plot(time, column, dash, color=color, lw=1.5, label=label)
    ax.margins(x=0.0)
    return lines

"""Style of all figures: one colour for one meaning, labels with units, grids and legends."""

from collections.abc import Sequence
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from torch_pbd import checks
from torch_pbd.checks import Floats

# Okabe and Ito's colours, which colour-blind readers tell apart; the truth is drawn dashed too.
DATA, MODEL, EMPIRICAL, FORCE, TRUTH = "#999999", "#0072B2", "#E69F00", "#D55E00", "#000000"
OTHER, ROBOT = "#CC79A7", "#009E73"
"""A second model beside the first; the simulated robot."""
SERIES = (ROBOT, "#332288", "#56B4E9", "#882255", "#999933", "#44AA99", "#661100")
"""Colours of what differs by output only: none of demonstrations, models, forces and the truth."""
LINES = ("-", "--", ":", "-.")

_CIRCLE = np.stack([np.cos(np.linspace(0.0, 2.0 * np.pi, 73)), np.sin(np.linspace(0.0, 2.0 * np.pi, 73))])
_LONGEST_UNIT = 8  # letters; a longer one is a description
_FLAT = 3.0  # ratio of the sides of a plane from which on equal scales would leave a sliver

POSE_NAMES = ("x", "y", "z", "rx", "ry", "rz")


def dash_of(color: str) -> str:
    """Style of a line of this colour: dashed for the truth."""
    return "--" if color == TRUTH else "-"


class Kind(NamedTuple):
    """Outputs that share a unit: words and units of what pushes do to them."""

    outputs: slice
    where: str
    push: str
    push_unit: str
    unit: str
    scale: float  # factor to the unit shown
    stiffness_unit: str


POSITION = Kind(slice(0, 3), "along", "force", "N", "mm", 1e3, "N/m")
ROTATION = Kind(slice(3, 6), "about", "torque", "Nm", "deg", 180.0 / np.pi, "Nm/rad")


def figure_grid(n_rows: int, n_columns: int, size: tuple[float, float], **options: Any) -> tuple[Figure, Any]:
    """Figure of ``size`` in inches that pyplot does not know, so that nothing needs closing, and its Axes."""
    figure = Figure(size)
    return figure, figure.subplots(n_rows, n_columns, squeeze=False, **options)


def shown_figure(size: tuple[float, float]) -> Figure:
    """Figure of ``size`` in inches that pyplot shows: what ``plot()`` draws into where no Axes are given."""
    from matplotlib import pyplot  # chooses a window system: only where one may be wanted

    return pyplot.figure(figsize=size, layout="constrained")


def panels(n_bands: int, n_space: int = 0, make: Any = shown_figure) -> tuple[Figure, list[Any], list[Axes]]:
    """Figure that ``make(size)`` makes, Axes of a path in two or three dimensions, if any, and those of bands.

    Bands stand in a column beside the path, which is as high as all of them, or in a grid of at most three columns.
    """
    if not n_space:
        n_columns = 3 if n_bands > 3 else 1
        n_rows = -(-n_bands // n_columns)
        figure = make((3.4 * n_columns if n_columns > 1 else 6.4, max(3.6, 2.0 * n_rows + 0.6)))
        return figure, [], [figure.add_subplot(n_rows, n_columns, i + 1) for i in range(n_bands)]
    width, ratios = (11.0, (1.25, 1.0)) if n_space == 3 else (9.6, (1.0, 1.3))
    n_columns = 2 if n_bands else 1
    figure = make((width if n_bands else 5.6, max(5.0, 1.7 * n_bands)))
    columns = figure.add_gridspec(max(n_bands, 1), n_columns, width_ratios=ratios[:n_columns])
    path = figure.add_subplot(columns[:, 0], projection="3d" if n_space == 3 else None)
    return figure, [path], [figure.add_subplot(columns[i, 1]) for i in range(n_bands)]


def legend_below(figure: Figure, axes: Axes | Sequence[Axes], n_columns: int = 4) -> None:
    """Draw one legend below the figure: each label of the Axes once."""
    entries: dict[str, Any] = {}
    for ax in np.ravel(np.asarray(axes, dtype=object)):
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    figure.legend(entries.values(), entries, loc="outside lower center", ncols=n_columns, fontsize=9)


def equal_scales(ax: Any) -> None:
    """Give the axes of a plane or a space one scale, unless a plane is so long that nothing would be seen across it."""
    if ax.name == "3d":
        ax.set_box_aspect([abs(high - low) for low, high in (ax.get_xlim(), ax.get_ylim(), ax.get_zlim())], zoom=0.85)
        ax.locator_params(nbins=4)  # more would touch
        return
    width, height = (abs(high - low) for low, high in (ax.get_xlim(), ax.get_ylim()))
    if width < _FLAT * height and height < _FLAT * width:
        ax.set_aspect("equal", adjustable="box")


def mark_ends(ax: Axes, path: Any, *, label: bool = True) -> None:
    """Mark the start of a path (n, 2) or (n, 3) by a circle and its goal by a star."""
    for place, marker, size, name in ((path[0], "o", 6, "start"), (path[-1], "*", 10, "goal")):
        style: dict[str, Any] = {"ms": size, "color": "black", "mfc": "white", "label": name if label else None}
        ax.plot(*np.reshape(place, (-1, 1)), marker, zorder=6, **style)


def short_unit(unit: str | None) -> str:
    """Unit for a label or a column; "unit" where there is none, or only a description."""
    return unit if unit and len(unit) <= _LONGEST_UNIT else "unit"


def schedule_names(schedule: Any) -> Sequence[str]:
    """Names of the outputs of a schedule."""
    return schedule.names or [f"y{i}" for i in range(schedule.n_outputs)]


def kind_of(unit: str | None, block: slice) -> Kind:
    """Words and units of the block of a rotation, or of positions in this unit, of which joints feel torques."""
    if block.start:  # after positions
        return ROTATION
    if unit == "rad":
        return Kind(block, "about", "torque", "Nm", "rad", 1.0, "Nm/rad")
    shown, scale = ("mm", 1000.0) if unit == "m" else (short_unit(unit), 1.0)  # deviations of metres are millimetres
    return Kind(block, "along", "force", "N", shown, scale, f"N/{short_unit(unit)}")


def output_label(demonstrations: Any, output: int) -> str:
    """Name of an output for an axis, with its unit in brackets if it has one."""
    unit = demonstrations.units[output] if demonstrations.units is not None else "1"
    in_brackets = f" [{unit}]" if 0 < len(unit) <= _LONGEST_UNIT and unit != "1" else ""
    return f"{demonstrations.names[output]}{in_brackets}"


def time_label(time_unit: str) -> str:
    """Label of an axis of time, or of phase."""
    return "phase" if time_unit == "1" else f"time [{time_unit}]"


def chosen_outputs(outputs: Any, names: Sequence[str], most: int) -> list[int]:
    """Numbers of one to ``most`` outputs, given by number or by name; None is the first ``most``."""
    if outputs is None:
        return list(range(len(names)))[:most]
    wanted = list(outputs) if isinstance(outputs, Sequence | np.ndarray) and not isinstance(outputs, str) else [outputs]
    found = [list(names).index(one) if isinstance(one, str) and one in names else one for one in wanted]
    known = all(isinstance(one, int | np.integer) and 0 <= one < len(names) for one in found)
    if not known or not 1 <= len(found) <= most:
        raise checks.refusal(outputs, "outputs", f"one to {most} of {', '.join(map(repr, names))}, or their numbers")
    return [int(one) for one in found]


def check_axes(name: str, axes: Any, n_axes: int = 1) -> None:
    """Check that there are as many Axes as will be drawn into."""
    known = np.ndim(axes) == 1 and all(hasattr(ax, "plot") for ax in axes)
    if not known or len(axes) < n_axes:
        raise ValueError(f"{name} is {axes!r}, must be {n_axes} matplotlib Axes.")


def ellipses(mean: Any, covariance: Any, ax: Any, n_std: float, d: int) -> Floats:
    """Ellipses (n, d (d - 1) / 2, m, d) around means (n, d) in the planes of two principal axes of covariances each."""
    check_axes("ax", [ax])
    centres = checks.array(mean, "mean", ("n", d))
    matrices = checks.array(covariance, "covariance", (len(centres), d, d))
    checks.semidefinite(matrices, "covariance")
    return centres[:, np.newaxis, np.newaxis, :] + n_std * unit_ellipses(matrices)


def unit_ellipses(covariance: Floats) -> Floats:
    """Ellipses of one standard deviation around the origin, that of the two widest axes first."""
    values, axes = np.linalg.eigh(covariance)
    # With covariances A diag(v) A' the curves are A sqrt(v) (cos, sin).
    roots = axes * np.sqrt(values.clip(0.0))[:, np.newaxis, :]
    pairs = combinations(range(covariance.shape[-1])[::-1], 2)
    return np.stack([(roots[:, :, pair] @ _CIRCLE).swapaxes(1, 2) for pair in map(list, pairs)], axis=1)


def check_kind(value: Any, name: str, kind: str) -> None:
    """Check that an object is of a class by the name of it: those that draw themselves stand above this floor."""
    if type(value).__name__ != kind:
        raise checks.refusal(value, name, f"a {kind}")

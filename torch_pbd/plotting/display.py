"""Whole figures of learned movements, demonstrations, schedules and simulated runs."""

from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass
from typing import Any, Literal, Self, final

import numpy as np
from matplotlib.axes import Axes

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.plotting import parts, poses, style

Law = tuple[Floats, Floats]
"""Means (n, d) and covariances (n, d, d) over a grid of n times."""

_N_STEPS = 201  # steps of the grid, at which bands and paths look smooth
_N_ELLIPSES = 21  # along a path: more would cover each other
_MOST = 9  # most outputs in a figure, in a grid of 3 x 3
_COLORS = (style.MODEL, style.OTHER)


@final
@dataclass(eq=False, repr=False)
class MovementDisplay:
    """Learned mean and covariance of a movement: bands over time, and ellipses along the path of two outputs.

    Create it by `from_estimator`; `plot` draws it again.

    Parameters
    ----------
    demonstrations : Demonstrations
        Demonstrations, drawn grey in the background.
    grid : ndarray of shape (n,)
        Times or phases.
    laws : dict of str to (ndarray of shape (n, d), ndarray of shape (n, d, d))
        Mean and covariance by the name of the model, one or two; the first is blue.
    truth : (ndarray of shape (n, d), ndarray of shape (n, d, d)), default=None
        True mean and covariance, drawn dashed in black.
    outputs : list of int, default=None
        Outputs to draw; None is the first nine.
    input : {"time", "phase"}, default="time"
    n_std : float, default=2.0
        Half width of bands and ellipses in standard deviations.

    Attributes
    ----------
    figure_ : matplotlib.figure.Figure
    ax_ : matplotlib.axes.Axes
        Axes of the path of two or three outputs, or else of the first band.
    axes_ : list of matplotlib.axes.Axes
        All axes, ``ax_`` first.

    Examples
    --------
    >>> from torch_pbd import GMMBaseline
    >>> from torch_pbd.data import make_handwriting_demonstrations
    >>> from torch_pbd.plotting import MovementDisplay
    >>> strokes = make_handwriting_demonstrations(timing=0.0, rate=25.0, random_state=0)
    >>> display = MovementDisplay.from_estimator(GMMBaseline().fit(*strokes.stack()), strokes)
    >>> [ax.get_ylabel() for ax in display.axes_]
    ['y [m]', 'x [m]', 'y [m]']
    """

    demonstrations: Any
    grid: Floats
    laws: dict[str, Law]
    _: KW_ONLY
    truth: Law | None = None
    outputs: Any = None
    input: Literal["time", "phase"] = "time"
    n_std: float = 2.0

    def __post_init__(self) -> None:
        self.outputs = style.chosen_outputs(self.outputs, self.demonstrations.names, _MOST)
        self.n_std = checks.number(self.n_std, "n_std", above=0.0)

    @classmethod
    def from_estimator(
        cls,
        estimator: Any,
        demonstrations: Any,
        *,
        other: Any = None,
        names: Sequence[str] | None = None,
        truth: Callable[[Floats], Law] | None = None,
        input: Literal["auto", "time", "phase"] = "auto",
        ax: Axes | None = None,
        **options: Any,
    ) -> Self:
        """Plot the learned mean and covariance of a fitted model with its demonstrations.

        Parameters
        ----------
        estimator : fitted covariance regressor, or model of whole movements
            Model over one input, time or phase.
        demonstrations : Demonstrations
        other : fitted covariance regressor, or model of whole movements, default=None
            Second model, drawn on the same axes.
        names : sequence of str, default=None
            Names of the models; None takes those of their classes.
        truth : callable, default=None
            Map from the grid (n,) to the true (mean, covariance).
        input : {"auto", "time", "phase"}, default="auto"
            Input of the fit. "auto" is that of a model of whole movements, and time for others.
        ax : matplotlib.axes.Axes, default=None
            Axes for the path, or for the band of a single output, alone; None makes a figure.
        **options
            ``outputs`` (indices or names) and ``n_std`` of `MovementDisplay`.

        Returns
        -------
        MovementDisplay
        """
        models = [model for model in (estimator, other) if model is not None]
        for model in models:
            if not (hasattr(model, "predict_cov") and hasattr(model, "log_likelihood")):
                remedy = "of a controller take its covariance_"
                raise checks.refusal(model, "estimator", "a covariance regressor or model of movements", remedy)
        style.check_kind(demonstrations, "demonstrations", "Demonstrations")
        names = names or [type(model).__name__ for model in models]
        if len(set(names)) != len(models):
            raise checks.refusal(names, "names", f"{len(models)}, one for each model, and no two alike")
        checks.choice(input, "input", ("auto", "time", "phase"))
        of_model: Any = getattr(estimator, "input_", "time") if input == "auto" else input
        times = demonstrations.stack(of_model)[0]
        grid = np.linspace(times.min(), times.max(), _N_STEPS)
        d = demonstrations.n_outputs
        laws = {}
        for name, model in zip(names, models, strict=True):
            mean, covariance = model.predict(grid[:, np.newaxis], return_cov=True)
            if covariance.shape[-1] != d:
                must = f"with the {covariance.shape[-1]} outputs that {name} has learned, of {d}"
                raise checks.refusal(demonstrations, "demonstrations", must, "take them by select()")
            laws[name] = np.reshape(mean, (-1, d)), covariance
        known = None if truth is None else truth(grid)
        return cls(demonstrations, grid, laws, truth=known, input=of_model, **options).plot(ax)

    def plot(self, ax: Axes | None = None) -> Self:
        """Draw into a new figure, or only the path or the band of a single output into ``ax``."""
        shown, in_space = self.outputs, len(self.outputs) in (2, 3)
        if ax is not None:
            plane, bands = ([ax], []) if in_space else ([], [ax])
        else:
            figure, plane, bands = style.panels(len(shown), len(shown) if in_space else 0)
        for band, output in zip(bands, shown, strict=False):
            self._plot_band(band, output)
        for path in plane:
            self._plot_path(path)
        self.axes_: list[Any] = [*plane, *bands]
        self.ax_ = self.axes_[0]
        self.figure_ = self.ax_.figure
        if ax is None:
            style.legend_below(figure, self.axes_)
        return self

    def _plot_band(self, ax: Axes, output: int) -> None:
        shown = self.demonstrations
        if self.input == "phase" and shown.time_unit != "1":
            shown = shown.align(n=_N_STEPS)
        parts.plot_demonstrations(shown, [output], ax)
        for (name, (mean, covariance)), color in zip(self.laws.items(), _COLORS, strict=False):
            std, label = np.sqrt(covariance[:, output, output]), f"{name}: mean, {self.n_std:g} sd"
            parts.plot_std_band(self.grid, mean[:, output], std, ax, n_std=self.n_std, color=color, label=label)
        if self.truth is not None:
            mean, covariance = self.truth
            std = 0.5 * self.n_std * np.sqrt(covariance[:, output, output])
            parts.draw_edges(self.grid, mean[:, output], std, ax, f"truth: {self.n_std:g} sd", style.TRUTH)
        ax.set_xlabel(style.time_label(shown.time_unit))
        ax.margins(x=0.0)

    def _plot_path(self, ax: Any) -> None:
        shown, laws = self.outputs, list(zip(self.laws.values(), _COLORS, strict=False))
        parts.plot_demonstrations(self.demonstrations, shown, ax)
        for name, ((mean, _), color) in zip(self.laws, laws, strict=False):
            ax.plot(*mean.T[shown], color=color, lw=1.5, label=f"{name}: mean, {self.n_std:g} sd", zorder=3)
        if len(shown) == 2:
            some = np.linspace(0, len(self.grid) - 1, _N_ELLIPSES).round().astype(int)
            for (mean, covariance), color in laws if self.truth is None else [*laws, (self.truth, style.TRUTH)]:
                in_plane = covariance[some][:, shown][:, :, shown]
                parts.plot_covariance_ellipses(mean[some][:, shown], in_plane, ax, n_std=self.n_std, color=color)
        style.mark_ends(ax, laws[0][0][0][:, shown])
        style.equal_scales(ax)


def plot_movements(demonstrations: Any, outputs: Sequence[int | str] | None = None, ax: Axes | None = None) -> Any:
    """Plot demonstrations; implementation of `Demonstrations.plot`."""
    shown = style.chosen_outputs(outputs, demonstrations.names, _MOST)
    if outputs is None and ax is None and demonstrations.rotation_reference is not None and len(shown) == 6:
        return poses.draw_poses(demonstrations, poses.draw_recorded_poses, 3)
    in_space = len(shown) in (2, 3)
    axes: list[Any] = [ax]
    if ax is None:
        figure, plane, bands = style.panels(0, len(shown)) if in_space else style.panels(len(shown))
        axes = plane or bands
    for panel, own in zip(axes, [shown] if in_space else [[output] for output in shown], strict=True):
        parts.plot_demonstrations(demonstrations, own, panel)
        for k, (time, position) in enumerate(demonstrations):
            path = position[:, own]
            style.mark_ends(panel, path if in_space else np.column_stack([time, path]), label=k == 0)
        if in_space:
            style.equal_scales(panel)
    if ax is None:
        style.legend_below(figure, axes)
    return axes[0] if len(axes) == 1 else axes


def plot_schedule(schedule: Any) -> list[Axes]:
    """Plot a schedule; implementation of `Schedule.plot`."""
    p, turns, unit = schedule.position.shape[1], schedule.orientation is not None, style.short_unit(schedule.units)
    if turns and p == 3:
        return poses.draw_poses(schedule, poses.draw_pose_schedule, 4)
    figure, plane, bands = style.panels(2 * len(schedule.blocks) + (p != 2), 2 if p == 2 else 0)
    position = [f"{name} [{unit}]" for name in style.schedule_names(schedule)[:p]]
    # The path of two outputs takes the place of their positions over time.
    if plane:
        path, some = schedule.position, np.linspace(0, len(schedule) - 1, _N_ELLIPSES).round().astype(int)
        plane[0].plot(*path.T, color=style.MODEL, lw=1.5, label="planned: position, 2 sd")
        parts.plot_covariance_ellipses(path[some], schedule.covariance[some, :2, :2], plane[0])
        style.mark_ends(plane[0], path)
        plane[0].set(xlabel=position[0], ylabel=position[1])
        style.equal_scales(plane[0])
    else:
        parts.plot_outputs(schedule.time, schedule.position, bands[0], position)
        bands[0].set_ylabel(f"position [{unit}]")
    parts.draw_blocks(schedule, bands[p != 2 :])
    bands[-2].set_xlabel("")
    style.legend_below(figure, [*plane, *bands[not turns :]])  # names of positions are those of other bands
    return [*plane, *bands]


def plot_pushes(rollout: Any, unpushed: Any = None, names: Sequence[str] | None = None) -> list[Axes]:
    """Plot a simulated run; implementation of `Rollout.plot`."""
    n = 1 + (rollout.velocity.shape[-1] > rollout.position.shape[-1])
    figure = style.shown_figure((6.4 if n == 1 else 11.0, 6.6))
    axes = list(figure.subplots(3, n, sharex=True, squeeze=False).T.flat)
    parts.plot_rollout(rollout.numpy(), axes, names=names, unpushed=None if unpushed is None else unpushed.numpy())
    style.legend_below(figure, axes)
    return axes

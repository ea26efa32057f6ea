"""Sampling of demonstrations: spacing, gaps, stillness, smoothing and resampling."""

from typing import Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline, make_smoothing_spline

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.data.alignment import comparable_scale, dtw_warps, interpolate, times_from_start, unit_phases
from torch_pbd.data.recordings import MIN_SAMPLES
from torch_pbd.data.units import TIMES
from torch_pbd.exceptions import InvalidParameterError
from torch_pbd.files.memory import require_much

Alignment = Literal["phase", "dtw"]

_ROUNDING = 1e-12  # share of a recording's time within which a point of an even grid lies on a sample
_MOST_STEPS = 200  # default limit of align's steps, as dynamic time warping takes time in their square


class Resampling:
    """State and methods of `torch_pbd.data.Demonstrations`; abstract."""

    times: tuple[Floats, ...]
    positions: tuple[Floats, ...]
    names: tuple[str, ...]
    units: tuple[str, ...] | None
    frame: str | None
    time_unit: str
    alignment: Alignment | None
    rotation_reference: Floats | None
    suspects: tuple[str, ...]

    def _replace(self, times: Any, positions: Any, *, anew: bool = False, **changes: Any) -> Self:
        raise NotImplementedError

    def resample(self, n: int, *, max_gap: float | None = None) -> Self:
        """Demonstrations at ``n`` points evenly spaced over each one's own time, by linear interpolation.

        Rotations are interpolated in their chart, which between neighbouring samples is the shortest rotation to second
        order in its angle. Demonstrations that start and end at the same times become aligned.

        Parameters
        ----------
        n : int
            Number of points over the whole time of each demonstration.
        max_gap : float, default=None
            Largest gap between samples, in ``time_unit``, that is interpolated; points in larger gaps are left out, so
            that missing data stay missing. None interpolates all.
        """
        most = np.inf if max_gap is None else checks.number(max_gap, "max_gap", above=0.0, unit=self.time_unit)
        grids = []
        for time in self.times:
            grid = np.linspace(time[0], time[-1], _checked_n(n))
            after = np.searchsorted(time, grid).clip(1, len(time) - 1)
            gap, distance = time[after] - time[after - 1], np.minimum(grid - time[after - 1], time[after] - grid)
            grids.append(grid[(gap <= most) | (distance <= _ROUNDING * (time[-1] - time[0]))])
        return self._replace(grids, list(map(interpolate, self.times, self.positions, grids)))

    def low_pass(self, cutoff: float) -> Self:
        """Low-pass filtered demonstrations at their own times.

        Each is the cubic smoothing spline that halves amplitudes at the cutoff: a second-order Butterworth filter run
        forward and backward, without lag, at even or uneven times. ``DMPController`` smooths its input itself;
        covariance regressors and movement models use recordings with all their noise.

        Parameters
        ----------
        cutoff : float
            Cutoff frequency in Hz, or in cycles per unit of phase. Each demonstration needs five samples.
        """
        each = checks.number(cutoff, "cutoff", above=0.0, unit="Hz") * TIMES.get(self.time_unit, 1.0)
        smooth = []
        for k, (time, position) in enumerate(zip(self.times, self.positions, strict=True)):
            if len(time) < LEAST_SAMPLES:
                has = f"demonstration {k} has {len(time)} samples"
                raise InvalidParameterError(f"{has}, must have {LEAST_SAMPLES} or more: leave it out.")
            own = time - time[0]
            smooth.append(smoothing_spline(own, position, each)(own))
        return self._replace(self.times, smooth)

    def align(self, method: Literal["phase", "dtw"] = "phase", n: int | None = None) -> Self:
        """All demonstrations on one grid of phases, evenly spaced over 0..1; ``time_unit`` becomes "1".

        Parameters
        ----------
        method : {"phase", "dtw"}, default="phase"
            "phase" is linear time normalization. "dtw" then removes differences of timing by dynamic time warping
            (``torch_pbd.data.alignment.dtw_warps``), keeping the ends of each demonstration and the mean timing of all.
            It also removes variation that only resembles timing: use it where shape matters, and not to predict new
            demonstrations, whose timing varies again (measured: 3.7 nats per step worse). Positions are compared in
            their units; if ``units`` differ, in standard deviations over all outputs of a unit.
        n : int, default=None
            Number of phases; None takes the median number of samples, at most 200. "dtw" takes time and memory in
            proportion to its square.
        """
        checks.choice(method, "method", Alignment)
        typical = round(float(np.median(list(map(len, self.times)))))
        grid = np.linspace(0.0, 1.0, _checked_n(min(typical, _MOST_STEPS) if n is None else n))
        units, phases = self.units, unit_phases(self.times)
        if units is None and self.rotation_reference is not None:
            units = (*[""] * (len(self.names) - 3), *["rad"] * 3)
        positions = [interpolate(own, position, grid) for own, position in zip(phases, self.positions, strict=True)]
        if method == "dtw":
            warps = dtw_warps(np.stack(positions) / comparable_scale(np.stack(positions), units))
            positions = list(map(interpolate, phases, self.positions, warps))
        # Timing that was removed stays so, whatever is done to the demonstrations afterwards.
        alignment = "dtw" if "dtw" in (method, self.alignment) else "phase"
        return self._replace(grid, positions, time_unit="1", alignment=alignment)

    def from_start(self) -> Self:
        """Demonstrations with times since each one's start; grids that then agree up to rounding become equal."""
        return self._replace(times_from_start(self.times), self.positions)


def _checked_n(n: int) -> int:
    checks.count(n, "n", least=MIN_SAMPLES)
    require_much(64.0 * n, what=f"n={n} points", remedy="Lower it.")
    return n


# A movement is known up to 2.5 spacings from a sample, as in a dropout of three whose neighbours jitter, and no longer
# at five. Of a finer sampling five count as a 40th of the movement.
KNOWN, LOST = 2.5, 5.0
_FINEST = 200
# Within a pause all outputs stay within this share of their extent in the recording: a hand that waits trembles.
_STILL = 0.02
LEAST_SAMPLES = 5
"""Fewest samples of which there is a smoothing spline."""


def spacing_of(time: Floats) -> float:
    """Spacing of neighbouring samples: the median over samples at least a 400th of the recording apart.

    It is at least a 200th of the recording, so that the shortest gap of denser ones depends on the movement alone.
    """
    lasting = time[-1] - time[0]
    _, first = np.unique(np.floor(2 * _FINEST * ((time - time[0]) / lasting)), return_index=True)
    return max(float(np.median(np.diff(time[first]))), lasting / _FINEST)


def holes_of(time: Floats) -> NDArray[np.intp]:
    """Indices (m,) of the samples before a gap of 7.5 spacings or more, whose middle is unknown."""
    return np.flatnonzero(np.diff(time) > (KNOWN + LOST) * spacing_of(time))


def smoothing_spline(time: Floats, position: Floats, cutoff: float) -> BSpline:
    """Cubic smoothing spline of a recording that halves amplitudes at ``cutoff``, in cycles per unit of its time.

    At even sampling it is a second-order Butterworth filter run forward and backward; times may be uneven.
    """
    # Weights by the spacing make the sum an integral: lam = 1 / w^4 then halves the amplitude at w. In units of
    # the mean spacing and of each output's spread, which keeps the spline's equations well conditioned. A sample
    # beside a hole stands for no more time than others: it would count as free of noise.
    between = np.diff(time)
    between[holes_of(time)] = spacing_of(time)
    spacing = np.gradient(np.r_[0.0, np.cumsum(between)])
    unit = spacing.mean()
    offset = position.mean(axis=0)
    spread = np.ptp(position, axis=0)
    scale = np.where(spread > 0.0, spread, 1.0)
    weight = 1.0 / (2.0 * np.pi * cutoff * unit) ** 4
    smoothed = make_smoothing_spline(time / unit, (position - offset) / scale, spacing / unit, weight)
    return BSpline(smoothed.t * unit, smoothed.c * scale + offset, smoothed.k)


def extents(position: Floats, demonstrations: Any) -> Floats:
    """Extent (d,) of each output in a recording; the three of a rotation share the largest one.

    A tool that turns about one axis trembles about the others, and the choice of axes is arbitrary.
    """
    extent = np.ptp(position, axis=0)
    if demonstrations.rotation_reference is not None:
        extent[-3:] = extent[-3:].max()
    return extent


def still(time: Floats, position: Floats, demonstrations: Any, pause: float) -> NDArray[np.bool_]:
    """Samples (T,) in a stretch of at least ``pause`` in which no output leaves 2 % of its extent."""
    checks.number(pause, "pause", above=0.0)
    # Resampled evenly, as windows count samples, with at least ten samples per pause.
    n = int(min(max(np.ceil(10.0 * (time[-1] - time[0]) / pause), len(time)), 100_000))
    grid = np.linspace(time[0], time[-1], n)
    width, extent = max(2, int(np.ceil(pause / (grid[1] - grid[0]))) + 1), extents(position, demonstrations)
    if width > n or not extent.any():
        return np.zeros(len(time), dtype=bool)
    quiet = np.ones(n - width + 1, dtype=bool)
    for values, whole in zip(position.T, extent, strict=True):
        windows = np.lib.stride_tricks.sliding_window_view(np.interp(grid, time, values), width)
        quiet &= np.ptp(windows, axis=1) <= _STILL * whole
    # A sample is still where any of the windows that hold it is quiet.
    return np.interp(time, grid, np.convolve(quiet, np.ones(width)) > 0.5) > 0.5

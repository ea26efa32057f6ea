"""Demonstrations with other outputs, in other units, cut, resampled, filtered or aligned."""

from collections.abc import Iterable, Sequence
from typing import Any, Literal, Self

import numpy as np

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.data.alignment import comparable_scale, dtw_warps, interpolate, times_from_start, unit_phases
from torch_pbd.data.poses import charted, find_suspects, unwrapped, with_whole_rotation
from torch_pbd.data.recordings import MIN_SAMPLES, as_recordings, as_texts, frozen, preview
from torch_pbd.data.sampling import LEAST_SAMPLES, smoothing_spline, still
from torch_pbd.data.units import ANGLES, LENGTHS, TIMES, check_unit
from torch_pbd.exceptions import InvalidParameterError
from torch_pbd.files.memory import require_much
from torch_pbd.rotations import Chart

Alignment = Literal["phase", "dtw"]

_ROUNDING = 1e-12  # share of a recording's time within which a point of an even grid lies on a sample
_MOST_STEPS = 200  # default limit of align's steps, as dynamic time warping takes time in their square


class Editing:
    """State of `torch_pbd.data.Demonstrations`, and the methods that return changed ones; abstract."""

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
        """Demonstrations of the same class with changes; suspects are looked for ``anew``, without a warning."""
        made = object.__new__(type(self))
        made.__setstate__(vars(self) | changes | {"times": times, "positions": positions})
        if anew:
            vars(made)["suspects"] = find_suspects(made.positions, made.names, made.units)
        return made

    def __setstate__(self, state: dict[str, Any]) -> None:
        # Pickling and copying make NumPy arrays writable again.
        times, positions = as_recordings(state["times"], state["positions"], "raise")
        reference = state["rotation_reference"]
        reference = None if reference is None else frozen(reference)
        vars(self).update(state, times=times, positions=positions, rotation_reference=reference)

    @classmethod
    def concatenate(cls, parts: Iterable[Self]) -> Self:
        """Demonstrations of several sets in order; outputs, units, frame and unit of time must agree.

        Rotations around different references are converted to one chart, around the mean of all.
        """
        sets = [checks.instance(part, f"parts[{i}]", cls) for i, part in enumerate(parts)]
        if not sets:
            raise InvalidParameterError("parts is empty, must have at least one set of demonstrations.")
        for i, part in enumerate(sets):
            for label in ("names", "units", "frame", "time_unit"):
                mine, first = getattr(part, label), getattr(sets[0], label)
                if mine != first:
                    must = f"must be as parts[0], {first}: use .select() or .in_units()"
                    raise InvalidParameterError(f"parts[{i}] has {label} {mine}, {must}.")
        times, positions = ([a for part in sets for a in getattr(part, name)] for name in ("times", "positions"))
        alignment = sets[0].alignment if len({part.alignment for part in sets}) == 1 else None
        reference = sets[0].rotation_reference
        if not all(np.array_equal(part.rotation_reference, reference) for part in sets):
            places, turns = ([a for part in sets for a in part.to_poses()[i]] for i in (0, 1))
            positions, reference = charted(times, places, turns)
        return sets[0]._replace(times, positions, anew=True, alignment=alignment, rotation_reference=reference)

    def to_poses(self) -> tuple[list[Floats], list[Floats]]:
        """Positions (T_k, d - 3) and unit quaternions (T_k, 4), w x y z, where the last three outputs are a rotation.

        Signs of quaternions are continuous along time and between demonstrations.
        """
        if self.rotation_reference is None:
            raise InvalidParameterError("the demonstrations have no rotation: name its columns by rotation=, w x y z.")
        # w >= 0 relative to the reference makes signs continuous.
        turns = [Chart(self.rotation_reference).exp(position[:, -3:]) for position in self.positions]
        return [position[:, :-3] for position in self.positions], turns

    def select(self, outputs: str | Sequence[str]) -> Self:
        """Demonstrations with the selected outputs, in the order given; a rotation is kept whole and last."""
        chosen = as_texts(outputs, "outputs")
        if not 0 < len(chosen) == len(set(chosen) & set(self.names)):
            raise checks.refusal([*chosen], "outputs", f"different ones of {preview(self.names)}")
        chosen, reference = with_whole_rotation(chosen, self.names, self.rotation_reference)
        kept = [self.names.index(name) for name in chosen]
        positions = [position[:, kept] for position in self.positions]
        units = self.units and tuple(self.units[i] for i in kept)
        labels = {"names": chosen, "units": units, "rotation_reference": reference}
        return self._replace(self.times, positions, anew=True, **labels)

    def unwrap(self, angles: str | Sequence[str]) -> Self:
        """Demonstrations with the named angles unwrapped, along time and between demonstrations."""
        positions = unwrapped(self.times, self.positions, self.names, self.units, angles)
        return self._replace(self.times, positions, anew=True)

    def in_units(self, unit: str | Sequence[str] | None = None, time_unit: str | None = None) -> Self:
        """Demonstrations in another unit of length or angle, and of time: h, min, s, ms, us or ns.

        The outputs of the kind of ``unit`` are converted; others, and rotations, stay as they are. Several units, as
        ``["mm", "deg", "ms"]``, may have that of time among them.
        """
        times, positions, units = self.times, self.positions, self.units
        wanted = () if unit is None else as_texts(unit, "unit")
        time_unit = next((one for one in wanted if one in TIMES), None) if time_unit is None else time_unit
        for unit in (one for one in wanted if one not in TIMES):
            check_unit(unit, "unit", LENGTHS | ANGLES)
            before, kind = units or (), LENGTHS if unit in LENGTHS else ANGLES
            n_free = len(self.names) - 3 * (self.rotation_reference is not None)  # a rotation is in rad
            units = tuple(unit if i < n_free and own in kind else own for i, own in enumerate(before))
            if unit not in units[:n_free]:
                must = f"of the kind of one of the outputs, which are in {before or 'no known units (give units=)'}"
                raise checks.refusal(unit, "unit", must)
            here, there = (np.array([kind.get(own, 1.0) for own in each]) for each in (before, units))
            positions = tuple(_convert(position, here, there) for position in positions)
        if time_unit is not None:
            if time_unit not in TIMES or self.time_unit not in TIMES:
                must = f"one of {', '.join(TIMES)}, as that of these demonstrations, {self.time_unit}"
                raise checks.refusal(time_unit, "time_unit", must)
            times = tuple(_convert(time, TIMES[self.time_unit], TIMES[time_unit]) for time in times)
        return self._replace(times, positions, units=units, time_unit=time_unit or self.time_unit)

    def cut(self, at: Literal["pauses"] | Sequence[tuple[float, float]] = "pauses") -> Self:
        """Several demonstrations of one long recording: between its pauses, or the start and end of each.

        ``at`` is "pauses", where all outputs stay within 2 % of their extent for half a second, or pairs (start, end)
        in ``time_unit``. For a column that labels them, `torch_pbd.data.load_demonstrations` has ``demo=``.
        """
        if len(self.times) != 1:
            raise InvalidParameterError(f"there are {len(self.times)} recordings, must be one to be cut, as [:1].")
        time, position = self.times[0], self.positions[0]
        if isinstance(at, str):
            checks.choice(at, "at", ("pauses",))
            moving = ~still(time, position, self)
            edges = np.flatnonzero(np.diff(np.r_[False, moving, False]))
            spans = [(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True) if b - a >= MIN_SAMPLES]
            if not spans:
                raise InvalidParameterError("nothing moves between pauses of half a second: cut at times.")
        else:
            spans = [_span(time, start_end, i) for i, start_end in enumerate(at)]
        return self._replace([time[a:b] for a, b in spans], [position[a:b] for a, b in spans], anew=True)

    def trim(self, method: Literal["still"] = "still") -> Self:
        """Demonstrations without the pauses at their ends, of half a second or more as in :meth:`cut`."""
        checks.choice(method, "method", ("still",))
        times, positions = [], []
        for time, position in zip(self.times, self.positions, strict=True):
            moving = np.flatnonzero(~still(time, position, self))
            # One still sample is kept at each end, where the movement starts and stops.
            span = slice(max(moving[0] - 1, 0), moving[-1] + 2) if len(moving) else slice(None)
            times.append(time[span])
            positions.append(position[span])
        return self._replace(times, positions)

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
        """Low-pass filtered demonstrations, each of five samples or more, at their own times.

        Each is the cubic smoothing spline that halves amplitudes at ``cutoff``, in Hz or in cycles per unit of phase: a
        second-order Butterworth filter run forward and backward, without lag, at even or uneven times.
        ``DMPController`` smooths its input itself; covariance regressors and movement models use recordings with all
        their noise.
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
            Number of phases, in whose square "dtw" takes time and memory; None is the median number of samples, at
            most 200.
        """
        checks.choice(method, "method", Alignment)
        typical = round(float(np.median(list(map(len, self.times)))))
        grid = np.linspace(0.0, 1.0, _checked_n(min(typical, _MOST_STEPS) if n is None else n))
        phases = unit_phases(self.times)
        positions = [interpolate(own, position, grid) for own, position in zip(phases, self.positions, strict=True)]
        if method == "dtw":
            n_turned = 3 * (self.rotation_reference is not None)
            units = self.units or [""] * (len(self.names) - n_turned) + ["rad"] * n_turned
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


def _span(time: Floats, start_end: Any, i: int) -> tuple[int, int]:
    ends = checks.real_floats(start_end, f"at[{i}]")
    if ends.shape != (2,) or not ends[0] < ends[1]:
        raise checks.refusal(start_end, f"at[{i}]", "a start and an end after it, in the unit of the times")
    a, b = np.searchsorted(time, ends[0]), np.searchsorted(time, ends[1], side="right")
    if b - a < MIN_SAMPLES:
        holds = f"at[{i}] holds {b - a} samples between {ends[0]:g} and {ends[1]:g}, must hold {MIN_SAMPLES}"
        raise InvalidParameterError(f"{holds}: the recording goes from {time[0]:g} to {time[-1]:g}.")
    return int(a), int(b)


def _convert(values: Floats, here: Any, there: Any) -> Floats:
    """Values in another unit, by division where the factor is a whole number: 1000 is exact and 0.001 is not."""
    return np.where(here >= there, values * (here / there), values / (there / here))

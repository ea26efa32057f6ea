"""Recordings, learned models, schedules and runs as a file for the Rerun viewer."""

import os
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.colors import to_rgb

from torch_pbd import checks, rotations
from torch_pbd.checks import Floats
from torch_pbd.exceptions import InvalidParameterError
from torch_pbd.plotting.style import DATA, FORCE, MODEL, OTHER, ROBOT, schedule_names
from torch_pbd.registry import optional

_N_ELLIPSOIDS = 21
_FLAT = 1e-3  # of an ellipse's longer half axis: its third one, in a plane
_N_STD = 2.0


def to_rerun(
    path: str | os.PathLike[str],
    *,
    demonstrations: Any = None,
    display: Any = None,
    schedule: Any = None,
    rollout: Any = None,
) -> None:
    """Write a file that the viewer of Rerun (https://rerun.io) opens: ``rerun FILE.rrd``.

    Outputs over time are curves, and of two or three outputs or a pose, paths are lines in space, covariances
    ellipsoids of two standard deviations, tools frames that move with time. What is in m, or without units, shares one
    space; recordings in other units have their own.

    Parameters
    ----------
    path : path-like
        File to write, ending with .rrd; an existing one is replaced.
    demonstrations : Demonstrations, default=None
    display : MovementDisplay, default=None
        Learned models of a movement, drawn as mean and bands.
    schedule : Schedule, default=None
        Schedule, drawn with the eigenvalues of its stiffness per block.
    rollout : Rollout, default=None
        A single run, as ``simulate`` of a controller returns it.

    Raises
    ------
    ValueError
        If nothing is given to write, or the path ends with something else.
    ImportError
        If rerun-sdk is not installed: ``pip install 'torch_pbd[rerun]'``.
    """
    if not os.fspath(path).endswith(".rrd"):
        raise checks.refusal(os.fspath(path), "path", "a file that ends with .rrd")
    if demonstrations is None and display is None and schedule is None and rollout is None:
        raise InvalidParameterError("there is nothing to write: give demonstrations, display, schedule or rollout.")
    rerun = optional("rerun", "rerun", "to_rerun")
    stream = rerun.RecordingStream("torch_pbd")
    stream.save(os.fspath(path))
    writer = _Writer(rerun, stream)
    if demonstrations is not None:
        writer.write_demonstrations(demonstrations)
    if display is not None:
        writer.write_laws(display)
    if schedule is not None:
        writer.write_schedule(schedule)
    if rollout is not None:
        writer.write_rollout(rollout, None if schedule is None else schedule_names(schedule))
    stream.disconnect()  # the file is complete then


class _Writer:
    """Entities of a stream: ``space`` or the like for paths, ``outputs``, ``stiffness``, ``force`` for curves."""

    def __init__(self, rerun: Any, stream: Any) -> None:
        self._rerun, self._stream = rerun, stream

    def write_demonstrations(self, demonstrations: Any) -> None:
        space, n_space = _space(demonstrations)
        for k, (time, position) in enumerate(_in_seconds(demonstrations)):
            self._path(f"{space}/demonstrations/{k}", position, n_space, DATA)
            self._curves("outputs", f"demonstration {k}", time, position, demonstrations.names, DATA)

    def write_laws(self, display: Any) -> None:
        demonstrations, time = display.demonstrations, display.grid
        space, n_space = _space(demonstrations)
        # Seconds of the grid's unit, by the demonstrations: both go from their first sample to their last.
        if display.input == "time":
            time = time * (np.ptp(_in_seconds(demonstrations)[0].time) / np.ptp(demonstrations.times[0]))
        for (name, (mean, covariance)), color in zip(display.laws.items(), (MODEL, OTHER), strict=False):
            self._path(f"{space}/{name}", mean, n_space, color, covariance)
            std = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
            for label, shift in (("", 0.0), (" +2 sd", _N_STD), (" -2 sd", -_N_STD)):
                self._curves("outputs", f"{name}{label}", time, mean + shift * std, demonstrations.names, color)

    def write_schedule(self, schedule: Any) -> None:
        p = schedule.position.shape[1]
        n_space = p if p in (2, 3) and schedule.units in (None, "m") else 0
        covariance = schedule.covariance if schedule.covariance_of == "position" else None
        self._motion("space/schedule", schedule, n_space, MODEL, covariance)
        self._curves("outputs", "schedule", schedule.time, schedule.position, schedule_names(schedule)[:p], MODEL)
        for block, kind in zip(schedule.blocks, ("positions", "rotation"), strict=False):
            eigenvalues = np.linalg.eigvalsh(schedule.stiffness[:, block, block])
            axes = [f"axis {i}" for i in range(eigenvalues.shape[1])]
            self._curves(f"stiffness/{kind}", "", schedule.time, eigenvalues, axes, MODEL)

    def write_rollout(self, rollout: Any, names: Sequence[str] | None) -> None:
        if np.ndim(rollout.position) != 2:
            raise InvalidParameterError(f"rollout is {rollout!r}, must be a single run: take one of the batch.")
        run, p = rollout.numpy(), rollout.position.shape[1]
        names = names or [f"y{i}" for i in range(run.velocity.shape[1])]
        self._motion("space/run", run, p if p in (2, 3) else 0, ROBOT)
        self._curves("outputs", "run", run.time, run.position, names[:p], ROBOT)
        self._curves("force", "", run.time, run.force, names, FORCE)

    def _path(self, entity: str, mean: Floats, n_space: int, color: str, covariance: Floats | None = None) -> None:
        """Path of the first two or three outputs, if they are a point in space, and ellipsoids along it."""
        if not n_space:
            return
        path = np.pad(mean[:, :n_space], ((0, 0), (0, 3 - n_space)))
        self._stream.log(entity, self._rerun.LineStrips3D([path], colors=[to_rgb(color)]), static=True)
        if covariance is None:
            return
        rows = np.linspace(0, len(mean) - 1, min(_N_ELLIPSOIDS, len(mean))).round().astype(int)
        variances, axes = np.linalg.eigh(covariance[rows, :n_space, :n_space])
        half, turned = _N_STD * np.sqrt(variances.clip(0.0)), np.tile(np.eye(3), (len(rows), 1, 1))
        turned[:, :n_space, :n_space] = axes
        turned[:, :, 0] *= np.linalg.det(turned)[:, np.newaxis]  # a reflection is no rotation
        if n_space == 2:
            half = np.column_stack([half, _FLAT * half.max(axis=1)])
        ellipsoids = self._rerun.Ellipsoids3D(
            centers=path[rows],
            half_sizes=half,
            quaternions=np.roll(rotations.from_matrix(turned), -1, axis=1),  # x y z w, as Rerun has them
            colors=[to_rgb(color)],
        )
        self._stream.log(f"{entity}/covariance", ellipsoids, static=True)

    def _motion(self, entity: str, moving: Any, n_space: int, color: str, covariance: Floats | None = None) -> None:
        """Path of a schedule or a run, and its tool, if it turns in space."""
        self._path(entity, moving.position, n_space, color, covariance)
        if n_space == 3 and moving.orientation is not None:
            tool, quaternion = f"{entity}/tool", np.roll(moving.orientation, -1, axis=1)
            columns = self._rerun.Transform3D.columns(translation=moving.position, quaternion=quaternion)
            index = self._rerun.TimeColumn("time", duration=moving.time)
            self._stream.send_columns(tool, indexes=[index], columns=columns)
            extent = float(np.linalg.norm(np.ptp(moving.position, axis=0)))
            self._stream.log(tool, self._rerun.TransformAxes3D(axis_length=0.1 * (extent or 1.0)), static=True)

    def _curves(self, root: str, label: str, time: Floats, values: Floats, names: Sequence[str], color: str) -> None:
        index = self._rerun.TimeColumn("time", duration=time)
        for name, column in zip(names, np.transpose(values), strict=True):
            entity = self._rerun.new_entity_path([part for part in (*root.split("/"), name, label) if part])
            lines = self._rerun.SeriesLines(colors=[to_rgb(color)], names=[label or name])
            self._stream.log(entity, lines, static=True)
            columns = self._rerun.Scalars.columns(scalars=column)
            self._stream.send_columns(entity, indexes=[index], columns=columns)


def _in_seconds(demonstrations: Any) -> Any:
    """Demonstrations in s, or in phase where they are."""
    return demonstrations if demonstrations.time_unit == "1" else demonstrations.in_units(time_unit="s")


def _space(demonstrations: Any) -> tuple[str, int]:
    """Name of the space in their unit, and outputs that are a point there: two or three of a length, no rotation."""
    n = demonstrations.n_outputs - 3 * (demonstrations.rotation_reference is not None)
    units = set((demonstrations.units or ("m",))[:n])
    n_space = n if n in (2, 3) and len(units) < 2 and not units & {"rad", "deg"} else 0
    first = (demonstrations.units or ("m",))[0]
    return "space" if first == "m" else f"space in {first}", n_space

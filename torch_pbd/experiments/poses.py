"""The robotic experiment with a tool that turns: learned poses on the plant of an arm, pushed by force and torque."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np
from matplotlib.figure import Figure
from sklearn.base import clone

from torch_pbd import plotting, rotations
from torch_pbd.checks import Floats
from torch_pbd.console import format_table, steps
from torch_pbd.control.controller import DMPController
from torch_pbd.control.schedule.schedule import Schedule
from torch_pbd.control.simulation.plant import AdmittancePlant
from torch_pbd.control.simulation.rollout import Rollout
from torch_pbd.control.simulation.run import simulate
from torch_pbd.control.stability.report import StabilityReport
from torch_pbd.data import Demonstrations
from torch_pbd.exceptions import ConfigError
from torch_pbd.experiments.robot import PUSHES, pulse
from torch_pbd.experiments.run_folder import RunFolder, fit_once
from torch_pbd.plotting import parts, poses, style

Arm = Literal["panda", "none"]

_TOOL = "xyz"
_figure = partial(Figure, layout="constrained")
_KINDS = (style.POSITION, style.ROTATION)
_ROWS = 50.0  # Hz; along a path the inertia of an arm changes with its joints, within seconds
_N_STEPS = 101


@dataclass(frozen=True)
class PoseRun:
    """One controller on one task of poses: its schedule for the arm, and what pushes in each axis of the tool do."""

    planned: Schedule
    schedule: Schedule
    unpushed: Rollout
    pushes: Mapping[str, list[Rollout]]
    """By "force" and "torque", in each axis."""
    report: StabilityReport

    def along(self, values: Floats, kind: style.Kind) -> Floats:
        """Matrices (n, 6, 6), or vectors (n, 6), in each axis (n, 3) of the tool, in the outputs of a kind."""
        axes = rotations.matrix(np.asarray(self.schedule.orientation))
        if values.ndim == 3:
            return np.einsum("nia,nij,nja->na", axes, values[:, kind.outputs, kind.outputs], axes)
        return np.einsum("nia,ni->na", axes, values[:, kind.outputs])

    def moved(self, kind: style.Kind) -> Floats:
        """Displacement (n, 3) by a push in each axis of the tool, along it, against the run without; in units shown."""
        still = self.unpushed.deviation
        moves = [self.along(run.deviation - still, kind)[:, i] for i, run in enumerate(self.pushes[kind.push])]
        return kind.scale * np.stack(moves, axis=1)


def run_poses(
    controllers: Mapping[str, DMPController],
    demonstrations: Demonstrations,
    folder: RunFolder,
    *,
    peak: float = 12.0,
    torque: float = 1.2,
    rate: float = 1000.0,
    arm: Arm = "panda",
) -> str:
    """Run each controller; writes figures, models, schedules, metrics, reports; returns tables and reports as text."""
    if demonstrations.n_outputs != 6:
        raise ConfigError(f"data: a pose has three positions and a rotation, not the outputs {demonstrations.names}.")
    figure, space, bands = style.panels(3, 3, _figure)
    poses.draw_recorded_poses(demonstrations, space[0], bands)
    plotting.legend_below(figure, space)
    folder.write_figure(figure, "figure6_task")
    rows, reports = [], []
    for name, controller in steps(controllers.items(), "controller", len(controllers)):
        fitted, _ = fit_once(clone(controller), demonstrations, finished=folder.finished)
        run = pushed(fitted, rate, peak, torque, arm)
        rows += [row for kind in _KINDS for row in push_rows(name, run, kind)]
        plain = damping_ratio(run.schedule, run.planned.damping)
        low, high = (f"{fitted.mass_ if np.ndim(fitted.mass_) == 0 else fitted.mass_[i, i]:.3g}" for i in (0, -1))
        mass = f"{low} kg and {high} kg m^2"
        note = f"a damping made for {mass} would have a ratio of {plain:.2f} here" if arm != "none" else f"of {mass}"
        reports.append(f"{name}: a movement of {run.schedule.duration:.3g} s; {note}\n{run.report}")
        folder.write_controller(
            name,
            fitted,
            run.schedule,
            figure7_variability=schedule_figure(run, demonstrations, name),
            figure8_pushes=pushes_figure(run, name),
        )
    folder.write_metrics(rows)
    folder.write_text("stability.txt", "\n\n".join(reports) + "\n")
    return "\n\n".join([*(_table(rows, kind) for kind in _KINDS), *reports])


def _table(rows: Sequence[Mapping[str, Any]], kind: style.Kind) -> str:
    """Table of pushes of one kind."""
    units = {"early": kind.unit, "late": kind.unit, "K early": kind.stiffness_unit, "K late": kind.stiffness_unit}
    names = {key: f"{key} [{unit}]" for key, unit in units.items()} | {"axis": f"{kind.push} {kind.where}"}
    own = [row for row in rows if row["push"] == kind.push]
    hidden = ("push", "unit")  # which stand in the header
    return format_table([{names.get(key, key): row[key] for key in row if key not in hidden} for row in own])


def pushed(controller: DMPController, rate: float, peak: float, torque: float, arm: Arm) -> PoseRun:
    """Plan for the arm, push along and about each axis of the tool, early and late, and certify."""
    planned = controller.schedule(rate)
    schedule = with_panda(planned) if arm == "panda" else planned
    # As torque control of an arm, which feeds its inertia times the acceleration forward.
    run = partial(simulate, schedule, plant=AdmittancePlant(None, feed_forward=True))
    pushes = {
        kind.push: [run(_wrench(schedule, largest, kind, axis)) for axis in range(3)]
        for kind, largest in zip(_KINDS, (peak, torque), strict=True)
    }
    return PoseRun(planned, schedule, run(), pushes, schedule.certify())


def with_panda(schedule: Schedule) -> Schedule:
    """Schedule with the inertia of a Panda along it, and the damping for that."""
    from torch_pbd.robots import HOME, inverse_kinematics, operational_inertia, panda  # here: it needs the extra robot

    arm, few = panda(), schedule.resample(_ROWS)
    joints = inverse_kinematics(arm, few.position, np.asarray(few.orientation), "tool", start=HOME)
    inertia = few.with_inertia(operational_inertia(arm, joints, "tool")).resample(times=schedule.time)
    return schedule.with_inertia(np.asarray(inertia.mass))


def damping_ratio(schedule: Schedule, damping: Floats) -> float:
    """Smallest damping ratio of the modes of ``M e'' + D e' + K e = 0`` over the rows of a schedule."""
    d, mass = schedule.n_outputs, np.asarray(1.0 if schedule.mass is None else schedule.mass)
    mass = mass if mass.ndim else mass * np.eye(d)
    system = np.zeros((len(schedule), 2 * d, 2 * d))
    system[:, :d, d:] = np.eye(d)
    system[:, d:] = -np.linalg.solve(mass, np.concatenate([schedule.stiffness, damping], axis=-1))
    modes = np.linalg.eigvals(system)
    return float((-modes.real / np.abs(modes)).min())


def push_rows(name: str, run: PoseRun, kind: style.Kind) -> list[dict[str, Any]]:
    """Rows of the table: what the early and the late push do in each axis of the tool, and stiffness there."""
    moved, stiffness = np.abs(run.moved(kind)), run.along(run.schedule.stiffness, kind)
    half, (early, late) = len(moved) // 2, stiffness[_push_rows(run.schedule)]
    rows = []
    for axis, letter in enumerate(_TOOL):
        first, second = float(moved[:half, axis].max()), float(moved[half:, axis].max())
        row: dict[str, Any] = {"controller": name, "push": kind.push, "axis": f"tool {letter}", "unit": kind.unit}
        row |= {"early": first, "late": second, "ratio": first / second if second else np.nan}
        rows.append(row | {"K early": float(early[axis]), "K late": float(late[axis])})
    return rows


def _wrench(schedule: Schedule, largest: float, kind: style.Kind, axis: int) -> Floats:
    """Wrenches (n, 6): pulses of a squared sine in an axis that the tool has in their middle."""
    wrench, phase = np.zeros((len(schedule), 6)), (schedule.time - schedule.time[0]) / schedule.duration
    for row in _push_rows(schedule):
        tool = rotations.matrix(np.asarray(schedule.orientation)[row])
        wrench[:, kind.outputs] += largest * np.outer(pulse(phase, phase[row]), tool[:, axis])
    return wrench


def _push_rows(schedule: Schedule) -> list[int]:
    """Rows in the middle of pushes."""
    return [round(centre * (len(schedule) - 1)) for centre in PUSHES]


def schedule_figure(run: PoseRun, demonstrations: Demonstrations, name: str) -> Figure:
    """Planned path, deviations and empirical ones in principal axes, and stiffness there, of both blocks: Figure 7."""
    figure, (space,), bands = style.panels(4, 3, _figure)
    for path in demonstrations.to_poses()[0]:
        space.plot(*path.T, color=plotting.DATA, lw=0.8)
    poses.draw_pose_schedule(run.schedule, space, bands)
    phase, covariances = empirical_covariances(demonstrations)
    for kind, band in zip(_KINDS, bands, strict=False):
        deviation = kind.scale * np.sqrt(np.linalg.eigvalsh(covariances[:, kind.outputs, kind.outputs]).clip(0.0))
        parts.plot_outputs(
            run.schedule.duration * phase, deviation, band, ["empirical", "_", "_"], [plotting.EMPIRICAL]
        )
    bands[0].set_title(name, fontsize=10)
    plotting.legend_below(figure, [space, *bands])
    return figure


def empirical_covariances(demonstrations: Demonstrations) -> tuple[Floats, Floats]:
    """Phases (n,) and covariances (n, 6, 6) of recorded poses there, at their mean, in world axes."""
    aligned = demonstrations.align(n=_N_STEPS)
    places, turns = map(np.array, aligned.to_poses())
    means = np.stack([rotations.mean(turns[:, i]) for i in range(_N_STEPS)])
    deviations = np.concatenate([places - places.mean(axis=0), rotations.between(means, turns)], axis=-1)
    return aligned.times[0], np.einsum("kni,knj->nij", deviations, deviations) / (len(demonstrations) - 1)


def pushes_figure(run: PoseRun, name: str) -> Figure:
    """Deviation, push and stiffness in each axis of the tool over time, of forces and of torques: Figure 8."""
    figure, grid = style.figure_grid(3, 2, (9.6, 6.6), sharex=True)
    time, labels = run.schedule.time, [f"tool {letter}" for letter in _TOOL]
    for kind, (above, middle, below) in zip(_KINDS, grid.T, strict=True):
        parts.plot_outputs(time, run.moved(kind), above, labels)
        above.set_ylabel(f"moved [{kind.unit}]")
        size = np.linalg.norm(run.pushes[kind.push][0].force, axis=1)
        middle.plot(time, size, color=plotting.FORCE, lw=1.5, label="push")
        middle.set_ylabel(f"{kind.push} [{kind.push_unit}]")
        parts.plot_outputs(time, run.along(run.schedule.stiffness, kind), below, labels)
        below.set(xlabel="time [s]", ylabel=f"stiffness [{kind.stiffness_unit}]", ylim=(0.0, None))
        above.set_title(f"{name}: pushed {kind.where} each axis", fontsize=10)
    plotting.legend_below(figure, grid[:, 0])
    return figure

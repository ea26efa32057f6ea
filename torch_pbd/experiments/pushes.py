"""Response of a learned robot to early and late pushes, along its first output or in each axis of a tool."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np

from torch_pbd import rotations
from torch_pbd.checks import Floats
from torch_pbd.control.controller import DMPController
from torch_pbd.control.filters import admittance_rate
from torch_pbd.control.schedule.schedule import Schedule
from torch_pbd.control.simulation.plant import AdmittancePlant
from torch_pbd.control.simulation.rollout import Rollout
from torch_pbd.control.simulation.run import simulate
from torch_pbd.control.stability.report import StabilityReport
from torch_pbd.plotting import style

Arm = Literal["panda", "none"]
KINDS = (style.POSITION, style.ROTATION)
TOOL = "xyz"

_PUSHES = (0.2, 0.8)  # onsets of pushes as shares of the duration: 2 s and 8 s of the paper's 10 s
_LENGTH = 0.08  # length of a push as a share of the duration: 0.8 s of 10 s
_ROWS = 50.0  # Hz; along a path the inertia of an arm changes with its joints, within seconds


@dataclass(frozen=True)
class Run:
    """One controller on one task: what it plans, what pushes do to it, and what is guaranteed."""

    controller: DMPController
    planned: Schedule
    schedule: Schedule  # the planned one, or the same with the inertia of an arm
    unpushed: Rollout
    # By kind: "force" along the first output, or for poses "force" and "torque" in each axis of the tool.
    pushes: Mapping[str, list[Rollout]]
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


def push(
    controller: DMPController, *, peak: float = 5.0, torque: float = 1.2, rate: float = 1000.0, arm: Arm = "none"
) -> Run:
    """Plan, push early and late, and certify; ``peak`` in N, ``torque`` in Nm, the arm's inertia for poses only."""
    planned = controller.schedule(rate)
    is_pose = planned.orientation is not None
    schedule = with_panda(planned) if is_pose and arm == "panda" else planned
    # As torque control of an arm, which feeds its inertia times the acceleration forward, or as an admittance.
    run = partial(simulate, schedule, plant=AdmittancePlant(None, feed_forward=is_pose))
    forces = {"force": [push_profile(planned.time, controller.duration_, peak, controller.n_outputs_)]}
    if is_pose:
        largest = zip(KINDS, (peak, torque), strict=True)
        forces = {kind.push: [_wrench(schedule, most, kind, axis) for axis in range(3)] for kind, most in largest}
    pushes = {push: [run(force) for force in each] for push, each in forces.items()}
    return Run(controller, planned, schedule, run(), pushes, schedule.certify())


def push_profile(time: Floats, duration: float, peak: float, n_outputs: int) -> Floats:
    """Forces (n, d) in N: pulses of a squared sine along the first output, early and late in the movement."""
    force = np.zeros((len(time), n_outputs))
    force[:, 0] = peak * sum(_pulse(time / duration, centre) for centre in _PUSHES)
    return force


def _wrench(schedule: Schedule, largest: float, kind: style.Kind, axis: int) -> Floats:
    """Wrenches (n, 6): pulses of a squared sine in an axis that the tool has in their middle."""
    wrench, phase = np.zeros((len(schedule), 6)), (schedule.time - schedule.time[0]) / schedule.duration
    for row in _middles(schedule):
        tool = rotations.matrix(np.asarray(schedule.orientation)[row])
        wrench[:, kind.outputs] += largest * np.outer(_pulse(phase, phase[row]), tool[:, axis])
    return wrench


def _middles(schedule: Schedule) -> list[int]:
    """Rows nearest to the middle of pushes."""
    time = schedule.time - schedule.time[0]
    return [int(np.abs(time - centre * schedule.duration).argmin()) for centre in _PUSHES]


def _pulse(phase: Floats, centre: float) -> Floats:
    """Squared sine (n,) of height 1 around a phase: at the ends of a push it has neither force nor slope."""
    return np.sin(np.pi * np.clip((phase - centre) / _LENGTH + 0.5, 0.0, 1.0)) ** 2


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
    modes = np.linalg.eigvals(admittance_rate(schedule.stiffness, damping, mass)[:, : 2 * d, : 2 * d])
    return float((-modes.real / np.abs(modes)).min())


def push_row(name: str, run: Run) -> dict[str, Any]:
    """Row of the table: displacement by the two pushes, against the run without them, and stiffness there."""
    kind = style.kind_of(run.schedule.units, run.schedule.blocks[0])
    early, late = run.schedule.stiffness[_middles(run.schedule)]
    # Against the run without pushes: how far the robot lags behind by itself does not count.
    first, second, ratio = _largest(kind.scale * (run.pushes["force"][0].position - run.unpushed.position)[:, 0])
    row = {"controller": name, f"early [{kind.unit}]": first, f"late [{kind.unit}]": second, "ratio": ratio}
    for output, label in list(enumerate(style.schedule_names(run.schedule)))[:2]:
        row |= {f"K {label} early": float(early[output, output]), f"K {label} late": float(late[output, output])}
    error = run.controller.outputs_.si * run.controller.reproduction_error_
    return row | {f"path error [{kind.unit}]": kind.scale * error}


def guarantees(run: Run) -> dict[str, Any]:
    """Columns on stability, beside those of a row."""
    report, schedule = run.report, run.schedule
    rates = np.diff(schedule.stiffness, axis=0) / np.diff(schedule.time)[:, np.newaxis, np.newaxis]
    return {
        "stable": "yes" if report.stable else "NO",
        "margin": report.margin,
        "max speed": report.max_speed,
        "gain": report.gain,
        "environment": report.environment_stiffness,
        "max |dK/dt|": float(np.linalg.norm(rates, ord=2, axis=(1, 2)).max()),
    }


def push_rows(name: str, run: Run, kind: style.Kind) -> list[dict[str, Any]]:
    """Rows of the table of poses: what pushes do in each axis of the tool, and stiffness there."""
    early, late = run.along(run.schedule.stiffness, kind)[_middles(run.schedule)]
    rows = []
    for axis, moved in enumerate(run.moved(kind).T):
        row: dict[str, Any] = {"controller": name, "push": kind.push, "axis": f"tool {TOOL[axis]}", "unit": kind.unit}
        row |= zip(("early", "late", "ratio"), _largest(moved), strict=True)
        rows.append(row | {"K early": float(early[axis]), "K late": float(late[axis])})
    return rows


def _largest(moved: Floats) -> tuple[float, float, float]:
    """Largest of displacements (n,) in the first half of the movement and in the second, and their ratio."""
    half = len(moved) // 2
    first, second = (float(np.abs(part).max()) for part in (moved[:half], moved[half:]))
    return first, second, first / second if second else np.nan

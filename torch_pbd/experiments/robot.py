"""The robotic experiment of Section V: learn, reproduce, push twice (Figures 5 to 8), on any demonstrations."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray
from sklearn.base import clone

from torch_pbd.control.controller import DMPController
from torch_pbd.control.primitive.units import in_metres
from torch_pbd.control.schedule.schedule import Schedule
from torch_pbd.control.simulation.rollout import Rollout
from torch_pbd.control.stability.report import StabilityReport
from torch_pbd.data import Demonstrations
from torch_pbd.experiments.resume import FinishedFits, fit_once
from torch_pbd.experiments.robot_figures import pushes_figure, task_figure, variability_figure
from torch_pbd.experiments.run_folder import RunFolder, check_names, format_table, slug
from torch_pbd.labels import readable_unit, schedule_names

_IN_REPORT = ("margin", "max speed", "gain", "environment")
Floats = NDArray[np.float64]

_PUSHES = (0.2, 0.8)  # of the duration: 2 s and 8 s of the paper's 10 s
_PUSH_LENGTH = 0.08


@dataclass(frozen=True)
class Run:
    """One controller on one task: what it plans, what pushes do to it, and what is guaranteed."""

    controller: DMPController
    schedule: Schedule
    rollout: Rollout
    unpushed: Rollout
    report: StabilityReport


def push_profile(time: Floats, duration: float, peak: float, n_outputs: int) -> Floats:
    """Forces (n, d) in N: pulses of a squared sine along the first output, early and late in the movement."""
    force = np.zeros((len(time), n_outputs))
    for centre in _PUSHES:
        u = np.clip((time / duration - centre) / _PUSH_LENGTH + 0.5, 0.0, 1.0)
        force[:, 0] += peak * np.sin(np.pi * u) ** 2
    return force


def run_controller(
    controller: DMPController,
    demonstrations: Demonstrations,
    *,
    peak: float = 5.0,
    rate: float = 1000.0,
    finished: FinishedFits | None = None,
) -> Run:
    """Fit, or take from the finished fits; plan, push and certify."""
    fitted, _ = fit_once(clone(controller), demonstrations, finished=finished)
    schedule = fitted.schedule(rate)
    force = push_profile(schedule.time, fitted.duration_, peak, fitted.n_outputs_)
    rollout = fitted.simulate(force=force, rate=rate)
    return Run(fitted, schedule, rollout, fitted.simulate(rate=rate), schedule.certify(mass=fitted.mass))


def push_row(name: str, run: Run) -> dict[str, Any]:
    """Row of the table: displacement by the two pushes, against the run without them, and stiffness there."""
    unit, scale = readable_unit(run.schedule.units)
    time, stiffness = run.schedule.time, run.schedule.stiffness
    early, late = (int(np.searchsorted(time, centre * run.controller.duration_)) for centre in _PUSHES)
    deviation = np.abs(run.rollout.position - run.unpushed.position)[:, 0]
    half = len(time) // 2
    first, second = scale * deviation[:half].max(), scale * deviation[half:].max()
    names = schedule_names(run.schedule)
    row = {"controller": name, f"early [{unit}]": float(first), f"late [{unit}]": float(second)}
    row |= {"ratio": float(first / second)}
    for output, label in list(enumerate(names))[:2]:
        row |= {f"K {label} early": float(stiffness[early, output, output])}
        row |= {f"K {label} late": float(stiffness[late, output, output])}
    row |= {f"path error [{unit}]": scale * in_metres(run.controller.units_) * run.controller.reproduction_error_}
    return row


def _guarantees(run: Run) -> dict[str, Any]:
    """Columns of what is guaranteed."""
    report, rates = run.report, np.diff(run.schedule.stiffness, axis=0) / np.diff(run.schedule.time)[:, None, None]
    return {
        "stable": "yes" if report.stable else "NO",
        "margin": report.margin,
        "max speed": report.max_speed,
        "gain": report.gain,
        "environment": report.environment_stiffness,
        "max |dK/dt|": float(np.linalg.norm(rates, ord=2, axis=(1, 2)).max()),
    }


def run_robot(
    controllers: Mapping[str, DMPController],
    demonstrations: Demonstrations,
    folder: RunFolder,
    *,
    peak: float = 5.0,
    rate: float = 1000.0,
    in_tunnel: bool = False,
    metrics: str = "metrics",
) -> str:
    """Run each controller; writes figures, models, schedules, metrics, reports; returns table and reports as text."""
    check_names(controllers, "controllers")
    rows, reports = [], []
    for name, controller in controllers.items():
        run = run_controller(controller, demonstrations, peak=peak, rate=rate, finished=folder.finished)
        rows.append(push_row(name, run) | _guarantees(run))
        reports.append(f"{name}: a movement of {run.schedule.duration:.3g} s\n{run.report}")
        _write(run, name, demonstrations, folder, in_tunnel=in_tunnel)
    folder.write_metrics(rows, metrics)
    folder.write_text("stability.txt", "\n\n".join(reports) + "\n")
    shown = [{key: value for key, value in row.items() if key not in _IN_REPORT} for row in rows]
    return "\n\n".join([format_table(shown), *reports])


def _write(run: Run, name: str, demonstrations: Demonstrations, folder: RunFolder, *, in_tunnel: bool) -> None:
    figures = {
        "figure6_task": task_figure(run.controller, demonstrations, name, in_tunnel=in_tunnel),
        "figure7_variability": variability_figure(run.controller, demonstrations, name),
        "figure8_pushes": pushes_figure(run.rollout, run.unpushed, run.schedule, name),
    }
    for title, figure in figures.items():
        folder.write_figure(figure, f"{slug(name)}_{title}")
        plt.close(figure)
    folder.write_model(run.controller, slug(name))
    target = folder.path / "schedule"
    target.mkdir(exist_ok=True)
    run.schedule.save(target / f"{slug(name)}.npz")
    run.schedule.resample(100.0).save(target / f"{slug(name)}_100hz.csv")

"""Answers to the page: models of strokes, bent movements, schedules, and files to download."""

import tempfile
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, fields, is_dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from sklearn.frozen import FrozenEstimator

from torch_pbd.checks import Floats
from torch_pbd.control import DMPController, Schedule, StiffnessLaw
from torch_pbd.data import Demonstrations, load_demonstrations, save_demonstrations
from torch_pbd.playground.messages import Settings
from torch_pbd.registry import MOVEMENTS, load_class

_STEPS, _DRAWN = 40, 50  # at which a movement is learned and drawn: the bends of strokes are a tenth of them
_DRAWS = 5  # made movements that are shown
_RATE = 1000.0  # Hz of the robot's loop
_AT_ONCE = 20  # rows of a schedule in a row of the strip chart

Answer = dict[str, Any]
Step = Callable[[], Answer | None]


@dataclass
class Learned:
    """Controllers of the strokes of a page, by the name of their model, and what was asked of the first."""

    strokes: Demonstrations
    settings: Settings
    steps: deque[Step] = field(default_factory=deque)  # that are left to do; each may be begun again if interrupted
    controllers: dict[str, DMPController] = field(default_factory=dict)
    via: list[tuple[float, float, float]] = field(default_factory=list)
    bent: DMPController | None = None
    schedule: Schedule | None = None
    scores: dict[tuple[str, int], float] = field(default_factory=dict)


def learn(strokes: list[Floats], settings: Settings) -> Learned:
    """Steps that learn models of two strokes or more, the schedule of the first, and how likely left-out ones are."""
    times, positions = [rows[:, 0] for rows in strokes], [rows[:, 1:] for rows in strokes]
    learned = Learned(Demonstrations(times, positions, names=["x", "y"], units="m"), settings)
    left_out = range(len(strokes)) if len(strokes) > 2 else ()
    learned.steps.extend(partial(_fit, learned, name) for name in settings.models)
    learned.steps.append(partial(follow, learned))
    learned.steps.extend(partial(_leave_out, learned, name, k) for name in settings.models for k in left_out)
    return learned


def _fit(learned: Learned, name: str) -> Answer:
    begun = time.perf_counter()
    learned.controllers[name] = _controller(_model(name), learned.settings).fit(learned.strokes)
    return {**picture(learned.controllers[name], name, drawn=True), "seconds": time.perf_counter() - begun}


def _leave_out(learned: Learned, name: str, k: int) -> Answer | None:
    """Log-likelihood of strokes, each left out, under the joint law of the others, once it is known of all."""
    aligned = learned.strokes.align("phase", n=_STEPS)
    train, test = aligned.split([k])
    learned.scores[name, k] = float(_model(name).fit(train).score_demonstrations(test)[0]) / _STEPS
    if k + 1 < len(aligned):
        return None
    nats = float(np.mean([learned.scores[name, i] for i in range(len(aligned))]))
    return {"type": "score", "model": name, "nats": nats}


def adjust(learned: Learned, settings: Settings) -> Answer:
    """Schedule with other limits, mass or speed: the model stays as it is."""
    learned.settings = settings
    for name, fitted in learned.controllers.items():
        # The fitted model is frozen: gains are made anew, nothing is learned again.
        learned.controllers[name] = _controller(FrozenEstimator(fitted.covariance_), settings).fit(learned.strokes)
    learned.bent = _bent(learned, learned.via)
    return follow(learned)


def bend(learned: Learned, via: list[tuple[float, float, float]]) -> Answer:
    """Movement of the first model through points: rows of time in s and position in m."""
    learned.bent, learned.via, learned.schedule = _bent(learned, via), via, None
    return picture(learned.bent, next(iter(learned.controllers)), drawn=False)


def follow(learned: Learned) -> Answer:
    """Schedule of the first model, for the robot, and what is guaranteed of it."""
    controller = learned.bent or next(iter(learned.controllers.values()))
    schedule = controller.schedule(rate=_RATE, speed=learned.settings.speed)
    learned.schedule = schedule
    report = schedule.certify(mass=learned.settings.mass)
    along = np.linalg.eigvalsh(schedule.stiffness[::_AT_ONCE])
    return {
        "type": "schedule",
        "schedule": schedule,  # for the robot; the page gets the rest
        "duration": schedule.duration,
        "stiffness": along.round(1).tolist(),
        "is_guaranteed": report.stable,
        "report": str(report),
    }


def picture(controller: DMPController, name: str, *, drawn: bool) -> Answer:
    """Path, covariances and made movements of a controller, at even times."""
    times = np.linspace(0.0, controller.duration_, _DRAWN)[:, np.newaxis]
    path, model = controller.predict(times), controller.covariance_
    covariance = model.predict_cov(times)
    draws = model.sample_demonstrations(times, _DRAWS, random_state=0) if drawn else np.empty((0, _DRAWN, 2))
    return {
        "type": "picture",
        "model": name,
        "time": times[:, 0].tolist(),
        "path": path.round(5).tolist(),
        "covariance": covariance[:, [0, 0, 1], [0, 1, 1]].tolist(),
        "draws": draws.round(5).tolist(),
    }


def take_home(learned: Learned, name: str) -> bytes:
    """Content of a file: the strokes, the schedule, or the lines that make the schedule of the strokes."""
    text = {"skill.py": _python, "skill.yaml": _yaml}.get(name)
    if text is not None:
        return text(learned).encode()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, name)
        if name == "demonstrations.csv":
            save_demonstrations(learned.strokes, path)
        else:
            (learned.schedule or follow(learned)["schedule"]).save(path)
        return path.read_bytes()


def read_file(name: str, content: bytes) -> list[list[list[float]]]:
    """Strokes of a file of demonstrations, .csv or .npz, of two outputs; of its name only the ending counts."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, f"dropped{Path(name).suffix.lower()}")
        path.write_bytes(content)
        try:
            demonstrations = load_demonstrations(path)
        except ValueError as error:
            raise ValueError(str(error).replace(str(path), name)) from None
    if demonstrations.n_outputs != 2:
        raise ValueError(f"{name} has {demonstrations.n_outputs} outputs, must have 2: leave the others out.")
    return [np.column_stack(each).tolist() for each in demonstrations.from_start()]


def _model(name: str) -> Any:
    """Model of whole movements: by itself, or of a regressor."""
    return load_class(name)() if name in MOVEMENTS else load_class("TrajectoryRegressor")(load_class(name)())


def _controller(covariance: Any, settings: Settings) -> DMPController:
    law = StiffnessLaw(settings.stiffness_min, settings.stiffness_max, smooth=settings.smooth)
    return DMPController(
        covariance, n_steps=_STEPS, stiffness_law=law, mass=settings.mass, damping_ratio=settings.damping_ratio
    )


def _bent(learned: Learned, via: list[tuple[float, float, float]]) -> DMPController:
    controller = next(iter(learned.controllers.values()))
    if not via:
        return controller
    points = np.array(via)
    return controller.condition(points[:, 0], points[:, 1:])


def _python(learned: Learned) -> str:
    settings, name = learned.settings, next(iter(learned.controllers))
    used, bent = {"DMPController", "load_demonstrations", name}, ""
    used |= set() if name in MOVEMENTS else {"TrajectoryRegressor"}
    if learned.via:
        times, points = [at for at, *_ in learned.via], [list(point) for _, *point in learned.via]
        bent = f"controller = controller.condition({times}, {points})\n"
    return f"""\
from torch_pbd import {", ".join(sorted(used))}
from torch_pbd.control import StiffnessLaw

strokes = load_demonstrations("demonstrations.csv", units="m")
controller = {_controller(_model(name), settings)!r}
controller = controller.fit(strokes)
{bent}schedule = controller.schedule(rate={_RATE:g}, speed={settings.speed!r})
print(schedule.certify(mass={settings.mass!r}))
schedule.save("schedule.npz")
"""


def _yaml(learned: Learned) -> str:
    mine = _spec(_controller(_model(next(iter(learned.controllers))), learned.settings))
    content = {"data": "demonstrations.csv", "controllers": {"mine": mine}}
    lines = [
        "torch-pbd experiment --config skill.yaml",
        "Without points that bend it, and at its own speed: see skill.py.",
    ]
    return "".join(f"# {line}\n" for line in lines) + str(yaml.safe_dump(content, sort_keys=False))


def _spec(value: Any) -> Any:
    """Value as the command line's files have it: of an object the class, and what is not as by default."""
    if not is_dataclass(value):
        return value
    parameters = {own.name: (getattr(value, own.name), own.default) for own in fields(value)}
    changed = {name: _spec(given) for name, (given, default) in parameters.items() if given != default}
    return {"class_path": type(value).__name__, "init_args": changed}

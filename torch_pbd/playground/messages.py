"""Messages of the page: plain JSON whose types, sizes and ranges are checked first."""

import base64
import json
from dataclasses import dataclass
from typing import Any

import numpy as np

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.registry import MOVEMENTS, REGRESSORS

MODELS = [*REGRESSORS, *(name for name in MOVEMENTS if name != "TrajectoryRegressor")]
"""Models that a page can choose: regressors become whole movements by TrajectoryRegressor."""

FILES = ["demonstrations.csv", "schedule.npz", "schedule.json", "schedule.csv", "skill.py", "skill.yaml"]
MOST_BYTES = 2**21  # largest message, above forty strokes of a minute at 60 Hz

# What a person draws is far less: a minute of a stroke at 60 Hz has 3600 samples.
_MOST_STROKES, _MOST_SAMPLES, _MOST_POINTS = 40, 4000, 12
_FARTHEST = 10.0  # m
_LEAST_STEP = 1e-4  # s: events of a pointer that share a millisecond are one


@dataclass(frozen=True)
class Settings:
    """Choices of the page's selectors and sliders; one model, or two to compare."""

    models: tuple[str, ...] = ("HeteroscedasticGPRegressor",)
    stiffness_min: float = 50.0
    stiffness_max: float = 1000.0
    smooth: bool = False
    damping_ratio: float = 1.0
    mass: float = 1.0
    speed: float = 1.0


def parse(text: Any) -> dict[str, Any]:
    """Message of a page as a mapping with a ``type``."""
    try:
        message = json.loads(text)
    except (TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"the message is not JSON: {str(error)[:80]}") from None
    if not isinstance(message, dict) or not isinstance(message.get("type"), str):
        raise ValueError("the message must be a mapping with a type")
    return message


def as_strokes(values: Any) -> list[Floats]:
    """Strokes, each of rows (time in s from its start, x in m, y in m); at least two, of at least five samples."""
    if not isinstance(values, list) or not 2 <= len(values) <= _MOST_STROKES:
        raise ValueError(f"strokes must be a list of 2 to {_MOST_STROKES}: draw the movement again, a bit differently.")
    strokes = []
    for k, rows in enumerate(values):
        name = f"strokes[{k}]"
        if not isinstance(rows, list) or not 5 <= len(rows) <= _MOST_SAMPLES:
            raise ValueError(f"{name} must have 5 to {_MOST_SAMPLES} samples: draw it more slowly, or shorter.")
        samples = checks.array(rows, name, ("n", 3))
        checks.require(np.abs(samples[:, 1:]) <= _FARTHEST, samples[:, 1:], name, f"within {_FARTHEST:g} m")
        # A clock that was set back gives times that do not increase: such samples are left out too.
        samples = samples[np.append(True, np.diff(np.maximum.accumulate(samples[:, 0])) > _LEAST_STEP)]
        if len(samples) < 5:
            raise ValueError(f"{name} has fewer than 5 different times: draw it more slowly.")
        strokes.append(samples - [samples[0, 0], 0.0, 0.0])
    return strokes


def as_settings(values: Any) -> Settings:
    """Settings within the ranges of the page's sliders."""
    if not isinstance(values, dict) or set(values) - set(Settings.__dataclass_fields__):
        raise ValueError(f"settings must be a mapping of {', '.join(Settings.__dataclass_fields__)}.")
    given = Settings(**values)
    if not isinstance(given.models, list | tuple) or not 1 <= len(given.models) <= 2:
        raise ValueError("models must be a list of one name, or two.")
    for name in given.models:
        checks.choice(name, "models", MODELS)
    least = checks.number(given.stiffness_min, "stiffness_min", least=1.0, most=5000.0, unit="N/m")
    return Settings(
        models=tuple(dict.fromkeys(given.models)),
        stiffness_min=least,
        stiffness_max=checks.number(given.stiffness_max, "stiffness_max", least=least, most=5000.0, unit="N/m"),
        smooth=checks.flag(given.smooth, "smooth"),
        damping_ratio=checks.number(given.damping_ratio, "damping_ratio", least=0.05, most=3.0),
        mass=checks.number(given.mass, "mass", least=0.1, most=50.0, unit="kg"),
        speed=checks.number(given.speed, "speed", least=0.1, most=4.0),
    )


def as_points(values: Any) -> list[tuple[float, float, float]]:
    """Via points, rows of time in s and position in m."""
    if not isinstance(values, list) or len(values) > _MOST_POINTS:
        raise ValueError(f"points must be a list of at most {_MOST_POINTS}.")
    points = checks.array(values or np.empty((0, 3)), "points", ("n", 3))
    checks.require(np.abs(points) <= 60.0, points, "points", "within 60 s and 60 m")
    return [(float(at), float(x), float(y)) for at, x, y in points]


def as_pair(values: Any, name: str, most: float) -> tuple[float, float] | None:
    """Two numbers no larger than ``most``, or None."""
    if values is None:
        return None
    pair = checks.array(values, name, (2,))
    checks.require(np.abs(pair) <= most, pair, name, f"at most {most:g} in size")
    return float(pair[0]), float(pair[1])


def as_file(message: dict[str, Any]) -> tuple[str, bytes]:
    """Name and content of a file that was dropped on the page."""
    name, content = message.get("name"), message.get("content")
    if not isinstance(name, str) or not name.lower().endswith((".csv", ".npz")) or len(name) > 200:
        raise ValueError("a file must end in .csv or .npz.")
    try:
        return name, base64.b64decode(content, validate=True)  # type: ignore[arg-type]  # None is a TypeError below
    except (TypeError, ValueError):
        raise ValueError("the content of a file must be base64.") from None

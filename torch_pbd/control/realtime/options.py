"""Options of the real-time controller that positions and rotations have each their own of."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from torch_pbd import checks
from torch_pbd.control.realtime.places import Vector
from torch_pbd.control.realtime.steps import Numbers, vector
from torch_pbd.exceptions import InvalidParameterError

Option = float | tuple[float, float] | None
"""Number for positions; for poses a pair, of positions and of rotations; None is the default."""

StartState = tuple[Vector | None, Vector | None, Vector]
"""Position, orientation and velocity; places are None where they are those of the schedule."""

# What rotations have for a unit of positions.
_ANGULAR = {"N": "Nm", "N/s": "Nm/s", "units/s": "rad/s", "units/s^2": "rad/s^2"}
# Defaults and units; those that are empty depend on others.
_OPTIONS: dict[str, tuple[Vector, str]] = {
    "force_limit": ((200.0, 20.0), "N"),
    "spring_limit": ((), "N"),
    "deadband": ((0.0, 0.0), "N"),
    "force_rate_limit": ((math.inf, math.inf), "N/s"),
    "velocity_limit": ((math.inf, math.inf), "units/s"),
    "acceleration_limit": ((math.inf, math.inf), "units/s^2"),
    "approach_speed": ((0.5, 1.0), "units/s"),
    "stop_deceleration": ((), "units/s^2"),
}
_OFF = 1e-3  # of a quaternion's length: four rounded digits


def of_blocks(given: Mapping[str, Any], n_blocks: int) -> dict[str, Vector]:
    """Options for positions, and for poses those for rotations too."""
    values = {}
    for name, (default, unit) in _OPTIONS.items():
        value = given[name]
        if value is None:
            values[name] = default[:n_blocks]
            continue
        if n_blocks == 1:
            values[name] = (_checked(value, name, unit),)
        elif isinstance(value, Sequence) and len(value) == 2:
            of_each = zip(value, (unit, _ANGULAR[unit]), strict=True)
            values[name] = tuple([_checked(part, f"{name}[{i}]", of) for i, (part, of) in enumerate(of_each)])
        else:
            raise checks.refusal(value, name, f"a pair for poses, in {unit} and {_ANGULAR[unit]}")
    values["spring_limit"] = values["spring_limit"] or values["force_limit"]
    return values


def _checked(value: Any, name: str, unit: str) -> float:
    if name.startswith("deadband"):
        return checks.number(value, name, least=0.0, unit=unit)
    return checks.number(value, name, above=0.0, unit=unit)


def start_state(
    position: Numbers | None,
    orientation: Numbers | None,
    velocity: Numbers | None,
    blocks: tuple[slice, ...],
    speed_limits: Vector,
) -> StartState:
    """State of a robot that begins, checked: at rest where no velocity is given."""
    d = blocks[-1].stop
    here = None if position is None else vector(position, "position", blocks[0].stop)
    if orientation is not None and len(blocks) == 1:
        raise InvalidParameterError("orientation is given, must be None for a schedule without: leave it out.")
    turned = None if orientation is None else _unit_quaternion(orientation)
    moving = (0.0,) * d if velocity is None else vector(velocity, "velocity", d)
    kinds = [("the speed", "units/s"), ("the angular speed", "rad/s")]
    for (name, unit), block, most in zip(kinds, blocks, speed_limits, strict=False):
        remedy = "slow it down, or raise velocity_limit"
        checks.number(math.hypot(*moving[block]), name, most=most, unit=unit, remedy=remedy)
    return here, turned, moving


def _unit_quaternion(values: Numbers) -> Vector:
    quaternion = checks.array(values, "orientation", (4,))
    length = float(np.linalg.norm(quaternion))
    remedy = "give a unit quaternion w x y z"
    checks.number(length, "the length of orientation", least=1.0 - _OFF, most=1.0 + _OFF, remedy=remedy)
    return tuple((quaternion / length).tolist())

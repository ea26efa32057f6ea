"""Names and units as figures and tables show them."""

from collections.abc import Sequence

from torch_pbd.control.schedule.schedule import Schedule
from torch_pbd.data import Demonstrations

_LONGEST_UNIT = 8  # letters; what is longer is a description


def readable_unit(unit: str | None) -> tuple[str, float]:
    """Unit of a deviation, and what to multiply it by: metres are shown in millimetres."""
    return ("mm", 1000.0) if unit == "m" else (short_unit(unit), 1.0)


def short_unit(unit: str | None) -> str:
    """Unit for a label or a column; "unit" where there is none, or only a description."""
    return unit if unit and len(unit) <= _LONGEST_UNIT else "unit"


def schedule_names(schedule: Schedule) -> Sequence[str]:
    """Names of the outputs of a schedule."""
    return schedule.names or [f"y{i}" for i in range(schedule.position.shape[1])]


def output_label(demonstrations: Demonstrations, output: int) -> str:
    """Name of an output with its unit, for an axis."""
    units = demonstrations.units
    unit = units[output] if units is not None else ""
    return axis_label(demonstrations.names[output], unit if len(unit) <= _LONGEST_UNIT else "")


def axis_label(name: str, unit: str) -> str:
    """Name with its unit in brackets, if it has one."""
    return f"{name} [{unit}]" if unit and unit != "1" else name

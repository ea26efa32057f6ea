"""What the benchmark found, as tables, as one JSON file, and as figures."""

import json
import os
import platform
from collections.abc import Sequence
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import torch_pbd
from speed.rows import Findings, Growth, Plan, Row
from speed.timing import median
from torch_pbd.console import format_table
from torch_pbd.experiments.run_folder import RunFolder
from torch_pbd.plotting import SERIES

_PACKAGES = ("torch", "scikit-learn", "numpy", "scipy", "gpytorch", "gmr")
_PREFIXES = ((1.0, ""), (1e-3, "m"), (1e-6, "u"), (1e-9, "n"))
_MARKERS = "osD^vP*X"

_WIDTH = 240  # of its tables, which are for wide windows: what is compared stays on one line


def tables(found: Sequence[Findings]) -> str:
    """One table a group, and below it what was left out."""
    parts = []
    for findings in found:
        lines = [findings.group]
        if findings.rows:
            lines.append(format_table([_cells(row) for row in findings.rows], _WIDTH))
        if findings.growth:
            lines.append(format_table([_growth_cells(growth) for growth in findings.growth], _WIDTH))
        parts.append("\n".join([*lines, *(f"left out: {note}" for note in findings.left_out)]))
    verdicts = [row.held for findings in found for row in findings.rows if row.held is not None]
    return "\n\n".join([*parts, f"{sum(verdicts)} of {len(verdicts)} bars held"])


def _cells(row: Row) -> dict[str, str]:
    values = row.values
    is_ratio, verdict = row.other is not None, {True: "held", False: "MISSED", None: ""}[row.held]
    unit = "x" if is_ratio else row.unit
    spread = "" if len(values) < 2 else f"{_amount(min(values), unit)} .. {_amount(max(values), unit)}"
    return {
        "what": row.what,
        "ours": _amount(median(row.ours), row.unit),
        "other": "" if row.other is None else _amount(median(row.other), row.unit),
        "ratio": _amount(median(values), unit) if is_ratio else "",
        "lowest .. highest": spread,
        "bar": "" if row.bar is None else f"{row.bar[0]} {_amount(row.bar[1], unit)}",
        "": verdict,
        "other is, or note": row.other_name or row.note,
    }


def _growth_cells(growth: Growth) -> dict[str, str]:
    first, last = (median(growth.seconds[end]) for end in (0, -1))
    return {
        "what": growth.what,
        "over": growth.axis,
        "smallest": f"{growth.sizes[0]:,}: {_amount(first, 's')}",
        "largest": f"{growth.sizes[-1]:,}: {_amount(last, 's')}",
        "exponent": f"{growth.exponent:.2f}",
    }


def _amount(value: float, unit: str) -> str:
    """Three digits; seconds with a prefix."""
    if unit == "x":
        return f"{value:.3g} x" if value < 1000 else f"{value:,.0f} x"
    if unit != "s":
        return f"{value:.3g} {unit}"
    scale, prefix = next((pair for pair in _PREFIXES if abs(value) >= 0.9995 * pair[0]), _PREFIXES[-1])
    return f"{value / scale:.3g} {prefix}s"


def as_json(found: Sequence[Findings], plan: Plan) -> dict[str, Any]:
    """All numbers, and what they are of."""
    groups = {}
    for findings in found:
        rows = [asdict(row) | {"values": row.values, "held": row.held} for row in findings.rows]
        groups[findings.group] = asdict(findings) | {"rows": rows}
    return {
        "machine": {"platform": platform.platform(), "processor": _processor(), "cpus": os.cpu_count()},
        "versions": {"torch_pbd": torch_pbd.__version__, "python": platform.python_version(), **_versions()},
        "plan": {"n_repetitions": plan.n_repetitions, "quick": plan.quick, "seed": plan.seed},
        "clock": "process CPU time of one thread; ticks: of the thread; --help: wall",
        "groups": groups,
    }


def _versions() -> dict[str, str | None]:
    found: dict[str, str | None] = {}
    for package in _PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = None
    return found


def _processor() -> str:
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:  # noqa: PTH123
            return next(line.partition(":")[2].strip() for line in file if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor()


def write(found: Sequence[Findings], plan: Plan, folder: RunFolder) -> None:
    """``benchmark.json``, ``figures/ratios.png`` and ``figures/growth.png``."""
    folder.write_text("benchmark.json", json.dumps(as_json(found, plan), indent=1) + "\n")
    rows = [row for findings in found for row in findings.rows if row.other is not None]
    growth = [one for findings in found for one in findings.growth]
    for name, figure in (("ratios", rows and ratios_figure(rows)), ("growth", growth and growth_figure(growth))):
        if isinstance(figure, Figure):
            folder.write_figure(figure, name)
            plt.close(figure)


def ratios_figure(rows: Sequence[Row]) -> Figure:
    """How many times as long the others take, and the bars."""
    figure, ax = plt.subplots(figsize=(9.0, 1.2 + 0.34 * len(rows)), layout="constrained")
    for place, row in enumerate(rows):
        value = median(row.values)
        ax.plot([min(row.values), max(row.values)], [place, place], color=SERIES[0], lw=1.5, zorder=1)
        ax.plot(value, place, "o", color=SERIES[0], label="median, lowest and highest" if place == 0 else None)
        if row.bar is not None:
            first = all(earlier.bar is None for earlier in rows[:place])
            ax.plot(row.bar[1], place, "|", color=SERIES[5], ms=14, mew=2, label="bar" if first else None)
    ax.axvline(1.0, color="0.6", lw=0.8)
    ax.set(xscale="log", xlabel="what others take over what we take (1)", ylim=(len(rows) - 0.5, -0.5))
    ax.set_yticks(range(len(rows)), [f"{row.what}\n{row.other_name}" for row in rows], fontsize=7)
    ax.grid(axis="x", alpha=0.3)
    ax.legend(loc="best", fontsize=8)
    return figure


def growth_figure(growth: Sequence[Growth]) -> Figure:
    """Times over sizes, one panel for each kind of size, with the exponents."""
    axes = list(dict.fromkeys(one.axis for one in growth))
    figure, panels = plt.subplots(
        1, len(axes), figsize=(3.4 * len(axes), 3.4), layout="constrained", sharey=True, squeeze=False
    )
    for axis, ax in zip(axes, panels[0], strict=True):
        for number, one in enumerate(one for one in growth if one.axis == axis):
            _draw(ax, one, number)
        ax.set(xscale="log", yscale="log", xlabel=f"{axis} (1)")
        sizes = next(one.sizes for one in growth if one.axis == axis)
        if sizes[-1] <= 10 * sizes[0]:  # within a decade the labels of a logarithmic axis lie on each other
            ax.set_xticks(sizes, [str(size) for size in sizes])
            ax.set_xticks([], minor=True)
        ax.grid(alpha=0.3)
        ax.legend(fontsize=8)
    panels[0, 0].set_ylabel("CPU time (s)")
    return figure


def _draw(ax: Axes, growth: Growth, number: int) -> None:
    middle = [median(times) for times in growth.seconds]
    spread = [[m - min(times) for m, times in zip(middle, growth.seconds, strict=True)]]
    spread.append([max(times) - m for m, times in zip(middle, growth.seconds, strict=True)])
    ax.errorbar(
        growth.sizes,
        middle,
        yerr=spread,
        color=SERIES[number],
        marker=_MARKERS[number],
        ms=4,
        label=f"{growth.what}: exponent {growth.exponent:.2f}",
    )

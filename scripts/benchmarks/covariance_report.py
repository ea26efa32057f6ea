"""Markdown tables of covariance.py from its rows."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

Row = dict[str, Any]
BASELINES = ("constant", "gmr 8", "reference", "smoother")

_MADE = """\
Made data: medians over seeds, on a grid; nats. KL: from the law to the normal of `predict`, which is the predictive \
one where a method has it; cov: as if means were equal; worst: the worst seed. Gap: what a fresh draw loses in log \
density, for a density that is not normal over 20,000 draws. Outside: standard deviation half a range below / above \
the data over that of the law's mean covariance. Fits: how many of the seeds gave a result.
"""
_RECORDED = """\
Recordings: log-likelihood per step of a demonstration left out, nats; +- is the paired standard error over folds; \
positive differences are in favour of the method. 90 % and 95 % hold: ellipses of the predictive covariance.
"""
_SETS = """\
All sets: mean over sets of the mean difference, +- from the standard errors of the sets; lowest: the set with the \
lowest; ahead: number of sets on which the mean over folds is higher. Sets where a fold of either failed are left \
out: see the number of sets.
"""
_PEN = """\
pen_a, few demonstrations: KL from the covariance of all others (as if means were equal), mean over steps and splits \
(lowest to highest split), nats.
"""


def report(made: Sequence[Row], recorded: Sequence[Row], pen: Sequence[Row]) -> str:
    """All tables that there are rows for."""
    parts = []
    if made:
        parts += [_MADE, *(_section(task, rows, _made_row) for task, rows in _by(made, "task").items())]
    if recorded:
        sets = _by(recorded, "set")
        parts += [_RECORDED, *(_section(name, rows, _recorded_row) for name, rows in sets.items())]
        parts += [_SETS, _table([_over_sets(method, sets) for method in _by(recorded, "method")])]
    if pen:
        parts += [_PEN, _table([_pen_row(method, rows) for method, rows in _by(pen, "method").items()]), _notes(pen)]
    return "\n".join(part for part in parts if part)


def changes(before: Sequence[Sequence[Row]], after: Sequence[Sequence[Row]], method: str) -> str:
    """Table of one method in two versions, of made and of recorded rows that both have; paired over seeds and folds."""
    lines = []
    for old, new, value, key in zip(before, after, ("kl_all", "log_likelihood"), ("seed", "fold"), strict=True):
        name = "task" if key == "seed" else "set"
        kept = {(row[name], row[key]): row for row in old if row["method"] == method and value in row}
        for title, rows in _by(new, name).items():
            pairs = [
                (kept[title, row[key]], row) for row in rows if row["method"] == method and (title, row[key]) in kept
            ]
            if not pairs:
                continue
            gain = np.array([(b[value] - a[value]) * (1 if key == "seed" else -1) for b, a in pairs])
            error = gain.std(ddof=1) / math.sqrt(len(gain)) if len(gain) > 1 else math.nan
            holds = [np.mean([row["holds_90"] for row in own]) for own in zip(*pairs, strict=True)]
            seconds = [_median([row["fit_seconds"] for row in own]) for own in zip(*pairs, strict=True)]
            lines.append(
                {
                    "data": title,
                    "gain, nats": f"{gain.mean():+.3f} +- {error:.3f}",
                    "90 % holds": "{:.3f} -> {:.3f}".format(*holds),
                    "fit [s]": "{:.2f} -> {:.2f}".format(*seconds),
                }
            )
    return _table(lines)


def _section(title: str, rows: Sequence[Row], cells: Callable[[str, Sequence[Row], Sequence[Row]], Row]) -> str:
    table = _table([cells(method, own, rows) for method, own in _by(rows, "method").items()])
    return f"## {title}\n\n{table}\n{_notes(rows)}"


def _made_row(method: str, own: Sequence[Row], rows: Sequence[Row]) -> Row:
    done = _done(own)
    kl_cov, kl_all = _column(done, "kl_cov"), _column(done, "kl_all")
    below, above = (_text(_median(_column(done, f"outside_{side}")), "{:.2g}") for side in ("low", "high"))
    return {
        "method": method,
        "KL cov": _text(_median(kl_cov), "{:.4f}"),
        "worst": _text(max(kl_cov, default=math.nan), "{:.3f}"),
        "KL all": _text(_median(kl_all), "{:.4f}"),
        "worst all": _text(max(kl_all, default=math.nan), "{:.3f}"),
        "gap": _text(_median(_column(done, "gap")), "{:.4f}"),
        "90 % holds": _text(_median(_column(done, "holds_90")), "{:.3f}"),
        "outside": f"{below} / {above}" if done else "",
        "fit [s]": _text(_median(_column(done, "fit_seconds")), "{:.2f}"),
        "fits": f"{len(done)}/{len(own)}",
    }


def _recorded_row(method: str, own: Sequence[Row], rows: Sequence[Row]) -> Row:
    done = _done(own)
    values = _column(done, "log_likelihood")
    row = {
        "method": method,
        "mean": _text(np.mean(values) if values else math.nan, "{:.3f}"),
        "median": _text(_median(values), "{:.3f}"),
    }
    for baseline in BASELINES:
        difference, error, _ = paired(rows, method, baseline)
        row[f"to {baseline}"] = _text(difference, "{:+.3f}") + _text(error, " +- {:.3f}") if method != baseline else ""
    for level in (90, 95):
        held = _column(done, f"holds_{level}")
        row[f"{level} % holds"] = _text(np.mean(held) if held else math.nan, "{:.3f}")
    row["fit [s]"] = _text(_median(_column(done, "fit_seconds")), "{:.2f}")
    return row | {"fits": f"{len(done)}/{len(own)}"}


def paired(rows: Sequence[Row], method: str, baseline: str) -> tuple[float, float, bool]:
    """Mean difference in log-likelihood over the folds that both have, its standard error, and if that is all."""
    mine, theirs = (
        {row["fold"]: row["log_likelihood"] for row in _done(rows) if row["method"] == name}
        for name in (method, baseline)
    )
    difference = [mine[fold] - theirs[fold] for fold in mine if fold in theirs]
    if not difference:
        return math.nan, math.nan, False
    error = np.std(difference, ddof=1) / len(difference) ** 0.5 if len(difference) > 1 else math.nan
    return float(np.mean(difference)), float(error), len(difference) == len({row["fold"] for row in rows})


def _over_sets(method: str, sets: dict[Any, list[Row]]) -> Row:
    row: Row = {"method": method}
    for baseline in BASELINES:
        compared = {name: paired(rows, method, baseline) for name, rows in sets.items()}
        complete = {name: (mean, error) for name, (mean, error, whole) in compared.items() if whole}
        if method == baseline or not complete:
            row |= {f"to {baseline}": "", f"lowest to {baseline}": "", f"ahead of {baseline}": ""}
            continue
        means, errors = np.array(list(complete.values())).T
        lowest = min(complete, key=lambda name: complete[name][0])
        error = float(np.sqrt(np.sum(errors**2)) / len(errors))
        row |= {
            f"to {baseline}": _text(means.mean(), "{:+.3f}") + _text(error, " +- {:.3f}"),
            f"lowest to {baseline}": f"{complete[lowest][0]:+.3f} ({lowest})",
            f"ahead of {baseline}": f"{int((means > 0).sum())}/{len(means)}",
        }
    held = [row["holds_95"] for rows in sets.values() for row in _done(rows) if row["method"] == method]
    return row | {"95 % holds": _text(np.mean(held) if held else math.nan, "{:.3f}")}


def _pen_row(method: str, own: Sequence[Row]) -> Row:
    row: Row = {"method": method}
    for size, rows in _by(own, "n_train").items():
        values = _column(_done(rows), "kl_cov")
        spread = f" ({min(values):.2f} to {max(values):.2f})" if values else ""
        row[f"{size} shown"] = (_text(np.mean(values), "{:.3f}") if values else "") + spread
    done = _done(own)
    return row | {"fit [s]": _text(_median(_column(done, "fit_seconds")), "{:.2f}"), "fits": f"{len(done)}/{len(own)}"}


def _notes(rows: Sequence[Row]) -> str:
    """Why a method has no result, the first reason of each."""
    reasons: dict[str, str] = {}
    for row in rows:
        if row["note"].startswith(("cannot: ", "failed: ")):
            reasons.setdefault(row["method"], row["note"])
    return "".join(f"\n- {method} {note}\n" for method, note in reasons.items())


def _table(rows: Sequence[Row]) -> str:
    """Markdown, columns those of the first row."""
    columns = list(rows[0])
    lines = ["| " + " | ".join(columns) + " |", "|---" * len(columns) + "|"]
    lines += ["| " + " | ".join(str(row[column]) for column in columns) + " |" for row in rows]
    return "\n".join(lines) + "\n"


def _by(rows: Sequence[Row], key: str) -> dict[Any, list[Row]]:
    """Rows by the value of a key, in order of appearance."""
    parts: dict[Any, list[Row]] = {}
    for row in rows:
        parts.setdefault(row[key], []).append(row)
    return parts


def _done(rows: Sequence[Row]) -> list[Row]:
    return [row for row in rows if "fit_seconds" in row]


def _column(rows: Sequence[Row], key: str) -> list[float]:
    return [row[key] for row in rows]


def _median(values: Sequence[float]) -> float:
    return float(np.median(values)) if len(values) else math.nan


def _text(value: float, style: str) -> str:
    """Number as text; nothing where there is none."""
    return "" if math.isnan(value) else style.format(value)

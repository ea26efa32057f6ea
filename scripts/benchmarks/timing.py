"""Phase of running movements that were left out, after their first third: ``timing="warp"``, "auto" and the clock.

The clock takes time over the mean duration for the phase. Two truths that no model has a part in: "place", where the
recording is along the mean of the others, by dynamic time warping of the whole recording; and "share", of its own
duration. Recordings that all last equally long have no durations to find: with ``--retime`` each takes a known random
one, of that standard deviation of the logarithm. The first eight demonstrations are left out in turn, with at most 40
of the others to learn from; every fold goes into a CSV file, and docs/movements.md has the table.
"""

import argparse
import math
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from joblib import Parallel, delayed
from movements import MOST_TRAINED, N_FOLDS, SETS, write

from torch_pbd import TrajectoryRegressor, load_demonstrations
from torch_pbd.data.alignment import dtw_path

Floats = Any
DATA = Path(__file__).parents[3] / "shared" / "data"
CHOSEN_ON = ("letter_A", "letter_C", "letter_G", "letter_L", "pen_a", "gait_hip_knee", "kuka_cube_pick")
CHOSEN_ON += ("adroit_door_palm",)
N_STEPS = 50


def load(name: str, retime: float) -> list[tuple[Floats, Floats]]:
    """Times (50,) since the start, in mean durations, and positions (50, d) in pooled deviations."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        recorded = load_demonstrations(DATA / f"{name}.npz").from_start().resample(N_STEPS)
    y = np.stack(recorded.positions)
    y = (y - y.mean((0, 1))) / y.std((0, 1))
    duration = np.array([times[-1] for times in recorded.times])
    if np.ptp(duration) < 0.01 * duration.mean():
        duration = np.exp(retime * np.random.default_rng(0).standard_normal(len(y)))
    return [(np.linspace(0.0, own / duration.mean(), N_STEPS), each) for own, each in zip(duration, y, strict=True)]


def place(path: Floats, mean: Floats, share: float) -> float:
    """Phase along a mean curve that dynamic time warping matches with a share of a whole path; twice as many points."""
    fine, coarse = np.linspace(0.0, 1.0, 2 * N_STEPS + 1), np.linspace(0.0, 1.0, N_STEPS)
    curves = [np.stack([np.interp(fine, coarse, c) for c in each.T], axis=1) for each in (path, mean)]
    pairs = dtw_path(*curves)
    match = np.bincount(pairs[:, 0], weights=pairs[:, 1]) / np.bincount(pairs[:, 0]) / (2 * N_STEPS)
    return float(np.interp(share, fine, match))


def fold(name: str, left_out: int, retime: float) -> dict[str, Any]:
    """Errors of phase, and of the positions after the first third, of one left-out demonstration."""
    recorded = load(name, retime)
    own_time, own = recorded.pop(left_out)
    order = np.random.default_rng(left_out).permutation(len(recorded))[:MOST_TRAINED]
    times, positions = zip(*(recorded[k] for k in order), strict=True)
    groups = np.repeat(np.arange(len(times)), N_STEPS)
    y, average = np.concatenate(positions), np.mean([each[-1] for each in times])
    share = np.linspace(0.0, 1.0, N_STEPS)
    seen = share <= 1.0 / 3.0
    X, now = own_time[:, np.newaxis], own_time[seen][-1]
    start = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        warp = TrajectoryRegressor(timing="warp").fit(np.concatenate(times)[:, np.newaxis], y, groups=groups)
        auto = TrajectoryRegressor(timing="auto").fit(np.concatenate(times)[:, np.newaxis], y, groups=groups)
        none = TrajectoryRegressor().fit(np.tile(share, len(times))[:, np.newaxis], y, groups=groups)
    fitted = time.process_time()
    known = warp.condition(X[seen], own[seen])
    phase, std = (float(each[0]) for each in known.predict_phase([[now]]))
    seconds = time.process_time() - fitted
    clock = np.minimum(X / average, 1.0 + 1e-6 * X)  # after the end it stands still
    rest = [known.predict(X[~seen]), none.condition(clock[seen], own[seen]).predict(clock[~seen])]
    errors = [float(np.sqrt(np.square(each - own[~seen]).mean())) for each in rest]
    chosen = float(auto.condition(X[seen], own[seen]).predict_phase([[now]])[0][0])
    truth = place(own, np.mean(positions, axis=0), share[seen][-1])
    return {
        "set": name,
        "fold": left_out,
        "place_clock": abs(now / average - truth),
        "place_warp": abs(phase - truth),
        "place_auto": abs(chosen - truth),
        "auto_takes": auto.timing_,
        "share_clock": abs(now / average - share[seen][-1]),
        "share_warp": abs(phase - share[seen][-1]),
        "standardized": abs(phase - truth) / std if std > 0.0 else math.nan,  # where timing is not seen to vary
        "rest_clock": errors[1],
        "rest_warp": errors[0],
        "fit_seconds": fitted - start,
        "condition_seconds": seconds,
    }


def difference(rows: list[dict[str, Any]], key: str) -> str:
    """Means of clock and warp, and the paired difference with its standard error."""
    clock, warp = (np.array([row[f"{key}_{method}"] for row in rows]) for method in ("clock", "warp"))
    change = warp - clock
    error = change.std(ddof=1) / math.sqrt(len(change)) if len(change) > 1 else math.nan
    return f"{clock.mean():.4f} | {warp.mean():.4f} | {change.mean():.4f} +- {error:.4f}"


def main() -> None:
    """Run what is asked for, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, default=Path("runs/timing"))
    parser.add_argument("--sets", nargs="*", default=SETS)
    parser.add_argument("--folds", type=int, default=N_FOLDS)
    parser.add_argument("--retime", type=float, default=0.0, help="of sets whose recordings last equally long")
    parser.add_argument("--jobs", type=int, default=2)
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    jobs = (delayed(fold)(name, k, options.retime) for k in range(options.folds) for name in options.sets)
    rows: list[dict[str, Any]] = []
    for row in Parallel(n_jobs=options.jobs, return_as="generator")(jobs):
        rows.append(row)
        write(options.output / f"phases_{options.retime:g}.csv", rows)
    keys = [key for key in ("place", "share", "rest") if any(row[f"{key}_clock"] > 1e-9 for row in rows)]
    cells = " | ".join(f"{key}: clock | warp | change" for key in keys)
    print(
        f"| set | chosen on | {cells} | errors in sd | place: auto | takes warp |\n|" + " --- |" * (3 * len(keys) + 5)
    )
    for name in options.sets:
        own = [row for row in rows if row["set"] == name]
        usual = math.sqrt(np.nanmean([row["standardized"] ** 2 for row in own]))
        cells = " | ".join(difference(own, key) for key in keys)
        auto = f"{np.mean([row['place_auto'] for row in own]):.4f} | {sum(row['auto_takes'] == 'warp' for row in own)}"
        print(f"| {name} | {'yes' if name in CHOSEN_ON else 'no'} | {cells} | {usual:.1f} | {auto} of {len(own)} |")
    seconds = [np.mean([row[f"{key}_seconds"] for row in rows]) for key in ("fit", "condition")]
    print(f"CPU: the three fits {seconds[0]:.2f} s, condition {seconds[1]:.2f} s")


if __name__ == "__main__":
    main()

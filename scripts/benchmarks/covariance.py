"""Regressors of a covariance that depends on the input, compared: ours, simple ones, and those of other libraries.

Made data of which the law is known, every recording with each demonstration left out, and few demonstrations of
``pen_a`` against the covariance of the rest. Every seed and every fold goes into a CSV file as it is done.
"""

import argparse
import csv
import time
import warnings
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from covariance_methods import METHODS, available
from covariance_peers import CannotError, Floats, log_normal
from covariance_report import changes, report
from covariance_tasks import TASKS, Recording, Task, load_recordings
from joblib import Parallel, delayed
from threadpoolctl import threadpool_limits

from torch_pbd.files import replacing
from torch_pbd.metrics import gaussian_kl, mahalanobis_coverage

Row = dict[str, Any]
Job = tuple[Callable[..., Row], tuple[Any, ...]]

DATA = Path(__file__).parents[3] / "shared" / "data"
N_DRAWS = 20_000
PEN_SIZES, PEN_SPLITS = (6, 10, 20), 12

MADE = ("task", "seed", "method", "kl_cov", "kl_all", "gap", "holds_90", "outside_low", "outside_high")
RECORDED = ("set", "fold", "method", "log_likelihood", "holds_90", "holds_95")
PEN = ("n_train", "split", "method", "kl_cov")
OUTCOME = ("fit_seconds", "note")


def fitted(method: str, X: Floats, y: Floats, groups: Any) -> tuple[Any, float]:
    """The method fitted, and the seconds it took."""
    contender = METHODS[method].make()
    start = time.perf_counter()
    contender.fit(X, y, groups)
    return contender, time.perf_counter() - start


def predicted(contender: Any, X: Floats) -> tuple[Floats, Floats]:
    """Mean and covariance, which must be finite."""
    mean, covariance = contender.predict(X)
    if not (np.isfinite(mean).all() and np.isfinite(covariance).all()):
        raise FloatingPointError("predictions are not finite")
    return mean, covariance


def score_task(name: str, seed: int, method: str) -> Row:
    """One method on one draw of a made task."""
    task = TASKS[name](seed)
    contender, seconds = fitted(method, task.X, task.y, task.groups)
    mean, covariance = predicted(contender, task.X_test)
    kl_all = gaussian_kl(task.covariance, covariance, reference_mean=task.mean, estimated_mean=mean)
    rows, fresh = fresh_draws(task, seed)
    below, above = deviation_outside(contender, task)
    return {
        "kl_cov": gaussian_kl(task.covariance, covariance),
        "kl_all": kl_all,
        "gap": kl_all if contender.gaussian else likelihood_gap(contender, task, rows, fresh),
        "holds_90": mahalanobis_coverage(mean[rows], covariance[rows], fresh, level=0.9),
        "outside_low": below,
        "outside_high": above,
        "fit_seconds": seconds,
    }


def fresh_draws(task: Task, seed: int) -> tuple[Any, Floats]:
    """About 20,000 draws from the law: the number of the input of each, and y."""
    rows = np.repeat(np.arange(len(task.X_test)), max(1, N_DRAWS // len(task.X_test)))
    noise = np.random.default_rng([seed, 1]).normal(size=(len(rows), task.y.shape[1], 1))
    return rows, task.mean[rows] + (np.linalg.cholesky(task.covariance)[rows] @ noise)[..., 0]


def likelihood_gap(contender: Any, task: Task, rows: Any, fresh: Floats) -> float:
    """Mean log density of the draws under the law less that under the method, nats; closed for a normal: the KL."""
    true = log_normal(fresh - task.mean[rows], task.covariance[rows])
    return float(np.mean(true - contender.log_likelihood(task.X_test[rows], fresh)))


def deviation_outside(contender: Any, task: Task) -> tuple[float, float]:
    """Standard deviation half a range below and above the data, over that of the law's mean covariance."""
    low, high = task.X.min(axis=0), task.X.max(axis=0)
    reach = 0.5 * (high - low)
    _, covariance = predicted(contender, np.stack([low - reach, high + reach]))
    pooled = np.trace(task.covariance.mean(axis=0))
    below, above = np.sqrt(np.trace(covariance, axis1=1, axis2=2) / pooled)
    return float(below), float(above)


def score_fold(recording: Recording, fold: int, method: str) -> Row:
    """One method on one demonstration left out."""
    out = recording.groups == fold
    contender, seconds = fitted(method, recording.X[~out], recording.y[~out], recording.groups[~out])
    mean, covariance = predicted(contender, recording.X[out])
    density = contender.log_likelihood(recording.X[out], recording.y[out])
    if not np.isfinite(density).all():
        raise FloatingPointError("log-likelihoods are not finite")
    return {
        "log_likelihood": float(np.mean(density)),
        "holds_90": mahalanobis_coverage(mean, covariance, recording.y[out], level=0.9),
        "holds_95": mahalanobis_coverage(mean, covariance, recording.y[out], level=0.95),
        "fit_seconds": seconds,
    }


def score_pen(recording: Recording, n_train: int, split: int, method: str) -> Row:
    """One method on ``n_train`` demonstrations, against the empirical covariance of all others."""
    demos = np.unique(recording.groups)
    shown = np.random.default_rng(split).permutation(demos)[:n_train]
    train = np.isin(recording.groups, shown)
    contender, seconds = fitted(method, recording.X[train], recording.y[train], recording.groups[train])
    steps = recording.X[recording.groups == demos[0]]
    rest = recording.y[~train].reshape(len(demos) - n_train, len(steps), -1)
    truth = np.stack([np.cov(values.T) for values in rest.swapaxes(0, 1)])
    return {"kl_cov": gaussian_kl(truth, predicted(contender, steps)[1]), "fit_seconds": seconds}


def attempt(score: Callable[..., Row], *arguments: Any) -> Row:
    """Scores, on one thread; or an empty row with the reason. The first warning of a fit is noted."""
    torch.set_num_threads(1)
    with threadpool_limits(1), warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            row = score(*arguments)
        except CannotError as reason:
            return {"note": f"cannot: {reason}"}
        except Exception as error:  # whatever a library raises: it is reported, and the others go on
            return {"note": _short(f"failed: {type(error).__name__}: {error}")}
    own = [f"{w.category.__name__}: {w.message}" for w in caught if not issubclass(w.category, DeprecationWarning)]
    return row | {"note": _short(own[0]) if own else ""}


def _short(text: str) -> str:
    return " ".join(text.split())[:160]


def run(jobs: list[Job], keys: list[Row], fields: Iterable[str], path: Path, n_jobs: int) -> list[Row]:
    """Scores of all jobs, each with its key, written to a CSV file one by one."""
    rows = []
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=[*fields, *OUTCOME])
        writer.writeheader()
        results = Parallel(n_jobs=n_jobs, return_as="generator")(
            delayed(attempt)(score, *arguments) for score, arguments in jobs
        )
        for key, result in zip(keys, results, strict=True):
            part = next(iter(key.items()))
            if not rows or part not in rows[-1].items():
                print(f"{path.stem}: {part[0]} {part[1]}, {len(rows)} of {len(jobs)} fits done", flush=True)
            rows.append(key | result)
            writer.writerow(rows[-1])
            file.flush()
    return rows


def run_made(tasks: list[str], methods: list[str], n_seeds: int, folder: Path, n_jobs: int) -> list[Row]:
    """Part (a): made data."""
    cells = [(task, seed, method) for task in tasks for seed in range(n_seeds) for method in methods]
    keys = [dict(zip(MADE[:3], cell, strict=True)) for cell in cells]
    return run([(score_task, cell) for cell in cells], keys, MADE, folder / "made.csv", n_jobs)


def run_recorded(
    recordings: list[Recording], methods: list[str], max_folds: int, folder: Path, n_jobs: int
) -> list[Row]:
    """Part (b): each demonstration of each recording left out, or ``max_folds`` of them, spread evenly."""
    jobs: list[Job] = []
    keys: list[Row] = []
    for recording in recordings:
        demos = np.unique(recording.groups)
        for at in np.linspace(0, len(demos) - 1, min(max_folds, len(demos))).round().astype(int):
            for method in methods:
                jobs.append((score_fold, (recording, demos[at], method)))
                keys.append({"set": recording.name, "fold": int(demos[at]), "method": method})
    return run(jobs, keys, RECORDED, folder / "recorded.csv", n_jobs)


def run_pen(recording: Recording, methods: list[str], folder: Path, n_jobs: int) -> list[Row]:
    """Part (c): few demonstrations of ``pen_a``."""
    cells = [(size, split, method) for size in PEN_SIZES for split in range(PEN_SPLITS) for method in methods]
    keys = [dict(zip(PEN[:3], cell, strict=True)) for cell in cells]
    return run([(score_pen, (recording, *cell)) for cell in cells], keys, PEN, folder / "pen.csv", n_jobs)


def read(folders: list[Path], name: str, n_keys: int) -> list[Row]:
    """Rows of CSV files that runs have written; one of a later folder replaces that of an earlier."""
    found: dict[tuple[str, ...], Row] = {}
    for path in (folder / name for folder in folders):
        if not path.is_file():
            continue
        with path.open(newline="", encoding="utf-8") as file:
            for row in csv.DictReader(file):
                texts = {*tuple(row)[:n_keys], "note"}
                numbers = {key: float(value) for key, value in row.items() if key not in texts and value}
                found[tuple(row.values())[:n_keys]] = {key: row[key] for key in row if key in texts} | numbers
    return list(found.values())


def recordings_of(folder: Path, sets: list[str] | None) -> list[Recording]:
    """Recordings of a folder; none, and a line that says so, where there is no such folder."""
    if sets == []:
        return []
    if not folder.is_dir():
        print(f"recordings are skipped: there is no folder {folder}.")
        return []
    return load_recordings(folder, sets)


def parse(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="*", choices=list(TASKS), default=list(TASKS), help="made data; none: skip")
    parser.add_argument("--sets", nargs="*", help="recordings, by the name of the file; none: skip; default: all")
    parser.add_argument("--methods", nargs="+", choices=list(METHODS), default=list(METHODS))
    parser.add_argument("--seeds", type=int, default=12, help="draws of each made task (default: 12)")
    parser.add_argument("--max-folds", type=int, default=15, help="demonstrations left out, a set (default: 15)")
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the recordings (default: %(default)s)")
    parser.add_argument("--jobs", type=int, default=1, help="fits at the same time, each on one thread (default: 1)")
    parser.add_argument(
        "--table-of",
        type=Path,
        nargs="+",
        help="run nothing: the table of what runs have written into these folders (of recordings: of --sets)",
    )
    parser.add_argument(
        "--since",
        type=Path,
        nargs="+",
        help="run nothing: what runs of another version, in these folders, and those of --table-of differ in",
    )
    parser.add_argument("--out", type=Path, default=Path("covariance_benchmark"), help="folder of what is written")
    return parser.parse_args(arguments)


def main(arguments: list[str] | None = None) -> None:
    options = parse(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    if options.since:
        parts = [
            [read(own, f"{name}.csv", 3) for name in ("made", "recorded")] for own in (options.since, options.table_of)
        ]
        for method in options.methods:
            print(f"\n{method}\n\n{changes(*parts, method)}")
        return
    if options.table_of:
        made, recorded, pen = (read(options.table_of, f"{name}.csv", 3) for name in ("made", "recorded", "pen"))
        if options.sets is not None:
            recorded = [row for row in recorded if row["set"] in options.sets]
        write_table(options.out, made, recorded, pen)
        return
    methods = available(options.methods)
    recordings = recordings_of(options.data, options.sets)
    made = run_made(options.tasks, methods, options.seeds, options.out, options.jobs) if options.tasks else []
    quick = [method for method in methods if not METHODS[method].made_data_only]
    recorded = run_recorded(recordings, quick, options.max_folds, options.out, options.jobs) if recordings else []
    pen = [row for r in recordings if r.name == "pen_a" for row in run_pen(r, quick, options.out, options.jobs)]
    write_table(options.out, made, recorded, pen)


def write_table(folder: Path, made: list[Row], recorded: list[Row], pen: list[Row]) -> None:
    """Write and print the tables."""
    text = report(made, recorded, pen)
    with replacing(folder / "table.md") as file:
        file.write(text.encode())
    print(f"\n{text}")


if __name__ == "__main__":
    main()

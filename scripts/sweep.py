"""Leave one demonstration out over files of demonstrations and models, here or on a dask cluster; prints one table.

``python scripts/sweep.py --data '[a.npz, b.csv]' --n_jobs -1``; with ``--cluster tcp://host:8786`` on the workers of
that scheduler, which need this package too. Models as for ``torch-pbd compare``. Needs the extra ``sweep`` for a
cluster only.

Everything runs through joblib, whose ``parallel_config`` says where. Every job has one thread, so that rows are the
same to the last bit however many run at a time, on equal processors. What else there is to compute many times, as
``simulate_many`` for several schedules and seeds, joblib runs as it is.
"""

import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import joblib
import numpy as np
import torch
from joblib import Parallel, delayed
from sklearn.base import clone
from threadpoolctl import threadpool_limits

from torch_pbd.cli.commands import OPTIONS as COMMANDS
from torch_pbd.cli.options import Option, parse
from torch_pbd.console import format_table, say
from torch_pbd.data import Demonstrations, load_demonstrations
from torch_pbd.estimators.base import CovarianceRegressor
from torch_pbd.exceptions import ConfigError
from torch_pbd.experiments.comparison import left_out, mean_and_error, prepare, score_fold

Row = dict[str, Any]

_COMPARE = COMMANDS["compare"]
OPTIONS = {
    "data": Option(list[str] | None, None, "files of demonstrations, .npz or .csv", required=True),
    "models": _COMPARE["models"]._replace(help="name: regressor, several; the first is the one to beat"),
    "cluster": Option(str | None, None, "address of a dask scheduler; none: processes here"),
    "n_jobs": _COMPARE["n_jobs"]._replace(help="jobs at the same time; -1: all cores; on a cluster, none: all"),
    "max_folds": Option(int | None, None, "demonstrations to leave out of each file; none: each of them"),
    "align": _COMPARE["align"],
    "n_steps": _COMPARE["n_steps"],
}


def sweep(
    estimators: Mapping[str, CovarianceRegressor],
    tasks: Mapping[str, Demonstrations],
    *,
    max_folds: int | None = None,
    n_jobs: int | None = None,
) -> list[Row]:
    """Leave one demonstration out, of every task, for every estimator: each is a job of its own.

    Rows are by task, estimator and fold, in this order: "task", "model", "fold" (the demonstration left out),
    "log_likelihood" (nats per sample), "coverage" (share of its samples in the 95 % ellipses), "fit_seconds" (of the
    processor), and "error": empty, or what the job failed with; its numbers are then NaN. Of a task some folds are left
    out, ``max_folds`` spread evenly over all, or each.
    """
    stacked = {name: task.stack() for name, task in tasks.items()}
    folds = {name: left_out(groups, max_folds) for name, (_, _, groups) in stacked.items()}
    for name, numbers in folds.items():
        if not len(numbers):
            raise ValueError(f"task {name!r} has one demonstration: to leave one out, record two or more.")
    jobs = [(task, model, int(fold)) for task in tasks for model in estimators for fold in folds[task]]
    calls = (delayed(_guarded)(clone(estimators[model]), *stacked[task], fold) for task, model, fold in jobs)
    results = Parallel(n_jobs=n_jobs)(calls)
    return [
        dict(zip(("task", "model", "fold"), job, strict=True)) | row for job, row in zip(jobs, results, strict=True)
    ]


def _guarded(*fold: Any) -> Row:
    with _one_thread():
        try:
            return score_fold(*fold) | {"error": ""}
        except Exception as error:  # of whatever kind: the other jobs of the campaign go on, and the row says it
            unknown = dict.fromkeys(("log_likelihood", "coverage", "fit_seconds"), np.nan)
            return unknown | {"error": f"{type(error).__name__}: {error}"}


@contextmanager
def _one_thread() -> Iterator[None]:
    """One thread for torch and the libraries under NumPy: sums of several have another order, and other last bits."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with threadpool_limits(1):
            yield
    finally:
        torch.set_num_threads(before)


def summarize(rows: Sequence[Row]) -> list[Row]:
    """One row for each task and model of a sweep: means over the folds with their standard errors.

    "against" is the mean difference of the log-likelihood to the first model, fold by fold, with its standard error:
    folds differ more than models do, and that does not count here.
    """
    table = []
    for task in dict.fromkeys(row["task"] for row in rows):
        folds: dict[str, list[Row]] = {}
        for row in rows:
            if row["task"] == task:
                folds.setdefault(row["model"], []).append(row)
        # Folds that failed are NaN, and left out of the means.
        values = {name: np.array([row["log_likelihood"] for row in own]) for name, own in folds.items()}
        first = next(iter(folds))
        for name, own in folds.items():
            mean, error = mean_and_error(values[name])
            ahead, ahead_error = mean_and_error(values[name] - values[first] if name != first else ())
            table.append(
                {
                    "task": task,
                    "model": name,
                    "held-out LL": mean,
                    "+-": error,
                    f"against {first}": ahead,
                    "+- ": ahead_error,
                    "95 % holds": mean_and_error([row["coverage"] for row in own])[0],
                    "folds": len(own),
                    "failed": sum(bool(row["error"]) for row in own),
                    "fit [s]": mean_and_error([row["fit_seconds"] for row in own])[0],
                }
            )
    return table


def main(arguments: list[str]) -> int:
    """Sweep and print."""
    try:
        options, _ = parse("python scripts/sweep.py", "leave one demonstration out, of every file", OPTIONS, arguments)
    except ConfigError as error:
        say(f"sweep.py: {error}", sys.stderr)
        return 2
    files = _names(options.data).items()
    tasks = {name: prepare(load_demonstrations(path), options.align, options.n_steps) for name, path in files}
    with _where(options.cluster):
        rows = sweep(options.models, tasks, max_folds=options.max_folds, n_jobs=options.n_jobs)
    print(format_table(summarize(rows)))
    for row in rows:
        if row["error"]:
            print(f"{row['task']}, {row['model']}, without demonstration {row['fold']}: {row['error']}")
    return 0


def _names(data: list[str]) -> dict[str, str]:
    """Each file by its name without folder and suffix; where several have the same one, by its path."""
    stems = [Path(path).stem for path in data]
    return {path if stems.count(stem) > 1 else stem: path for stem, path in zip(stems, data, strict=True)}


@contextmanager
def _where(cluster: str | None) -> Iterator[None]:
    if cluster is None:
        yield
        return
    from distributed import Client

    with Client(cluster), joblib.parallel_config("dask"):
        yield


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

"""Campaigns: many fits and many simulations, each by itself, on all cores of a machine or of a cluster.

Everything runs through joblib, whose ``parallel_config`` says where: processes here, or workers of dask.distributed::

    client = distributed.Client("tcp://scheduler:8786")
    with joblib.parallel_config("dask"):
        rows = sweep(estimators, tasks)

Every job has one thread, so that rows are the same to the last bit however many run at a time, on equal processors.
"""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import product
from typing import Any, Literal

import numpy as np
import torch
from joblib import Parallel, delayed
from numpy.typing import ArrayLike, NDArray
from sklearn.base import clone
from threadpoolctl import threadpool_limits

from torch_pbd.checks import Floats
from torch_pbd.control.schedule.schedule import Schedule
from torch_pbd.control.simulation.run import simulate_many
from torch_pbd.data import Demonstrations
from torch_pbd.estimators.base import CovarianceRegressor
from torch_pbd.experiments.resume import FinishedFits, fit_once
from torch_pbd.metrics import mahalanobis_coverage, negative_log_likelihood
from torch_pbd.movement import judge_movement

Row = dict[str, Any]


def sweep(
    estimators: Mapping[str, CovarianceRegressor],
    tasks: Mapping[str, Demonstrations],
    *,
    input: Literal["time", "phase"] = "time",
    max_folds: int | None = None,
    n_jobs: int | None = None,
) -> list[Row]:
    """Leave one demonstration out, of every task, for every estimator: each is a job of its own.

    Parameters
    ----------
    estimators : mapping of str to covariance regressor
        Cloned, not changed. Where one draws at random, give it a ``random_state``.
    tasks : mapping of str to Demonstrations
        Two demonstrations or more of each.
    input : {"time", "phase"}, default="time"
        What the covariance depends on.
    max_folds : int, default=None
        Largest number of demonstrations to leave out of a task, spread evenly over all; None is each.
    n_jobs : int, default=None
        Jobs at the same time, as in scikit-learn.

    Returns
    -------
    list of dict
        By task, estimator and fold, in this order: "task", "model", "fold" (the demonstration left out),
        "log_likelihood" (nats per sample), "coverage" (share of its samples in the 95 % ellipses), "fit_seconds" (of
        the processor), and "error": empty, or what the job failed with; its numbers are then NaN.

    Raises
    ------
    ValueError
        If a task has one demonstration only.
    """
    stacked = {name: task.stack(input) for name, task in tasks.items()}
    folds = {name: left_out(groups, max_folds) for name, (_, _, groups) in stacked.items()}
    for name, numbers in folds.items():
        if not len(numbers):
            raise ValueError(f"task {name!r} has one demonstration: to leave one out, record two or more.")
    jobs = [(task, model, int(fold)) for task in tasks for model in estimators for fold in folds[task]]
    labels = [dict(zip(("task", "model", "fold"), job, strict=True)) for job in jobs]
    calls = [(clone(estimators[model]), *stacked[task], fold) for task, model, fold in jobs]
    return _run(score_fold, labels, calls, n_jobs, dict.fromkeys(("log_likelihood", "coverage", "fit_seconds"), np.nan))


def push_campaign(
    schedules: Mapping[str, Schedule], seeds: Sequence[int], *, n_jobs: int | None = None, **options: Any
) -> list[Row]:
    """Random pushes on several schedules, with several seeds: each a job of its own.

    Parameters
    ----------
    schedules : mapping of str to Schedule
    seeds : sequence of int
        Of each schedule's pushes.
    n_jobs : int, default=None
        Jobs at the same time, as in scikit-learn.
    **options
        Of :func:`~torch_pbd.control.simulate_many`.

    Returns
    -------
    list of dict
        By schedule and seed: "schedule", "seed", "summary" (a RolloutSummary, None if the job failed) and "error".
    """
    jobs = list(product(schedules, seeds))
    labels = [{"schedule": name, "seed": seed} for name, seed in jobs]
    calls = [(schedules[name], options | {"random_state": seed}) for name, seed in jobs]
    return _run(_pushed, labels, calls, n_jobs, {"summary": None})


def left_out(groups: NDArray[np.intp], max_folds: int | None = None) -> NDArray[np.intp]:
    """Demonstrations to leave out, one by one: all, or some of them spread evenly; none where there is one only."""
    demos = np.unique(groups)
    n_folds = len(demos) if max_folds is None else min(max_folds, len(demos))
    if len(demos) < 2 or n_folds < 1:
        return demos[:0]
    return demos[np.unique(np.linspace(0, len(demos) - 1, n_folds).round().astype(int))]


def score_fold(
    model: CovarianceRegressor,
    X: Floats,
    y: Floats,
    groups: NDArray[np.intp],
    demonstration: int,
    finished: FinishedFits | None = None,
    *,
    whole: bool = False,
) -> dict[str, float]:
    """Fit without a demonstration, and score how well its rows are predicted, and if asked for it as a whole."""
    left = groups == demonstration
    # Of this thread: what else runs on the machine does not count.
    start = time.thread_time()
    model, _ = fit_once(model, X[~left], y[~left], groups[~left], finished=finished)
    seconds = time.thread_time() - start
    mean, covariance = model.predict(X[left], return_cov=True)
    coverage = mahalanobis_coverage(mean.reshape(len(mean), -1), covariance, y[left], level=0.95)
    # The score of a model of movements is that of the whole: here its rows are compared with those of regressors.
    is_movement = hasattr(model, "score_demonstrations")
    likelihood = -negative_log_likelihood(model, X[left], y[left]) if is_movement else model.score(X[left], y[left])
    row = {"log_likelihood": likelihood, "coverage": float(coverage), "fit_seconds": seconds}
    return row | judge_movement(model, X[left], y[left]) if whole else row


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


def mean_and_error(values: ArrayLike) -> tuple[float, float]:
    """Mean over the folds that have a result, and its standard error; NaN where those are too few."""
    known = np.asarray(values, dtype=float)
    known = known[~np.isnan(known)]
    mean = float(known.mean()) if len(known) else np.nan
    return mean, float(known.std(ddof=1) / len(known) ** 0.5) if len(known) > 1 else np.nan


def _pushed(schedule: Schedule, options: Mapping[str, Any]) -> Row:
    return {"summary": simulate_many(schedule, **options)}


def _run(
    function: Callable[..., Row], labels: Sequence[Row], calls: Sequence[tuple[Any, ...]], n_jobs: int | None, none: Row
) -> list[Row]:
    """Rows of labels and what the calls gave, or ``none`` and the error where one failed."""
    pairs = zip(labels, calls, strict=True)
    results = Parallel(n_jobs=n_jobs)(delayed(_guarded)(function, arguments, none) for _, arguments in pairs)
    return [label | result for label, result in zip(labels, results, strict=True)]


def _guarded(function: Callable[..., Row], arguments: tuple[Any, ...], none: Row) -> Row:
    with _one_thread():
        try:
            return function(*arguments) | {"error": ""}
        except Exception as error:  # of whatever kind: the other jobs of the campaign go on, and the row says it
            return none | {"error": f"{type(error).__name__}: {error}"}


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

"""Fits on random problems, and the table of what they keep."""

import warnings
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from joblib import Parallel, delayed
from sklearn.base import clone

from reliability.candidates import CANDIDATES, candidate, fit_candidate
from reliability.measures import (
    Discrepancy,
    Floats,
    Smallest,
    of_origin,
    of_units,
    queries,
    smallest_eigenvalues,
)
from reliability.problems import Recipe, random_recipe
from torch_pbd.estimators.base import CovarianceRegressor
from torch_pbd.exceptions import NotPositiveDefiniteError

LAWS = ("units", "origin", "unix_time")
SHARE = {"cholesky": 3, "wishart": 3, "mixture": 2, "heteroscedastic": 2}
"""Of each ten fits."""
_STEPS, _OUTPUTS = 20, 4
_UNIX_TIME = 1.7e9 / 14.0  # s, of a recording of 14 s
_EVERY = 10  # of so many tens of fits one is made again in other units, and from another origin


@dataclass(frozen=True)
class Measured:
    """One fit: what its covariances are at many inputs, or why there is none."""

    name: str
    seed: int
    problem: str = ""
    failed: bool = False
    smallest: Smallest | None = None
    n_not_finite: int = 0
    units: Discrepancy | None = None
    """Of fits that converged, as all discrepancies."""
    origin: Discrepancy | None = None
    """A million ranges away."""
    unix_time: Discrepancy | None = None
    """With 1.7e9 s before 14 s."""


def measure(name: str, seed: int, n_inputs: int) -> Measured:
    """Fit variant ``seed`` of an estimator to the problem of that seed."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the tests look at them
        recipe = random_recipe(seed, most_steps=_STEPS, most_outputs=_OUTPUTS)
        X, y, groups = recipe.data()
        estimator = candidate(name, seed, X)
        try:
            model = fit_candidate(clone(estimator), X, y, groups)
            x = queries(X, n_inputs, seed)
            mean, covariance = model.predict(x, return_cov=True)
        except Exception as error:
            own = isinstance(error, ValueError) and not isinstance(error, NotPositiveDefiniteError)
            return Measured(name, seed, str(error), failed=not own)
        finite = np.isfinite(mean.reshape(len(x), -1)).all(axis=1) & np.isfinite(covariance).all(axis=(1, 2))
        smallest = smallest_eigenvalues(covariance[finite], model.module_.y_scale.numpy())
        measured = Measured(name, seed, smallest=smallest, n_not_finite=int((~finite).sum()))
        return _again(measured, recipe) if seed // 10 % _EVERY == 0 else measured


def _again(measured: Measured, recipe: Recipe) -> Measured:
    """The same with plain numbers, as which equal ones in other units exist."""
    X, y, groups = recipe.plain().data()

    def fit(inputs: Floats, targets: Floats) -> CovarianceRegressor:
        return fit_candidate(candidate(measured.name, measured.seed, inputs), inputs, targets, groups)

    try:
        units, origin, unix_time = (
            found if converged else None
            for found, converged in (
                of_units(fit, X, y, measured.seed),
                of_origin(fit, X, y, measured.seed),
                of_origin(fit, X, y, measured.seed, ranges=_UNIX_TIME),
            )
        )
    except Exception as error:  # that there was a fit in other units makes any error one of ours
        return replace(measured, problem=str(error), failed=True)
    return replace(measured, units=units, origin=origin, unix_time=unix_time)


def measure_all(n_fits: int, n_inputs: int, *, seed: int = 0, n_jobs: int = 1) -> list[Measured]:
    """As many fits in all, shared among the estimators; seeds count up from ``seed``."""
    names = [name for name, share in SHARE.items() for _ in range(share)]
    jobs = [(names[i % len(names)], seed + i) for i in range(n_fits)]
    return list(Parallel(n_jobs=n_jobs)(delayed(measure)(name, number, n_inputs) for name, number in jobs))


def table(results: Sequence[Measured]) -> list[dict[str, str]]:
    """A row for each estimator, and one for all: the worst of each measure, and the seed it was at."""
    names = [name for name in CANDIDATES if any(result.name == name for result in results)]
    rows = [_row(name, [result for result in results if result.name == name]) for name in names]
    return [*rows, _row("all", results)]


def told(results: Sequence[Measured]) -> list[str]:
    """What refused fits said, and all that failed without saying it in our words."""
    refused = Counter(
        " ".join(result.problem.split()[:4]) for result in results if result.problem and not result.failed
    )
    lines = [f"{count} refused: {problem} ..." for problem, count in refused.most_common()]
    return lines + [f"FAILED: {r.name}, seed {r.seed}: {r.problem}" for r in results if r.failed]


def _row(name: str, results: Sequence[Measured]) -> dict[str, str]:
    fitted = [result for result in results if result.smallest is not None]
    row = {
        "estimator": name,
        "fits": str(len(fitted)),
        "refused": str(sum(bool(result.problem) and not result.failed for result in results)),
        "failed": str(sum(result.failed for result in results)),
        "not finite": str(sum(result.n_not_finite for result in fitted)),
    }
    for label, key in (("of correlation", "of_correlation"), ("of standardized", "of_standardized")):
        values = [(getattr(result.smallest, key), result.seed) for result in fitted]
        row[f"eig {label} (seed)"] = _shown(min(values)) if values else "-"
    for law in LAWS:
        of_law = [(getattr(result, law), result.seed) for result in fitted if getattr(result, law) is not None]
        row[f"{law}: mean (seed)"] = _shown(max((d.mean, seed) for d, seed in of_law)) if of_law else "-"
        row[f"{law}: covariance (seed)"] = _shown(max((d.covariance, seed) for d, seed in of_law)) if of_law else "-"
    return row


def _shown(worst: tuple[float, int]) -> str:
    return f"{worst[0]:.1e} ({worst[1]})"

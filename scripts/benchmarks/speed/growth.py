"""How costs grow: times at rising sizes, and the exponent of the upper half of them."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from speed.made import demonstrations
from speed.rollouts import pushed
from speed.rows import Findings, Growth, Plan
from speed.timing import alternate, median
from torch_pbd import CholeskyCovRegressor, HeteroscedasticGPRegressor
from torch_pbd.estimators.base import CovarianceRegressor

# Name of a size, what it is called in `demonstrations`, and its values; else 20 inputs, 10 draws, d = 2, e = 1.
_SIZES: list[tuple[str, str, list[int]]] = [
    ("T, inputs", "n_inputs", [10, 20, 50, 100, 200, 500, 1000, 2000]),
    ("K, demonstrations", "n_demos", [5, 10, 50, 100, 500, 1000, 5000]),
    ("d, outputs", "n_outputs", [1, 2, 3, 5, 7, 10]),
    ("e, features", "n_features", [1, 2, 3, 5, 7]),
]
_MODELS: dict[str, Callable[[], CovarianceRegressor]] = {
    "CD": CholeskyCovRegressor,
    "HGP": HeteroscedasticGPRegressor,
}


def exponent(sizes: Sequence[int], seconds: Sequence[float]) -> float:
    """Slope of the logarithm of times over that of sizes, by least squares, on the upper half of the sizes."""
    half = max(2, (len(sizes) + 1) // 2)
    slope, _ = np.polyfit(np.log(sizes[-half:]), np.log(seconds[-half:]), 1)
    return float(slope)


def measure(plan: Plan) -> Findings:
    """Of fits of CD and HGP, and of rollouts."""
    findings = Findings("growth")
    for axis, argument, sizes in _SIZES[: plan.size(4, 1)]:
        for name, model in _MODELS.items():
            findings.growth.append(_fits(plan, name, model, axis, argument, sizes[: plan.size(len(sizes), 2)]))
    sizes = [1, 10, 100, 1000, 10_000, 100_000][: plan.size(6, 2)]
    seconds = [alternate({"ours": lambda n=n: pushed(n)}, min(3, plan.n_repetitions))["ours"] for n in sizes]
    findings.growth.append(_growth("simulate_many", "rollouts of 1001 ticks", sizes, seconds))
    return findings


def _fits(
    plan: Plan, name: str, model: Callable[[], CovarianceRegressor], axis: str, argument: str, sizes: list[int]
) -> Growth:
    seconds = []
    for size in sizes:
        shape: dict[str, Any] = {
            "n_inputs": 20,
            "n_demos": 20 if argument == "n_outputs" else 10,
            "n_outputs": 2,
            "n_features": 1,
        }
        X, y = demonstrations(**shape | {argument: size, "seed": plan.seed})
        seconds.append(
            alternate({"ours": lambda X=X, y=y: model().fit(X, y)}, min(3, plan.n_repetitions), warm_up=False)["ours"]
        )
    return _growth(f"fit of {name}", axis, sizes, seconds)


def _growth(what: str, axis: str, sizes: list[int], seconds: list[list[float]]) -> Growth:
    return Growth(what, axis, sizes, seconds, exponent(sizes, [median(times) for times in seconds]))

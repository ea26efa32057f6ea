"""The contenders of covariance.py by name."""

from collections.abc import Callable
from importlib.util import find_spec
from typing import Any, NamedTuple, Self

from covariance_libraries import (
    GmrMixture,
    GPyTorchFactors,
    HetGP,
    MixtureRegression,
    MovementPrimitive,
    SklearnFactors,
    VariationalFactors,
)
from covariance_peers import ConstantCovariance, Floats, Groups, KernelSmoother, StudentReference

import torch_pbd


class Ours:
    """An estimator of torch_pbd with its defaults, behind the interface of the peers."""

    def __init__(self, estimator: Any, gaussian: bool) -> None:
        self.estimator = estimator
        self.gaussian = gaussian

    def fit(self, X: Floats, y: Floats, groups: Groups | None = None) -> Self:
        """Fit with the defaults."""
        self.estimator.fit(X, y, groups=groups)
        return self

    def predict(self, X: Floats) -> tuple[Floats, Floats]:
        """Mean (m, d) and covariance (m, d, d)."""
        return self.estimator.predict(X, return_cov=True)

    def log_likelihood(self, X: Floats, y: Floats) -> Floats:
        """Log density of each row of y, in nats."""
        return self.estimator.log_likelihood(X, y)


class Method(NamedTuple):
    """How to make a contender, and what it needs."""

    make: Callable[[], Any]
    package: str | None = None
    """Module that must be there."""
    made_data_only: bool = False
    """Too slow for every fold of every recording."""


def _ours(name: str, gaussian: bool = True) -> Method:
    return Method(lambda: Ours(getattr(torch_pbd, name)(), gaussian))


METHODS: dict[str, Method] = {
    "CholeskyCovRegressor": _ours("CholeskyCovRegressor"),
    "WishartProcessRegressor": _ours("WishartProcessRegressor"),
    "GMMBaseline": _ours("GMMBaseline"),
    "constant": Method(ConstantCovariance),
    "smoother": Method(KernelSmoother),
    "reference": Method(StudentReference),
    "sklearn GMR 5": Method(lambda: MixtureRegression(5)),
    "sklearn GMR 8": Method(lambda: MixtureRegression(8)),
    "gmr 8": Method(lambda: GmrMixture(8), "gmr"),
    "gmr 8 as a mixture": Method(lambda: GmrMixture(8, own_density=True), "gmr"),
    "sklearn GP factors": Method(SklearnFactors),
    "gpytorch GP factors": Method(GPyTorchFactors, "gpytorch"),
    "ProMP": Method(MovementPrimitive, "movement_primitives"),
    "hetgpy": Method(HetGP, "hetgpy"),
    "gpytorch SVGP": Method(VariationalFactors, "gpytorch", made_data_only=True),
}
if hasattr(torch_pbd, "HeteroscedasticGPRegressor"):  # its density is a Student-t
    METHODS = {"HeteroscedasticGPRegressor": _ours("HeteroscedasticGPRegressor", gaussian=False)} | METHODS


def available(names: list[str]) -> list[str]:
    """Those of ``names`` whose package is installed; says so of the others."""
    kept = []
    for name in names:
        package = METHODS[name].package
        if package is None or find_spec(package) is not None:
            kept.append(name)
        else:
            print(f"{name} is skipped: the package {package} is not installed.")
    return kept

"""Learning input-dependent covariance, how precise people are at each point, from demonstrations."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from torch_pbd.registry import ESTIMATORS

if TYPE_CHECKING:
    from torch_pbd.control.controller import DMPController as DMPController
    from torch_pbd.data import Demonstrations as Demonstrations
    from torch_pbd.data import load_demonstrations as load_demonstrations
    from torch_pbd.data import save_demonstrations as save_demonstrations
    from torch_pbd.estimators.cholesky import CholeskyCovRegressor as CholeskyCovRegressor
    from torch_pbd.estimators.heteroscedastic import HeteroscedasticGPRegressor as HeteroscedasticGPRegressor
    from torch_pbd.estimators.mixture import GMMBaseline as GMMBaseline
    from torch_pbd.estimators.wishart import WishartProcessRegressor as WishartProcessRegressor
    from torch_pbd.movement import KMPBaseline as KMPBaseline
    from torch_pbd.movement import ProMPBaseline as ProMPBaseline
    from torch_pbd.movement import TrajectoryRegressor as TrajectoryRegressor
    from torch_pbd.persistence import load as load
    from torch_pbd.persistence import save as save

__version__ = "0.1.0"

# Where each public name lives: torch and scikit-learn take seconds to import, so they wait for their first use.
_HOMES = {
    **ESTIMATORS,
    "Demonstrations": "torch_pbd.data",
    "load_demonstrations": "torch_pbd.data",
    "save_demonstrations": "torch_pbd.data",
    "load": "torch_pbd.persistence",
    "save": "torch_pbd.persistence",
}

__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(import_module(_HOMES[name]), name)
    if name in _modules():
        return import_module(f"torch_pbd.{name}")
    raise AttributeError(f"module 'torch_pbd' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOMES, *_modules()})


def _modules() -> list[str]:
    from pkgutil import iter_modules  # here: it takes a third of the time of all else

    return [module.name for module in iter_modules(__path__)]

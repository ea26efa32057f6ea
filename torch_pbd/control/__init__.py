"""From covariance to control: movement primitives, variable stiffness, simulation and stability."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torch_pbd.control.controller import DMPController as DMPController
    from torch_pbd.control.filters import EnergyTank as EnergyTank
    from torch_pbd.control.filters import RateLimit as RateLimit
    from torch_pbd.control.matrices import damping_from_stiffness as damping_from_stiffness
    from torch_pbd.control.matrices import required_damping_ratio as required_damping_ratio
    from torch_pbd.control.planning import MotionLimits as MotionLimits
    from torch_pbd.control.primitive.dmp import DMP as DMP
    from torch_pbd.control.realtime import RealTimeAdmittance as RealTimeAdmittance
    from torch_pbd.control.realtime import TickStatus as TickStatus
    from torch_pbd.control.schedule.schedule import Schedule as Schedule
    from torch_pbd.control.simulation.plant import AdmittancePlant as AdmittancePlant
    from torch_pbd.control.simulation.rollout import Rollout as Rollout
    from torch_pbd.control.simulation.rollouts import RolloutSummary as RolloutSummary
    from torch_pbd.control.simulation.run import simulate as simulate
    from torch_pbd.control.simulation.run import simulate_many as simulate_many
    from torch_pbd.control.simulation.sensor import ForceSensor as ForceSensor
    from torch_pbd.control.simulation.sensor import PositionLoop as PositionLoop
    from torch_pbd.control.simulation.walls import Tunnel as Tunnel
    from torch_pbd.control.stability.certify import certify as certify
    from torch_pbd.control.stability.report import StabilityReport as StabilityReport
    from torch_pbd.control.stiffness import RotationLimits as RotationLimits
    from torch_pbd.control.stiffness import StiffnessLaw as StiffnessLaw
    from torch_pbd.control.stiffness import lqt as lqt

# What each module has for users: the controller of the control loop must load without torch.
_MODULES = {
    "controller": ["DMPController"],
    "filters": ["EnergyTank", "RateLimit"],
    "matrices": ["damping_from_stiffness", "required_damping_ratio"],
    "planning": ["MotionLimits"],
    "primitive.dmp": ["DMP"],
    "realtime": ["RealTimeAdmittance", "TickStatus"],
    "schedule": ["Schedule"],
    "simulation.plant": ["AdmittancePlant"],
    "simulation.rollout": ["Rollout"],
    "simulation.rollouts": ["RolloutSummary"],
    "simulation.run": ["simulate", "simulate_many"],
    "simulation.sensor": ["ForceSensor", "PositionLoop"],
    "simulation.walls": ["Tunnel"],
    "stability.certify": ["certify"],
    "stability.report": ["StabilityReport"],
    "stiffness": ["RotationLimits", "StiffnessLaw", "lqt"],
}
_HOMES = {name: module for module, names in _MODULES.items() for name in names}

__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(import_module(f"torch_pbd.control.{_HOMES[name]}"), name)
    raise AttributeError(f"module 'torch_pbd.control' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOMES])

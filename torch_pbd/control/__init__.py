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

# Where each name lives: the controller of the control loop must load without torch.
_HOMES = {
    "AdmittancePlant": "simulation.plant",
    "DMP": "primitive.dmp",
    "DMPController": "controller",
    "EnergyTank": "filters",
    "ForceSensor": "simulation.sensor",
    "MotionLimits": "planning",
    "PositionLoop": "simulation.sensor",
    "RateLimit": "filters",
    "RealTimeAdmittance": "realtime",
    "Rollout": "simulation.rollout",
    "RolloutSummary": "simulation.rollouts",
    "RotationLimits": "stiffness",
    "Schedule": "schedule",
    "StabilityReport": "stability.report",
    "StiffnessLaw": "stiffness",
    "TickStatus": "realtime",
    "Tunnel": "simulation.walls",
    "certify": "stability.certify",
    "damping_from_stiffness": "matrices",
    "lqt": "stiffness",
    "required_damping_ratio": "matrices",
    "simulate": "simulation.run",
    "simulate_many": "simulation.run",
}

__all__ = [*_HOMES]


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(import_module(f"torch_pbd.control.{_HOMES[name]}"), name)
    raise AttributeError(f"module 'torch_pbd.control' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOMES])

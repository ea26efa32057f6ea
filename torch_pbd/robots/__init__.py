"""Schedules on arms: their inertia, a simulated one, and adapters to the interfaces of real ones.

One module for each robot, none of which is imported before it is asked for: ``franky``, ``mujoco``, ``robosuite``,
``ros`` and ``ur_rtde``. They need NumPy and the robot's own library, not torch.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torch_pbd.robots.franka_panda import panda, panda_mjcf
    from torch_pbd.robots.kinematics import inverse_kinematics, operational_inertia
    from torch_pbd.robots.mujoco import ArmRun
    from torch_pbd.robots.session import RobotLimits, RobotRun, RobotStoppedError

# Where each name lives.
_HOMES = {
    "HOME": "franka_panda",
    "ArmRun": "mujoco",
    "RobotStoppedError": "session",
    "RobotLimits": "session",
    "RobotRun": "session",
    "inverse_kinematics": "kinematics",
    "operational_inertia": "kinematics",
    "panda": "franka_panda",
    "panda_mjcf": "franka_panda",
}
_MODULES = ("franky", "mujoco", "robosuite", "ros", "ur_rtde")

__all__ = [
    "ArmRun",
    "RobotLimits",
    "RobotRun",
    "RobotStoppedError",
    "inverse_kinematics",
    "operational_inertia",
    "panda",
    "panda_mjcf",
]


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(import_module(f"torch_pbd.robots.{_HOMES[name]}"), name)
    if name in _MODULES:
        return import_module(f"torch_pbd.robots.{name}")
    raise AttributeError(f"module 'torch_pbd.robots' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOMES, *_MODULES])

"""Schedules on robot arms: inertia, a simulated arm, and adapters to interfaces of real ones.

There is one module per interface: ``franky``, ``mujoco``, ``robosuite``, ``ros`` and ``ur_rtde``. They need NumPy, and
the robot's own library when used, but not torch.
"""

from torch_pbd.robots import franky as franky
from torch_pbd.robots import mujoco as mujoco
from torch_pbd.robots import robosuite as robosuite
from torch_pbd.robots import ros as ros
from torch_pbd.robots import ur_rtde as ur_rtde
from torch_pbd.robots.kinematics import inverse_kinematics, operational_inertia
from torch_pbd.robots.mujoco import HOME as HOME
from torch_pbd.robots.mujoco import panda, panda_mjcf
from torch_pbd.robots.session import RobotLimits, RobotRun, RobotStoppedError

__all__ = [
    "RobotLimits",
    "RobotRun",
    "RobotStoppedError",
    "inverse_kinematics",
    "operational_inertia",
    "panda",
    "panda_mjcf",
]

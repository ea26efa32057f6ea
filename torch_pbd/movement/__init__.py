"""Whole movements: the joint law of a demonstration, drawn from, judged by, and conditioned."""

from torch_pbd.movement.kmp import KMPBaseline
from torch_pbd.movement.promp import ProMPBaseline
from torch_pbd.movement.trajectory import TrajectoryRegressor

__all__ = [
    "KMPBaseline",
    "ProMPBaseline",
    "TrajectoryRegressor",
]

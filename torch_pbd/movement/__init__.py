"""Models of whole movements: the joint law of a demonstration, for draws, scores and conditioning."""

from torch_pbd.movement.kmp import KMPBaseline
from torch_pbd.movement.promp import ProMPBaseline
from torch_pbd.movement.trajectory import TrajectoryRegressor

__all__ = ["KMPBaseline", "ProMPBaseline", "TrajectoryRegressor"]

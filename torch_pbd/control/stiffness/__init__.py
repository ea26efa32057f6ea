"""Stiffness from covariance: the law of the paper, that of minimal intervention, and their limits for each block."""

from torch_pbd.control.stiffness.law import StiffnessLaw
from torch_pbd.control.stiffness.limits import RotationLimits
from torch_pbd.control.stiffness.precision import lqt

__all__ = ["RotationLimits", "StiffnessLaw", "lqt"]

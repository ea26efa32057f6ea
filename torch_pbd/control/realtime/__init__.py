"""The controller inside a robot's 1 kHz loop: no torch, nothing that grows."""

from torch_pbd.control.realtime.admittance import RealTimeAdmittance
from torch_pbd.control.realtime.limits import TickStatus

__all__ = ["RealTimeAdmittance", "TickStatus"]

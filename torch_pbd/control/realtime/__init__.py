"""Controller for a robot's 1 kHz loop, without torch and with constant memory."""

from torch_pbd.control.realtime.admittance import RealTimeAdmittance
from torch_pbd.control.realtime.limits import TickStatus

__all__ = ["RealTimeAdmittance", "TickStatus"]

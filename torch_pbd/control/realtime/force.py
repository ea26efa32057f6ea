"""The force channel: a measured force less its bias, within the sensor's range, and bridged where it is lost."""

import math
from collections import deque
from collections.abc import Sequence
from typing import final

from torch_pbd import checks
from torch_pbd.control.realtime.limits import FINE, TickStatus
from torch_pbd.control.realtime.steps import Vector

# A median of five is a good force after one or two wild ones, and 2 ms late at 1 kHz.
_RECENT = 5


@final
class ForceChannel:
    """The force that acts, per kg of virtual mass; options as `RealTimeAdmittance` takes them.

    A lost force is replaced by the median of the last good ones, on each axis, which fades to nothing over
    ``hold_ticks``: neither a wild reading before the loss nor an old push can carry the robot away. After more ticks
    than that, it ``is_lost``.
    """

    def __init__(
        self, mass: float, force_limit: float, deadband: float, force_rate_limit: float | None, hold_ticks: int
    ) -> None:
        self._mass = mass
        self._limit = checks.number(force_limit, "force_limit", above=0.0, unit="N") / mass
        self._deadband = checks.number(deadband, "deadband", least=0.0, unit="N") / mass
        rate = checks.number(force_rate_limit, "force_rate_limit", above=0.0, unit="N/s", optional=True)
        self._rate_limit = math.inf if rate is None else rate / mass
        self._hold_ticks = checks.count(hold_ticks, "hold_ticks", least=0)
        self.begin(0, ())

    def begin(self, d: int, bias: Vector) -> None:
        """Forget all forces; before the first there was none."""
        self.push: Vector = (0.0,) * d
        self._bias, self._n_lost, self.is_lost = bias, 0, False
        self._recent = deque([self.push] * _RECENT, _RECENT)

    def take(self, force: Sequence[float] | checks.Floats, step: float) -> TickStatus:
        """Let a force as measured act, as far as it may, ``step`` s after the last one."""
        try:
            mass = self._mass
            if self._bias:
                push = tuple([(float(part) - bias) / mass for part, bias in zip(force, self._bias, strict=True)])
            else:
                push = tuple([float(part) / mass for part in force])
        except (TypeError, ValueError, OverflowError):
            push = ()
        if len(push) != len(self.push):
            raise checks.refusal(force, "force", f"{len(self.push)} numbers in N")
        if self._deadband:
            push = tuple([part - max(-self._deadband, min(self._deadband, part)) for part in push])
        length, status = math.hypot(*push), FINE
        if not length <= self._limit:
            if not length < math.inf:
                self._bridge()
                return TickStatus.FORCE_INVALID
            push, status = tuple([part / length * self._limit for part in push]), TickStatus.FORCE_SATURATED
        if self._rate_limit < math.inf:
            change, most = math.dist(push, self.push), self._rate_limit * step
            if change > most:
                push = tuple([old + most / change * (new - old) for old, new in zip(self.push, push, strict=True)])
                status |= TickStatus.FORCE_RATE_LIMITED
        self.push, self._n_lost = push, 0
        self._recent.append(push)
        return status

    def _bridge(self) -> None:
        self._n_lost += 1
        self.is_lost = self._n_lost > self._hold_ticks
        share = max(0.0, 1.0 - self._n_lost / (self._hold_ticks + 1))
        self.push = tuple([share * sorted(parts)[_RECENT // 2] for parts in zip(*self._recent, strict=True)])

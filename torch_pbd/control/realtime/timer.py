"""The clock of the loop: how long a tick took, where the clock says so."""

import math
from typing import final

from torch_pbd import checks
from torch_pbd.control.realtime.limits import FINE, TickStatus

# A reading must tell ticks apart to 1 %: times since 1970 in s do, in ns they do not.
_COARSE = 0.01
# One late tick is a stall, two may be; three on end are a loop that is too slow.
_LATE_ON_END = 3
# Share of the newest tick in how long a tick lasts: neither one short tick nor one long counts for much.
SMOOTHING = 0.1


@final
class TickTimer:
    """Ticks of at most ``max_step`` s; ``last`` is until when the motion is known, ``step`` how long ticks last."""

    def __init__(self, rate: float, max_step: float, max_bad_ticks: int) -> None:
        self._rate = checks.number(rate, "rate", above=0.0, unit="1/s")
        self.max_step = checks.number(max_step, "max_step", above=1.0 / self._rate, unit="s", remedy="give some ticks")
        self._max_bad_ticks = checks.count(max_bad_ticks, "max_bad_ticks")
        self.begin(math.nan)

    def begin(self, now: float) -> None:
        """Count from ``now``."""
        if math.ulp(now) * self._rate > _COARSE:
            must = f"small enough to tell ticks of {1.0 / self._rate:g} s apart"
            raise checks.refusal(now, "now", must, "give seconds", unit="s")
        self.last = self._newest = now
        self.step = 1.0 / self._rate
        self.is_regular, self._is_new = False, True
        self._n_bad = self._n_late = 0

    @property
    def is_failed(self) -> bool:
        """True if bad or late ticks are too many on end for the robot to go on."""
        return self._n_bad >= self._max_bad_ticks or self._n_late >= _LATE_ON_END

    def read(self, now: float) -> tuple[TickStatus, float]:
        """Fault of a tick that is not like the last one, and the time by which ``last`` was put forward.

        Where the clock does not say how long a tick took, it is taken to be as long as they are.
        """
        if math.isnan(self.last):
            raise RuntimeError("tick before start: call start(now) with the time of the same clock first.")
        if self.is_regular:
            self.is_regular, self._newest = False, self.last
        if not self._newest < now < math.inf:
            self._n_bad += 1
            return TickStatus.CLOCK, 0.0
        shift = 0.0
        # The clock has lost what bad ticks have lived through.
        if self._n_bad and now < self.last + 0.5 * self.step:
            shift, self.last = now - self.step - self.last, now - self.step
        self._newest, self._n_bad, step = now, 0, now - self.last
        if step > self.max_step:
            self._n_late += 1
            if self._is_new and self._n_late >= _LATE_ON_END:
                must = f"longer than a tick: all {self._n_late} since start were longer, the last of {step:.4g} s"
                raise checks.refusal(self.max_step, "max_step", must, "give some ticks, and times in s", unit="s")
            return TickStatus.LATE, shift
        self.is_regular, self._is_new, self._n_late = True, False, 0
        return FINE, shift

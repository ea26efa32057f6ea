"""What the readings of the loop's clock mean: how long a tick lasted, and whether it can be believed."""

import math
from typing import final

from torch_pbd.control.realtime.checks import number, whole
from torch_pbd.control.realtime.status import TickStatus

_COARSE = 0.01  # of a tick, to which a time must be told
_LATE_ON_END = 3  # ticks that are no stall any more
SMOOTHING = 0.1  # of how long a tick lasts: neither one short tick nor one long counts for much


@final
class TickTimer:
    """Ticks of at most ``max_step`` s; ``last`` is until when the motion is known, ``step`` how long ticks last."""

    def __init__(self, rate: float, max_step: float, max_bad_ticks: int) -> None:
        self._rate = number("rate", rate, "1/s")
        self.max_step = number("max_step", max_step, "s")
        if self.max_step * self._rate <= 1.0:
            raise ValueError(f"max_step={max_step} s is no longer than a tick at rate={rate}: raise it, to some ticks.")
        self._max_bad_ticks = whole("max_bad_ticks", max_bad_ticks, 1)
        self.begin(math.nan)

    def begin(self, now: float) -> None:
        """Count from ``now``."""
        if math.ulp(now) * self._rate > _COARSE:
            raise ValueError(f"now={now!r} leaves no digits for ticks of {1.0 / self._rate:g} s: give seconds.")
        self.last = self._newest = now
        self.step = 1.0 / self._rate
        self.is_regular, self._is_new = False, True
        self._n_bad = self._n_late = 0

    @property
    def is_failed(self) -> bool:
        """Whether bad or late ticks are too many on end for the robot to go on."""
        return self._n_bad >= self._max_bad_ticks or self._n_late >= _LATE_ON_END

    def read(self, now: float) -> tuple[TickStatus, float]:
        """What is wrong in a tick that is not like the last one, and the time by which ``last`` was put forward.

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
        if self._n_bad and now < self.last + 0.5 * self.step:  # the clock has lost what bad ticks have lived through
            shift, self.last = now - self.step - self.last, now - self.step
        self._newest, self._n_bad, step = now, 0, now - self.last
        if step > self.max_step:
            self._n_late += 1
            if self._is_new and self._n_late >= _LATE_ON_END:
                raise ValueError(
                    f"max_step={self.max_step:g} s is shorter than all {self._n_late} ticks since start, the last of "
                    f"{step:.4g} s: give a max_step of some ticks of your loop, and times in s."
                )
            return TickStatus.LATE, shift
        self.is_regular, self._is_new, self._n_late = True, False, 0
        return TickStatus(0), shift

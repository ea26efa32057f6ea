"""Report on the stability of a schedule, as made by :func:`certify`."""

import math
from dataclasses import dataclass
from textwrap import fill
from typing import final

# Gain above which a report warns. The paper's schedule, with the roots of its bounds, has 1.53 at 1 kg and 2.32 at
# 10 kg; the unstable one has 144.
MAX_GAIN = 2.0
# Growth over an interval that counts as none, from rounding of an exact map.
GROWTH_ROUNDING = 1e-9
_WIDTH = 80
_NOT_PROMISED = (
    "saturated motors, delay, elastic joints, contact, errors that a driver clips, an elbow that drifts, Coriolis "
    "forces left in, another inertia than this"
)


@final
@dataclass(frozen=True)
class StabilityReport:
    """Stability of a schedule at one inertia and speed, computed by :func:`certify`; ``print`` gives a summary.

    The guarantees hold for the force-free motion of this inertia, integrated exactly, without the effects of a real
    robot, above all lag, saturation and contact; only ``environment_stiffness`` covers a position loop and a force
    filter in contact with a spring. Rates and ratios are independent of units.

    Attributes
    ----------
    damping_ratio : float
        Smallest damping ratio over the schedule and its axes, at each row with its own inertia.
    stiffness_ratio : float
        Ratio R of the largest to the smallest stiffness over all axes and times. NaN for poses and for a varying
        inertia, for which the rule below does not hold.
    required_damping_ratio : float
        Damping ratio from which any schedule within these limits is exponentially stable, by
        :func:`~torch_pbd.control.required_damping_ratio`. NaN where R is.
    stable_at_any_schedule : bool
        Whether a common Lyapunov function of all rows was found. Any schedule of these rows and of blends of their
        gains and inertias is then exponentially stable: in any order, held for any time or linear between rows, at any
        speed up to ``any_schedule_speed``. The result of :meth:`Schedule.diagonal` must be certified anew.
    any_schedule_rate : float
        Smallest decay rate of the root of that function in 1/s; NaN where none was found.
    any_schedule_speed : float
        Replay speed up to which it decays; infinite, except for poses that rotate.
    alpha : float
        Constant of the certificate in 1/s.
    margin : float
        Smallest decay rate of the root of Kronander and Billard's V in 1/s, exact for gains that are linear between the
        rows. If it is not negative, V never grows without a force, and the motion is passive with respect to the force
        and ``v + alpha e``. A negative one means that this certificate does not hold, not that the schedule is
        unstable.
    held_growth : float
        Largest growth of such a V, with this alpha, a half or a quarter of it, over an interval between rows with gains
        held instead, as in the ticks of a controller; 1 is no growth. NaN without an alpha.
    margin_time : float
        Time of the smallest margin in s.
    max_speed : float
        Largest replay speed at which the margin is not negative; 1 is the schedule's own.
    gain : float
        Largest growth of ``sqrt(v'Mv + e'Ke)`` over a part of the schedule from any state, with gains held between
        rows; not conservative. 1 is no growth. If many parts grow at a time, the 64 that grew most are followed.
    environment_stiffness, environment_rotation : float
        Stiffest spring in N/m, and for poses Nm/rad, that the robot can press on in the softest phase without vibrating
        with its position loop. NaN for a varying inertia, as an arm's own, and for the second without an orientation.
    speed : float
        Replay speed.
    inertia : tuple of (float, float)
        Smallest and largest inertia of the positions in kg, and of the rotation in kg m^2.
    is_constant : bool
        Whether one inertia is that of all rows.
    units : tuple of str
        Units of the stiffness of positions and of the rotation.
    """

    damping_ratio: float
    stiffness_ratio: float
    required_damping_ratio: float
    stable_at_any_schedule: bool
    any_schedule_rate: float
    any_schedule_speed: float
    alpha: float
    margin: float
    margin_time: float
    held_growth: float
    max_speed: float
    gain: float
    environment_stiffness: float
    environment_rotation: float
    speed: float
    inertia: tuple[tuple[float, float], ...]
    is_constant: bool
    units: tuple[str, ...]

    @property
    def certified(self) -> bool:
        """Whether the certificate holds for this very schedule and speed, its gains linear or held between rows."""
        return self.margin >= 0.0 and self.held_growth <= 1.0 + GROWTH_ROUNDING

    @property
    def stable(self) -> bool:
        """Whether one of the two guarantees holds."""
        return self.certified or self.stable_at_any_schedule

    def __str__(self) -> str:
        is_any, which = self.stable_at_any_schedule, "this schedule as it is"
        own, any_order = (
            "any" if math.isinf(limit) else f"{limit:.3g} x" for limit in (self.max_speed, self.any_schedule_speed)
        )
        if is_any:
            which = "these rows in any order, blended or held"
            own = own if own == any_order else f"{any_order}, by the rule; by the certificate {own}"
        remedy = "slow down" if self.margin < 0.0 else "resample it finer"
        certificate = f"rate {self.margin:.3g} /s at t = {self.margin_time:.3g} s, alpha {self.alpha:.3g} /s"
        if self.margin >= 0.0 and not self.certified:
            certificate += f"; held between rows, V grows by {self.held_growth - 1.0:.2g}"
        warning = "" if self.gain <= MAX_GAIN else f"  <- above {MAX_GAIN:g}: disturbances grow on the way"
        promise = f"without a force deviations die out, of {which}; a bounded force moves it by a bounded amount"
        verdict = "guaranteed" if self.stable else f"NOT GUARANTEED: {remedy}, damp more, or use a filter"
        rows = {
            "exact and without lag": verdict,
            "any-schedule rule": self._any_schedule(),
            "certificate of this one": f"{'holds' if self.certified else 'DOES NOT HOLD'}: {certificate}",
            "replay speed limit": own,
            "gain from any state": f"{self.gain:.3g}{warning}",
            "stiffest environment": self._environment(),
            "promised": promise if self.stable else "nothing",
            "not promised": _NOT_PROMISED,
        }
        head = fill(f"stability of {self._robot()}, replay speed {self.speed:g}", _WIDTH)
        lines = (fill(f"  {name:<25}{text}", _WIDTH, subsequent_indent=27 * " ") for name, text in rows.items())
        return "\n".join([head, *lines])

    def _robot(self) -> str:
        parts = []
        for limits, unit in zip(self.inertia, self.units, strict=True):
            shown = " to ".join(dict.fromkeys(f"{limit:.3g}" for limit in limits))  # one number where they are equal
            parts.append(f"{shown} {'kg m^2' if unit == 'Nm/rad' else 'kg'}")
        return f"{'the admittance at' if self.is_constant else 'an inertia that varies,'} {' and '.join(parts)}"

    def _any_schedule(self) -> str:
        holds = f"holds: in any order at a rate of {self.any_schedule_rate:.3g} /s"
        enough = f"one of {self.required_damping_ratio:.3g} will do for stiffness ratio {self.stiffness_ratio:.3g}"
        if math.isnan(self.stiffness_ratio):
            enough = f"no ratio is enough in itself for {'poses' if self.is_constant else 'an inertia that varies'}"
        holds = holds if self.stable_at_any_schedule else "does not hold"
        return f"{holds}; damping ratio {self.damping_ratio:.3g}; {enough}"

    def _environment(self) -> str:
        if math.isnan(self.environment_stiffness):
            return "not asked: an arm of its own inertia has no position loop"
        pressed = zip((self.environment_stiffness, self.environment_rotation), self.units, strict=False)
        return " and ".join(f"{value:.4g} {unit}" for value, unit in pressed) + " in the softest phase"

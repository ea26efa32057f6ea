"""Report on the stability of a schedule."""

import math
from dataclasses import dataclass
from textwrap import fill
from typing import final

# Gain of a schedule above which its report warns. The paper's own, with the roots of its bounds, has 1.53 at 1 kg and
# 2.32 at 10 kg; the unstable one has 144.
MAX_GAIN = 2.0
# Growth over an interval that is none: rounding of an exact map.
GROWTH_ROUNDING = 1e-9


@final
@dataclass(frozen=True)
class StabilityReport:
    """Stability of a schedule at one mass and speed, as :func:`certify` found it; ``print`` it.

    Guaranteed is the admittance of this mass, integrated exactly, without a force. A lag between it and the robot, by
    a position loop or a filter of the force, is in ``environment_stiffness`` only.

    Attributes
    ----------
    damping_ratio : float
        Smallest over the schedule and its axes.
    stiffness_ratio : float
        Largest over smallest stiffness R, of all axes and times.
    required_damping_ratio : float
        Of damping ``2 zeta (M K)^1/2`` with one zeta, from here on any schedule within these limits is exponentially
        stable: :func:`~torch_pbd.control.required_damping_ratio`.
    stable_at_any_schedule : bool
        Whether one function of the state, which no axis is special to, falls at every knot. Any schedule of these gains
        and blends of them, at any speed, in any order, held over ticks or linear between knots, is then exponentially
        stable.
    alpha : float
        Constant of the certificate, 1/s.
    margin : float
        Of the certificate, N/m/s: smallest eigenvalue of ``2 alpha K - K' - alpha D'``. Not negative: V of
        Kronander and Billard never grows without a force, and the admittance is passive with respect to the force
        and ``v + alpha y``. Exact for gains that are linear between the knots of the schedule. Negative says
        that this certificate does not hold, not that the schedule is unstable.
    held_growth : float
        Largest growth of such a V, of this alpha, a half or a quarter of it, over an interval between knots in which
        the gains are held instead, as at the ticks of a controller: 1 is none. NaN without an alpha.
    margin_time : float
        Where the margin is smallest, s.
    max_speed : float
        Largest replay speed at which the margin is not negative; 1 is the schedule's own. Where the rule holds, any
        speed is stable.
    gain : float
        Largest growth of ``sqrt(v'Mv + y'Ky)`` over a part of the schedule from any state, gains held between
        knots: not conservative. 1 is no growth. Of parts that all grow at a time, the 400 that have grown the most.
    environment_stiffness : float
        Stiffest spring, N/m, that the robot can press on in the softest phase without vibrating, behind its
        position loop.
    speed, mass : float, float or tuple of rows
        Replay speed, and virtual mass in kg.
    """

    damping_ratio: float
    stiffness_ratio: float
    required_damping_ratio: float
    stable_at_any_schedule: bool
    alpha: float
    margin: float
    margin_time: float
    held_growth: float
    max_speed: float
    gain: float
    environment_stiffness: float
    speed: float
    mass: float | tuple[tuple[float, ...], ...]

    @property
    def certified(self) -> bool:
        """Whether the certificate holds for this very schedule and speed, its gains linear or held between knots."""
        return self.margin >= 0.0 and self.held_growth <= 1.0 + GROWTH_ROUNDING

    @property
    def stable(self) -> bool:
        """Whether one of the two guarantees holds."""
        return self.certified or self.stable_at_any_schedule

    def __str__(self) -> str:
        any_schedule = "holds" if self.stable_at_any_schedule else "does not hold"
        certificate = "holds" if self.certified else "DOES NOT HOLD"
        warning = "" if self.gain <= MAX_GAIN else f"  <- above {MAX_GAIN:g}: disturbances grow on the way"
        speed = "any" if math.isinf(self.max_speed) else f"{self.max_speed:.3g} x"
        if self.stable_at_any_schedule and math.isfinite(self.max_speed):
            speed = f"any, by the rule; by the certificate {speed}"
        grows = self.margin >= 0.0 and self.held_growth > 1.0 + GROWTH_ROUNDING
        held = f"; held between knots, V grows by {self.held_growth - 1.0:.2g}" if grows else ""
        remedy = "slow down" if self.margin < 0.0 else "resample it finer"
        verdict = "guaranteed" if self.stable else f"NOT GUARANTEED: {remedy}, damp more, or use a filter"
        mass = f"{self.mass:g} kg" if isinstance(self.mass, float) else "a mass matrix"
        rows = {
            "exact and without lag": verdict,
            "any-schedule rule": f"{any_schedule}: damping ratio {self.damping_ratio:.3g}; one of "
            f"{self.required_damping_ratio:.3g} will do for stiffness ratio {self.stiffness_ratio:.3g}",
            "certificate of this one": f"{certificate}: margin {self.margin:.4g} N/m/s at t = "
            f"{self.margin_time:.3g} s, alpha {self.alpha:.3g} /s{held}",
            "replay speed limit": speed,
            "gain from any state": f"{self.gain:.3g}{warning}",
            "stiffest environment": f"{self.environment_stiffness:.4g} N/m in the softest phase",
        }
        head = f"stability of the admittance at {mass}, replay speed {self.speed:g}"
        return "\n".join(
            [head, *(fill(f"  {name:<25}{text}", 80, subsequent_indent=27 * " ") for name, text in rows.items())]
        )

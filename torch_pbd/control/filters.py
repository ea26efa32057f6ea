"""Online filters that keep a varying stiffness from feeding energy into the robot.

Both stand between the stiffness that is asked for and the one in effect, at every tick, and take the largest
share of the step that their invariant allows. Damping steps by the same share. State and gains are those of
``M a = u - K y - D v`` held over a tick, y the deviation from the desired position.

Where a desired orientation turns, deviations of rotation turn with it, and so do the gains that are held on to: what is
held back is their change as the tool sees it. An inertia that varies, as that of an arm, changes the kinetic energy by
``1/2 v' dM v`` from tick to tick at the same velocity; what each filter makes of that, it says.

The simulation and the real-time loop, which has no torch, run them each in numbers of its own.
"""

from dataclasses import dataclass
from typing import final

from torch_pbd import checks
from torch_pbd.exceptions import InvalidParameterError

MARGIN = 1e-13
"""A share is smaller by this than the largest allowed, which pays for its own rounding: 2.2e-16, some hundred times."""


class StiffnessFilter:
    """Filter of the gains, as :class:`~torch_pbd.control.AdmittancePlant` and the real-time loop take it."""


@final
@dataclass(frozen=True)
class RateLimit(StiffnessFilter):
    """Raise the stiffness no faster than a common Lyapunov function allows.

    ``V = 1/2 (v + a y)' M (v + a y) + 1/2 y' (K + a D - a^2 M) y`` does not grow from one tick to the next
    without an external force, whatever the schedule asks for: the discrete form, for gains held over a tick, of
    the conditions of K. Kronander and A. Billard, "Stability considerations for variable impedance control",
    IEEE Transactions on Robotics 32, 2016. It needs no measurement. The admittance is passive with respect to
    ``v + a y`` and a force that is held over each tick; behind a position loop that lags, a robot need not be.
    Where the mass varies, or a desired orientation turns, the function is that of each tick's own mass, of the
    difference between any two motions under the same gains, and has to pay for that too: a run stops where the damping
    cannot, since no stiffness would help. That needs a positive definite ``D - a M - M'/2`` of the damping that is held
    back, not of the one asked for, and nobody knows it before the run. A robot must not stop half way: the real-time
    loop refuses masses that vary and poses. There :class:`EnergyTank` is for both.

    Parameters
    ----------
    alpha : float, default=None
        The constant a, in 1/s, below the smallest eigenvalue of ``M^-1/2 D M^-1/2`` in the schedule; None is
        half of that. The larger, the faster the stiffness may rise.
    """

    alpha: float | None = None

    def __post_init__(self) -> None:
        checks.number(self.alpha, "alpha", above=0.0, unit="1/s", optional=True)

    def constant(self, limit: float, softest: float) -> float:
        """The constant a under the smallest eigenvalues of ``M^-1/2 D M^-1/2`` and of K in a schedule: checked."""
        alpha = 0.5 * limit if self.alpha is None else self.alpha
        if not 0.0 < alpha < limit:
            raise InvalidParameterError(
                f"alpha is {alpha:g} /s, must be above 0 and below {limit:g} /s, the smallest damping over mass of the "
                "schedule: leave it None, or damp more."
            )
        if softest <= 0.0:
            raise InvalidParameterError(
                f"the smallest eigenvalue of stiffness is {softest:g} N/m, must be above zero for a rate limit: a free "
                "axis has no equilibrium."
            )
        return alpha


@final
@dataclass(frozen=True)
class EnergyTank(StiffnessFilter):
    """Pay for every rise of the stiffness from a tank that dissipation fills.

    A rise at deviation y puts ``1/2 y' (K_new - K) y`` into the spring: it comes out of the tank, and where the
    tank has less, only that share of the rise is made; the stiffness may always fall. With the energy H of
    spring and mass, T of the tank and the work W of external force and desired motion,
    ``H + T - W <= H_0 + T_0`` at every tick, to rounding. What a falling stiffness takes out of the spring goes into
    the tank whole, and a stiffness that turns with the desired orientation costs nothing. Where the mass varies, what
    that does to the kinetic energy counts as work of the motion, in W: the tank answers for the stiffness alone. As for
    :class:`RateLimit`, this is of the admittance, not of a robot that lags behind it. After
    F. Ferraguti, C. Secchi, C. Fantuzzi, "A tank-based approach to impedance control with variable stiffness",
    ICRA 2013, made exact for gains that switch at ticks.

    Parameters
    ----------
    energy : float, default=0.0
        In the tank at the start, J: what the schedule may inject beyond what the motion has dissipated.
    energy_max : float, default=10.0
        Most the tank holds, J; what comes beyond is lost.
    efficiency : float, default=0.5
        Share of the dissipated energy that goes into the tank, 0 <= efficiency < 1. With 1 the robot would be
        passive but need never come to rest: all it dissipates could be injected again.
    """

    energy: float = 0.0
    energy_max: float = 10.0
    efficiency: float = 0.5

    def __post_init__(self) -> None:
        checks.number(self.energy_max, "energy_max", least=0.0, unit="J")
        checks.number(self.energy, "energy", least=0.0, most=self.energy_max, unit="J")
        checks.number(self.efficiency, "efficiency", least=0.0, below=1.0)

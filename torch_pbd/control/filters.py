"""Online filters that keep a varying stiffness from feeding energy into the robot.

At every tick they move the stiffness in effect towards the wanted one, by the largest share of the step that
their invariant allows. Damping steps by the same share. State and gains are those of
``M a = u - K y - D v`` held over a tick, y the deviation from the desired position.

Where a desired orientation turns, deviations of rotation turn with it, and so do the retained gains: their change is
held back in the tool frame. The arithmetic is the same on tensors (..., d) of many rollouts, in the simulation, and on
NumPy's arrays of one robot, in the real-time loop: of functions that have the same names in both.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, final

from torch_pbd import checks
from torch_pbd.exceptions import InvalidParameterError
from torch_pbd.rotations import library_of, of_last_axes

# A tensor, or an array of NumPy.
Array = Any
State = tuple[Array, Array]  # deviation and velocity (..., d)
Energy = Callable[[Array, Array], Array]  # energy (...) in J from stiffness (..., d, d) and deviation (..., d)

# Amount by which a share stays below the largest allowed, to cover rounding: some hundred times 2.2e-16.
_MARGIN = 1e-13


class StiffnessFilter(ABC):
    """Filter of the gains for :class:`~torch_pbd.control.AdmittancePlant` and the real-time loop."""

    @abstractmethod
    def start(self, stiffness: Array, damping: Array, mass: Array) -> "ActiveFilter":
        """Running filter for a schedule with gains (..., T, d, d) and a mass (d, d) or (..., T, d, d)."""


@final
@dataclass(frozen=True)
class RateLimit(StiffnessFilter):
    """Limit of the stiffness rate by a common Lyapunov function.

    ``V = 1/2 (v + a y)' M (v + a y) + 1/2 y' (K + a D - a^2 M) y`` does not grow from one tick to the next
    without an external force, for any schedule: the discrete form, for gains held over a tick, of
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
        Constant a in 1/s, below the smallest eigenvalue of ``M^-1/2 D M^-1/2`` in the schedule; None is half
        of that. A larger value lets the stiffness rise faster.
    """

    alpha: float | None = None

    def __post_init__(self) -> None:
        checks.number(self.alpha, "alpha", above=0.0, unit="1/s", optional=True)

    def start(self, stiffness: Array, damping: Array, mass: Array) -> "ActiveFilter":  # noqa: D102
        linalg = library_of(stiffness).linalg
        inverse = linalg.inv(linalg.cholesky(mass))
        limit = float(linalg.eigvalsh(inverse @ damping @ inverse.mT).min())
        softest = float(linalg.eigvalsh(stiffness).min())
        alpha = 0.5 * limit if self.alpha is None else self.alpha
        remedy = "leave it None, or damp more: it is below the smallest damping over mass of the schedule"
        checks.number(alpha, "alpha", above=0.0, below=limit, unit="1/s", remedy=remedy)
        remedy = "a rate limit needs it, for a free axis has no equilibrium"
        checks.number(softest, "the smallest eigenvalue of stiffness", above=0.0, unit="N/m", remedy=remedy)
        return _ActiveRateLimit(alpha)


@final
@dataclass(frozen=True)
class EnergyTank(StiffnessFilter):
    """Energy tank that dissipation fills and from which every rise of the stiffness is paid.

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
        Initial energy in J, which the schedule may inject beyond what the motion has dissipated.
    energy_max : float, default=10.0
        Capacity of the tank in J; any excess is lost.
    efficiency : float, default=0.5
        Share of the dissipated energy that goes into the tank, 0 <= efficiency < 1. With 1 the robot would be
        passive but might never come to rest, as all dissipated energy could be injected again.
    """

    energy: float = 0.0
    energy_max: float = 10.0
    efficiency: float = 0.5

    def __post_init__(self) -> None:
        checks.number(self.energy_max, "energy_max", least=0.0, unit="J")
        checks.number(self.energy, "energy", least=0.0, most=self.energy_max, unit="J")
        checks.number(self.efficiency, "efficiency", least=0.0, below=1.0)

    def start(self, stiffness: Array, damping: Array, mass: Array) -> "ActiveFilter":  # noqa: D102
        return _ActiveTank(self)


def spring_energy(stiffness: Array, off: Array) -> Array:
    """Energy (...) in J of springs (..., d, d) at deviations (..., d)."""
    return 0.5 * _quadratic(stiffness, off, off)


class ActiveFilter(ABC):
    """Running filter of the gains: `select` and then `settle` each tick, and `carry` where the orientation turns.

    ``gains`` are the stiffness and damping (..., d, d) in effect, and the share (...) of the step towards the wanted
    ones; ``tank_energy`` (...) is in J, None where there is no tank.
    """

    gains: Any = None
    tank_energy: Array = None

    def select(
        self, stiffness: Array, damping: Array, mass: Array, step: float, off: Array, scale: Array = 1.0
    ) -> None:
        """Choose the gains of a tick of ``step`` s from the wanted ones, the mass and the deviation (..., d).

        ``scale`` (..., d) is the scale of springs that limits reduce.
        """
        if self.gains is None:
            library, shape = library_of(off), (*off.shape, off.shape[-1])
            wanted = [library.broadcast_to(gain, shape) for gain in (stiffness, damping)]
            self.gains = wanted[0], wanted[1], library.ones_like(off[..., 0])
            if self.tank_energy is not None:
                self.tank_energy = self.tank_energy * self.gains[2]
        else:
            share = self._paid_share(stiffness, damping, mass, off, scale * off)
            kept = (1.0 - share)[..., None, None]  # zero where all is granted, which is then exactly what is wanted
            steps = zip((stiffness, damping), self.gains, strict=False)
            stiffness, damping = (wanted - kept * (wanted - last) for wanted, last in steps)
            self.gains = stiffness, damping, share
        self._turn, self._tick = None, (*self.gains[:2], mass, step)

    def carry(self, turn: Array) -> None:
        """Rotate the gains with the desired orientation, by a matrix (..., 3, 3), at the end of a tick."""
        stiffness, damping, share = self.gains
        whole = of_last_axes(turn, stiffness.shape[-1])
        turned = [whole @ gain @ whole.mT for gain in (stiffness, damping)]
        self._turn, self.gains = whole, (*(0.5 * (gain + gain.mT) for gain in turned), share)

    @abstractmethod
    def settle(self, before: State, after: State, force: Array, energy: Energy = spring_energy) -> None:
        """Record a tick: states at its start and end, the force (..., d) held during it, and the springs' energy."""

    @abstractmethod
    def _paid_share(self, stiffness: Array, damping: Array, mass: Array, off: Array, scaled: Array) -> Array:
        """Largest share, at most 1, of the step to these gains that can be paid for, and is with that."""


class _ActiveTank(ActiveFilter):
    def __init__(self, tank: EnergyTank) -> None:
        self._tank, self.tank_energy = tank, tank.energy

    def _paid_share(self, stiffness: Array, damping: Array, mass: Array, off: Array, scaled: Array) -> Array:
        asked, where = 0.5 * _quadratic(stiffness - self.gains[0], off, scaled), library_of(off).where
        lacking = asked > self.tank_energy
        share = where(lacking, (1.0 - _MARGIN) * self.tank_energy / where(lacking, asked, 1.0), 1.0)
        self._pay(share * asked)
        return share

    def settle(self, before: State, after: State, force: Array, energy: Energy = spring_energy) -> None:
        stiffness, _, mass, _ = self._tick
        stored = [energy(stiffness, off) + spring_energy(mass, velocity) for off, velocity in (before, after)]
        dissipated = stored[0] + (force * (after[0] - before[0])).sum(-1) - stored[1]
        # Negative dissipation comes from rounding or from a limit of the command, and is charged in full.
        self._pay(-library_of(force).where(dissipated > 0.0, self._tank.efficiency * dissipated, dissipated))

    def _pay(self, energy: Array) -> None:
        self.tank_energy = library_of(energy).clip(self.tank_energy - energy, 0.0, self._tank.energy_max)


class _ActiveRateLimit(ActiveFilter):
    def __init__(self, alpha: float) -> None:
        self._alpha = alpha

    def settle(self, before: State, after: State, force: Array, energy: Energy = spring_energy) -> None:
        """Record nothing, since the payment of a tick follows from its gains."""

    def _paid_share(self, stiffness: Array, damping: Array, mass: Array, off: Array, scaled: Array) -> Array:
        """Largest s in [0, 1] for which the last tick pays for the step ``s dP`` of the function P.

        Whatever its state x at the start and its force f: ``E' (P + s dP) E <= P + W`` with E the map of (x, f) to
        the state at the end, and W twice the work of f on ``v + a y``. On the left, P is that of the gains held on to
        and of this tick's mass, and E turns the deviation with them.
        """
        held_stiffness, held_damping, _ = self.gains
        # dP = dK + a dD, of deviations.
        rise = stiffness - held_stiffness + self._alpha * (damping - held_damping)
        library, ones = library_of(rise), 0.0 * rise[..., 0, 0] + 1.0
        if not rise.any():
            return ones
        last_stiffness, last_damping, last_mass, step = self._tick
        d, rate = rise.shape[-1], admittance_rate(last_stiffness, last_damping, last_mass)
        change = expm1(step * rate[..., : 2 * d, :])  # from deviation, velocity and held force to that of the first two
        unit = library.eye(3 * d, dtype=rise.dtype, device=rise.device)
        start, forces = unit[: 2 * d], unit[2 * d :]
        # The equation of motion integrated over the tick, M dv = f h - K int(y) - D dy, gives int(y), of which the port
        # is dy + a int(y).
        pull = step * forces - last_mass @ change[..., d:, :] - last_damping @ change[..., :d, :]
        port = change[..., :d, :] + self._alpha * library.linalg.solve(last_stiffness, pull)
        if self._turn is not None:
            position, velocity = (start + change)[..., :d, :], (start + change)[..., d:, :]
            change = library.concatenate([self._turn @ position, velocity], axis=-2) - start
        before = lyapunov_matrix(last_stiffness, last_damping, last_mass, self._alpha)
        after = lyapunov_matrix(held_stiffness, held_damping, mass, self._alpha)
        # E' P E - P with E = 1 + change is expanded without P, which would swamp the digits that count in short ticks.
        given = forces.mT @ port - start.mT @ after @ change
        paid = start.mT @ (before - after) @ start + given + given.mT - change.mT @ after @ change
        try:
            factor = library.linalg.cholesky(paid)
        except library.linalg.LinAlgError:
            if bool((before == after).all()):  # in a tick so short that rounding hides what it pays
                return 0.0 * ones
            raise InvalidParameterError(
                "stiffness_filter is a RateLimit, but the mass rises, or the desired orientation turns, faster than "
                "the damping can pay for: damp more, move more slowly, or take EnergyTank()."
            ) from None
        # With F F' = paid, s is one over the largest eigenvalue of F^-1 E' dP E F'^-1.
        half = library.linalg.solve(factor, (start + change)[..., :d, :].mT)
        needed = library.linalg.eigvalsh(half @ rise @ half.mT)[..., -1]
        return library.where(needed > 1.0, (1.0 - _MARGIN) / library.clip(needed, 1.0, None), ones)


def admittance_rate(stiffness: Array, damping: Array, mass: Array) -> Array:
    """Matrix of ``[deviation, velocity, force]' = rate @ [deviation, velocity, force]`` of a held force, (..., n, n).

    It is eq. (15) for gains (..., d, d), and n = 3 d.
    """
    library, d = library_of(stiffness), stiffness.shape[-1]
    inverse = library.linalg.inv(mass) + 0.0 * stiffness
    rate = library.zeros((*stiffness.shape[:-2], 3 * d, 3 * d), dtype=stiffness.dtype, device=stiffness.device)
    rate[..., :d, d : 2 * d] = library.eye(d)
    rate[..., d : 2 * d, :] = library.concatenate([-inverse @ stiffness, -inverse @ damping, inverse], axis=-1)
    return rate


def expm1(matrix: Array) -> Array:
    """exp(matrix) - 1 by Taylor series and doubling: without the 1, slow motions keep their digits beside fast ones.

    Rows of zeros at the end of a square matrix may be left out, and then are of the result.
    """
    doublings = max(0, math.frexp(float(abs(matrix).sum(-1).max()))[1] + 1)
    # The norm is now 1/2 at most, for which 14 terms have all digits.
    small = matrix / 2.0**doublings
    power, square = small / 14.0, small[..., : small.shape[-2]]
    for order in range(13, 0, -1):
        power = (small + square @ power) / order
    for _ in range(doublings):
        power = 2.0 * power + power[..., : power.shape[-2]] @ power
    return power


def lyapunov_matrix(stiffness: Array, damping: Array, mass: Array, alpha: float) -> Array:
    """Twice the matrix (..., 2 d, 2 d) of Kronander and Billard's V in (deviation, velocity)."""
    concatenate, mass = library_of(stiffness).concatenate, mass + 0.0 * stiffness
    upper = concatenate([stiffness + alpha * damping, alpha * mass], axis=-1)
    return concatenate([upper, concatenate([alpha * mass, mass], axis=-1)], axis=-2)


def _quadratic(matrix: Array, left: Array, right: Array) -> Array:
    return (left[..., None, :] @ matrix @ right[..., :, None])[..., 0, 0]

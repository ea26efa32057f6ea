"""Filters of the stiffness in the simulated robot, of many rollouts at a time."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torch_pbd import checks
from torch_pbd.control.filters import MARGIN, EnergyTank, RateLimit, StiffnessFilter
from torch_pbd.control.simulation.ticks import State, admittance_rate, mass_at, transition
from torch_pbd.exceptions import InvalidParameterError
from torch_pbd.linalg import symmetrize


@dataclass(frozen=True)
class Gains:
    """Stiffness and damping in effect, (..., d, d), and the share (...) of the step towards the wanted ones."""

    stiffness: Tensor
    damping: Tensor
    share: Tensor


class ActiveFilter(ABC):
    """Filter of the gains in a run, of a robot of a mass (d, d), or of one for each tick (..., T, d, d)."""

    tank_energy: Tensor | None = None
    _gains: Gains | None = None
    _turn: Tensor | None = None
    _tick = -1

    def __init__(self, mass: Tensor) -> None:
        self._mass = mass

    @abstractmethod
    def select(self, stiffness: Tensor, damping: Tensor, deviation: Tensor) -> Gains:
        """Gains for this tick, of the wanted ones (..., d, d) and the deviation (..., d) at its start."""

    def carry(self, turn: Tensor) -> None:
        """Take the gains along where the desired orientation turns, by a matrix (..., 3, 3), at the end of a tick."""
        self._turn = turn

    def _begin(self) -> tuple[Gains | None, Gains | None]:
        """Gains of the last tick, as they were and as they are held on to in this one, that now begins."""
        self._tick += 1
        last, turn = self._gains, self._turn
        if last is None or turn is None:
            return last, last
        d = last.stiffness.shape[-1]
        whole = torch.eye(d).to(turn).repeat(*turn.shape[:-2], 1, 1)
        whole[..., d - 3 :, d - 3 :] = turn
        held = [symmetrize(whole @ gain @ whole.mT) for gain in (last.stiffness, last.damping)]
        return last, Gains(held[0], held[1], last.share)

    def settle(self, before: State, after: State, force: Tensor) -> None:  # noqa: B027 - most have nothing to note
        """Take note of the tick: (deviation, velocity) at its start and end, and the force held in it."""


def started(wanted: StiffnessFilter, stiffness: Tensor, damping: Tensor, mass: Tensor, dt: float) -> ActiveFilter:
    """Begin a run over the wanted gains (..., T, d, d), of a mass (d, d) or (..., T, d, d)."""
    if isinstance(wanted, EnergyTank):
        return _Tank(wanted, mass)
    rate_limit: RateLimit = checks.instance(wanted, "stiffness_filter", RateLimit)
    inverse = torch.linalg.inv(torch.linalg.cholesky(mass))
    limit = torch.linalg.eigvalsh(symmetrize(inverse @ damping @ inverse.mT)).min()
    return _RateLimited(rate_limit.constant(float(limit), float(torch.linalg.eigvalsh(stiffness).min())), mass, dt)


class _RateLimited(ActiveFilter):
    def __init__(self, alpha: float, mass: Tensor, dt: float) -> None:
        super().__init__(mass)
        self._alpha, self._dt = alpha, dt

    def select(self, stiffness: Tensor, damping: Tensor, deviation: Tensor) -> Gains:
        last, held = self._begin()
        if last is None or held is None:
            self._gains = Gains(stiffness, damping, stiffness.new_ones(stiffness.shape[:-2]))
        else:
            share = self._largest_share(stiffness, damping, last, held)
            self._gains = _partway(held, stiffness, damping, share)
        return self._gains

    def _largest_share(self, stiffness: Tensor, damping: Tensor, last: Gains, held: Gains) -> Tensor:
        """Largest s in [0, 1] for which the last tick pays for the step ``s dP`` of the function P.

        Whatever its state x at the start and its force f: ``E' (P + s dP) E <= P + W`` with E the map of (x, f) to
        the state at the end, and W twice the work of f on ``v + a y``. On the left, P is that of the gains held on to
        and of this tick's mass, and E turns the deviation with them.
        """
        d, mass = stiffness.shape[-1], mass_at(self._mass, self._tick - 1)
        end = transition(admittance_rate(last.stiffness, last.damping, mass), self._dt)[..., : 2 * d, :]
        start = torch.eye(3 * d).to(end)
        moved = end - start[: 2 * d]
        # The equation of motion integrated over the tick, M dv = f h - K int(y) - D dy, gives int(y), of which the port
        # is dy + a int(y).
        pull = self._dt * start[2 * d :] - mass @ moved[..., d:, :] - last.damping @ moved[..., :d, :]
        port = moved[..., :d, :] + self._alpha * torch.linalg.solve(last.stiffness, pull)
        function = lyapunov_matrix(last.stiffness, last.damping, mass, self._alpha)
        work = torch.nn.functional.pad(port, (0, 0, 2 * d, 0))
        if self._turn is not None:
            position, rotation, velocity = end.split([d - 3, 3, d], dim=-2)
            end = torch.cat([position, self._turn @ rotation, velocity], dim=-2)
        after = lyapunov_matrix(held.stiffness, held.damping, mass_at(self._mass, self._tick), self._alpha)
        paid = torch.nn.functional.pad(function, (0, d, 0, d)) + work + work.mT - end.mT @ after @ end
        # dP = dK + a dD, of deviations. With F F' = paid, s is one over the largest eigenvalue of F^-1 E' dP E F'^-1.
        rise = stiffness - held.stiffness + self._alpha * (damping - held.damping)
        factor, failed = torch.linalg.cholesky_ex(symmetrize(paid))
        if bool(failed.any()):
            raise InvalidParameterError(
                f"stiffness_filter is a RateLimit, but at tick {self._tick} the mass rises, or the desired orientation "
                "turns, faster than the damping can pay for: damp more, move more slowly, or take EnergyTank()."
            )
        half = torch.linalg.solve_triangular(factor, end[..., :d, :].mT, upper=False)
        needed = torch.linalg.eigvalsh(symmetrize(half @ rise @ half.mT))[..., -1]
        return torch.where(needed > 1.0, (1.0 - MARGIN) / needed.clamp_min(1.0), 1.0)


def lyapunov_matrix(
    stiffness: Float[Tensor, "*b d d"], damping: Float[Tensor, "*b d d"], mass: Float[Tensor, "*m d d"], alpha: float
) -> Float[Tensor, "*b n n"]:
    """Twice the matrix of Kronander and Billard's V in (deviation, velocity), n = 2 d."""
    cross = (alpha * mass).expand_as(stiffness)
    upper = torch.cat([stiffness + alpha * damping, cross], dim=-1)
    lower = torch.cat([cross, mass.expand_as(stiffness)], dim=-1)
    return torch.cat([upper, lower], dim=-2)


class _Tank(ActiveFilter):
    tank_energy: Tensor

    def __init__(self, tank: EnergyTank, mass: Tensor) -> None:
        super().__init__(mass)
        self._tank = tank

    def select(self, stiffness: Tensor, damping: Tensor, deviation: Tensor) -> Gains:
        _, last = self._begin()
        share = deviation.new_ones(deviation.shape[:-1])
        if last is None:
            self.tank_energy = torch.full_like(share, self._tank.energy)
            batch = (*share.shape, -1, -1)
            self._gains = Gains(stiffness.expand(batch), damping.expand(batch), share)
            return self._gains
        asked = 0.5 * _quadratic(stiffness - last.stiffness, deviation)
        lacking = asked > self.tank_energy
        share = torch.where(lacking, (1.0 - MARGIN) * self.tank_energy / torch.where(lacking, asked, 1.0), 1.0)
        self._gains = _partway(last, stiffness, damping, share)
        paid = 0.5 * _quadratic(self._gains.stiffness - last.stiffness, deviation)
        self.tank_energy = (self.tank_energy - paid).clamp(0.0, self._tank.energy_max)
        return self._gains

    def settle(self, before: State, after: State, force: Tensor) -> None:
        work = (force * (after[0] - before[0])).sum(-1)
        dissipated = self._energy(*before) + work - self._energy(*after)
        # What looks like negative dissipation is rounding: it is charged in full.
        gain = torch.where(dissipated > 0.0, self._tank.efficiency * dissipated, dissipated)
        self.tank_energy = (self.tank_energy + gain).clamp(0.0, self._tank.energy_max)

    def _energy(self, deviation: Tensor, velocity: Tensor) -> Tensor:
        assert self._gains is not None
        return 0.5 * (
            _quadratic(self._gains.stiffness, deviation) + _quadratic(mass_at(self._mass, self._tick), velocity)
        )


def _partway(last: Gains, stiffness: Tensor, damping: Tensor, share: Tensor) -> Gains:
    weight = share[..., None, None]
    return Gains(torch.lerp(last.stiffness, stiffness, weight), torch.lerp(last.damping, damping, weight), share)


def _quadratic(matrix: Tensor, vector: Tensor) -> Any:
    return (vector.unsqueeze(-2) @ matrix @ vector.unsqueeze(-1))[..., 0, 0]

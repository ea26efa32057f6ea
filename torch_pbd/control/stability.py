"""What is guaranteed of a stiffness schedule, and what is not: each statement by its name, checked.

With the deviation y from the desired motion, ``M y'' + D y' + K y = f``: a rise of K feeds energy in.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torch_pbd.control.coupling import stiffest_environment
from torch_pbd.control.damping import required_damping_ratio
from torch_pbd.control.matrices import as_mass, as_rows, as_semidefinite, check_positive
from torch_pbd.control.passivity import lyapunov_matrix
from torch_pbd.control.position_loop import PositionLoop
from torch_pbd.control.stability_report import StabilityReport
from torch_pbd.control.transitions import admittance_rate, transition
from torch_pbd.linalg import spectral_map, symmetrize

_MAX_KNOTS = 400  # at which parts begin and end that the gain is of; as many again where the stiffness rises most
_GOLDEN = (math.sqrt(5.0) - 1.0) / 2.0


def certify(
    schedule: Any,
    *,
    mass: Any = 1.0,
    speed: float = 1.0,
    position_loop: PositionLoop | Any = None,
    force_cutoff: float | None = 500.0,
    dt: float = 0.001,
) -> StabilityReport:
    """Check the stability of a schedule.

    Parameters
    ----------
    schedule : Schedule
        Or anything with ``time`` (n,), ``stiffness`` and ``damping`` (n, d, d).
    mass : float or array_like of shape (d, d), default=1.0
        Virtual mass of the admittance, kg.
    speed : float, default=1.0
        Replay speed: 2 is twice as fast.
    position_loop : PositionLoop, default=None
        For the stiffest environment; None is 20 Hz behind one tick.
    force_cutoff : float, default=500.0
        Of the force sensor's low-pass, Hz; None is none.
    dt : float, default=0.001
        Tick of the controller, s.

    Returns
    -------
    StabilityReport

    Raises
    ------
    ValueError
        If the mass or speed is not positive, or a stiffness is not positive definite.

    References
    ----------
    K. Kronander, A. Billard, "Stability considerations for variable impedance control", IEEE Transactions on
    Robotics 32, 2016. Its conditions are linear in time between knots where K and D are, so that holding at the
    ends of every interval is holding throughout; and they are convex in alpha, which is found by golden section.
    """
    check_positive("speed", speed)
    check_positive("dt", dt, "s")
    if force_cutoff is not None:
        check_positive("force_cutoff", force_cutoff, "Hz")
    if position_loop is not None and not isinstance(position_loop, PositionLoop):
        raise ValueError(f"position_loop == {position_loop!r}, must be a PositionLoop or None.")
    time, stiffness, damping = _rows_of(schedule)
    inertia = _door(as_mass(mass))
    is_number = not inertia.ndim
    inertia = inertia if inertia.ndim else inertia * torch.eye(stiffness.shape[-1]).to(stiffness)
    if inertia.shape != stiffness.shape[1:]:
        raise ValueError(f"mass has shape {tuple(inertia.shape)}, must be a number or {tuple(stiffness.shape[1:])}.")
    if float(torch.linalg.eigvalsh(stiffness).min()) <= 0.0:
        raise ValueError("stiffness must be positive definite to be certified: a free axis never returns.")
    knots = _Knots.of(time / speed, stiffness, damping, inertia)
    alpha, margin, worst = knots.certificate()
    ratio, required, lawful, smallest = _damping_rule(stiffness, damping, inertia)
    loop = PositionLoop() if position_loop is None else position_loop
    return StabilityReport(
        damping_ratio=smallest,
        stiffness_ratio=ratio,
        required_damping_ratio=required,
        stable_at_any_schedule=lawful and smallest > required,
        alpha=alpha,
        margin=margin,
        margin_time=float(time[worst]),
        held_growth=_held_growth(time / speed, stiffness, damping, inertia, alpha),
        max_speed=speed * knots.max_speed(),
        gain=_gain(time / speed, stiffness, damping, inertia),
        environment_stiffness=stiffest_environment(stiffness, damping, inertia, loop, force_cutoff, dt),
        speed=float(speed),
        mass=float(inertia[0, 0]) if is_number else tuple(map(tuple, inertia.tolist())),
    )


def _rows_of(schedule: Any) -> tuple[Tensor, Tensor, Tensor]:
    """Times, stiffness and damping of what may be a schedule, checked as a schedule's are."""
    missing = [name for name in ("time", "stiffness", "damping") if not hasattr(schedule, name)]
    if missing:
        raise ValueError(f"schedule is a {type(schedule).__name__} without {', '.join(missing)}: give a Schedule.")
    time = _door(as_rows(schedule.time, "schedule.time", 1))
    if time.ndim != 1 or len(time) < 2 or not bool((time.diff() > 0.0).all()):
        raise ValueError(f"schedule.time has shape {tuple(time.shape)}, must be two or more times that increase.")
    gains = [_door(as_semidefinite(getattr(schedule, name), f"schedule.{name}")) for name in ("stiffness", "damping")]
    for name, gain in zip(("stiffness", "damping"), gains, strict=True):
        if gain.ndim != 3 or gain.shape != gains[0].shape or len(gain) != len(time):
            raise ValueError(
                f"schedule.{name} has shape {tuple(gain.shape)}, must have shape (n, d, d) with n = {len(time)}, the "
                "number of times."
            )
    return time, gains[0], gains[1]


def _door(values: Any) -> Tensor:
    """Copy in float64; arrays of a schedule are read-only, which torch must not alias."""
    return values.detach().double() if isinstance(values, Tensor) else torch.tensor(values, dtype=torch.float64)


@dataclass(frozen=True)
class _Knots:
    """Gains at both ends of every interval (2, n - 1, d, d), their rates (n - 1, d, d), and the largest alpha."""

    stiffness: Tensor
    stiffness_rate: Tensor
    damping_rate: Tensor
    alpha_max: float

    @classmethod
    def of(cls, time: Tensor, stiffness: Tensor, damping: Tensor, mass: Tensor) -> "_Knots":
        step = time.diff()[:, None, None]
        inverse = torch.linalg.inv(torch.linalg.cholesky(mass))
        alpha_max = float(torch.linalg.eigvalsh(symmetrize(inverse @ damping @ inverse.mT)).min())
        ends = torch.stack([stiffness[:-1], stiffness[1:]])
        return cls(ends, stiffness.diff(dim=0) / step, damping.diff(dim=0) / step, alpha_max)

    def certificate(self) -> tuple[float, float, int]:
        """Alpha with the largest margin, that margin, and the interval where it is smallest."""

        def excess(alpha: float) -> Tensor:
            matrix = self.stiffness_rate + alpha * self.damping_rate - 2.0 * alpha * self.stiffness
            return torch.linalg.eigvalsh(matrix)[..., -1]

        if self.alpha_max <= 0.0:  # no damping somewhere: no alpha will do
            values = excess(0.0)
            alpha, margin = 0.0, min(-float(values.max()), -math.ulp(0.0))
        else:
            alpha = _minimize_convex(lambda a: float(excess(a).max()), 1e-9 * self.alpha_max, self.alpha_max)
            values = excess(alpha)
            margin = -float(values.max())
        return alpha, margin, int(values.amax(0).argmax())

    def max_speed(self) -> float:
        """Largest factor on the rates for which some alpha has no negative margin."""
        if self.alpha_max <= 0.0:
            return 0.0
        root = spectral_map(self.stiffness, torch.rsqrt)

        def needed(inverse_alpha: float) -> float:
            rate = root @ (inverse_alpha * self.stiffness_rate + self.damping_rate) @ root
            return 0.5 * float(torch.linalg.eigvalsh(symmetrize(rate))[..., -1].max())

        slowest = 1.0 / self.alpha_max
        best = needed(_minimize_convex(needed, slowest, 1e3 * slowest))
        return 1.0 / best if best > 1e-12 else math.inf


def _minimize_convex(function: Callable[[float], float], low: float, high: float, n_steps: int = 45) -> float:
    """Where a convex function of one variable is smallest, by golden section; the ends are tried too."""
    first, last = low, high
    left, right = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
    at_left, at_right = function(left), function(right)
    for _ in range(n_steps):
        if at_left <= at_right:
            high, right, at_right = right, left, at_left
            left = high - _GOLDEN * (high - low)
            at_left = function(left)
        else:
            low, left, at_left = left, right, at_right
            right = low + _GOLDEN * (high - low)
            at_right = function(right)
    return min((first, last, left, right), key=function)


def _damping_rule(stiffness: Tensor, damping: Tensor, mass: Tensor) -> tuple[float, float, bool, float]:
    """Stiffness ratio, damping ratio it requires, whether one ratio makes the damping, and the smallest ratio."""
    inverse = spectral_map(mass, torch.rsqrt)
    stiff, damp = (symmetrize(inverse @ gain @ inverse) for gain in (stiffness, damping))
    eigenvalues = torch.linalg.eigvalsh(stiff)
    ratio = float(eigenvalues.max() / eigenvalues.min())
    root = spectral_map(stiff, lambda value: value.pow(-0.25))
    ratios = torch.linalg.eigvalsh(symmetrize(root @ damp @ root)) / 2.0
    smallest, largest = float(ratios.min()), float(ratios.max())
    return ratio, required_damping_ratio(ratio), largest - smallest <= 1e-6 * largest, smallest


def _gain(
    time: Float[Tensor, " n"], stiffness: Float[Tensor, "n d d"], damping: Float[Tensor, "n d d"], mass: Tensor
) -> float:
    """Largest ``||P_j^1/2 Phi(j, i) P_i^-1/2||`` over chosen i < j, with P = diag(K, M) and the exact maps Phi."""
    d = stiffness.shape[-1]
    rate = admittance_rate(stiffness[:-1], damping[:-1], mass)[..., : 2 * d, : 2 * d]
    maps = transition(rate * time.diff()[:, None, None], 1.0)
    begins, ends = _chosen_knots(stiffness)
    energy = torch.zeros_like(maps[:1]).repeat(len(time), 1, 1)
    energy[:, :d, :d], energy[:, d:, d:] = stiffness, mass
    root, inverse = spectral_map(energy, torch.sqrt), spectral_map(energy, torch.rsqrt)
    since = maps.new_zeros(0, 2 * d, 2 * d)
    largest = 1.0
    for tick, each in enumerate(maps):
        if tick in begins:
            since = torch.cat([since, inverse[tick : tick + 1]])
        since = each @ since
        if tick + 1 in ends:
            grown = root[tick + 1] @ since
            largest = max(largest, float(torch.linalg.eigvalsh(grown.mT @ grown)[:, -1].max()) ** 0.5)
    return largest


def _chosen_knots(stiffness: Tensor) -> tuple[set[int], set[int]]:
    """Knots to begin and to end at: evenly spaced ones, and those before and after the steepest rises."""
    n_knots = len(stiffness)
    root = spectral_map(stiffness[:-1], torch.rsqrt)
    rise = torch.linalg.eigvalsh(symmetrize(root @ stiffness.diff(dim=0) @ root))[:, -1]
    steepest = rise.topk(min(_MAX_KNOTS, n_knots - 1)).indices.tolist()
    even = set(torch.linspace(0, n_knots - 1, min(_MAX_KNOTS, n_knots)).round().long().tolist())
    return even | set(steepest), even | {knot + 1 for knot in steepest}


def _held_growth(
    time: Float[Tensor, " n"],
    stiffness: Float[Tensor, "n d d"],
    damping: Float[Tensor, "n d d"],
    mass: Tensor,
    alpha: float,
) -> float:
    """Largest eigenvalue of ``A' P_next A`` relative to P: A the exact map of an interval with its gains held."""
    if alpha <= 0.0:
        return math.nan
    d = stiffness.shape[-1]
    rate = admittance_rate(stiffness[:-1], damping[:-1], mass)[..., : 2 * d, : 2 * d]
    maps = transition(rate * time.diff()[:, None, None], 1.0)
    function = lyapunov_matrix(stiffness, damping, mass, alpha)
    inverse = torch.linalg.inv(torch.linalg.cholesky(function[:-1]))
    grown = inverse @ maps.mT @ function[1:] @ maps @ inverse.mT
    return float(torch.linalg.eigvalsh(symmetrize(grown)).max())

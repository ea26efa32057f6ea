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

from torch_pbd.control.damping import required_damping_ratio
from torch_pbd.control.matrices import as_mass, as_rows, as_semidefinite, check_positive
from torch_pbd.control.simulation.filters import lyapunov_matrix
from torch_pbd.control.simulation.position_loop import PositionLoop
from torch_pbd.control.simulation.transitions import admittance_rate, transition
from torch_pbd.control.stability.coupling import stiffest_environment
from torch_pbd.control.stability.lyapunov import has_common_function, minimize_convex
from torch_pbd.control.stability.report import GROWTH_ROUNDING, StabilityReport
from torch_pbd.linalg import spectral_map, symmetrize

_MAX_BEGINNINGS = 400  # of parts of the schedule that are followed at a time for their gain
_N_WORST = 32  # intervals at which a maximum over all is looked for; more change nothing, fewer are asked more often


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
        raise ValueError(f"position_loop is {position_loop!r}, must be a PositionLoop or None.")
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
    rate = admittance_rate(stiffness[:-1], damping[:-1], inertia)[..., : 2 * inertia.shape[0], : 2 * inertia.shape[0]]
    maps = transition(rate * (time / speed).diff()[:, None, None], 1.0)
    loop = PositionLoop() if position_loop is None else position_loop
    return StabilityReport(
        damping_ratio=smallest,
        stiffness_ratio=ratio,
        required_damping_ratio=required,
        stable_at_any_schedule=lawful,
        alpha=alpha,
        margin=margin,
        margin_time=float(time[worst]),
        held_growth=_held_growth(maps, stiffness, damping, inertia, alpha),
        max_speed=speed * knots.max_speed(),
        gain=_gain(maps, stiffness, inertia),
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

        def excess(alpha: float, rows: Any = slice(None)) -> Tensor:
            matrix = self.stiffness_rate[rows] + alpha * (self.damping_rate[rows] - 2.0 * self.stiffness[:, rows])
            return torch.linalg.eigvalsh(matrix)[..., -1].amax(0)

        if self.alpha_max <= 0.0:  # no damping somewhere: no alpha will do
            values = excess(0.0)
            return 0.0, min(-float(values.max()), -math.ulp(0.0)), int(values.argmax())
        alpha, values = _minimize_largest(excess, 1e-9 * self.alpha_max, self.alpha_max)
        return alpha, -float(values.max()), int(values.argmax())

    def max_speed(self) -> float:
        """Largest factor on the rates for which some alpha has no negative margin."""
        if self.alpha_max <= 0.0:
            return 0.0
        root = spectral_map(self.stiffness, torch.rsqrt)

        def needed(log_inverse_alpha: float, rows: Any = slice(None)) -> Tensor:
            rate = math.exp(log_inverse_alpha) * self.stiffness_rate[rows] + self.damping_rate[rows]
            return 0.5 * torch.linalg.eigvalsh(symmetrize(root[:, rows] @ rate @ root[:, rows]))[..., -1].amax(0)

        # By its logarithm, of which it still falls and then rises: where K falls and D rises alpha must be small.
        slowest = -math.log(self.alpha_max)
        best = float(_minimize_largest(needed, slowest, slowest + math.log(1e9))[1].max())
        return 1.0 / best if best > 1e-12 else math.inf


def _minimize_largest(function: Callable[..., Tensor], low: float, high: float) -> tuple[float, Tensor]:
    """Where the largest of many convex functions of one variable is smallest, and the values of all of them there.

    ``function(x, rows)`` has some of them. Most are never the largest: the search is among those that are so at an end
    and at the minima of the ones that were, until these are the largest of all.
    """
    found, values, rows = low, function(high), torch.empty(0, dtype=torch.long)
    while not len(rows) or values.max() > values[rows].max():
        rows = torch.cat([rows, values.topk(min(_N_WORST, len(values))).indices]).unique()
        found = minimize_convex(lambda x, rows=rows: float(function(x, rows).max()), low, high)
        values = function(found)
    return found, values


def _damping_rule(stiffness: Tensor, damping: Tensor, mass: Tensor) -> tuple[float, float, bool, float]:
    """Stiffness ratio, damping ratio it requires, whether one function falls at all knots, and the smallest ratio."""
    inverse = spectral_map(mass, torch.rsqrt)
    stiff, damp = (symmetrize(inverse @ gain @ inverse) for gain in (stiffness, damping))
    eigenvalues = torch.linalg.eigvalsh(stiff)
    ratio = float(eigenvalues.max() / eigenvalues.min())
    root = spectral_map(stiff, lambda value: value.pow(-0.25))
    ratios = torch.linalg.eigvalsh(symmetrize(root @ damp @ root)) / 2.0
    return ratio, required_damping_ratio(ratio), has_common_function(stiff, damp), float(ratios.min())


def _gain(maps: Float[Tensor, "m n n"], stiffness: Float[Tensor, "k d d"], mass: Tensor) -> float:
    """Largest ``||P_j^1/2 Phi(j, i) P_i^-1/2||`` over i < j, with P = diag(K, M) and the exact maps Phi."""
    energy = torch.stack([torch.block_diag(each, mass) for each in stiffness])
    root = torch.linalg.cholesky(energy).mT
    maps = torch.linalg.solve_triangular(root[:-1], root[1:] @ maps, upper=True, left=False)
    begun, identity = maps[:0], torch.eye(maps.shape[-1]).to(maps)
    largest = 1.0
    for each in maps:
        begun = each @ torch.cat([begun, identity[None]])
        squared = begun.mT @ begun
        # A part that has not grown so far gains no more than one that begins here. Whether all eigenvalues are below
        # a limit is seen sooner than what they are.
        grown = torch.linalg.cholesky_ex((1.0 + 1e-12) * identity - squared).info > 0
        begun, squared = begun[grown], squared[grown]
        record = torch.linalg.cholesky_ex(largest * (1.0 + 1e-12) * identity - squared).info > 0
        if bool(record.any()):
            largest = float(torch.linalg.eigvalsh(squared[record]).max())
        if len(begun) > _MAX_BEGINNINGS:
            begun = begun[torch.linalg.matrix_norm(begun).topk(_MAX_BEGINNINGS).indices]
    return math.sqrt(largest)


def _held_growth(maps: Tensor, stiffness: Tensor, damping: Tensor, mass: Tensor, alpha: float) -> float:
    """Largest eigenvalue of ``A' P_next A`` relative to P: A the exact map of an interval with its gains held.

    Of this alpha, or, where that grows, of a half or a quarter: at the largest some velocity does not damp V.
    """
    least = math.nan
    for each in (alpha, alpha / 2.0, alpha / 4.0) if alpha > 0.0 else ():
        function = lyapunov_matrix(stiffness, damping, mass, each)
        inverse = torch.linalg.inv(torch.linalg.cholesky(function[:-1]))
        grown = inverse @ maps.mT @ function[1:] @ maps @ inverse.mT
        growth = float(torch.linalg.eigvalsh(symmetrize(grown)).max())
        least = growth if math.isnan(least) else min(least, growth)
        if least <= 1.0 + GROWTH_ROUNDING:
            break
    return least

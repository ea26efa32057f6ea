"""Dynamic movement primitives, eq. (16) to (18), and their safe adaptation to other starts and goals."""

from contextlib import suppress
from dataclasses import KW_ONLY, dataclass
from itertools import pairwise
from typing import Any, Literal, final

import torch
from jaxtyping import Float
from torch import Tensor

from torch_pbd import checks
from torch_pbd.control.matrices import as_rows, as_tensor
from torch_pbd.linalg import broadcast_shapes

Gate = Literal["time", "phase", "none"]
Adaptation = Literal["safe", "additive"]

# Coefficients of the quintics of unit position, velocity and acceleration at 0 that are at rest at 0 from 1 on, and of
# their first and second derivatives.
_QUINTICS = [
    [[1.0, 0.0, 0.0, -10.0, 15.0, -6.0], [0.0, 1.0, 0.0, -6.0, 8.0, -3.0], [0.0, 0.0, 0.5, -1.5, 1.5, -0.5]],
    [[0.0, 0.0, -30.0, 60.0, -30.0, 0.0], [1.0, 0.0, -18.0, 32.0, -15.0, 0.0], [0.0, 1.0, -4.5, 6.0, -2.5, 0.0]],
    [[0.0, -60.0, 180.0, -120.0, 0.0, 0.0], [0.0, -36.0, 96.0, -60.0, 0.0, 0.0], [1.0, -9.0, 18.0, -10.0, 0.0, 0.0]],
]
_LEAST = 0.5  # least share of the duration to reach a late goal, at four times the acceleration of an early one
_BEYOND = 0.05  # allowed excess of the hull: half of the promised 10 %, as paths may exceed it between watched points
_WATCHED = 256  # points of the path that are checked against the hull


@final
@dataclass(eq=False)
class DMP:
    """Spring-damper towards a goal with a forcing term over a phase that encodes the movement.

    ``tau z' = alpha (beta (goal - x) - z) + gate f(s)``, ``tau x' = z``, ``tau s' = -gamma s`` with s(0) = 1. The
    forcing of a demonstration, eq. (18), drives it along that demonstration again.

    As printed, eq. (16) does not stop at the goal: f of a movement that ends with a velocity v_end holds the rest
    point at ``goal + tau v_end / beta``. A gate takes the forcing to zero after ``duration``; it is 1 before,
    where eq. (18) is therefore the inverse of eq. (16) with every gate.

    As printed ("additive"), another goal or start than the demonstrated one adds the response of the spring-damper, in
    0.5 tau whatever the duration. "safe" shifts both by minimum jerk over the duration. The acceleration is then at
    most 1.5 times that of the movement plus such a blend, and no coordinate leaves the hull of start, goal and
    demonstrated path by more than a tenth, as the path is flattened where necessary. A goal that changes on the way is
    reached at the end of the movement, or half a duration after the change if that is later.

    Parameters
    ----------
    alpha : float, default=25.0
        Positive gain of the velocity; the natural frequency is ``sqrt(alpha beta) / tau``.
    beta : float, default=None
        Positive gain of the position; None is ``alpha / 4``, critical damping. The damping ratio is
        ``sqrt(alpha / beta) / 2``: the paper's alpha = beta = 1 gives 0.5, which overshoots.
    gamma : float, default=0.7
        Positive decay rate of the phase.
    tau : float, default=1.0
        Time constant in s; doubling it halves the speed.
    duration : float, default=None
        Time in s at which, for this tau, the movement ends and the gate begins to close; None is never.
    gate : {"time", "phase", "none"}, default="time"
        Gate of the forcing: "time" closes over ``0.1 duration`` along a minimum-jerk curve, "phase" as the phase decays
        after ``duration``, s / s(duration), and "none" never, as in the paper.
    adaptation : {"safe", "additive"}, default="safe"
        Adaptation to other goals and starts; "additive" is the paper's. "safe" uses tau if there is no ``duration``.

    Raises
    ------
    ValueError
        If a parameter is invalid.

    References
    ----------
    A. Ijspeert, J. Nakanishi, H. Hoffmann, P. Pastor, S. Schaal, "Dynamical movement primitives: learning
    attractor models for motor behaviors", Neural Computation 25, 2013.

    Examples
    --------
    >>> import torch
    >>> dmp = DMP(duration=1.0)
    >>> position, velocity = dmp.rollout(torch.zeros(3001, 1).double(), 0.001, goal=torch.ones(1).double())
    >>> bool((position.diff(dim=0) > -1e-12).all() and position.max() < 1.0 + 1e-12), round(float(position[-1]), 4)
    (True, 1.0)
    """

    alpha: float = 25.0
    beta: float | Any = None
    gamma: float = 0.7
    tau: float = 1.0
    _: KW_ONLY
    duration: float | None = None
    gate: Gate = "time"
    adaptation: Adaptation = "safe"

    def __post_init__(self) -> None:
        self.alpha = checks.number(self.alpha, "alpha", above=0.0)
        self.beta = self.alpha / 4.0 if self.beta is None else checks.number(self.beta, "beta", above=0.0)
        self.gamma = checks.number(self.gamma, "gamma", above=0.0)
        self.tau = checks.number(self.tau, "tau", above=0.0, unit="s")
        self.duration = checks.number(self.duration, "duration", above=0.0, unit="s", optional=True)
        checks.choice(self.gate, "gate", Gate)
        checks.choice(self.adaptation, "adaptation", Adaptation)

    def phase(self, time: Tensor | Any) -> Tensor:
        """Phase s of eq. (17) at ``time`` in s, by its solution ``exp(-gamma time / tau)``."""
        return torch.exp(-self.gamma * as_tensor(time, "time") / self.tau)

    def gate_at(self, time: Tensor | Any) -> Tensor:
        """Factor of the forcing at ``time`` in s: 1 up to ``duration``."""
        time = as_tensor(time, "time")
        if self.gate == "none" or self.duration is None:
            return torch.ones_like(time)
        late = time - self.duration
        if self.gate == "phase":
            return self.phase(late.clamp_min(0.0))
        u = (late / (0.1 * self.duration)).clamp(0.0, 1.0)
        return 1.0 - u**3 * (10.0 - 15.0 * u + 6.0 * u**2)

    def forcing(
        self,
        position: Float[Tensor, "*b d"] | Any,
        velocity: Float[Tensor, "*b d"] | Any,
        acceleration: Float[Tensor, "*b d"] | Any,
        goal: Float[Tensor, "*g d"] | Any,
    ) -> Float[Tensor, "*b d"]:
        """Forcing that reproduces a motion, eq. (18), in the units of position.

        Raises
        ------
        ValueError
            If shapes disagree, or a value is not finite.
        """
        parts = {"position": position, "velocity": velocity, "acceleration": acceleration, "goal": goal}
        parts = {name: as_rows(part, name, 1) for name, part in parts.items()}
        _broadcast(parts)
        position, velocity, acceleration, goal = parts.values()
        spring = self.beta * (goal - position) - self.tau * velocity
        return self.tau**2 * acceleration - self.alpha * spring

    def rollout(
        self,
        forcing: Float[Tensor, "*b t d"] | Any,
        dt: float | Any,
        *,
        goal: Tensor | Any,
        position0: Float[Tensor, "*s d"] | Any = None,
        velocity0: Float[Tensor, "*s d"] | Any = None,
        demonstrated_start: Float[Tensor, "*s d"] | Any = None,
        demonstrated_goal: Float[Tensor, "*s d"] | Any = None,
    ) -> tuple[Float[Tensor, "*o t d"], Float[Tensor, "*o t d"]]:
        """Position and velocity at ticks of ``dt`` seconds, exact for forcing that is linear between them.

        Parameters
        ----------
        forcing : Tensor of shape (..., T, d)
            Forcing at the ticks, before the gate.
        dt : float
            Length of a tick in s.
        goal : Tensor of shape (d,), (..., 1, d) or (..., T, d)
            One goal, or the goal held over each tick, which may change during the movement.
        position0, velocity0 : Tensor of shape (..., d), default=None
            Initial state; None is the origin, at rest.
        demonstrated_start, demonstrated_goal : Tensor of shape (..., d), default=None
            Start and goal of the demonstrated movement, for "safe"; None takes ``position0`` and the first goal.

        Raises
        ------
        ValueError
            If a shape is wrong, or a value is not finite.
        """
        forcing, goal = as_rows(forcing, "forcing", 2), as_rows(goal, "goal", 1)
        time = torch.arange(forcing.shape[-2]).to(goal) * checks.number(dt, "dt", above=0.0, unit="s")
        places = {"position0": position0, "velocity0": velocity0}
        places |= {"demonstrated_start": demonstrated_start, "demonstrated_goal": demonstrated_goal}
        rows = {name: as_rows(place, name, 1)[..., None, :] for name, place in places.items() if place is not None}
        rows |= {"forcing": forcing * self.gate_at(time)[:, None], "goal": goal if goal.ndim > 1 else goal[None]}
        shape = _broadcast(rows, len(time))
        rows = {name: part.expand(shape) for name, part in rows.items()}
        at_ticks, goals, still = rows["forcing"], rows["goal"], goal.new_zeros(shape)
        start, velocity = (rows.get(name, still)[..., 0, :] for name in ("position0", "velocity0"))
        own_start = rows.get("demonstrated_start", rows.get("position0", still))[..., 0, :]
        own_goal = rows.get("demonstrated_goal", goals)[..., 0, :]
        # A safe adaptation reproduces the demonstrated movement, and moves its path to the other start and goals.
        same = bool((own_start == start).all() and (goals == own_goal[..., None, :]).all())
        safe = self.adaptation == "safe" and not same
        driven = own_goal[..., None, :].expand(shape) if safe else goals
        begin = torch.stack([own_start if safe else start, self.tau * velocity], dim=-1)
        position, scaled = self._solve(at_ticks, driven, float(dt), begin).unbind(-1)
        if not safe:
            return position, scaled / self.tau
        acceleration = (self.alpha * (self.beta * (driven - position) - scaled) + at_ticks) / self.tau**2  # eq. (16)
        path, ends = [position, scaled / self.tau, acceleration], {"own_goal": own_goal, "goals": goals, "start": start}
        motion = adapt(torch.stack(path), time, (position, time), **ends, duration=self.duration or self.tau)
        return motion[0], motion[1]

    def _solve(self, forcing: Tensor, goals: Tensor, dt: float, state: Tensor) -> Tensor:
        """States at the ticks, exact for forcing that is linear between them and goals held over them."""
        # Over a tick [x, z, goal, forcing, rise] has constant coefficients: the forcing grows by the rise, which like
        # the goal stays. The matrix exponential of a tick is its map.
        rate = state.new_zeros(5, 5)
        eq16 = [[0.0, 1.0, 0.0, 0.0], [-self.alpha * self.beta, -self.alpha, self.alpha * self.beta, 1.0]]
        rate[:2, :4] = state.new_tensor(eq16) / self.tau * dt
        rate[3, 4] = 1.0
        passed_on, added = torch.linalg.matrix_exp(rate)[:2].mT.split([2, 3])
        inputs = torch.stack([goals[..., :-1, :], forcing[..., :-1, :], forcing.diff(dim=-2)], dim=-1)
        # The effect of goal and forcing is computed for all ticks at once; only the states are sequential.
        states = [state]
        for increment in (inputs @ added).unbind(dim=-3):
            states.append(states[-1] @ passed_on + increment)
        return torch.stack(states, dim=-3)


def _broadcast(parts: dict[str, Tensor], n_ticks: int | None = None) -> torch.Size:
    """Shape (..., d), or (..., n_ticks, d), to which all parts broadcast; outputs do not."""
    shapes = {name: tuple(part.shape) for name, part in parts.items()}
    with suppress(RuntimeError):
        common = broadcast_shapes(*(part.shape for part in parts.values()))
        if n_ticks in (None, common[-2]) and all(shape[-1] == common[-1] for shape in shapes.values()):
            return common
    raise ValueError(f"shapes are {shapes}, must be of the same movements, ticks and outputs.")


def adapt(
    path: Float[Tensor, "3 *b t d"],
    time: Float[Tensor, " t"],
    whole: tuple[Float[Tensor, "*b m d"], Float[Tensor, " m"]],
    *,
    own_goal: Float[Tensor, "*#b d"],
    goals: Float[Tensor, "*#b t d"],
    start: Float[Tensor, "*#b d"],
    duration: float,
) -> Float[Tensor, "3 *b t d"]:
    """Position, velocity and acceleration of a path at given times, adapted to another start and other goals.

    With u the path relative to its own goal, the motion is ``goal + k u + c``: c takes start and goal along, by minimum
    jerk over the duration, so that with k = 1 the acceleration is the sum of both. Where this would leave the hull of
    start, goal and the whole path (positions, times), k is less: a mean of that motion and of the straight minimum
    jerk. Where the goal changes, k and c are chosen anew so that the motion goes on smoothly. k never grows.
    """
    relative = torch.stack([path[0] - own_goal.unsqueeze(-2), *path[1:]], dim=-1)
    stride = -(-len(whole[1]) // _WATCHED)
    shown, watched = whole[0][..., ::stride, :], whole[1][::stride]
    rest = torch.zeros_like(start + own_goal + goals[..., 0, :])
    low, high = torch.minimum(shown.amin(-2), start), torch.maximum(shown.amax(-2), start)
    # The first tick has the speed of k u: the straight motion begins at rest.
    state, own = _still(start - goals[..., 0, :]), _still(rest + relative[..., 0, :, 0])
    keep, moved = rest + 1.0, rest == 0.0
    since, until, carry, parts = rest, rest, _still(rest), list[Tensor]()
    changes = (goals.diff(dim=-2) != 0.0).movedim(-2, 0).flatten(1).any(1).nonzero().flatten() + 1
    for first, last in pairwise([0, *changes.tolist(), len(time)]):
        now, goal = time[first], rest + goals[..., first, :]
        # Where the goal changes, the motion under way is what the next part begins with.
        if first:
            own, state = relative[..., first, :, :], parts[-1][..., -1, :, :] - _still(goal)
            moved = goal != goals[..., first - 1, :]
        horizon = (duration - now).clamp_min(_LEAST * duration)
        ahead = _quintics((watched - now) / horizon, horizon)[:, 0]
        along = goal.unsqueeze(-2) + ahead @ state.mT
        bend = (shown - own_goal.unsqueeze(-2) - ahead @ own.mT).masked_fill((watched < now)[:, None], 0.0)
        room = _room(along, bend, torch.minimum(low, goal), torch.maximum(high, goal))
        keep = torch.where(moved, torch.minimum(keep, room), keep)
        carry = torch.where(moved.unsqueeze(-1), state - keep.unsqueeze(-1) * own, carry)
        since, until = torch.where(moved, now, since), torch.where(moved, now + horizon, until)
        # The motion at the ticks up to that of the next change, whose state begins the next part.
        ticks, lasting = slice(first, last + 1), (until - since).unsqueeze(-2)
        carried = _quintics((time[ticks, None] - since.unsqueeze(-2)) / lasting, lasting) @ carry[..., None, :, :, None]
        shape = keep[..., None, :, None] * relative[..., ticks, :, :]
        parts.append(_still(goal).unsqueeze(-3) + shape + carried.squeeze(-1))
    motion = torch.cat([*(part[..., :-1, :, :] for part in parts[:-1]), parts[-1]], dim=-3)
    return motion.movedim(-1, 0)


def _quintics(share: Float[Tensor, "*m"], horizon: Tensor) -> Float[Tensor, "*m 3 3"]:
    """Derivatives of order 0 to 2, by time, of the three quintics at shares of the horizon."""
    powers = share.clamp(0.0, 1.0).unsqueeze(-1) ** torch.arange(6).to(share)
    order = torch.arange(3).to(share)
    rates = torch.einsum("...k, opk -> ...op", powers, torch.tensor(_QUINTICS).to(share))
    return rates * horizon[..., None, None] ** (order - order[:, None])


def _still(position: Float[Tensor, "*b d"]) -> Float[Tensor, "*b d 3"]:
    """States at rest at these positions."""
    return torch.nn.functional.pad(position.unsqueeze(-1), (0, 2))


def _room(along: Tensor, bend: Tensor, low: Tensor, high: Tensor) -> Float[Tensor, "*b d"]:
    """Share of a bend (..., m, d) that keeps motions within low and high (..., d), or no further out than without."""
    margin = _BEYOND * (high - low)
    above, below = (high + margin).unsqueeze(-2) - along, along - (low - margin).unsqueeze(-2)
    space = torch.where(bend > 0.0, above, below).clamp_min(0.0)
    return (space / torch.where(bend == 0.0, torch.finfo(bend.dtype).tiny, bend.abs())).amin(-2)

"""Other starts and goals than those that were demonstrated, without a throw: ``adaptation="safe"``."""

from itertools import pairwise
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

Adaptation = Literal["safe", "additive"]

# Coefficients of the quintics of unit position, velocity and acceleration at 0 that are at rest at 0 from 1 on, and of
# their first and second derivatives.
_QUINTICS = [
    [[1.0, 0.0, 0.0, -10.0, 15.0, -6.0], [0.0, 1.0, 0.0, -6.0, 8.0, -3.0], [0.0, 0.0, 0.5, -1.5, 1.5, -0.5]],
    [[0.0, 0.0, -30.0, 60.0, -30.0, 0.0], [1.0, 0.0, -18.0, 32.0, -15.0, 0.0], [0.0, 1.0, -4.5, 6.0, -2.5, 0.0]],
    [[0.0, -60.0, 180.0, -120.0, 0.0, 0.0], [0.0, -36.0, 96.0, -60.0, 0.0, 0.0], [1.0, -9.0, 18.0, -10.0, 0.0, 0.0]],
]
_LEAST = 0.5  # of the duration, for a goal that changes late: four times the acceleration of one known at the start
_BEYOND = 0.05  # of the hull: half of the 10 % that is promised, for what lies between the watched points
_WATCHED = 256  # points of the path, of which none may leave the hull


def adapt(
    path: tuple[Float[Tensor, "*b t d"], ...],
    time: Float[Tensor, " t"],
    whole: tuple[Float[Tensor, "*b m d"], Float[Tensor, " m"]],
    *,
    own_goal: Float[Tensor, "*b d"],
    goals: Float[Tensor, "*b t d"],
    start: Float[Tensor, "*b d"],
    duration: float,
) -> tuple[Float[Tensor, "*b t d"], Float[Tensor, "*b t d"], Float[Tensor, "*b t d"]]:
    """Position, velocity and acceleration at times of a path of these, from another start, to other goals.

    With u the path relative to its own goal, the motion is ``goal + k u + c``: c takes start and goal along, by minimum
    jerk over the duration, so that with k = 1 the acceleration is the sum of both. Where this would leave the hull of
    start, goal and the whole path (positions, times), k is less: the motion is then a mean of that one and of the
    straight minimum jerk, whose peak acceleration is 10 / sqrt(3) where that of any in this time is 4 or more.

    Where the goal changes, k and c are chosen anew so that position, velocity and acceleration go on; it is reached
    when the movement ends, or half a duration after it changed if that is later. k never grows again.
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
    position, velocity, acceleration = motion.unbind(-1)
    return position, velocity, acceleration


def _quintics(share: Float[Tensor, "*m"], horizon: Tensor) -> Float[Tensor, "*m 3 3"]:
    """Derivatives of order 0 to 2, by time, of the three quintics at shares of the horizon."""
    powers = share.clamp(0.0, 1.0).unsqueeze(-1) ** torch.arange(6).to(share)
    order = torch.arange(3).to(share)
    rates = torch.einsum("...k, opk -> ...op", powers, torch.tensor(_QUINTICS).to(share))
    return rates * horizon[..., None, None] ** (order - order[:, None])


def _still(position: Float[Tensor, "*b d"]) -> Float[Tensor, "*b d 3"]:
    """States at rest."""
    return torch.nn.functional.pad(position.unsqueeze(-1), (0, 2))


def _room(along: Tensor, bend: Tensor, low: Tensor, high: Tensor) -> Float[Tensor, "*b d"]:
    """Share of a bend (..., m, d) that keeps motions within low and high (..., d), or as far out as without it."""
    margin = _BEYOND * (high - low)
    above, below = (high + margin).unsqueeze(-2) - along, along - (low - margin).unsqueeze(-2)
    space = torch.where(bend > 0.0, above, below).clamp_min(0.0)
    return (space / torch.where(bend == 0.0, torch.finfo(bend.dtype).tiny, bend.abs())).amin(-2)

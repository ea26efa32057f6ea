"""Other starts and goals than those that were demonstrated, without a throw: ``adaptation="safe"``."""

import math
from itertools import pairwise
from typing import Literal, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

Adaptation = Literal["safe", "additive"]

# Coefficients of the quintics of unit position, velocity and acceleration at 0 that are at rest at 0 from 1 on.
_QUINTICS = [[1.0, 0.0, 0.0, -10.0, 15.0, -6.0], [0.0, 1.0, 0.0, -6.0, 8.0, -3.0], [0.0, 0.0, 0.5, -1.5, 1.5, -0.5]]
_LEAST = 0.5  # of the duration, for a goal that changes late: four times the acceleration of one known at the start
_BEYOND = 0.05  # of the hull: half of the 10 % that is promised, for what lies between the points looked at
_WATCHED = 256  # points of the path that are looked at


class Quintic(NamedTuple):
    """Motions of d axes by minimum jerk, from states at ``since`` to rest at 0 after ``horizon``."""

    state: Float[Tensor, "*b d 3"]
    since: Float[Tensor, "*b d"]
    horizon: Float[Tensor, "*b d"]

    def at(self, time: Float[Tensor, " m"], order: int = 0) -> Float[Tensor, "*b m d"]:
        """The motion at times that are not before ``since``, or its derivative of this order."""
        rows = [[math.perm(n, order) * c for n, c in enumerate(row)][order:] for row in _QUINTICS]
        share = ((time[:, None] - self.since.unsqueeze(-2)) / self.horizon.unsqueeze(-2)).clamp(0.0, 1.0)
        powers = share.unsqueeze(-1) ** torch.arange(6 - order).to(share)
        size = self.state * self.horizon.unsqueeze(-1) ** (torch.arange(3).to(share) - order)
        return ((powers @ torch.tensor(rows).to(share).mT) * size.unsqueeze(-3)).sum(-1)


def adapt(
    path: tuple[Float[Tensor, "*b t d"], ...],
    time: Float[Tensor, " t"],
    whole: tuple[Float[Tensor, "*b m d"], Float[Tensor, " m"]],
    *,
    own_goal: Float[Tensor, "*b d"],
    goals: Float[Tensor, "*b t d"],
    start: Float[Tensor, "*b d"],
    duration: float,
) -> tuple[Float[Tensor, "*b t d"], Float[Tensor, "*b t d"]]:
    """Position and velocity of a demonstrated movement to other goals, from another start.

    With u the demonstrated path relative to its own goal, the motion is ``goal + k u + c``: c takes start and goal
    along, by minimum jerk over the duration, so that with k = 1 the acceleration is the sum of both. Where this would
    leave the hull of start, goal and demonstrated path, k is less: the motion is then a mean of that one and of the
    straight minimum jerk, whose peak acceleration is 10 / sqrt(3) where that of any in this time is 4 or more.

    Where the goal changes, k and c are chosen anew so that position, velocity and acceleration go on; it is reached
    when the movement ends, or half a duration after it changed if that is later. k never grows again.

    Parameters
    ----------
    path : position, velocity, acceleration, each a Tensor of shape (..., T, d)
        Of the demonstrated movement at the ticks.
    time : Tensor of shape (T,)
        Of the ticks, s.
    whole : Tensor of shape (..., m, d), Tensor of shape (m,)
        Positions of the whole movement, and their times.
    own_goal, start : Tensor of shape (..., d)
        Where the demonstrated movement leads, and where the motion starts.
    goals : Tensor of shape (..., T, d)
        Held over each tick.
    duration : float
        Of the movement, s.
    """
    relative = (path[0] - own_goal.unsqueeze(-2), *path[1:])
    stride = -(-len(whole[1]) // _WATCHED)
    shown, watched = whole[0][..., ::stride, :], whole[1][::stride]
    rest = torch.zeros_like(start + own_goal + goals[..., 0, :])
    keep, carry, parts = rest + 1.0, Quintic(_still(rest), rest, rest + duration), []
    changes = (goals.diff(dim=-2) != 0.0).movedim(-2, 0).flatten(1).any(1).nonzero().flatten() + 1
    for first, last in pairwise([0, *changes.tolist(), len(time)]):
        now, goal = time[first], rest + goals[..., first, :]
        if first == 0:  # its speed is that of k u: the straight motion begins at rest
            own, state, moved = _still(rest + relative[0][..., 0, :]), _still(start - goal), rest == 0.0
        else:
            own, before = torch.stack([part[..., first, :] for part in relative], dim=-1), goals[..., first - 1, :]
            carried = torch.stack([carry.at(now[None], order)[..., 0, :] for order in range(3)], dim=-1)
            state, moved = keep.unsqueeze(-1) * own + carried + _still(before - goal), goal != before
        horizon = rest + max(duration - float(now), _LEAST * duration)
        straight, shape = (Quintic(each, rest + now, horizon) for each in (state, own))
        along = goal.unsqueeze(-2) + straight.at(watched)
        bend = shown - own_goal.unsqueeze(-2) - shape.at(watched)
        room = _room(along, bend, _hull(shown, start, goal)).masked_fill((watched < now)[:, None], math.inf)
        keep = torch.where(moved, torch.minimum(keep, room.amin(-2)), keep)
        turned = state - keep.unsqueeze(-1) * own
        carry = Quintic(
            torch.where(moved.unsqueeze(-1), turned, carry.state),
            torch.where(moved, now, carry.since),
            torch.where(moved, horizon, carry.horizon),
        )
        ticks, kept = slice(first, last), keep.unsqueeze(-2)
        position = goal.unsqueeze(-2) + kept * relative[0][..., ticks, :] + carry.at(time[ticks])
        parts.append((position, kept * relative[1][..., ticks, :] + carry.at(time[ticks], 1)))
    position, velocity = (torch.cat(part, dim=-2) for part in zip(*parts, strict=True))
    return position, velocity


def _still(position: Float[Tensor, "*b d"]) -> Float[Tensor, "*b d 3"]:
    """States at rest."""
    return torch.nn.functional.pad(position.unsqueeze(-1), (0, 2))


def _hull(path: Float[Tensor, "*b m d"], *ends: Float[Tensor, "*b d"]) -> tuple[Tensor, Tensor]:
    """Least and largest of a path and its ends, each (..., d), and a little beyond."""
    low, high = path.amin(-2), path.amax(-2)
    for end in ends:
        low, high = torch.minimum(low, end), torch.maximum(high, end)
    return low - _BEYOND * (high - low), high + _BEYOND * (high - low)


def _room(along: Float[Tensor, "*b m d"], bend: Float[Tensor, "*b m d"], hull: tuple[Tensor, Tensor]) -> Tensor:
    """How much of a bend (..., m, d) keeps a motion within the hull, or no farther out than without it."""
    low, high = (limit.unsqueeze(-2) for limit in hull)
    inwards = torch.where(bend > 0.0, (high - along).clamp_min(0.0), (along - low).clamp_min(0.0))
    return inwards / torch.where(bend == 0.0, torch.finfo(bend.dtype).tiny, bend.abs())

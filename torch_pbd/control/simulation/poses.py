"""Orientations of a run in tensors: how the desired one turns from tick to tick, and the robot away from it.

The rotation of the robot R from the desired R_d is the vector ``e = Log(R R_d')``, in world axes. In a tick, R_d stands
still and e moves with the angular velocity w; at its end R_d turns by ``delta``, and e becomes
``exp([delta]) (e - delta)``. Of a robot that turned by delta itself, so that e had become ``e + delta``, this is exact:
R and R_d are then both turned in the world, and e with them. It is the discrete form of ``e' = w - w_d + w_d x e``, to
first order in e.
"""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torch_pbd import checks

# rad. The path of a push is off by about a sixth of its largest angle, of that angle: a quarter here.
_FAR = 0.5 * math.pi


def multiply(first: Float[Tensor, "*a 4"], second: Float[Tensor, "*b 4"]) -> Float[Tensor, "*c 4"]:
    """Product of quaternions w x y z: the rotation by ``second``, then by ``first``."""
    (a, v), (b, w) = (each.split([1, 3], dim=-1) for each in torch.broadcast_tensors(first, second))
    return torch.cat([a * b - (v * w).sum(-1, keepdim=True), a * w + b * v + torch.linalg.cross(v, w)], dim=-1)


def exp(vector: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 4"]:
    """Quaternion of a rotation vector."""
    half = 0.5 * torch.linalg.vector_norm(vector, dim=-1, keepdim=True)
    return torch.cat([torch.cos(half), 0.5 * torch.sinc(half / math.pi) * vector], dim=-1)


def rotation_between(start: Float[Tensor, "*a 4"], end: Float[Tensor, "*b 4"]) -> Float[Tensor, "*c 3"]:
    """Rotation vector in world axes from one orientation to another, the shorter way: at most pi long."""
    nearer = torch.where((end * start).sum(-1, keepdim=True) < 0.0, -end, end)
    conjugate = torch.cat([start[..., :1], -start[..., 1:]], dim=-1)
    # Of the difference, so that small rotations keep their digits: q2 q1' = 1 + (q2 - q1) q1'.
    away, xyz = multiply(nearer - start, conjugate).split([1, 3], dim=-1)
    length = torch.linalg.vector_norm(xyz, dim=-1, keepdim=True)
    tiny = length < torch.finfo(length.dtype).tiny
    angle = 2.0 * torch.atan2(length, 1.0 + away)
    return torch.where(tiny, 2.0, angle / torch.where(tiny, 1.0, length)) * xyz


def warn_if_far(angle: float) -> None:
    """Warn where the robot is so far from the desired orientation that a linear model is no longer one."""
    if angle > _FAR:
        checks.warn(
            f"The robot is turned by up to {angle:.2g} rad from the desired orientation, where the linear plant "
            "is off by a quarter of the path or more: push less, or raise the stiffness of rotations."
        )


class Turning(NamedTuple):
    """Desired orientations (..., T, 4) of a task, with the turns (..., T, 3) that end its ticks, none the last.

    ``transport`` (..., T, 3, 3) is ``exp([turn])``, which takes along what turns with the desired orientation.
    """

    orientation: Tensor
    turns: Tensor
    transport: Tensor


def turning(orientation: Float[Tensor, "*b t 4"]) -> Turning:
    """Turns of unit quaternions from tick to tick."""
    turns = rotation_between(orientation[..., :-1, :], orientation[..., 1:, :])
    turns = torch.nn.functional.pad(turns, (0, 0, 0, 1))
    rows = torch.linalg.cross(turns.unsqueeze(-2), torch.eye(3).to(turns).expand(*turns.shape, 3))
    return Turning(orientation, turns, torch.linalg.matrix_exp(rows.mT))

"""Walls of the tunnel task around the simulated robot."""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple, final

import torch
from jaxtyping import Float
from torch import Tensor

from torch_pbd import checks
from torch_pbd.control.matrices import as_rows, as_tensor
from torch_pbd.exceptions import InvalidParameterError

_WAVE_NUMBER = 2.0 * math.pi / 0.6  # one period over the path, 1/m


def corridor(y: Float[Tensor, "*b"]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Centre line, its slope, half width and its slope at y in m: `torch_pbd.data.synthetic` in torch."""
    # Slopes in closed form, because autograd takes several times as long as all else in a tick.
    s = ((y - 0.2) / 0.25).clamp(0.0, 1.0)
    return (
        0.02 * torch.sin(_WAVE_NUMBER * y),
        0.02 * _WAVE_NUMBER * torch.cos(_WAVE_NUMBER * y),
        0.12 - 0.11 * s * s * (3.0 - 2.0 * s),
        -0.11 * 6.0 / 0.25 * s * (1.0 - s),
    )


class ContactReport(NamedTuple):
    """Contacts of a rollout with the walls; a batch of rollouts has a value for each.

    Attributes
    ----------
    max_penetration : (...), m
        Largest depth beyond a wall; 0 without contact.
    time_in_wall : (...), s
        Number of ticks that start beyond a wall, times dt.
    impulse : (...), N s
        Sum of the wall force's magnitude times dt; 0 for a virtual wall.
    """

    max_penetration: Float[Tensor, "*b"]
    time_in_wall: Float[Tensor, "*b"]
    impulse: Float[Tensor, "*b"]


@final
@dataclass(frozen=True)
class Tunnel:
    """Corridor of the task in the plane, along y, between two smooth walls without friction.

    The wall is a spring and a damper along its normal, only while it is penetrated, and it never pulls. Depth and
    normal are to first order, with a relative error of about the depth times the curvature of the wall. Positions
    (..., 2) are x and y in m; NaN propagates.

    Parameters
    ----------
    stiffness : float, default=1e4
        Stiffness of the walls [N/m].
    damping : float or None, default=None
        Damping of the walls [N s/m]. None is ``sqrt(stiffness)``: half the critical damping of 1 kg.
    virtual : bool, default=False
        Whether the wall is only displayed, as in the paper: penetration counts but there is no force.

    Notes
    -----
    A force that is held for a tick h makes the wall return more energy than it absorbed unless the damping is large
    enough; too much overshoots. A free mass m pressed against the wall can rest there if and only if
    ``stiffness h / 2 < damping < 2 m / h`` (Jury's test on the sampled mass), which the default damping meets below
    4 MN/m at 1 kHz, for masses above 0.05 kg (0.16 kg at 1e5 N/m). Else compute the force several times a tick. Behind
    a position loop that lags, the limit is lower by far: see `StabilityReport.environment_stiffness`.

    References
    ----------
    Colgate and Schenkel, Passivity of a class of sampled-data systems: application to haptic interfaces, Journal
    of Robotic Systems 14(1), 1997: with a hand on the device the damping must also come from the device.
    """

    stiffness: float = 1e4
    damping: float | None = None
    virtual: bool = False

    def __post_init__(self) -> None:
        checks.number(self.stiffness, "stiffness", above=0.0, unit="N/m", remedy="virtual=True is no wall")
        checks.number(self.damping, "damping", least=0.0, unit="N s/m", optional=True)
        checks.flag(self.virtual, "virtual")

    def penetration(self, position: Float[Tensor, "*b 2"] | Any) -> Float[Tensor, "*b"]:
        """Depth beyond the nearer wall [m], along its normal: ``(|x - x_c| - w) / sqrt(1 + slope^2)``, or 0."""
        return self._contact(position)[0].clamp_min(0.0)

    def force(
        self, position: Float[Tensor, "*b 2"] | Any, velocity: Float[Tensor, "*b 2"] | Any
    ) -> Float[Tensor, "*b 2"]:
        """Force of the wall [N] on a robot at ``position`` with ``velocity`` (..., 2), in m and m/s."""
        position, velocity = as_tensor(position, "position"), as_tensor(velocity, "velocity")
        depth, normal = self._contact(position)
        if position.shape != velocity.shape:
            raise InvalidParameterError(
                f"velocity has shape {tuple(velocity.shape)}, must have shape {tuple(position.shape)}, as position."
            )
        if self.virtual:
            return torch.zeros_like(position)
        damping = math.sqrt(self.stiffness) if self.damping is None else self.damping
        closing = -(velocity * normal).sum(-1)
        press = (self.stiffness * depth + damping * closing).clamp_min(0.0)
        return torch.where(depth <= 0.0, 0.0, press).unsqueeze(-1) * normal

    def report(
        self, rollout_position: Float[Tensor, "*b t 2"] | Any, velocity: Float[Tensor, "*b t 2"] | Any, dt: float
    ) -> ContactReport:
        """Contacts of a rollout: positions and velocities (..., T, 2) at the start of ticks of ``dt`` s, all finite."""
        checks.number(dt, "dt", above=0.0, unit="s")
        rollout_position, velocity = as_rows(rollout_position, "rollout_position", 2), as_rows(velocity, "velocity", 2)
        depth = self.penetration(rollout_position)
        press = torch.linalg.vector_norm(self.force(rollout_position, velocity), dim=-1)
        return ContactReport(depth.amax(-1), dt * (depth > 0.0).sum(-1).to(depth), dt * press.sum(-1))

    def _contact(self, position: Tensor | Any) -> tuple[Tensor, Tensor]:
        """Depth along the normal of the nearer wall, negative in the free corridor, and the normal into it."""
        position = as_tensor(position, "position")
        if position.ndim == 0 or position.shape[-1] != 2:
            raise InvalidParameterError(f"position has shape {tuple(position.shape)}, must have shape (..., 2).")
        x, y = position.unbind(-1)
        center, center_slope, half_width, half_width_slope = corridor(y)
        # The wall is the zero of g = side (x - x_c(y)) - w(y), the depth g / |grad g|, the normal -grad g / |grad g|.
        offset = x - center
        side = torch.copysign(torch.ones_like(x), offset.detach())
        slope = center_slope + side * half_width_slope
        steepness = (1.0 + slope.square()).sqrt()
        depth = (side * offset - half_width) / steepness
        return depth, torch.stack([-side, side * slope], dim=-1) / steepness.unsqueeze(-1)

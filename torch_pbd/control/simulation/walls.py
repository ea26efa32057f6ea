"""What surrounds the simulated robot: the walls of the tunnel task."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from numbers import Real
from typing import Any, final

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torch_pbd.control.matrices import as_tensor, check_flag, is_finite

Curve = Callable[[Tensor], Tensor]

_WAVE_NUMBER = 2.0 * math.pi / 0.6  # one period over the path, 1/m


def tunnel_center(y: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
    """Centre line of the task: x in m at y in m; `torch_pbd.data.synthetic.tunnel_center` in torch."""
    return 0.02 * torch.sin(_WAVE_NUMBER * y)


def tunnel_half_width(y: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
    """Half the width of the task's tunnel, in m at y in m; `torch_pbd.data.synthetic.tunnel_half_width` in torch."""
    s = ((y - 0.2) / 0.25).clamp(0.0, 1.0)
    return 0.12 - 0.11 * s * s * (3.0 - 2.0 * s)


def _center_slope(y: Tensor) -> Tensor:
    return 0.02 * _WAVE_NUMBER * torch.cos(_WAVE_NUMBER * y)


def _half_width_slope(y: Tensor) -> Tensor:
    s = ((y - 0.2) / 0.25).clamp(0.0, 1.0)
    return -0.11 * 6.0 / 0.25 * s * (1.0 - s)


# Autograd gives the same, at several times the cost of all else in a tick.
_SLOPES: tuple[tuple[Curve, Curve], ...] = ((tunnel_center, _center_slope), (tunnel_half_width, _half_width_slope))


@final
class Tunnel:
    """A corridor in the plane, along y, between two smooth walls without friction.

    The wall is a spring and a damper along its normal, only while it is penetrated, and it never pulls. Depth and
    normal are to first order at the y of the position: exact for straight walls, otherwise with a relative error
    of about the depth times the curvature of the wall.

    Parameters
    ----------
    stiffness : float, default=1e4
        Of the wall [N/m].
    damping : float or None, default=None
        Of the wall [N s/m]. None is ``sqrt(stiffness)``: half the critical damping of 1 kg, 100 N s/m by default.
    virtual : bool, default=False
        A drawn wall, as on the display of the paper: penetration counts but there is no force.
    center, half_width : callable, default=tunnel_center, tunnel_half_width
        x of the centre line and half the width [m] at y [m], element by element; by default those of the tunnel
        task. The slopes of other curves come from autograd, so they must be made of torch operations; no gradient
        flows into parameters of theirs by way of the slope.

    Raises
    ------
    ValueError
        If ``stiffness`` is not finite and above zero, or ``damping`` not finite and at least zero.

    Notes
    -----
    A force that is held for a tick h makes the wall give back more energy than it took, unless there is enough
    damping; too much overshoots. A free mass m pressed against the wall can rest there if and only if
    ``stiffness h / 2 < damping < 2 m / h`` (Jury's test on the sampled mass). The default damping meets it below
    4 MN/m at 1 kHz, for masses above 0.05 kg (0.16 kg at 1e5 N/m). Where it is not met, compute the force several
    times a tick. Behind a position loop that lags, the limit is lower by far: about the damping of the admittance
    over the lag, 400 N/m in the soft phase of the paper (1 kg, loop of 20 Hz).

    References
    ----------
    Colgate and Schenkel, Passivity of a class of sampled-data systems: application to haptic interfaces, Journal
    of Robotic Systems 14(1), 1997: with a hand on the device the damping must also come from the device.
    """

    def __init__(
        self,
        stiffness: float = 1e4,
        damping: float | None = None,
        virtual: bool = False,
        *,
        center: Curve = tunnel_center,
        half_width: Curve = tunnel_half_width,
    ) -> None:
        if not (_is_number(stiffness) and stiffness > 0):
            raise ValueError(
                f"stiffness={stiffness!r} must be finite and above 0, in N/m; virtual=True is no wall at all."
            )
        if damping is not None and not (_is_number(damping) and damping >= 0):
            raise ValueError(f"damping={damping!r} must be finite and at least 0, in N s/m, or None.")
        check_flag("virtual", virtual)
        for name, curve in (("center", center), ("half_width", half_width)):
            if not callable(curve):
                raise ValueError(f"{name}={curve!r} must be a function of y, of torch operations.")
        self.stiffness = stiffness
        self.damping = math.sqrt(stiffness) if damping is None else damping
        self.virtual = virtual
        self.center = center
        self.half_width = half_width

    def penetration(self, position: Float[Tensor, "*b 2"] | Any) -> Float[Tensor, "*b"]:
        """Depth beyond the nearer wall [m], along its normal: ``(|x - x_c| - w) / sqrt(1 + slope^2)``, or 0.

        Parameters
        ----------
        position : Tensor of shape (..., 2)
            x and y [m]. NaN stays NaN.
        """
        return self._contact(position)[0].clamp_min(0.0)

    def normal(self, position: Float[Tensor, "*b 2"] | Any) -> Float[Tensor, "*b 2"]:
        """Unit normal of the nearer wall, pointing into the corridor; on the centre line, that of the right wall."""
        return self._contact(position)[1]

    def force(
        self, position: Float[Tensor, "*b 2"] | Any, velocity: Float[Tensor, "*b 2"] | Any
    ) -> Float[Tensor, "*b 2"]:
        """Force of the wall on what is at ``position`` [N].

        Parameters
        ----------
        position : Tensor of shape (..., 2)
            x and y [m]. NaN gives a force of NaN, not of zero.
        velocity : Tensor of shape (..., 2)
            In m/s.

        Raises
        ------
        ValueError
            If shapes differ or the last dimension is not 2.
        """
        position, velocity = as_tensor(position, "position"), as_tensor(velocity, "velocity")
        depth, normal = self._contact(position)
        _check_same_shape(position, velocity)
        if self.virtual:
            return torch.zeros_like(position)
        closing = -(velocity * normal).sum(-1)
        press = (self.stiffness * depth + self.damping * closing).clamp_min(0.0)
        return torch.where(depth <= 0.0, 0.0, press).unsqueeze(-1) * normal

    def report(
        self, rollout_position: Float[Tensor, "*b t 2"] | Any, velocity: Float[Tensor, "*b t 2"] | Any, dt: float
    ) -> "ContactReport":
        """How a rollout touched the walls.

        Parameters
        ----------
        rollout_position : Tensor of shape (..., T, 2)
            At the start of each tick [m].
        velocity : Tensor of shape (..., T, 2)
            In m/s.
        dt : float
            Length of a tick [s].

        Raises
        ------
        ValueError
            If shapes differ, there is no tick, a value is not finite, or ``dt`` is not above zero.
        """
        if not (_is_number(dt) and dt > 0):
            raise ValueError(f"dt={dt!r} must be finite and above 0: the length of a tick in s.")
        rollout_position = as_tensor(rollout_position, "rollout_position")
        velocity = as_tensor(velocity, "velocity")
        _check_same_shape(rollout_position, velocity)
        if rollout_position.ndim < 2 or rollout_position.shape[-2] == 0:
            raise ValueError(
                f"rollout_position has shape {tuple(rollout_position.shape)}: at least one tick is needed."
            )
        _check_finite(rollout_position, "rollout_position")
        _check_finite(velocity, "velocity")
        depth = self.penetration(rollout_position)
        press = torch.linalg.vector_norm(self.force(rollout_position, velocity), dim=-1)
        inside = depth > 0.0
        before = torch.cat([torch.zeros_like(inside[..., :1]), inside[..., :-1]], dim=-1)
        return ContactReport(
            max_penetration=depth.amax(-1),
            time_in_wall=dt * inside.sum(-1).to(depth),
            impulse=dt * press.sum(-1),
            n_contacts=(inside & ~before).sum(-1),
        )

    def _contact(self, position: Tensor | Any) -> tuple[Tensor, Tensor]:
        """Depth along the normal, negative in the free corridor, and the normal.

        The wall is the zero of ``g = side (x - x_c(y)) - w(y)``, the depth ``g / |grad g|``, the normal
        ``-grad g / |grad g|``.
        """
        position = as_tensor(position, "position")
        if position.ndim == 0 or position.shape[-1] != 2:
            raise ValueError(f"position has shape {tuple(position.shape)}: the tunnel is in the plane, (..., 2).")
        x, y = position.unbind(-1)
        offset = x - _value(self.center, y, "center")
        half_width = _value(self.half_width, y, "half_width")
        side = torch.copysign(torch.ones_like(x), offset.detach())
        slope = _slope(self.center, y) + side * _slope(self.half_width, y)
        steepness = (1.0 + slope.square()).sqrt()
        depth = (side * offset - half_width) / steepness
        return depth, torch.stack([-side, side * slope], dim=-1) / steepness.unsqueeze(-1)


@final
@dataclass(frozen=True, eq=False)
class ContactReport:
    """How a rollout touched the walls; a batch of rollouts has a value for each.

    Attributes
    ----------
    max_penetration : Tensor of shape (...)
        Greatest depth beyond a wall [m]; 0 where it was not touched.
    time_in_wall : Tensor of shape (...)
        Number of ticks that start beyond a wall, times dt [s].
    impulse : Tensor of shape (...)
        Sum of the size of the wall's force times dt [N s]; 0 for a virtual wall.
    n_contacts : Tensor of shape (...)
        How often a wall was entered; to start in it counts.
    """

    max_penetration: Float[Tensor, "*b"]
    time_in_wall: Float[Tensor, "*b"]
    impulse: Float[Tensor, "*b"]
    n_contacts: Int[Tensor, "*b"]

    def __str__(self) -> str:
        """One line for each rollout."""
        columns = (self.max_penetration, self.time_in_wall, self.impulse, self.n_contacts)
        rows = zip(*(column.flatten().tolist() for column in columns), strict=True)
        return "\n".join(
            f"{count} contact{'s' * (count != 1)}, {time:.3g} s in the wall, "
            f"at most {1e3 * depth:.3g} mm deep, impulse {impulse:.3g} N s"
            for depth, time, impulse, count in rows
        )


def _is_number(value: object) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool) and is_finite(value)


def _value(curve: Curve, y: Tensor, name: str) -> Tensor:
    value = curve(y)
    if not isinstance(value, Tensor) or value.shape != y.shape:
        got = f"shape {tuple(value.shape)}" if isinstance(value, Tensor) else f"a {type(value).__name__}"
        raise ValueError(
            f"{name} returned {got} for y of shape {tuple(y.shape)}: it must return a tensor with one value for each "
            "y; torch.full_like(y, value) is a constant."
        )
    return value


def _slope(curve: Curve, y: Tensor) -> Tensor:
    for known, derivative in _SLOPES:
        if curve is known:
            return derivative(y)
    with torch.inference_mode(False), torch.enable_grad():
        leaf = y if y.requires_grad else y.clone().requires_grad_()
        total = curve(leaf).sum()
        if not total.requires_grad:  # a constant
            return torch.zeros_like(y)
        return torch.autograd.grad(total, leaf, create_graph=y.requires_grad, materialize_grads=True)[0]


def _check_same_shape(position: Tensor, velocity: Tensor) -> None:
    if position.shape != velocity.shape:
        raise ValueError(
            f"velocity has shape {tuple(velocity.shape)} but position {tuple(position.shape)}: they must be the same."
        )


def _check_finite(values: Tensor, name: str) -> None:
    wrong = ~torch.isfinite(values)
    if bool(wrong.any()):
        index = tuple(wrong.nonzero()[0].tolist())
        raise ValueError(f"{name} is {values[index].item()} at index {index}: cut the rollout before it.")

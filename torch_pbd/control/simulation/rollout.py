"""What a simulated run was: states, forces and gains over time."""

from dataclasses import dataclass, fields
from typing import Any, final

from torch import Tensor


@final
@dataclass(frozen=True, eq=False)
class Rollout:
    """States at the start of each tick of a simulated run, tensors or, by :meth:`numpy`, arrays.

    Attributes
    ----------
    time : (T,), s
    position, velocity : (..., T, d)
        Of the robot, in m and m/s.
    force : (..., T, d), N
        External force on the robot, that of walls included.
    stiffness, damping : (..., T, d, d), N/m and N s/m
        In effect during the tick: what a filter let through.
    desired_position : (..., T, d), m
    commanded_position : (..., T, d), m
        What the admittance asks of the robot's position loop; without such a loop, ``position``.
    filter_share : (..., T) or None
        How much of the step in stiffness a filter let through, 1 where it did not intervene.
    tank_energy : (..., T) or None
        Energy in the tank during the tick, J.
    saturated : (..., T) of bool or None
        Whether the force sensor was out of its range.
    """

    time: Any
    position: Any
    velocity: Any
    force: Any
    stiffness: Any
    damping: Any
    desired_position: Any
    commanded_position: Any
    filter_share: Any = None
    tank_energy: Any = None
    saturated: Any = None

    def numpy(self) -> "Rollout":
        """The same as NumPy arrays, on the CPU."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return Rollout(**{k: v.detach().cpu().numpy() if isinstance(v, Tensor) else v for k, v in values.items()})

    @property
    def deviation(self) -> Any:
        """Position less desired position, (..., T, d)."""
        return self.position - self.desired_position

    @property
    def interventions(self) -> Any:
        """Times (n,) of a single run at which a filter held the stiffness back; of a batch, see ``filter_share``."""
        if self.filter_share is None:
            return self.time[:0]
        if self.filter_share.ndim > 1:
            raise ValueError(f"interventions are of one run; this is a batch of {tuple(self.filter_share.shape[:-1])}.")
        return self.time[self.filter_share < 1.0]

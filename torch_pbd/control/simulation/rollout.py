"""A simulated run: states, forces and gains over time."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, final

from torch import Tensor


@final
@dataclass(frozen=True, eq=False, repr=False)
class Rollout:
    """States at the start of each tick of a simulated run, tensors or, by ``numpy()``, arrays.

    Of positions alone p = d. Of poses p = d - 3, and the last three of velocity, force and gains are of rotation, in
    world axes: rad/s, Nm, Nm/rad and Nm s/rad.

    Attributes
    ----------
    time : (T,), s
    position : (..., T, p), m
        Of the robot.
    velocity : (..., T, d), m/s
    force : (..., T, d), N
        External force on the robot, that of walls included.
    stiffness, damping : (..., T, d, d), N/m and N s/m
        In effect during the tick, behind the filter.
    desired_position : (..., T, p), m
    commanded_position : (..., T, p), m
        By the admittance, of the robot's position loop; without such a loop, ``position``.
    filter_share : (..., T) or None
        Share of the step in stiffness that a filter let through, 1 where it did not intervene.
    tank_energy : (..., T) or None
        Energy in the tank during the tick, J.
    saturated : (..., T) of bool or None
        Whether the force sensor was out of its range.
    orientation, desired_orientation, commanded_orientation : (..., T, 4) or None
        Of poses, as unit quaternions w x y z.
    pose_deviation : (..., T, d) or None, m and rad
        Of poses, position less desired position, and rotation vector e from the desired orientation in world axes,
        ``R = exp([e]) R_d``.
    units : str or None
        Of the schedule's positions: "rad" of joints, which have rad for m above, and Nm for N; None where unknown.
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
    orientation: Any = None
    desired_orientation: Any = None
    commanded_orientation: Any = None
    pose_deviation: Any = None
    units: str | None = "m"

    def __repr__(self) -> str:
        *batch, n_ticks, d = self.velocity.shape
        p = self.position.shape[-1]
        turned = "" if d == p else f" and {float(abs(self.deviation[..., p:]).max()):.3g} rad"
        return (
            f"Rollout({f'batch={tuple(batch)}, ' if batch else ''}n_ticks={n_ticks}, n_outputs={d}, "
            f"time={float(self.time[0]):.6g}..{float(self.time[-1]):.6g} s, "
            f"deviation up to {float(abs(self.deviation[..., :p]).max()):.3g} {self.units or 'units'}{turned})"
        )

    def numpy(self) -> "Rollout":
        """The run as NumPy arrays, on the CPU."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        arrays: dict[str, Any] = {k: v.detach().cpu().numpy() for k, v in values.items() if isinstance(v, Tensor)}
        return replace(self, **arrays)

    def plot(self, *, unpushed: "Rollout | None" = None, names: Sequence[str] | None = None) -> Any:
        """Draw deviation, external force and stiffness over time, below each other in a new figure; rotations beside.

        Parameters
        ----------
        unpushed : Rollout, default=None
            The same run without pushes, drawn behind.
        names : sequence of d str, default=None
            Names of the outputs; None calls them y0, y1, ...

        Returns
        -------
        list of three matplotlib Axes, or of six of poses: three of positions, three of rotations

        Raises
        ------
        ValueError
            If this is a batch of runs.
        """
        from torch_pbd.plotting.display import plot_pushes  # here: it needs matplotlib, a run does not

        return plot_pushes(self, unpushed, names)

    @property
    def deviation(self) -> Any:
        """Position less desired position, and of poses the rotation vector away from the desired one, (..., T, d)."""
        return self.position - self.desired_position if self.pose_deviation is None else self.pose_deviation

    @property
    def interventions(self) -> Any:
        """Times (n,) of a single run at which a filter held the stiffness back; of a batch, see ``filter_share``."""
        if self.filter_share is None:
            return self.time[:0]
        if self.filter_share.ndim > 1:
            batch = tuple(self.filter_share.shape[:-1])
            raise ValueError(
                f"interventions is of a batch {batch}, must be of one run: take filter_share of the batch."
            )
        return self.time[self.filter_share < 1.0]

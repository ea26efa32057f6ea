"""Outputs of a movement: blocks of one unit, rotations, and the axes in which they are learned."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.data.poses import FURTHEST
from torch_pbd.data.units import ANGLES, LENGTHS
from torch_pbd.rotations import Chart, of_last_axes

RESOLUTION = 1e-5
"""Share of a movement's extent, for rotations of a radian, below which standard deviations count as none."""

_ROUNDING = 1e-11  # rounding as a share of the largest position, and in rad
_STEPS, _FLAT = 100, 1e-3  # at most; of curvature, where two axes are as good turned
_NEARLY_UNIT = 1e-3  # tolerance of a quaternion's norm when typed by hand


@dataclass(frozen=True)
class Outputs:
    """Outputs of a movement: ``n_positions``, and, of poses, three coordinates of a rotation in the chart around R0.

    ``units`` are those of the positions, if they have any; ``reference`` (4,) is R0, w x y z. What the regressor learns
    are z of ``y = axes z``: of poses the common axes of each block, in units of its extent. Outputs are standardized
    one by one, which depends on their axes; and floors are relative to other outputs, which must not mix m with rad.
    """

    n_positions: int
    units: Sequence[str] | None = None
    reference: Floats | None = None
    axes: Floats | None = None

    @property
    def blocks(self) -> tuple[slice, ...]:
        """Slices of outputs that share a unit."""
        p = self.n_positions
        return (slice(0, p),) if self.reference is None else (slice(0, p), slice(p, p + 3))

    @cached_property
    def _chart(self) -> Chart:
        assert self.reference is not None
        return Chart(self.reference)

    @property
    def unit(self) -> str | None:
        """Common unit of the positions; None if they have none, or several."""
        return self.units[0] if self.units is not None and len(set(self.units)) == 1 else None

    @property
    def si(self) -> float:
        """Metres or radians per unit of position; 1, and stiffness in N per unit, where it is neither or unknown."""
        return (LENGTHS | ANGLES).get(self.unit or "", 1.0)

    @property
    def in_metres(self) -> bool:
        """Whether a robot's positions are in m, which is also assumed without units."""
        return self.units is None or self.unit in LENGTHS

    @property
    def scales(self) -> Floats:
        """Metres or radians per unit of each output (d,)."""
        return np.array([self.si] * self.n_positions + [1.0] * (0 if self.reference is None else 3))

    def extents(self, varying: Floats) -> Floats:
        """Extent (d,) of what varies (K, n, d), block by block: the diagonal of its box; of poses one that turns.

        Where nothing moves it is the largest position, which floors are relative to; a rotation has a radian.
        """
        extents = np.empty(varying.shape[-1])
        for block in self.blocks:
            own = varying[..., block]
            box = np.ptp(own, axis=(0, 1)) if self.reference is None else 4.0 * own.std(axis=(0, 1))
            extent, largest = float(np.linalg.norm(box)), float(np.abs(own).max())
            extents[block] = extent if extent > _ROUNDING * largest else largest or 1.0
        if self.reference is not None:
            extents[self.n_positions :] = np.maximum(extents[self.n_positions :], 1.0)
        return extents

    def with_axes(self, varying: Floats, known: NDArray[np.bool_]) -> "Outputs":
        """Outputs with the axes of what varies (K, n, d) between demonstrations, where known (K, n); of poses only.

        They are the common axes of the covariances within times: they turn with the world and with the tool, and so do
        their signs, by third moments. Of the pooled covariance free phases, which are large, would choose the axes of
        the precise ones.
        """
        if self.reference is None:
            return self
        count = known.sum(axis=0)[:, np.newaxis]
        mean = np.where(known[..., np.newaxis], varying, 0.0).sum(axis=0) / np.maximum(count, 1)
        deviation = np.where(known[..., np.newaxis], varying - mean, 0.0)
        axes, extents = np.eye(varying.shape[-1]), self.extents(varying)
        for block in self.blocks:
            own, least = deviation[..., block], RESOLUTION * extents[block][0]
            if own.shape[-1] > 1 and float(np.abs(own).max()) > least:
                turned = common_axes(own, count[:, 0] - 1, least)
                axes[block, block] = turned * np.where(((own @ turned) ** 3).sum(axis=(0, 1)) < 0.0, -1.0, 1.0)
        return replace(self, axes=axes * extents)

    def encode(self, values: Floats) -> Floats:
        """Coordinates z of outputs (..., d)."""
        return values if self.axes is None else values @ np.linalg.inv(self.axes).T

    def decode(self, coordinates: Floats) -> Floats:
        """Outputs (..., d) from coordinates z."""
        return coordinates if self.axes is None else coordinates @ self.axes.T

    def covariance(self, learned: Floats, path: Floats | None = None, *, cross_terms: bool = True) -> Floats:
        """Covariances (n, d, d) of outputs from those of z; at poses ``path`` (n, d) in world axes.

        Covariances in the chart equal those in world axes only near its reference: its axes are turned by up to half
        the angle to it, and stretched. A robot controller compares deviations in world axes.
        """
        if self.axes is None:
            return learned
        turn, p = self.axes, self.n_positions
        if path is not None:  # by the Jacobian of small changes of outputs
            turn = of_last_axes(self._chart.to_world(path[:, p:]), p + 3) @ turn
        whole = turn @ learned @ np.swapaxes(turn, -1, -2)
        whole = 0.5 * (whole + np.swapaxes(whole, -1, -2))
        if not cross_terms:
            # All outputs are learned at once, but what few demonstrations say of how positions and rotations vary
            # together does not hold for others: without it, those left out are as likely, or likelier.
            positions, rotations = self.blocks
            whole[:, positions, rotations] = whole[:, rotations, positions] = 0.0
        return whole

    def poses(self, path: Floats) -> tuple[Floats, Floats]:
        """Positions (n, p) and quaternions (n, 4) from outputs (n, d)."""
        return path[..., : self.n_positions], self._chart.exp(path[..., self.n_positions :])

    def motion(self, path: Floats, velocity: Floats, acceleration: Floats) -> dict[str, Floats]:
        """Schedule rows in m and rad, in world axes, from a motion (n, d)."""
        position, velocity, acceleration = (self.scales * part for part in (path, velocity, acceleration))
        if self.reference is None:
            return {"position": position, "velocity": velocity, "acceleration": acceleration}
        p, chart = self.n_positions, self._chart
        y, rate, second = position[:, p:], velocity[:, p:], acceleration[:, p:]
        return {
            "position": position[:, :p],
            "velocity": np.hstack([velocity[:, :p], chart.velocity(y, rate)]),
            "acceleration": np.hstack([acceleration[:, :p], chart.acceleration(y, rate, second)]),
            "orientation": chart.exp(y),
        }

    def rows(self, values: Any, name: str) -> Floats:
        """Outputs (..., d) of positions followed by a unit quaternion w x y z, or as they are; NaN where not given."""
        given = checks.real_floats(values, name)
        p = self.n_positions
        if self.reference is None or not given.ndim:
            return given
        if given.shape[-1] == p + 4:
            quaternion = given[..., p:]
            norm = np.linalg.norm(quaternion, axis=-1, keepdims=True)
            good = np.isnan(quaternion).all(axis=-1) | (np.abs(norm[..., 0] - 1.0) <= _NEARLY_UNIT)
            remedy = "give a unit quaternion w x y z, or four NaN"
            checks.require(good, norm[..., 0], f"the norm of the quaternion of {name}", "1", remedy)
            y = self._chart.log(quaternion / norm)
            angle = np.rad2deg(np.linalg.norm(y, axis=-1))
            checks.require(
                np.isnan(angle) | (angle <= FURTHEST),
                angle,
                f"the angle of {name} to the reference of the demonstrations, in degrees,",
                f"at most {FURTHEST:g}",
                "is the quaternion in the order w x y z?",
            )
            given = np.concatenate([given[..., :p], y], axis=-1)
        if given.shape[-1] != p + 3:
            must = f"must have {p + 4} columns, position and quaternion w x y z, or the {p + 3} of the outputs."
            raise ValueError(f"{name} has shape {given.shape}, {must}")
        free = np.isnan(given[..., p:])
        if (free.any(axis=-1) != free.all(axis=-1)).any():
            raise ValueError(f"{name} has a part of the rotation, must have all of it, or NaN for all of it.")
        return given


def outputs_of(d: int, units: Sequence[str] | None, reference: Floats | None, axes: Floats | None = None) -> Outputs:
    """Outputs of d columns with their units, the last three a rotation where there is a ``reference``."""
    n_positions = d - (0 if reference is None else 3)
    return Outputs(n_positions, None if units is None else units[:n_positions], reference, axes)


def common_axes(deviation: Floats, degrees: NDArray[np.integer], least: float) -> Floats:
    """Axes (d, d), its columns, that the covariances of deviations (K, n, d) within times have nearly in common.

    Maximum likelihood of common principal components (B. Flury, Journal of the American Statistical Association 79,
    1984): the sum over times, ``degrees`` (n,) of freedom each, of the log variances along the axes is least, so that
    each time counts by its shape, however large it is. Before, they are shrunk towards spheres: times that are no less
    round than chance would have it, of so few demonstrations, count little. Deviations below ``least`` count as none.
    """
    scatter, free = np.einsum("kni,knj->nij", deviation, deviation), np.maximum(degrees, 0)[:, np.newaxis, np.newaxis]
    covariances = _shrunk(scatter / np.maximum(free, 1) + least**2 * np.eye(scatter.shape[-1]), free)
    axes = np.linalg.eigh(scatter.sum(axis=0))[1]  # of the pooled covariance, which stay where no shape tells anything
    found = _along(covariances, axes)
    for _ in range(_STEPS):
        # Newton's step of the angle in each plane of two axes, with the curvature where all are diagonal.
        variance = found[:, :, np.newaxis]
        inverse, ratio = 1.0 / variance, variance / np.swapaxes(variance, 1, 2)
        slope = (free * (axes.T @ covariances @ axes) * (inverse - np.swapaxes(inverse, 1, 2))).sum(axis=0)
        angles = slope / (free * (ratio + np.swapaxes(ratio, 1, 2) - 2.0 + _FLAT)).sum(axis=0)
        tried = axes @ expm(angles)
        while (free[:, 0] * np.log((ahead := _along(covariances, tried)) / found)).sum() > _ROUNDING * free.sum():
            angles = 0.5 * angles
            tried = axes @ expm(angles)
        axes, found = tried, ahead
        if np.abs(angles).max() < _ROUNDING:
            break
    return np.array(axes[:, np.argsort((free[:, 0] * np.log(found)).sum(axis=0))], dtype=np.float64)


def _shrunk(covariances: Floats, free: Floats) -> Floats:
    """Covariances (n, d, d) nearer to spheres: the nearer, the rounder they are, and the fewer degrees they have.

    Y. Chen, A. Wiesel, Y. Eldar, A. Hero, "Shrinkage algorithms for MMSE covariance estimation", IEEE Transactions on
    Signal Processing 58, 2010, equation (23).
    """
    d, trace = covariances.shape[-1], np.trace(covariances, axis1=1, axis2=2)[:, np.newaxis, np.newaxis]
    square = (covariances**2).sum(axis=(1, 2), keepdims=True)
    chance = (1.0 - 2.0 / d) * square + trace**2
    share = chance / np.maximum(chance, (free + 1.0 - 2.0 / d) * (square - trace**2 / d))
    return (1.0 - share) * covariances + share * trace / d * np.eye(d)


def _along(covariances: Floats, axes: Floats) -> Floats:
    """Variances (n, d) along axes."""
    return np.asarray(np.einsum("ia,nij,ja->na", axes, covariances, axes), dtype=np.float64)

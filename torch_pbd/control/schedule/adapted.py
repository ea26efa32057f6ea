"""Rows of a schedule made fit for a robot: for its inertia, in its frame, with the diagonal gains that it takes."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from numpy.typing import ArrayLike

from torch_pbd import checks, rotations
from torch_pbd.checks import Floats
from torch_pbd.exceptions import InvalidParameterError


def inertial_rows(schedule: Any, mass: Any, damping_ratio: float, law: Any) -> dict[str, Any]:
    """Mass, damping, and stiffness if there is a law, of a schedule; see :meth:`Schedule.with_inertia`."""
    ratio = checks.number(damping_ratio, "damping_ratio", least=0.0, most=1e6, remedy="1 is critical")
    inertia: Any = checks.real_floats(mass(schedule.time) if callable(mass) else mass, "mass")
    if inertia.ndim:
        inertia = checks.array(inertia, "mass", schedule.stiffness.shape[-max(inertia.ndim, 2) :])
        checks.semidefinite(inertia, "mass", definite=True)
    else:
        inertia = checks.number(float(inertia), "mass", above=0.0, unit="kg")
    rows = {"mass": inertia}
    matrices = inertia if np.ndim(inertia) else inertia * np.eye(schedule.n_outputs)
    stiffness = schedule.stiffness
    if law is not None:
        if not hasattr(law, "limits"):  # to name its class would need torch
            raise checks.refusal(law, "law", "a StiffnessLaw or None")
        rows["stiffness_limits"] = law.limits(schedule.n_outputs)
        softest, known = rows["stiffness_limits"][0] * np.eye(schedule.n_outputs), 1.0 - schedule.type1[:, None, None]
        stiffness = rows["stiffness"] = softest + known * (np.asarray(law(schedule.covariance, matrices)) - softest)
    return rows | {"damping": damping_with(matrices, stiffness, ratio)}


def damping_with(mass: Floats, stiffness: Floats, damping_ratio: float) -> Floats:
    """Damping (n, d, d) that gives all modes of mass and stiffness (n, d, d) this ratio.

    ``2 zeta L (L^-1 K L^-T)^1/2 L'`` with M = L L'. It is twice zeta times the geometric mean of M and K, whatever the
    factor L: that of :func:`~torch_pbd.control.damping_from_stiffness`, which takes the root of M.
    """
    factor = np.broadcast_to(np.linalg.cholesky(mass), stiffness.shape)
    half = np.linalg.solve(factor, stiffness)
    squared, axes = np.linalg.eigh(np.linalg.solve(factor, half.swapaxes(1, 2)))
    modes = factor @ axes * squared.clip(0.0)[:, np.newaxis] ** 0.25
    return 2.0 * damping_ratio * modes @ modes.swapaxes(1, 2)


def turned_rows(schedule: Any, rotation: ArrayLike, translation: ArrayLike | None) -> dict[str, Any]:
    """Arrays of a schedule that a rotation and a translation change; see :meth:`Schedule.transform`."""
    p = schedule.position.shape[1]
    if schedule.units in ("rad", "deg"):
        raise InvalidParameterError(
            f"the positions are in {schedule.units}, must be coordinates of a point: joint angles have no frame."
        )
    turn = checks.real_floats(rotation, "rotation")
    if turn.shape == (4,) and p == 3:
        turn = rotations.matrix(turn / np.linalg.norm(turn))
    turn = checks.array(turn, "rotation", (p, p))
    if not np.allclose(turn @ turn.T, np.eye(p), atol=1e-6) or np.linalg.det(turn) < 0.0:
        raise InvalidParameterError(
            f"rotation is {turn.tolist()}, must be a rotation matrix, of which R R' = I and det R = 1."
        )
    moved = 0.0 if translation is None else checks.array(translation, "translation", (p,))
    for limit in schedule.stiffness_limits or ():
        if np.ndim(limit) and any(np.ptp(np.asarray(limit)[block]) > 0.0 for block in schedule.blocks):
            raise InvalidParameterError(
                f"stiffness_limits is {schedule.stiffness_limits}, must be the same for all axes that turn into each "
                "other: give schedules limits for each block, or none."
            )
    whole = np.zeros((schedule.n_outputs, schedule.n_outputs))
    for block in schedule.blocks:
        whole[block, block] = turn
    rows = {"position": schedule.position @ turn.T + moved, "velocity": schedule.velocity @ whole.T}
    if schedule.acceleration is not None:
        rows["acceleration"] = schedule.acceleration @ whole.T
    if schedule.orientation is not None:
        rows["orientation"] = rotations.multiply(rotations.from_matrix(turn), schedule.orientation)
    matrices = {name: getattr(schedule, name) for name in ("stiffness", "damping", "covariance", "mass")}
    return rows | {name: whole @ array @ whole.T for name, array in matrices.items() if isinstance(array, np.ndarray)}


@final
@dataclass(frozen=True)
class DiagonalLoss:
    """Loss of a controller that takes the diagonals of stiffness and damping only; all 0 if they are all there is.

    Attributes
    ----------
    stiffness_max, stiffness_median, damping_max, damping_median : float
        Frobenius norm of the entries off the diagonal over that of the whole, in which positions and rotations count
        alike, each in units of its own block's norm; largest and median over time.
    displacement, time : float
        Largest ||x - x_diagonal|| / ||x|| over all forces and times, where the force displaces the robot by x
        with the whole stiffness, and when that is, in s. 1 is an error as large as the displacement.
    """

    stiffness_max: float
    stiffness_median: float
    damping_max: float
    damping_median: float
    displacement: float
    time: float

    def __str__(self) -> str:
        return (
            f"diagonal gains lose {self.stiffness_max:.1%} of the stiffness (median {self.stiffness_median:.1%}), "
            f"{self.damping_max:.1%} of the damping (median {self.damping_median:.1%}); displacements under a force "
            f"or a torque are off by up to {self.displacement:.1%}, at {self.time:.6g} s"
        )


def diagonal_gains(schedule: Any) -> tuple[Floats, Floats, DiagonalLoss]:
    """Diagonal stiffness and damping (n, d, d) of a schedule, and what they lose."""
    # The nearest diagonal matrix, in the Frobenius norm, is the diagonal itself. It lies between the least and the
    # largest eigenvalue, so within the limits too; rounding may leave it below zero.
    gains = schedule.stiffness, schedule.damping
    stiffness, damping = (np.eye(schedule.n_outputs) * np.maximum(gain, 0.0) for gain in gains)
    # x = K^-1 f and x_diagonal = D^-1 f differ by (I - D^-1 K) x: by its spectral norm, for the worst x, of a force or
    # of a torque.
    along = np.diagonal(stiffness, axis1=1, axis2=2)[..., np.newaxis]
    coupling = (stiffness - schedule.stiffness) / np.where(along > 0.0, along, 1.0)
    displacement = np.max([np.linalg.norm(coupling[:, b, b], ord=2, axis=(1, 2)) for b in schedule.blocks], axis=0)
    worst = int(displacement.argmax())
    loss = DiagonalLoss(
        *_relative_loss(schedule.stiffness, stiffness, schedule.blocks),
        *_relative_loss(schedule.damping, damping, schedule.blocks),
        displacement=float(displacement[worst]),
        time=float(schedule.time[worst]),
    )
    return stiffness, damping, loss


def _relative_loss(matrices: Floats, diagonal: Floats, blocks: Sequence[slice]) -> tuple[float, float]:
    """Frobenius norm of the entries lost relative to the whole, 0 where all is zero: largest and median over time."""
    norms = np.ones(matrices.shape[:2])  # of the block of each output: N/m and Nm/rad are not added
    for block in blocks:
        norms[:, block] = np.linalg.norm(matrices[:, block, block], axis=(1, 2))[:, np.newaxis]
    root = np.sqrt(np.where(norms > 0.0, norms, 1.0))
    unit = root[:, :, np.newaxis] * root[:, np.newaxis, :]
    whole = np.linalg.norm(matrices / unit, axis=(1, 2))
    loss = np.linalg.norm((matrices - diagonal) / unit, axis=(1, 2)) / np.where(whole > 0.0, whole, 1.0)
    return float(loss.max()), float(np.median(loss))

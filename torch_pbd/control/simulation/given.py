"""Tensors that a simulation is given: one dtype, shapes that agree, numbers that can be followed."""

import torch
from torch import Tensor

from torch_pbd import checks
from torch_pbd.exceptions import InvalidParameterError

# Sizes behind those of the batch; those that are not here are motions of all axes, (T, d).
_SHAPES = {
    "position_desired": "Tp",
    "orientation_desired": "T4",
    "stiffness": "Tdd",
    "damping": "Tdd",
    "position0": "p",
    "orientation0": "4",
    "velocity0": "d",
}
# Of the squared norm of quaternions, as in schedules: those of seven digits count as unit ones.
_NEARLY_UNIT = 1e-6


def check_given(given: dict[str, Tensor]) -> None:
    """Check the tensors that :meth:`AdmittancePlant.simulate` was given; T and p are those of the desired position."""
    kinds = sorted({f"{value.dtype} on {value.device}" for value in given.values()})
    if len(kinds) > 1:
        raise InvalidParameterError(
            f"the inputs are of {', '.join(kinds)}, must be of one dtype and device: convert them."
        )
    shape, is_pose = given["position_desired"].shape, "orientation_desired" in given
    if "orientation0" in given and not is_pose:
        raise InvalidParameterError("orientation0 is given, must come with orientation_desired: give both, or none.")
    n_ticks, p = shape[-2:] if len(shape) > 1 else (0, 0)
    sizes = {"T": n_ticks, "p": p, "d": p + 3 if is_pose else p, "4": 4}
    for name, value in given.items():
        letters = _SHAPES.get(name, "Td")
        if not n_ticks or not value.numel() or value.shape[-len(letters) :] != tuple(map(sizes.__getitem__, letters)):
            expected = ", ".join(letters if is_pose else letters.replace("p", "d"))
            raise InvalidParameterError(
                f"{name} has shape {tuple(value.shape)}, must have shape (..., {expected}), none of it empty, with T "
                f"and {'p' if is_pose else 'd'} those of position_desired, {tuple(shape)}"
                f"{', and d = p + 3' if is_pose else ''}."
            )
        plain = value.detach().cpu()
        if name in ("stiffness", "damping"):
            checks.semidefinite(plain.numpy(), name)
            continue
        checks.require(torch.isfinite(plain).numpy(), plain.numpy(), name, "finite")
        if name.startswith("orientation"):
            squared = plain.square().sum(-1).numpy()
            good, remedy = abs(squared - 1.0) <= _NEARLY_UNIT, "give unit quaternions w x y z"
            checks.require(good, squared, f"the squared norm of {name}", "1", remedy)

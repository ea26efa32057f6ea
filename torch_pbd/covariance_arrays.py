"""Arrays of covariances (n, d, d) that somebody gave: what is asked of them, and their factors."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from torch_pbd import checks

Floats = NDArray[np.floating[Any]]

_ASYMMETRY = 1e-8  # largest difference of mirrored entries, relative to a matrix's largest entry
_NEGATIVE = 1e-10  # an eigenvalue no further below zero is rounding, relative to the largest one
_LARGEST = 1e140  # in size: squares, and their sums, are numbers
_ZERO_PIVOT = 1e-14  # a pivot of a Cholesky factorization below it is rounding, relative to the diagonal


def _finite(name: str, array: ArrayLike) -> Floats:
    """Numbers whose squares, and their sums, are finite."""
    values = checks.real_floats(array, name)
    if not (np.abs(values) <= _LARGEST).all():
        raise ValueError(f"{name} has entries that are not finite, or whose squares are not (above {_LARGEST:g}).")
    return values


def covariances(name: str, array: ArrayLike) -> Floats:
    """Symmetric matrices (n, d, d), one a row."""
    matrices = _finite(name, array)
    if matrices.ndim != 3 or matrices.shape[1] != matrices.shape[2] or not matrices.size:
        raise ValueError(f"{name} has shape {matrices.shape}: it must be (n, d, d), one matrix a row.")
    asymmetry = np.abs(matrices - matrices.mT).max(axis=(1, 2))
    asymmetric = asymmetry > _ASYMMETRY * np.abs(matrices).max(axis=(1, 2))
    if asymmetric.any():
        row = int(np.argmax(asymmetric))
        raise ValueError(f"{name}[{row}] is not symmetric: mirrored entries differ by {asymmetry[row]:.3g}.")
    return matrices


def matching_covariances(first: ArrayLike, second: ArrayLike, *, names: tuple[str, str]) -> tuple[Floats, Floats]:
    """Two of the same shape."""
    pair = covariances(names[0], first), covariances(names[1], second)
    if pair[0].shape != pair[1].shape:
        raise ValueError(f"{names[0]} has shape {pair[0].shape} but {names[1]} has shape {pair[1].shape}.")
    return pair


def rows_beside(name: str, array: ArrayLike, n: int, d: int) -> Floats:
    """Rows (n, d) that belong to n covariances of d outputs; of one output also (n,)."""
    rows = _finite(name, array)
    if rows.shape != (n, d) and (rows.shape, d) != ((n,), 1):
        raise ValueError(f"{name} has shape {rows.shape}: these covariances need ({n}, {d}).")
    return rows.reshape(n, d)


def log_det(scale_tril: Floats) -> Floats:
    """Log determinants of factors: half those of their covariances."""
    return np.log(np.diagonal(scale_tril, axis1=-2, axis2=-1)).sum(-1)


def definite_factor(name: str, matrices: Floats) -> Floats:
    """Cholesky factors of positive definite matrices."""
    try:
        factor = np.linalg.cholesky(matrices)
    except np.linalg.LinAlgError:
        factor = np.zeros_like(matrices)
    if (np.diagonal(factor, axis1=1, axis2=2) < 1.0 / _LARGEST).any():
        raise _not_positive(name, "definite", np.linalg.eigvalsh(matrices))
    return factor


def semidefinite_factor(name: str, matrices: Floats) -> Floats:
    """Cholesky factors of matrices that may be singular: zeros below a pivot that is zero to rounding."""
    eigenvalues = np.linalg.eigvalsh(matrices)
    if (eigenvalues[:, 0] < -_NEGATIVE * eigenvalues[:, -1]).any():
        raise _not_positive(name, "semidefinite", eigenvalues)
    remainder, factor = matrices.copy(), np.zeros_like(matrices)
    rounding = _ZERO_PIVOT * np.diagonal(matrices, axis1=-2, axis2=-1)
    for j in range(matrices.shape[-1]):
        pivot = remainder[:, j, j]
        root = np.sqrt(np.where(pivot > rounding[:, j], pivot, np.inf))
        factor[:, j:, j] = remainder[:, j:, j] / root[:, None]
        remainder -= factor[:, :, j, None] * factor[:, None, :, j]
    return factor


def _not_positive(name: str, kind: str, eigenvalues: Floats) -> ValueError:
    row = int(np.argmin(eigenvalues[:, 0] / np.abs(eigenvalues).max(axis=1).clip(np.finfo(np.float64).tiny)))
    return ValueError(f"{name}[{row}] is not positive {kind}: its smallest eigenvalue is {eigenvalues[row, 0]:.3g}.")

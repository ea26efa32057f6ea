"""Probabilistic movement primitives (ProMP): a normal distribution of the weights of basis functions."""

import itertools
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import numpy as np
import torch

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.data.demonstrations import Demonstration
from torch_pbd.estimators.door import Standardization
from torch_pbd.estimators.validation import ALIKE
from torch_pbd.exceptions import DataRankWarning
from torch_pbd.movement.base import MovementRegressor
from torch_pbd.movement.joint import JointNormal
from torch_pbd.movement.law import as_rows, check_arrays, semidefinite_root

_N_BASES = (8, 12, 16, 20)  # candidates of "auto", as far as recordings have enough samples
_REACHES = (1.0, 2.0, 4.0)  # candidate length scales of the smooth prior, in bases
_SHARES = (0.9, 0.7, 0.5, 0.3, 0.1, 0.03)  # candidate weights of the smooth prior
_OVERLAPS = (0.7, 0.85, 0.92)  # narrow bases follow bends, wide ones are smooth; movement_primitives uses 0.7
_LEAST_NOISE = 1e-4  # least noise as a share of an output's deviation: below it the law is nearly singular
_MOST_LEFT_OUT = 40  # most demonstrations that are left out in turn


@dataclass(kw_only=True, eq=False, repr=False)
class ProMPBaseline(MovementRegressor):
    """Probabilistic movement primitive: x_t = Psi_t w + noise, with normally distributed weights w.

    Bases are normalized Gaussians over the time; a ridge regression finds the weights of each demonstration, near those
    of all together. Their covariance is singular for fewer demonstrations than weights: it is shrunk towards a smooth
    one, a squared exponential over the bases' numbers times the covariance of the outputs. That has one size for all
    times: where demonstrations narrow to a tenth, the deviation may be many times theirs.

    Parameters
    ----------
    n_basis : int or "auto", default="auto"
        Number of bases, at most one less than the samples of the median demonstration; "auto" takes 8 to 20 by the
        likelihood of demonstrations left out in turn.
    overlap : float or "auto", default="auto"
        About the value of a basis, before normalization, midway to its neighbour's centre, 0 to 1: it is this to the
        power ``(n_basis / (n_basis - 1))**2``. "auto" takes 0.7, 0.85 or 0.92 by the same likelihood.
    ridge : float, default=1e-6
        Ridge of the regression of the weights, relative to the mean diagonal of its matrix.
    shrinkage : float or "auto", default="auto"
        Weight of the smooth covariance, 0 to 1; "auto" takes it and its length scale by the same likelihood.
    random_state : int, RandomState instance or None, default=0
        Not used, since the fit is deterministic.

    Attributes
    ----------
    n_basis_ : int
    overlap_ : float
    shrinkage_, reach_ : float
        Weight of the smooth covariance and its length scale in bases.
    weight_mean_ : ndarray of shape (n_basis, n_outputs)
    weight_covariance_ : ndarray of shape (n_basis n_outputs, n_basis n_outputs)
    noise_scale_ : ndarray of shape (n_outputs,)
        Standard deviation of the samples around the fitted bases, in units of y.
    df_ : float
        Degrees of freedom; infinite, as the law is normal.
    n_features_in_, n_outputs_ : int

    References
    ----------
    Paraschos, Daniel, Peters, Neumann, "Using probabilistic movement primitives in robotics", Autonomous Robots 42,
    2018.
    """

    n_basis: int | str = "auto"
    overlap: float | str = "auto"
    ridge: float = 1e-6
    shrinkage: float | str = "auto"
    random_state: Any = 0

    _learned: ClassVar[Any] = {
        "n_basis_": partial(checks.count, least=2),
        "overlap_": partial(checks.number, above=0.0, below=1.0),
        "reach_": partial(checks.number, above=0.0),
        "shrinkage_": partial(checks.number, least=0.0, most=1.0),
    }

    def _check_parameters(self) -> None:
        for name in ("n_basis", "overlap", "shrinkage"):
            if getattr(self, name) != "auto":
                self._learned[f"{name}_"](getattr(self, name), name)
        checks.number(self.ridge, "ridge", least=0.0)
        checks.seed(self.random_state)

    def _fit(self, recordings: list[Demonstration]) -> None:
        # A ridge shrinks towards 0, which must be a position of the movement, and not the user's origin.
        scaling = Standardization.fit(*as_rows(recordings)[:2])
        scaled = [Demonstration(self._scaled(time), scaling.outputs(y, exact=True)) for time, y in recordings]
        most = max(2, int(np.median([len(time) for time, _ in recordings])) - 1)
        sizes = _N_BASES if self.n_basis == "auto" else (int(self.n_basis),)
        overlaps = _OVERLAPS if self.overlap == "auto" else (float(self.overlap),)
        pairs = itertools.product(sorted({min(size, most) for size in sizes}), overlaps)
        candidates = [_Weights(scaled, *pair, float(self.ridge)) for pair in pairs]
        shares = _SHARES if self.shrinkage == "auto" else (float(self.shrinkage),)
        choices = itertools.product(candidates, _REACHES, shares)
        weights, reach, share = max(choices, key=lambda choice: choice[0].left_out(*choice[1:]))
        self.n_basis_, self.overlap_, self.reach_, self.shrinkage_ = weights.n_basis, weights.overlap, reach, share
        if weights.values.std(axis=0).max() < 1e-9:
            checks.warn(ALIKE, DataRankWarning)
        # The bases sum to one, so that a shift of all weights is one of the movement.
        self.weight_mean_ = scaling.y_shift + scaling.y_scale * weights.values.mean(axis=0)
        self.weight_covariance_ = weights.covariance(scaling.y_scale * weights.values, reach, share)
        self.noise_scale_ = scaling.y_scale * weights.noise_scale

    def _arrays(self) -> dict[str, Floats]:
        names = ("weight_mean_", "weight_covariance_", "noise_scale_")
        return {name: getattr(self, name) for name in names} | {"range": np.array(self._range)}

    def _restore(self, arrays: dict[str, Floats]) -> None:
        n_basis, d = self.n_basis_, self.n_outputs_
        shapes = {"weight_mean_": (n_basis, d), "weight_covariance_": 2 * (n_basis * d,), "noise_scale_": (d,)}
        check_arrays(arrays, {**shapes, "range": (2,)})
        checks.semidefinite(arrays["weight_covariance_"], "weight_covariance_")
        checks.require(arrays["noise_scale_"] > 0.0, arrays["noise_scale_"], "noise_scale_", "above 0")
        low, width = arrays["range"].tolist()
        self._range = low, checks.number(width, "the range of X", above=0.0)
        self.__dict__.update({name: arrays[name] for name in shapes})

    def _prior(self, time: Floats) -> JointNormal:
        bases = basis_functions(self._scaled(time), self.n_basis_, self.overlap_)
        # In units of the noise: rounding of an output in large numbers would be all of one in small numbers.
        scale = np.tile(self.noise_scale_, self.n_basis_)
        root = semidefinite_root(self.weight_covariance_ / np.outer(scale, scale)) * scale[:, np.newaxis]
        loadings = np.einsum("nb,bdk->ndk", bases, root.reshape(self.n_basis_, self.n_outputs_, -1))
        mean = bases @ self.weight_mean_
        return JointNormal.with_noise(*map(torch.from_numpy, (time, mean, loadings, self.noise_scale_)))


class _Weights:
    """Weights of each demonstration, and the statistics that score a covariance of them."""

    def __init__(self, recordings: list[Demonstration], n_basis: int, overlap: float, ridge: float) -> None:
        self.n_basis, self.overlap = n_basis, overlap
        self._samples = [(basis_functions(time, n_basis, overlap), position) for time, position in recordings]
        # A recording that ends early, or has few samples, says nothing of some weights, which are then those of all
        # together.
        common = _ridge_weights(*map(np.concatenate, zip(*self._samples, strict=True)), ridge=ridge)
        weights = [common + _ridge_weights(bases, y - bases @ common, ridge=ridge) for bases, y in self._samples]
        residual = np.concatenate([y - bases @ own for (bases, y), own in zip(self._samples, weights, strict=True)])
        self.values: Floats = np.stack(weights)  # (K, n_basis, d)
        # Degrees of freedom: samples minus the weights that were fitted to them.
        freedoms = max(1, sum(max(0, len(bases) - n_basis) for bases, _ in self._samples))
        self.noise_scale: Floats = np.maximum(np.sqrt(np.square(residual).sum(axis=0) / freedoms), _LEAST_NOISE)

    def covariance(self, values: Floats, reach: float, share: float) -> Floats:
        """Shrunk covariance (B d, B d) of weights (K, B, d)."""
        centred = values - values.mean(axis=0)
        flat = centred.reshape(len(values), -1)
        own = flat.T @ flat / (len(values) - 1)
        outputs = np.einsum("kbi,kbj->ij", centred, centred) / (len(values) - 1) / self.n_basis
        # Weights of near bases vary together, and the outputs of each covary as over all bases.
        number = np.arange(self.n_basis)
        smooth = np.exp(-0.5 * np.square((number[:, np.newaxis] - number) / reach))
        return np.asarray((1.0 - share) * own + share * np.kron(smooth, outputs))

    def left_out(self, reach: float, share: float) -> float:
        """Log likelihood of demonstrations under the law of the others, in nats.

        For y = Psi w + noise, with r = y - Psi mean, M = Psi' Psi / s^2, b = Psi' r / s^2 and the weights' covariance
        S, it is -(log det(I + M S) + r' r / s^2 - b' S (I + M S)^-1 b + log det s^2 + n log 2 pi) / 2.
        """
        if len(self.values) < 3:
            return -float(np.log(self.noise_scale).sum())  # one other demonstration has no covariance
        total = 0.0
        for k, (bases, position) in enumerate(self._samples[:_MOST_LEFT_OUT]):
            others = np.delete(self.values, k, axis=0)
            covariance = self.covariance(others, reach, share)
            residual = (position - bases @ others.mean(axis=0)) / self.noise_scale
            precision = np.kron(bases.T @ bases, np.diag(self.noise_scale**-2.0))
            projected = (bases.T @ (residual / self.noise_scale)).ravel()
            matrix = np.eye(len(precision)) + precision @ covariance
            explained = projected @ covariance @ np.linalg.solve(matrix, projected)
            log_det = np.linalg.slogdet(matrix).logabsdet + 2.0 * len(bases) * np.log(self.noise_scale).sum()
            total -= 0.5 * (log_det + np.square(residual).sum() - explained + position.size * np.log(2.0 * np.pi))
        return float(total)


def _ridge_weights(bases: Floats, position: Floats, *, ridge: float) -> Floats:
    gram = bases.T @ bases
    # Without a ridge, weights of which a recording shows nothing are 0.
    matrix = gram + ridge * gram.trace() / len(gram) * np.eye(len(gram))
    return np.asarray(np.linalg.lstsq(matrix, bases.T @ position, rcond=None)[0])


def basis_functions(time: Floats, n_basis: int, overlap: float) -> Floats:
    """Normalized Gaussian bases (n, n_basis) at times from 0 to 1, with centres evenly spaced from 0 to 1."""
    centres = np.linspace(0.0, 1.0, n_basis)
    width = -1.0 / (8.0 * n_basis**2 * np.log(overlap))
    exponent = -0.5 * np.square(time[:, np.newaxis] - centres) / width
    values = np.exp(exponent - exponent.max(axis=1, keepdims=True))  # far away the nearest basis is left
    return np.asarray(values / values.sum(axis=1, keepdims=True))

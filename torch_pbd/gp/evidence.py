"""Hyperparameters of Gaussian processes by their evidence: a grid, then L-BFGS from its best points.

Several observations of one input enter as their mean and their count: the noise of a mean is the noise
over the root of the count. Targets are those from which the prior mean is subtracted; the range of the
inputs is about one in every dimension.
"""

import math
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from torch_pbd.exceptions import NotPositiveDefiniteError
from torch_pbd.gp.observations import Hyperparameters, Observations
from torch_pbd.kernels import KernelName, correlation
from torch_pbd.optim import FitReport, minimize_batch

MIN_NOISE_RATIO, MAX_NOISE_RATIO = 1e-10, 1e5
"""Bounds of a learned noise variance over the variance of the process; a fixed noise may be far lower."""

_BLOCK = 32  # processes fitted together: bounds the memory
_HOPEFUL = 0.5  # nats for each input that polishing may be worth

# Below 1e-3 the evidence is nearly flat in the ratio: no optimum is lost between these.
_LOG10_RATIOS = (-10.0, -8.0, -6.0, -4.0, -3.0, -2.5, -2.0, -1.5, -1.0, -0.5, 0.0, 0.5, 1.0, 2.0, 4.0)


@dataclass(frozen=True)
class EvidenceSearch:
    """What :func:`fit_hyperparameters` looks for, and where.

    Parameters
    ----------
    kernel : KernelName
    length_scale_bounds : (float, float)
        Smallest and largest length scale, in units of the range of the inputs. A lower bound at the spacing
        of the inputs keeps out "needles", which explain every point by itself and nothing between.
    length_scale : Tensor of shape (e,) or None
        Held there if given.
    noise_scale : Tensor of shape (b,) or None
        Standard deviation of the noise of one observation, held there if given; learned if None.
    n_restarts : int
        Starting points beside the first: the best of each of ``1 + n_restarts`` bands of a grid.
    max_iter, tol
        Of the L-BFGS that polishes the grid's points.
    """

    kernel: KernelName = "squared_exponential"
    length_scale_bounds: tuple[float, float] = (1e-3, 1e1)
    length_scale: Tensor | None = None
    noise_scale: Tensor | None = None
    n_restarts: int = 2
    max_iter: int = 100
    tol: float = 1e-6


class _Evidence(torch.autograd.Function):
    """y' A^-1 y and log|A| with their gradients in closed form; NaN where A is not positive definite."""

    @staticmethod
    def forward(ctx: Any, matrix: Tensor, targets: Tensor) -> tuple[Tensor, Tensor]:
        factor, info = torch.linalg.cholesky_ex(matrix)
        failed = info > 0
        factor = torch.where(failed[:, None, None], torch.eye(matrix.shape[-1]).to(matrix), factor)
        solved = torch.cholesky_solve(targets.unsqueeze(-1), factor).squeeze(-1)
        ctx.save_for_backward(factor, solved)
        log_det = 2.0 * factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        nan = torch.full_like(log_det, math.nan)
        return torch.where(failed, nan, (targets * solved).sum(-1)), torch.where(failed, nan, log_det)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor]:
        factor, solved = ctx.saved_tensors
        from_quadratic, from_log_det = (gradient[:, None, None] for gradient in gradients)
        outer = solved.unsqueeze(-1) * solved.unsqueeze(-2)
        matrix = from_log_det * torch.cholesky_inverse(factor) - from_quadratic * outer
        return matrix, 2.0 * from_quadratic.squeeze(-1) * solved


def negative_log_evidence(
    observations: Observations, hyperparameters: Hyperparameters, kernel: KernelName = "squared_exponential"
) -> Float[Tensor, " b"]:
    """Negative log marginal likelihood of each process, in nats (Rasmussen and Williams, eq. (2.30))."""
    quadratic, log_det = _quadratic_and_log_det(
        observations, hyperparameters.length_scale, hyperparameters.noise_ratio, kernel
    )
    return _evidence(quadratic, log_det, hyperparameters.amplitude.square(), observations.counts)


def _quadratic_and_log_det(
    observations: Observations, length_scale: Tensor, noise_ratio: Tensor, kernel: KernelName
) -> tuple[Tensor, Tensor]:
    """Of the covariance over the squared amplitude, rows scaled so that the noise is the same for all."""
    weight = observations.counts.sqrt()
    gram = correlation(observations.inputs, observations.inputs, length_scale, kernel)
    gram = weight[:, None] * gram * weight + noise_ratio[:, None, None] * torch.eye(len(weight)).to(weight)
    result: tuple[Tensor, Tensor] = _Evidence.apply(gram, observations.targets * weight)
    return result


def _evidence(quadratic: Tensor, log_det: Tensor, variance: Tensor, counts: Tensor) -> Tensor:
    constant = len(counts) * math.log(2 * math.pi) - counts.log().sum()
    return 0.5 * (quadratic / variance + log_det + len(counts) * variance.log() + constant)


def _best_variance(quadratic: Tensor, n_inputs: int) -> Tensor:
    """Squared amplitude that maximizes the evidence, given the rest; tiny for targets that are all zero."""
    return (quadratic / n_inputs).clamp_min(1e-200)


class _Coordinates:
    """Unbounded coordinates of the hyperparameters that are searched; the rest are fixed or closed-form.

    A cosine folds each onto its bounds: unlike a sigmoid it reaches them, so an optimum there is found.
    """

    def __init__(self, observations: Observations, search: EvidenceSearch) -> None:
        self.observations, self.search = observations, search
        n_features = observations.inputs.shape[1]
        smallest, largest = (math.log(bound) for bound in search.length_scale_bounds)
        bounds = [] if search.length_scale is not None else [(smallest, largest)] * n_features
        self.n_length_scales = len(bounds)
        if search.noise_scale is None or bool((search.noise_scale > 0).all()):
            bounds.append((math.log(self._lowest_ratio()), math.log(MAX_NOISE_RATIO)))
        table = observations.inputs.new_tensor(bounds).reshape(-1, 2)
        self.low, self.width = table[:, 0], table[:, 1] - table[:, 0]

    def _lowest_ratio(self) -> float:
        """That of a fixed noise must leave room for amplitudes a hundred times the targets."""
        if self.search.noise_scale is None:
            return MIN_NOISE_RATIO
        largest = float(self.observations.targets.square().mean(1).max())
        lowest = float(self.search.noise_scale.min()) ** 2 / max(1e4 * largest, 1e-200)
        return min(MIN_NOISE_RATIO, max(lowest, 1e-40))

    def decode(self, z: Tensor, rows: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
        """Length scales, noise ratio, and the squared amplitude where a fixed noise decides it."""
        logs = self.low + self.width * (0.5 - 0.5 * torch.cos(z))
        fixed = self.search.length_scale
        length_scale = logs[:, : self.n_length_scales].exp() if fixed is None else fixed.expand(len(z), -1)
        if logs.shape[1] == self.n_length_scales:
            return length_scale, z.new_zeros(len(z)), None
        noise_ratio = logs[:, -1].exp()
        if self.search.noise_scale is None:
            return length_scale, noise_ratio, None
        return length_scale, noise_ratio, self.search.noise_scale[rows].square() / noise_ratio

    def encode(self, length_scale: Tensor, noise_ratio: Tensor) -> Tensor:
        logs = length_scale.log()[:, None].expand(-1, self.n_length_scales)
        if len(self.low) > self.n_length_scales:
            logs = torch.cat([logs, noise_ratio.log()[:, None]], dim=1)
        share = (logs - self.low) / self.width.clamp_min(1e-9)
        return torch.acos(1.0 - 2.0 * share.clamp(0.01, 0.99))

    def loss(self, z: Float[Tensor, "a p"], rows: Int64[Tensor, " a"]) -> Float[Tensor, " a"]:
        """Negative log evidence for a observation."""
        length_scale, noise_ratio, variance = self.decode(z, rows)
        chosen = replace(self.observations, targets=self.observations.targets[rows])
        quadratic, log_det = _quadratic_and_log_det(chosen, length_scale, noise_ratio, self.search.kernel)
        variance = _best_variance(quadratic, len(chosen.counts)) if variance is None else variance
        return _evidence(quadratic, log_det, variance, chosen.counts) / len(chosen.counts)

    @torch.no_grad()
    def losses(self, z: Float[Tensor, "s b p"]) -> Float[Tensor, "s b"]:
        """Negative log evidence of each process at s points, in nats; infinite where it has none."""
        rows = torch.arange(z.shape[1], device=z.device).repeat(len(z))
        loss = self.loss(z.flatten(0, 1), rows).reshape(z.shape[:2])
        return loss.nan_to_num(nan=math.inf) * len(self.observations.counts)

    @torch.no_grad()
    def hyperparameters(self, z: Tensor) -> Hyperparameters:
        rows = torch.arange(len(z), device=z.device)
        length_scale, noise_ratio, variance = self.decode(z, rows)
        if variance is None:
            quadratic, _ = _quadratic_and_log_det(self.observations, length_scale, noise_ratio, self.search.kernel)
            variance = _best_variance(quadratic, len(self.observations.counts))
            crude = self.observations.targets.square().mean(1).clamp_min(1e-200)
            variance = torch.where(variance.isnan(), crude, variance)
        return Hyperparameters(length_scale, variance.sqrt(), noise_ratio)


def _grid(coordinates: _Coordinates, n_starts: int) -> Tensor:
    """The best point of each process in each of ``n_starts`` bands of a grid: (n_starts, b, p).

    The bands are of the noise ratio (of the length scale, where the noise is fixed): the evidence often
    has one optimum where the data are signal and one where they are noise, with a plateau between. One
    eigendecomposition serves all processes and all noise ratios of a length scale.
    """
    observations, search = coordinates.observations, coordinates.search
    weight = observations.counts.sqrt()
    low, high = search.length_scale_bounds
    n_scales = 20 if search.length_scale is None else 1
    scales = torch.logspace(math.log10(low), math.log10(high), n_scales, dtype=weight.dtype, device=weight.device)
    learned = len(coordinates.low) > coordinates.n_length_scales
    ratios = 10.0 ** weight.new_tensor(_LOG10_RATIOS) if learned else weight.new_zeros(1)
    if learned and search.noise_scale is not None:
        lower = range(math.ceil(float(coordinates.low[-1]) / math.log(10)), int(_LOG10_RATIOS[0]))
        ratios = torch.cat([10.0 ** weight.new_tensor(lower), ratios])
    losses = []
    for scale in scales:
        length_scale = scale.expand(observations.inputs.shape[1])
        length_scale = length_scale if search.length_scale is None else search.length_scale
        gram = weight[:, None] * correlation(observations.inputs, observations.inputs, length_scale, search.kernel)
        eigenvalue, eigenvector = torch.linalg.eigh(gram * weight)
        square = ((observations.targets * weight) @ eigenvector).square()
        spectrum = eigenvalue + ratios[:, None]  # (ratios, n)
        sound = spectrum[:, 0] > 10 * len(weight) * torch.finfo(weight.dtype).eps * spectrum[:, -1]
        quadratic = square @ (1.0 / spectrum.clamp_min(1e-300)).T
        variance = _best_variance(quadratic, len(weight))
        if learned and search.noise_scale is not None:
            variance = search.noise_scale.square()[:, None] / ratios
        loss = _evidence(quadratic, spectrum.clamp_min(1e-300).log().sum(-1), variance, observations.counts)
        losses.append(loss.where(sound, torch.full_like(loss, math.inf)))
    table = torch.stack(losses, dim=2).flatten(1)  # (b, ratios * scales)
    starts, offset = [], 0
    for band in table.tensor_split(min(n_starts, table.shape[1]), dim=1):
        best = band.argmin(1) + offset
        starts.append(coordinates.encode(scales[best % len(scales)], ratios[best // len(scales)]))
        offset += band.shape[1]
    return torch.stack(starts)


def fit_hyperparameters(
    observations: Observations, search: EvidenceSearch
) -> tuple[Hyperparameters, Float[Tensor, " b"], FitReport]:
    """Hyperparameters that maximize each process's evidence: a grid, then L-BFGS from its best points.

    Returns
    -------
    Hyperparameters
    loss : Tensor of shape (b,)
        Negative log evidence of each process, in nats.
    report : FitReport
        Of their sum; its curve has two points, the grid's best and the end.

    Raises
    ------
    ValueError
        If the noise is held at zero for some processes and above zero for others.
    NotPositiveDefiniteError
        If there is no start from which the evidence can be computed, as for a length scale held at many
        times the spacing of inputs without noise.
    """
    if search.noise_scale is not None and len((search.noise_scale > 0).unique()) > 1:
        raise ValueError("noise_scale is zero for some processes and not for others: fit these in two searches.")
    blocks = []
    for rows in torch.arange(len(observations.targets)).split(_BLOCK):
        noise_scale = None if search.noise_scale is None else search.noise_scale[rows]
        block = replace(observations, targets=observations.targets[rows])
        blocks.append(_fit_block(block, replace(search, noise_scale=noise_scale)))
    found, losses, firsts, n_iters, ends = zip(*blocks, strict=True)
    hyperparameters = Hyperparameters(
        torch.cat([part.length_scale for part in found]),
        torch.cat([part.amplitude for part in found]),
        torch.cat([part.noise_ratio for part in found]),
    )
    loss, converged = torch.cat(losses), all(ends)
    curve = (float(torch.cat(firsts).sum()), float(loss.sum()))
    message = "converged" if converged else f"stopped at max_iter={search.max_iter} iterations"
    return hyperparameters, loss, FitReport(curve[-1], curve, max(n_iters), converged, message)


def _fit_block(observations: Observations, search: EvidenceSearch) -> tuple[Hyperparameters, Tensor, Tensor, int, bool]:
    """Hyperparameters, loss, loss of the grid's best points, iterations, and whether all converged."""
    coordinates = _Coordinates(observations, search)
    starts = _grid(coordinates, 1 + search.n_restarts)
    n_starts, n_processes, n_searched = starts.shape
    columns = torch.arange(n_processes, device=starts.device)
    rows = columns.repeat(n_starts)
    losses = coordinates.losses(starts)
    first = losses.amin(0)
    # A start far worse than another for each input is not polished: its optimum would have to be a spike.
    hopeful = (losses <= first + _HOPEFUL * len(observations.counts)).flatten()
    z, n_iter, converged = starts.flatten(0, 1), 0, True
    if n_searched:
        z[hopeful], batch = minimize_batch(
            lambda chosen, index: coordinates.loss(chosen, rows[hopeful][index]),
            z[hopeful],
            max_iter=search.max_iter,
            tol=search.tol,
        )
        n_iter, converged = batch.n_iter, batch.converged
        # Not evaluated again: at the edge of being singular another batch could round to another answer.
        losses = losses.flatten().masked_scatter(hopeful, batch.loss * len(observations.counts))
    loss, best = losses.reshape(n_starts, n_processes).min(0)
    if not torch.isfinite(loss).all():
        raise NotPositiveDefiniteError(
            "The kernel matrix is singular wherever the hyperparameters were searched. Allow for noise "
            "(noise_scale=None), or give a shorter length_scale."
        )
    return coordinates.hyperparameters(z.reshape(starts.shape)[best, columns]), loss, first, n_iter, converged

"""Latent Gaussian processes: prediction from observed values, eq. (5) and (6), and their evidence in closed form.

Several observations of one input enter as their mean and their count: the noise of a mean is the noise over the
root of the count. Targets are those from which the prior mean is subtracted.
"""

import math

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn

from torch_pbd.gp.observations import FULL, Basis, Hyperparameters, Observations
from torch_pbd.kernels import correlation, value_and_slope
from torch_pbd.linalg import cholesky_with_jitter, safe_cholesky

_LEAST_VARIANCE = 1e-200  # squared amplitude of targets that are all zero


class LatentGP(nn.Module):
    """b independent Gaussian processes with the same training inputs, conditioned on their values.

    Parameters
    ----------
    inputs : Tensor of shape (n, e)
        Training inputs, or nodes that stand for them.
    weight : Tensor of shape (b, n)
        What eq. (5) multiplies the correlations with the inputs by: the inverse of the matrix there, times
        the squared amplitude and the observed deviations from the prior mean.
    value_weight : Tensor of shape (b, n)
        The same for what the model reads off without a prior: see :meth:`values`.
    hyperparameters : Hyperparameters
        Of the b processes; ``length_scale`` of shape (1, e) where all share it.
    counts : Tensor of shape (n,)
        Observations behind each value; they divide the noise variance.
    kernel : str
    root : Tensor of shape (r, n), default=None
        Where the inputs are nodes: what was observed are r combinations of the values there.
    """

    inputs: Tensor
    value_weight: Tensor
    length_scale: Tensor
    amplitude: Tensor
    noise_ratio: Tensor
    counts: Tensor
    root: Tensor | None

    def __init__(
        self,
        inputs: Float[Tensor, "n e"],
        weight: Float[Tensor, "b n"],
        value_weight: Float[Tensor, "b n"],
        hyperparameters: Hyperparameters,
        counts: Float[Tensor, " n"],
        kernel: str = "squared_exponential",
        root: Float[Tensor, "r n"] | None = None,
    ) -> None:
        super().__init__()
        self.kernel = kernel
        self.weight = nn.Parameter(weight)
        self.register_buffer("inputs", inputs)
        self.register_buffer("value_weight", value_weight)
        self.register_buffer("length_scale", hyperparameters.length_scale)
        self.register_buffer("amplitude", hyperparameters.amplitude)
        self.register_buffer("noise_ratio", hyperparameters.noise_ratio)
        self.register_buffer("counts", counts)
        self.register_buffer("root", root)

    def forward(self, x: Float[Tensor, "m e"]) -> Float[Tensor, "m b"]:
        """Mean at x less the prior mean: eq. (5)."""
        return self._weighted(x, self.weight)[0]

    def values(self, x: Float[Tensor, "m e"]) -> Float[Tensor, "m b"]:
        """Mean at x of the processes of ``value_weight``, whose prior mean is zero: what data alone say."""
        return self._weighted(x, self.value_weight)[0]

    def both(self, x: Float[Tensor, "m e"]) -> list[Float[Tensor, "m b"]]:
        """Results of :meth:`forward` and :meth:`values`, by one matrix of correlations."""
        return self._weighted(x, self.weight, self.value_weight)

    def _weighted(self, x: Tensor, *weights: Tensor) -> list[Tensor]:
        cross = correlation(x, self.inputs, self.length_scale, self.kernel)
        # Processes that share their length scales share the correlations.
        if len(cross) == 1:
            return [cross[0] @ weight.mT for weight in weights]
        return [(cross @ weight.unsqueeze(-1)).squeeze(-1).mT for weight in weights]

    def variance(self, x: Float[Tensor, "m e"]) -> Float[Tensor, "m b"]:
        """Variance of the latent value at x: eq. (6)."""
        return (self.amplitude.square()[:, None] * self._reduced(x, self.noise_ratio)).mT

    def type1(self, x: Float[Tensor, "m e"]) -> Float[Tensor, " m"]:
        """Type I uncertainty: 0 at the training inputs, 1 where only the prior speaks.

        The variance of eq. (6) without noise, over the squared amplitude; the average over the processes
        has their squared amplitudes for weights.
        """
        reduced = self._reduced(x, torch.zeros_like(self.noise_ratio))
        share = self.amplitude.square().clamp_min(torch.finfo(self.amplitude.dtype).tiny)
        if len(reduced) == 1:
            return reduced[0]
        return ((share / share.sum()) @ reduced).clamp(max=1.0)

    def _reduced(self, x: Tensor, noise_ratio: Tensor) -> Tensor:
        """Eq. (6) over the squared amplitude: (b, m), or (1, m) where no noise tells the processes apart."""
        gram = correlation(self.inputs, self.inputs, self.length_scale, self.kernel)
        cross = correlation(self.inputs, x, self.length_scale, self.kernel)
        noise = noise_ratio[:, None].expand(-1, len(self.inputs)) / self.counts
        if self.root is not None:
            gram, cross = self.root @ gram @ self.root.mT, self.root @ cross
        if bool((noise_ratio > 0).any()):
            gram = gram + torch.diag_embed(noise)
        # Eq. (6) over the squared amplitude, 1 - k' inv(K + ratio / counts) k, by the factor of the matrix.
        factor = safe_cholesky(gram, name="the kernel matrix of the training inputs")
        whitened = torch.linalg.solve_triangular(factor, cross, upper=False)
        return (1.0 - whitened.square().sum(-2)).clamp(0.0, 1.0)


def condition(
    observations: Observations,
    hyperparameters: Hyperparameters,
    kernel: str = "squared_exponential",
    values: Float[Tensor, "b n"] | None = None,
    *,
    basis: Basis | None = None,
) -> tuple[LatentGP, float]:
    """Gaussian processes conditioned on noisy observations, and the relative jitter that needed.

    ``values`` are those whose prior mean is zero, if they are others than the targets. The nodes of a ``basis`` that
    carries the processes, by default all inputs, are the inputs of what is returned.
    """
    values = observations.targets if values is None else values
    basis = Basis(observations, FULL) if basis is None else basis
    targets, _ = basis.project(torch.cat([observations.targets, values]))
    gram = basis.covariance(correlation(basis.nodes, basis.nodes, hyperparameters.length_scale, kernel))
    gram = gram + hyperparameters.noise_ratio[:, None, None] * torch.eye(gram.shape[-1]).to(gram)
    factor, jitter = cholesky_with_jitter(gram, name="the kernel matrix of the training inputs")
    solved = torch.cholesky_solve(targets.reshape(2, -1, gram.shape[-1]).permute(1, 2, 0), factor)
    weight, value_weight = basis.node_weights(solved).unbind(-1)
    root = None if basis.root is None else basis.root.clone(memory_format=torch.contiguous_format)
    parts = (weight.contiguous(), value_weight.contiguous(), hyperparameters, basis.counts.clone(), kernel, root)
    return LatentGP(basis.nodes.clone(), *parts), jitter


class Evidence:
    """Negative log evidence (nats) of b processes as a function of length scales and noise ratio alone.

    For n observations y with the covariance ``v A``, A the correlation plus the noise ratio r on the diagonal, it is
    ``(y' inv(A) y / v + log |A| + n log(2 pi v)) / 2`` (Rasmussen and Williams, eq. (2.30)), less half the sum of
    the logarithms of the counts, as the observations are weighted by their roots. Its minimum in v is at
    ``v = y' inv(A) y / n``. What is outside of the basis has a covariance of v r alone.

    Parameters
    ----------
    basis : Basis
    targets : Tensor of shape (b, n)
    kernel : str
    noise_scale : Tensor of shape (b,) or None
        Where it is given the squared amplitude v is that which the noise ratio leaves, ``noise_scale^2 / r``. Zeros
        are no noise, and leave the amplitude free.
    """

    def __init__(
        self, basis: Basis, targets: Float[Tensor, "b n"], kernel: str, noise_scale: Float[Tensor, " b"] | None
    ) -> None:
        self.basis, self.kernel = basis, kernel
        self.targets, self.remainder = basis.project(targets)
        self.weighted = targets * basis.observations.counts.sqrt()
        self.noise_scale = noise_scale if noise_scale is not None and bool((noise_scale > 0).all()) else None
        nodes = basis.nodes.mT
        self.square_difference = (nodes[:, :, None] - nodes[:, None, :]).square()
        self.n_inputs = targets.shape[1]
        self.n_outside = self.n_inputs - self.targets.shape[1]
        self._constant = self.n_inputs * math.log(2.0 * math.pi) - float(basis.observations.counts.log().sum())

    def __call__(
        self, length_scale: Float[Tensor, "a e"], noise_ratio: Float[Tensor, " a"], rows: Int64[Tensor, " a"]
    ) -> tuple[Float[Tensor, " a"], Float[Tensor, "a e+1"]]:
        """Value for a of the processes, and gradient by the logarithms of length scales and, last, noise ratio.

        Both NaN where the covariance is not positive definite.
        """
        inverse_square = length_scale.square().reciprocal()
        correlated, slope = value_and_slope(self.square_difference, inverse_square, self.kernel)
        covariance = self.basis.covariance(correlated)
        covariance.diagonal(dim1=-2, dim2=-1).add_(noise_ratio[:, None])
        inverse, log_det = _inverse_and_log_det(covariance)
        targets = self.targets[rows].unsqueeze(-1)
        alpha = inverse @ targets
        quadratic = (targets * alpha).sum((-2, -1))
        if self.n_outside:
            outside = self.remainder[rows] / noise_ratio
            quadratic = quadratic + outside
            log_det = log_det + self.n_outside * noise_ratio.log()
        variance = self._variance(quadratic, noise_ratio, rows)
        loss = self._density(quadratic, log_det, variance)
        # With M = inv(A) - alpha alpha' / v and alpha = inv(A) y, a change of A changes the value by tr(M dA) / 2: the
        # best amplitude changes nothing to first order. The squared distance s is inversely proportional to the square
        # of the length scale, ds = -2 s d log(scale).
        matrix = inverse - (alpha / variance[:, None, None]) @ alpha.mT
        by_distance = (self.basis.covariance_vjp(matrix) * slope).flatten(1)
        by_length = (by_distance @ self.square_difference.flatten(1).mT) * -inverse_square
        by_ratio = noise_ratio * matrix.diagonal(dim1=-2, dim2=-1).sum(-1)
        if self.n_outside:
            by_ratio = by_ratio + (self.n_outside - outside / variance)
        if self.noise_scale is not None:  # the variance is inversely proportional to the ratio
            by_ratio = by_ratio + (quadratic / variance - self.n_inputs)
        return loss, torch.cat([by_length, 0.5 * by_ratio[:, None]], dim=1)

    def table(self, length_scales: Float[Tensor, "s e"], noise_ratios: Float[Tensor, " q"]) -> Float[Tensor, "b s q"]:
        """Values of all processes at all pairs; infinite where the covariance is near singular.

        With the eigenvectors E and eigenvalues w of the correlation A has the same E, and w + r: one decomposition
        of a length scale serves all processes and all noise ratios.
        """
        correlated, _ = value_and_slope(self.square_difference, length_scales.square().reciprocal(), self.kernel)
        eigenvalue, eigenvector = torch.linalg.eigh(self.basis.covariance(correlated))
        square = (self.targets @ eigenvector).square()  # (s, b, r)
        spectrum = eigenvalue.clamp_min(0.0).unsqueeze(1) + noise_ratios[:, None]  # (s, q, r)
        rounding = 10 * len(self.basis.nodes) * torch.finfo(spectrum.dtype).eps
        sound = eigenvalue[:, :1] + noise_ratios > rounding * spectrum[..., -1]
        quadratic = square @ (1.0 / spectrum.clamp_min(1e-300)).mT  # (s, b, q)
        log_det = spectrum.clamp_min(1e-300).log().sum(-1).unsqueeze(1)
        if self.n_outside:
            quadratic = quadratic + self.remainder[:, None] / noise_ratios
            log_det = log_det + self.n_outside * noise_ratios.log()
        variance = self._variance(quadratic, noise_ratios, (slice(None), None))
        loss = self._density(quadratic, log_det, variance)
        return loss.where(sound.unsqueeze(1), math.inf).transpose(0, 1)

    def residual(self, length_scale: Float[Tensor, "b e"], noise_ratio: Float[Tensor, " b"]) -> Float[Tensor, "b n"]:
        """Weighted observations less what each process explains; of a basis of nodes."""
        orthogonal = self.basis.orthogonal
        assert orthogonal is not None
        left = noise_ratio[:, None] * self._solved(length_scale, noise_ratio, slice(None))
        return self.weighted - (self.targets - left) @ orthogonal.mT

    def best_variance(
        self, length_scale: Float[Tensor, "a e"], noise_ratio: Float[Tensor, " a"], rows: Int64[Tensor, " a"]
    ) -> Float[Tensor, " a"]:
        """Squared amplitude; that of the targets themselves where the covariance is singular."""
        targets = self.targets[rows]
        quadratic = (targets * self._solved(length_scale, noise_ratio, rows)).sum(-1)
        if self.n_outside:
            quadratic = quadratic + self.remainder[rows] / noise_ratio
        variance = self._variance(quadratic, noise_ratio, rows)
        return torch.where(variance.isnan(), targets.square().mean(1).clamp_min(_LEAST_VARIANCE), variance)

    def _variance(self, quadratic: Tensor, noise_ratio: Tensor, rows: Tensor | tuple[slice, None]) -> Tensor:
        if self.noise_scale is None:
            return (quadratic / self.n_inputs).clamp_min(_LEAST_VARIANCE)
        return (self.noise_scale[rows].square() / noise_ratio).expand_as(quadratic)

    def _density(self, quadratic: Tensor, log_det: Tensor, variance: Tensor) -> Tensor:
        return 0.5 * (quadratic / variance + log_det + self.n_inputs * variance.log() + self._constant)

    def _solved(self, length_scale: Tensor, noise_ratio: Tensor, rows: Tensor | slice) -> Float[Tensor, "a r"]:
        """``inv(A) y``; NaN where A is singular."""
        nodes = self.basis.nodes
        covariance = self.basis.covariance(correlation(nodes, nodes, length_scale, self.kernel))
        covariance.diagonal(dim1=-2, dim2=-1).add_(noise_ratio[:, None])
        factor, info = torch.linalg.cholesky_ex(covariance)
        solved = torch.cholesky_solve(self.targets[rows].unsqueeze(-1), factor).squeeze(-1)
        return torch.where(info[:, None] == 0, solved, math.nan)


def negative_log_evidence(
    observations: Observations, hyperparameters: Hyperparameters, kernel: str = "squared_exponential"
) -> Float[Tensor, " b"]:
    """Negative log evidence of processes with noise, in nats; NaN where the covariance is not positive definite."""
    noise_scale = hyperparameters.amplitude * hyperparameters.noise_ratio.sqrt()
    evidence = Evidence(Basis(observations, FULL), observations.targets, kernel, noise_scale)
    length_scale = hyperparameters.length_scale.expand(len(noise_scale), -1)
    rows = torch.arange(len(noise_scale), device=noise_scale.device)
    return evidence(length_scale, hyperparameters.noise_ratio, rows)[0]


def _inverse_and_log_det(matrix: Float[Tensor, "a r r"]) -> tuple[Tensor, Tensor]:
    """Inverses and log determinants of positive definite matrices; the latter NaN for others."""
    factor, info = torch.linalg.cholesky_ex(matrix)
    log_det = 2.0 * factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    if bool(info.any()):
        log_det = torch.where(info == 0, log_det, math.nan)
        factor = torch.where((info > 0)[:, None, None], torch.eye(factor.shape[-1]).to(factor), factor)
    return torch.cholesky_inverse(factor), log_det

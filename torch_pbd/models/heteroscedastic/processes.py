"""Families of latent processes, their features, and the search for their hyperparameters."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import product

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from torch_pbd.exceptions import NotPositiveDefiniteError
from torch_pbd.gp.inducing import FeatureMap, Features, FixedFeatures, unexplained
from torch_pbd.optim import FitReport, Progress, Status, first_failure, minimize_batch

CLEAR = 3.0
"""Times the shortest length scale, above which inducing inputs resolve one with room to spare."""

_WIDEST = 4.0  # amplitudes stay within a factor of exp(4) of their prior median
_SPREAD_LENGTH_SCALE, _SPREAD_AMPLITUDE = 1.0, 1.5  # prior deviations of the logarithms
# Length scales, in ranges of the inputs, short to long by threes; and logarithms of amplitudes, weak and strong.
_STARTS = tuple(product((0.04, 0.12, 0.35, 1.0), (-1.0, 0.5)))
# Nats of the log evidence that features which are left out may be worth, of data as expected; searches end at 1e-3, and
# one that met a step of 3e-3, of 1e-5 here, did not.
_NEGLIGIBLE = 1e-7

_SMALL = 10_000  # entries of all processes' features
_DIFFERENCE = 1e-3  # of hyperparameters, whose gradients' differences tell the curvature at a start
_LEAST_CURVATURE = 0.2  # about half of the prior's

Gradient = Callable[[], Float[Tensor, "a q"]]
Evidence = Callable[[Float[Tensor, "a q"], Int64[Tensor, " a"]], tuple[Float[Tensor, " a"], Gradient]]
"""Log evidence of hyperparameters of some of the processes, given which ones; and what computes its gradients."""
_Objective = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]


@dataclass(frozen=True)
class ProcessFamily:
    """``constant + amplitude * process(x / length_scale)``: d of them, each with hyperparameters of its own.

    Hyperparameters theta are the logarithms of the length scales (e of them) and of the amplitude over its
    prior median.

    Parameters
    ----------
    features : FeatureMap
    length_scale, amplitude : float
        Medians of their prior, which is log-normal: a factor of e (of 4.5 for the amplitude) either way is usual.
    constant : float
        Prior standard deviation of the constant; 0 for none.
    fixed_length_scale : Tensor of shape (e,), default=None
        Takes the place of the searched one.
    shared : bool, default=False
        One length scale for all processes that are searched together.
    """

    features: FeatureMap
    length_scale: float
    amplitude: float
    constant: float
    fixed_length_scale: Float[Tensor, " e"] | None = None
    shared: bool = False

    def prepared(self, theta: Float[Tensor, "b q"]) -> "Processes":
        """Processes with these hyperparameters."""
        return Processes(self, self.amplitude_of(theta), self.features(self.length_scale_of(theta)))

    def design_vjp(
        self, fixed: FixedFeatures, theta: Float[Tensor, "b q"], information: Float[Tensor, " b"]
    ) -> tuple[Float[Tensor, "b n p"], Callable[[Float[Tensor, "b n p"]], Float[Tensor, "b q"]]]:
        """Design at inputs that stay, and the product of a gradient in it with its derivative in the hyperparameters.

        The gradient is that of a function of the design's inner products. Its log evidence is that of all features,
        but for what cannot be told: where features that carry a variance of at most v are left out, it changes by
        about half of v times the ``information``, the sum of the precisions of what is observed.
        """
        amplitude = self.amplitude_of(theta)
        negligible = 2.0 * _NEGLIGIBLE / (amplitude.square() * information)
        values, vjp = fixed.vjp(self.length_scale_of(theta), negligible)
        design = self.scaled(values, amplitude)

        def in_theta(gradient: Tensor) -> Tensor:
            gradient = gradient[..., : values.shape[-1]]  # the constant has no hyperparameters
            in_amplitude = (gradient * design[..., : values.shape[-1]]).sum((-2, -1))
            in_amplitude = in_amplitude * (1.0 - torch.tanh(theta[:, -1] / _WIDEST).square())
            if self.fixed_length_scale is not None:
                return torch.nn.functional.pad(in_amplitude[:, None], (theta.shape[1] - 1, 0))
            in_scale = vjp(amplitude[:, None, None] * gradient)
            in_scale = in_scale * torch.sigmoid(theta[:, :-1] - math.log(self.features.shortest_length_scale))
            return torch.cat([in_scale, in_amplitude[:, None]], dim=1)

        return design, in_theta

    def scaled(self, features: Float[Tensor, "b n m"], amplitude: Float[Tensor, " b"]) -> Float[Tensor, "b n p"]:
        """Features times the amplitudes, and the constant."""
        features = amplitude[:, None, None] * features
        if self.constant == 0.0:
            return features
        return torch.nn.functional.pad(features, (0, 1), value=self.constant)

    def length_scale_of(self, theta: Float[Tensor, "b q"]) -> Float[Tensor, "b e"]:
        """Length scales, never below what the inducing inputs resolve."""
        if self.fixed_length_scale is not None:
            return self.fixed_length_scale.expand(len(theta), -1)
        least = math.log(self.features.shortest_length_scale)
        return torch.logaddexp(theta[:, :-1], torch.full_like(theta[:, :-1], least)).exp()

    def theta_of(self, length_scale: Float[Tensor, "b e"], amplitude: Float[Tensor, " b"]) -> Float[Tensor, "b q"]:
        """Hyperparameters of these length scales and amplitudes, or those nearest to them."""
        above = (length_scale - self.features.shortest_length_scale).maximum(0.3 * length_scale)
        strength = (amplitude / self.amplitude).log().clamp(-0.5 * _WIDEST, 0.5 * _WIDEST)
        return torch.cat([above.log(), strength[:, None]], dim=1)

    def resolved(self, theta: Float[Tensor, "b q"]) -> bool:
        """Whether length scales stay clear of the shortest that the inducing inputs resolve."""
        least = CLEAR * self.features.shortest_length_scale
        return self.features.exact or bool((self.length_scale_of(theta) > least).all())

    def amplitude_of(self, theta: Float[Tensor, "b q"]) -> Float[Tensor, " b"]:
        """Amplitude, within a wide range."""
        return self.amplitude * (_WIDEST * torch.tanh(theta[:, -1] / _WIDEST)).exp()

    def log_prior(self, theta: Float[Tensor, "b q"]) -> tuple[Float[Tensor, " b"], Float[Tensor, "b q"]]:
        """Log density of hyperparameters, but for a constant, and its gradient."""
        median = theta.new_tensor([math.log(self.length_scale)] * (theta.shape[1] - 1) + [0.0])
        spread = theta.new_tensor([_SPREAD_LENGTH_SCALE] * (theta.shape[1] - 1) + [_SPREAD_AMPLITUDE])
        deviation = (theta - median) / spread
        return -0.5 * deviation.square().sum(-1), -deviation / spread

    def starts(self, like: Tensor, n_features: int) -> Float[Tensor, "s q"]:
        """Hyperparameters where a search may begin."""
        return like.new_tensor([[math.log(scale)] * n_features + [amplitude] for scale, amplitude in _STARTS])


@dataclass(frozen=True)
class Processes:
    """Processes of a family whose hyperparameters are known, with what does not depend on the inputs computed."""

    family: ProcessFamily
    amplitude: Float[Tensor, " b"]
    features: Features

    def __call__(self, x: Float[Tensor, "n e"]) -> Float[Tensor, "b n p"]:
        """Features at x, of which a process is the sum weighted by standard normal numbers."""
        return self.family.scaled(self.features(x), self.amplitude)

    def unexplained(self, design: Float[Tensor, "b n p"]) -> Float[Tensor, "b n"]:
        """Prior variance that the features at x do not carry: none at the inducing inputs, all far from them."""
        square = self.amplitude.square().unsqueeze(-1)
        return square * unexplained(design[..., : self.features.factor.shape[-1]] / self.amplitude[:, None, None])


@dataclass
class SearchOptions:
    """How hyperparameters are searched, and how the searches ended."""

    max_iter: int = 30
    tol: float = 1e-3
    """In nats."""
    n_restarts: int = 0
    """Starts beside the best point of the grid, where no earlier search gives one."""
    callback: Callable[[Progress], None] | None = None
    """Called at the end of each turn of mean and covariance."""
    slack: float = 1.0
    """Times the tolerance, as long as better evidence is to come."""
    ends: list[tuple[int, Status]] = field(default_factory=list)
    """Iterations of each search, and what ended it."""

    def report(self, turn: int, loss: float, elapsed: float) -> None:
        """Tell the callback."""
        if self.callback is not None:
            self.callback(Progress(turn, loss, elapsed))

    def outcome(self, losses: tuple[float, ...]) -> FitReport:
        """Report of a fit with these losses, by how its searches ended."""
        status = first_failure(status for _, status in self.ends)
        return FitReport(losses[-1], losses, max(n for n, _ in self.ends), status)


@dataclass
class Search:
    """Hyperparameters of the highest evidence times prior, by BFGS: for each of b processes by itself.

    The first run takes the best points of a small grid, and the curvature there by differences; the next ones start
    where the last ended, with its curvature.

    Parameters
    ----------
    family : ProcessFamily
    n_processes, n_features : int
        b, and the inputs' dimensions.
    options : SearchOptions
        Its reports are added to.
    """

    family: ProcessFamily
    n_processes: int
    n_features: int
    options: SearchOptions
    theta: Float[Tensor, "b q"] | None = None
    held: bool = False
    """Whether ``theta`` is given, and not searched."""
    _end: tuple[Tensor, Tensor] | None = None
    """Point and inverse Hessian that the last run ended with, of each problem."""

    def run(self, evidence: Evidence, like: Tensor) -> Float[Tensor, "b q"]:
        """Hyperparameters for this evidence; ``like`` has the dtype and the device to work on."""
        if self.held and self.theta is not None:
            return self.theta
        every = torch.arange(self.n_processes, device=like.device)

        def value(theta: Tensor, rows: Tensor) -> tuple[Tensor, Gradient]:
            try:
                return evidence(theta, rows)
            except (NotPositiveDefiniteError, torch.linalg.LinAlgError):  # type: ignore[attr-defined]
                return math.nan * theta.sum(-1), lambda: theta  # too far, for the optimizer

        def loss(theta: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
            found, gradient = value(theta, rows)
            prior, of_prior = self.family.log_prior(theta)
            return -found - prior, -gradient() - of_prior

        def joint_loss(points: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
            values, gradients = loss(self._spread_out(points), every.repeat(len(points)))
            each = gradients.reshape(len(points), self.n_processes, -1)
            together = torch.cat([each[..., :-1].sum(1), each[..., -1]], dim=1)
            return values.reshape(len(points), -1).sum(1), together

        objective = joint_loss if self.family.shared else loss
        starts = self._starts(value, objective, every, like) if self._end is None else [self._end]
        ends = [
            minimize_batch(
                objective,
                start,
                max_iter=self.options.max_iter,
                tol=self.options.slack * self.options.tol,
                inverse_hessian=inverse_hessian,
            )
            for start, inverse_hessian in starts
        ]
        points, reports = zip(*ends, strict=True)
        best = torch.stack([report.loss for report in reports]).nan_to_num(nan=math.inf).argmin(0)
        row = torch.arange(len(best), device=like.device)
        inverse_hessians = torch.stack([report.inverse_hessian for report in reports])
        self._end = torch.stack(points)[best, row], inverse_hessians[best, row]
        status = first_failure(report.status for report in reports)
        self.options.ends.append((max(report.n_iter for report in reports), status))
        self.theta = self._spread_out(self._end[0]) if self.family.shared else self._end[0]
        return self.theta

    def _starts(
        self, value: Evidence, objective: _Objective, every: Tensor, like: Tensor
    ) -> list[tuple[Tensor, Tensor]]:
        """Best points of the grid for each problem, and inverse Hessians there."""
        points, table = self.family.starts(like, self.n_features), -self._table(value, every, like)
        starts = [points[rank] for rank in table.argsort(0)[: 1 + self.options.n_restarts]]
        if self.family.shared:
            starts = [torch.cat([start[:, :-1], start[:, -1:].expand(-1, len(every))], dim=1) for start in starts]
        return [(start, _inverse_hessian(objective, start)) for start in starts]

    def best_of_grid(self, evidence: Evidence, like: Tensor) -> Float[Tensor, ""]:
        """Highest log evidence times prior that a search would start from, of all processes together."""
        every = torch.arange(self.n_processes, device=like.device)
        return self._table(evidence, every, like).amax(0).sum()

    def maximum(self, evidence: Evidence, like: Tensor) -> Float[Tensor, ""]:
        """Highest log evidence times prior that a search finds, of all processes together."""
        theta = self.run(evidence, like)
        value, _ = evidence(theta, torch.arange(self.n_processes, device=like.device))
        return (value + self.family.log_prior(theta)[0]).sum()

    def _table(self, value: Evidence, every: Tensor, like: Tensor) -> Float[Tensor, "s b"]:
        """Log evidence times prior at the points of the grid; of all processes together where they share one scale.

        Those of one length scale are tried together, as they take as many features; all, where calls cost more.
        """
        points = self.family.starts(like, self.n_features)
        small = like.numel() * len(self.family.features.inducing) < _SMALL
        parts = [
            value(pair.repeat_interleave(len(every), dim=0), every.repeat(len(pair)))[0].reshape(-1, len(every))
            for pair in points.split(len(points) if small else 2)
        ]
        table = (torch.cat(parts) + self.family.log_prior(points)[0][:, None]).nan_to_num(nan=-math.inf)
        return table.sum(1, keepdim=True) if self.family.shared else table

    def _spread_out(self, together: Float[Tensor, "s r"]) -> Float[Tensor, "sb q"]:
        """Hyperparameters of each process from the length scales of all and the amplitude of each."""
        scales = together[:, None, : self.n_features].expand(-1, self.n_processes, -1)
        return torch.cat([scales, together[:, self.n_features :, None]], dim=2).flatten(0, 1)


def _inverse_hessian(objective: _Objective, start: Float[Tensor, "b p"]) -> Float[Tensor, "b p p"]:
    """By differences of gradients; of directions with less or negative curvature as if they had its size."""
    n_problems, size = start.shape
    steps = torch.cat([start.new_zeros(1, size), _DIFFERENCE * torch.eye(size).to(start)])
    points = (start + steps[:, None]).flatten(0, 1)
    rows = torch.arange(n_problems, device=start.device).repeat(size + 1)
    _, gradients = objective(points, rows)
    gradients = gradients.reshape(size + 1, n_problems, size)
    hessian = ((gradients[1:] - gradients[0]) / _DIFFERENCE).transpose(0, 1)
    curvature, axes = torch.linalg.eigh(0.5 * (hessian + hessian.mT).nan_to_num())
    return axes @ torch.diag_embed(1.0 / curvature.abs().clamp_min(_LEAST_CURVATURE)) @ axes.mT

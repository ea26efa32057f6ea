"""Families of latent processes, and the search for their hyperparameters."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from torch_pbd.exceptions import NotPositiveDefiniteError
from torch_pbd.gp.inducing import FeatureMap
from torch_pbd.optim import BatchReport, Progress, by_autograd, minimize_batch

_CLEAR = 3.0  # times the shortest length scale
_WIDEST = 4.0  # amplitudes stay within a factor of exp(4) of their prior median
_SPREAD_LENGTH_SCALE, _SPREAD_AMPLITUDE = 1.0, 1.5  # prior deviations of the logarithms


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
    reports: list[BatchReport] = field(default_factory=list)

    def report(self, turn: int, loss: float, elapsed: float) -> None:
        """Tell the callback."""
        if self.callback is not None:
            self.callback(Progress(turn, loss, elapsed))


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

    def design(self, x: Float[Tensor, "n e"], theta: Float[Tensor, "b q"]) -> Float[Tensor, "b n p"]:
        """Features at x, of which a process is the sum weighted by standard normal numbers."""
        features = self.amplitude_of(theta)[:, None, None] * self.features(x, self.length_scale_of(theta))
        if self.constant == 0.0:
            return features
        return torch.cat([features, self.constant * torch.ones_like(features[..., :1])], dim=-1)

    def unexplained(self, design: Float[Tensor, "b n p"], theta: Float[Tensor, "b q"]) -> Float[Tensor, "b n"]:
        """Prior variance that the features at x do not carry: none at the inducing inputs, all far from them."""
        carried = design[..., : len(self.features.inducing)].square().sum(-1)
        return (self.amplitude_of(theta).square().unsqueeze(-1) - carried).clamp_min(0.0)

    def length_scale_of(self, theta: Float[Tensor, "b q"]) -> Float[Tensor, "b e"]:
        """Length scales, never below what the inducing inputs resolve."""
        if self.fixed_length_scale is not None:
            return self.fixed_length_scale.expand(len(theta), -1)
        least = math.log(self.features.shortest_length_scale())
        return torch.logaddexp(theta[:, :-1], torch.full_like(theta[:, :-1], least)).exp()

    def resolved(self, theta: Float[Tensor, "b q"]) -> bool:
        """Whether length scales stay clear of the shortest that the inducing inputs resolve."""
        least = _CLEAR * self.features.shortest_length_scale()
        return self.features.exact or bool((self.length_scale_of(theta) > least).all())

    def amplitude_of(self, theta: Float[Tensor, "b q"]) -> Float[Tensor, " b"]:
        """Amplitude, within a wide range."""
        return self.amplitude * (_WIDEST * torch.tanh(theta[:, -1] / _WIDEST)).exp()

    def log_prior(self, theta: Float[Tensor, "b q"]) -> Float[Tensor, " b"]:
        """Log density of hyperparameters, but for a constant."""
        scales = (theta[:, :-1] - math.log(self.length_scale)) / _SPREAD_LENGTH_SCALE
        return -0.5 * (scales.square().sum(-1) + (theta[:, -1] / _SPREAD_AMPLITUDE).square())

    def starts(self, like: Tensor, n_features: int) -> Float[Tensor, "s q"]:
        """Where a search begins: short and long, weak and strong."""
        grid = [
            [math.log(scale)] * n_features + [amplitude]
            for scale in (0.04, 0.12, 0.35, 1.0)
            for amplitude in (-1.0, 0.5)
        ]
        return like.new_tensor(grid)


def search(
    family: ProcessFamily,
    evidence: Callable[[Float[Tensor, "a q"], Int64[Tensor, " a"]], Float[Tensor, " a"]],
    start: Float[Tensor, "b q"] | None,
    size: tuple[int, int],
    like: Tensor,
    options: SearchOptions,
) -> Float[Tensor, "b q"]:
    """Hyperparameters of the highest evidence times prior, by L-BFGS: for each of b processes by itself.

    Parameters
    ----------
    evidence : callable
        Log evidence of hyperparameters of some of the processes, given which ones.
    start : Tensor of shape (b, q) or None
        Without one the best points of a small grid.
    size : (int, int)
        Numbers of processes and of inputs' dimensions.
    like : Tensor
        Of the dtype and on the device to work on.
    options : SearchOptions
        Its reports are added to.
    """
    n_processes, n_features = size
    every = torch.arange(n_processes, device=like.device)

    def loss(theta: Tensor, rows: Tensor) -> Tensor:
        try:
            return -evidence(theta, rows) - family.log_prior(theta)
        except (NotPositiveDefiniteError, torch.linalg.LinAlgError):  # type: ignore[attr-defined]
            return math.nan * theta.sum(-1)  # too far, for the optimizer

    def joint_loss(theta: Tensor, _: Tensor) -> Tensor:
        return torch.stack([loss(_spread_out(row, n_features), every).sum() for row in theta])

    candidates = [start] if start is not None else _best_of_grid(family, loss, every, n_features, like, options)
    ends, losses = [], []
    for candidate in candidates:
        if family.shared:
            together = torch.cat([candidate[0, :n_features], candidate[:, -1]])[None]
            end, report = minimize_batch(by_autograd(joint_loss), together, max_iter=options.max_iter, tol=options.tol)
            ends.append(_spread_out(end[0], n_features))
            losses.append(report.loss.expand(n_processes))
        else:
            end, report = minimize_batch(by_autograd(loss), candidate, max_iter=options.max_iter, tol=options.tol)
            ends.append(end)
            losses.append(report.loss)
        options.reports.append(report)
    best = torch.stack(losses).nan_to_num(nan=math.inf).argmin(0)
    return torch.stack(ends)[best, every]


def _best_of_grid(
    family: ProcessFamily,
    loss: Callable[[Tensor, Tensor], Tensor],
    every: Tensor,
    n_features: int,
    like: Tensor,
    options: SearchOptions,
) -> list[Tensor]:
    points = family.starts(like, n_features)
    with torch.no_grad():
        table = torch.stack([loss(point.expand(len(every), -1), every) for point in points])
    table = table.nan_to_num(nan=math.inf)
    if family.shared:
        table = table.sum(1, keepdim=True).expand_as(table)
    order = table.argsort(0)[: 1 + options.n_restarts]
    return [points[rank] for rank in order]


def _spread_out(together: Tensor, n_features: int) -> Tensor:
    """Hyperparameters of each process from the length scales of all and the amplitude of each."""
    amplitudes = together[n_features:, None]
    return torch.cat([together[:n_features].expand(len(amplitudes), -1), amplitudes], dim=1)

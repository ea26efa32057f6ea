"""Gaussian processes of low rank: weights of standard normal numbers on features of inducing inputs.

With the kernel matrix K = L L' of the inducing inputs, and their kernel c with x, the features at x are inv(L) c. With
the inducing inputs at all training inputs the processes are the exact ones; with fewer they are the "deterministic
training conditional" approximation, which is exact at the inducing inputs.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from torch_pbd.gp.observations import SHORTEST, neighbourhoods, spacing, sum_by
from torch_pbd.kernels import correlation, differences, value_and_slope
from torch_pbd.linalg import safe_cholesky

# In ranges of the inputs: those that nearly coincide, as of two precisions, show no finer detail than this.
_SHORTEST = 1e-3
_RESOLUTION = 1.0  # spacings: at this length scale features carry 0.995 of the variance between inducing inputs
CLEAR = 3.0  # times the shortest length scale, above which inducing inputs resolve one with room to spare
# Of a process's variance: less than this that features do not carry is the jitter of kernel matrices, and rounding.
_ROUNDING = 1e-11
_WIDEST = 4.0  # amplitudes stay within a factor of exp(4) of their prior median
_SPREAD_LENGTH_SCALE, _SPREAD_AMPLITUDE = 1.0, 1.5  # prior deviations of the logarithms
# Nats of the log evidence that features which are left out may be worth, of data as expected; searches end at 1e-3, and
# one that met a step of 3e-3, of 1e-5 here, did not.
_NEGLIGIBLE = 1e-7


Gradient = Callable[[], Float[Tensor, "a q"]]
Evidence = Callable[[Float[Tensor, "a q"], Int64[Tensor, " a"]], tuple[Float[Tensor, " a"], Gradient]]
"""Log evidence of hyperparameters of some of the processes, given which ones; and what computes its gradients."""


@dataclass(frozen=True)
class ProcessFamily:
    """``constant + amplitude * process(x / length_scale)``: b of them, each with hyperparameters of its own.

    Hyperparameters theta are the logarithms of the length scales (e of them) and of the amplitude over its
    prior median.
    """

    inducing: Float[Tensor, "m e"]
    length_scale: float
    """Median of its prior, which is log-normal: a factor of e either way is usual."""
    amplitude: float
    """Median of its prior: a factor of 4.5 either way is usual."""
    constant: float
    """Prior standard deviation of the constant; 0 for none."""
    fixed_length_scale: Float[Tensor, " e"] | None = None
    """Takes the place of the searched one."""
    kernel: str = "squared_exponential"
    period: Float[Tensor, " e"] | None = None
    exact: bool = False
    """Whether the inducing inputs are all the training inputs."""
    stretch: Float[Tensor, "2 2"] | None = None
    """Length added next to the first and the last input, and the distance from it over which most of it is."""
    # Kernel matrices of smooth kernels have a condition number beyond float64: what this takes away from a process of
    # unit variance cannot be told from noise.
    jitter: ClassVar[float] = 1e-13
    """Added to the diagonal of kernel matrices, which is one."""

    def prepared(self, theta: Float[Tensor, "b q"]) -> "Processes":
        """Processes with these hyperparameters."""
        length_scale, inducing = self.length_scale_of(theta), self.warped(self.inducing)
        gram = correlation(inducing, inducing, length_scale, self.kernel, self.period)
        gram = gram + self.jitter * torch.eye(len(inducing)).to(gram)
        factor = safe_cholesky(gram, name="the kernel matrix of the inducing inputs")
        return Processes(self, theta, length_scale, self.amplitude_of(theta), factor)

    def warped(self, x: Float[Tensor, "n e"]) -> Float[Tensor, "n e"]:
        """Inputs with length added next to the ends of their range, within which alone it is."""
        if self.stretch is None:
            return x
        (first, first_width), (last, last_width) = self.stretch
        from_first, from_last = (x + 0.5).clamp_min(0.0), (0.5 - x).clamp_min(0.0)
        return x - first * torch.expm1(-from_first / first_width) + last * torch.expm1(-from_last / last_width)

    def square_differences(self, x: Float[Tensor, "n e"], other: Float[Tensor, "m e"]) -> Float[Tensor, "e n m"]:
        """Squares of the differences in each dimension; along a circle of the chords."""
        return torch.stack(differences(self.warped(x), self.warped(other), self.period)).square()

    @cached_property
    def farthest_first(self) -> Int64[Tensor, " m"]:
        """Order of the inducing inputs in which each is the farthest from those before it, begun at the middle."""
        distance = self.square_differences(self.inducing, self.inducing).sum(0)
        number = int(distance.sum(0).argmin())
        nearest = torch.full_like(distance[0], math.inf)
        order = []
        for _ in range(len(distance)):
            order.append(number)
            nearest = torch.minimum(nearest, distance[number])
            nearest[number] = -1.0
            number = int(nearest.argmax())
        return torch.tensor(order, device=distance.device)

    @cached_property
    def shortest_length_scale(self) -> float:
        """Length scale below which the inducing inputs no longer resolve what is between them."""
        if len(self.inducing) < 2:
            return _SHORTEST
        share = SHORTEST if self.exact else _RESOLUTION
        return max(_SHORTEST, min(0.5, share * spacing(self.warped(self.inducing))))

    def length_scale_of(self, theta: Float[Tensor, "b q"]) -> Float[Tensor, "b e"]:
        """Length scales, never below what the inducing inputs resolve."""
        if self.fixed_length_scale is not None:
            return self.fixed_length_scale.expand(len(theta), -1)
        least = math.log(self.shortest_length_scale)
        return torch.logaddexp(theta[:, :-1], torch.full_like(theta[:, :-1], least)).exp()

    def amplitude_of(self, theta: Float[Tensor, "b q"]) -> Float[Tensor, " b"]:
        """Amplitude, within a wide range."""
        return self.amplitude * (_WIDEST * torch.tanh(theta[:, -1] / _WIDEST)).exp()

    def theta_of(self, length_scale: Float[Tensor, "b e"], amplitude: Float[Tensor, " b"]) -> Float[Tensor, "b q"]:
        """Hyperparameters of these length scales and amplitudes, or those nearest to them."""
        above = (length_scale - self.shortest_length_scale).maximum(0.3 * length_scale)
        strength = (amplitude / self.amplitude).log().clamp(-0.5 * _WIDEST, 0.5 * _WIDEST)
        return torch.cat([above.log(), strength[:, None]], dim=1)

    def log_prior(self, theta: Float[Tensor, "b q"]) -> tuple[Float[Tensor, " b"], Float[Tensor, "b q"]]:
        """Log density of hyperparameters, but for a constant, and its gradient."""
        median = theta.new_tensor([math.log(self.length_scale)] * (theta.shape[1] - 1) + [0.0])
        spread = theta.new_tensor([_SPREAD_LENGTH_SCALE] * (theta.shape[1] - 1) + [_SPREAD_AMPLITUDE])
        deviation = (theta - median) / spread
        return -0.5 * deviation.square().sum(-1), -deviation / spread

    def scaled(self, features: Float[Tensor, "b n m"], amplitude: Float[Tensor, " b"]) -> Float[Tensor, "b n p"]:
        """Features times the amplitudes, and the constant."""
        features = amplitude[:, None, None] * features
        return torch.nn.functional.pad(features, (0, 1), value=self.constant) if self.constant else features


@dataclass(frozen=True)
class Processes:
    """Processes of a family whose hyperparameters are known, with what does not depend on x computed."""

    family: ProcessFamily
    theta: Float[Tensor, "b q"]
    length_scale: Float[Tensor, "b e"]
    amplitude: Float[Tensor, " b"]
    factor: Float[Tensor, "b m m"]
    """Lower Cholesky factor of the kernel matrix of the inducing inputs."""

    def __call__(self, x: Float[Tensor, "n e"]) -> Float[Tensor, "b n p"]:
        """Features at x, of which a process is the sum weighted by standard normal numbers.

        Their inner products are the covariance, wherever the inducing inputs resolve it.
        """
        features = torch.linalg.solve_triangular(self.factor, self.cross(x).mT, upper=False).mT
        return self.family.scaled(features, self.amplitude)

    @property
    def resolved(self) -> bool:
        """Whether length scales stay clear of the shortest that the inducing inputs resolve, or these are all."""
        return self.family.exact or bool((self.length_scale > CLEAR * self.family.shortest_length_scale).all())

    def cross(self, x: Float[Tensor, "n e"]) -> Float[Tensor, "b n m"]:
        """Kernel between x and the inducing inputs."""
        family = self.family
        inducing = family.warped(family.inducing)
        return correlation(family.warped(x), inducing, self.length_scale, family.kernel, family.period)

    def unexplained(self, design: Float[Tensor, "b n p"]) -> Float[Tensor, "b n"]:
        """Prior variance that the features at x do not carry: none at the inducing inputs, all far from them.

        Where y deviates by a millionth, rounding would else be a hundredth of what is predicted.
        """
        features = design[..., : self.factor.shape[-1]] / self.amplitude[:, None, None]
        share = (1.0 - features.square().sum(-1)).clamp(0.0, 1.0)
        # Smooth, and equal to the bit above a few of these.
        share = share * -torch.expm1(-(share / _ROUNDING).square())
        return self.amplitude.square()[:, None] * share


class FixedFeatures:
    """Features of a family at x that stay, for some hyperparameters after others.

    The inducing inputs are taken each as far as possible from those before it, and no more of them than carry what
    can be told: for a smooth kernel and a long length scale these are few. The features are those of the processes but
    for an orthogonal matrix, and so are the same processes.
    """

    def __init__(self, family: ProcessFamily, x: Float[Tensor, "n e"]) -> None:
        self.family = family
        chosen = family.inducing[family.farthest_first]
        self._gram = family.square_differences(chosen, chosen)
        self._cross = family.square_differences(chosen, x)
        self._jitter = family.jitter * torch.eye(len(chosen)).to(x)

    def design_vjp(
        self, theta: Float[Tensor, "b q"], information: Float[Tensor, " b"]
    ) -> tuple[Float[Tensor, "b n p"], Callable[[Float[Tensor, "b n p"]], Float[Tensor, "b q"]]]:
        """Design, and the product of a gradient in it with its derivative in the hyperparameters.

        The gradient is to be that of a function of the design's inner products. Its log evidence is that of all
        features, but for what cannot be told: where features that carry a variance of at most v are left out, it
        changes by about half of v times the ``information``, the sum of the precisions of what is observed.
        """
        family = self.family
        length_scale, amplitude = family.length_scale_of(theta), family.amplitude_of(theta)
        inverse_square = length_scale.reciprocal().square()
        gram, gram_slope = value_and_slope(self._gram, inverse_square, family.kernel)
        factor = safe_cholesky(gram + self._jitter, name="the kernel matrix of the inducing inputs")
        # The square of a diagonal entry is the variance at an inducing input given those before it, and given the
        # first r of them none is farther from these than the next. One feature is left in any case.
        negligible = 2.0 * _NEGLIGIBLE / (amplitude.square() * information)
        carries = (factor.diagonal(dim1=-2, dim2=-1).square() > negligible[:, None]).any(0)
        size = int(carries.nonzero().max()) + 1 if bool(carries.any()) else 1
        factor, gram_slope = factor[:, :size, :size], gram_slope[:, :size, :size]
        gram_squares, cross_squares = self._gram[:, :size, :size], self._cross[:, :size]
        cross, cross_slope = value_and_slope(cross_squares, inverse_square, family.kernel)
        features = torch.linalg.solve_triangular(factor, cross, upper=False).mT
        design = family.scaled(features, amplitude)

        # With K = L L' of the inducing inputs and C their kernel with the others the features are F' = inv(L) C, and
        # dF' = inv(L) dC - P F', where P is the lower half of S = inv(L) dK inv(L)'. P and S / 2 differ by an
        # antisymmetric matrix, a rotation of the features, which a function of inner products does not see:
        # dF' = inv(L) (dC - dK inv(K) C / 2). For a squared distance s in length scales dk = -2 s k'(s) d log(scale).
        def in_theta(gradient: Tensor) -> Tensor:
            gradient = gradient[..., :size]  # the constant has no hyperparameters
            in_amplitude = (gradient * design[..., :size]).sum((-2, -1))
            in_amplitude = (in_amplitude * (1.0 - torch.tanh(theta[:, -1] / _WIDEST).square()))[:, None]
            if family.fixed_length_scale is not None:
                return torch.nn.functional.pad(in_amplitude, (theta.shape[1] - 1, 0))
            both = torch.cat([amplitude[:, None, None] * gradient.mT, features.mT], dim=-1)
            adjoint, solved = torch.linalg.solve_triangular(factor.mT, both, upper=True).chunk(2, dim=-1)
            in_cross = (adjoint * cross_slope).flatten(1) @ cross_squares.flatten(1).mT
            in_gram = (adjoint @ solved.mT * gram_slope).flatten(1) @ gram_squares.flatten(1).mT
            in_scale = (in_gram - 2.0 * in_cross) / length_scale.square()
            in_scale = in_scale * torch.sigmoid(theta[:, :-1] - math.log(family.shortest_length_scale))
            return torch.cat([in_scale, in_amplitude], dim=1)

        return design, in_theta


def inducing_inputs(inputs: Float[Tensor, "n e"], n_inducing: int) -> Float[Tensor, "m e"]:
    """The inputs themselves, or where they are too many the centres of their neighbourhoods.

    On a line the ends are among them: of a prior far wider than what is learned, the share that a process of centres
    alone leaves there, 6e-5, is more than the deviations of movements that start or end at one point.
    """
    if len(inputs) <= n_inducing:
        return inputs
    ends = inputs[:0]
    if inputs.shape[1] == 1:
        order = inputs[:, 0].argsort(stable=True)
        ends, inputs = inputs[order[[0, -1]]], inputs[order[1:-1]]
    n_centres = max(1, n_inducing - len(ends))
    index = neighbourhoods(inputs, n_centres)
    centres = sum_by(inputs, index) / torch.bincount(index).to(inputs)[:, None]
    return torch.cat([ends, centres])[:n_inducing]

"""Families of latent processes, and their features."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torch_pbd.gp.inducing import FeatureMap, Features, FixedFeatures

CLEAR = 3.0
"""Times the shortest length scale, above which inducing inputs resolve one with room to spare."""

_WIDEST = 4.0  # amplitudes stay within a factor of exp(4) of their prior median
_SPREAD_LENGTH_SCALE, _SPREAD_AMPLITUDE = 1.0, 1.5  # prior deviations of the logarithms
_NEGLIGIBLE = 1e-5  # nats of the log evidence, that features which are left out may be worth; searches end at 1e-3


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
        return self.prepared(theta)(x)

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
            in_scale = in_scale * torch.sigmoid(theta[:, :-1] - math.log(self.features.shortest_length_scale()))
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
        least = math.log(self.features.shortest_length_scale())
        return torch.logaddexp(theta[:, :-1], torch.full_like(theta[:, :-1], least)).exp()

    def theta_of(self, length_scale: Float[Tensor, "b e"], amplitude: Float[Tensor, " b"]) -> Float[Tensor, "b q"]:
        """Hyperparameters of these length scales and amplitudes, or those nearest to them."""
        above = (length_scale - self.features.shortest_length_scale()).maximum(0.3 * length_scale)
        strength = (amplitude / self.amplitude).log().clamp(-0.5 * _WIDEST, 0.5 * _WIDEST)
        return torch.cat([above.log(), strength[:, None]], dim=1)

    def resolved(self, theta: Float[Tensor, "b q"]) -> bool:
        """Whether length scales stay clear of the shortest that the inducing inputs resolve."""
        least = CLEAR * self.features.shortest_length_scale()
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
        """Where a search begins: short and long, weak and strong."""
        grid = [
            [math.log(scale)] * n_features + [amplitude]
            for scale in (0.04, 0.12, 0.35, 1.0)
            for amplitude in (-1.0, 0.5)
        ]
        return like.new_tensor(grid)


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
        carried = design[..., : self.features.factor.shape[-1]].square().sum(-1)
        return (self.amplitude.square().unsqueeze(-1) - carried).clamp_min(0.0)

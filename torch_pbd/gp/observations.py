"""What is known of a batch of processes: their observations and their hyperparameters."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class Observations:
    """Targets of b processes at n distinct inputs, the mean of ``counts`` observations each."""

    inputs: Float[Tensor, "n e"]
    targets: Float[Tensor, "b n"]
    counts: Float[Tensor, " n"]


@dataclass(frozen=True)
class Hyperparameters:
    """Of b processes: length scales (one row where all share them), amplitude, and the noise variance over
    the squared amplitude.
    """

    length_scale: Float[Tensor, "g e"]
    amplitude: Float[Tensor, " b"]
    noise_ratio: Float[Tensor, " b"]

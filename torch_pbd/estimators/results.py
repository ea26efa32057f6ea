"""What a fit gives, and what is asked of it."""

from dataclasses import dataclass
from typing import NamedTuple

from torch_pbd.estimators.validation import Floats
from torch_pbd.models.conditional import ConditionalNormal
from torch_pbd.optim import FitReport


class Uncertainty(NamedTuple):
    """The two kinds of uncertainty of Section IV-C, at n inputs."""

    type1: Floats
    """(n,): missing data. 0 at training inputs, 1 where only the prior speaks."""
    type2: Floats
    """(n, d, d): variability of the data, with the prior taken out; squared units of y."""


@dataclass(frozen=True)
class Fitted:
    """What a subclass returns from its fit."""

    module: ConditionalNormal
    report: FitReport
    jitter: float

"""Stiffness and damping of a movement from what is known of its variability, and what is not."""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from torch_pbd.control.damping import damping_from_stiffness
from torch_pbd.control.primitive.coverage import UNKNOWN
from torch_pbd.control.stiffness import StiffnessLaw

Floats = NDArray[np.float64]
OnUnknown = Literal["soft", "prior", "raise"]


class Gains(NamedTuple):
    """Stiffness and damping (n, d, d), and the covariance (n, d, d) and Type I uncertainty (n,) they come from."""

    stiffness: Floats
    damping: Floats
    covariance: Floats
    type1: Floats


@dataclass(frozen=True)
class Impedance:
    """Gains from covariances; see the parameters of :class:`~torch_pbd.control.DMPController`."""

    law: StiffnessLaw
    mass: float
    damping_ratio: float | Literal["paper"]
    on_unknown: OnUnknown

    def __call__(self, covariance: Floats, type1: Floats, time: Floats) -> Gains:
        """Gains of covariances (n, d, d) with Type I uncertainties (n,), at times (n,).

        Raises
        ------
        ValueError
            With on_unknown="raise", if the uncertainty is above 0.5 somewhere.
        """
        if self.on_unknown == "raise" and (type1 > UNKNOWN).any():
            index = int(np.argmax(type1 > UNKNOWN))
            raise ValueError(
                f"There are no data at time {time[index]:g}: the Type I uncertainty is {type1[index]:.2f}. Ask within "
                "the demonstrations, or let on_unknown='soft' make the robot compliant there."
            )
        stiffness = self.law(covariance)
        if self.on_unknown == "soft":
            softest = self.law.stiffness_min * torch.eye(stiffness.shape[-1]).to(stiffness)
            known = torch.tensor(1.0 - type1)[:, None, None]
            stiffness = softest + known * (stiffness - softest)
        damping = damping_from_stiffness(stiffness, self.mass, self.damping_ratio)
        return Gains(stiffness.numpy(), damping.numpy(), covariance, type1)

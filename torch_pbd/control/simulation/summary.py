"""What is told of many rollouts: quantiles over time, and a few numbers of each."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torch_pbd.control.simulation.rollouts import Deviations, Tally

Floats = NDArray[np.float64]


@final
@dataclass(frozen=True, eq=False, repr=False)
class RolloutSummary:
    """What R random pushes did to a robot; NumPy arrays.

    Attributes
    ----------
    time : (n,), s
    quantiles : (n_quantiles,)
    deviation : (n, n_quantiles), m
        Quantiles over the rollouts of the distance from the reference at these times.
    peak_deviation : (R,), m
        Largest distance of each rollout; rollouts are in the order in which they are pushed.
    peak_time : (R,), s
    return_time : (R,), s
        From the end of the push until the distance stays below the threshold; inf where it is above it at the end.
    final_deviation : (R,), m
    onset, duration : (R,), s
        Of the push.
    push : (R, d), N
        Force at its peak.
    """

    time: Floats
    quantiles: Floats
    deviation: Floats
    peak_deviation: Floats
    peak_time: Floats
    return_time: Floats
    final_deviation: Floats
    onset: Floats
    duration: Floats
    push: Floats

    @property
    def n_rollouts(self) -> int:
        """Number of rollouts R."""
        return len(self.onset)

    def __repr__(self) -> str:
        low, middle, high = np.quantile(self.peak_deviation, (0.05, 0.5, 0.95))
        returned = np.isfinite(self.return_time)
        return (
            f"RolloutSummary(n_rollouts={self.n_rollouts}, peak deviation "
            f"{1e3 * low:.3g}/{1e3 * middle:.3g}/{1e3 * high:.3g} mm at 5/50/95 %, {returned.mean():.0%} return)"
        )


def quantiles_in(
    blocks: Iterator[Deviations], tally: Tally, levels: Floats, every: int, away: Tensor | None
) -> Iterator[Floats]:
    """Quantiles (L, n_quantiles) of the distances at each ``every``-th tick; all are noted in the tally."""
    n_rollouts = len(tally.last_above)
    scratch = rows = torch.empty(0)
    for part in blocks:
        values = part.values if away is None else part.values - away[:, part.ticks, None]
        if not len(scratch):  # the first part is the largest
            scratch, rows = torch.empty_like(values[0]), values.new_empty(values.shape[1], n_rollouts)
        squared = scratch[: values.shape[1], : values.shape[2]]
        torch.mul(values[0], values[0], out=squared)
        for axis in values[1:]:
            squared.addcmul_(axis, axis)
        tally.add(part, squared)
        chosen = squared[-part.ticks.start % every :: every]
        rows[: len(chosen), part.columns] = chosen
        if part.columns.stop == n_rollouts:
            yield _quantiles(rows[: len(chosen)], levels)


def _quantiles(squares: Tensor, levels: Floats) -> Floats:
    """Quantiles (L, n_quantiles) of the roots of squares (L, R), whose rows are put in another order."""
    n_rollouts = squares.shape[1]
    place = levels * (n_rollouts - 1)
    below = np.floor(place).astype(np.intp)
    above = np.minimum(below + 1, n_rollouts - 1)
    if squares.device.type == "cpu":
        ordered = squares.numpy()
        ordered.sort(axis=1)  # ten times as fast as torch's
        ends = [ordered[:, below], ordered[:, above]]
    else:
        ranked = squares.sort(dim=1).values
        ends = [ranked[:, rank.tolist()].cpu().numpy() for rank in (below, above)]
    low, high = map(np.sqrt, ends)
    return low + (place - below) * (high - low)

"""Test for demonstrations that follow several ways, which a normal distribution cannot describe."""

from typing import NamedTuple

import numpy as np

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.data.demonstrations import Demonstrations
from torch_pbd.exceptions import UnimodalityWarning

_N_STEPS = 20
_LEAST_DEMOS = 6
# Gain of the criterion in nats, and distance of the two means in standard deviations within the groups. The best of all
# splits of a sample from one normal distribution gains something too, and two halves of a uniform one lie 3.5 apart:
# both bounds are above that, the second more so for whole demonstrations, in which there are more directions to choose.
_GAIN_WHOLE, _SEPARATION_WHOLE = 8.0, 6.0
_GAIN_STEP, _SEPARATION_STEP = 10.0, 4.5
# Two ways around an obstacle part for a while, and each is taken by some.
_SHARE_OF_STEPS, _SHARE_OF_DEMOS = 0.25, 0.2


class _Split(NamedTuple):
    """Split of the demonstrations in two groups: gain of the criterion, distance of their means, the smaller group."""

    gain: float
    separation: float
    few: list[int]


def check_unimodal(demonstrations: Demonstrations) -> bool:
    """Check that the demonstrations look like one way to do the task; warns if they do not.

    The paper assumes one mode (Section II): between two ways around an obstacle, a mean goes through it. Looked at
    are the direction in which the whole demonstrations differ most, and that at each of 20 steps: their places
    along it are split into two groups with a common variance, and the split must be worth it by the Bayesian
    information criterion and lie wide apart. Subtle cases are missed, and fewer than six demonstrations pass.

    Parameters
    ----------
    demonstrations : Demonstrations
        Aligned by phase here, if they are not.

    Returns
    -------
    bool

    Warns
    -----
    UnimodalityWarning
        If there are two groups, or one demonstration far from all others.
    """
    checks.instance(demonstrations, "demonstrations", Demonstrations)
    if len(demonstrations) < _LEAST_DEMOS:
        return True
    aligned = demonstrations if demonstrations.is_aligned else demonstrations.align()
    residual = aligned.to_array() - aligned.to_array().mean(axis=0)
    deviation = residual.std(axis=(0, 1))
    residual = residual / np.where(deviation > 0, deviation, 1.0)
    n_demos, n_steps, _ = residual.shape
    found = _best_split(residual.reshape(n_demos, -1))
    if found.gain <= _GAIN_WHOLE or found.separation <= _SEPARATION_WHOLE:
        steps = [_best_split(residual[:, t]) for t in np.linspace(0, n_steps - 1, _N_STEPS).astype(int)]
        least = _SHARE_OF_DEMOS * n_demos
        clear = [s for s in steps if s.gain > _GAIN_STEP and s.separation > _SEPARATION_STEP and len(s.few) >= least]
        if len(clear) < _SHARE_OF_STEPS * _N_STEPS:
            return True
        found = max(clear, key=lambda split: split.gain)
    checks.warn(_sentence(sorted(found.few), n_demos), UnimodalityWarning)
    return False


def _best_split(residual: Floats) -> _Split:
    """Best split of the rows in two along the direction in which they differ most."""
    left, singular, _ = np.linalg.svd(residual, full_matrices=False)
    place = left[:, 0] * singular[0]
    order = np.argsort(place, kind="stable")
    x, n = place[order], len(place)
    total = np.square(x - x.mean()).sum()
    if total <= 1e-18 * n:
        return _Split(0.0, 0.0, [])
    # For each number of rows in the lower group: squares within both groups, of which a common variance is estimated.
    count = np.arange(1, n)
    before, squares = np.cumsum(x)[:-1], np.cumsum(x * x)[:-1]
    within = squares - before**2 / count + (x @ x - squares) - (x.sum() - before) ** 2 / (n - count)
    within = np.maximum(within, 1e-9 * total)
    # Twice the log-likelihood of two groups above that of one, less log n for each of two further parameters.
    share = count / n
    entropy = share * np.log(share) + (1 - share) * np.log(1 - share)
    gain = -n * np.log(within / total) + 2 * n * entropy - 2 * np.log(n)
    best = int(gain.argmax())
    apart = (x[best + 1 :].mean() - x[: best + 1].mean()) / np.sqrt(within[best] / n)
    few = min(order[: best + 1], order[best + 1 :], key=len)
    return _Split(float(gain[best]), float(apart), few.tolist())


def _sentence(few: list[int], n_demos: int) -> str:
    if len(few) == 1:
        return f"Demonstration {few[0]} is far from the other {n_demos - 1}: look at it, and leave it out if it failed."
    return (
        f"The demonstrations seem to follow two ways: {', '.join(map(str, few))} differ from the others. A normal "
        "distribution puts its mean between them; learn each way by itself."
    )

"""Made demonstrations: a hand reaches around something in its way, more or less wide, and ends where it must."""

import numpy as np

from torch_pbd import Demonstrations

DURATION = 4.0  # s


def demonstrations(n_demos: int = 12, seed: int = 0) -> Demonstrations:
    """Reaches of 0.5 m along x, around what is in the way, in m; how wide varies by 3 cm, the end by some mm."""
    rng = np.random.default_rng(seed)
    time = np.linspace(0.0, DURATION, 101)
    s = time / DURATION
    rise, bow = s**3 * (10.0 - 15.0 * s + 6.0 * s**2), np.sin(np.pi * s) ** 2
    positions = []
    for wide, early, end, along in rng.standard_normal((n_demos, 4)):
        skewed = np.sin(np.pi * s ** np.exp(0.08 * early)) ** 2  # some turn early, some late
        across = (0.15 + 0.03 * wide) * skewed + 0.002 * end * rise
        positions.append(np.stack([0.5 * rise + 0.012 * along * bow, across], axis=1))
    noise = 0.0005 * rng.standard_normal((n_demos, len(time), 2))
    return Demonstrations(time, list(np.stack(positions) + noise), names=("x", "y"), units="m")

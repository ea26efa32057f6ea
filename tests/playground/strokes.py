"""Strokes for the tests of the playground: free in the middle, precise at the ends."""

import numpy as np


def make_strokes(n=6, seed=0):
    """Rows (time in s, x in m, y in m) of n strokes, as a page sends them."""
    rng = np.random.default_rng(seed)
    strokes = []
    for _ in range(n):
        time = np.cumsum(rng.uniform(0.012, 0.02, size=rng.integers(80, 110)))
        s = (time - time[0]) / (time[-1] - time[0])
        free = 0.04 * np.sin(np.pi * s)
        x, y = 0.1 + 0.7 * s + free * rng.normal(), 0.3 + 0.1 * np.sin(2 * np.pi * s) + free * rng.normal()
        strokes.append(np.column_stack([time, x, y]).tolist())
    return strokes

"""Random recordings of a movement, for a controller."""

import numpy as np

from reliability.problems import Recipe, as_kind
from torch_pbd.data import Demonstrations


def movements(recipe: Recipe) -> Demonstrations:
    """Recordings of a recipe's numbers, outputs and units: smooth paths with noise, of all outputs in one unit.

    They share their times where the recipe's inputs are "aligned", have lengths of their own where these are "ragged"
    or "unaligned", and uneven steps but for "aligned" and "ragged".
    """
    rng = np.random.default_rng(recipe.seed)
    duration, d = 10.0 ** rng.uniform(-0.5, 1.0), recipe.n_outputs
    lengths = np.full(recipe.n_demos, recipe.n_steps)
    if recipe.inputs in ("ragged", "unaligned"):
        lengths = rng.integers(max(5, recipe.n_steps // 2), recipe.n_steps + 1, size=recipe.n_demos)
    cycles, phase = rng.uniform(0.2, 3.0, size=d), rng.uniform(-np.pi, np.pi, size=d)
    scale, noise = 10.0 ** rng.uniform(-4.0, 0.0, size=d), 10.0 ** rng.uniform(-6.0, -1.0)
    times, paths = [], []
    for n in lengths:
        jitter = 0.0 if recipe.inputs in ("aligned", "ragged") else rng.uniform(-0.3, 0.3, size=n)
        own = 1.0 if recipe.inputs == "aligned" else rng.uniform(0.8, 1.25)
        share = np.clip(np.arange(n) + jitter, 0.0, None) / n
        times.append(recipe.x_offsets[0] * duration + own * duration * share)
        bend = np.sin(np.pi * share)[:, np.newaxis] * rng.normal(size=d)
        path = np.sin(2.0 * np.pi * cycles * share[:, np.newaxis] + phase)
        paths.append(path + scale * (rng.normal(size=d) + bend) + noise * rng.normal(size=(n, d)))
    whole = np.vstack(paths)
    for i, kind in enumerate(recipe.outputs):
        whole[:, i] = as_kind(rng, whole, i, kind)
    whole = (whole + np.array(recipe.y_offsets)) * 10.0 ** recipe.y_units[0]
    return Demonstrations(times, np.split(whole, np.cumsum(lengths)[:-1]))

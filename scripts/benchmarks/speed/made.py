"""Data of the benchmark: demonstrations of any size whose factor changes along the input."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def demonstrations(
    n_inputs: int, n_demos: int, *, n_outputs: int = 2, n_features: int = 1, seed: int = 0, aligned: bool = True
) -> tuple[Floats, Floats]:
    """X (n_inputs * n_demos, n_features) in 0..1, and y (n_inputs * n_demos, n_outputs).

    Aligned ones repeat each input ``n_demos`` times; else there are as many rows, no two of one input.
    """
    rng = np.random.default_rng(seed)
    if not aligned:
        X = rng.uniform(size=(n_inputs * n_demos, n_features))
    elif n_features == 1:
        X = np.repeat(np.linspace(0.0, 1.0, n_inputs)[:, np.newaxis], n_demos, axis=0)
    else:
        X = np.repeat(rng.uniform(size=(n_inputs, n_features)), n_demos, axis=0)
    slope, bend = rng.normal(size=(n_features, n_outputs)), 0.3 * np.tril(rng.normal(size=(n_outputs, n_outputs)))
    noise = rng.normal(size=(len(X), n_outputs))
    wave = np.sin(2.0 * np.pi * X[:, :1])
    return X, 3.0 * np.tanh(X @ slope) + noise + wave * (noise @ bend.T)


def cholesky_entries(X: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Distinct inputs, in units of their range, and the entries of the empirical Cholesky factors at them (n, p)."""
    inputs, index, counts = np.unique(X, axis=0, return_inverse=True, return_counts=True)
    order = np.argsort(index.reshape(-1), kind="stable")
    stacked = y[order].reshape(len(inputs), counts[0], -1)
    residual = stacked - stacked.mean(axis=1, keepdims=True)
    factors = np.linalg.cholesky(residual.mT @ residual / (counts[0] - 1.0))
    return inputs / np.ptp(inputs, axis=0), factors[:, *np.tril_indices(y.shape[1])]

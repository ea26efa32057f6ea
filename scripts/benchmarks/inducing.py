"""Error and time of HeteroscedasticGPRegressor on few inducing inputs, against the exact model on all inputs.

``python scripts/benchmarks/inducing.py`` fits 500 unaligned rows of eq. (14) and of a covariance that changes faster,
with hyperparameters learned anew each time. The difference to the exact model is the relative Frobenius distance of the
covariances, mean over a grid of the range; that to the truth tells whether it matters.
"""

import time

import numpy as np
import torch

from torch_pbd import HeteroscedasticGPRegressor
from torch_pbd.data.synthetic import paper_covariance, paper_mean
from torch_pbd.metrics import relative_frobenius_error

N_ROWS, N_SEEDS = 500, 3
SIZES = (8, 16, 24, 48, 128, None, N_ROWS)  # None: as the regressor chooses


def waves(x: np.ndarray) -> np.ndarray:
    """Covariances (n, 2, 2) with a factor of sines of periods of a third to a sixth of the range."""
    factor = np.zeros((len(x), 2, 2))
    factor[:, 0, 0] = 12.0 + 8.0 * np.sin(x[:, 0] / 8.0)
    factor[:, 1, 0] = 8.0 * np.sin(x[:, 0] / 10.0)
    factor[:, 1, 1] = 9.0 + 6.0 * np.cos(x[:, 0] / 5.0)
    return factor @ factor.transpose(0, 2, 1)


LAWS = {"eq. (14), printed": lambda x: paper_covariance(x, "printed"), "waves": waves}


def run(law: str, seed: int) -> list[list[float]]:
    """Difference to the exact model and to the truth, and process time, for each number of inducing inputs."""
    generator = np.random.default_rng(seed)
    X = np.sort(generator.uniform(-100.0, 100.0, N_ROWS))[:, None]
    noise = np.linalg.cholesky(LAWS[law](X)) @ generator.normal(size=(N_ROWS, 2, 1))
    y = paper_mean(X) + noise[..., 0]
    grid = np.linspace(-100.0, 100.0, 201)[:, None]
    fitted, seconds = [], []
    for size in SIZES:
        start = time.process_time()
        model = HeteroscedasticGPRegressor(n_inducing=size).fit(X, y)
        seconds.append(time.process_time() - start)
        fitted.append(model.predict_cov(grid))
    truth = LAWS[law](grid)
    return [
        [relative_frobenius_error(cov, fitted[-1]), relative_frobenius_error(cov, truth), spent]
        for cov, spent in zip(fitted, seconds, strict=True)
    ]


if __name__ == "__main__":
    torch.set_num_threads(1)
    for law in LAWS:
        medians = np.median([run(law, seed) for seed in range(N_SEEDS)], axis=0)
        print(f"{law}: {N_ROWS} rows, medians of {N_SEEDS} seeds")
        print("  inducing inputs  to the exact model  to the truth  process time [s]")
        for size, (to_exact, to_truth, seconds) in zip(SIZES, medians, strict=True):
            name = "chosen" if size is None else str(size)
            print(f"  {name:>15}  {to_exact:18.4f}  {to_truth:12.3f}  {seconds:16.2f}")

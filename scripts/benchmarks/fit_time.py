"""Time of fitting CD and WP on the paper's simulation, against three Gaussian processes of scikit-learn.

``python scripts/benchmarks/fit_time.py`` prints process CPU times with one thread and, run by run, their ratios.
scikit-learn's three processes are those of the covariance's entries, with its default start; ours fit the two of the
mean as well.
"""

import time
import warnings
from collections.abc import Callable

import numpy as np
import torch
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

from torch_pbd import CholeskyCovRegressor, WishartProcessRegressor
from torch_pbd.data import make_paper_simulation
from torch_pbd.experiments.comparison import empirical_covariances

N_RUNS = 7


def cpu_seconds(work: Callable[[], object]) -> float:
    start = time.process_time()
    work()
    return time.process_time() - start


def run(seed: int, n_inputs: int) -> list[float]:
    X, y, _ = make_paper_simulation(n_inputs, 50, random_state=seed)
    inputs, empirical = empirical_covariances(X, y)
    factors = np.linalg.cholesky(empirical)

    def scikit_learn() -> None:
        for row, column in [(0, 0), (1, 0), (1, 1)]:
            kernel = ConstantKernel() * RBF(0.2) + WhiteKernel(0.1)
            GaussianProcessRegressor(kernel, normalize_y=True).fit(inputs / 200.0, factors[:, row, column])

    return [
        cpu_seconds(scikit_learn),
        cpu_seconds(lambda: CholeskyCovRegressor().fit(X, y)),
        cpu_seconds(lambda: WishartProcessRegressor().fit(X, y)),
        cpu_seconds(lambda: WishartProcessRegressor(objective="likelihood").fit(X, y)),
    ]


if __name__ == "__main__":
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")  # scikit-learn's, of length scales at their bounds
    print(f"median of {N_RUNS} runs; ratio of each run's time to scikit-learn's, its median (lowest .. highest)")
    for n_inputs in (10, 200):
        run(99, n_inputs)  # warm up
        times = np.array([run(seed, n_inputs) for seed in range(N_RUNS)])
        print(f"{n_inputs} inputs x 50 draws; scikit-learn, three processes: {np.median(times[:, 0]):.3f} s")
        for name, column in zip(["CD", "WP (9)", "WP (11)"], times.T[1:], strict=True):
            ratio = column / times[:, 0]
            spread = f"({ratio.min():.2f} .. {ratio.max():.2f})"
            print(f"  {name:8} {np.median(column):6.3f} s  x {np.median(ratio):.2f} {spread}")

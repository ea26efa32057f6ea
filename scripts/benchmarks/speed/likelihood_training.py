"""Training of a likelihood: Fisher scoring and preconditioned L-BFGS against L-BFGS in plain whitened values.

All maximize one posterior density, that of the Cholesky factor with a logarithmic diagonal at 500 inputs that do not
repeat (eq. (12) under its prior, eq. (14), "bell"), to within 1e-3 nats of the optimum, set-up included. The plain one
is whitened by the dense Cholesky factor of the kernel matrix, its gradient by autograd.
"""

import time
from collections.abc import Callable
from contextlib import suppress

import numpy as np
import torch
from torch import Tensor

from torch_pbd.data import make_paper_simulation
from torch_pbd.data.synthetic import paper_mean
from torch_pbd.kernels import correlation
from torch_pbd.linalg import safe_cholesky, scale_tril_from_root
from torch_pbd.models.costs import LatentValues, Likelihood, Solver, train
from torch_pbd.models.links import CholeskyLink
from torch_pbd.optim.batch import Progress
from torch_pbd.optim.descent import minimize

N_ROWS, LENGTH_SCALE = 500, 0.2
WITHIN = 1e-3  # nats of the optimum


class Problem:
    """Rows in standardized units, the prior, and where training starts."""

    def __init__(self, seed: int, n_rows: int = N_ROWS) -> None:
        X, y, _ = make_paper_simulation(n_rows, 1, random_state=seed)
        residual = torch.tensor((y - paper_mean(X)) / y.std(axis=0))
        self.inputs = torch.tensor(X / np.ptp(X))
        self.scatter_root, self.counts = residual[:, :, None], torch.ones(n_rows, dtype=torch.float64)
        pooled = scale_tril_from_root(residual.mT / n_rows**0.5)
        self.prior_tril = 2.0 * pooled
        # Of the logarithms on the diagonal, and of the entry below.
        self.amplitude = torch.tensor([2.0, float(self.prior_tril[1].norm()), 2.0], dtype=torch.float64)
        start = CholeskyLink(self.prior_tril, True).deviation(pooled)
        self.start = start.expand(n_rows, -1).mT.contiguous()


class _ReachedError(Exception):
    """The loss is as low as was asked for."""


class Watch:
    """Counts evaluations until the loss is as low as asked for, and stops the training there."""

    def __init__(self, target: float = -np.inf) -> None:
        self.target, self.loss, self.n_evaluations = target, np.inf, 0

    def __call__(self, progress: Progress) -> None:
        """Note an improvement: the callback of an optimizer."""
        self.loss, self.n_evaluations = progress.loss, progress.n_evaluations
        if self.loss <= self.target:
            raise _ReachedError


def by_scoring(problem: Problem, watch: Watch, solver: Solver, tol: float = 1e-11) -> None:
    """Train by one of our solvers."""
    n_rows = len(problem.counts)
    length_scale = torch.tensor([[LENGTH_SCALE]], dtype=torch.float64)
    latent = LatentValues(problem.inputs, problem.start, problem.amplitude, length_scale)
    cost = Likelihood(CholeskyLink(problem.prior_tril, True), problem.scatter_root, problem.counts, 1.0 / n_rows)
    train(cost, latent, solver=solver, max_iter=200, tol=tol, callback=watch)


def plain(problem: Problem, watch: Watch, tol: float = 1e-9) -> None:
    """Train as one would write it first."""
    n_rows = len(problem.counts)
    gram = correlation(problem.inputs, problem.inputs, torch.tensor([LENGTH_SCALE], dtype=torch.float64))
    factor = safe_cholesky(gram, name="kernel matrix")
    link = CholeskyLink(problem.prior_tril, True)
    cost = Likelihood(link, problem.scatter_root, problem.counts, 1.0)
    start = torch.linalg.solve_triangular(factor, problem.start.mT / problem.amplitude, upper=False)
    whitened = start.requires_grad_()

    def objective() -> Tensor:
        loss = cost.at_root(link.root(problem.amplitude * (factor @ whitened)))
        return (loss + 0.5 * whitened.square().sum()) / n_rows

    minimize(objective, [whitened], max_iter=2000, tol=tol, callback=watch)


METHODS: dict[str, Callable[[Problem, Watch], None]] = {
    "Fisher scoring": lambda problem, watch: by_scoring(problem, watch, "fisher"),
    "preconditioned L-BFGS": lambda problem, watch: by_scoring(problem, watch, "lbfgs"),
    "whitened L-BFGS": plain,
}


def run(seed: int, n_rows: int = N_ROWS) -> dict[str, tuple[int, float, float]]:
    """For each method evaluations and CPU seconds to within ``WITHIN`` nats, and how far its end is from the best."""
    problem, ends = Problem(seed, n_rows), dict[str, float]()
    for name, method in METHODS.items():
        watch = Watch()
        method(problem, watch)
        ends[name] = watch.loss
    optimum = min(ends.values())
    found = {}
    for name, method in METHODS.items():
        watch, start = Watch(optimum + WITHIN / n_rows), time.process_time()
        with suppress(_ReachedError):
            method(problem, watch)
        found[name] = (watch.n_evaluations, time.process_time() - start, (ends[name] - optimum) * n_rows)
    return found

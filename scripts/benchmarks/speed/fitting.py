"""Time of fitting CD and WP, against Gaussian processes of scikit-learn and of gpytorch on the same factors."""

import torch
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

from speed.fresh import measured_fit
from speed.made import Floats, cholesky_entries, demonstrations
from speed.rows import Bar, Findings, Plan, Row
from speed.timing import alternate
from torch_pbd import CholeskyCovRegressor, WishartProcessRegressor
from torch_pbd.data import make_paper_simulation
from torch_pbd.experiments.comparison import empirical_covariances
from torch_pbd.gp.evidence import EvidenceSearch
from torch_pbd.gp.observations import Observations, resolved_length_scale
from torch_pbd.gp.search import fit_together
from torch_pbd.metrics import covariance_mse

_SKLEARN = "scikit-learn, a process for each entry of the factor"


def measure(plan: Plan) -> Findings:
    """All of them; ours is the whole fit, with the processes of the mean."""
    findings = Findings("fitting")
    for n_inputs, least in ((10, 3.0), (200, 10.0), (1000, 300.0)):
        if not (plan.quick and n_inputs > 10):
            findings.rows.append(_against_scikit_learn(plan, n_inputs, 2, least))
    findings.rows.append(_against_scikit_learn(plan, plan.size(200, 10), plan.size(7, 3), 15.0))
    for n_inputs in (10, 200)[: plan.size(2, 1)]:
        findings.rows.append(_evidence(plan, n_inputs))
    for n_inputs, least in ((10, 15.0), (200, 50.0))[: plan.size(2, 1)]:
        findings.try_peer(
            "gpytorch", lambda n=n_inputs, bar=least: findings.rows.append(_against_gpytorch(plan, n, bar))
        )
    findings.rows += _paper_problem(plan)
    if not plan.quick:
        findings.rows.append(_many_inputs())
    return findings


def scikit_learn_entries(inputs: Floats, entries: Floats, n_restarts: int = 0) -> list[GaussianProcessRegressor]:
    """A process for each column of ``entries``, as a user of scikit-learn would write it."""
    return [
        GaussianProcessRegressor(
            ConstantKernel() * RBF(0.2) + WhiteKernel(0.1),
            normalize_y=True,
            n_restarts_optimizer=n_restarts,
            random_state=0,
        ).fit(inputs, column)
        for column in entries.T
    ]


def _against_scikit_learn(plan: Plan, n_inputs: int, d: int, least: float) -> Row:
    X, y = demonstrations(n_inputs, 50, n_outputs=d, seed=plan.seed)
    inputs, entries = cholesky_entries(X, y)
    contenders = {
        "ours": lambda: CholeskyCovRegressor().fit(X, y),
        "scikit-learn": lambda: scikit_learn_entries(inputs, entries),
    }
    slow = n_inputs * d > 1000
    if not slow:
        times = alternate(contenders, plan.n_repetitions)
    else:
        times = alternate({"ours": contenders["ours"]}, plan.n_repetitions)
        times |= alternate({"scikit-learn": contenders["scikit-learn"]}, 1, warm_up=False)
    what = f"CD, {n_inputs} inputs x 50, d = {d}"
    return Row(what, times["ours"], other=times["scikit-learn"], other_name=_SKLEARN, bar=(">=", least))


def _evidence(plan: Plan, n_inputs: int) -> Row:
    """Evidence that our search finds above that of scikit-learn's best of six starts, on the same problem.

    Targets are the standardized entries of the factor; length scales are bounded alike, from what the inputs resolve to
    ten ranges.
    """
    gaps = []
    for seed in range(plan.seed, plan.seed + plan.size(5, 1)):
        X, y = demonstrations(n_inputs, 50, seed=seed)
        inputs, entries = cholesky_entries(X, y)
        targets = torch.tensor((entries - entries.mean(axis=0)) / entries.std(axis=0)).mT.contiguous()
        nodes = torch.tensor(inputs)
        bounds = (resolved_length_scale(nodes), 10.0)
        data = Observations(nodes, targets, torch.ones(n_inputs, dtype=torch.float64))
        loss = fit_together([(data, EvidenceSearch(length_scale_bounds=bounds))])[0].loss
        kernel = ConstantKernel(1.0, (1e-6, 1e5)) * RBF(0.2, bounds) + WhiteKernel(0.1, (1e-9, 1e5))
        for ours, column in zip(loss.tolist(), targets.numpy(), strict=True):
            theirs = GaussianProcessRegressor(
                kernel, alpha=0.0, n_restarts_optimizer=plan.size(5, 1), random_state=0
            ).fit(inputs, column)
            gaps.append(-ours - theirs.log_marginal_likelihood_value_)
    return Row(
        f"evidence above scikit-learn's best of 6 starts, {n_inputs} inputs x 50, lowest of {len(gaps)}",
        [min(gaps)],
        "nats",
        bar=(">=", -0.2),
        note=f"highest {max(gaps):+.2g}; of each entry of the factor",
    )


def _against_gpytorch(plan: Plan, n_inputs: int, least: float) -> Row:
    from speed.gpytorch_models import ExactBatch

    X, y = demonstrations(n_inputs, 50, seed=plan.seed)
    inputs, entries = cholesky_entries(X, y)
    contenders = {
        "ours": lambda: CholeskyCovRegressor().fit(X, y),
        "gpytorch": lambda: ExactBatch(inputs, entries, plan.size(100, 2)),
    }
    times = alternate(contenders, plan.n_repetitions)
    name = "gpytorch, a batch of exact processes, 100 steps of Adam"
    return Row(
        f"CD, {n_inputs} inputs x 50, d = 2", times["ours"], other=times["gpytorch"], other_name=name, bar=(">=", least)
    )


def _paper_problem(plan: Plan) -> list[Row]:
    X, y, _ = make_paper_simulation(10, 50, random_state=plan.seed)
    models = {
        "CD": CholeskyCovRegressor(),
        "WP by eq. (9)": WishartProcessRegressor(),
    }
    times = alternate({name: lambda m=model: m.fit(X, y) for name, model in models.items()}, plan.n_repetitions)
    inputs, empirical = empirical_covariances(X, y)
    assert empirical is not None
    bars: dict[str, Bar] = {"CD": ("<=", 0.02)}
    rows = [Row(f"{name}, the paper's problem", times[name], bar=bars.get(name, ("<=", 0.3))) for name in models]
    for name in list(models)[1:]:
        error = float(covariance_mse(models[name].predict_cov(inputs), empirical))
        rows.append(Row(f"{name}: mean squared error of Table I", [error], "y^2", bar=("<=", 1e-10)))
    return rows


def _many_inputs() -> Row:
    found = [measured_fit("CholeskyCovRegressor()", "100_000, 5") for _ in range(3)]
    return Row("CD, 100,000 inputs x 5, d = 2", [seconds for seconds, _ in found], bar=("<=", 2.0), note=found[-1][1])

"""Time of predictions, and of a mixture's steps, against scikit-learn and gmr."""

import warnings
from typing import Any

import numpy as np
import torch
from sklearn.exceptions import ConvergenceWarning
from sklearn.mixture import GaussianMixture as ScikitLearnMixture

from speed.fresh import measured
from speed.made import demonstrations
from speed.rows import Findings, Plan, Row
from speed.timing import alternate
from torch_pbd import CholeskyCovRegressor, GMMBaseline
from torch_pbd.data import make_paper_simulation
from torch_pbd.models.mixture import expectation_maximization


def measure(plan: Plan) -> Findings:
    """Of one row, of many, and of the mixture."""
    findings = Findings("prediction", [*_single(plan), _steps(plan), _mixture_fit(plan)])
    if not plan.quick:
        findings.rows.append(_many())
    findings.try_peer("gmr", lambda: findings.rows.extend(_against_gmr(plan)))
    return findings


def _single(plan: Plan) -> list[Row]:
    X, y, _ = make_paper_simulation(10, 50, random_state=plan.seed)
    model, query = CholeskyCovRegressor().fit(X, y), np.array([[3.0]])
    contenders = {"predict_cov": lambda: model.predict_cov(query), "predict": lambda: model.predict(query)}
    times = alternate(contenders, plan.size(200, 2), n_calls=5)
    return [
        Row("CD, predict_cov of one input", times["predict_cov"], bar=("<=", 3e-4)),
        Row("CD, predict of one input", times["predict"], note="the mean alone"),
    ]


def _many() -> Row:
    n_rows = 100_000
    setup = (
        "from torch_pbd import CholeskyCovRegressor\nfrom torch_pbd.data import make_paper_simulation\n"
        "model = CholeskyCovRegressor().fit(*make_paper_simulation(10, 50, random_state=0)[:2])\n"
        f"X = np.linspace(-100.0, 100.0, {n_rows})[:, None]\nmodel.predict_cov(X[:2000])"
    )
    found = [measured(setup, "model.predict_cov(X)") for _ in range(3)]
    note = f"{max(one['above'] for one in found):.0f} MiB above what a fitted model takes"
    return Row(f"CD, predict_cov of {n_rows:,} inputs", [one["seconds"] for one in found], note=note)


def _steps(plan: Plan) -> Row:
    """Seconds of an iteration, as the difference of a long run and a short one from the same start."""
    n_rows, n_components, (short, long) = plan.size(50_000, 500), 8, (5, plan.size(25, 7))
    X, y = demonstrations(n_rows, 1, aligned=False, seed=plan.seed)
    joint = np.hstack([X, y])
    joint = (joint - joint.mean(axis=0)) / joint.std(axis=0)
    share = np.eye(n_components)[np.minimum((X[:, 0] * n_components).astype(int), n_components - 1)]
    data, responsibilities = torch.tensor(joint), torch.tensor(share)
    centres = (share.T @ joint) / share.sum(axis=0)[:, np.newaxis]

    def ours(n_steps: int) -> None:
        expectation_maximization(data, responsibilities, n_features=1, reg_covar=1e-6, tol=1e-300, max_iter=n_steps)

    def scikit_learn(n_steps: int) -> None:
        start = {"init_params": "random_from_data", "means_init": centres, "random_state": 0}
        mixture = ScikitLearnMixture(n_components, tol=0.0, max_iter=n_steps, **start)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ConvergenceWarning)
            mixture.fit(joint)

    runs = {
        f"{work.__name__} {n_steps}": lambda work=work, n_steps=n_steps: work(n_steps)
        for work in (ours, scikit_learn)
        for n_steps in (short, long)
    }
    times = alternate(runs, plan.n_repetitions)
    each = {
        name: [
            max(after - before, 1e-9) / (long - short)
            for before, after in zip(times[f"{name} {short}"], times[f"{name} {long}"], strict=True)
        ]
        for name in ("ours", "scikit_learn")
    }
    what = f"a step of expectation maximization, {n_rows:,} rows, {n_components} components of 3 variables"
    return Row(what, each["ours"], other=each["scikit_learn"], other_name="scikit-learn", bar=(">=", 2.0))


def _mixture_fit(plan: Plan) -> Row:
    X, y = demonstrations(plan.size(100_000, 300), 1, aligned=False, seed=plan.seed)
    times = alternate({"ours": lambda: GMMBaseline().fit(X, y)}, plan.size(3, 1), warm_up=False)
    return Row(f"GMMBaseline().fit, {len(X):,} rows", times["ours"])


def _against_gmr(plan: Plan) -> list[Row]:
    """The same mixture, and both the mean and the covariance of its conditional density."""
    from gmr import GMM

    X, y, _ = make_paper_simulation(10, 50, random_state=plan.seed)
    model = GMMBaseline().fit(X, y)
    core: Any = model.module_.core
    factor = core.scale_tril.numpy()
    mixture = GMM(len(factor), core.log_weight.softmax(0).numpy(), core.mean.numpy(), factor @ factor.mT)
    batch = np.linspace(-100.0, 100.0, 200)[:, np.newaxis]
    standardized = (batch - model.module_.x_shift.numpy()) / model.module_.x_scale.numpy()

    def gmr_batch() -> None:
        for row in standardized:
            mixture.condition([0], row).to_mvn()

    single = alternate(
        {
            "ours": lambda: model.predict(batch[:1], return_cov=True),
            "gmr": lambda: mixture.condition([0], standardized[0]).to_mvn(),
        },
        plan.size(100, 2),
        n_calls=10,
    )
    several = alternate({"ours": lambda: model.predict(batch, return_cov=True), "gmr": gmr_batch}, plan.n_repetitions)
    name = "gmr, condition and to_mvn"
    return [
        Row("GMMBaseline, predict of one input", single["ours"], "s", single["gmr"], name, (">=", 20.0)),
        Row("GMMBaseline, predict of 200 inputs", several["ours"], "s", several["gmr"], name, (">=", 500.0)),
    ]

"""Time of training on the likelihood: of one objective by three optimizers, and of whole fits of many outputs."""

import numpy as np

from torch_pbd import CholeskyCovRegressor
from torch_pbd.experiments.benchmark import likelihood_training
from torch_pbd.experiments.benchmark.made import demonstrations
from torch_pbd.experiments.benchmark.rows import Findings, Plan, Row
from torch_pbd.experiments.benchmark.timing import alternate


def measure(plan: Plan) -> Findings:
    """CD by eq. (12) under its prior, 200 inputs x 50 draws."""
    findings = Findings("likelihood", _optimizers(plan))
    n_inputs, n_demos = plan.size(200, 10), plan.size(50, 10)
    for d, most in ((10, 2.0), (20, 30.0)) if not plan.quick else ((2, 2.0),):
        X, y = demonstrations(n_inputs, n_demos, n_outputs=d, seed=plan.seed)
        work = {"ours": lambda X=X, y=y: CholeskyCovRegressor(objective="likelihood").fit(X, y)}
        times = alternate(work, 1 if d > 10 else min(3, plan.n_repetitions), warm_up=False)
        findings.rows.append(
            Row(f"CD by likelihood, {n_inputs} inputs x {n_demos}, d = {d}", times["ours"], bar=("<=", most))
        )
    return findings


def _optimizers(plan: Plan) -> list[Row]:
    """To within 1e-3 nats of the optimum, set-up included."""
    n_rows = plan.size(likelihood_training.N_ROWS, 60)
    likelihood_training.run(99, n_rows)  # warm up
    runs = [likelihood_training.run(seed, n_rows) for seed in range(plan.seed, plan.seed + plan.size(5, 1))]

    def of(name: str, number: int) -> list[float]:
        return [float(run[name][number]) for run in runs]

    what, plain = f"CD by likelihood, {n_rows} unaligned inputs", of("whitened L-BFGS", 1)
    fisher, lbfgs = of("Fisher scoring", 1), of("preconditioned L-BFGS", 1)
    evaluations = {name: f"{np.median(of(name, 0)):.0f}" for name in likelihood_training.METHODS}
    note = f"L-BFGS in whitened values, dense, {evaluations['whitened L-BFGS']} evaluations"
    return [
        Row(f"{what}: evaluations of preconditioned L-BFGS", of("preconditioned L-BFGS", 0), "", bar=("<=", 25.0)),
        Row(f"{what}: preconditioned L-BFGS", lbfgs, other=plain, other_name=note),
        Row(
            f"{what}: Fisher scoring, {evaluations['Fisher scoring']} evaluations",
            fisher,
            other=plain,
            other_name=note,
            bar=(">=", 50.0),
        ),
    ]

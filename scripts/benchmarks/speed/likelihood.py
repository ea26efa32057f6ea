"""Time of training on the likelihood: of one objective by three optimizers, and of whole fits of many outputs."""

import numpy as np

from speed import likelihood_training
from speed.fresh import measured_fit
from speed.rows import Findings, Plan, Row


def measure(plan: Plan) -> Findings:
    """CD by eq. (12) under its prior: whole fits of many outputs and of many rows, in processes of their own."""
    findings = Findings("likelihood", _optimizers(plan))
    fits = [("200, 50, n_outputs=10", 2.0), ("200, 50, n_outputs=20", 30.0)]
    fits += [("10_000, 1, aligned=False", 3.0), ("1_000_000, 1, aligned=False", 10.0)]
    for data, most in fits if not plan.quick else [("10, 10", 2.0)]:
        seconds, note = measured_fit("CholeskyCovRegressor(objective='likelihood')", data)
        findings.rows.append(Row(f"CD by likelihood, demonstrations({data})", [seconds], bar=("<=", most), note=note))
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

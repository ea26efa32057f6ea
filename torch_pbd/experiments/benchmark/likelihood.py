"""Time of training on the likelihood, where the cost is in the outputs."""

from torch_pbd import CholeskyCovRegressor
from torch_pbd.experiments.benchmark.made import demonstrations
from torch_pbd.experiments.benchmark.rows import Findings, Plan, Row
from torch_pbd.experiments.benchmark.timing import alternate


def measure(plan: Plan) -> Findings:
    """CD by eq. (12) under its prior, 200 inputs x 50 draws."""
    findings = Findings("likelihood")
    n_inputs, n_demos = plan.size(200, 10), plan.size(50, 10)
    for d, most in ((10, 2.0), (20, 30.0)) if not plan.quick else ((2, 2.0),):
        X, y = demonstrations(n_inputs, n_demos, n_outputs=d, seed=plan.seed)
        work = {"ours": lambda X=X, y=y: CholeskyCovRegressor(objective="likelihood").fit(X, y)}
        times = alternate(work, 1 if d > 10 else min(3, plan.n_repetitions), warm_up=False)
        findings.rows.append(
            Row(f"CD by likelihood, {n_inputs} inputs x {n_demos}, d = {d}", times["ours"], bar=("<=", most))
        )
    return findings

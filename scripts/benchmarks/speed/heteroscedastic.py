"""Time and error of HeteroscedasticGPRegressor, against a sampled variational process of gpytorch."""

import numpy as np

from speed.fresh import measured_fit
from speed.made import Floats
from speed.rows import Findings, Plan, Row
from speed.timing import alternate
from torch_pbd import HeteroscedasticGPRegressor
from torch_pbd.data import load_demonstrations, make_paper_simulation, paper_covariance
from torch_pbd.metrics import gaussian_kl

_RECORDINGS = ("pen_a", "letter_A", "letter_C", "letter_G", "letter_L", "letter_N", "letter_P", "letter_S", "letter_Z")
_GRID = np.linspace(-100.0, 100.0, 101)[:, np.newaxis]


def measure(plan: Plan) -> Findings:
    """Whole fits, with default parameters."""
    findings = Findings("heteroscedastic")
    for aligned, most in ((True, 0.3), (False, 0.5))[: plan.size(2, 1)]:
        seconds = []
        for seed in range(
            plan.seed, plan.seed + plan.size(5, 1)
        ):  # how many inducing inputs it takes is up to the data
            X, y = _papers(plan, seed, aligned=aligned)
            work = {"ours": lambda X=X, y=y: HeteroscedasticGPRegressor().fit(X, y)}
            seconds += alternate(work, 1, warm_up=not plan.quick)["ours"]
        what = f"HGP, {'10 inputs x 50' if aligned else '500 inputs that never repeat'}"
        note = f"{len(seconds)} draws of the data, the slowest {max(seconds):.2g} s"
        findings.rows.append(Row(what, seconds, bar=("<=", most), note=note))
    findings.try_peer("gpytorch", lambda: findings.rows.extend(_against_gpytorch(plan)))
    _recordings(plan, findings)
    for n_rows, most in ((10_000, 3.0), (1_000_000, 10.0))[: plan.size(2, 0)]:
        findings.rows.append(_many_rows(n_rows, most))
    return findings


def _papers(plan: Plan, seed: int, *, aligned: bool) -> tuple[Floats, Floats]:
    """Eq. (14) as printed: 10 inputs x 50 draws, or 500 inputs of one draw each."""
    sizes = (plan.size(10, 5), plan.size(50, 20)) if aligned else (plan.size(500, 60), 1)
    X, y, _ = make_paper_simulation(*sizes, reading="printed", random_state=seed)
    return X, y


def _against_gpytorch(plan: Plan) -> list[Row]:
    from speed.gpytorch_models import SampledFactors

    X, y = _papers(plan, plan.seed, aligned=True)
    scale, shift = y.std(axis=0), y.mean(axis=0)
    kept: dict[str, Floats] = {}

    def ours() -> None:
        kept["ours"] = HeteroscedasticGPRegressor().fit(X, y).predict_cov(_GRID)

    def gpytorch() -> None:
        model = SampledFactors(X / 200.0, (y - shift) / scale, plan.size(1000, 2))
        mean, factor = model.sample(_GRID / 200.0)
        deviation = mean - mean.mean(axis=0)
        covariance = (factor @ factor.mT).mean(axis=0) + np.einsum("sni,snj->nij", *2 * [deviation]) / len(mean)
        kept["gpytorch"] = covariance * np.outer(scale, scale)

    times = alternate({"ours": ours}, plan.n_repetitions, warm_up=False)
    times |= alternate({"gpytorch": gpytorch}, 1, warm_up=False)
    truth = paper_covariance(_GRID, reading="printed")
    error = {name: float(np.mean(gaussian_kl(truth, covariance))) for name, covariance in kept.items()}
    name = "gpytorch, sampled variational factors, 1000 steps of Adam"
    what = "HGP, 10 inputs x 50, fitted and predicted"
    return [
        Row(what, times["ours"], other=times["gpytorch"], other_name=name, bar=(">=", 20.0)),
        Row("its divergence from the truth", [error["ours"]], "nats", [error["gpytorch"]], name, (">=", 1.0)),
    ]


def _recordings(plan: Plan, findings: Findings) -> None:
    paths = [] if plan.data is None else [plan.data / f"{name}.npz" for name in _RECORDINGS]
    found = [path for path in paths if path.is_file()][: plan.size(len(paths), 0)]
    if not found and not plan.quick:
        findings.left_out.append("recordings: set TORCH_PBD_DATA to a folder that has pen_a.npz and letter_*.npz")
    for path in found:
        recorded = load_demonstrations(path)
        X, y, groups = (recorded if recorded.is_aligned else recorded.align("phase")).stack()
        work = {"ours": lambda X=X, y=y, groups=groups: HeteroscedasticGPRegressor().fit(X, y, groups=groups)}
        times = alternate(work, min(3, plan.n_repetitions), warm_up=False)
        what = f"HGP, {path.stem}: {len(recorded)} demonstrations, {len(X):,} rows, d = {y.shape[1]}"
        findings.rows.append(Row(what, times["ours"], bar=("<=", 2.0)))


def _many_rows(n_rows: int, most: float) -> Row:
    seconds, note = measured_fit("HeteroscedasticGPRegressor()", f"{n_rows}, 1, aligned=False")
    return Row(f"HGP, {n_rows:,} inputs that never repeat", [seconds], bar=("<=", most), note=note)

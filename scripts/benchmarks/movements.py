"""Models of whole movements, judged by left-out demonstrations of recorded sets, and by made data of known law.

Every fold of every set goes into a CSV file; the table in docs/movements.md is what this prints. Recordings are taken
over 50 steps of phase (handwriting over 200), in units of their pooled deviation; the first eight demonstrations are
left out in turn, with at most 40 of the others to learn from.
"""

import argparse
import csv
import math
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import torch
from joblib import Parallel, delayed
from movement_primitives.promp import ProMP
from scipy.stats import multivariate_normal, multivariate_t

from torch_pbd import (
    DMPController,
    GMMBaseline,
    HeteroscedasticGPRegressor,
    KMPBaseline,
    ProMPBaseline,
    TrajectoryRegressor,
    load_demonstrations,
)
from torch_pbd.data import Demonstrations
from torch_pbd.experiments.comparison import MOVEMENT_STATISTICS, movement_statistics
from torch_pbd.metrics import gaussian_kl

Floats = Any
DATA = Path(__file__).parents[3] / "shared" / "data"
SETS = [
    *(f"letter_{letter}" for letter in "ACGLNPSZ"),
    *("pen_a", "handwriting_fda", "gait_hip_knee", "kuka_cube_pick", "kuka_cshape_top", "adroit_door_palm"),
    *("mouse_choice_1", "snooker_skilled"),
]
N_STEPS = {"handwriting_fda": 200}
N_FOLDS, MOST_TRAINED, N_DRAWS = 8, 40, 300
MODELS = {
    "TrajectoryRegressor": TrajectoryRegressor,
    "ProMPBaseline": ProMPBaseline,
    "KMPBaseline": KMPBaseline,
    "rows independent": None,
    "movement_primitives": None,
}


def load(name: str) -> tuple[Floats, Floats]:
    """Phases (n,) and movements (K, n, d) in units of their pooled deviation."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        y = load_demonstrations(DATA / f"{name}.npz").align(n=N_STEPS.get(name, 50)).to_array()
    return np.linspace(0.0, 1.0, y.shape[1]), (y - y.mean((0, 1))) / y.std((0, 1))


class Independent:
    """The recommended regressor with its rows taken for independent."""

    def __init__(self, trajectory: TrajectoryRegressor) -> None:
        self._model = trajectory.regressor_

    def joint(self, X: Floats) -> tuple[Floats, Floats, float]:
        """Mean (n, d), covariance (n, d, n, d) and degrees of freedom."""
        mean, own = self._model.predict(X, return_cov=True)
        n, d = mean.shape
        covariance = np.zeros((n, d, n, d))
        covariance[np.arange(n), :, np.arange(n)] = own
        return mean, covariance, float(np.median(self._model.predict_df(X)))


class Published:
    """movement_primitives' ProMP as it comes, with its own noise variance on the diagonal."""

    def __init__(self, grid: Floats, demos: Floats) -> None:
        self._grid, self._d = grid, demos.shape[2]
        self._model = ProMP(self._d, 10)
        self._model.imitate([grid] * len(demos), list(demos))

    def joint(self, X: Floats) -> tuple[Floats, Floats, float]:
        """Mean (n, d), covariance (n, d, n, d) and degrees of freedom."""
        n, d = len(self._grid), self._d
        covariance = self._model.cov_trajectory(self._grid) + max(self._model.variance, 1e-8) * np.eye(n * d)
        covariance = covariance.reshape(d, n, d, n).transpose(1, 0, 3, 2)
        return self._model.mean_trajectory(self._grid), covariance, math.inf


def log_density(x: Floats, mean: Floats, covariance: Floats, df: float) -> float:
    """Joint log density of a movement, from scipy, in nats."""
    flat = covariance.reshape(mean.size, mean.size)
    if math.isinf(df):
        return float(multivariate_normal(mean.ravel(), flat, allow_singular=True).logpdf(x.ravel()))
    return float(multivariate_t(mean.ravel(), flat * (df - 2.0) / df, df=df, allow_singular=True).logpdf(x.ravel()))


def given(joint: tuple[Floats, Floats, float], seen: Floats, x: Floats) -> tuple[Floats, Floats]:
    """Mean and covariance of the steps that were not seen, given those that were, by dense normal formulas."""
    mean, covariance, _ = joint
    d = mean.shape[1]
    flat, rows = covariance.reshape(mean.size, mean.size), np.flatnonzero(np.repeat(seen, d))
    rest = np.flatnonzero(np.repeat(~seen, d))
    own = flat[np.ix_(rows, rows)]
    gain = np.linalg.lstsq(own, flat[np.ix_(rows, rest)], rcond=1e-12)[0].T
    conditional = mean.ravel()[rest] + gain @ (x.ravel()[rows] - mean.ravel()[rows])
    return conditional.reshape(-1, d), flat[np.ix_(rest, rest)] - gain @ flat[np.ix_(rows, rest)]


def judge_conditioning(joint: tuple[Floats, Floats, float], seen: Floats, x: Floats, ahead: slice) -> dict[str, float]:
    """Error over that of the unconditioned mean, nats a step above it, and what 95 % ellipses hold, of steps ahead."""
    mean, covariance, df = joint
    d = mean.shape[1]
    conditional, left = given(joint, seen, x)
    left = left.reshape(len(conditional), d, len(conditional), d)
    rest = np.flatnonzero(~seen)[ahead]
    error, before = conditional[ahead] - x[rest], mean[rest] - x[rest]
    own = left[np.arange(len(conditional)), :, np.arange(len(conditional))][ahead]
    own = own + 1e-12 * np.eye(d) * np.trace(covariance[rest, :, rest].mean(0))
    square = np.einsum("ni,ni->n", error, np.linalg.solve(own, error[..., None])[..., 0])
    gain = [
        log_density(x[t], conditional[ahead][i], own[i], df) - log_density(x[t], mean[t], covariance[t, :, t], df)
        for i, t in enumerate(rest)
    ]
    draws = 4096
    generator = np.random.default_rng(0)
    normal = np.square(generator.standard_normal((draws, d))).sum(1)
    if math.isfinite(df):
        normal *= (df - 2.0) / generator.chisquare(df, draws)
    return {
        "rmse": float(np.sqrt(np.square(error).mean() / np.square(before).mean())),
        "gain": float(np.mean(gain)),
        "holds_95": float((square <= np.quantile(normal, 0.95)).mean()),
    }


def judge(joint: tuple[Floats, Floats, float], x: Floats, train: Floats, draws: Floats) -> dict[str, float]:
    """Everything that one left-out movement says of one model."""
    mean, covariance, df = joint
    n = len(mean)
    half, ends = np.arange(n) < n // 2, np.isin(np.arange(n), [n // 2, n - 1])
    row: dict[str, float] = {"joint": log_density(x, mean, covariance, df)}
    cases = {
        "next": (half, slice(0, max(1, n // 10))),
        "rest": (half, slice(None)),
        "between": (ends, slice(n // 2, -1)),
        "replanned": (np.arange(n) == n // 2, slice(n // 2, None)),
        "moving": (np.isin(np.arange(n), [n // 2 - 2, n // 2]), slice(n // 2 - 1, None)),
    }
    for name, (seen, steps) in cases.items():
        row |= {f"{name}_{key}": value for key, value in judge_conditioning(joint, seen, x, steps).items()}
    deviation = np.sqrt(np.einsum("nini->ni", covariance))
    own, of_draws = (movement_statistics(part, mean, deviation) for part in (x[None], draws))
    low, high = np.quantile(of_draws, [0.05, 0.95], axis=0)
    row |= {f"region_{name}": float(low[i] <= own[0, i] <= high[i]) for i, name in enumerate(MOVEMENT_STATISTICS)}
    rough = [np.sqrt(np.square(np.diff(part, 2, axis=1)).mean()) for part in (draws, train)]
    return row | {"roughness": float(rough[0] / rough[1])}


def drawn(joint: tuple[Floats, Floats, float], seed: int) -> Floats:
    """Movements of a joint law, by a dense root."""
    mean, covariance, df = joint
    generator = np.random.default_rng(seed)
    values, vectors = np.linalg.eigh(covariance.reshape(mean.size, mean.size))
    normal = (vectors * np.sqrt(values.clip(0.0))) @ generator.standard_normal((mean.size, N_DRAWS))
    if math.isfinite(df):
        normal *= np.sqrt((df - 2.0) / generator.chisquare(df, N_DRAWS))
    return mean + normal.T.reshape(N_DRAWS, *mean.shape)


def fold(name: str, left_out: int, n_train: int, models: list[str]) -> list[dict[str, Any]]:
    """Models, the first of them TrajectoryRegressor, on one left-out demonstration of one set."""
    grid, y = load(name)
    train = np.delete(y, left_out, axis=0)
    train = train[np.random.default_rng(left_out).permutation(len(train))[:n_train]]
    n_demos, n, d = train.shape
    X, rows, groups = np.tile(grid, n_demos)[:, None], train.reshape(-1, d), np.repeat(np.arange(n_demos), n)
    at, trajectory, results = grid[:, None], None, []
    for model in models:
        make, start = MODELS[model], time.process_time()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            if make is not None:
                fitted = make().fit(X, rows, groups=groups)
                trajectory = trajectory or fitted
                joint = (*fitted.predict_joint(at), fitted.df_)
            else:
                joint = (Independent(trajectory) if model == "rows independent" else Published(grid, train)).joint(at)
        seconds = time.process_time() - start
        milliseconds = math.nan if make is None else planned_anew(fitted, at, y[left_out])
        row = judge(joint, y[left_out], train, drawn(joint, left_out))
        row |= {"seconds": seconds, "replanned_ms": milliseconds}
        results.append({"set": name, "fold": left_out, "K": n_demos, "model": model, **row})
    return results


def planned_anew(model: Any, at: Floats, x: Floats) -> float:
    """CPU milliseconds of conditioning on where a movement is at half, and of the rest of it, the best of three."""
    half, times = len(at) // 2, []
    for _ in range(3):
        start = time.process_time()
        model.condition(at[half : half + 1], x[half : half + 1]).predict(at)
        times.append(1e3 * (time.process_time() - start))
    return min(times)


def made(law: str, kernel: str, length: float, n_demos: int, seed: int) -> list[dict[str, Any]]:
    """KL divergence per step from a made law, whose covariance and kernel are known, to what models learn of it."""
    n = 60
    grid = np.linspace(0.0, 1.0, n)
    r = np.abs(grid[:, None] - grid) / length
    root5 = math.sqrt(5.0) * r
    unit = np.exp(-0.5 * r**2) if kernel == "squared exponential" else (1 + root5 + root5**2 / 3) * np.exp(-root5)
    unit = unit + 1e-6 * np.eye(n)
    mean = np.stack([np.sin(3.0 * grid), np.cos(2.0 * grid)], axis=1)
    if law == "bell":
        width = 0.3 + np.exp(-0.5 * np.square((grid - 0.5) / 0.15))
        factor = np.stack([np.array([[w, 0.0], [0.5 * w, 0.7]]) for w in width])
    elif law == "rotating":
        angle = np.pi * grid
        factor = np.stack([[[math.cos(a), -0.2 * math.sin(a)], [math.sin(a), 0.2 * math.cos(a)]] for a in angle])
    else:  # the deviations fall by thirty within the last twentieth
        share = np.clip((grid - 0.95) / 0.05, 0.0, 1.0)
        factor = (1.0 - 0.97 * share**2 * (3.0 - 2.0 * share))[:, None, None] * np.eye(2)
    whole = np.einsum("iab,ij,jcb->iajc", factor, unit, factor).reshape(2 * n, 2 * n)
    draws = mean.ravel() + np.random.default_rng(seed).multivariate_normal(np.zeros(2 * n), whole, n_demos)
    X, groups = np.tile(grid, n_demos)[:, None], np.repeat(np.arange(n_demos), n)
    results = []
    for model in (TrajectoryRegressor, ProMPBaseline):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            fitted = model().fit(X, draws.reshape(-1, 2), groups=groups)
        own_mean, own = fitted.predict_joint(grid[:, None])
        moments = own.reshape(1, 2 * n, 2 * n), mean.reshape(1, -1), own_mean.reshape(1, -1)
        kl = gaussian_kl(whole[None], moments[0], reference_mean=moments[1], estimated_mean=moments[2])
        row = {"law": law, "kernel": kernel, "length": length, "K": n_demos, "seed": seed}
        results.append({**row, "model": model.__name__, "kl_per_step": kl / n})
    return results


def table_of_sets(rows: list[dict[str, Any]]) -> str:
    """Joint log likelihood of each set, paired differences to ProMPBaseline, and errors of what is planned anew."""
    models = list(dict.fromkeys(row["model"] for row in rows))
    names = list(dict.fromkeys(row["set"] for row in rows))
    values: dict[tuple[str, str], list[float]] = {}
    for row in rows:
        values.setdefault((row["set"], row["model"]), []).append(row["joint"])
    lines = ["| set | " + " | ".join(models) + " | ahead of ProMPBaseline | planned anew | moving |"]
    lines.append("|" + " --- |" * (len(models) + 4))
    ahead = []
    for name in names:
        difference = np.subtract(values[name, "TrajectoryRegressor"], values[name, "ProMPBaseline"])
        error = difference.std(ddof=1) / math.sqrt(len(difference)) if len(difference) > 1 else math.nan
        means = " | ".join(f"{np.mean(values[name, model]):.0f}" for model in models)
        own = [row for row in rows if (row["set"], row["model"]) == (name, "TrajectoryRegressor")]
        cells = [_ratio([row[f"{case}_rmse"] for row in own]) for case in ("replanned", "moving")]
        lines.append(f"| {name} | {means} | {difference.mean():.0f} +- {error:.0f} | {' | '.join(cells)} |")
        ahead.append(difference.mean())
    if len(ahead) > 1:
        error = np.std(ahead, ddof=1) / math.sqrt(len(ahead))
        lines.append(f"| mean of the sets {'| ' * len(models)}| {np.mean(ahead):.0f} +- {error:.0f} | | |")
    return "\n".join(lines)


def _ratio(values: list[float]) -> str:
    """Geometric mean of ratios, and its standard error."""
    logarithm = np.log(values)
    mean = float(np.exp(logarithm.mean()))
    return (
        f"{mean:.2f} +- {mean * logarithm.std(ddof=1) / math.sqrt(len(values)):.2f}"
        if len(values) > 1
        else f"{mean:.2f}"
    )


def table_of_lengths(rows: list[dict[str, Any]]) -> str:
    """What 90 % regions of the path length hold, and why not more: who is left out, and what normal laws cannot be."""
    lines = ["| set | region length | left out over the others | normal over own | roughness |", "|" + " --- |" * 5]
    for name in dict.fromkeys(row["set"] for row in rows):
        y = load(name)[1]
        steps = np.diff(y, axis=1)
        length = np.linalg.norm(steps, axis=2).sum(1)
        # Paths whose steps are normal, with the mean and the covariance that the demonstrations' own have.
        mean, deviation = steps.mean(0), steps - steps.mean(0)
        values, vectors = np.linalg.eigh(np.einsum("kti,ktj->tij", deviation, deviation) / (len(y) - 1))
        root = vectors * np.sqrt(values.clip(0.0))[:, None]
        normal = np.einsum("tij,stj->sti", root, np.random.default_rng(0).standard_normal((400, *mean.shape)))
        ratio = np.linalg.norm(mean + normal, axis=2).sum(1).mean() / length.mean()
        own = [row for row in rows if (row["set"], row["model"]) == (name, "TrajectoryRegressor")]
        held, rough = (np.mean([row[key] for row in own]) for key in ("region_length", "roughness"))
        others = np.median(length[N_FOLDS:]) if len(length) > N_FOLDS else math.nan
        lines.append(
            f"| {name} | {held:.2f} | {np.median(length[:N_FOLDS]) / others:.2f} | {ratio:.2f} | {rough:.2f} |"
        )
    return "\n".join(lines)


def table_of_models(rows: list[dict[str, Any]]) -> str:
    """Everything else but times, which are of the machine, in the mean over the sets; ratios as geometric means."""
    left_out = ("set", "fold", "K", "model", "joint", "seconds", "replanned_ms")
    columns = [key for key in rows[0] if key not in left_out and not key.startswith("moving")]
    lines = ["| model | " + " | ".join(column.replace("_", " ") for column in columns) + " |"]
    lines.append("|" + " --- |" * (len(columns) + 1))
    for model in dict.fromkeys(row["model"] for row in rows):
        entries = []
        for column in columns:
            each = [
                [row[column] for row in rows if row["model"] == model and row["set"] == name]
                for name in dict.fromkeys(row["set"] for row in rows)
            ]
            ratio = column.endswith("rmse") or column == "roughness"
            means = [np.exp(np.log(part).mean()) if ratio else np.mean(part) for part in each]
            entries.append(f"{np.exp(np.log(means).mean()) if ratio else np.mean(means):.2f}")
        lines.append(f"| {model} | {' | '.join(entries)} |")
    return "\n".join(lines)


def table_of_laws(rows: list[dict[str, Any]]) -> str:
    """KL divergences a step, means over seeds with the paired standard error."""
    lines = ["| law | kernel | length | K | TrajectoryRegressor | ProMPBaseline | difference |", "|" + " --- |" * 7]
    values: dict[tuple[Any, ...], dict[str, list[float]]] = {}
    for row in rows:
        key = row["law"], row["kernel"], row["length"], row["K"]
        values.setdefault(key, {}).setdefault(row["model"], []).append(row["kl_per_step"])
    for key, each in values.items():
        own, other = (np.array(each[model]) for model in ("TrajectoryRegressor", "ProMPBaseline"))
        difference = own - other
        error = difference.std(ddof=1) / math.sqrt(len(own)) if len(own) > 1 else math.nan
        figures = f"{own.mean():.2f} | {other.mean():.2f} | {difference.mean():.2f} +- {error:.2f}"
        lines.append(f"| {' | '.join(map(str, key))} | {figures} |")
    return "\n".join(lines)


def speed(n_demos: int, n: int, d: int) -> str:
    """CPU times on one thread, of the fit beyond the regressor's and, best of five, of what is asked of it.

    Of a hundred draws, a via point, a controller that is planned anew, and its schedule of a second at 1 kHz.
    """
    rng, grid = np.random.default_rng(0), np.linspace(0.0, 1.0, n)
    unit = np.exp(-0.5 * np.square((grid[:, None] - grid) / 0.1)) + 1e-6 * np.eye(n)
    mixed = (np.eye(d) + 0.3 * rng.standard_normal((d, d))) * (0.2 + grid[:, None, None])
    series = np.linalg.cholesky(unit) @ rng.standard_normal((n_demos, n, d))
    y = np.sin(3.0 * grid)[:, None] + np.einsum("kni,nij->knj", series, mixed)
    rows, groups = (np.tile(grid, n_demos)[:, None], y.reshape(-1, d)), np.repeat(np.arange(n_demos), n)
    regressor, at, half = GMMBaseline(), grid[:, None], slice(n // 2, n // 2 + 1)
    model = TrajectoryRegressor(regressor)
    fit = seconds(lambda: model.fit(*rows, groups=groups), 1) - seconds(lambda: regressor.fit(*rows), 1)
    draws = seconds(lambda: model.sample_demonstrations(at, 100, random_state=0))
    via = seconds(lambda: model.condition(at[half], y[0, half]).predict(at))
    skill = DMPController(model).fit(Demonstrations([grid] * n_demos, list(y)))
    replanned = seconds(lambda: skill.condition(grid[half], y[0, half]))
    bent = skill.condition(grid[half], y[0, half])
    schedule = seconds(lambda: bent.schedule(rate=1000.0, limits=None))
    cells = " | ".join(f"{1e3 * each:.1f}" for each in (draws, via, replanned, schedule))
    return f"| {n_demos} x {n} x {d} | {fit:.2f} | {cells} |"


def speed_of_outputs(d: int) -> str:
    """CPU time on one thread of the recommended regressor's fit to outputs of a real set, and its log evidence."""
    shown = load_demonstrations(DATA / "adroit_door_joints.npz").resample(200)
    X, y, groups = shown.stack(input="phase")
    model = HeteroscedasticGPRegressor()
    fit = seconds(lambda: model.fit(X, y[:, :d], groups=groups), 3)
    return f"| {d} | {fit:.2f} | {-model.loss_:.1f} |"


def seconds(call: Any, n_repetitions: int = 5) -> float:
    """Least CPU time of some calls."""
    times = []
    for _ in range(n_repetitions):
        start = time.process_time()
        call()
        times.append(time.process_time() - start)
    return min(times)


def print_times() -> None:
    """Print the tables of times."""
    torch.set_num_threads(1)
    asked = " | ".join(f"{name} [ms]" for name in ("100 draws", "via point", "planned anew", "1 s of schedule"))
    print(f"| K x T x d | fit beyond the regressor [s] | {asked} |\n|" + " --- |" * 6)
    print(speed(6, 100, 2), speed(20, 1000, 14), sep="\n")
    print("\n| outputs | fit of HeteroscedasticGPRegressor [s] | log evidence |\n|" + " --- |" * 3)
    print(*(speed_of_outputs(d) for d in (2, 7, 14, 27)), sep="\n")


def write(path: Path, rows: list[dict[str, Any]]) -> None:
    """Rows as CSV."""
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)


def main() -> None:
    """Run what is asked for, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, default=Path("runs/movements"))
    parser.add_argument("--sets", nargs="*", default=SETS)
    compared = ("TrajectoryRegressor", "ProMPBaseline")
    parser.add_argument(
        "--models", nargs="*", default=list(MODELS), choices=list(MODELS), help=f"besides {' and '.join(compared)}"
    )
    parser.add_argument("--folds", type=int, default=N_FOLDS)
    parser.add_argument("--n_train", type=int, default=MOST_TRAINED, help="demonstrations learned from, at most")
    parser.add_argument("--seeds", type=int, default=4, help="of made data; 0 leaves them out")
    parser.add_argument("--speed", action="store_true", help="print the tables of times alone")
    parser.add_argument("--n_jobs", type=int, default=2)
    options = parser.parse_args()
    if options.speed:
        print_times()
        return
    options.output.mkdir(parents=True, exist_ok=True)
    models = [model for model in MODELS if model in {*compared, *options.models}]
    jobs = [
        delayed(fold)(name, left_out, options.n_train, models)
        for name in options.sets
        for left_out in range(min(options.folds, len(load(name)[1])))
    ]
    parallel = Parallel(n_jobs=options.n_jobs)
    rows = [row for part in parallel(jobs) for row in part]
    if rows:
        write(options.output / "movements.csv", rows)
        print(table_of_sets(rows), table_of_lengths(rows), table_of_models(rows), sep="\n\n")
    kernels, laws = ("squared exponential", "Matern 5/2"), ("bell", "rotating", "collapsing")
    jobs = [
        delayed(made)(law, kernel, length, n_demos, seed)
        for law in laws
        for kernel in kernels
        for length in (0.1, 0.3)
        for n_demos in (6, 12)
        for seed in range(options.seeds)
    ]
    rows = [row for part in parallel(jobs) for row in part]
    if rows:
        write(options.output / "laws.csv", rows)
        print("", table_of_laws(rows), sep="\n")


if __name__ == "__main__":
    main()

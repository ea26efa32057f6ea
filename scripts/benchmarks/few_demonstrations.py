"""Few demonstrations: the predictive law of the recommended regressor beside that of independent samples.

Trained on K demonstrations drawn from a set, judged by up to 20 of the others; the two laws are of the same fits, so
differences are paired. The law was chosen on one half of the sets, and then tried on the other. Prints the table of
docs/covariance_benchmark.md.
"""

import argparse
import copy
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from covariance_tasks import TASKS, Floats, Groups, load_recordings
from scipy.stats import f as fisher

from torch_pbd import HeteroscedasticGPRegressor
from torch_pbd.metrics import gaussian_kl

DATA = Path(__file__).parents[3] / "shared" / "data"
HALVES = {
    "chosen on": (
        *("adroit_door_palm", "adroit_door_joints", "handwriting_fda", "kuka_cube_pick", "pen_a"),
        *("letter_C", "letter_L", "letter_P", "letter_Z"),
    ),
    "confirmed on": (
        *("gait_hip_knee", "kuka_cshape_top", "mouse_choice_1", "snooker_skilled"),
        *("letter_A", "letter_G", "letter_N", "letter_S"),
    ),
}
SIZES, MOST_STEPS, MOST_OUTPUTS, MOST_TESTED = (3, 4, 6, 10), 50, 6, 20


def movements(name: str, folder: Path) -> tuple[Floats, Floats]:
    """Times (n, 1) and demonstrations (K, n, d): every other step of long ones; the arm and wrist of 27 joints."""
    recording = load_recordings(folder, [name])[0]
    n_demos = len(np.unique(recording.groups))
    X, y = (part.reshape(n_demos, -1, part.shape[1]) for part in (recording.X, recording.y))
    step = 1 + (X.shape[1] > MOST_STEPS)
    return X[0, ::step], y[:, ::step, :MOST_OUTPUTS]


def judge(model: HeteroscedasticGPRegressor, X: Floats, y: Floats) -> Floats:
    """Log-likelihood a step of demonstrations (k, n, d), and the shares of steps that 50 and 95 % regions hold."""
    mean, covariance = model.predict(X, return_cov=True)
    df, d = model.predict_df(X).clip(max=1e7), y.shape[2]
    rows = y.reshape(-1, d)
    likelihood = model.log_likelihood(np.tile(X, (len(y), 1)), rows).mean()
    deviation = y - mean
    square = np.einsum("knd,knd->kn", deviation, np.linalg.solve(covariance, deviation[..., None])[..., 0])
    ratio = square * df / (df - 2.0) / d
    return np.array([likelihood, *(float((ratio <= fisher(d, df).ppf(level)).mean()) for level in (0.5, 0.95))])


def draws(name: str, n_train: int, n_draws: int, folder: Path) -> Iterator[tuple[Floats, Floats]]:
    """Scores without and with the law of correlated samples."""
    X, y = movements(name, folder)
    for draw in range(n_draws if len(y) > n_train else 0):
        order = np.random.default_rng([draw, n_train]).permutation(len(y))
        shown, tested = y[order[:n_train]], y[order[n_train : n_train + MOST_TESTED]]
        groups = np.repeat(np.arange(n_train), len(X))
        plain, model = laws(np.tile(X, (n_train, 1)), shown.reshape(len(groups), -1), groups)
        yield judge(plain, X, tested), judge(model, X, tested)


def laws(X: Floats, y: Floats, groups: Groups) -> tuple[HeteroscedasticGPRegressor, HeteroscedasticGPRegressor]:
    """One fit under the law of independent samples, and under its own."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model = HeteroscedasticGPRegressor().fit(X, y, groups=groups)
    plain = copy.deepcopy(model)
    plain.module_.core._buffers.pop("correlation_variance", None)
    return plain, model


def print_made() -> None:
    """Kullback-Leibler divergence from made laws, of four seeds of six smooth demonstrations."""
    print("\n| made data | KL before | change |\n|---|---|---|")
    for name in (name for name in TASKS if "smooth" in name):
        found = []
        for task in map(TASKS[name], range(4)):
            for model in laws(task.X, task.y, task.groups):
                mean, covariance = model.predict(task.X_test, return_cov=True)
                found.append(gaussian_kl(task.covariance, covariance, reference_mean=task.mean, estimated_mean=mean))
        before, after = np.reshape(found, (4, 2)).T
        change = after - before
        print(f"| {name} | {before.mean():.3f} | {change.mean():+.3f} +- {change.std(ddof=1) / 2.0:.3f} |", flush=True)


def print_joints(folder: Path, n_draws: int = 3) -> None:
    """Nats a step of five movements of a hand, of joints and demonstrations drawn at random, under three laws."""
    recording = load_recordings(folder, ["adroit_door_joints"])[0]
    hand = recording.y.reshape(len(np.unique(recording.groups)), -1, recording.y.shape[1])
    X = recording.X[: hand.shape[1]]
    print(
        "\n| joints | K | independent samples | shrunk as two are | own law | 95 % holds |\n|---|---|---|---|---|---|"
    )
    for n_joints in (4, 7, 14, 27):
        for n_train in (6, 20):
            found = []
            for draw in range(n_draws):
                rng = np.random.default_rng(draw)
                joints, order = rng.permutation(hand.shape[2])[:n_joints], rng.permutation(len(hand))
                shown, tested = hand[order[:n_train]][..., joints], hand[order[20:]][..., joints]
                groups = np.repeat(np.arange(n_train), len(X))
                plain, model = laws(np.tile(X, (n_train, 1)), shown.reshape(len(groups), -1), groups)
                alike = copy.deepcopy(model)
                alike.module_.core._buffers.pop("correlation_error", None)
                found.append([judge(law, X, tested) for law in (plain, alike, model)])
            (first, *_), (second, *_), (own, _, held) = np.mean(found, axis=0)
            print(f"| {n_joints} | {n_train} | {first:.2f} | {second:.2f} | {own:.2f} | {held:.2f} |", flush=True)


def main(arguments: list[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=6, help="of the demonstrations shown, a set (default: 6)")
    parser.add_argument("--sets", nargs="*", help="only these; none: made data alone")
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the recordings (default: %(default)s)")
    parser.add_argument("--joints", action="store_true", help="print the table of many joints alone")
    options = parser.parse_args(arguments)
    if options.joints:
        print_joints(options.data)
        return
    print("| sets | K | nats a step | lowest | ahead | 50 % holds | 95 % holds |\n|---|---|---|---|---|---|---|")
    for half, sets in HALVES.items():
        for n_train in SIZES:
            means, errors, held = {}, [], []
            for name in sets:
                found = np.array(
                    list(draws(name, n_train, options.draws, options.data) if _asked(name, options) else [])
                )
                if not len(found):
                    continue
                gain = found[:, 1, 0] - found[:, 0, 0]
                means[name] = float(gain.mean())
                errors.append(float(gain.std(ddof=1)) / len(gain) ** 0.5)
                held.append(found[:, :, 1:].mean(0))
            if not means:
                continue
            mean, error = np.mean(list(means.values())), np.linalg.norm(errors) / len(errors)
            (before, after), lowest = np.mean(held, axis=0), min(means, key=lambda name: means[name])
            ahead = sum(value > 0.0 for value in means.values())
            error_of_lowest = errors[list(means).index(lowest)]
            print(
                f"| {half} | {n_train} | {mean:+.3f} +- {error:.3f} | {means[lowest]:+.3f} +- {error_of_lowest:.3f} "
                f"({lowest}) | {ahead}/{len(means)} | {before[0]:.2f} -> {after[0]:.2f} "
                f"| {before[1]:.2f} -> {after[1]:.2f} |",
                flush=True,
            )
    print_made()


def _asked(name: str, options: argparse.Namespace) -> bool:
    return options.sets is None or name in options.sets


if __name__ == "__main__":
    main()

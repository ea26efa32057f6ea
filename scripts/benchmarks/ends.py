"""How HeteroscedasticGPRegressor follows deviations that collapse at an end of the movement, and what that costs else.

Made data of known law, tested by 200 more demonstrations, and recordings, each with some demonstrations left out in
turn. The whitened rms of the left-out steps is one where the predicted covariance is right. ``--before`` takes the CSV
file of a run of another version, and adds paired differences of the log likelihood a step with their standard errors.
"""

import argparse
import csv
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from covariance_tasks import load_recordings

from torch_pbd import HeteroscedasticGPRegressor
from torch_pbd.data import make_tunnel_demonstrations

DATA = Path(__file__).parents[3] / "shared" / "data"
FIELDS = ("set", "fold", "log_likelihood", "first", "last", "worst", "seconds")
LAWS = ("law, goal", "law, start", "law, both", "law, even")
TUNNELS = ("tunnel, goal", "tunnel, start", "tunnel")
N_TEST, N_STEPS = 200, 10


def law(kind: str, n_demos: int, n_steps: int, seed: int) -> Any:
    """Curves (K, n, 2) whose deviations fall by 30 in the last or the first twentieth; Matern 5/2 of length .1."""
    grid = np.linspace(0.0, 1.0, n_steps)
    share = np.clip((grid - 0.95) / 0.05, 0.0, 1.0)
    falling = 1.0 - 0.97 * share**2 * (3.0 - 2.0 * share)
    goal, start = (falling if kind.endswith(end) or kind.endswith("both") else 1.0 for end in ("goal", "start"))
    distance = 5.0**0.5 * np.abs(grid[:, None] - grid) / 0.1
    gram = (1.0 + distance + distance**2 / 3.0) * np.exp(-distance) + 1e-6 * np.eye(n_steps)
    z = np.linalg.cholesky(gram) @ np.random.default_rng(seed).normal(size=(n_demos, n_steps, 2))
    deviation = goal * (start if np.isscalar(start) else start[::-1]) * np.ones(n_steps)
    return np.stack([np.sin(3.0 * grid), np.cos(2.0 * grid)], axis=1) + deviation[:, None] * z


def tunnel(kind: str, n_demos: int, n_steps: int, seed: int) -> Any:
    """Movements (K, n, 2) of the tunnel task."""
    ends = {"common_goal": kind.endswith("goal"), "common_start": kind.endswith("start")}
    return make_tunnel_demonstrations(n_demos, 10.0, (n_steps - 1) / 10.0, random_state=seed, **ends).to_array()


def jobs(n_seeds: int, n_folds: int, data: Path, sets: list[str] | None) -> Iterator[tuple[str, int, Any, Any]]:
    """Name, number, demonstrations to learn from and demonstrations left out."""
    for kind in (*LAWS, *TUNNELS):
        for n_shown, n_steps in ((6, 50), (6, 100), (12, 100), (6, 200)):
            name = f"{kind}, K={n_shown}, {n_steps} steps"
            for seed in range(n_seeds) if sets is None or kind in sets else ():
                made = (law if kind.startswith("law") else tunnel)(kind, n_shown + N_TEST, n_steps, seed)
                yield name, seed, made[:n_shown], made[n_shown:]
    for recording in load_recordings(data) if data.is_dir() else []:
        if sets is not None and recording.name not in sets:
            continue
        names = np.unique(recording.groups)
        y = recording.y.reshape(len(names), -1, recording.y.shape[1])
        for fold in np.linspace(0, len(names) - 1, min(n_folds, len(names))).round().astype(int):
            yield recording.name, int(fold), np.delete(y, fold, axis=0), y[fold : fold + 1]


def score(shown: Any, left_out: Any) -> dict[str, float]:
    """Log likelihood a step, and whitened mean squares of the first and the last steps, together and at the worst."""
    n_demos, n_steps, d = shown.shape
    grid = np.linspace(0.0, 1.0, n_steps)[:, None]
    start = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        groups = np.repeat(np.arange(n_demos), n_steps)
        model = HeteroscedasticGPRegressor().fit(np.tile(grid, (n_demos, 1)), shown.reshape(-1, d), groups=groups)
    seconds = time.process_time() - start
    mean, covariance = model.predict(grid, return_cov=True)
    whitened = np.linalg.solve(np.linalg.cholesky(covariance), (left_out - mean)[..., None])[..., 0]
    square = np.square(whitened).mean((0, 2))
    density = np.mean([model.log_likelihood(grid, one).mean() for one in left_out])
    first, last = square[:N_STEPS], square[-N_STEPS:]
    both = np.concatenate([first, last])
    worst = both[np.abs(np.log(both + 1e-12)).argmax()]
    return {
        "log_likelihood": float(density),
        "first": float(first.mean()),
        "last": float(last.mean()),
        "worst": float(worst),
        "seconds": seconds,
    }


def table(rows: list[dict[str, Any]], before: list[dict[str, Any]]) -> str:
    """One line a set; roots of mean squares over the folds."""
    old = {(row["set"], int(row["fold"])): row for row in before}
    lines = ["| set | whitened rms, first ten steps | last ten | worst of these | to before | time to before |"]
    lines.append("|" + " --- |" * 6)
    for name in dict.fromkeys(row["set"] for row in rows):
        own = [row for row in rows if row["set"] == name]
        rms = [np.sqrt(np.mean([float(row[key]) for row in own])) for key in ("first", "last", "worst")]
        pairs = [(row, old[name, int(row["fold"])]) for row in own if (name, int(row["fold"])) in old]
        gain = np.array([float(new["log_likelihood"]) - float(was["log_likelihood"]) for new, was in pairs])
        error = gain.std(ddof=1) / len(gain) ** 0.5 if len(gain) > 1 else np.nan
        spent = [sum(float(row["seconds"]) for row in side) for side in zip(*pairs, strict=True)] if pairs else []
        change = f"{gain.mean():+.3f} +- {error:.3f} | {spent[0] / spent[1]:.2f}" if pairs else "|"
        lines.append(f"| {name} | {' | '.join(f'{value:.2f}' for value in rms)} | {change} |")
    return "\n".join(lines)


def main() -> None:
    """Run what is asked for, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--folds", type=int, default=5)
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--sets", nargs="*", help="made or recorded; default: all")
    parser.add_argument("--before", type=Path, help="CSV file to compare with")
    parser.add_argument("--output", type=Path, default=Path("ends.csv"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    rows = []
    with options.output.open("w", newline="") as file:
        writer = csv.DictWriter(file, FIELDS)
        writer.writeheader()
        for name, number, shown, left_out in jobs(options.seeds, options.folds, options.data, options.sets):
            rows.append({"set": name, "fold": number, **score(shown, left_out)})
            writer.writerow(rows[-1])
            file.flush()
    before = list(csv.DictReader(options.before.open(newline=""))) if options.before else []
    print(table(rows, before))


if __name__ == "__main__":
    main()

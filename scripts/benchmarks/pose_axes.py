"""Axes in which the variability of poses is learned: those of the pooled covariance, common ones, none, the tool's.

The covariance of each block, of positions and of rotations, has a free factor whose entries are smooth functions of
time; how well these are found depends on the axes. They are chosen from the demonstrations, by:

- pooled: the principal axes of the covariance within times, pooled, which free phases dominate;
- any: a drawn rotation, as where a frame happens to be;
- mean log: the axes of the mean of the logarithms of the covariances, shrunk like those of "common";
- likely: maximum likelihood of common principal components, not shrunk;
- common: the same of shrunk covariances, which is what DMPController takes;
- tool, world: "common" of rotations in axes that turn with the mean pose, or of the world, instead of the chart's.

Made poses, whose law is known, in its own form (its freedoms turn with the tool) and with freedoms of rotation that
stay in the world: divergence from the true law at the mean pose to the one learned, averaged over times, and
log-likelihood a step of fresh demonstrations, for each block; and the middle standard deviation in the hole, learned
over true. Recordings, outputs of one unit: log-likelihood of left-out demonstrations, against none. Prints means of the
first choice, and paired differences from it with standard errors. Choices were made on the seeds 0 to 11 and one half
of the recordings; the others confirm. Tables of docs/poses.md.
"""

import argparse
import warnings
from pathlib import Path
from unittest.mock import patch

import numpy as np
from few_demonstrations import DATA, HALVES, MOST_TESTED, movements
from scipy.stats import multivariate_t

from torch_pbd import HeteroscedasticGPRegressor
from torch_pbd.control.primitive import outputs
from torch_pbd.data import make_pose_demonstrations, pose_covariance, pose_mean
from torch_pbd.rotations import Chart, conjugate, exp, left_jacobian, log, matrix, mean, multiply

SEEDS = {"chosen on": range(12), "confirmed on": range(100, 112)}
SIZES, STEPS, FRESH = (5, 6, 8, 12, 16), 60, 12
POSES = ("pooled", "any", "mean log", "likely", "common", "tool", "world")
RECORDED = ("none", "pooled", "likely", "common")
BLOCKS = {"positions": slice(3), "rotations": slice(3, 6)}


def axes(deviation, choice, seed):
    """Axes (d, d) of deviations (K, n, d)."""
    d, degrees = deviation.shape[2], np.full(deviation.shape[1], len(deviation) - 1)
    least = 1e-5 * np.abs(deviation).max()
    scatter = np.einsum("kni,knj->nij", deviation, deviation)
    match choice:
        case "none":
            return np.eye(d)
        case "any":
            return np.linalg.qr(np.random.default_rng([seed, 1]).normal(size=(d, d)))[0]
        case "pooled":
            return np.linalg.eigh(scatter.sum(axis=0))[1]
        case "mean log":
            covariance = scatter / degrees[0] + least**2 * np.eye(d)
            values, vectors = np.linalg.eigh(outputs._shrunk(covariance, degrees[:, None, None]))
            return np.linalg.eigh(np.einsum("nia,na,nja->ij", vectors, np.log(values), vectors))[1]
        case "likely":
            with patch.object(outputs, "_shrunk", lambda covariances, _: covariances):
                return outputs.common_axes(deviation, degrees, least)
    return outputs.common_axes(deviation, degrees, least)


def learned(X, coordinates):
    """Mean (n, d), covariance (n, d, d) and degrees of freedom (n,) of coordinates (K, n, d) at X (n, 1)."""
    n_demos, n, d = coordinates.shape
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model = HeteroscedasticGPRegressor().fit(
            np.tile(X, (n_demos, 1)), coordinates.reshape(-1, d), groups=np.repeat(np.arange(n_demos), n)
        )
    return *model.predict(X, return_cov=True), model.predict_df(X).clip(2.01, 1e7)


def likelihood(deviations, covariance, degrees):
    """Log-likelihood a step of deviations (k, n, d) under Student's t."""
    scale = covariance * ((degrees - 2.0) / degrees)[:, None, None]
    found = [
        multivariate_t(shape=each, df=own, allow_singular=True).logpdf(rows)
        for each, own, rows in zip(scale, degrees, np.swapaxes(deviations, 0, 1), strict=True)
    ]
    return float(np.mean(found))


def made(n_demos, seed, stays):
    """Phases (n,), positions (K, n, 3), quaternions (K, n, 4) of the made task; its freedoms stay or turn."""
    shown = make_pose_demonstrations(n_demos, rate=50.0, timing=0.0, random_state=seed).align(n=STEPS)
    phase = shown.times[0] / shown.times[0][-1]
    position, turn = map(np.array, shown.to_poses())
    if stays:
        middle = pose_mean(phase)[1]
        turn = multiply(exp(log(multiply(conjugate(middle), turn)) @ matrix(middle[-1]).T), middle)
    return phase, position, turn


def truth(phase, stays):
    """Its covariances (n, 6, 6), in axes of the world."""
    covariance = pose_covariance(phase)
    if stays:
        turn = matrix(pose_mean(phase)[1])
        turn = turn[-1] @ np.swapaxes(turn, 1, 2)
        covariance[:, 3:, 3:] = turn @ covariance[:, 3:, 3:] @ np.swapaxes(turn, 1, 2)
    return covariance


def judge_poses(n_demos, seed, stays, choices):
    """Scores (choices, blocks, 3): divergence, log-likelihood, and ratio of middle deviations at the end."""
    phase, position, turn = made(n_demos, seed, stays)
    chart, true = Chart(mean(turn.reshape(-1, 4))), truth(phase, stays)
    shown = np.concatenate([position, chart.log(turn)], axis=-1)
    _, position, turn = made(FRESH, 50_000 + seed, stays)
    fresh, middle = np.concatenate([position, chart.log(turn)], axis=-1), shown.mean(axis=0)
    to_world = np.tile(np.eye(6), (STEPS, 1, 1))
    to_world[:, 3:, 3:] = chart.to_world(middle[:, 3:])
    frames, scores = {"tool": left_jacobian(-middle[:, 3:]), "world": left_jacobian(middle[:, 3:])}, []
    for choice in choices:
        frame = np.tile(np.eye(6), (STEPS, 1, 1))
        frame[:, 3:, 3:] = frames.get(choice, np.eye(3))
        deviation, turned = np.einsum("nij,knj->kni", frame, shown - middle), np.zeros((6, 6))
        for block in BLOCKS.values():
            turned[block, block] = axes(deviation[..., block], choice, seed)
        found, covariance, degrees = learned(phase[:, None], (deviation + middle) @ turned)
        back = np.linalg.inv(frame)
        path = middle + np.einsum("nij,nj->ni", back, found @ turned.T - middle)
        covariance = back @ turned @ covariance @ np.swapaxes(back @ turned, 1, 2)
        at_pose = to_world @ covariance @ np.swapaxes(to_world, 1, 2)
        for block in BLOCKS.values():
            mine, its = at_pose[:, block, block], true[:, block, block]
            ratio = np.linalg.solve(mine, its)
            divergence = 0.5 * (np.trace(ratio, axis1=1, axis2=2) - 3.0 - np.linalg.slogdet(ratio)[1]).mean()
            ends = np.linalg.eigvalsh(mine[-1])[1] / np.linalg.eigvalsh(its[-1])[1]
            apart = fresh[..., block] - path[:, block]
            scores.append((divergence, likelihood(apart, covariance[:, block, block], degrees), ends**0.5))
    return np.reshape(scores, (len(choices), 2, 3))


def print_poses(half, stays, sizes, choices):
    """Print the table of the made task."""
    where = "stay in the world" if stays else "turn with the tool"
    print(f"\nPoses, freedoms that {where}, {half} seeds {SEEDS[half]}\n")
    columns = [f"{name} {block}" for block in BLOCKS for name in ("KL", "nats", "middle sd")]
    print(f"| n | axes | {' | '.join(columns)} |\n|{'---|' * (len(columns) + 2)}")
    for n_demos in sizes:
        found = np.array([judge_poses(n_demos, seed, stays, choices) for seed in SEEDS[half]])
        print_rows(str(n_demos), choices, found.reshape(len(found), len(choices), -1))


def print_rows(label, choices, scores):
    """Print means of the first choice, and paired differences of the others, of scores (m, choices, columns)."""
    print(f"| {label} | {choices[0]} | {' | '.join(f'{score:.2f}' for score in scores[:, 0].mean(axis=0))} |")
    for number, choice in enumerate(choices[1:], 1):
        change = scores[:, number] - scores[:, 0]
        error = change.std(axis=0, ddof=1) / len(change) ** 0.5
        cells = (f"{one:+.2f} +- {its:.2f}" for one, its in zip(change.mean(axis=0), error, strict=True))
        print(f"| {label} | {choice} | {' | '.join(cells)} |", flush=True)


def print_recordings(half, sizes, folder, n_draws):
    """Print the table of recordings."""
    print(f"\nRecordings, {half}: nats a step\n\n| set, n | axes | left out |\n|---|---|---|")
    for name in HALVES[half]:
        X, y = movements(name, folder)
        for n_demos in sizes:
            scores = []
            for draw in range(n_draws if len(y) > n_demos else 0):
                order = np.random.default_rng([draw, n_demos]).permutation(len(y))
                shown, tested = y[order[:n_demos]], y[order[n_demos : n_demos + MOST_TESTED]]
                for choice in RECORDED:
                    turned = axes(shown - shown.mean(axis=0), choice, draw)
                    path, covariance, degrees = learned(X, shown @ turned)
                    scores.append(likelihood(tested @ turned - path, covariance, degrees))
            if scores:
                print_rows(f"{name}, {n_demos}", RECORDED, np.reshape(scores, (n_draws, len(RECORDED), 1)))


def main(arguments=None):
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--half", choices=SEEDS, default="confirmed on", help="default: %(default)s")
    parser.add_argument("--task", choices=("tool", "world", "recordings"), nargs="*", default=["tool", "world"])
    parser.add_argument("--sizes", type=int, nargs="*", default=SIZES, help="demonstrations (default: %(default)s)")
    parser.add_argument("--axes", choices=POSES[1:], nargs="*", default=POSES[1:], help="beside the pooled ones")
    parser.add_argument("--draws", type=int, default=4, help="of demonstrations of a recording (default: 4)")
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the recordings (default: %(default)s)")
    options = parser.parse_args(arguments)
    for task in options.task:
        if task == "recordings":
            print_recordings(options.half, options.sizes, options.data, options.draws)
        else:
            print_poses(options.half, task == "world", options.sizes, (POSES[0], *options.axes))


if __name__ == "__main__":
    main()

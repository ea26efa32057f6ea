"""What each command does with its options, in a folder of results: the text it ends with."""

import warnings
from typing import Any

from torch_pbd.console import say
from torch_pbd.exceptions import ConfigError

_LEGEND = """MSE: squared distance of Cholesky factors to the empirical covariances, units of the data (Table I)
error to truth: relative Frobenius error of the covariance; held-out LL: log-likelihood of left-out
demonstrations, nats per sample, its mean +- standard error and its median over the folds; 95 % holds: share of
left-out samples in the 95 % ellipse; least eig.: smallest eigenvalue of the predicted correlations"""


def demo(options: Any, folder: Any) -> str:
    """The main job: made demonstrations of the tunnel task, four models, a robot that is pushed."""
    from torch_pbd import (
        CholeskyCovRegressor,
        GMMBaseline,
        HeteroscedasticGPRegressor,
        WishartProcessRegressor,
    )
    from torch_pbd.experiments.demo import run_demo

    models = {
        "HGP": HeteroscedasticGPRegressor(),
        "CD": CholeskyCovRegressor(),
        "WP": WishartProcessRegressor(),
        "GMM 5": GMMBaseline(n_components=5),
    }
    say(f"{options.n_demos} made demonstrations of the tunnel task; the truth is that of 300 more\n")
    tables = run_demo(models, folder, n_demos=options.n_demos, seed=options.seed)
    return f"{tables}\n\n{_LEGEND};\n95 % of fresh: share of the samples of those 300 in it"


def fit(options: Any, folder: Any) -> str:
    """One model on a file of demonstrations."""
    from torch_pbd.experiments.recordings import write_fitted
    from torch_pbd.experiments.resume import fit_once

    demonstrations = _demonstrations(options)
    X, y, groups = demonstrations.stack(options.input)
    model, _ = fit_once(options.model, X, y, groups, finished=folder.finished)
    name = type(model).__name__
    model_path, figure_path = write_fitted(model, demonstrations, folder, name, options.input)
    row = {
        "n_iter": model.n_iter_,
        "loss": model.loss_,
        "converged": model.converged_,
        "jitter": model.jitter_,
        "LL": model.score(X, y),
    }
    folder.write_metrics([{"model": name} | row])
    settled = "converged" if model.converged_ else "did not converge"
    return (
        f"{name} {settled} after {model.n_iter_} iterations; log-likelihood {row['LL']:.3f} nats per sample of the "
        f"data it was fitted to\nmodel:   {model_path}\nfigure:  {figure_path}"
    )


def experiment(options: Any, folder: Any) -> str:
    """A skill, learned and reproduced on a simulated robot that is pushed."""
    from torch_pbd.data import load_demonstrations, make_tunnel_demonstrations
    from torch_pbd.experiments.recordings import describe
    from torch_pbd.experiments.robot import run_robot
    from torch_pbd.experiments.robot_figures import framework_figure

    if options.data is None:
        demonstrations = make_tunnel_demonstrations(
            options.n_demos, random_state=options.seed, common_start=options.common_start
        )
        say(describe(demonstrations, "tunnel task"))
    else:
        demonstrations = load_demonstrations(options.data, missing=options.missing, from_start=options.from_start)
        say(describe(demonstrations, options.data.name))
    where = f"along {demonstrations.names[0]}, at 20 % and 80 % of the movement; K is the stiffness there, N/m"
    say(f"pushes of {options.push:g} N {where}\n")
    folder.write_figure(framework_figure(), "figure5_framework")
    made = options.data is None
    return run_robot(options.controllers, demonstrations, folder, peak=options.push, rate=options.rate, in_tunnel=made)


def compare(options: Any, folder: Any) -> str:
    """Models on a file, demonstration by demonstration, or on the paper's simulation."""
    if options.data is not None:
        from torch_pbd.experiments.recordings import run_recordings

        demonstrations = _demonstrations(options)
        if len(demonstrations) < 2:
            raise ConfigError("data: there is one demonstration; to compare models, at least two are needed.")
        table = run_recordings(
            options.models,
            demonstrations,
            folder,
            input=options.input,
            max_folds=options.max_folds,
            n_jobs=options.n_jobs,
        )
        return f"{table}\n\n{_LEGEND}"
    from torch_pbd.experiments.simulation import run_simulation

    say(f"eq. (14): {options.n_inputs} inputs x {options.n_draws} draws, medians over {options.n_seeds} seeds\n")
    return run_simulation(
        options.models,
        folder,
        readings=options.readings,
        n_seeds=options.n_seeds,
        n_inputs=options.n_inputs,
        n_demos=options.n_draws,
        max_folds=options.max_folds,
        n_jobs=options.n_jobs,
    )


WORK = {"demo": demo, "fit": fit, "experiment": experiment, "compare": compare}


def _demonstrations(options: Any) -> Any:
    from torch_pbd.data import check_unimodal, load_demonstrations
    from torch_pbd.data.alignment import TIMING_REMOVED
    from torch_pbd.experiments.recordings import describe, prepare

    recorded = load_demonstrations(options.data, missing=options.missing, from_start=options.from_start)
    say(describe(recorded, options.data.name))
    if len(recorded) == 1:
        warnings.warn(
            "There is one demonstration: what varies between demonstrations cannot be told from how one moves.",
            stacklevel=2,
        )
    check_unimodal(recorded)
    prepared = prepare(recorded, options.align, options.n_steps)
    if prepared is not recorded:
        say(describe(prepared, f"after align={options.align}"))
    if prepared.alignment == "dtw":
        warnings.warn(TIMING_REMOVED, stacklevel=2)
    say("")
    return prepared

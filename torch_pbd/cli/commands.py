"""Commands: the options of each, its work in a results folder, and the closing text."""

import json
import math
import re
import textwrap
from argparse import Namespace
from collections.abc import Callable, Sequence
from itertools import takewhile
from pathlib import Path
from typing import Annotated, Any, Literal

from torch_pbd.cli import options
from torch_pbd.cli.options import MODELS, Option
from torch_pbd.console import say
from torch_pbd.exceptions import ConfigError, DataFormatError
from torch_pbd.registry import MOVEMENTS, optional

COMMANDS = {
    "demo": "learn from six made demonstrations of the tunnel task; the main job, no data needed",
    "fit": "fit one model to a file of demonstrations",
    "inspect": "what is in a file of demonstrations, and what is likely wrong with it: torch-pbd inspect FILE",
    "experiment": "learn a skill, reproduce it on a simulated robot and push it (Figures 5 to 8)",
    "compare": "compare models: on the paper's simulation (Table I, Figures 1 to 3), or on a file",
    "playground": "draw strokes in the browser, see their covariance, bend the movement, push the robot",
}

_Count = Annotated[int, (1, math.inf)]
_Seed = Annotated[int, (0, 2**32 - 2)]  # NumPy's seeds end at 2**32 - 1, and the demo takes the next one too
_MADE = {
    "n_demos": Option(_Count, 6, "demonstrations to make"),
    "seed": Option(_Seed, 0, "seed of the demonstrations"),
}
_DATA = "file or folder of demonstrations, several, or a pattern such as 'trial_*.csv'"
_FILE = {
    "data": Option(str | list[str] | None, None, f"{_DATA}; none: made or simulated ones"),
    "loader": Option(dict[str, Any] | None, None, "options of load_demonstrations: --loader.outputs [x, y]"),
    "missing": Option(Literal["raise", "drop"], "raise", "samples without a value: refuse them, or leave them out"),
    "from_start": Option(bool, False, "count the times of each of the file's demonstrations from 0"),
}
_GRID = {
    "align": Option(Literal["auto", "none", "phase", "dtw"], "auto", "auto: by phase where sampling times differ"),
    "input": Option(Literal["time", "phase"], "time", "what the covariance depends on"),
    "n_steps": Option(Annotated[int, (2, math.inf)] | None, None, "number of points to resample to"),
}
_CLASS_HELP = "by name, or class_path and init_args; see"
_RECORDED = {**_FILE, "data": Option(str | list[str] | None, None, _DATA, required=True)}
OPTIONS: dict[str, dict[str, Option]] = {
    "demo": _MADE,
    "fit": {
        **_RECORDED,
        "model": Option("Model", MODELS["HGP"], f"estimator {_CLASS_HELP} --model.help NAME"),
        **_GRID,
    },
    "inspect": _RECORDED,
    "experiment": {
        **_FILE,
        **_MADE,
        "n_demos": Option(_Count | None, None, "demonstrations to make; null: 6, and of poses 8"),
        "common_start": Option(bool, False, "made demonstrations of the tunnel start at one point"),
        "task": Option(Literal["tunnel", "peg"], "tunnel", "task of made demonstrations: peg turns a tool"),
        "controllers": Option(
            dict[str, "DMPController"],  # type: ignore[name-defined]  # a key of CLASSES, as "Model" below
            {"recommended": "DMPController"},
            f"controllers {_CLASS_HELP} --controllers.help DMPController",
        ),
        "push": Option(Annotated[float, (0.0, 1e6)], 5.0, "peak of the two pushes along the first output, N"),
        "torque": Option(Annotated[float, (0.0, 1e6)], 1.2, "peak of two pushes of poses by torque, Nm"),
        "arm": Option(Literal["panda", "none"], "panda", "arm whose inertia a robot of poses has; none: a virtual one"),
        "rate": Option(Annotated[float, (1e-3, 1e6)], 1000.0, "ticks of the controller, Hz"),
    },
    "compare": {
        **_FILE,
        "models": Option(
            dict[str, "Model"],  # type: ignore[name-defined]
            MODELS,
            f"estimators {_CLASS_HELP} --models.help NAME",
        ),
        "max_folds": Option(Annotated[int, (0, math.inf)], 10, "how many demonstrations to leave out, one by one"),
        "n_jobs": Option(
            Annotated[int, (-math.inf, -1)] | _Count | None, None, "fits at the same time; -1: all cores"
        ),
        "readings": Option(
            list[Literal["bell", "printed", "bowl"]], ["bell", "printed", "bowl"], "readings of the ambiguous eq. (14)"
        ),
        "n_seeds": Option(_Count, 10, "simulations to take the median of"),
        "n_inputs": Option(_Count, 10, "inputs of the simulation"),
        "n_draws": Option(_Count, 50, "draws at each input of the simulation"),
        **_GRID,
    },
    "playground": {
        "port": Option(Annotated[int, (0, 65535)], 0, "port of this machine for the page; 0: a free one"),
        "browse": Option(bool, True, "open the page in a browser"),
    },
}  # fmt: skip


def parse(command: str, arguments: Sequence[str]) -> tuple[Namespace, str]:
    """Options of a command, and the YAML that gives them again."""
    own = OPTIONS[command]
    if command != "playground":  # which has no results
        output = Option(str, f"runs/{command}", "folder of the results")
        own = {"output": output, "resume": Option(bool, False, "go on with the finished fits in that folder")} | own
    if command == "inspect":  # whose files may stand first, as a shell writes trial_*.csv
        files = list(takewhile(lambda argument: not argument.startswith("-"), arguments))
        data = ["--data", files[0] if len(files) == 1 else json.dumps(files)] if files else []
        arguments = [*data, *arguments[len(files) :]]
    return options.parse(f"torch-pbd {command}", COMMANDS[command], own, arguments)


def playground(options: Any) -> None:
    """A page in the browser, until Ctrl-C."""
    for library in ("starlette", "uvicorn", "websockets"):
        optional(library, "playground", "playground")
    from torch_pbd.playground.server import serve

    serve(options.port, browse=options.browse)


def demo(options: Any, folder: Any) -> str:
    """The main job: made demonstrations of the tunnel task, four models, a robot that is pushed."""
    from torch_pbd.experiments.simulation import run_demo

    say(f"{options.n_demos} made demonstrations of the tunnel task; the truth is that of 300 fresh ones\n")
    compared = parse("compare", [])[0].models
    models = {name: compared[name] for name in ("HGP", "CD", "WP", "GMM 5")}
    return run_demo(models, folder, n_demos=options.n_demos, seed=options.seed)


def fit(options: Any, folder: Any) -> str:
    """One model on a file of demonstrations."""
    from torch_pbd.experiments.comparison import figure_of
    from torch_pbd.experiments.run_folder import fit_once

    demonstrations = _demonstrations(options)
    X, y, groups = demonstrations.stack(options.input)
    model, _ = fit_once(options.model, X, y, groups, finished=folder.finished)
    name = type(model).__name__
    model_path, figure_path = folder.write_fitted(name, model, figure_of(model, demonstrations, name, options.input))
    # A model of whole movements has no single optimization whose end could be told.
    if hasattr(model, "score_demonstrations"):
        learned, likelihood = {}, model.score(X, y, groups=groups)
        settled, of_what = f"learned {len(demonstrations)} movements", "joint log-likelihood"
    else:
        learned = {key: getattr(model, f"{key}_") for key in ("n_iter", "loss", "converged", "jitter")}
        likelihood, of_what = model.score(X, y), "log-likelihood"
        settled = f"{'converged' if model.converged_ else 'did not converge'} after {model.n_iter_} iterations"
    folder.write_metrics([{"model": name, **learned, "LL": likelihood}])
    return (
        f"{name} {settled}; {of_what} {likelihood:.3f} nats per sample of the data it was fitted to\n"
        f"model:   {model_path}\nfigure:  {figure_path}"
    )


def inspect(options: Any, folder: Any) -> str:
    """Description of recordings, before anything is fitted."""
    from torch_pbd.data import inspect_demonstrations
    from torch_pbd.experiments.comparison import describe, figure_of_recordings

    demonstrations, description = _loaded(options, inspect_demonstrations)
    say(f"{describe(demonstrations, _name(options.data))}\n")
    figure = folder.write_figure(figure_of_recordings(demonstrations, _name(options.data)), "recordings")
    return f"{description}\n\nfigure:  {figure}"


def experiment(options: Any, folder: Any) -> str:
    """A skill, learned and reproduced on a simulated robot that is pushed."""
    from torch_pbd.data import load_demonstrations, make_pose_demonstrations, make_tunnel_demonstrations
    from torch_pbd.experiments.comparison import describe
    from torch_pbd.experiments.robot import framework_figure, run_robot

    made, source = options.data is None, f"{options.task} task"
    if not made:
        demonstrations, source = _loaded(options, load_demonstrations), _name(options.data)
    elif options.task == "peg":  # six outputs: fewer than seven leave open how they vary together
        demonstrations = make_pose_demonstrations(options.n_demos or 8, random_state=options.seed)
    else:
        demonstrations = make_tunnel_demonstrations(
            options.n_demos or 6, random_state=options.seed, common_start=options.common_start
        )
    say(describe(demonstrations, source))
    if demonstrations.rotation_reference is None:
        turns = set(demonstrations.units or ()) in ({"rad"}, {"deg"})
        along, unit = ("Nm about", ", Nm/rad") if turns else ("N along", ", N/m")
        pushes = f"{options.push:g} {along} {demonstrations.names[0]}"
        folder.write_figure(framework_figure(), "figure5_framework")
    else:
        if options.arm == "panda":
            try:
                optional("mujoco", "robot", "a Panda")  # before anything is learned
            except ModuleNotFoundError as error:
                raise ConfigError(f"arm: {error} Or leave the arm out by --arm none.") from error
        pushes, unit = f"{options.push:g} N along and {options.torque:g} Nm about each axis of the tool", ""
    say(f"pushes of {pushes},\nat 20 % and 80 % of the movement; K is the stiffness there{unit}\n")
    sizes = {"peak": options.push, "torque": options.torque, "rate": options.rate, "arm": options.arm}
    return run_robot(options.controllers, demonstrations, folder, in_tunnel=made, **sizes)


def compare(options: Any, folder: Any) -> str:
    """Models on a file, demonstration by demonstration, or on the paper's simulation."""
    how = {"max_folds": options.max_folds, "n_jobs": options.n_jobs}
    if options.data is not None:
        from torch_pbd.experiments.comparison import run_recordings

        demonstrations = _demonstrations(options)
        if len(demonstrations) < 2:
            raise ConfigError("data: there is one demonstration; to compare models, at least two are needed.")
        models = options.models
        if len(demonstrations) == 2:
            models = _of_rows(models, "one left out leaves one, and how whole movements differ is not seen in one")
        return run_recordings(models, demonstrations, folder, options.input, **how)
    from torch_pbd.experiments.simulation import run_simulation

    models = _of_rows(options.models, "the simulation draws at each input anew: give --data FILE")
    say(f"eq. (14): {options.n_inputs} inputs x {options.n_draws} draws, medians over {options.n_seeds} seeds\n")
    sizes = {"n_seeds": options.n_seeds, "n_inputs": options.n_inputs, "n_demos": options.n_draws}
    return run_simulation(models, folder, options.readings, **sizes, **how)


WORK = {"demo": demo, "fit": fit, "inspect": inspect, "experiment": experiment, "compare": compare}


def _loaded(options: Any, load: Callable[..., Any]) -> Any:
    """Result of a loader on the files, with the options of the command line."""
    loader = {"missing": options.missing, "from_start": options.from_start, **(options.loader or {})}
    try:
        return load(options.data, **loader)
    except TypeError as error:
        raise ConfigError(f"loader: {error}") from error
    except DataFormatError as error:
        option = re.search(r"\b([a-z_]+)=", str(error))
        here = f" Here {option[1]}= is written --loader.{option[1]}." if option else ""
        raise DataFormatError(f"{error}{here}") from error


def _name(files: Sequence[Path]) -> str:
    """Origin of demonstrations, in short."""
    return files[0].name if len(files) == 1 else f"{files[0].name} to {files[-1].name}, {len(files)} files"


def _of_rows(models: dict[str, Any], why: str) -> dict[str, Any]:
    """Models but for those of whole movements, which cannot be compared."""
    kept = {name: model for name, model in models.items() if type(model).__name__ not in MOVEMENTS}
    if not kept:
        raise ConfigError(f"models: there are only such of whole movements, which cannot be compared: {why}.")
    if left := [name for name in models if name not in kept]:
        line = f"without {', '.join(left)}, as models of whole movements cannot be compared here: {why}"
        say(textwrap.fill(line, 80) + "\n")
    return kept


def _demonstrations(options: Any) -> Any:
    """Demonstrations of the files, described, checked and on one grid."""
    from torch_pbd import checks
    from torch_pbd.data import check_unimodal, load_demonstrations
    from torch_pbd.data.alignment import TIMING_REMOVED
    from torch_pbd.experiments.comparison import describe, prepare

    recorded = _loaded(options, load_demonstrations)
    say(describe(recorded, _name(options.data)))
    if len(recorded) == 1:
        checks.warn("There is one demonstration: what varies between demonstrations cannot be told from how one moves.")
    check_unimodal(recorded)
    prepared = prepare(recorded, options.align, options.n_steps)
    if prepared is not recorded:
        say(describe(prepared, f"after align={options.align}"))
    if prepared.alignment == "dtw":
        checks.warn(TIMING_REMOVED)
    say("")
    return prepared

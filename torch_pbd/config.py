"""Command lines and YAML files to objects; what cannot be used is one line that says where and why.

Importing this module, and showing help, loads neither torch nor scikit-learn.
"""

import difflib
import re
from argparse import ArgumentError
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any, Literal

import yaml
from jsonargparse import ActionConfigFile, ArgumentParser, Namespace, set_loader  # type: ignore[attr-defined]
from jsonargparse.typing import PositiveFloat, PositiveInt

from torch_pbd.exceptions import ConfigError

COMMANDS = {
    "demo": "learn from six made demonstrations of the tunnel task; the main job, no data needed",
    "fit": "fit one model to a file of demonstrations",
    "experiment": "learn a skill, reproduce it on a simulated robot and push it (Figures 5 to 8)",
    "compare": "compare models: on the paper's simulation (Table I, Figures 1 to 3), or on a file",
    "benchmark": "time fits, predictions and ticks against other libraries; ratios, bars, growth",
}
RESUMABLE = ("demo", "fit", "experiment", "compare")

_MODEL_HELP = "an estimator's name, or class_path and init_args; its options: --model.help NAME"
_MODELS = {
    "HGP": {"class_path": "HeteroscedasticGPRegressor"},
    "CD": {"class_path": "CholeskyCovRegressor"},
    "WP": {"class_path": "WishartProcessRegressor"},
    "GMM 5": {"class_path": "GMMBaseline", "init_args": {"n_components": 5}},
    "GMM 8": {"class_path": "GMMBaseline", "init_args": {"n_components": 8}},
}
GROUPS = ("imports", "fitting", "likelihood", "heteroscedastic", "prediction", "control", "growth")  # of the benchmark
_CONTROLLERS = {"recommended": {"class_path": "DMPController"}}
_Reading = Literal["bell", "printed", "bowl"]


class _StrictLoader(yaml.SafeLoader):
    """YAML without surprises: numbers like 1e-3 are numbers, and a key twice is an error."""

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        seen: set[str] = set()
        for key, _ in node.value:
            if key.value in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"the key {key.value!r} is there twice", key.start_mark
                )
            seen.add(key.value)
        return super().construct_mapping(node, deep=deep)


_StrictLoader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)[eE][-+]?[0-9]+$"),
    list("-+0123456789."),
)


def _load_yaml(text: str) -> Any:
    return yaml.load(text, _StrictLoader)


def parse(command: str, arguments: Sequence[str]) -> tuple[Namespace, str]:
    """Arguments of a command as objects, and the YAML that gives them again.

    Raises
    ------
    ConfigError
        If an argument or a key of a file cannot be used.
    SystemExit
        After ``--help`` and ``--print_config`` are answered.
    """
    set_loader("yaml", _load_yaml, exceptions=(yaml.YAMLError,))
    parser = _parser(command, only_help=any(argument in ("-h", "--help") for argument in arguments))
    try:
        values = parser.parse_args(list(arguments))
        objects = parser.instantiate(values)
        values.pop("resume", None)  # the same options begin the run and resume it
        text = parser.dump(values, skip_validation=True)
    except (ArgumentError, TypeError, ValueError, OSError) as error:
        raise ConfigError(_one_line(str(error), parser)) from error
    del objects["config"]
    return objects, text


def _parser(command: str, *, only_help: bool) -> ArgumentParser:
    parser = ArgumentParser(
        prog=f"torch-pbd {command}", description=COMMANDS[command].capitalize() + ".", exit_on_error=False
    )
    parser.add_argument("--config", action=ActionConfigFile, help="YAML file with any of these options")
    parser.add_argument("--output", type=str, default=f"runs/{command}", help="folder of the results")
    if command in RESUMABLE:
        parser.add_argument("--resume", action="store_true", help="go on from the checkpoint in the folder of results")
        parser.add_argument(
            "--checkpoint_interval", type=PositiveFloat, default=5.0, help="seconds between two checkpoints"
        )
    model_type, models_type = (Any, Any) if only_help else _model_types()
    if command == "demo":
        parser.add_argument("--n_demos", type=int, default=6, help="demonstrations to learn from, at least 3")
        parser.add_argument("--seed", type=int, default=0, help="seed of the demonstrations")
        return parser
    if command == "benchmark":
        parser.add_argument("--groups", type=str, default="all", help=f"comma-separated, of {', '.join(GROUPS)}")
        parser.add_argument("--n_repetitions", type=PositiveInt, default=5, help="of each contender")
        parser.add_argument("--quick", action="store_true", help="small sizes, once, to see that everything runs")
        return parser
    if command == "experiment":
        _add_experiment_arguments(parser, Any if only_help else _controllers_type())
    elif command == "fit":
        parser.add_argument("--data", type=str, required=True, help="file of demonstrations, .npz or .csv")
        parser.add_argument(
            "--model", type=model_type, default={"class_path": "HeteroscedasticGPRegressor"}, help=_MODEL_HELP
        )
    else:
        parser.add_argument("--data", type=str | None, default=None, help="file of demonstrations; none: simulation")
        parser.add_argument("--models", type=models_type, default=_MODELS, help="name: model, several; " + _MODEL_HELP)
        parser.add_argument("--max_folds", type=int, default=10, help="demonstrations to leave out, one by one")
        parser.add_argument("--n_jobs", type=int | None, default=None, help="fits at the same time; -1: all cores")
        _add_simulation_arguments(parser)
    if command == "experiment":
        return parser
    parser.add_argument(
        "--align",
        type=Literal["auto", "none", "phase", "dtw"],
        default="auto",
        help="auto: by phase where sampling times differ",
    )
    parser.add_argument("--input", type=Literal["time", "phase"], default="time", help="what the covariance depends on")
    parser.add_argument("--n_steps", type=int | None, default=None, help="resample to so many points")
    return parser


def _add_experiment_arguments(parser: ArgumentParser, controllers_type: Any) -> None:
    parser.add_argument(
        "--data", type=str | None, default=None, help="file of demonstrations; none: made ones of the tunnel task"
    )
    parser.add_argument("--n_demos", type=int, default=6, help="demonstrations to make")
    parser.add_argument("--seed", type=int, default=0, help="seed of the demonstrations")
    parser.add_argument("--common_start", type=bool, default=False, help="made demonstrations start at one point")
    parser.add_argument(
        "--controllers",
        type=controllers_type,
        default=_CONTROLLERS,
        help="name: DMPController with its class_path and init_args, several",
    )
    parser.add_argument("--push", type=float, default=5.0, help="peak of the two pushes along the first output, N")
    parser.add_argument("--rate", type=float, default=1000.0, help="ticks of the controller, Hz")


def _add_simulation_arguments(parser: ArgumentParser) -> None:
    parser.add_argument(
        "--readings", type=list[_Reading], default=["bell", "printed", "bowl"], help="of eq. (14), which is ambiguous"
    )
    parser.add_argument("--n_seeds", type=int, default=10, help="simulations to take the median of")
    parser.add_argument("--n_inputs", type=int, default=10, help="inputs of the simulation")
    parser.add_argument("--n_draws", type=int, default=50, help="draws at each input of the simulation")


def _model_types() -> tuple[Any, Any]:
    """Types of one model and of several by name; loads torch."""
    import torch_pbd.estimators.cholesky
    import torch_pbd.estimators.heteroscedastic
    import torch_pbd.estimators.mixture
    import torch_pbd.estimators.wishart  # noqa: F401 - short class names are those of imported classes
    from torch_pbd.estimators._base import CovarianceRegressor

    return CovarianceRegressor, dict[str, CovarianceRegressor]


def _controllers_type() -> Any:
    """Type of controllers by name; loads torch."""
    _model_types()  # the covariance of a controller is one of these
    from torch_pbd.control.controller import DMPController

    return dict[str, DMPController]


def _one_line(message: str, parser: ArgumentParser) -> str:
    """The message without jsonargparse's tree of attempts, with a suggestion for an unknown name."""
    lines = [line.strip(" -") for line in message.splitlines()]
    dull = ("Does not validate", "Subtypes:", "Errors:", "Expected a <class 'NoneType'>", "Given value")
    text = " ".join(line for line in lines if line and not line.startswith(dull))
    names = _known_names(parser)
    mentioned = re.findall(r"(?:arguments: --|[Kk]ey ['\"]|Option ['\"]|path string: )([\w.]+)", text)
    for unknown in (name.split(".")[-1] for name in mentioned):
        close = difflib.get_close_matches(unknown, names, n=1)
        if unknown not in names and close:
            return f"{text} Did you mean {close[0]!r}?"
    return text


def _known_names(parser: ArgumentParser) -> list[str]:
    import inspect

    from torch_pbd.control import DMPController, StiffnessLaw

    models, _ = _model_types()
    names = [action.dest for action in parser._actions]
    leaves = [leaf for child in models.__subclasses__() for leaf in child.__subclasses__()]
    for known in (*models.__subclasses__(), *leaves, DMPController, StiffnessLaw):
        names += [known.__name__, *inspect.signature(known).parameters]
    return names


def chosen_groups(text: str) -> list[str]:
    """Groups of the benchmark that a comma-separated list names.

    Raises
    ------
    ConfigError
        If there is no such group.
    """
    names = list(GROUPS) if text == "all" else [name.strip() for name in text.split(",")]
    for name in names:
        if name not in GROUPS:
            raise ConfigError(f"groups: there is no group {name!r}. {nearest(name, [*GROUPS, 'all'])}")
    return names


def nearest(name: str, known: Collection[str]) -> str:
    """Sentence with the known name that is meant, or all of them."""
    close = difflib.get_close_matches(name, known, n=1)
    return f"Did you mean {close[0]!r}?" if close else f"Known are {', '.join(known)}."


def existing_file(path: str) -> Path:
    """Path of a file that is there.

    Raises
    ------
    ConfigError
        If it is not.
    """
    if not Path(path).is_file():
        raise ConfigError(f"data: there is no file {path!r}; give one with --data FILE.")
    return Path(path)

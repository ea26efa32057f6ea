"""Command lines and YAML files to objects; what cannot be used is one line that says where and why.

Importing this module, and showing help, loads neither torch nor scikit-learn.
"""

import difflib
from argparse import Namespace
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any, Literal

import yaml
from jsonargparse import ActionConfigFile, ArgumentParser  # type: ignore[attr-defined]
from jsonargparse.typing import NonNegativeInt, PositiveFloat, PositiveInt, restricted_number_type

from torch_pbd.cli.options import Option, Options
from torch_pbd.console import say
from torch_pbd.exceptions import ConfigError

COMMANDS = {
    "demo": "learn from six made demonstrations of the tunnel task; the main job, no data needed",
    "fit": "fit one model to a file of demonstrations",
    "experiment": "learn a skill, reproduce it on a simulated robot and push it (Figures 5 to 8)",
    "compare": "compare models: on the paper's simulation (Table I, Figures 1 to 3), or on a file",
}

_MODEL_HELP = "an estimator's name, or class_path and init_args; its options: --model.help NAME"
_MODELS = {
    "HGP": {"class_path": "HeteroscedasticGPRegressor"},
    "CD": {"class_path": "CholeskyCovRegressor"},
    "WP": {"class_path": "WishartProcessRegressor"},
    "GMM 5": {"class_path": "GMMBaseline", "init_args": {"n_components": 5}},
    "GMM 8": {"class_path": "GMMBaseline", "init_args": {"n_components": 8}},
}
_CONTROLLERS = {"recommended": {"class_path": "DMPController"}}
_Seed: Any = restricted_number_type(
    "IntFrom0To4294967294", int, [(">=", 0), ("<=", 2**32 - 2)]
)  # the next one is a seed too
_NonzeroInt: Any = restricted_number_type("NonzeroInt", int, ("!=", 0))
_OF_MODELS = ("fit", "experiment", "compare")
_Reading = Literal["bell", "printed", "bowl"]


class _Parser(ArgumentParser):
    """jsonargparse's parser, which shows help; values are held to the types of its options by `Options`."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.options: dict[str, Option] = {}
        super().__init__(*args, **kwargs)

    def add_argument(self, *args: Any, **kwargs: Any) -> Any:
        """Add an option, and remember what it takes."""
        name = str(args[0]).removeprefix("--")
        if kwargs.get("action") == "store_true":
            self.options[name] = Option(bool, False, is_flag=True)
        elif "action" not in kwargs:
            self.options[name] = Option(kwargs["type"], kwargs.get("default"), kwargs.get("required", False))
        return super().add_argument(*args, **kwargs)


def parse(command: str, arguments: Sequence[str]) -> tuple[Namespace, str]:
    """Arguments of a command as objects, and the YAML that gives them again.

    Raises
    ------
    ConfigError
        If an argument or a key of a file cannot be used.
    SystemExit
        After ``--help`` and ``--print_config`` are answered.
    """
    if any(argument in ("-h", "--help") for argument in arguments):
        say(_parser(command, only_help=True).format_help().rstrip())
        raise SystemExit(0)
    parser = _parser(command, only_help=False)
    options = Options(parser.options, _classes() if command in _OF_MODELS else {})
    options.read(arguments)
    if options.help_for is not None:
        say(_class_help(*options.help_for).rstrip())
        raise SystemExit(0)
    if options.print_flags is not None:
        shown = options.given() if "skip_default" in options.print_flags else options.complete()
        say(_as_yaml(_without_nulls(shown) if "skip_unset" in options.print_flags else shown).rstrip())
        raise SystemExit(0)
    if (name := options.missing()) is not None:
        raise ConfigError(f"{name} is missing: give --{name}, or {name}: in a file named by --config.")
    # The same options begin a run and resume it.
    written = {name: value for name, value in options.complete().items() if name != "resume"}
    return Namespace(**options.objects()), _as_yaml(written)


def _as_yaml(values: dict[str, Any]) -> str:
    return yaml.safe_dump(values, allow_unicode=True, sort_keys=False, default_flow_style=False)


def _without_nulls(value: Any) -> Any:
    return {k: _without_nulls(v) for k, v in value.items() if v is not None} if isinstance(value, dict) else value


def _class_help(known: type, key: str) -> str:
    parser = ArgumentParser(prog="torch-pbd COMMAND", usage=f"options of {known.__name__}", add_help=False)
    parser.add_class_arguments(known, key, as_group=False)
    return parser.format_help()


def _parser(command: str, *, only_help: bool) -> _Parser:
    parser = _Parser(prog=f"torch-pbd {command}", description=COMMANDS[command].capitalize() + ".", exit_on_error=False)
    parser.add_argument("--config", action=ActionConfigFile, help="YAML file with any of these options")
    parser.add_argument("--output", type=str, default=f"runs/{command}", help="folder of the results")
    parser.add_argument("--resume", action="store_true", help="go on with the finished fits in the folder of results")
    model_type, models_type = (Any, Any) if only_help else _model_types()
    if command == "demo":
        parser.add_argument("--n_demos", type=PositiveInt, default=6, help="demonstrations to learn from, at least 3")
        parser.add_argument("--seed", type=_Seed, default=0, help="seed of the demonstrations")
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
        parser.add_argument(
            "--max_folds", type=NonNegativeInt, default=10, help="demonstrations to leave out, one by one"
        )
        parser.add_argument(
            "--n_jobs", type=_NonzeroInt | None, default=None, help="fits at the same time; -1: all cores"
        )
        _add_simulation_arguments(parser)
    _add_loader_arguments(parser)
    if command == "experiment":
        return parser
    parser.add_argument(
        "--align",
        type=Literal["auto", "none", "phase", "dtw"],
        default="auto",
        help="auto: by phase where sampling times differ",
    )
    parser.add_argument("--input", type=Literal["time", "phase"], default="time", help="what the covariance depends on")
    parser.add_argument("--n_steps", type=PositiveInt | None, default=None, help="resample to so many points")
    return parser


def _add_loader_arguments(parser: ArgumentParser) -> None:
    parser.add_argument(
        "--missing", type=Literal["raise", "drop"], default="raise", help="of the file's samples: refuse, or leave out"
    )
    parser.add_argument(
        "--from_start", type=bool, default=False, help="count the times of each of the file's demonstrations from 0"
    )


def _add_experiment_arguments(parser: ArgumentParser, controllers_type: Any) -> None:
    parser.add_argument(
        "--data", type=str | None, default=None, help="file of demonstrations; none: made ones of the tunnel task"
    )
    parser.add_argument("--n_demos", type=PositiveInt, default=6, help="demonstrations to make")
    parser.add_argument("--seed", type=_Seed, default=0, help="seed of the demonstrations")
    parser.add_argument("--common_start", type=bool, default=False, help="made demonstrations start at one point")
    parser.add_argument(
        "--controllers",
        type=controllers_type,
        default=_CONTROLLERS,
        help="name: DMPController with its class_path and init_args, several",
    )
    parser.add_argument("--push", type=float, default=5.0, help="peak of the two pushes along the first output, N")
    parser.add_argument("--rate", type=PositiveFloat, default=1000.0, help="ticks of the controller, Hz")


def _add_simulation_arguments(parser: ArgumentParser) -> None:
    parser.add_argument(
        "--readings", type=list[_Reading], default=["bell", "printed", "bowl"], help="of eq. (14), which is ambiguous"
    )
    parser.add_argument("--n_seeds", type=PositiveInt, default=10, help="simulations to take the median of")
    parser.add_argument("--n_inputs", type=PositiveInt, default=10, help="inputs of the simulation")
    parser.add_argument("--n_draws", type=PositiveInt, default=50, help="draws at each input of the simulation")


def _model_types() -> tuple[Any, Any]:
    """Types of one model and of several by name; loads torch."""
    import torch_pbd.estimators.cholesky
    import torch_pbd.estimators.heteroscedastic
    import torch_pbd.estimators.mixture
    import torch_pbd.estimators.wishart  # noqa: F401 - short class names are those of imported classes
    from torch_pbd.estimators.base import CovarianceRegressor

    return CovarianceRegressor, dict[str, CovarianceRegressor]


def _controllers_type() -> Any:
    """Type of controllers by name; loads torch."""
    _model_types()  # the covariance of a controller is one of these
    from torch_pbd.control.controller import DMPController

    return dict[str, DMPController]


def _classes() -> dict[type, dict[str, type]]:
    """The closed table: the classes that a configuration can name, by the type they are asked for as."""
    from torch_pbd.control.controller import DMPController
    from torch_pbd.control.stiffness import StiffnessLaw
    from torch_pbd.estimators.cholesky import CholeskyCovRegressor
    from torch_pbd.estimators.heteroscedastic import HeteroscedasticGPRegressor
    from torch_pbd.estimators.mixture import GMMBaseline
    from torch_pbd.estimators.wishart import WishartProcessRegressor

    models = (HeteroscedasticGPRegressor, CholeskyCovRegressor, WishartProcessRegressor, GMMBaseline)
    tables = {_model_types()[0]: models, DMPController: (DMPController,), StiffnessLaw: (StiffnessLaw,)}
    return {base: {known.__name__: known for known in table} for base, table in tables.items()}


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

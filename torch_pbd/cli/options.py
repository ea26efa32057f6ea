"""Options from a command line and the YAML files that it names: each held to its type, and the later one wins.

Classes are named, by ``class_path`` and ``init_args`` or by a name alone, from one closed table. Torch is loaded only
where a class is given parameters, or built.
"""

import inspect
import textwrap
from argparse import Namespace
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from typing import Any, NamedTuple, NoReturn, get_args, get_origin, get_type_hints

import yaml

from torch_pbd.cli.values import (
    Place,
    alternatives,
    described,
    is_of,
    read_yaml,
    read_yaml_file,
    remedy,
    shown,
    unknown,
    visible,
)
from torch_pbd.console import say
from torch_pbd.exceptions import ConfigError
from torch_pbd.registry import ESTIMATORS, MOVEMENTS, REGRESSORS

CLASSES: Mapping[str, Mapping[str, str]] = {
    "CovarianceRegressor": REGRESSORS,
    "MovementRegressor": MOVEMENTS,
    "Model": {**REGRESSORS, **MOVEMENTS},
    "DMPController": {"DMPController": ESTIMATORS["DMPController"]},
    "StiffnessLaw": {"StiffnessLaw": "torch_pbd.control.stiffness"},
    "RotationLimits": {"RotationLimits": "torch_pbd.control.stiffness"},
}
"""The closed table: the classes that a value of a type can be of, and their modules. No other is ever imported."""

MODELS = {
    "HGP": "HeteroscedasticGPRegressor",
    "Trajectory": "TrajectoryRegressor",
    "CD": "CholeskyCovRegressor",
    "WP": "WishartProcessRegressor",
    "GMM 5": {"class_path": "GMMBaseline", "init_args": {"n_components": 5}},
    "GMM 8": {"class_path": "GMMBaseline", "init_args": {"n_components": 8}},
}
"""Models by the names that tables print: those that are compared by default, and what options take as well as a class.

A mixture has as many components as in the paper's Table I. Models of whole movements are compared on files alone."""

_MODULES = {name: module for known in CLASSES.values() for name, module in known.items()}
_CLASS_KEYS = ("class_path", "init_args")
_HELP_WIDTH = 80  # width of default terminals


class Option(NamedTuple):
    """Type of an option, its default as it would stand in a file, and one line on what it is for.

    A number within bounds is ``Annotated[int, (least, most)]``; a class is named by a key of :data:`CLASSES`.
    """

    type: Any
    default: Any
    help: str
    required: bool = False


def parse(usage: str, about: str, options: Mapping[str, Option], arguments: Sequence[str]) -> tuple[Namespace, str]:
    """Values of a command line as objects, and the YAML that gives them again.

    Raises ConfigError if an argument or a key of a file cannot be used, and SystemExit once ``--help``,
    ``--NAME.help CLASS`` or ``--print_config`` is answered.
    """
    if {"-h", "--help"} & set(arguments):
        _answer(_help(usage, about, options))
    asked = [argument for argument in arguments if argument.partition("=")[0] == "--print_config"]
    for flag in asked:
        if flag not in ("--print_config", "--print_config=skip_default"):
            raise ConfigError(f"{flag} {unknown(flag.partition('=')[2], ['skip_default'], 'a flag of it')}")
    defaults = {
        name: option.default and _take(option.default, option.type, Place()) for name, option in options.items()
    }
    values = dict(defaults)
    for place, name, value in _given([argument for argument in arguments if argument not in asked], options):
        if name not in options:
            raise place.error(unknown(name, options, "an option of this command"))
        values[name] = _take(value, options[name].type, place, values[name])
    if asked[-1:] == ["--print_config=skip_default"]:
        _answer(_as_yaml(_plain({name: value for name, value in values.items() if value != defaults[name]})))
    complete = _plain(values, complete=True)
    if asked:
        _answer(_as_yaml(complete))
    for name, option in options.items():
        if option.required and values[name] is None:
            raise ConfigError(f"{name} is missing: give --{name}, or {name}: in a file named by --config.")
    complete.pop("resume", None)  # the same options begin a run and resume it
    return Namespace(**{name: _build(value, name) for name, value in values.items()}), _as_yaml(complete)


def _answer(text: str) -> NoReturn:
    say(text.rstrip())
    raise SystemExit(0)


def _as_yaml(values: dict[str, Any]) -> str:
    return str(yaml.safe_dump(values, allow_unicode=True, sort_keys=False, default_flow_style=False))


def _help(usage: str, about: str, options: Mapping[str, Option]) -> str:
    lines = [f"usage: {usage} [--config FILE] [--option VALUE ...]", "", f"{about[0].upper()}{about[1:]}.", ""]
    width = max(map(len, options))
    for name, option in options.items():
        default = ", ".join(option.default) if isinstance(option.default, dict | list) else option.default
        kind = f"{described(option.type)}; {'required' if option.required else f'default {default}'}"
        text = f"  --{name:<{width}}  {option.help} ({kind})"
        lines += textwrap.wrap(text, _HELP_WIDTH, subsequent_indent=" " * (width + 6))
    return "\n".join([*lines, "", "--config FILE: YAML of any of these, as --print_config shows them all."])


def _class_help(text: str, place: Place) -> str:
    """Parameters of a class, and what its docstring says of them."""
    spec = _take_class(text, _MODULES, place, None)
    lines = [f"  {name}: {described(hint)}; default {default}" for name, (hint, default) in spec.parameters().items()]
    return "\n".join([f"parameters of {spec.name}:", *lines, "", inspect.getdoc(spec.load()) or ""])


@dataclass(frozen=True)
class _Spec:
    """An object yet to be made: its class and the parameters given."""

    name: str
    init_args: dict[str, Any]

    def load(self) -> Any:
        return getattr(import_module(_MODULES[self.name]), self.name)

    def parameters(self) -> dict[str, tuple[Any, Any]]:
        """Type and default of each parameter of the class."""
        known = self.load()
        hints = get_type_hints(known.__init__)
        return {name: (hints[name], p.default) for name, p in inspect.signature(known).parameters.items()}


class _Text(str):
    """Value of the command line, which its type says how to read."""

    __slots__ = ()


class _Dotted(dict[str, Any]):
    """Entry named by a dotted option: it is changed, and the others beside it stay."""


def _given(arguments: Sequence[str], options: Mapping[str, Option]) -> Iterator[tuple[Place, str, Any]]:
    """Place, option and value of ``--name value``, ``--name=value``, ``--name.key value``, and of entries of files."""
    rest = list(arguments)
    while rest:
        argument = rest.pop(0)
        if not argument.startswith("--") or argument == "--":
            raise ConfigError(f"there is {argument!r} where an option should stand: options begin with --.")
        dotted, has_value, text = argument[2:].partition("=")
        name, *keys = dotted.split(".")
        place = Place(keys=(f"--{name}",))
        if not has_value and rest and not rest[0].startswith("--"):
            has_value, text = "=", _next_value(rest)
        if has_value and dotted == "config":
            document = read_yaml_file(text)
            for key, value in document.content.items():
                yield Place(visible(text), (key,), document.lines), key, value
        elif has_value and keys[-1:] == ["help"] and name in options:
            _answer(_class_help(text, Place(keys=(f"--{dotted}",))))
        elif has_value:
            value = _Text(text)
            for key in reversed(keys):
                value = _Dotted({key: value})
            yield place, name, value
        elif dotted == "config" or (name in options and options[name].type is not bool):
            raise ConfigError(f"--{dotted} has no value: write --{dotted} VALUE.")
        else:
            yield place, name, True


def _next_value(rest: list[str]) -> str:
    """Next argument; a list that the shell took apart, as [x, y] without quotes, is one."""
    text = rest.pop(0)
    while text.startswith("[") and not text.endswith("]") and any(argument.endswith("]") for argument in rest):
        text = f"{text} {rest.pop(0)}"
    return text


def _take(value: Any, hint: Any, place: Place, before: Any = None) -> Any:
    """Value as its type has it; ``before`` is what it adds to, where a class is changed in part."""
    if isinstance(value, _Text):
        value = _read_text(value, hint, place)
    names = (part if isinstance(part, str) else getattr(part, "__name__", "") for part in alternatives(hint))
    table = dict(entry for name in names for entry in CLASSES.get(name, {}).items())
    if table and value is not None:
        return _take_class(value, table, place, before)
    for part in alternatives(hint):
        if get_origin(part) is dict and isinstance(value, dict) and value:
            # A dotted option changes one entry of a mapping; a mapping given whole replaces it.
            kept = (before or {}) if isinstance(value, _Dotted) else {}
            inner = get_args(part)[1]
            return kept | {key: _take(v, inner, place.below(key), kept.get(key)) for key, v in value.items()}
        if get_origin(part) is list and isinstance(value, list) and value:
            return [_take(entry, get_args(part)[0], place.below(i)) for i, entry in enumerate(value)]
    if value in ([], {}):
        raise place.error(f"is empty, must be {described(hint)}.")
    for part in sorted(alternatives(hint), key=lambda part: part is float):  # a whole number stays one where it may
        if is_of(value, part):
            return float(value) if part is float or get_args(part)[:1] == (float,) else value
    raise place.error(f"is {shown(value)}, must be {described(hint)}{remedy(value, hint)}")


def _read_text(text: str, hint: Any, place: Place) -> Any:
    """Text of the command line read as YAML, or left as it is where its type takes any text."""
    parts = alternatives(hint)
    if str in parts and not (text.startswith("[") and any(get_origin(part) is list for part in parts)):
        with suppress(ConfigError):
            value = read_yaml(text, "").content
            if any(is_of(value, part) for part in parts if part is not str):
                return value
        return str(text)
    if hint is Any and len(text) == 1 and not text.isalnum():
        return str(text)  # a mark, as the decimal one of a file, of which some mean something in YAML
    return read_yaml(text, ".".join(map(str, place.keys))).content


def _find_class(name: Any, table: Mapping[str, str], place: Place) -> str:
    """Name of a class of the table, which may have the name of its module before it."""
    short = name.rsplit(".", 1)[-1] if isinstance(name, str) else ""
    if short not in table or name not in (short, f"torch_pbd.{short}", f"{table[short]}.{short}"):
        raise place.error(f"== {name!r:.80} {unknown(short, table, 'a class that can be used here')}")
    return short


def _take_class(value: Any, table: Mapping[str, str], place: Place, before: _Spec | None) -> _Spec:
    inside, only = place.below("init_args"), next(iter(table)) if len(table) == 1 else None
    if isinstance(value, str):
        value = MODELS.get(value, value)
    if isinstance(value, str):
        name, value = _find_class(value, table, place), {}
    elif not isinstance(value, dict):
        raise place.error(f"is {shown(value)}, must be a mapping of class_path and init_args.")
    elif "class_path" in value:
        name = _find_class(value["class_path"], table, place.below("class_path"))
    elif before or only:
        name = before.name if before else str(only)
        # Where one class alone can stand its name may be left out, and so may init_args.
        if "init_args" not in value and (only or isinstance(value, _Dotted)):
            value, inside = {"init_args": value}, place
    else:
        raise place.error(f"has no class_path, must be one of {', '.join(table)}.")
    for key in set(value).difference(_CLASS_KEYS):
        raise place.below(key).error(unknown(key, _CLASS_KEYS, "a key here; parameters stand below init_args"))
    # Parameters that were given before stay, unless the class is another.
    spec = _Spec(name, dict(before.init_args) if before and before.name == name else {})
    given = value.get("init_args")
    given = read_yaml(given, "init_args").content if isinstance(given, _Text) else given
    if not isinstance(given, dict | None):
        raise inside.error(f"is {shown(given)}, must be a mapping: one 'name: value' a line.")
    for key, entry in (given or {}).items():
        known = spec.parameters()
        if key not in known:
            raise inside.below(key).error(unknown(key, known, f"a parameter of {name}"))
        spec.init_args[key] = _take(entry, known[key][0], inside.below(key), spec.init_args.get(key))
    return spec


def _plain(value: Any, *, complete: bool = False) -> Any:
    """Value as a file would have it, with all parameters of its classes or with those that were given."""
    if isinstance(value, _Spec):
        defaults = {name: default for name, (_, default) in value.parameters().items()} if complete else {}
        init_args = _plain(defaults | value.init_args, complete=complete)
        return {"class_path": f"torch_pbd.{value.name}", "init_args": init_args}
    if isinstance(value, dict):
        return {key: _plain(entry, complete=complete) for key, entry in value.items()}
    return value


def _build(value: Any, name: str) -> Any:
    """Value with objects in the place of their classes and parameters."""
    if isinstance(value, _Spec):
        try:
            return value.load()(**_build(value.init_args, name))
        except (TypeError, ValueError) as error:
            raise error if isinstance(error, ConfigError) else ConfigError(f"{name}: {error}") from error
    return {key: _build(entry, f"{name}.{key}") for key, entry in value.items()} if isinstance(value, dict) else value

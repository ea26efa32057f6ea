"""Options from a command line and the YAML files that it names, each held to its type; the later one wins."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, get_origin

from torch_pbd.cli.values import Classes, Place, Types, alternatives, find_class, unknown
from torch_pbd.cli.words import shown, visible
from torch_pbd.cli.yaml import read_yaml, read_yaml_file
from torch_pbd.exceptions import ConfigError

_PRINT_FLAGS = ("skip_default", "skip_unset")


class Option(NamedTuple):
    """What an option takes, its default as it would stand in a file, and how it is given."""

    type: Any
    default: Any
    required: bool = False
    is_flag: bool = False


class Options:
    """Values of the options of a command, from the defaults to the last argument.

    Parameters
    ----------
    options : mapping
        The options there are, by name.
    classes : mapping
        The classes there are, by the type that they are asked for as.
    """

    def __init__(self, options: Mapping[str, Option], classes: Classes) -> None:
        self.types = Types(classes)
        self.print_flags: list[str] | None = None
        self.help_for: tuple[type, str] | None = None
        self._options = options
        self._defaults = {name: self._default(name, option) for name, option in options.items()}
        self.values: dict[str, Any] = dict(self._defaults)

    def read(self, arguments: Sequence[str]) -> None:
        """Take ``--name value``, ``--name=value``, ``--name.key value`` and ``--config FILE``, one after another.

        Raises
        ------
        ConfigError
            If one of them, or an entry of a file, cannot be used.
        """
        rest = list(arguments)
        while rest:
            argument = rest.pop(0)
            if not argument.startswith("--") or argument == "--":
                raise ConfigError(f"there is {argument!r} where an option should stand: options begin with --.")
            name, equals, text = argument[2:].partition("=")
            if name == "print_config":
                self._print(text)
            elif not equals and self._needs_no_value(name):
                self.values[name] = True
            else:
                if not equals:
                    if not rest or rest[0].startswith("--"):
                        raise ConfigError(f"--{name} {self._without_value(name)}")
                    text = rest.pop(0)
                self._set(name, text)

    def missing(self) -> str | None:
        """Name of an option that must be given and is not."""
        return next((name for name, o in self._options.items() if o.required and self.values[name] is None), None)

    def complete(self) -> dict[str, Any]:
        """All values as they would stand in a file, those of classes with all their parameters."""
        complete: dict[str, Any] = self.types.complete(self.values)
        return complete

    def given(self) -> dict[str, Any]:
        """Those values that are not the default, and of classes only the parameters given."""
        return {name: self.types.plain(value) for name, value in self.values.items() if value != self._defaults[name]}

    def objects(self) -> dict[str, Any]:
        """All values, with objects where a class is meant.

        Raises
        ------
        ConfigError
            If a constructor refuses its parameters.
        """
        return {name: self.types.build(value, name) for name, value in self.values.items()}

    def _default(self, name: str, option: Option) -> Any:
        if option.default is None:
            return None
        return self.types.take(option.default, option.type, Place(f"the default of {name}", {}))

    def _needs_no_value(self, name: str) -> bool:
        return name in self._options and self._options[name].is_flag

    def _without_value(self, name: str) -> str:
        if name.split(".")[0].rstrip("+") not in (*self._options, "config"):
            return self._unknown(name)
        example = " true" if name in self._options and self._options[name].type is bool else " VALUE"
        return f"has no value: write --{name}{example}."

    def _unknown(self, name: str) -> str:
        return unknown(name.split(".")[0], [*self._options], "an option of this command")

    def _print(self, flags: str) -> None:
        self.print_flags = [flag for flag in flags.split(",") if flag]
        for flag in self.print_flags:
            if flag not in _PRINT_FLAGS:
                raise ConfigError(f"--print_config={flag} {unknown(flag, _PRINT_FLAGS, 'a flag of it')}")

    def _set(self, name: str, text: str) -> None:
        if name == "config":
            self._read_file(text)
            return
        place = Place(f"--{name}", {})
        first, *keys = name.split(".")
        adds = first.endswith("+") and not keys
        first = first.removesuffix("+") if adds else first
        if first not in self._options:
            raise place.error(self._unknown(name))
        hint, before = self._options[first].type, self.values[first]
        if keys and keys[-1] == "help":
            self._help(first, keys[:-1], text, place)
        elif adds:
            self.values[first] = self._entries(before, text, hint, place)
        else:
            value = self.types.put(keys, lambda part: _value(text, part, place), hint, place, before)
            self.values[first] = _finite(value, place)

    def _entries(self, before: Any, text: str, hint: Any, place: Place) -> list[Any]:
        if not isinstance(before, list):
            raise place.error("cannot be added to: it is no list.")
        value = _value(text, hint, place)
        return [*before, *self.types.take(value if isinstance(value, list) else [value], hint, place)]

    def _help(self, name: str, keys: Sequence[str], text: str, place: Place) -> None:
        table = self.types.named(self._options[name].type)
        for key in keys:
            for known in table.values():
                if key in self.types.parameters(known):
                    table = self.types.named(self.types.parameters(known)[key][0])
                    break
        if not table:
            raise place.error("is there for classes only.")
        if get_origin(self._options[name].type) is dict and not keys:
            keys = ["NAME"]
        self.help_for = find_class(text, table, place), ".".join([name, *keys])

    def _read_file(self, path: str) -> None:
        document = read_yaml_file(path)
        root = Place(visible(path), document.lines)
        for name, value in document.content.items():
            place = root.below(name)
            if name == "config":
                raise place.error("cannot stand in a file: name each file by its own --config.")
            if name not in self._options:
                raise place.error(self._unknown(name))
            option = self._options[name]
            if value is None and option.default is None:
                self.values[name] = None
            else:
                taken = self.types.take(value, option.type, place, self.values[name])
                self.values[name] = _finite(taken, place)


def _finite(value: Any, place: Place) -> Any:
    """The value, which must be no infinite number; a parameter of a class may be one."""
    if isinstance(value, float) and math.isinf(value):
        raise place.error(f"is {shown(value)}, must be a finite number.")
    return value


def _value(text: str, hint: Any, place: Place) -> Any:
    """A text of the command line read as YAML, or left as it is where its type takes any text."""
    parts = alternatives(hint)
    if parts == (str,):
        return text
    try:
        value = read_yaml(text, place.source).content
    except ConfigError:
        if str in parts and not (text.startswith("[") and any(get_origin(part) is list for part in parts)):
            return text
        raise
    return text if str in parts and not any(_is_of(value, part) for part in parts) else value


def _is_of(value: Any, part: Any) -> bool:
    """Whether a value is of the kind of a type: a list for one of lists, a whole number for a float too."""
    return value is None or type(value) in (part, get_origin(part)) or (part is float and type(value) is int)

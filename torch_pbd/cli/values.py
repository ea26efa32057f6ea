"""Plain values held to the types of options and of constructors; objects made of classes from a closed table."""

import difflib
import inspect
import math
import types
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from torch_pbd.cli.words import NONE, described, remedy, shown, visible
from torch_pbd.cli.yaml import Keys
from torch_pbd.exceptions import ConfigError

Classes = Mapping[type, Mapping[str, type]]
"""For each type that a class is asked for as: the classes there are, by name."""


@dataclass(frozen=True)
class Place:
    """Where a value stands: a file or an option, the keys below it, and the line of each."""

    source: str
    lines: Mapping[Keys, int]
    keys: Keys = ()

    def below(self, *keys: str | int) -> "Place":
        """The place of an entry of this value."""
        return Place(self.source, self.lines, self.keys + keys)

    def error(self, problem: str) -> ConfigError:
        """What is wrong here, with file, line and keys."""
        lines = [self.lines[self.keys[:n]] for n in range(len(self.keys) + 1) if self.keys[:n] in self.lines]
        where = f"{self.source}, line {lines[-1]}" if lines else self.source
        path = ".".join(visible(str(key)) for key in self.keys)
        return ConfigError(f"{where}: {path} {problem}" if path else f"{where} {problem}")


def unknown(name: str, names: Sequence[str], what: str) -> str:
    """Says that a name is not known, with the nearest one that is."""
    close = difflib.get_close_matches(name, names, n=1, cutoff=0.5)
    meant = f"Did you mean {close[0]!r}?" if close else f"Known are {', '.join(names) or 'none'}."
    return f"is not {what}. {meant}"


def find_class(name: Any, table: Mapping[str, type], place: Place) -> type:
    """The class of this name, which may have the name of its module before it.

    Raises
    ------
    ConfigError
        If the table has no such class; the name is not looked up anywhere else.
    """
    if not isinstance(name, str):
        raise place.error(f"is {shown(name)}, must be one of {', '.join(table)}.")
    short = name.rsplit(".", 1)[-1]
    known = table.get(short)
    if known is None or name not in (short, f"torch_pbd.{short}", f"{known.__module__}.{short}"):
        raise place.error(f"== {name!r:.80} {unknown(short, list(table), 'a class that can be used here')}")
    return known


class Types:
    """Values held to types, of which a class means a mapping of ``class_path`` and ``init_args``.

    Parameters
    ----------
    classes : mapping
        The classes there are. No other is ever looked up, let alone imported.
    """

    def __init__(self, classes: Classes) -> None:
        self.classes = classes

    def parameters(self, known: type) -> dict[str, tuple[Any, Any]]:
        """Type and default of each parameter of a class."""
        hints = get_type_hints(known.__init__)
        return {name: (hints[name], p.default) for name, p in inspect.signature(known).parameters.items()}

    def named(self, hint: Any) -> dict[str, type]:
        """The classes that a value of this type, or an entry of it, can be of, by name."""
        parts = [inner for part in alternatives(hint) for inner in (part, *get_args(part))]
        return {n: k for part in parts if isinstance(part, type) for n, k in self.classes.get(part, {}).items()}

    def take(self, value: Any, hint: Any, place: Place, before: Any = None) -> Any:
        """The value as its type has it; ``before`` is what it adds to, where a class is changed in part.

        Raises
        ------
        ConfigError
            If it is not of the type.
        """
        for part in alternatives(hint):
            if part in self.classes and value is not None:
                return self._take_class(value, part, place, before)
            if get_origin(part) is dict and isinstance(value, dict):
                if not value:
                    raise place.error(f"is empty; it must be {described(hint)}.")
                return {key: self.take(entry, get_args(part)[1], place.below(key)) for key, entry in value.items()}
            if get_origin(part) is list and isinstance(value, list):
                if not value:
                    raise place.error(f"is empty; it must be {described(hint)}.")
                return [self.take(entry, get_args(part)[0], place.below(i)) for i, entry in enumerate(value)]
        return _scalar(value, hint, place)

    def put(self, keys: Sequence[str], read: Callable[[Any], Any], hint: Any, place: Place, before: Any) -> Any:
        """The value ``before`` with one entry, found by its keys, taken anew from ``read(its type)``."""
        if not keys:
            return self.take(read(hint), hint, place, before)
        key, *rest = keys
        for part in alternatives(hint):
            if get_origin(part) is dict:
                old = before or {}
                return {**old, key: self.put(rest, read, get_args(part)[1], place, old.get(key))}
            if part in self.classes:
                return self._put_in_class(keys, read, part, place, before)
        raise place.error(f"has no options of its own, so no {key!r}.")

    def complete(self, value: Any) -> Any:
        """The value as a file would have it, with all parameters of its classes."""
        return _plain(value, lambda known: {name: default for name, (_, default) in self.parameters(known).items()})

    def plain(self, value: Any) -> Any:
        """The value as a file would have it, with the parameters that were given."""
        return _plain(value, lambda known: {})

    def build(self, value: Any, name: str) -> Any:
        """The value with objects in the place of their classes and parameters.

        Raises
        ------
        ConfigError
            If a constructor refuses its parameters.
        """
        if isinstance(value, _Spec):
            arguments = {key: self.build(entry, f"{name}.{key}") for key, entry in value.init_args.items()}
            try:
                return value.known(**arguments)
            except (TypeError, ValueError) as error:
                raise ConfigError(f"{name}: {error}") from error
        if isinstance(value, dict):
            return {key: self.build(entry, f"{name}.{key}") for key, entry in value.items()}
        return value

    def _take_class(self, value: Any, base: type, place: Place, before: "_Spec | None") -> "_Spec":
        only = len(self.classes[base]) == 1
        if isinstance(value, str):
            known = find_class(value, self.classes[base], place)
            return before if before and before.known is known else _Spec(known, {})
        if not isinstance(value, dict):
            raise place.error(f"is {shown(value)}, must be {described(base)}.")
        named = {"class_path", "init_args"} & set(value)
        if only and not named:
            value = {"init_args": value}
        for key in value:
            if key not in ("class_path", "init_args"):
                hint = unknown(key, ("class_path", "init_args"), "a key here; parameters stand below init_args")
                raise place.below(key).error(hint)
        known = self._class_of(value, base, place, before)
        given = value.get("init_args")
        if given is not None and not isinstance(given, dict):
            raise place.below("init_args").error(f"is {shown(given)}, must be a mapping: one 'name: value' a line.")
        init_args = dict(before.init_args) if before and before.known is known else {}
        inside = place.below("init_args") if named else place
        for name, entry in (given or {}).items():
            hint = self._parameter(known, name, inside.below(name))
            init_args[name] = self.take(entry, hint, inside.below(name), init_args.get(name))
        return _Spec(known, init_args)

    def _class_of(self, value: dict[str, Any], base: type, place: Place, before: "_Spec | None") -> type:
        table = self.classes[base]
        if "class_path" not in value:
            if before is not None:
                return before.known
            if len(table) == 1:
                return next(iter(table.values()))
            raise place.error(f"has no class_path; it must be one of {', '.join(table)}.")
        return find_class(value["class_path"], table, place.below("class_path"))

    def _put_in_class(
        self, keys: Sequence[str], read: Callable[[Any], Any], base: type, place: Place, before: "_Spec | None"
    ) -> "_Spec":
        key, *rest = keys
        if key == "class_path" and not rest:
            return self._take_class(read(str), base, place, before)
        if key == "init_args" and not rest:
            return self._take_class({"init_args": read(dict)}, base, place, before)
        if key == "init_args":
            key, *rest = rest
        known = self._class_of({}, base, place, before)
        init_args = dict(before.init_args) if before else {}
        hint = self._parameter(known, key, place)
        init_args[key] = self.put(rest, read, hint, place, init_args.get(key))
        return _Spec(known, init_args)

    def _parameter(self, known: type, name: str, place: Place) -> Any:
        parameters = self.parameters(known)
        if name not in parameters:
            raise place.error(unknown(name, list(parameters), f"a parameter of {known.__name__}"))
        return parameters[name][0]


@dataclass(frozen=True)
class _Spec:
    """An object yet to be made: its class, and the parameters given."""

    known: type
    init_args: dict[str, Any]


def _plain(value: Any, defaults: Callable[[type], dict[str, Any]]) -> Any:
    if isinstance(value, _Spec):
        init_args = {name: _plain(v, defaults) for name, v in (defaults(value.known) | value.init_args).items()}
        return {"class_path": f"torch_pbd.{value.known.__name__}", "init_args": init_args}
    if isinstance(value, dict):
        return {key: _plain(entry, defaults) for key, entry in value.items()}
    return value


def alternatives(hint: Any) -> tuple[Any, ...]:
    """The types of a union, or the one type that it is."""
    if get_origin(hint) in (Union, types.UnionType):
        return tuple(part for argument in get_args(hint) for part in alternatives(argument))
    return (hint,)


def _scalar(value: Any, hint: Any, place: Place) -> Any:
    parts = alternatives(hint)
    for part in sorted(parts, key=lambda part: part is float):  # a whole number stays one where it may
        if part is Any or (value is None and part is NONE):
            return value
        if get_origin(part) is Literal and any(
            value == choice and type(value) is type(choice) for choice in get_args(part)
        ):
            return value
        if not isinstance(part, type):
            continue
        if part in (bool, str) and type(value) is part:
            return value
        if issubclass(part, int) and part is not bool and type(value) is int:
            return _restricted(value, part, place)
        if issubclass(part, float) and type(value) in (int, float) and not math.isnan(value):
            return _restricted(float(value), part, place)
    raise place.error(f"is {shown(value)}, must be {described(hint)}{remedy(value, parts)}")


def _restricted(value: float, part: type, place: Place) -> float:
    """The number, where a type of its own (such as jsonargparse's PositiveInt) takes it."""
    try:
        part(value)
    except (TypeError, ValueError) as error:
        raise place.error(f"is {shown(value)}, must be {described(part)}.") from error
    return value

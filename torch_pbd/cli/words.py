"""Types of options, and words of messages: places, values and types, and the remedies that can be guessed."""

import difflib
import math
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from torch_pbd.cli.yaml import Keys
from torch_pbd.exceptions import ConfigError

_LONGEST = 120  # letters of a name: one line of a wide terminal
# Half a line: what the value must be stands beside it.
_LONGEST_VALUE = 60

_NAMES: dict[Any, str] = {
    type(None): "null",
    bool: "true or false",
    int: "a whole number",
    float: "a number",
    str: "text",
    Any: "any value",
}
_KINDS = {int: "the number ", float: "the number ", str: "the text "}
_TRUTH = {"yes": "true", "on": "true", "y": "true", "no": "false", "off": "false", "n": "false"}


@dataclass(frozen=True)
class Place:
    """Place of a value: a file or the command line, the keys below it, and the line of each."""

    source: str = ""
    keys: Keys = ()
    lines: Mapping[Keys, int] = field(default_factory=dict)

    def below(self, key: str | int) -> "Place":
        """Place of an entry of this value."""
        return Place(self.source, (*self.keys, key), self.lines)

    def error(self, problem: str) -> ConfigError:
        """Error with file, line and keys."""
        lines = [self.lines[self.keys[:n]] for n in range(len(self.keys) + 1) if self.keys[:n] in self.lines]
        where = f"{self.source}, line {lines[-1]}: " if lines else ""
        return ConfigError(f"{where}{'.'.join(visible(str(key)) for key in self.keys)} {problem}")


def visible(name: str) -> str:
    """Name as it stands in a message: on one line, and not too long."""
    text = name if name and name.isprintable() else repr(name)
    return text if len(text) <= _LONGEST else text[: _LONGEST - 3] + "..."


def unknown(name: str, names: Collection[str], what: str) -> str:
    """Sentence on a name that is not known, with the nearest one that is."""
    close = difflib.get_close_matches(name, names, n=1, cutoff=0.5)
    return f"is not {what}. " + (f"Did you mean {close[0]!r}?" if close else f"Known are {', '.join(names) or 'none'}.")


def shown(value: Any) -> str:
    """Value as it stands in YAML, with its kind."""
    if isinstance(value, list | dict):
        return "a list" if isinstance(value, list) else "a mapping"
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, float) and not math.isfinite(value):
        return "not a number (.nan)" if math.isnan(value) else f"infinite ({str(value).replace('inf', '.inf')})"
    text = repr(value)
    return _KINDS[type(value)] + (text if len(text) <= _LONGEST_VALUE else text[: _LONGEST_VALUE - 3] + "...")


def alternatives(hint: Any) -> tuple[Any, ...]:
    """Types of a union, or the one type that it is."""
    if get_origin(hint) in (Union, UnionType):
        return tuple(part for argument in get_args(hint) for part in alternatives(argument))
    return (hint,)


def is_of(value: Any, part: Any) -> bool:
    """Whether a value that is no list and no mapping is of a type that is no union."""
    if get_origin(part) is Literal:
        return isinstance(value, str) and value in get_args(part)
    if get_origin(part) is Annotated:
        kind, (least, most) = get_args(part)
        return is_of(value, kind) and bool(least <= value <= most)
    if part is float:
        return (type(value) is float and value == value) or (type(value) is int and abs(value) < 1e300)
    return part is Any or type(value) is part


def described(hint: Any) -> str:
    """Type in words."""
    return " or ".join(dict.fromkeys(words for part in alternatives(hint) if (words := _described(part))))


def _described(part: Any) -> str:
    origin, arguments = get_origin(part), get_args(part)
    if origin is Literal:
        return ("one of " if len(arguments) > 1 else "") + ", ".join(map(str, arguments))
    if origin is Annotated:
        kind, (least, most) = arguments
        low, high = (f"{bound:g}" if isinstance(bound, float) else str(bound) for bound in (least, most))
        below = f"of at most {high}" if least == -math.inf else f"from {low} to {high}"
        return f"{_NAMES[kind]} {below if most < math.inf else f'of at least {low}'}"
    if origin is list:
        return f"a list, each entry {described(arguments[0])}"
    if origin is dict:
        return f"a mapping, for each name {described(arguments[1])}"
    if part in _NAMES:
        return _NAMES[part]
    # Of the other types, only classes can be written in YAML, by name; functions cannot.
    return "a mapping of class_path and init_args" if isinstance(part, type | str) else ""


def remedy(value: Any, hint: Any) -> str:
    """End of the sentence on a value of a wrong type: what to write instead, where that can be guessed."""
    guess = _guess(value, alternatives(hint))
    return f": {guess}" if guess else "."


def _guess(value: Any, parts: tuple[Any, ...]) -> str:
    choices = [choice for part in parts if get_origin(part) is Literal for choice in get_args(part)]
    numbers = {get_args(part)[0] if get_origin(part) is Annotated else part for part in parts} & {int, float}
    if isinstance(value, str):
        text = value.strip()
        if close := difflib.get_close_matches(value, choices, n=1):
            return f"did you mean {close[0]!r}?"
        if bool in parts and text.lower() in _TRUTH:
            return f"write {_TRUTH[text.lower()]}."
        if type(None) in parts and text.lower() == "none":
            return "write null."
        # 010 is eight in YAML 1.1 and text here; 1_000 and 1,5 are numbers to people.
        number = re.sub("^([-+]?)0+(?=[0-9])", r"\1", text.replace("_", "").replace(",", "."))
        return f"write {number}." if numbers and re.fullmatch(r"[-+]?[0-9]{1,30}(\.[0-9]{1,30})?", number) else ""
    if isinstance(value, float) and value.is_integer() and int in numbers:
        return f"write {int(value)}."
    if value is None or isinstance(value, list | dict):
        return ""
    if str in parts or choices:
        return "text that looks like something else stands in quotes."
    return "a list is written [first, second]." if any(get_origin(part) is list for part in parts) else ""

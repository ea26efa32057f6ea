"""What messages about options call values and types, and what they advise."""

import difflib
import math
import re
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin

NONE: type = type(None)

_NAMES: dict[Any, str] = {
    NONE: "null",
    bool: "true or false",
    int: "a whole number",
    float: "a number",
    str: "text",
    Any: "any value",
}
_KINDS = {bool: "", int: "the number ", float: "the number ", str: "the text ", list: "a list ", dict: "a mapping "}
_TRUTH = {"yes": "true", "on": "true", "y": "true", "no": "false", "off": "false", "n": "false"}


def visible(name: str) -> str:
    """A name as it stands in a message: on one line, and not too long."""
    text = name if name.isprintable() else repr(name)
    return text if len(text) <= 120 else text[:117] + "..."


def shown(value: Any) -> str:
    """A value as it stands in YAML, with what it is."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list | dict):
        return _KINDS[type(value)].strip()
    if isinstance(value, float) and not math.isfinite(value):
        return "not a number (.nan)" if math.isnan(value) else f"infinite ({str(value).replace('inf', '.inf')})"
    text = repr(value)
    return _KINDS[type(value)] + (text if len(text) <= 60 else text[:57] + "...")


def described(hint: Any) -> str:
    """A type in words."""
    origin = get_origin(hint)
    if origin in (Union, UnionType):
        parts = [words for part in get_args(hint) if (words := described(part))]
        return " or ".join(dict.fromkeys(parts))
    if origin is Literal:
        return ("one of " if len(get_args(hint)) > 1 else "") + ", ".join(map(str, get_args(hint)))
    if origin is list:
        return f"a list, each entry {described(get_args(hint)[0])}"
    if origin is dict:
        return f"a mapping, for each name {described(get_args(hint)[1])}"
    if hint in _NAMES:
        return _NAMES[hint]
    if not isinstance(hint, type):
        return ""  # a callable: there is no YAML for it
    if issubclass(hint, int | float):
        words = re.sub(r"(?<=[a-z])(?=[A-Z\d])|(?<=\d)(?=[A-Z])", " ", hint.__name__).lower()
        return "a " + words.replace("int", "whole number").replace("float", "number")
    return "a mapping of class_path and init_args"


def remedy(value: Any, parts: tuple[Any, ...]) -> str:
    """What to write instead, where that can be guessed; begins with a colon; ends the sentence."""
    guess = _guess(value, parts)
    return f": {guess}" if guess else "."


def _guess(value: Any, parts: tuple[Any, ...]) -> str:
    choices = [choice for part in parts if get_origin(part) is Literal for choice in get_args(part)]
    if isinstance(value, str):
        close = difflib.get_close_matches(value, [choice for choice in choices if isinstance(choice, str)], n=1)
        if close:
            return f"did you mean {close[0]!r}?"
        return _guess_of_text(value.strip(), parts)
    if (
        isinstance(value, float)
        and value.is_integer()
        and any(isinstance(part, type) and issubclass(part, int) for part in parts)
    ):
        return f"write {int(value)}."
    if value is not None and not isinstance(value, list | dict):
        if str in parts or choices:
            return "text that looks like something else stands in quotes."
        if any(get_origin(part) is list for part in parts):
            return "a list is written [first, second]."
    return ""


def _guess_of_text(text: str, parts: tuple[Any, ...]) -> str:
    if bool in parts and text.lower() in _TRUTH:
        return f"write {_TRUTH[text.lower()]}."
    if text.lower() == "none" and NONE in parts:
        return "write null."
    if not {int, float} & set(parts):
        return ""
    for pattern, number in (
        (r"[-+]?0+[1-9][0-9]*", lambda: str(int(text))),
        (r"0x[0-9a-fA-F]{1,16}", lambda: str(int(text, 16))),
        (r"0o[0-7]{1,20}", lambda: str(int(text, 8))),
        (r"[-+]?[0-9]+(_[0-9]+)+", lambda: text.replace("_", "")),
        (r"[-+]?[0-9]+,[0-9]+", lambda: text.replace(",", ".")),
    ):
        if len(text) < 40 and re.fullmatch(pattern, text):
            return f"write {number()}."
    return ""

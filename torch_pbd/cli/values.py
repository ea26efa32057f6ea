"""Values of options: YAML of plain values without surprises, types in words, and suggested remedies."""

import difflib
import json
import math
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, NamedTuple, Union, get_args, get_origin

import yaml

from torch_pbd.exceptions import ConfigError

# The largest configuration of this checkout has 2 KiB, 58 entries and 5 levels. PyYAML takes a second for 20,000
# entries, and composes each level in three of the thousand frames that Python allows.
MAX_BYTES = 2**20
MAX_DEPTH = 50
MAX_NODES = 20_000

_LONGEST = 120  # letters of a name: one line of a wide terminal
_LONGEST_VALUE = 60  # half a line: what the value must be stands beside it

_NAMES: dict[Any, str] = {
    type(None): "null",
    bool: "true or false",
    int: "a whole number",
    float: "a number",
    str: "text",
    Any: "any value",
}
_TRUTH = {"yes": "true", "on": "true", "y": "true", "no": "false", "off": "false", "n": "false"}

Keys = tuple[str | int, ...]


class Document(NamedTuple):
    """Content of a YAML text (mappings, lists, text, numbers, true, false, null), and the line of each entry."""

    content: Any
    lines: dict[Keys, int]


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


class _RefusedError(yaml.MarkedYAMLError):
    """YAML, but not what a configuration has need of."""

    def __init__(self, what: str, mark: yaml.Mark) -> None:
        super().__init__(problem=f"there is {what}", problem_mark=mark)


class _Loader(yaml.SafeLoader):
    """Loader without tags, and without references, which make a text of 300 bytes endless."""

    yaml_implicit_resolvers: dict[Any, Any] = {}  # noqa: RUF012 - filled below, by yaml's own method
    depth = n_nodes = 0

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node:
        event = self.peek_event()
        self.n_nodes += 1
        self.depth += 1
        for refused, problem in (
            (isinstance(event, yaml.AliasEvent), "a reference (*): write the value out"),
            (getattr(event, "tag", None) is not None, "a tag (!): write the plain value"),
            (self.depth > MAX_DEPTH, f"nesting of more than {MAX_DEPTH} levels: no option needs so many"),
            (self.n_nodes > MAX_NODES, f"a text of more than {MAX_NODES} entries: no option needs so many"),
        ):
            if refused:
                raise _RefusedError(problem, event.start_mark)
        node = super().compose_node(parent, index)
        self.depth -= 1
        return node


# YAML 1.1, which PyYAML reads, takes no for False, 010 for 8, 1:20 for 80, and 1e-3 for text.
for _tag, _pattern in (
    ("null", "null|Null|NULL|~|"),
    ("bool", "true|True|TRUE|false|False|FALSE"),
    ("int", "[-+]?(?:0|[1-9][0-9]*)"),
    ("float", r"[-+]?(?:\.[0-9]+|(?:0|[1-9][0-9]*)(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?|[-+]?\.(?:inf|Inf|INF)"),
    ("float", r"\.(?:nan|NaN|NAN)"),
):
    _Loader.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", re.compile(rf"(?:{_pattern})\Z"), None)


def read_yaml_file(path: str) -> Document:
    """Document of a file of UTF-8, which must hold one mapping, or nothing; else a ConfigError has file and line."""
    source = path if path.isprintable() else repr(path)
    try:
        with Path(path).open("rb") as file:
            raw = file.read(MAX_BYTES + 1)
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = raw.count(b"\n", 0, error.start) + 1
        raise ConfigError(f"{source}, line {line}: the file is not text in UTF-8: save it as UTF-8.") from error
    except (OSError, ValueError) as error:  # a name with a null character is a ValueError
        raise ConfigError(f"{source}: the file cannot be read: {getattr(error, 'strerror', error)}.") from error
    if len(raw) > MAX_BYTES:
        raise ConfigError(f"{source}: the file is larger than {MAX_BYTES} bytes: is it a configuration file?")
    document = read_yaml(text, source)
    if not isinstance(document.content, dict | None):
        what = f"it holds {document.content!r:.60}, must hold options"
        raise ConfigError(f"{source}: {what}: one 'name: value' a line.")
    return Document({}, {}) if document.content is None else document


def read_yaml(text: str, source: str) -> Document:
    """One YAML document; ``source``, which says where the text is from, begins every message of a ConfigError.

    Only ``true`` and ``false`` are booleans, and a number is decimal: ``no``, ``1:20``, ``2026-01-01``, ``010``,
    ``0x10`` and ``1_000`` are text, ``1e-3`` is a number. Keys are text.
    """
    lines: dict[Keys, int] = {}
    try:
        loader = _Loader(text)
        node = loader.get_single_node()
        return Document(None if node is None else _content(loader, node, (), lines), lines)
    except _RefusedError as error:
        raise ConfigError(f"{source}, line {error.problem_mark.line + 1}: {error.problem}.") from error
    except yaml.MarkedYAMLError as error:
        mark, problem = error.problem_mark, f"{error.context or ''} {error.problem}"
        where = f"{source}, line {mark.line + 1}" if mark else source
        hint = ": indent by spaces, not by tabs" if "'\\t'" in problem else ""
        raise ConfigError(f"{where}: this is not YAML: {' '.join(problem.split())}{hint}.") from error
    except (yaml.YAMLError, ValueError, OverflowError) as error:  # what no letter or number can be
        raise ConfigError(f"{source}: this is not YAML: {' '.join(str(error).split())}.") from error


def _content(loader: _Loader, node: yaml.Node, keys: Keys, lines: dict[Keys, int]) -> Any:
    lines.setdefault(keys, node.start_mark.line + 1)
    if isinstance(node, yaml.ScalarNode):
        value = loader.construct_object(node)
        if isinstance(value, float) and math.isinf(value) and not node.value.lower().endswith(".inf"):
            raise _RefusedError(f"the number {node.value:.30}, beyond what a float holds", node.start_mark)
        return value
    if isinstance(node, yaml.SequenceNode):
        return [_content(loader, entry, (*keys, i), lines) for i, entry in enumerate(node.value)]
    content: dict[str, Any] = {}
    for key, value in node.value:
        name = key.value
        if not isinstance(name, str):
            raise _RefusedError("a mapping or a list as a key: a key is one word", key.start_mark)
        if name in content:
            first = lines[*keys, name]
            raise _RefusedError(f"the key {name!r} twice (first in line {first}): keep one of them", key.start_mark)
        lines[*keys, name] = key.start_mark.line + 1
        content[name] = _content(loader, value, (*keys, name), lines)
    return content


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
        return json.dumps(value)
    if isinstance(value, float) and not math.isfinite(value):
        return "not a number (.nan)" if math.isnan(value) else f"infinite ({str(value).replace('inf', '.inf')})"
    text = repr(value)
    kind = "text" if isinstance(value, str) else "number"
    return f"the {kind} {text if len(text) <= _LONGEST_VALUE else text[: _LONGEST_VALUE - 3] + '...'}"


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
    parts, origin, arguments = alternatives(hint), get_origin(hint), get_args(hint)
    if len(parts) > 1:
        return " or ".join(dict.fromkeys(words for part in parts if (words := described(part))))
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
    # Of the other types, only classes can be written in YAML, by name; functions cannot.
    return _NAMES.get(hint, "a mapping of class_path and init_args" if isinstance(hint, type | str) else "")


def remedy(value: Any, hint: Any) -> str:
    """End of the sentence on a value of a wrong type: what to write instead, where that can be guessed."""
    parts, guess = alternatives(hint), ""
    choices = [choice for part in parts if get_origin(part) is Literal for choice in get_args(part)]
    numbers = {get_args(part)[0] if get_origin(part) is Annotated else part for part in parts} & {int, float}
    if isinstance(value, str):
        text = value.strip().lower()
        # 010 is eight in YAML 1.1 and text here; 1_000 and 1,5 are numbers to people.
        number = re.sub("^([-+]?)0+(?=[0-9])", r"\1", text.replace("_", "").replace(",", "."))
        if close := difflib.get_close_matches(value, choices, n=1):
            guess = f"did you mean {close[0]!r}?"
        elif bool in parts and text in _TRUTH:
            guess = f"write {_TRUTH[text]}."
        elif type(None) in parts and text == "none":
            guess = "write null."
        elif numbers and re.fullmatch(r"[-+]?[0-9]{1,30}(\.[0-9]{1,30})?", number):
            guess = f"write {number}."
    elif isinstance(value, float) and value.is_integer() and int in numbers:
        guess = f"write {int(value)}."
    elif isinstance(value, bool | int | float) and (str in parts or choices):
        guess = "text that looks like something else stands in quotes."
    elif isinstance(value, bool | int | float) and any(get_origin(part) is list for part in parts):
        guess = "a list is written [first, second]."
    return f": {guess}" if guess else "."

"""YAML without surprises: the scalars of YAML 1.2, plain values only, each key once; bounded in size and depth."""

import math
import re
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from torch_pbd.exceptions import ConfigError

# The largest configuration of this checkout has 2 KiB, 58 entries and 5 levels. PyYAML takes a second for 20,000
# entries, and composes each level in three of the thousand frames that Python allows.
MAX_BYTES = 2**20
MAX_DEPTH = 50
MAX_NODES = 20_000

Keys = tuple[str | int, ...]


class Document(NamedTuple):
    """Content of a YAML text (mappings, lists, text, numbers, true, false, null), and the line of each entry."""

    content: Any
    lines: dict[Keys, int]


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
    """Document of a file of at most 1 MiB of UTF-8, which must hold one mapping; an empty file is an empty mapping.

    Raises
    ------
    ConfigError
        If the file cannot be read, is not text, or is not such YAML; names the file and the line.
    """
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
    """One YAML document; ``source``, which says where the text is from, begins every message.

    Only ``true`` and ``false`` are booleans, and a number is decimal: ``no``, ``1:20``, ``2026-01-01``, ``010``,
    ``0x10`` and ``1_000`` are text, ``1e-3`` is a number. Keys are text.

    Raises
    ------
    ConfigError
        On text that is not YAML, on tags, references, keys that are there twice or are no words, a
        second document, and more than 20,000 entries or 50 levels.
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


def next_value(rest: list[str]) -> str:
    """Next argument; a list that the shell took apart, as [x, y] without quotes, is one."""
    text = rest.pop(0)
    while text.startswith("[") and not text.endswith("]") and any(argument.endswith("]") for argument in rest):
        text = f"{text} {rest.pop(0)}"
    return text

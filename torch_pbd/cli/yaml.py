"""YAML without surprises: the scalars of YAML 1.2, no tags, no references, each key once; bounded in size and depth."""

import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from torch_pbd.exceptions import ConfigError

MAX_BYTES = 2**20
MAX_DEPTH = 50
MAX_NODES = 20_000

Keys = tuple[str | int, ...]

_INTEGER = re.compile(r"[-+]?(?:0|[1-9][0-9]*)")
_FLOAT = re.compile(r"[-+]?(?:\.[0-9]+|(?:0|[1-9][0-9]*)(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?")
_WORDS: dict[str, Any] = dict.fromkeys(("null", "Null", "NULL", "~", ""))
_WORDS |= dict.fromkeys(("true", "True", "TRUE"), True) | dict.fromkeys(("false", "False", "FALSE"), False)
_WORDS |= {sign + word: float(sign + "inf") for sign in ("", "+", "-") for word in (".inf", ".Inf", ".INF")}
_WORDS |= dict.fromkeys((".nan", ".NaN", ".NAN"), math.nan)


class Document(NamedTuple):
    """What a YAML text holds (mappings, lists, text, numbers, true, false, null), and the line of each entry."""

    content: Any
    lines: dict[Keys, int]


def read_yaml_file(path: str) -> Document:
    """Read a file, which must hold one mapping; an empty file is an empty mapping.

    Parameters
    ----------
    path : str
        At most 1 MiB of UTF-8, with or without a byte order mark.

    Raises
    ------
    ConfigError
        If the file is not there or not readable, is not text, or is not such YAML; names the file and the line.
    """
    source = path if path.isprintable() else repr(path)
    document = read_yaml(_text_of(path, source), source)
    if document.content is None:
        return Document({}, {})
    if not isinstance(document.content, dict):
        raise ConfigError(
            f"{source}: it must hold options, one 'name: value' a line; it holds {document.content!r:.60}."
        )
    return document


def read_yaml(text: str, source: str) -> Document:
    """Read one YAML document.

    Only ``true`` and ``false`` are booleans, and a number is decimal: ``no``, ``1:20``, ``2026-01-01``, ``010``,
    ``0x10`` and ``1_000`` are text, ``1e-3`` is a number.

    Parameters
    ----------
    text : str
    source : str
        Where the text is from; begins every message.

    Raises
    ------
    ConfigError
        On what is not YAML, on tags, anchors, aliases, merge keys, keys that are there twice or are not text, a
        second document, and more than 20,000 entries or 50 levels.
    """
    try:
        return _Reader(text, source).document()
    except yaml.reader.ReaderError as error:
        line = text.count("\n", 0, error.position) + 1
        code = error.character if isinstance(error.character, int) else ord(error.character)
        raise ConfigError(f"{source}, line {line}: the character U+{code:04X} is not allowed in YAML.") from error
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        where = f", line {mark.line + 1}" if mark else ""
        remedy = " Indent by spaces, not by tabs." if "'\\t'" in str(error.problem) else ""
        problem = " ".join(f"{error.context or ''} {error.problem or 'cannot be read'}".split())
        raise ConfigError(f"{source}{where}: this is not YAML: {problem}.{remedy}") from error
    except (ValueError, OverflowError) as error:
        if isinstance(error, ConfigError):
            raise
        raise ConfigError(f"{source}: this is not YAML: {error}.") from error


def _text_of(path: str, source: str) -> str:
    try:
        with Path(path).open("rb") as file:
            raw = file.read(MAX_BYTES + 1)
    except FileNotFoundError as error:
        raise ConfigError(f"{source}: there is no such file.") from error
    except IsADirectoryError as error:
        raise ConfigError(f"{source}: this is a folder; name a YAML file in it.") from error
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise ConfigError(f"{source}: the file cannot be read: {reason}.") from error
    if len(raw) > MAX_BYTES:
        raise ConfigError(f"{source}: the file is larger than {MAX_BYTES} bytes; is it a configuration file?")
    if raw.startswith((b"\xff\xfe", b"\xfe\xff", b"\x00\x00\xfe\xff")):
        raise ConfigError(f"{source}: the file is in UTF-16 or UTF-32; save it as UTF-8.")
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = raw.count(b"\n", 0, error.start) + 1
        raise ConfigError(f"{source}, line {line}: the file is not text in UTF-8; save it as UTF-8.") from error


class _Reader:
    """Builds the document from YAML's events, refusing what a configuration has no need of."""

    def __init__(self, text: str, source: str) -> None:
        self._source = source
        self._events: Iterator[yaml.Event] = iter(yaml.parse(text, yaml.SafeLoader))
        self._lines: dict[Keys, int] = {}
        self._n_nodes = 0

    def document(self) -> Document:
        next(self._events)  # the start of the stream
        start = next(self._events)
        if isinstance(start, yaml.StreamEndEvent):
            return Document(None, {})
        if start.tags:
            raise self._refusal(start, "a %TAG directive", "leave it out")
        content = self._node(next(self._events), ())
        next(self._events)  # the end of the document
        after = next(self._events)
        if not isinstance(after, yaml.StreamEndEvent):
            raise self._refusal(after, "a second document (---)", "keep one to a file")
        return Document(content, self._lines)

    def _node(self, event: yaml.Event, keys: Keys) -> Any:
        self._check(event, keys)
        self._lines.setdefault(keys, event.start_mark.line + 1)
        if isinstance(event, yaml.MappingStartEvent):
            return self._mapping(keys)
        if isinstance(event, yaml.SequenceStartEvent):
            return self._sequence(keys)
        return self._scalar(event)

    def _check(self, event: yaml.Event, keys: Keys) -> None:
        self._n_nodes += 1
        if isinstance(event, yaml.AliasEvent):
            raise self._refusal(event, f"a reference (*{event.anchor:.30})", "write the value out")
        if event.anchor is not None:
            raise self._refusal(event, f"an anchor (&{event.anchor:.30})", "write the value out where it is used")
        if event.tag is not None:
            raise self._refusal(event, f"a tag ({event.tag:.60})", "write the plain value")
        if len(keys) > MAX_DEPTH:
            raise self._refusal(event, f"nesting of more than {MAX_DEPTH} levels", "no option needs so many")
        if self._n_nodes > MAX_NODES:
            raise self._refusal(event, f"a text of more than {MAX_NODES} entries", "no option needs so many")

    def _mapping(self, keys: Keys) -> dict[str, Any]:
        content: dict[str, Any] = {}
        while not isinstance(event := next(self._events), yaml.MappingEndEvent):
            key = self._key(event, keys)
            if key in content:
                first = self._lines[*keys, key]
                what = f"the key {key!r} twice (first in line {first})"
                raise self._refusal(event, what, "keep one of them")
            self._lines[*keys, key] = event.start_mark.line + 1
            content[key] = self._node(next(self._events), (*keys, key))
        return content

    def _key(self, event: yaml.Event, keys: Keys) -> str:
        self._check(event, keys)
        if not isinstance(event, yaml.ScalarEvent):
            raise self._refusal(event, "a mapping or a list as a key", "a key is one word")
        key = self._scalar(event)
        if key == "<<" and event.implicit[0]:
            raise self._refusal(event, "a merge key (<<)", "write the entries out")
        if not isinstance(key, str):
            what = f"the key {event.value}, which is not text" if event.value else "an entry without a key"
            raise self._refusal(event, what, f"write '{event.value}': in quotes, if this is the name you mean")
        return key

    def _sequence(self, keys: Keys) -> list[Any]:
        content: list[Any] = []
        while not isinstance(event := next(self._events), yaml.SequenceEndEvent):
            content.append(self._node(event, (*keys, len(content))))
        return content

    def _scalar(self, event: yaml.Event) -> Any:
        text: str = event.value
        if any("\ud800" <= character <= "\udfff" for character in text):
            raise self._refusal(event, "half of a surrogate pair", "write the character itself")
        if not event.implicit[0]:
            return text
        if text in _WORDS:
            return _WORDS[text]
        if not _FLOAT.fullmatch(text):
            return text
        number = float(text)
        if not math.isfinite(number) or (number == 0.0 and re.search("[1-9]", re.split("[eE]", text)[0])):
            raise self._refusal(event, f"the number {text:.30}, beyond what a float holds", "write one that it holds")
        return int(text) if _INTEGER.fullmatch(text) else number

    def _refusal(self, event: yaml.Event, what: str, remedy: str) -> ConfigError:
        return ConfigError(f"{self._source}, line {event.start_mark.line + 1}: there is {what}; {remedy}.")

"""Output to a terminal, or to nobody."""

import os
import sys
from typing import Any, TextIO


def say(text: str, stream: TextIO | None = None) -> None:
    """Print; once nobody reads, as behind ``| head``, the work goes on without a word.

    Letters that the stream's encoding has not are question marks.
    """
    stream = sys.stdout if stream is None else stream
    try:
        print(_encodable(text, stream), file=stream, flush=True)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def _encodable(text: str, stream: TextIO) -> str:
    encoding = getattr(stream, "encoding", None) or "utf-8"
    try:
        text.encode(encoding, getattr(stream, "errors", None) or "strict")
    except UnicodeEncodeError:
        return text.encode(encoding, "replace").decode(encoding)
    return text


class Notes:
    """Shows each warning once, as one line on the standard error."""

    def __init__(self) -> None:
        self._shown: set[str] = set()

    def __call__(self, message: Warning | str, category: type[Warning], *_: Any, **__: Any) -> None:
        """Show a warning, in the place of ``warnings.showwarning``."""
        if str(message) not in self._shown:
            self._shown.add(str(message))
            say(f"note ({category.__name__}): {message}", sys.stderr)

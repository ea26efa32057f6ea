"""The command line: ``torch-pbd demo``, ``fit`` and so on; torch loads once there is work."""

import signal
import sys
import threading
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch_pbd
from torch_pbd.cli import commands
from torch_pbd.cli.values import unknown
from torch_pbd.console import progress, say
from torch_pbd.exceptions import ConfigError, FolderInUseError

# The last two are 128 and the number of the signal, as of shells.
_ERROR, _USAGE, _IN_USE, _INTERRUPTED, _TERMINATED = 1, 2, 3, 130, 143


class _Terminated(BaseException):
    """SIGTERM, as KeyboardInterrupt is SIGINT."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Exit code of one command: 0; 1, it failed; 2, it cannot be used; 3, its folder is in use; 130, 143, it is cut."""
    try:
        with _signals():
            _run(list(sys.argv[1:] if arguments is None else arguments))
        return 0
    except ConfigError as error:
        return _complain(str(error), _USAGE)
    except FolderInUseError as error:
        return _complain(f"{error} Wait for it, or take another with --output FOLDER.", _IN_USE)
    except (ValueError, TypeError, OSError, MemoryError) as error:
        return _complain(str(error) or "the memory is not enough", _ERROR)
    except (ArithmeticError, RuntimeError) as error:  # from deep inside, where the message alone says little
        return _complain(f"{type(error).__name__}: {' '.join(str(error).split())}", _ERROR)
    except ModuleNotFoundError as error:
        if error.name is not None:  # of Python's own, not one of ours that tells which extra to install
            raise
        return _complain(str(error), _USAGE)
    except KeyboardInterrupt as stop:
        return _complain("; ".join(("interrupted", *stop.args)), _INTERRUPTED)
    except _Terminated as stop:
        return _complain("; ".join(("terminated", *stop.args)), _TERMINATED)


@contextmanager
def _signals() -> Iterator[None]:
    """SIGINT and SIGTERM are exceptions, the first time; the next one ends the process at once."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    errors = {signal.SIGINT: KeyboardInterrupt, signal.SIGTERM: _Terminated}

    def handle(number: int, _: object) -> None:
        for each in errors:
            signal.signal(each, signal.SIG_DFL)
        raise errors[signal.Signals(number)]

    before = {number: signal.signal(number, handle) for number in errors}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _run(arguments: Sequence[str]) -> None:
    """Answer, or do the work of a command."""
    if not arguments or arguments[0] in ("-h", "--help") or arguments == ["help"]:
        say("torch-pbd: learn how precise people are from demonstrations\n")
        say("usage: torch-pbd COMMAND [--config FILE] [--option VALUE ...]\n")
        for name, about in commands.COMMANDS.items():
            say(f"  {name:<10}  {about}")
        say("\nOptions of a command: torch-pbd COMMAND --help. As YAML: torch-pbd COMMAND --print_config.")
        return
    command, *rest = arguments
    if command == "--version":
        say(torch_pbd.__version__)
        return
    if command == "help":
        command, rest = rest[0], ["--help"]
    if command not in commands.COMMANDS:
        raise ConfigError(f"{command!r} {unknown(command, commands.COMMANDS, 'a command')}")
    with progress():
        options, config = commands.parse(command, rest)
        if command != "playground":
            _work(command, options, config)
    if command == "playground":  # which goes on until it is ended, and says so itself
        commands.playground(options)


def _work(command: str, options: Any, config: str) -> None:
    from torch_pbd.experiments.run_folder import check_names, write_report

    own = getattr(options, "models", None) or getattr(options, "controllers", None) or {}
    for name, model in ({"model": options.model} if hasattr(options, "model") else own).items():
        try:
            model._check_parameters()  # as its fit does, once data are loaded
        except (TypeError, ValueError) as error:
            raise ConfigError(f"{name}: {error}") from error
    if getattr(options, "data", None) is not None:
        options.data = _files(options.data)
    for argument in ("models", "controllers"):
        check_names(getattr(options, argument, ()), argument)
    with _notes(), _run_folder(options.output, command, resume=options.resume) as folder:
        try:
            folder.write_text("config.yaml", config)
            import torch

            torch.set_num_threads(1)  # the matrices are small: threads would only wait for each other
            text = commands.WORK[command](options, folder)
            say(text)
            report = write_report(folder, command, text)
        except (KeyboardInterrupt, _Terminated) as stop:
            if folder.finished.files():
                stop.args = (f"torch-pbd {command} --config {folder.path / 'config.yaml'} --resume goes on",)
            raise
    say(f"\nreport:  {report}\nresults: {folder.path}")


def _files(data: Any) -> list[Path]:
    """Files of demonstrations, which are there."""
    from torch_pbd.data.io import find_files

    try:
        files = find_files(data)
    except (FileNotFoundError, ValueError) as error:
        raise ConfigError(f"data: {error}") from error
    if missing := [file for file in files if not file.exists()]:
        raise ConfigError(f"data: there is no file {str(missing[0])!r}; give one with --data FILE.")
    return files


def _run_folder(path: str, command: str, *, resume: bool) -> Any:
    from torch_pbd.experiments.run_folder import RunFolder

    if not path:
        raise ConfigError("output: it is empty, must be a folder of results. Give one with --output FOLDER.")
    try:
        return RunFolder(path, {"command": command}, resume=resume)
    except OSError as error:
        what = f"{path!r} cannot be a folder of results: {error.strerror or error}"
        raise ConfigError(f"output: {what}. Give another with --output FOLDER.") from error


@contextmanager
def _notes() -> Iterator[None]:
    """Warnings are printed once each, as one line on standard error."""
    shown = set()

    def show(message: Warning | str, category: type[Warning], *_: Any, **__: Any) -> None:
        if str(message) not in shown:
            shown.add(str(message))
            say(f"note ({category.__name__}): {message}", sys.stderr)

    with warnings.catch_warnings():
        warnings.simplefilter("default")
        warnings.showwarning = show
        yield


def _complain(message: str, code: int) -> int:
    say(f"torch-pbd: {message}", sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main())

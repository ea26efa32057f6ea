"""Libraries of robots and simulators: imported where they are needed, not before."""

from importlib import import_module
from typing import Any


def required(module: str, package: str = "") -> Any:
    """A library that this package does not need as a whole; ``package`` is its name for pip, if it is another."""
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        name = package or module.partition(".")[0]
        raise ModuleNotFoundError(
            f"this needs {name}, which is not installed: pip install {name}, or pip install 'torch_pbd[robot]'"
        ) from error

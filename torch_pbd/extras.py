"""Libraries that only a part of the package needs."""

from importlib import import_module
from typing import Any


def optional(module: str, extra: str, what: str) -> Any:
    """Library of an extra, imported once it is needed; where it is not there, the error says for ``what``."""
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        library = module.partition(".")[0]
        raise ModuleNotFoundError(
            f"{what} needs {library}, which is not installed: pip install 'torch_pbd[{extra}]'."
        ) from error

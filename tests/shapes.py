"""Shapes of the torch floors, checked while the tests run: jaxtyping's annotations, by beartype.

A check takes longer than most functions that are checked. Of each function the first few calls in a test are checked,
more in tests that are marked slow, and of the later ones ever fewer: the 4th, the 8th, the 16th and so on, as batches
may shrink late. This leaves a fit nearly at the speed that users see.
"""

from collections import Counter
from dataclasses import is_dataclass
from functools import partial, wraps
from pathlib import Path

import jaxtyping

_FEW, _SLOW = 3, 50  # whole batches, and some that shrank as members converged
_most = _FEW
_calls = Counter()  # in this test
_jaxtyped = jaxtyping.jaxtyped


def install(modules):
    """Check these modules, which are not imported yet."""
    files = [Path(__file__).parents[1] / module.replace(".", "/") for module in modules]
    missing = [file for file in files if not file.is_dir() and not file.with_suffix(".py").is_file()]
    assert not missing, f"modules whose shapes are checked are not there: {missing}"
    jaxtyping.jaxtyped = _first_calls_checked  # what the hook decorates with
    jaxtyping.install_import_hook(modules, "beartype.beartype")


def begin_test(*, slow):
    """Count calls anew."""
    global _most
    _most = _SLOW if slow else _FEW
    _calls.clear()


def _first_calls_checked(function=None, *, typechecker):
    if function is None:
        return partial(_first_calls_checked, typechecker=typechecker)
    if isinstance(function, type):
        if is_dataclass(function):
            function.__init__ = _first_calls_checked(function.__init__, typechecker=typechecker)
        return function
    if isinstance(function, classmethod | staticmethod):
        return type(function)(_first_calls_checked(function.__func__, typechecker=typechecker))
    if isinstance(function, property):
        return property(_first_calls_checked(function.fget, typechecker=typechecker))
    if "<locals>" in function.__qualname__:  # it would be wrapped anew whenever the function around it is called
        return function
    checked = _jaxtyped(function, typechecker=typechecker)

    @wraps(function)
    def called(*args, **kwargs):
        _calls[called] = count = _calls[called] + 1
        if count > _most and count & (count - 1):  # no power of two
            return function(*args, **kwargs)
        return checked(*args, **kwargs)

    return called

import doctest
import pkgutil
from importlib import import_module

import pytest

import torch_pbd

MODULES = sorted(module.name for module in pkgutil.walk_packages(torch_pbd.__path__, "torch_pbd."))


@pytest.mark.parametrize("name", MODULES)
def test_examples_say_what_happens(name):
    failed, _ = doctest.testmod(import_module(name))
    assert failed == 0


def test_there_are_examples():
    finder = doctest.DocTestFinder(exclude_empty=True)
    shown = [name for name in MODULES if any(test.examples for test in finder.find(import_module(name)))]
    assert {
        "torch_pbd.control.stiffness.law",
        "torch_pbd.control.primitive.dmp",
        "torch_pbd.control.controller",
    } <= set(shown)

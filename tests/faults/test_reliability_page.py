"""The page of guarantees names tests that exist, and every number of the list of faults."""

import ast
import re
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "reliability.md").read_text(encoding="utf-8")
NAMED = sorted(set(re.findall(r"`(tests/[\w/]+\.py)::(\w+)`", PAGE)))


@cache
def functions(path):
    """Names of the tests of a file: functions, and what is assigned to such a name."""
    nodes = list(ast.walk(ast.parse((ROOT / path).read_text(encoding="utf-8"))))
    names = {node.name for node in nodes if isinstance(node, ast.FunctionDef)}
    names |= {node.id for node in nodes if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)}
    return {name for name in names if name.startswith("test_")}


@pytest.mark.parametrize(("path", "name"), NAMED, ids=[name for _, name in NAMED])
def test_every_test_on_the_page_exists(path, name):
    assert name in functions(path)


def rows():
    """Cells of the tables."""
    lines = [line for line in PAGE.splitlines() if line.startswith("| ") and not line.startswith(("| #", "| ---"))]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def test_every_row_has_a_test_and_says_how_it_fails():
    for cells in rows():
        assert len(cells) == 4, cells
        assert all(cells[1:]), cells
        assert re.fullmatch(r"`tests/[\w/]+\.py::\w+`(, `tests/[\w/]+\.py::\w+`)*", cells[3]), cells


def test_every_fault_is_on_the_page():
    shown = {int(number) for cells in rows() for number in re.findall(r"\d+", cells[0])}
    rest = re.search(r"## Not on this page\n(.*)", PAGE, re.DOTALL)
    shown |= {int(number) for number in re.findall(r"(?<!float)\b\d+\b", rest[1])}
    assert set(range(1, 93)) - shown == set()


def test_tests_that_bear_the_number_of_a_row_bear_the_right_one():
    for cells in rows():
        for number in re.findall(r"::test_(\d+)_", cells[3]):
            span = re.search(rf"::test_{number}_(?:to_)?(\d+)?", cells[3])
            allowed = {int(number), *([int(span[1])] if span and span[1] else [])}
            assert allowed & {int(one) for one in re.findall(r"\d+", cells[0])}, cells

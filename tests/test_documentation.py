"""The documentation names every public name, its code runs, and its links lead somewhere."""

import ast
import re
import runpy
from importlib import import_module
from pathlib import Path

import matplotlib.pyplot as plt
import pytest

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
PAGES = sorted(path.name for path in DOCS.glob("*.md"))
WITH_CODE = [name for name in PAGES if "```python" in (DOCS / name).read_text(encoding="utf-8")]


def documented():
    """Objects on the page of the API."""
    module, found = None, set()
    for line in (DOCS / "api.rst").read_text(encoding="utf-8").splitlines():
        if line.startswith(".. currentmodule:: "):
            module = import_module(line.split()[-1])
        elif re.fullmatch(r"   \w+", line):
            found.add(getattr(module, line.strip()))
    return found


@pytest.mark.parametrize(
    "name",
    ["torch_pbd", "torch_pbd.control", "torch_pbd.data", "torch_pbd.metrics", "torch_pbd.movement", "torch_pbd.robots"],
)
def test_every_public_name_is_in_the_api(name):
    module = import_module(name)
    assert [public for public in module.__all__ if getattr(module, public) not in documented()] == []


@pytest.mark.slow
@pytest.mark.parametrize("name", WITH_CODE)
def test_the_python_of_a_page_runs(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = {"__name__": "page"}
    for block in re.findall(r"```python\n(.*?)```", (DOCS / name).read_text(encoding="utf-8"), re.DOTALL):
        exec(compile(block, name, "exec"), names)
    plt.close("all")


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_is_short_and_takes_names_of_the_api(path):
    text, api = path.read_text(encoding="utf-8"), (DOCS / "api.rst").read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 60
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.ImportFrom) and node.module.startswith("torch_pbd"):
            module, names = import_module(node.module), {alias.name for alias in node.names}
            constants = {name for name in names if re.search(rf"``(torch_pbd\.\w+\.)?{name}``", api)}
            assert {name for name in names - constants if getattr(module, name) not in documented()} == set()


@pytest.mark.slow
@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_runs_and_shows_one_figure(path):
    plt.close("all")  # of other tests
    runpy.run_path(str(path))
    assert len(plt.get_fignums()) == 1
    plt.close("all")


@pytest.mark.parametrize("path", [ROOT / "README.md", *(DOCS / name for name in PAGES)], ids=lambda path: path.name)
def test_links_and_files_are_there(path):
    text = path.read_text(encoding="utf-8")
    linked = [link.partition("#")[0] for link in re.findall(r"\]\((?!https?:)([^)\s]+)\)", text)]
    # Pages of the gallery are made of the examples.
    sources = [re.sub(r"^gallery/(.*)\.rst$", r"../examples/\1.py", link) for link in linked]
    missing = [link for link in sources if link and not (path.parent / link).is_file()]
    assert missing == []
    assert [name for name in re.findall(r"--config ([\w/.]+)", text) if not (ROOT / name).is_file()] == []


def test_pictures_are_small():
    sizes = {path.name: path.stat().st_size for path in (DOCS / "pictures").iterdir()}
    assert max(sizes.values()) < 1e6, sizes
    assert len((ROOT / "README.md").read_text(encoding="utf-8").split()) <= 1200

"""The examples run, print what they say, and leave a figure."""

import re
import runpy
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[1] / "scripts" / "examples"


@pytest.mark.parametrize("name", ["pushed", "via_point"])
def test_an_example_prints_its_numbers_and_draws(name, tmp_path, monkeypatch, capsys):
    monkeypatch.syspath_prepend(EXAMPLES)
    monkeypatch.setattr(sys, "argv", [name, "--output", str(tmp_path / "figure.png")])
    runpy.run_path(str(EXAMPLES / f"{name}.py"), run_name="__main__")
    shown = capsys.readouterr().out
    gains = [tuple(map(int, pair)) for pair in re.findall(r"(\d+) -> +(\d+) N/m", shown)]
    # Stiff where the robot was pushed to, or must pass; less so farther on.
    before, after = max(gains, key=lambda pair: pair[1])
    assert before < 100
    assert after == 1000
    assert min(pair[1] for pair in gains) < 900
    assert (tmp_path / "figure.png").stat().st_size > 20_000
    assert len((EXAMPLES / f"{name}.py").read_text().splitlines()) <= 65

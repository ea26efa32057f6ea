import re
from pathlib import Path

import pytest

README = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")


@pytest.mark.slow
def test_the_python_of_the_readme_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    names = {}
    for block in re.findall(r"```python\n(.*?)```", README, re.DOTALL):
        exec(compile(block, "README.md", "exec"), names)
    assert "guaranteed" in capsys.readouterr().out
    assert (tmp_path / "tunnel.npz").is_file()
    assert names["covariance"].shape == (5, 2, 2)


def test_every_config_of_the_readme_is_there():
    named = re.findall(r"--config ([\w/.]+)", README)
    assert named
    assert [name for name in named if not (Path(__file__).parents[1] / name).is_file()] == []

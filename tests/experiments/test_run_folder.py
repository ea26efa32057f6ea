import json
import re

import pytest

from torch_pbd.console import format_table
from torch_pbd.exceptions import ConfigError
from torch_pbd.experiments.run_folder import RunFolder, check_names, slug


def test_a_table_lines_up_and_shows_what_is_not_known_as_a_dash():
    rows = [{"model": "CD", "MSE": 1.5e-13, "LL": -3.25}, {"model": "GMM 5", "MSE": float("nan"), "LL": 123456.0}]
    lines = format_table(rows).splitlines()
    assert lines[0] == "model       MSE        LL"
    assert lines[2:] == ["CD     1.50e-13     -3.25", "GMM 5         -  1.23e+05"]
    assert len({len(line) for line in lines}) == 1


def test_a_column_of_which_nothing_is_known_is_left_out():
    rows = [{"model": "CD", "truth": float("nan"), "LL": 1.0}, {"model": "WP", "truth": float("nan"), "LL": 2.0}]
    assert "truth" not in format_table(rows)


def test_a_folder_says_what_was_run(tmp_path):
    RunFolder(tmp_path / "runs" / "new", {"command": "fit"})
    environment = json.loads((tmp_path / "runs" / "new" / "env.json").read_text())
    assert environment["settings"] == {"command": "fit"}
    assert {"torch", "scikit-learn"} <= set(environment["packages"])


def test_a_folder_that_is_a_file_fails_before_the_work(tmp_path):
    (tmp_path / "taken").write_text("")
    with pytest.raises(FileExistsError, match="taken"):
        RunFolder(tmp_path / "taken", {})


def test_names_of_models_become_names_of_files():
    assert slug("Figure 2, CD") == "figure_2_cd"


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (["CD", "cd"], "models: 'CD' and 'cd' would both be written to files named 'cd'"),
        (["GMM 5", "WP", "GMM-5"], "'GMM 5' and 'GMM-5' would both be written"),
        (["CD", "!!!"], "models: '!!!' gives no name of a file: it must have a letter or a digit"),
        ([""], "models: '' gives no name of a file"),
        (["a" * 300], "at most 180 bytes"),
    ],
)
def test_names_that_give_no_files_of_their_own_are_refused(names, message):
    check_names(["CD", "WP", "GMM 5", "GMM 8", "記録"], "models")
    with pytest.raises(ConfigError, match=re.escape(message)):
        check_names(names, "models")

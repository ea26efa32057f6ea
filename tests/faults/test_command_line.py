"""The command line where there is no display, nobody who reads, no folder to write.

Numbers in the names are those of the list of faults that the project keeps.
"""

import os
import signal
import subprocess
import sys
from itertools import product
from pathlib import Path

import matplotlib.pyplot as plt
import pytest

import torch_pbd
from torch_pbd.cli.commands import WORK
from torch_pbd.cli.main import main

COMMAND = [sys.executable, "-m", "torch_pbd.cli.main"]
GMM = ["--model", "GMMBaseline", "--model.n_components", "2"]


@pytest.fixture(autouse=True)
def empty_figures(monkeypatch):
    """Figures take most of the time of a short run; those of other processes are drawn."""
    monkeypatch.setattr("torch_pbd.experiments.comparison.figure_of", lambda *_: plt.figure())


def refused(data, output, capsys):
    """The one line that a run says whose folder cannot be written; before any work."""
    assert main(["fit", "--data", str(data), *GMM, "--output", str(output)]) == 2
    shown = capsys.readouterr()
    assert shown.out == ""
    assert shown.err.count("\n") == 1
    assert shown.err.startswith("torch-pbd: output: ")
    assert repr(str(output)) in shown.err
    assert "--output FOLDER" in shown.err
    return shown.err


def test_a_missing_extra_is_one_line(tmp_path, monkeypatch, capsys):
    (tmp_path / "a.parquet").write_bytes(b"PAR1")
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    monkeypatch.setitem(sys.modules, "pyarrow.parquet", None)
    assert main(["inspect", str(tmp_path / "a.parquet"), "--output", str(tmp_path / "run")]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert said.endswith("pip install 'torch_pbd[parquet]'.\n")


def test_47_a_file_in_the_place_of_the_folder_is_told_before_the_work(data, tmp_path, capsys):
    (tmp_path / "file").write_text("mine")
    assert "File exists" in refused(data, tmp_path / "file", capsys)
    assert "Not a directory" in refused(data, tmp_path / "file" / "below", capsys)
    assert (tmp_path / "file").read_text() == "mine"


@pytest.mark.parametrize("part", ["model", "figures", "schedule", "finished"])
def test_47_so_is_one_in_the_place_of_a_folder_in_it(part, data, tmp_path, capsys):
    (tmp_path / part).write_text("mine")
    assert "no folder" in refused(data, tmp_path, capsys)


@pytest.mark.parametrize(
    "part", ["metrics.csv", "config.yaml", "env.json", "model/gmmbaseline.safetensors", "figures/a.png"]
)
def test_47_so_is_a_folder_in_the_place_of_a_file_in_it(part, data, tmp_path, capsys):
    (tmp_path / part).mkdir(parents=True)
    (tmp_path / "mine").mkdir()
    assert f"{part} stands where a file of results may have to: move it away" in refused(data, tmp_path, capsys)
    (tmp_path / part).rmdir()
    assert main(["fit", "--data", str(data), *GMM, "--output", str(tmp_path)]) == 0


def test_47_a_folder_that_may_not_be_written_is_told_before_the_work(data, tmp_path, capsys):
    locked = tmp_path / "locked"
    locked.mkdir(mode=0o500)
    if os.access(locked, os.W_OK):
        pytest.skip("everything is writable for this user")
    assert "Permission denied" in refused(data, locked, capsys)
    assert "Permission denied" in refused(data, locked / "new", capsys)


@pytest.mark.parametrize("arguments", [["--output", ""], ["--output="], ["--config", "c.yaml"]], ids=" ".join)
def test_47_no_name_is_no_folder(arguments, data, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("c.yaml").write_text("output: ''\n")
    assert main(["fit", "--data", str(data), *GMM, *arguments]) == 2
    assert capsys.readouterr().err == (
        "torch-pbd: output: it is empty, must be a folder of results. Give one with --output FOLDER.\n"
    )
    assert [path.name for path in tmp_path.iterdir()] == ["c.yaml"]


@pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="no folder that nobody can write in")
def test_47_nor_can_one_be_made_where_nobody_may(data, capsys):
    refused(data, Path("/proc/self/nowhere/runs"), capsys)


@pytest.mark.parametrize("name", ["with spaces", "überprüfung 軌跡", "-dash", "quote's"])
def test_47_names_of_any_kind(name, data, tmp_path, capsys):
    output = tmp_path / name / "run"
    assert main(["fit", "--data", str(data), *GMM, "--output", str(output)]) == 0
    assert f"results: {output}" in capsys.readouterr().out
    assert main(["fit", "--config", str(output / "config.yaml")]) == 0
    torch_pbd.load(output / "model" / "gmmbaseline.safetensors")


def test_47_a_link_to_a_folder_is_that_folder(data, tmp_path):
    (tmp_path / "there").mkdir()
    (tmp_path / "link").symlink_to("there")
    assert main(["fit", "--data", str(data), *GMM, "--output", str(tmp_path / "link")]) == 0
    assert (tmp_path / "there" / "model" / "gmmbaseline.safetensors").is_file()
    assert (tmp_path / "link").is_symlink()


@pytest.mark.parametrize(
    ("closed", "arguments"),
    [
        *product([["stdout"], ["stderr"]], [["--help"], ["demo", "--help"], ["demo", "--print_config"]]),
        (["stdout", "stderr"], ["fit"]),
        pytest.param(["stdout"], ["fit"], marks=pytest.mark.slow),  # where what the other says is seen
        pytest.param(["stderr"], ["fit"], marks=pytest.mark.slow),
    ],
    ids=" ".join,
)
def test_48_nobody_who_reads_is_no_error(closed, arguments, data, tmp_path):
    """As in ``torch-pbd ... | head -0``: no traceback, and the results are there."""
    if arguments == ["fit"]:
        arguments = ["fit", "--data", str(data), *GMM, "--output", str(tmp_path / "out")]
        arguments += ["--resume"]  # which says to standard error that there is nothing to resume
    reading, writing = os.pipe()
    os.close(reading)
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE} | dict.fromkeys(closed, writing)
    buffered = {key: value for key, value in os.environ.items() if key != "PYTHONUNBUFFERED"}  # as it is for users
    process = subprocess.Popen([*COMMAND, *arguments], text=True, env=buffered, **streams)
    os.close(writing)
    out, err = process.communicate(timeout=120)
    assert process.returncode == 0
    assert "Traceback" not in f"{out}{err}"
    assert "Broken" not in f"{out}{err}"
    if arguments[0] == "fit":
        torch_pbd.load(tmp_path / "out" / "model" / "gmmbaseline.safetensors")


@pytest.fixture(scope="module")
def bare(data, tmp_path_factory):
    """Folder and process of a fit without a display, of a terminal that shows ASCII."""
    folder = tmp_path_factory.mktemp("bare")
    environment = {key: value for key, value in os.environ.items() if key not in ("DISPLAY", "WAYLAND_DISPLAY")}
    environment |= {"PYTHONIOENCODING": "ascii", "MPLBACKEND": "TkAgg"}
    command = [*COMMAND, "fit", "--data", str(data), *GMM, "--output", "ü"]
    return folder / "ü", subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, timeout=120, check=False
    )


def test_letters_that_a_terminal_has_not_are_no_error(bare):
    """The encoding of the terminal is not that of the file system; nothing is lost because of what is printed."""
    folder, done = bare
    assert done.returncode == 0, done.stderr
    assert done.stdout.endswith("results: ?\n")
    torch_pbd.load(folder / "model" / "gmmbaseline.safetensors")


def test_49_without_a_display_figures_are_drawn(bare):
    folder, done = bare
    assert done.returncode == 0, done.stderr
    assert (folder / "figures" / "gmmbaseline.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_38_a_signal_while_torch_is_loaded_is_one_line(number, data, monkeypatch, capsys):
    def interrupted(*_):
        signal.raise_signal(number)

    monkeypatch.setattr("torch_pbd.cli.commands.parse", interrupted)
    assert main(["fit", "--data", str(data)]) == {signal.SIGINT: 130, signal.SIGTERM: 143}[number]
    shown = capsys.readouterr()
    assert shown.err == {signal.SIGINT: "torch-pbd: interrupted\n", signal.SIGTERM: "torch-pbd: terminated\n"}[number]
    assert shown.out == ""


@pytest.mark.parametrize(
    "error",
    [
        OverflowError("(34, 'Numerical result out of range')"),
        ZeroDivisionError("division by zero"),
        RuntimeError("expected a tensor\n\nof another shape"),
        NotImplementedError("no such kernel"),
        RecursionError("maximum recursion depth exceeded"),
    ],
    ids=lambda error: type(error).__name__,
)
def test_an_error_from_deep_inside_is_one_line_with_its_type(error, data, tmp_path, monkeypatch, capsys):
    def failing(*_):
        raise error

    monkeypatch.setitem(WORK, "fit", failing)
    assert main(["fit", "--data", str(data), "--output", str(tmp_path)]) == 1
    assert capsys.readouterr().err == f"torch-pbd: {type(error).__name__}: {' '.join(str(error).split())}\n"


def test_memory_that_is_not_enough_is_one_line(data, tmp_path, monkeypatch, capsys):
    def too_much(*_):
        raise MemoryError

    monkeypatch.setitem(WORK, "fit", too_much)
    assert main(["fit", "--data", str(data), "--output", str(tmp_path)]) == 1
    assert capsys.readouterr().err == "torch-pbd: the memory is not enough\n"

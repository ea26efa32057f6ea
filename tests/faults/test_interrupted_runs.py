"""Runs of the command line that are interrupted, terminated, killed, out of disk, or two at a time.

Numbers in the names are those of the list of faults that the project keeps.
"""

import csv
import errno
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest
import torch
from sklearn.base import clone
from sklearn.linear_model import LinearRegression

import torch_pbd
from torch_pbd import (
    CholeskyCovRegressor,
    Demonstrations,
    DMPController,
    GMMBaseline,
    HeteroscedasticGPRegressor,
    WishartProcessRegressor,
    load_demonstrations,
)
from torch_pbd.cli.main import main
from torch_pbd.experiments import robot, run_folder
from torch_pbd.experiments.robot import run_robot
from torch_pbd.experiments.run_folder import FinishedFits, RunFolder, fit_once
from torch_pbd.experiments.simulation import run_demo

# What these runs are of was recorded by nobody: a few samples, without units, cut anywhere.
pytestmark = [
    pytest.mark.filterwarnings(f"ignore:The {what}") for what in ("demonstrations tell no", "movement starts at")
]

SIGNALS = {signal.SIGINT: (130, "interrupted"), signal.SIGTERM: (143, "terminated")}
KILLS = Path(__file__).parents[2] / "scripts" / "benchmarks" / "kills.py"
FOLDS = ["LL 1", "LL 2"]
MIXTURE = {"class_path": "GMMBaseline", "init_args": {"n_components": 2}}


def fit(data, output, *more):
    model = ["--model", "GMMBaseline", "--model.n_components", "2"]
    return main(["fit", "--data", str(data), *model, "--output", str(output), *more])


def metrics(folder):
    """Rows, but for what a clock measured."""
    with (folder / "metrics.csv").open() as file:
        return [row | {"fit [s]": ""} for row in csv.DictReader(file)]


def model_bytes(folder):
    return {path.name: path.read_bytes() for path in (folder / "model").iterdir()}


def finished(folder):
    return sorted((folder / "finished").iterdir()) if (folder / "finished").exists() else []


def watched(monkeypatch, number=None, at=0):
    """List that grows with each fit that is carried out here; the process gets a signal at the end of one of them."""
    timed_fit, fits = run_folder._timed_fit, []

    def fit_and_signal(model, *data):
        result = timed_fit(model, *data)
        fits.append(type(model).__name__)
        if len(fits) == at:
            signal.raise_signal(number)
        return result

    monkeypatch.setattr(run_folder, "_timed_fit", fit_and_signal)
    return fits


@pytest.fixture(autouse=True)
def empty_figures(monkeypatch):
    """Figures take most of the time of a short run."""
    monkeypatch.setattr("torch_pbd.experiments.comparison.figure_of", lambda *_: plt.figure())


@pytest.fixture(scope="module")
def whole(data, tmp_path_factory):
    """Folder of a fit that was not cut."""
    folder = tmp_path_factory.mktemp("whole")
    assert fit(data, folder) == 0
    return folder


@pytest.fixture(scope="module")
def recorded(data):
    """Few samples of what is in the file."""
    return load_demonstrations(data).resample(8)


@pytest.mark.parametrize("number", SIGNALS)
def test_36_38_a_cut_fit_begins_again_and_ends_the_same(number, data, whole, tmp_path, monkeypatch, capsys):
    code, word = SIGNALS[number]
    handlers = [signal.getsignal(each) for each in SIGNALS]
    with monkeypatch.context() as patched:
        watched(patched, number, at=1)
        assert fit(data, tmp_path) == code
    assert capsys.readouterr().err == f"torch-pbd: {word}\n"  # there is nothing to go on from
    assert [signal.getsignal(each) for each in SIGNALS] == handlers
    assert finished(tmp_path) == []
    assert main(["fit", "--config", str(tmp_path / "config.yaml"), "--resume"]) == 0
    assert "nothing finished to resume from" in capsys.readouterr().err
    assert (metrics(tmp_path), model_bytes(tmp_path)) == (metrics(whole), model_bytes(whole))


@pytest.mark.parametrize("number", SIGNALS)
def test_36_38_a_finished_fit_is_reused(number, data, whole, tmp_path, monkeypatch, capsys):
    """The signal comes while the figure is drawn."""
    code, word = SIGNALS[number]
    with monkeypatch.context() as patched:
        patched.setattr("torch_pbd.experiments.comparison.figure_of", lambda *_: signal.raise_signal(number))
        assert fit(data, tmp_path) == code
    config = tmp_path / "config.yaml"
    assert capsys.readouterr().err == f"torch-pbd: {word}; torch-pbd fit --config {config} --resume goes on\n"
    assert len(finished(tmp_path)) == 1
    fits = watched(monkeypatch)
    assert main(["fit", "--config", str(config), "--resume"]) == 0
    assert capsys.readouterr().err == ""
    assert fits == []
    assert (metrics(tmp_path), model_bytes(tmp_path)) == (metrics(whole), model_bytes(whole))
    assert not (tmp_path / "finished").exists()


def compare(data, output, *more):
    models = json.dumps({"mixture": MIXTURE, "default": "GMMBaseline"})
    return main(
        ["compare", "--data", str(data), "--models", models, "--max_folds", "2", "--output", str(output), *more]
    )


def test_36_a_comparison_goes_on_with_the_fits_that_are_left(data, tmp_path, monkeypatch):
    """Two models, and both without each of two demonstrations."""
    fits = watched(monkeypatch)
    assert compare(data, tmp_path / "whole") == 0
    assert len(fits) == 2 + 2 * 2
    with monkeypatch.context() as patched:
        watched(patched, signal.SIGTERM, at=4)
        assert compare(data, tmp_path / "cut") == 143
    assert len(finished(tmp_path / "cut")) == 3
    fits.clear()
    assert compare(data, tmp_path / "cut", "--resume") == 0
    assert len(fits) == 3
    assert metrics(tmp_path / "cut") == metrics(tmp_path / "whole")
    assert model_bytes(tmp_path / "cut") == model_bytes(tmp_path / "whole")


def test_36_processes_keep_and_reuse_their_fits_too(data, tmp_path, monkeypatch):
    """One of the folds' fits is gone, and another one exchanged, which shows that it is taken."""
    with monkeypatch.context() as patched:
        patched.setattr("torch_pbd.experiments.comparison.figure_of", lambda *_: signal.raise_signal(signal.SIGTERM))
        assert compare(data, tmp_path, "--n_jobs", "2") == 143
    whole, _, gone, exchanged, *others = sorted(finished(tmp_path), key=lambda file: file.stat().st_mtime_ns)
    assert len(others) == 2
    before = metrics(tmp_path)
    gone.unlink()
    exchanged.write_bytes(whole.read_bytes())
    assert compare(data, tmp_path, "--n_jobs", "2", "--resume") == 0
    cells = [(row[fold], other[fold]) for row, other in zip(before, metrics(tmp_path), strict=True) for fold in FOLDS]
    assert [value == other for value, other in cells].count(False) == 1


def test_36_an_experiment_goes_on_with_the_controllers_that_are_left(recorded, tmp_path, monkeypatch):
    monkeypatch.setattr(RunFolder, "write_controller", lambda self, name, own, *_, **__: self.write_model(own, name))
    for figure in ("task_figure", "variability_figure", "pushes_figure"):
        monkeypatch.setattr(robot, figure, lambda *_, **__: None)
    skill = DMPController(GMMBaseline(n_components=2), n_steps=20)
    controllers = {"stiff": skill, "soft": clone(skill).set_params(alpha=16.0)}
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell lets what it runs in the background ignore it
    with RunFolder(tmp_path, {}) as folder:
        with monkeypatch.context() as patched:
            watched(patched, signal.SIGINT, at=2)
            with pytest.raises(KeyboardInterrupt):
                run_robot(controllers, recorded, folder, rate=20.0)
        fits = watched(monkeypatch)
        run_robot(controllers, recorded, folder, rate=20.0)
        assert fits == ["DMPController"]
    assert {torch_pbd.load(file).alpha for file in (tmp_path / "model").iterdir()} == {25.0, 16.0}


@pytest.mark.slow
def test_36_a_demo_goes_on_with_the_fits_that_are_left(tmp_path, monkeypatch):
    models = {"mixture": GMMBaseline(n_components=2)}
    fits = watched(monkeypatch)
    with RunFolder(tmp_path, {}) as folder:
        text = run_demo(models, folder, n_demos=3)
        assert fits == ["GMMBaseline", "DMPController"]
        assert len(finished(tmp_path)) == 2
        assert run_demo(models, folder, n_demos=3) == text
        assert len(fits) == 2


@pytest.mark.filterwarnings("ignore:.*stopped early")
@pytest.mark.parametrize(
    "model",
    [
        CholeskyCovRegressor(objective="likelihood"),
        WishartProcessRegressor(objective="likelihood", max_iter=20),
        HeteroscedasticGPRegressor(),
        GMMBaseline(n_components=2),
        DMPController(GMMBaseline(n_components=2), n_steps=20),
    ],
    ids=lambda model: type(model).__name__,
)
def test_36_a_fit_is_the_same_from_its_file_to_the_byte(model, recorded, tmp_path, monkeypatch):
    given = (recorded,) if isinstance(model, DMPController) else recorded.stack()
    fits, files = watched(monkeypatch), [tmp_path / "fitted", tmp_path / "loaded"]
    for file in files:
        fitted, seconds = fit_once(clone(model), *given, finished=FinishedFits(tmp_path / "finished"))
        torch_pbd.save(fitted, file)
        assert f"{seconds:.6f}" in finished(tmp_path)[0].name
    assert len(fits) == 1
    assert files[0].read_bytes() == files[1].read_bytes()


def test_fits_of_other_parameters_data_or_versions_are_others(recorded, monkeypatch):
    model = GMMBaseline(n_components=2)
    controller = DMPController(model, n_steps=20)
    X, y, groups = recorded.stack()

    def named(**labels):
        return Demonstrations(recorded.times, recorded.positions, **labels)

    others = [
        (model, X, y, groups),
        (GMMBaseline(n_components=2, tol=1e-4), X, y, groups),
        (CholeskyCovRegressor(), X, y, groups),
        (model, X + 1.0, y, groups),
        (model, X, np.nextafter(y, 0.0), groups),
        (model, X, y, groups[::-1]),
        (model, X[:-1], y[:-1], groups[:-1]),
        (controller, recorded),
        (controller, named(names=["a", "b"])),
        (controller, named(units="m")),
        (DMPController(model, n_steps=20, mass=2.0), recorded),
        (DMPController(GMMBaseline(n_components=3), n_steps=20), recorded),
    ]
    keys = [run_folder._key(*given) for given in others]
    assert len(set(keys)) == len(others)
    assert keys == [run_folder._key(clone(given[0]), *given[1:]) for given in others]
    for package in (torch_pbd, torch):
        with monkeypatch.context() as patched:
            patched.setattr(package, "__version__", "0")
            assert not {run_folder._key(*given) for given in others} & set(keys)


def test_a_peer_that_has_no_file_is_always_fitted(recorded, tmp_path, monkeypatch):
    fits = watched(monkeypatch)
    for _ in range(2):
        fit_once(LinearRegression(), *recorded.stack(), finished=FinishedFits(tmp_path / "finished"))
    assert len(fits) == 2
    assert finished(tmp_path) == []


def test_finished_fits_of_another_run_are_told_of_where_they_are_not_used(data, tmp_path, monkeypatch, capsys):
    def cut():
        with monkeypatch.context() as patched:
            patched.setattr("torch_pbd.experiments.comparison.figure_of", lambda *_: signal.raise_signal(signal.SIGINT))
            assert fit(data, tmp_path) == 130
        capsys.readouterr()

    cut()
    assert fit(data, tmp_path, "--resume", "--model.tol", "1e-4") == 0
    assert "nothing finished to resume from" in capsys.readouterr().err
    assert finished(tmp_path) == []
    cut()
    (tmp_path / "finished" / "mine.safetensors").write_text("not of the run")
    fits = watched(monkeypatch)
    assert fit(data, tmp_path) == 0
    assert fits == ["GMMBaseline"]
    assert "--resume would have gone on with it" in capsys.readouterr().err
    assert [file.name for file in finished(tmp_path)] == ["mine.safetensors"]


def test_a_finished_fit_that_is_damaged_is_an_error(data, tmp_path, monkeypatch, capsys):
    with monkeypatch.context() as patched:
        patched.setattr("torch_pbd.experiments.comparison.figure_of", lambda *_: signal.raise_signal(signal.SIGTERM))
        assert fit(data, tmp_path) == 143
    (file,) = finished(tmp_path)
    file.write_bytes(file.read_bytes()[:-1])
    assert fit(data, tmp_path, "--resume") == 1
    assert f"torch-pbd: {file} is" in capsys.readouterr().err


@pytest.mark.slow
def test_37_killed_runs_lose_nothing(tmp_path):
    """Killed at calls that change files, spread over all that a run makes, and at random times."""
    command = [sys.executable, str(KILLS), "--trials", "1", "--crash_points", "5", "--models", "CD"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    name, _, n_changes, n_kills, n_working, lost = done.stdout.splitlines()[1].split()
    assert (name, n_kills, lost) == ("CD", "6", "0")
    assert int(n_changes) > 20
    assert int(n_working) >= 5  # those at changes of files; at a random time a run may have ended


@pytest.mark.parametrize("numbers", [("SIGINT", "SIGINT"), ("SIGTERM", "SIGINT")])
def test_38_the_second_signal_ends_the_process_at_once(numbers):
    """Even where what the first one raises is held up."""
    script = f"""
import signal, sys
import torch_pbd.cli.commands
from torch_pbd.cli.main import main

def signalled(*_):
    try:
        signal.raise_signal(signal.{numbers[0]})
    finally:
        signal.raise_signal(signal.{numbers[1]})

torch_pbd.cli.commands.parse = signalled
sys.exit(main(["demo"]))
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == -getattr(signal, numbers[1])
    assert done.stderr == ""


def test_39_a_full_disk_leaves_the_earlier_model_and_the_finished_fit(data, whole, tmp_path, monkeypatch, capsys):
    assert fit(data, tmp_path, "--model.tol", "1e-2") == 0
    earlier, sync, write_model = model_bytes(tmp_path), os.fsync, RunFolder.write_model

    def full(descriptor):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def write_to_full_disk(self, *model):
        monkeypatch.setattr(os, "fsync", full)
        return write_model(self, *model)

    monkeypatch.setattr(RunFolder, "write_model", write_to_full_disk)
    assert fit(data, tmp_path) == 1
    monkeypatch.setattr(os, "fsync", sync)
    monkeypatch.setattr(RunFolder, "write_model", write_model)
    shown = capsys.readouterr().err.strip().splitlines()[-1]
    assert "No space left" in shown
    assert str(tmp_path / "model" / "gmmbaseline.safetensors") in shown
    assert model_bytes(tmp_path) == earlier != model_bytes(whole)
    assert not [path for path in tmp_path.rglob("*") if path.name.endswith(".draft")]
    fits = watched(monkeypatch)
    assert fit(data, tmp_path, "--resume") == 0
    assert fits == []
    assert model_bytes(tmp_path) == model_bytes(whole)


def test_46_a_second_run_on_one_folder_is_refused_and_told_who_has_it(data, tmp_path, capsys):
    output = tmp_path / "out"
    with RunFolder(output, {}):
        before = {path: path.read_bytes() for path in output.rglob("*") if path.is_file()}
        assert fit(data, output) == 3
        shown = capsys.readouterr()
        assert {path: path.read_bytes() for path in output.rglob("*") if path.is_file()} == before
    owner = json.loads((output / "env.json").read_text())["process"]
    assert owner["id"] == os.getpid()
    assert f"is being written by process {owner['id']} on {owner['host']}, since {owner['started']}" in shown.err
    assert shown.err.count("\n") == 1
    assert shown.out == ""
    assert fit(data, output) == 0  # it is free again


def test_46_what_a_killed_run_left_half_written_is_removed(data, tmp_path):
    output = tmp_path / "out"
    (output / "model").mkdir(parents=True)
    (output / "finished").mkdir()
    drafts = [output / ".metrics.csv.123.00c0ffee.draft", output / "model" / ".x.safetensors.9.00c0ffee.draft"]
    drafts.append(output / "finished" / ".y.safetensors.9.00c0ffee.draft")
    others = [output / "notes.draft", output / ".hidden"]
    for path in (*drafts, *others):
        path.write_text("half")
    RunFolder(output, {}).close()
    assert not any(path.exists() for path in drafts)
    assert all(path.exists() for path in others)

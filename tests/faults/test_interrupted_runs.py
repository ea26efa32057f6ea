"""Runs of the command line that are interrupted, terminated, killed, out of disk, or two at a time.

Numbers in the names are those of the list of faults that the project keeps.
"""

import csv
import errno
import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import torch_pbd
from torch_pbd import Demonstrations
from torch_pbd.checkpoint import read_checkpoint
from torch_pbd.cli import main
from torch_pbd.experiments.run_folder import RunFolder
from torch_pbd.optim import Journal

MODELS = {
    "cholesky": ["CholeskyCovRegressor", "--model.objective", "likelihood", "--model.latent_prior", "false"],
    "wishart": ["WishartProcessRegressor", "--model.start", "random"],
    "heteroscedastic": ["HeteroscedasticGPRegressor"],
    "mixture": ["GMMBaseline", "--model.tol", "1e-12"],
}
SIGNALS = {signal.SIGINT: (130, "interrupted"), signal.SIGTERM: (143, "terminated")}
KILLS = Path(__file__).parents[2] / "scripts" / "benchmarks" / "kills.py"


def fit(data, output, model="cholesky", *more):
    arguments = ["--model", *MODELS[model], "--model.max_iter", "30", "--output", str(output), *more]
    return main(["fit", "--data", str(data), *arguments])


def metrics(folder):
    with (folder / "metrics.csv").open() as file:
        return list(csv.DictReader(file))


def model_bytes(folder):
    (path,) = (folder / "model").iterdir()
    return path.read_bytes()


def signalled(monkeypatch, number, n_states):
    """The process gets a signal once so many states of optimizations are kept."""
    keep, kept = Journal.keep, []

    def keep_and_signal(self, *state, **options):
        keep(self, *state, **options)
        kept.append(1)
        if len(kept) == n_states:
            signal.raise_signal(number)

    monkeypatch.setattr(Journal, "keep", keep_and_signal)


@pytest.mark.filterwarnings("ignore:.*stopped early")
@pytest.mark.parametrize("n_states", [1, 3])
@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("number", SIGNALS)
def test_36_38_a_signal_leaves_a_checkpoint_and_the_resumed_run_ends_as_the_whole_one(
    number, model, n_states, data, tmp_path, monkeypatch, capsys
):
    code, word = SIGNALS[number]
    handlers = [signal.getsignal(each) for each in SIGNALS]
    assert fit(data, tmp_path / "whole", model) == 0
    with monkeypatch.context() as patched:
        signalled(patched, number, n_states)
        capsys.readouterr()
        assert fit(data, tmp_path / "cut", model) == code
    shown = capsys.readouterr().err.strip().splitlines()
    config = tmp_path / "cut" / "config.yaml"
    assert shown[-1] == f"torch-pbd: {word}; torch-pbd fit --config {config} --resume goes on"
    assert not any("Traceback" in line for line in shown)
    assert [signal.getsignal(each) for each in SIGNALS] == handlers
    assert len(read_checkpoint(tmp_path / "cut" / "checkpoint")[1]) >= 1
    assert main(["fit", "--config", str(config), "--resume"]) == 0
    assert metrics(tmp_path / "cut") == metrics(tmp_path / "whole")
    assert model_bytes(tmp_path / "cut") == model_bytes(tmp_path / "whole")
    assert not (tmp_path / "cut" / "checkpoint").exists()


@pytest.mark.parametrize("n_jobs", ["1", "2"])
def test_36_a_comparison_goes_on_with_the_folds_that_are_left(n_jobs, data, tmp_path, monkeypatch, capsys):
    models = (
        '{"mixture": {"class_path": "GMMBaseline", "init_args": {"n_components": 2}}, "CD": "CholeskyCovRegressor"}'
    )
    arguments = ["compare", "--data", str(data), "--models", models, "--n_jobs", n_jobs]
    assert main([*arguments, "--output", str(tmp_path / "whole")]) == 0
    with monkeypatch.context() as patched:
        signalled(patched, signal.SIGTERM, 6)
        assert main([*arguments, "--output", str(tmp_path / "cut")]) == 143
    entries = read_checkpoint(tmp_path / "cut" / "checkpoint")[1]
    assert [entry.ended for entry in entries] == [True] * 6 + [False] * 2
    assert main([*arguments, "--output", str(tmp_path / "cut"), "--resume"]) == 0
    whole, resumed = metrics(tmp_path / "whole"), metrics(tmp_path / "cut")
    for row, other in zip(whole, resumed, strict=True):
        assert row | {"fit [s]": 0} == other | {"fit [s]": 0}


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
def test_38_the_second_signal_ends_the_process_at_once(numbers, data, tmp_path):
    """Even while the checkpoint is being written for the first one; what was written before stays whole."""
    script = f"""
import os, signal, sys
from torch_pbd.cli import main
from torch_pbd.optim import Journal

write = Journal.write

def write_twice(self):
    write(self)
    if self.entries and signal.getsignal(signal.SIGINT) is signal.SIG_DFL:
        os.kill(os.getpid(), signal.{numbers[1]})

keep = Journal.keep

def keep_and_signal(self, *state, **options):
    keep(self, *state, **options)
    signal.raise_signal(signal.{numbers[0]})

Journal.write, Journal.keep = write_twice, keep_and_signal
sys.exit(main(sys.argv[1:]))
"""
    arguments = ["fit", "--data", str(data), "--model", *MODELS["cholesky"], "--output", str(tmp_path / "out")]
    done = subprocess.run(
        [sys.executable, "-c", script, *arguments], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == -signal.SIGINT
    assert "Traceback" not in done.stderr
    assert len(read_checkpoint(tmp_path / "out" / "checkpoint")[1]) == 1


def test_a_checkpoint_of_other_work_is_refused(data, tmp_path, monkeypatch, capsys):
    output = tmp_path / "out"
    with monkeypatch.context() as patched:
        signalled(patched, signal.SIGTERM, 2)
        assert fit(data, output) == 143
    before = (output / "checkpoint").read_bytes(), (output / "config.yaml").read_bytes()
    capsys.readouterr()
    assert fit(data, output, "cholesky", "--resume", "--model.tol", "1e-9") == 2
    shown = capsys.readouterr().err
    assert "resume: " in shown
    assert re.search(r"options\.model\.init_args\.tol was 0\.\d+, is 1e-09\. Give what it had", shown)
    other = tmp_path / "other.npz"
    torch_pbd.save_demonstrations(
        Demonstrations(np.arange(9.0), np.random.default_rng(1).normal(size=(3, 9, 2))), other
    )
    assert fit(other, output, "cholesky", "--resume") == 2
    assert "data was" in capsys.readouterr().err
    assert before == ((output / "checkpoint").read_bytes(), (output / "config.yaml").read_bytes())
    (output / "checkpoint").write_bytes(before[0][:-1])
    assert fit(data, output, "cholesky", "--resume") == 1
    assert str(output / "checkpoint") in capsys.readouterr().err


def test_a_checkpoint_is_told_of_where_it_is_not_used_and_where_there_is_none(data, tmp_path, monkeypatch, capsys):
    output = tmp_path / "out"
    assert fit(data, output, "cholesky", "--resume") == 0
    assert "There is no" in capsys.readouterr().err
    with monkeypatch.context() as patched:
        signalled(patched, signal.SIGTERM, 2)
        assert fit(data, output) == 143
    assert fit(data, output) == 0
    assert "with --resume that run would have gone on" in capsys.readouterr().err


def test_39_a_full_disk_leaves_the_earlier_model_and_what_was_learned(data, tmp_path, monkeypatch, capsys):
    output = tmp_path / "out"
    assert fit(data, output, "mixture") == 0
    (output / "model" / "gmmbaseline.safetensors").rename(output / "model" / "choleskycovregressor.safetensors")
    earlier = model_bytes(output)
    sync, full = os.fsync, []

    def fsync(descriptor):
        if full and not Path(f"/proc/self/fd/{descriptor}").readlink().name.startswith(".checkpoint"):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        sync(descriptor)

    if not Path("/proc/self/fd").is_dir():
        pytest.skip("this system does not tell the names of open files")
    keep = Journal.keep
    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", fsync)
        patched.setattr(Journal, "keep", lambda *state, **options: (keep(*state, **options), full.append(1)))
        assert fit(data, output) == 1
    shown = capsys.readouterr().err.strip().splitlines()[-1]
    assert "No space left" in shown
    assert str(output / "model" / "choleskycovregressor.safetensors") in shown
    assert model_bytes(output) == earlier
    assert not [path for path in output.rglob("*") if path.name.endswith(".draft")]
    assert fit(data, output, "cholesky", "--resume") == 0
    assert fit(data, tmp_path / "whole") == 0
    assert model_bytes(output) == model_bytes(tmp_path / "whole")


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
    drafts = [output / ".metrics.csv.123.00c0ffee.draft", output / "model" / ".x.safetensors.9.00c0ffee.draft"]
    others = [output / "notes.draft", output / ".hidden"]
    for path in (*drafts, *others):
        path.write_text("half")
    RunFolder(output, {}).close()
    assert not any(path.exists() for path in drafts)
    assert all(path.exists() for path in others)

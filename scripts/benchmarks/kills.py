"""Kill fits of the command line: what is lost, and does ``--resume`` end where the whole run does?

``python scripts/benchmarks/kills.py --trials 200`` kills at random times, ``--crash_points 50`` at calls that change
files (writes, renames, removals), spread over all that a run makes. A trial is lost if a model that was there before is
gone or changed and no new one took its place whole, if a finished fit cannot be read, if ``--resume`` fails or ends at
another loss, or if a draft or a finished fit stays. Children are forked from one process that has loaded torch: POSIX
only.
"""

import argparse
import csv
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

import torch_pbd
from torch_pbd.cli.main import main
from torch_pbd.experiments import comparison  # noqa: F401 - loaded before the forks

_CHANGES = ("fsync", "replace", "rename", "unlink", "link", "mkdir", "rmdir")  # of os
FIT = {
    "CD": ["CholeskyCovRegressor", "--model.objective", "likelihood", "--model.latent_prior", "false"],
    "WP": ["WishartProcessRegressor", "--model.objective", "likelihood", "--model.solver", "fisher"],
    "GMM": ["GMMBaseline", "--model.solver", "lbfgs"],
    "HGP": ["HeteroscedasticGPRegressor"],
}


def run() -> int:
    """Print a table; the exit code is the number of trials that lost something, at most 100."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=200, help="kills at random times, of all models together")
    parser.add_argument("--crash_points", type=int, default=0, help="kills at changes of files, of each model")
    parser.add_argument("--models", nargs="+", choices=FIT, default=list(FIT))
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    rng = random.Random(options.seed)
    lost = 0
    print("model  whole run [s]  changes  kills  of which while working  lost")
    for i, name in enumerate(options.models):
        n_trials = len(range(i, options.trials, len(options.models)))
        with tempfile.TemporaryDirectory() as folder:
            trial = Trial(Path(folder), FIT[name])
            kills = [trial.killed_after(rng.uniform(0.0, trial.seconds)) for _ in range(n_trials)]
            points = np.unique(np.linspace(1, trial.n_changes, options.crash_points).round().astype(int))
            kills += [trial.killed_at(int(point)) for point in points]
        problems = [problem for _, problem in kills if problem]
        lost += len(problems)
        working = sum(killed for killed, _ in kills)
        cells = f"{trial.seconds:13.2f}  {trial.n_changes:7d}  {len(kills):5d}  {working:22d}  {len(problems):4d}"
        print(f"{name:<5}  {cells}")
        for problem in problems[:5]:
            print(f"       {problem}")
    return min(lost, 100)


class Trial:
    """Runs of one model on one file, each in a folder where an earlier model is.

    Parameters
    ----------
    folder : Path
    model : sequence of str
        Name, and options of the command line.
    """

    def __init__(self, folder: Path, model: Sequence[str]) -> None:
        rng = np.random.default_rng(0)
        time_, n_demos = np.linspace(0.0, 2.0, 40), 6
        positions = rng.normal(size=(n_demos, 40, 2)).cumsum(axis=1) * [1.0, 1e-3]
        data = folder / "made.npz"
        torch_pbd.save_demonstrations(torch_pbd.Demonstrations(time_, positions), data)
        self.folder, self.earlier = folder, folder / "earlier"
        self.arguments = [
            "fit",
            "--data",
            str(data),
            "--model",
            *model,
            "--model.tol",
            "1e-9",
            "--model.max_iter",
            "40",
        ]
        _in_child(lambda: self._run(self.earlier, "--model.max_iter", "1"))  # the model that is there already
        whole = folder / "whole"
        start = time.perf_counter()
        _in_child(lambda: self._run(whole))
        self.seconds = time.perf_counter() - start
        self.loss, self.model = _loss(whole), next((whole / "model").iterdir()).read_bytes()
        counter = folder / "changes"
        _in_child(lambda: self._counted(folder / "counted", counter))
        self.n_changes = int(counter.read_text())

    def killed_after(self, seconds: float) -> tuple[bool, str]:
        """Kill a run at a time; whether it was still working, and what was lost."""
        return self._judged(lambda folder: _in_child(lambda: self._run(folder), kill_after=seconds))

    def killed_at(self, change: int) -> tuple[bool, str]:
        """Kill a run just before a change of a file; whether it came to it, and what was lost."""

        def run(folder: Path) -> int:
            return _in_child(lambda: self._run(_bomb(folder, change)))

        return self._judged(run)

    def _run(self, folder: Path, *more: str) -> int:
        return main([*self.arguments, *more, "--output", str(folder)])

    def _counted(self, folder: Path, counter: Path) -> int:
        calls = _watch(lambda _: None)
        code = self._run(folder)
        n_changes = len(calls)
        counter.write_text(str(n_changes))
        return code

    def _judged(self, run: Callable[[Path], int]) -> tuple[bool, str]:
        folder = Path(tempfile.mkdtemp(dir=self.folder)) / "run"
        shutil.copytree(self.earlier, folder)
        earlier = next((folder / "model").iterdir()).read_bytes()
        killed = run(folder) == -signal.SIGKILL
        try:
            return killed, self._lost(folder, earlier)
        except Exception as error:  # whatever is raised is what was lost
            return killed, f"{type(error).__name__}: {error}"
        finally:
            shutil.rmtree(folder.parent)

    def _lost(self, folder: Path, earlier: bytes) -> str:
        """What is not as it must be after a kill, and after the resumed run."""
        (path,) = (path for path in (folder / "model").iterdir() if path.suffix == ".safetensors")
        if path.read_bytes() not in (earlier, self.model):
            return "the model is neither the earlier one nor the new one"
        torch_pbd.load(path)
        finished = folder / "finished"
        for fit in finished.glob("*.safetensors"):
            torch_pbd.load(fit)
        code = _in_child(lambda: self._run(folder, "--resume"))
        left = [path.name for path in folder.rglob("*") if path.name.endswith(".draft")]
        if code or left or finished.exists():
            return f"--resume ended with {code}, left {left}, finished fits {finished.exists()}"
        if _loss(folder) != self.loss or path.read_bytes() != self.model:
            return f"--resume ended at loss {_loss(folder)}, the whole run at {self.loss}"
        return ""


def _loss(folder: Path) -> str:
    with (folder / "metrics.csv").open() as file:
        return next(csv.DictReader(file))["loss"]


def _bomb(folder: Path, change: int) -> Path:
    """From now on the process is killed just before so many changes of files."""

    def count(n_calls: int) -> None:
        if n_calls == change:
            os.kill(os.getpid(), signal.SIGKILL)

    _watch(count)
    return folder


def _watch(tell: Callable[[int], None]) -> list[str]:
    """List that grows by one before each change of a file; ``tell`` is given its length."""
    calls: list[str] = []

    def watched(name: str, function: Callable[..., object]) -> Callable[..., object]:
        def call(*arguments: object, **options: object) -> object:
            calls.append(name)
            tell(len(calls))
            return function(*arguments, **options)

        return call

    for name in _CHANGES:
        setattr(os, name, watched(name, getattr(os, name)))
    return calls


def _in_child(work: Callable[[], int], *, kill_after: float | None = None) -> int:
    """Exit code of some work in a forked process, or minus the signal that ended it; its output is dropped."""
    sys.stdout.flush()
    child = os.fork()
    if child == 0:
        code = 99
        try:
            with Path(os.devnull).open("w") as nothing:
                os.dup2(nothing.fileno(), 1)
                os.dup2(nothing.fileno(), 2)
                code = work()
        finally:
            os._exit(code)
    if kill_after is not None:
        time.sleep(kill_after)
        os.kill(child, signal.SIGKILL)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


if __name__ == "__main__":
    sys.exit(run())

"""Every comparison of speed in one run."""

import os
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import torch
from threadpoolctl import threadpool_limits

from speed import (
    control,
    fitting,
    growth,
    heteroscedastic,
    imports,
    likelihood,
    prediction,
)
from speed.report import tables, write
from speed.rows import Findings, Plan
from torch_pbd.experiments.run_folder import RunFolder

GROUPS: dict[str, Callable[[Plan], Findings]] = {
    "imports": imports.measure,
    "fitting": fitting.measure,
    "likelihood": likelihood.measure,
    "heteroscedastic": heteroscedastic.measure,
    "prediction": prediction.measure,
    "control": control.measure,
    "growth": growth.measure,
}


def run_benchmark(
    folder: RunFolder, groups: Sequence[str] = tuple(GROUPS), *, n_repetitions: int = 5, quick: bool = False
) -> str:
    """Run groups of comparisons, one thread, the contenders taking turns; write what they found.

    Parameters
    ----------
    folder : RunFolder
        Gets ``benchmark.json`` with all raw times, and the figures.
    groups : sequence of str
        Of :data:`GROUPS`.
    n_repetitions : int, default=5
        Of each contender; the slowest run once.
    quick : bool, default=False
        Small sizes, once, to see that everything runs.

    Returns
    -------
    str
        The tables.
    """
    plan = Plan(1 if quick else n_repetitions, quick, data=_recordings())
    found = []
    with _one_thread(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # others' length scales at their bounds, steps that are not enough
        for group in groups:
            found.append(GROUPS[group](plan))
            write(found, plan, folder)  # after each: a run that is stopped leaves what it has
    return tables(found)


def _recordings() -> Path | None:
    """Folder of recorded demonstrations, beside a development checkout or where ``TORCH_PBD_DATA`` says."""
    beside = Path(__file__).parents[4] / "shared" / "data"
    folder = Path(os.environ.get("TORCH_PBD_DATA", beside))
    return folder if folder.is_dir() else None


@contextmanager
def _one_thread() -> Iterator[None]:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with threadpool_limits(1):
            yield
    finally:
        torch.set_num_threads(threads)

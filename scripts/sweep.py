"""Leave one demonstration out over files of demonstrations and models, here or on a dask cluster; prints one table.

``python scripts/sweep.py --data '[a.npz, b.csv]' --n_jobs -1``; with ``--cluster tcp://host:8786`` on the workers of
that scheduler, which need this package too. Models as for ``torch-pbd compare``. Needs the extra ``sweep`` for a
cluster only.
"""

import contextlib
import sys
from pathlib import Path

import joblib

from torch_pbd.cli.commands import OPTIONS as COMMANDS
from torch_pbd.cli.options import Option, parse
from torch_pbd.console import say
from torch_pbd.data import load_demonstrations
from torch_pbd.exceptions import ConfigError
from torch_pbd.experiments.recordings import prepare
from torch_pbd.experiments.run_folder import format_table
from torch_pbd.experiments.sweep import summarize, sweep

_COMPARE = COMMANDS["compare"]
OPTIONS = {
    "data": Option(list[str] | None, None, "files of demonstrations, .npz or .csv", required=True),
    "models": _COMPARE["models"]._replace(help="name: regressor, several; the first is the one to beat"),
    "cluster": Option(str | None, None, "address of a dask scheduler; none: processes here"),
    "n_jobs": _COMPARE["n_jobs"]._replace(help="jobs at the same time; -1: all cores; on a cluster, none: all"),
    "max_folds": Option(int | None, None, "demonstrations to leave out of each file; none: each of them"),
    "align": _COMPARE["align"],
    "n_steps": _COMPARE["n_steps"],
}


def main(arguments: list[str]) -> int:
    """Sweep and print."""
    try:
        options, _ = parse("python scripts/sweep.py", "leave one demonstration out, of every file", OPTIONS, arguments)
    except ConfigError as error:
        say(f"sweep.py: {error}", sys.stderr)
        return 2
    files = _names(options.data).items()
    tasks = {name: prepare(load_demonstrations(path), options.align, options.n_steps) for name, path in files}
    with _where(options.cluster):
        rows = sweep(options.models, tasks, max_folds=options.max_folds, n_jobs=options.n_jobs)
    print(format_table(summarize(rows)))
    for row in rows:
        if row["error"]:
            print(f"{row['task']}, {row['model']}, without demonstration {row['fold']}: {row['error']}")
    return 0


def _names(data: list[str]) -> dict[str, str]:
    """Each file by its name without folder and suffix; where several have the same one, by its path."""
    stems = [Path(path).stem for path in data]
    return {path if stems.count(stem) > 1 else stem: path for stem, path in zip(stems, data, strict=True)}


@contextlib.contextmanager
def _where(cluster: str | None):
    if cluster is None:
        yield
        return
    from distributed import Client

    with Client(cluster), joblib.parallel_config("dask"):
        yield


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

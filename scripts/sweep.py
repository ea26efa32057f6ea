"""Leave one demonstration out over files of demonstrations and models, here or on a dask cluster; prints one table.

``python scripts/sweep.py --data '[a.npz, b.csv]' --n_jobs -1``; with ``--cluster tcp://host:8786`` on the workers of
that scheduler, which need this package too. Models as for ``torch-pbd compare``. Needs the extra ``sweep`` for a
cluster only.
"""

import contextlib
from pathlib import Path
from typing import Literal

import joblib
from jsonargparse import auto_cli

from torch_pbd import CholeskyCovRegressor, GMMBaseline, HeteroscedasticGPRegressor, WishartProcessRegressor
from torch_pbd.data import load_demonstrations
from torch_pbd.estimators.base import CovarianceRegressor
from torch_pbd.experiments.recordings import prepare
from torch_pbd.experiments.run_folder import format_table
from torch_pbd.experiments.sweep import summarize, sweep


def main(
    data: list[str],
    models: dict[str, CovarianceRegressor] | None = None,
    cluster: str | None = None,
    n_jobs: int | None = None,
    max_folds: int | None = None,
    align: Literal["auto", "none", "phase", "dtw"] = "auto",
    n_steps: int | None = None,
) -> None:
    """Sweep and print.

    Args:
        data: Files of demonstrations, .npz or .csv.
        models: Name and regressor, several; the first is what the others are held against.
        cluster: Address of a dask scheduler; none are processes here.
        n_jobs: Jobs at the same time, -1 for all cores; on a cluster, none for all.
        max_folds: Demonstrations to leave out of each file; none for each of them.
        align: How demonstrations come onto one grid.
        n_steps: Points of that grid.
    """
    if models is None:
        models = {
            "HGP": HeteroscedasticGPRegressor(),
            "CD": CholeskyCovRegressor(),
            "WP": WishartProcessRegressor(),
            "GMM 5": GMMBaseline(random_state=0),
        }
    tasks = {name: prepare(load_demonstrations(path), align, n_steps) for name, path in _names(data).items()}
    with _where(cluster):
        rows = sweep(models, tasks, max_folds=max_folds, n_jobs=n_jobs)
    print(format_table(summarize(rows)))
    for row in rows:
        if row["error"]:
            print(f"{row['task']}, {row['model']}, without demonstration {row['fold']}: {row['error']}")


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
    auto_cli(main, as_positional=False)

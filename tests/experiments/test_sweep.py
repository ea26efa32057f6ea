"""Campaigns are what their jobs are by themselves, wherever these run, and whatever fails among them."""

import joblib
import numpy as np
import pytest
import torch
from distributed import Client, LocalCluster
from sklearn.base import clone
from sklearn.model_selection import GridSearchCV, GroupKFold
from sweep import _one_thread, summarize, sweep
from threadpoolctl import threadpool_info

from torch_pbd import CholeskyCovRegressor, GMMBaseline
from torch_pbd.control import DMPController, simulate_many
from torch_pbd.data import Demonstrations, make_tunnel_demonstrations
from torch_pbd.metrics import mahalanobis_coverage

ESTIMATORS = {"CD": CholeskyCovRegressor(), "GMM": GMMBaseline(n_components=2, random_state=0)}


@pytest.fixture(scope="module")
def tasks():
    return {
        "tunnel": make_tunnel_demonstrations(4, rate=1.0, random_state=0),
        "another": make_tunnel_demonstrations(5, rate=1.5, random_state=1),
    }


@pytest.fixture(scope="module")
def serial(tasks):
    return sweep(ESTIMATORS, tasks)


@pytest.fixture(scope="module")
def schedule(tasks):
    return DMPController(ESTIMATORS["CD"], n_steps=20).fit(tasks["tunnel"]).schedule(20.0)


@pytest.fixture(scope="module")
def dask(tmp_path_factory):
    """joblib on the workers of a scheduler of this machine."""
    workers = {"n_workers": 2, "processes": True, "threads_per_worker": 1}
    with (
        LocalCluster(**workers, dashboard_address=None, local_directory=tmp_path_factory.mktemp("dask")) as cluster,
        Client(cluster),
    ):
        yield lambda: joblib.parallel_config("dask")


def without_times(rows):
    return [{key: value for key, value in row.items() if key != "fit_seconds"} for row in rows]


def test_every_fold_is_a_row(tasks, serial):
    labels = [(task, model, k) for task, demos in tasks.items() for model in ESTIMATORS for k in range(len(demos))]
    assert [(row["task"], row["model"], row["fold"]) for row in serial] == labels
    for row in serial:
        train, test = tasks[row["task"]].split(row["fold"])
        model = clone(ESTIMATORS[row["model"]]).fit(*train.stack()[:2])
        X, y, _ = test.stack()
        assert row["log_likelihood"] == pytest.approx(model.score(X, y), rel=1e-9)
        assert row["coverage"] == mahalanobis_coverage(*model.predict(X, return_cov=True), y, level=0.95)
        assert row["fit_seconds"] > 0.0
        assert row["error"] == ""


@pytest.mark.slow
def test_processes_make_no_difference(tasks, serial):
    assert without_times(sweep(ESTIMATORS, tasks, n_jobs=2)) == without_times(serial)


@pytest.mark.slow
def test_a_cluster_makes_no_difference(tasks, serial, schedule, dask):
    seeds = (0, 1)
    calls = [joblib.delayed(simulate_many)(schedule, 50, random_state=seed) for seed in seeds]
    with dask():
        assert without_times(sweep(ESTIMATORS, tasks)) == without_times(serial)
        rows = joblib.Parallel()(calls)
    for row, seed in zip(rows, seeds, strict=True):
        expected = simulate_many(schedule, 50, random_state=seed)
        for name in ("deviation", "peak_deviation", "return_time", "push"):
            np.testing.assert_allclose(getattr(row, name), getattr(expected, name), rtol=1e-12)


@pytest.mark.slow
def test_grid_search_runs_on_a_cluster(tasks, dask):
    X, y, groups = tasks["tunnel"].stack()
    search = GridSearchCV(GMMBaseline(random_state=0), {"n_components": [1, 2]}, cv=GroupKFold(2), n_jobs=2)
    here = search.fit(X, y, groups=groups).cv_results_["mean_test_score"]
    with dask():
        there = search.fit(X, y, groups=groups).cv_results_["mean_test_score"]
    np.testing.assert_allclose(there, here, rtol=1e-12)


def test_a_job_that_fails_is_a_row_with_its_error(tasks, serial):
    wrong = {"wrong": GMMBaseline(n_components=-1), **ESTIMATORS}
    rows = sweep(wrong, {"tunnel": tasks["tunnel"]}, n_jobs=2)
    failed, others = rows[:4], rows[4:]
    assert without_times(others) == without_times(serial[:8])
    for row in failed:
        assert np.isnan([row["log_likelihood"], row["coverage"], row["fit_seconds"]]).all()
        assert row["error"].startswith("InvalidParameterError: n_components is -1")
    table = summarize(rows)
    assert [row["failed"] for row in table] == [4, 0, 0]
    assert np.isnan(table[0]["held-out LL"])


def test_the_table_is_paired():
    values = {"first": [1.0, 5.0, 3.0], "second": [1.5, 5.5, 4.5]}
    rows = [
        {
            "task": "t",
            "model": model,
            "fold": k,
            "log_likelihood": value,
            "coverage": 0.9,
            "fit_seconds": 2.0,
            "error": "",
        }
        for model, several in values.items()
        for k, value in enumerate(several)
    ]
    first, second = summarize(rows)
    assert first["held-out LL"] == 3.0
    assert first["+-"] == pytest.approx(2.0 / 3**0.5)
    assert np.isnan(first["against first"])
    assert second["against first"] == pytest.approx(2.5 / 3)
    assert second["+- "] == pytest.approx(np.std([0.5, 0.5, 1.5], ddof=1) / 3**0.5)
    assert (second["95 % holds"], second["folds"], second["failed"], second["fit [s]"]) == (0.9, 3, 0, 2.0)


def test_folds_may_be_fewer_but_there_must_be_one(tasks):
    rows = sweep({"CD": CholeskyCovRegressor()}, {"tunnel": tasks["tunnel"]}, max_folds=2)
    assert [row["fold"] for row in rows] == [0, 3]
    with pytest.raises(ValueError, match="task 'alone' has one demonstration"):
        sweep(ESTIMATORS, {"alone": Demonstrations([[0.0, 1.0]], [[[0.0], [1.0]]])})


def test_a_job_has_one_thread_and_leaves_the_others_theirs():
    before = torch.get_num_threads(), [pool["num_threads"] for pool in threadpool_info()]
    with _one_thread():
        assert torch.get_num_threads() == 1
        assert {pool["num_threads"] for pool in threadpool_info()} <= {1}
    assert (torch.get_num_threads(), [pool["num_threads"] for pool in threadpool_info()]) == before

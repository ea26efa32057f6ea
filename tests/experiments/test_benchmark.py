"""The benchmark of speed: what it measures is that of a machine; here is what it makes of it."""

import json
from pathlib import Path

import numpy as np
import pytest
from speed import GROUPS, made, prediction, report, run_benchmark
from speed import ticks as ticking
from speed.fresh import measured
from speed.growth import exponent
from speed.rows import Findings, Growth, Plan, Row
from speed.timing import alternate, ratios

from torch_pbd.experiments.run_folder import RunFolder


class Clock:
    """Goes on by what the work says that it takes."""

    def __init__(self):
        self.now, self.calls = 0.0, []

    def __call__(self):
        return self.now

    def work(self, name, seconds):
        def run():
            self.calls.append(name)
            self.now += seconds

        return run


def test_contenders_take_turns_in_either_order():
    clock = Clock()
    contenders = {"a": clock.work("a", 2.0), "b": clock.work("b", 3.0)}
    times = alternate(contenders, 3, n_calls=2, clock=clock)
    assert clock.calls == ["a", "b", *"aabb", *"bbaa", *"aabb"]
    assert times == {"a": [2.0, 2.0, 2.0], "b": [3.0, 3.0, 3.0]}
    clock.calls.clear()
    alternate(contenders, 1, warm_up=False, clock=clock)
    assert clock.calls == ["a", "b"]


def test_ratios_are_of_one_repetition_or_of_all_pairs():
    assert ratios([6.0, 8.0], [2.0, 4.0]) == [3.0, 2.0]
    assert ratios([6.0], [2.0, 3.0]) == [3.0, 2.0]


@pytest.mark.parametrize("power", [0.0, 1.0, 2.5])
def test_the_exponent_is_that_of_the_upper_half(power):
    sizes = [10, 20, 50, 100, 200, 500]
    seconds = [1.0, 1.0, 1.0, *(1e-3 * size**power for size in sizes[3:])]
    assert exponent(sizes, seconds) == pytest.approx(power, abs=1e-9)


@pytest.mark.parametrize(
    ("ours", "other", "bar", "held"),
    [
        ([2.0, 1.0, 3.0], [20.0, 30.0, 40.0], (">=", 13.0), True),  # 10, 30 and 13.3 times
        ([2.0, 1.0, 3.0], [20.0, 30.0, 40.0], (">=", 14.0), False),
        ([2.0, 1.0, 3.0], None, ("<=", 2.0), True),
        ([2.0, 1.0, 3.0], None, ("<=", 1.9), False),
        ([2.0], None, None, None),
    ],
)
def test_a_bar_is_held_by_the_median(ours, other, bar, held):
    assert Row("work", ours, other=other, bar=bar).held is held


def test_tables_and_json_say_what_was_held_and_what_missed():
    found = Findings("one", left_out=["gmr is not installed"])
    found.rows.append(Row("fast", [1e-3, 2e-3], "s", [0.3, 0.5], "theirs", (">=", 200.0)))
    found.rows.append(Row("slow", [0.5], "s", bar=("<=", 0.1), note="why"))
    found.growth.append(Growth("fit", "T", [10, 100], [[0.1], [1.0]], 1.0))
    text = report.tables([found])
    fast, slow = (next(line for line in text.splitlines() if line.startswith(name)) for name in ("fast", "slow"))
    assert " ".join(fast.split()) == "fast 1.5 ms 400 ms 275 x 250 x .. 300 x >= 200 x held theirs"
    assert " ".join(slow.split()) == "slow 500 ms <= 100 ms MISSED why"
    assert "left out: gmr" in text
    assert text.endswith("1 of 2 bars held")
    kept = report.as_json([found], Plan())["groups"]["one"]
    assert kept["rows"][0]["values"] == [300.0, 250.0]
    assert [row["held"] for row in kept["rows"]] == [True, False]
    assert kept["growth"][0]["seconds"] == [[0.1], [1.0]]


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [
        (2.5e-7, "s", "250 ns"),
        (4.29e-6, "s", "4.29 us"),
        (12.0, "s", "12 s"),
        (1234.5, "x", "1,234 x"),
        (0.0, "s", "0 ns"),
    ],
)
def test_amounts_have_three_digits_and_a_prefix(value, unit, text):
    assert report._amount(value, unit) == text


def test_a_peer_that_is_not_installed_is_left_out_by_name():
    def with_peer():
        import a_peer_that_nobody_has  # noqa: F401

    found = Findings("one")
    for _ in range(2):
        found.try_peer("a_peer_that_nobody_has", with_peer)
    assert found.left_out == ["a_peer_that_nobody_has is not installed: its comparisons are left out"]
    with pytest.raises(ModuleNotFoundError):
        found.try_peer("another", with_peer)


def test_factors_are_those_of_the_empirical_covariances():
    X, y = made.demonstrations(6, 9, n_outputs=3, n_features=2, seed=1)
    inputs, entries = made.cholesky_entries(X, y)
    assert inputs.shape == (6, 2)
    np.testing.assert_allclose(np.ptp(inputs, axis=0), 1.0, rtol=1e-12)
    first = np.linalg.cholesky(np.cov(y[(np.unique(X, axis=0)[0] == X).all(axis=1)].T))
    np.testing.assert_allclose(entries[0], first[np.tril_indices(3)], rtol=1e-9)
    assert len(np.unique(made.demonstrations(6, 9, aligned=False)[0])) == 54


def test_the_bare_loop_and_the_controller_arrive_at_one_place():
    took = ticking.blocks(2, 300, n_eager=5)
    assert {name: len(times) for name, times in took.items()} == {"bare": 600, "tick": 600, "eager": 10}


def test_the_mixture_of_gmr_is_ours(monkeypatch):
    contenders = []
    times = {"ours": [1.0], "gmr": [2.0]}
    monkeypatch.setattr(prediction, "alternate", lambda work, *_, **__: contenders.append(work) or times)
    prediction._against_gmr(Plan(quick=True))
    mean, covariance = contenders[0]["ours"]()
    theirs = contenders[0]["gmr"]()
    # In units of the mixture, which are other ones: what relates them is one shift and one scale an output.
    scale = np.sqrt(np.diagonal(covariance[0]) / np.diagonal(theirs.covariance))
    np.testing.assert_allclose(covariance[0] / np.outer(scale, scale), theirs.covariance, rtol=1e-9)
    batch, _ = contenders[1]["ours"]()
    np.testing.assert_allclose(batch[0], mean[0], rtol=1e-12)


def test_memory_is_what_work_takes_above_its_setup():
    if not Path("/proc/self/clear_refs").exists():
        pytest.skip("the peak of a process can be told on Linux only")
    setup = "data = np.ones((300, 1 << 17)); data = data[:1].copy()"  # 300 MiB that are given back
    found = measured(setup, "more = np.ones((100, 1 << 17)); del more")
    assert 95.0 < found["above"] < 130.0


def test_the_numbers_of_a_run_take_the_place_of_the_last_ones_whole(tmp_path):
    before, kept = tmp_path / "benchmark.json", tmp_path / "another name of it"
    before.write_text("of the last run")
    kept.hardlink_to(before)
    report.write([], Plan(), RunFolder(tmp_path, {}))
    assert json.loads(before.read_text())["groups"] == {}
    assert kept.read_text() == "of the last run"


@pytest.mark.slow
def test_a_quick_run_leaves_its_numbers(tmp_path):
    with RunFolder(tmp_path, {}) as folder:
        shown = run_benchmark(folder, quick=True)
    assert "bars held" in shown
    found = json.loads((tmp_path / "benchmark.json").read_text())
    assert list(found["groups"]) == list(GROUPS)
    assert {"machine", "versions", "plan"} <= set(found)
    for group in found["groups"].values():
        for row in group["rows"]:
            assert row["what"] in shown
            assert np.isfinite(row["ours"]).all()
            assert (row["held"] is None) == (row["bar"] is None)
        for growth in group["growth"]:
            assert len(growth["sizes"]) == len(growth["seconds"])
    assert {path.name for path in (tmp_path / "figures").iterdir()} == {"ratios.png", "growth.png"}

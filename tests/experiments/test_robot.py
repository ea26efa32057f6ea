import numpy as np
import pytest

from torch_pbd import CholeskyCovRegressor, Demonstrations, DMPController
from torch_pbd.control import Schedule
from torch_pbd.data import make_tunnel_demonstrations
from torch_pbd.experiments.pushes import push, push_profile, push_row
from torch_pbd.experiments.robot import run_robot
from torch_pbd.experiments.run_folder import RunFolder


def test_pushes_are_two_pulses_of_the_peak_and_0_8_s():
    time = np.arange(10001) / 1000.0
    force = push_profile(time, 10.0, 5.0, 3)
    np.testing.assert_allclose(force[[2000, 8000], 0], 5.0)
    assert (force[:, 1:] == 0.0).all()
    acting = time[force[:, 0] > 1e-12]
    np.testing.assert_allclose([acting[0], acting[acting < 5.0][-1]], [1.6, 2.4], atol=2e-3)
    np.testing.assert_allclose(force[:, 0].sum() * 1e-3, 2 * 5.0 * 0.4, rtol=1e-6)  # the square's mean is a half


def test_the_table_has_what_the_run_shows():
    recorded = make_tunnel_demonstrations(random_state=0, rate=50.0)
    run = push(DMPController().fit(recorded), rate=200.0)
    row = push_row("mine", run)
    deviation = np.abs(run.pushes["force"][0].position - run.controller.simulate(rate=200.0).position)[:, 0]
    assert row["early [mm]"] == pytest.approx(1e3 * deviation[:1000].max())
    assert row["ratio"] == pytest.approx(row["early [mm]"] / row["late [mm]"])
    assert row["K x early"] == pytest.approx(run.schedule.stiffness[400, 0, 0])
    assert row["path error [mm]"] < 0.5
    coarse = push(run.controller, rate=33.05)  # whose rows are not in the middle of pushes
    largest = 166 + int(coarse.pushes["force"][0].force[166:, 0].argmax())
    assert push_row("mine", coarse)["K x late"] == coarse.schedule.stiffness[largest, 0, 0]


@pytest.mark.parametrize("d", [1, 3])
def test_a_run_of_any_dimension_leaves_its_figures_schedules_and_models(d, tmp_path, rng):
    time = np.linspace(0.0, 2.0, 60)
    ways = rng.normal(size=(5, 1, d)) * (0.05 + 0.2 * np.sin(np.pi * time / 2.0)[:, None] ** 2) + time[:, None]
    folder = RunFolder(tmp_path, {})
    before, kept = tmp_path / "stability.txt", tmp_path / "another name of it"
    before.write_text("of the last run")
    kept.hardlink_to(before)
    with pytest.warns(UserWarning, match="tell no units"):
        text = run_robot({"a b": DMPController(CholeskyCovRegressor())}, Demonstrations(time, ways), folder, rate=100.0)
    assert "[unit]" in text
    assert "certificate of this one" in text
    assert {path.name for path in (tmp_path / "figures").iterdir()} == {
        "a_b_figure6_task.png", "a_b_figure7_variability.png", "a_b_figure8_pushes.png",
    }  # fmt: skip
    schedule = Schedule.load(tmp_path / "schedule" / "a_b.npz")
    assert schedule.stiffness.shape == (201, d, d)
    assert Schedule.load(tmp_path / "schedule" / "a_b_100hz.csv").duration == pytest.approx(2.0)
    assert (tmp_path / "model" / "a_b_controller.safetensors").is_file()
    assert "guaranteed" in (tmp_path / "stability.txt").read_text()
    assert kept.read_text() == "of the last run"  # the new report took its place whole

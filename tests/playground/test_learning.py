"""What the page shows is what the library says, and what is taken home gives it again."""

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
import yaml

from torch_pbd.control import Schedule
from torch_pbd.playground import learning, messages

from .strokes import make_strokes


def learned_from(models=("CholeskyCovRegressor",), n_steps=2, **settings):
    """The first steps done: each model, the schedule, what strokes that are left out say."""
    settings = messages.as_settings({"models": list(models), **settings})
    learned = learning.learn(messages.as_strokes(make_strokes()), settings)
    return learned, [answer for step in islice(learned.steps, n_steps) if (answer := step())]


@pytest.fixture(scope="module")
def learned_once():
    return learned_from()[0]


@pytest.fixture
def learned(learned_once):
    """Of what is asked, nothing stays."""
    return replace(learned_once, controllers=dict(learned_once.controllers))


def test_two_models_are_pictured_then_a_schedule_then_left_out_strokes():
    learned, answers = learned_from(("CholeskyCovRegressor", "ProMPBaseline"), n_steps=None)
    assert [answer["type"] for answer in answers] == ["picture", "picture", "schedule", "score", "score"]
    picture, controller = answers[0], learned.controllers["CholeskyCovRegressor"]
    times = np.array(picture["time"])[:, None]
    covariance = controller.covariance_.predict_cov(times)
    np.testing.assert_allclose(picture["covariance"], covariance[:, [0, 0, 1], [0, 1, 1]], rtol=1e-9)
    np.testing.assert_allclose(picture["path"], controller.predict(times), atol=1e-5)
    assert np.shape(picture["draws"]) == (5, 50, 2)


def test_a_bent_movement_passes_its_points_and_an_adjusted_one_too(learned):
    at = learned.controllers["CholeskyCovRegressor"].duration_ / 2
    path = learning.bend(learned, [(at, 0.47, 0.33)])
    schedule = learning.follow(learned)["schedule"]
    nearest = schedule.position[np.abs(schedule.time - at).argmin()]
    np.testing.assert_allclose(nearest, [0.47, 0.33], atol=2e-4)
    assert len(path["path"]) == 50
    with pytest.raises(ValueError, match="near the movement"):
        learning.bend(learned, [(59.0, 0.47, 0.33)])  # which leaves the points there were
    softer = learning.adjust(
        learned, messages.as_settings({"models": ["CholeskyCovRegressor"], "stiffness_max": 300.0})
    )
    assert np.max(softer["stiffness"]) <= 300.0 + 1e-6
    nearest = softer["schedule"].position[np.abs(softer["schedule"].time - at).argmin()]
    np.testing.assert_allclose(nearest, [0.47, 0.33], atol=2e-4)


@pytest.mark.parametrize("model", ["GMMBaseline", "ProMPBaseline"])
def test_the_python_lines_give_the_schedule_again(model, tmp_path, monkeypatch, capsys):
    learned, _ = learned_from((model,), stiffness_max=700.0, speed=1.5, mass=2.0, smooth=True)
    learning.bend(learned, [(0.7, 0.4, 0.35)])
    for name in messages.FILES:
        (tmp_path / name).write_bytes(learning.take_home(learned, name))
    shown = Schedule.load(tmp_path / "schedule.npz")
    monkeypatch.chdir(tmp_path)
    exec(compile((tmp_path / "skill.py").read_text(), "skill.py", "exec"), {})
    again = Schedule.load(tmp_path / "schedule.npz")
    np.testing.assert_allclose(again.position, shown.position, atol=1e-6)
    np.testing.assert_allclose(again.stiffness, shown.stiffness, rtol=1e-4)
    assert "guaranteed" in capsys.readouterr().out.lower()


def test_the_yaml_is_a_configuration_of_experiment(learned, tmp_path):
    from torch_pbd.cli.commands import parse

    path = tmp_path / "skill.yaml"
    path.write_bytes(learning.take_home(learned, "skill.yaml"))
    options, _ = parse("experiment", ["--config", str(path)])
    mine = options.controllers["mine"].fit(learned.strokes)
    schedule = learning.follow(learned)["schedule"]
    np.testing.assert_array_equal(mine.schedule(rate=1000.0).stiffness, schedule.stiffness)
    assert yaml.safe_load(path.read_text())["data"] == "demonstrations.csv"
    assert "# Without points that bend it, and at its own speed: see skill.py." in path.read_text().splitlines()


def test_a_dropped_file_is_read_whatever_its_name(learned):
    content = learning.take_home(learned, "demonstrations.csv")
    strokes = learning.read_file("../../etc/passwd.CSV", content)
    assert len(strokes) == 6
    np.testing.assert_allclose(np.array(strokes[2])[:, 1:], learned.strokes.positions[2], atol=1e-9)
    with pytest.raises(ValueError, match="2"):
        learning.read_file("a.csv", b"demo,time,x,y,z\n0,0,1,2,3\n0,1,1,2,3\n0,2,1,2,4\n")
    with pytest.raises(ValueError, match=r"^b\.npz: it is not a sound"):
        learning.read_file("b.npz", b"no archive")

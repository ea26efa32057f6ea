"""Files of every format version that was ever written load, and say what they said; fits are what they were."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from golden.make import QUERIES, RATE, fits, predictions

import torch_pbd
from torch_pbd.control import Schedule
from torch_pbd.data import load_demonstrations, make_tunnel_demonstrations

VERSIONS = sorted(Path(__file__).parent.glob("golden/v*"))
REGRESSORS = ["CholeskyCovRegressor", "WishartProcessRegressor", "HeteroscedasticGPRegressor", "GMMBaseline"]

of_each_version = pytest.mark.parametrize("folder", VERSIONS, ids=lambda folder: folder.name)


def assert_same(found, expected):
    # Predictions of version 1 have the jitter of kernel matrices in them, 1e-13 of a process's variance.
    expected = np.array(expected)
    np.testing.assert_allclose(found, expected, rtol=1e-11, atol=1e-12 * np.abs(expected).max())


def expected(folder, name):
    return json.loads((folder / "predictions.json").read_text())[name]


@of_each_version
@pytest.mark.parametrize("name", REGRESSORS)
def test_44_models_predict_what_they_did(folder, name):
    model = torch_pbd.load(folder / f"{name}.safetensors")
    assert type(model).__name__ == name
    X = pd.DataFrame(QUERIES, columns=["time"]) if name == "CholeskyCovRegressor" else np.array(QUERIES)
    found = predictions(model, X)
    assert found.keys() == expected(folder, name).keys()
    for part, values in expected(folder, name).items():
        assert_same(found[part], values)


@of_each_version
def test_44_their_parameters_are_of_the_types_that_they_were(folder):
    loaded = {name: torch_pbd.load(folder / f"{name}.safetensors") for name in REGRESSORS}
    assert loaded["CholeskyCovRegressor"].length_scale == [0.4]
    assert loaded["CholeskyCovRegressor"].feature_names_in_.tolist() == ["time"]
    np.testing.assert_array_equal(loaded["WishartProcessRegressor"].prior, [[2.0, 0.5], [0.5, 1.0]])
    assert loaded["HeteroscedasticGPRegressor"].kernel == "matern52"
    assert loaded["GMMBaseline"].predict([[0.0]]).shape == (1,)


@of_each_version
def test_44_a_controller_plans_what_it_did(folder):
    controller = torch_pbd.load(folder / "DMPController.safetensors")
    schedule = controller.schedule(RATE)
    for name, values in expected(folder, "DMPController").items():
        assert_same(getattr(schedule, name), values)
    assert (controller.mass, controller.covariance.n_components, controller.names_) == (2.0, 2, ("x", "y"))


@of_each_version
@pytest.mark.parametrize("suffix", ["npz", "json", "csv"])
def test_44_schedules_hold_what_they_did(folder, suffix):
    schedule = Schedule.load(folder / f"schedule.{suffix}")
    for name, values in expected(folder, "DMPController").items():
        np.testing.assert_array_equal(getattr(schedule, name), values)
    assert (schedule.names, schedule.units, schedule.mass, schedule.stiffness_limits) == (
        ("x", "y"), "m", 2.0, (50.0, 1000.0),
    )  # fmt: skip
    assert schedule.provenance["controller"]["DMPController"]["mass"] == 2.0


@of_each_version
@pytest.mark.parametrize("suffix", ["npz", "csv"])
def test_44_demonstrations_hold_what_they_did(folder, suffix):
    loaded = load_demonstrations(folder / f"demonstrations.{suffix}")
    recorded = make_tunnel_demonstrations(4, rate=10.0, random_state=0).resample(5)
    assert (len(loaded), loaded.names, loaded.n_steps) == (4, recorded.names, recorded.n_steps)
    for mine, theirs in zip(loaded, recorded, strict=True):
        assert_same(mine.time, theirs.time)
        assert_same(mine.position, theirs.position)


@of_each_version
def test_44_each_file_is_one_of_these(folder):
    kinds = [f"{name}.safetensors" for name in (*REGRESSORS, "DMPController")]
    kinds += ["schedule.npz", "schedule.json", "schedule.csv", "demonstrations.npz", "demonstrations.csv"]
    assert {file.name for file in folder.iterdir()} == {*kinds, "predictions.json"}


def test_what_is_learned_is_what_it_was():
    """Rounding of y, 1e-15 of it, moves these by 8e-11 at most, and another processor's two of them by more."""
    rtols = {
        # Gradients of its evidence have eight digits: by a processor's instructions predictions differ by 1e-6.
        "HeteroscedasticGPRegressor": 1e-5,
        # Expectation maximization ends at a gain of so little that rounding moves it by 4e-7.
        "GMMBaseline": 1e-5,
    }
    pinned, found = json.loads((Path(__file__).parent / "golden/fits.json").read_text()), fits()
    assert found.keys() == pinned.keys()
    for name, parts in pinned.items():
        for part, values in parts.items():
            # Type I uncertainty is a share of one.
            atol = rtols.get(name, 1e-8) * (1.0 if part == "type1" else np.abs(values).max())
            np.testing.assert_allclose(found[name][part], values, rtol=0, atol=atol, err_msg=f"{name} {part}")

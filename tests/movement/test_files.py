"""Model files of whole movements: the same to the last bit, and refused where they are forged."""

import numpy as np
import pytest
from safetensors.numpy import load_file

import torch_pbd
from movement.test_trajectory import GRID, movements, stacked
from torch_pbd import DMPController, GMMBaseline, KMPBaseline, ProMPBaseline, TrajectoryRegressor
from torch_pbd.data import make_tunnel_demonstrations
from torch_pbd.exceptions import ModelFileError
from torch_pbd.persistence import read_archive, write_archive

X = GRID[:, np.newaxis]
MODELS = [TrajectoryRegressor(GMMBaseline(n_restarts=0)), ProMPBaseline(n_basis=8, overlap=0.85), KMPBaseline()]


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """Fitted models and their files."""
    folder, pairs = tmp_path_factory.mktemp("movements"), {}
    inputs, y, groups = stacked(movements())
    for model in MODELS:
        name = type(model).__name__
        model.fit(inputs, y, groups=groups)
        torch_pbd.save(model, folder / f"{name}.safetensors")
        pairs[name] = model, folder / f"{name}.safetensors"
    return pairs


@pytest.mark.parametrize("name", [type(model).__name__ for model in MODELS])
def test_a_loaded_movement_is_the_same(saved, name):
    model, path = saved[name]
    loaded = torch_pbd.load(path)
    for own, other in zip(model.predict_joint(X[::5]), loaded.predict_joint(X[::5]), strict=True):
        np.testing.assert_array_equal(own, other)
    known = [m.condition([[0.5]], [[1.0, 0.5]]).sample_demonstrations(X, 2, 0) for m in (model, loaded)]
    np.testing.assert_array_equal(*known)
    np.testing.assert_equal(loaded.get_params(), model.get_params()) if name != "TrajectoryRegressor" else None
    assert loaded.score(X, movements()[0]) == model.score(X, movements()[0])


def test_a_controller_of_movements_is_the_same_and_a_bent_one_is_refused(tmp_path):
    shown = make_tunnel_demonstrations(random_state=0).resample(60)
    controller = DMPController(TrajectoryRegressor(GMMBaseline())).fit(shown)
    torch_pbd.save(controller, tmp_path / "c.safetensors")
    loaded = torch_pbd.load(tmp_path / "c.safetensors")
    via = [(5.0, controller.predict([[5.0]])[0])]
    rows = [each.schedule(rate=20.0, via=via) for each in (controller, loaded)]
    np.testing.assert_array_equal(rows[0].stiffness, rows[1].stiffness)
    with pytest.raises(TypeError, match="was conditioned, which a file cannot hold: save it before"):
        torch_pbd.save(controller.condition([5.0], [via[0][1]]), tmp_path / "d.safetensors")


@pytest.mark.parametrize("name", [type(model).__name__ for model in MODELS])
def test_forged_arrays_are_refused(saved, name, tmp_path):
    _, path = saved[name]
    header, arrays = read_archive(path)
    n_refused = 0
    for key in load_file(path):
        for change in (lambda a: a[..., :-1], lambda a: a * np.nan, lambda a: np.stack([a, a]), lambda _: None):
            forged = {k: (change(v) if k == key and np.ndim(v) else v) for k, v in arrays.items()}
            forged = {k: np.ascontiguousarray(v) for k, v in forged.items() if v is not None}
            if all(k in forged and np.array_equal(forged[k], v) for k, v in arrays.items()):
                continue
            write_archive(tmp_path / "forged.safetensors", header, forged)
            with pytest.raises(ModelFileError):
                torch_pbd.load(tmp_path / "forged.safetensors")
            n_refused += 1
    assert n_refused > 10


def test_forged_headers_are_refused(saved, tmp_path):
    _, path = saved["TrajectoryRegressor"]
    header, arrays = read_archive(path)
    for change in (
        {"regressor_": None},
        {"regressor_": {**header["regressor_"], "class": "DMPController"}},
        {"fitted": {**header["fitted"], "df_": 1e9}},
        {"fitted": {**header["fitted"], "time_kernel_": "rbf"}},
        {"fitted": {**header["fitted"], "n_outputs_": 3}},
        {"params": {"regressor": {"class": "os.system", "params": {}}}},
    ):
        write_archive(tmp_path / "forged.safetensors", {**header, **change}, arrays)
        with pytest.raises(ModelFileError):
            torch_pbd.load(tmp_path / "forged.safetensors")

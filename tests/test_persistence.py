import os
import pickle

import numpy as np
import pandas as pd
import pytest
import torch
from estimators.zoo import DEFAULTS, VARIANTS, assert_same_model, demonstrations, fit, fitted, new, queries
from sklearn.exceptions import NotFittedError
from sklearn.linear_model import LinearRegression
from sklearn.pipeline import make_pipeline

import torch_pbd
from torch_pbd import DMPController, GMMBaseline
from torch_pbd.control import StiffnessLaw
from torch_pbd.data import make_tunnel_demonstrations


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """Bytes of a model file."""
    path = tmp_path_factory.mktemp("model") / "model.safetensors"
    torch_pbd.save(fitted("cholesky"), path)
    return path.read_bytes()


@pytest.mark.parametrize("name", VARIANTS)
def test_a_loaded_model_predicts_the_same_to_the_bit(name, tmp_path):
    model = fitted(name)
    torch_pbd.save(model, tmp_path / "model.safetensors")
    loaded = torch_pbd.load(tmp_path / "model.safetensors")
    assert type(loaded) is type(model)
    assert_same_model(loaded, model, queries(1))
    X, y = demonstrations()
    np.testing.assert_array_equal(loaded.log_likelihood(X, y), model.log_likelihood(X, y))
    assert loaded.get_params() == model.get_params()
    learned = {key: value for key, value in model.__getstate__().items() if not key.startswith("_module")}
    assert {key: vars(loaded)[key] for key in learned} == learned


@pytest.mark.parametrize("name", DEFAULTS)
@pytest.mark.parametrize("d", [1, 9])
def test_a_loaded_model_can_be_saved_fitted_and_differentiated(name, d, tmp_path):
    path = tmp_path / "model.safetensors"
    torch_pbd.save(fitted(name, d), path)
    first = path.read_bytes()
    loaded = torch_pbd.load(path)
    torch_pbd.save(loaded, path)
    assert path.read_bytes() == first
    x = torch.zeros(1, 1, dtype=torch.float64, requires_grad=True)
    loaded.module_(x)[0].sum().backward()
    assert torch.isfinite(x.grad).all()
    assert_same_model(fit(loaded, *demonstrations(d)), fitted(name, d), queries(1))


def test_parameters_and_names_of_any_kind_come_back(tmp_path):
    X, y = demonstrations(2, 2, n_inputs=5)
    model = new("cholesky", prior=np.array([[40.0, 12.0], [12.0, 60.0]]), length_scale=[0.3, 0.5], tol=np.float64(1e-5))
    fit(model, pd.DataFrame(X, columns=["time", "place"]), y)
    torch_pbd.save(model, tmp_path / "model")
    loaded = torch_pbd.load(tmp_path / "model")
    np.testing.assert_array_equal(loaded.prior, model.prior)
    assert (loaded.length_scale, loaded.tol, loaded.device) == ([0.3, 0.5], 1e-5, None)
    assert loaded.feature_names_in_.tolist() == ["time", "place"]
    frame = pd.DataFrame(X, columns=["time", "place"])
    np.testing.assert_array_equal(loaded.predict_cov(frame), model.predict_cov(frame))


def test_one_dimensional_y_stays_so(tmp_path):
    X, y = demonstrations(1)
    model = fit(new("mixture"), X, y[:, 0])
    torch_pbd.save(model, tmp_path / "model")
    assert torch_pbd.load(tmp_path / "model").predict(X).shape == (96,)


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
def test_loading_where_gradients_are_off_and_whatever_the_default_dtype(mode, saved, tmp_path):
    path = tmp_path / "model"
    path.write_bytes(saved)
    try:
        torch.set_default_dtype(torch.float16)
        with mode():
            loaded = torch_pbd.load(path)
    finally:
        torch.set_default_dtype(torch.float32)
    assert_same_model(loaded, fitted("cholesky"), queries(1))
    x = torch.zeros(1, 1, dtype=torch.float64, requires_grad=True)
    loaded.module_(x)[0].sum().backward()
    assert x.grad is not None


def test_no_file_and_a_folder_are_told_from_a_damaged_one(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no model file at .*nothing"):
        torch_pbd.load(tmp_path / "nothing")
    with pytest.raises(FileNotFoundError, match="no model file at"):
        torch_pbd.load(tmp_path)


def test_what_a_file_cannot_hold_is_an_error_that_says_so(tmp_path):
    X, y = demonstrations(n_inputs=4, n_demos=4)
    path = tmp_path / "model"
    model = fit(new("cholesky", prior=lambda x: np.broadcast_to(np.eye(2), (len(x), 2, 2))), X, y)
    with pytest.raises(TypeError, match="prior is a function, which a model file cannot hold; pickle the estimator"):
        torch_pbd.save(model, path)
    model = fit(new("mixture", random_state=np.random.RandomState(0)), X, y)
    with pytest.raises(TypeError, match="random_state is a RandomState"):
        torch_pbd.save(model, path)
    with pytest.raises(NotFittedError, match="not fitted yet"):
        torch_pbd.save(new("mixture"), path)
    with pytest.raises(TypeError, match="estimator is a LinearRegression; can save HeteroscedasticGPRegressor"):
        torch_pbd.save(LinearRegression().fit(X, y), path)
    with pytest.raises(TypeError, match=r"estimator is a Pipeline.*In a pipeline, save that step"):
        torch_pbd.save(make_pipeline(new("mixture")).fit(X, y), path)
    with pytest.raises(FileNotFoundError, match="nowhere does not exist"):
        torch_pbd.save(fitted("mixture"), tmp_path / "nowhere" / "model")
    assert list(tmp_path.iterdir()) == []


def test_a_file_is_replaced_and_readable_by_others(saved, tmp_path):
    path = tmp_path / "a model of démonstrations"
    umask = os.umask(0o022)
    try:
        torch_pbd.save(fitted("mixture"), path)
        torch_pbd.save(fitted("cholesky"), str(path))
    finally:
        os.umask(umask)
    assert path.read_bytes() == saved
    assert path.stat().st_mode & 0o777 == 0o644
    assert list(tmp_path.iterdir()) == [path]


def by_pickle(model, _):
    return pickle.loads(pickle.dumps(model))


def by_file(model, path):
    torch_pbd.save(model, path)
    return torch_pbd.load(path)


@pytest.mark.parametrize("copied", [by_pickle, by_file])
def test_a_model_from_a_device_that_is_missing_here_is_put_on_the_cpu(copied, tmp_path):
    model = by_pickle(fitted("cholesky"), None)
    model.device = "cuda:99"  # as if it had been fitted there
    with pytest.warns(UserWarning, match=r"'cuda:99', which this machine lacks .* now on the CPU"):
        loaded = copied(model, tmp_path / "model")
    assert loaded.device is None
    assert_same_model(loaded, fitted("cholesky"), queries(1))


@pytest.mark.parametrize("regressor", [None, GMMBaseline(n_components=2, random_state=0)])
def test_a_controller_plans_the_same_from_its_file(regressor, tmp_path):
    law = StiffnessLaw(20.0, 400.0, smooth=True)
    recorded = make_tunnel_demonstrations(5, rate=20.0, random_state=0, variant="unequal")
    controller = DMPController(regressor, variability="forcing", stiffness_law=law, goal="each").fit(recorded)
    torch_pbd.save(controller, tmp_path / "skill")
    again = torch_pbd.load(tmp_path / "skill")
    assert again.schedule(20.0, settle=1.0) == controller.schedule(20.0, settle=1.0)
    assert again.get_params(deep=False).keys() == controller.get_params(deep=False).keys()
    assert again.stiffness_law == law
    np.testing.assert_array_equal(again.noise_share_, controller.noise_share_)
    again.fit(recorded)  # parameters, too, are as they were
    assert again.schedule(20.0) == controller.schedule(20.0)

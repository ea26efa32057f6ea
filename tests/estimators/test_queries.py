"""What is checked of the inputs that are predicted at, and what is not worked out in vain."""

import copy
import pickle

import numpy as np
import pandas as pd
import pytest
import torch
from scipy.sparse import csr_array

from estimators.zoo import DEFAULTS, VARIANTS, demonstrations, fitted, new, queries
from torch_pbd.estimators import validation

BAD = {
    "features": np.zeros((3, 2)),
    "nan": np.array([[0.0], [np.nan]]),
    "infinity": np.array([[np.inf]]),
    "one dimension": np.zeros(3),
    "three dimensions": np.zeros((3, 1, 1)),
    "none": None,
    "a number": 1.0,
    "complex": np.zeros((3, 1), dtype=complex),
    "text": np.array([["a"]]),
    "objects": np.array([["a"], [1.0]], dtype=object),
    "sparse": csr_array(np.zeros((3, 1))),
    "coarse": np.array([[1.7e9], [1.7e9 + 200.0]], dtype=np.float32),
    "a frame without names": pd.DataFrame(np.full((2, 1), np.nan)),
}


def complaint(model, X):
    with pytest.raises((ValueError, TypeError)) as caught:
        model.predict_cov(X)
    return type(caught.value), str(caught.value)


@pytest.mark.parametrize("name", DEFAULTS)
@pytest.mark.parametrize("bad", BAD)
def test_what_cannot_be_predicted_at_is_refused_as_by_all_checks(name, bad, monkeypatch):
    model = fitted(name)
    refused = complaint(model, BAD[bad])
    monkeypatch.setattr(validation, "_is_plain", lambda *_: False)
    assert refused == complaint(model, BAD[bad])


@pytest.mark.parametrize("name", DEFAULTS)
def test_an_estimator_that_is_not_fitted_says_so(name, monkeypatch):
    refused = complaint(new(name), np.zeros((3, 1)))
    assert "not fitted" in refused[1]
    monkeypatch.setattr(validation, "_is_plain", lambda *_: False)
    assert refused == complaint(new(name), np.zeros((3, 1)))


def test_names_of_features_are_compared():
    X, y = demonstrations()
    model = new("mixture").fit(pd.DataFrame(X, columns=["phase"]), y)
    with pytest.warns(UserWarning, match="valid feature names"):
        model.predict(X)


@pytest.mark.parametrize("name", DEFAULTS)
def test_plain_arrays_are_predicted_at_without_further_checks_and_alike(name, monkeypatch):
    model, X = fitted(name), queries(1)
    checked = model.predict(X.tolist(), return_cov=True)
    monkeypatch.setattr(validation, "validate_data", None)
    for form in (X, np.asfortranarray(X), np.repeat(X, 2, axis=0)[::2], X[::-1][::-1]):
        for mine, other in zip(model.predict(form, return_cov=True), checked, strict=True):
            np.testing.assert_array_equal(mine, other)


@pytest.mark.parametrize("name", [name for name in VARIANTS if not name.startswith("mixture")])
def test_the_mean_alone_takes_no_covariance(name, monkeypatch):
    model, X = fitted(name), queries(1)
    expected = model.predict(X, return_cov=True)[0]
    core = type(model.module_.core)
    monkeypatch.setattr(core, "forward", None)
    np.testing.assert_array_equal(model.predict(X), expected)


@pytest.mark.parametrize("name", ["cholesky", "cholesky-log", "wishart"])
def test_the_covariance_alone_takes_no_mean(name, monkeypatch):
    model, X = fitted(name), queries(1)
    expected = model.predict(X, return_cov=True)[1]
    monkeypatch.setattr(type(model.module_), "mean", None)
    monkeypatch.setattr(type(model.module_.core), "forward", None)
    np.testing.assert_array_equal(model.predict_cov(X), expected)


def assert_those_of_the_module(model, X):
    """Equal but for rounding, in units of the standard deviations."""
    mean, covariance = model.predict(X, return_cov=True)
    module = copy.deepcopy(model.module_)
    expected = module.moments(torch.tensor(X))
    scale = np.sqrt(np.diagonal(expected[1], axis1=1, axis2=2))
    np.testing.assert_allclose((mean - expected[0].numpy()) / scale, 0.0, atol=1e-11)
    correlations = (covariance - expected[1].numpy()) / scale[:, :, np.newaxis] / scale[:, np.newaxis]
    np.testing.assert_allclose(correlations, 0.0, atol=1e-11)
    np.testing.assert_array_equal(model.predict(X), mean)
    np.testing.assert_array_equal(model.predict_cov(X), covariance)


@pytest.mark.parametrize(("d", "e"), [(1, 1), (2, 1), (2, 2), (9, 1)])
def test_a_mixture_predicts_what_its_module_does(d, e):
    X = queries(e)
    assert_those_of_the_module(fitted("mixture", d, e), X[np.abs(X).max(axis=1) < 100.0])


def in_place(core):
    core.mean += 0.1


def behind_autograd(core):
    core.log_diagonal.data.mul_(1.1)


def replaced(core):
    core.mean = torch.nn.Parameter(core.mean + 0.1, requires_grad=False)


def loaded(core):
    core.load_state_dict({key: 0.9 * value for key, value in core.state_dict().items()}, assign=True)


@pytest.mark.parametrize("change", [in_place, behind_autograd, replaced, loaded])
def test_a_mixture_follows_its_module(change):
    model, X = copy.deepcopy(fitted("mixture")), queries(1)[:40]
    before = model.predict_cov(X)
    change(model.module_.core)
    assert np.abs(model.predict_cov(X) - before).max() > 1e-3
    assert_those_of_the_module(model, X)


def test_a_mixture_from_a_pickle_predicts_the_same():
    model, X = fitted("mixture"), queries(1)
    twin = pickle.loads(pickle.dumps(model))
    assert twin._regression is not None
    np.testing.assert_array_equal(twin.predict_cov(X), model.predict_cov(X))

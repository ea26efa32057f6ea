"""What is checked of the inputs that are predicted at, and what is not worked out in vain."""

import numpy as np
import pandas as pd
import pytest
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

"""Priors, parameters, queries and numerics that the estimators must survive, or refuse and say what to do.

Numbers in the names are those of the list of faults that the project keeps.
"""

import numpy as np
import pytest
from estimators.zoo import DEFAULTS, LATENT, VARIANTS, assert_covariances, demonstrations, fit, fitted, new, queries
from sklearn.exceptions import NotFittedError

from torch_pbd import CholeskyCovRegressor, WishartProcessRegressor
from torch_pbd.exceptions import NotPositiveDefiniteError

NEAR = np.linspace(-1.5, 1.5, 31)[:, np.newaxis]


@pytest.mark.parametrize(
    ("prior", "message"),
    [
        (-1.0, r"prior must be positive definite; its smallest eigenvalue is -1"),
        (0.0, r"its smallest eigenvalue is 0"),
        ([[1.0, 2.0], [2.0, 1.0]], r"its smallest eigenvalue is -1.*give every direction some variance"),
        (np.ones((2, 2)), r"prior must be positive definite"),
        ([[1.0, 0.5], [0.4, 1.0]], r"prior must be symmetric; at index 0 two entries differ by 0\.1"),
        ([1.0, 2.0], r"prior has shape \(2,\), must have shape \(2, 2\)"),
        (np.eye(3), r"prior has shape \(3, 3\), must have shape \(2, 2\): a covariance in squared units of y"),
        (np.nan, r"prior has an entry that is not finite"),
        ("papr", r"prior == 'papr', must be one of 'paper'"),
        ({}, r"prior == \{\}, must be numbers"),
        (lambda X: np.eye(2), r"prior\(X\) has shape \(2, 2\), must have shape \(8, 2, 2\)"),
        (lambda X: -np.ones((len(X), 2, 2)), r"prior\(X\) must be positive definite; .* at index 0"),
        (lambda X: "wide", r"prior\(X\) == 'wide', must be numbers"),
    ],
    ids=lambda value: "callable" if callable(value) else str(value),
)
@pytest.mark.parametrize("name", ["cholesky", "cholesky-likelihood", "wishart", "wishart-likelihood"])
def test_22_priors_that_are_no_covariance_are_refused_by_fit(name, prior, message):
    estimator = new(name, prior=prior)  # not here, says scikit-learn
    with pytest.raises(ValueError, match=message):
        estimator.fit(*demonstrations())


def test_22_a_callable_prior_is_held_to_it_when_it_predicts_too():
    def prior(X):
        return np.where(X[:, :, np.newaxis] < 2.0, 1.0, -1.0) * np.eye(2)

    model = fit(new("cholesky", prior=prior), *demonstrations())
    with pytest.raises(ValueError, match=r"prior\(X\) must be positive definite; .* at index 1"):
        model.predict_cov([[0.0], [3.0]])


@pytest.mark.parametrize(
    ("df", "error", "message"),
    [
        (1, ValueError, "df == 1, must be at least 2, the number of outputs"),
        (0, ValueError, "df == 0, must be >= 1"),
        (2.5, TypeError, "df must be an instance of int"),
        ("many", TypeError, "df must be an instance of int"),
    ],
)
@pytest.mark.parametrize("objective", ["mse", "likelihood"])
def test_23_fewer_vectors_than_outputs_are_refused(df, error, message, objective):
    with pytest.raises(error, match=message):
        WishartProcessRegressor(df=df, objective=objective).fit(*demonstrations())


BAD_PARAMETERS = {
    "max_iter": (0, ValueError),
    "tol": (0.0, ValueError),
    "n_restarts": (-1, ValueError),
    "verbose": ("loud", TypeError),
    "device": ("cuda:99", ValueError),
    "objective": ("mle", ValueError),
    "kernel": ("rbf", ValueError),
    "length_scale": ([0.1, 0.2], ValueError),
    "max_inputs": (1, ValueError),
    "noise_scale": (-0.1, ValueError),
    "diagonal": ("sqrt", ValueError),
    "start": ("zero", ValueError),
    "n_components": (0, ValueError),
    "solver": ("adam", ValueError),
    "reg_covar": (0.0, ValueError),
}


@pytest.mark.parametrize("parameter", BAD_PARAMETERS)
@pytest.mark.parametrize("name", DEFAULTS)
def test_parameters_out_of_range_are_refused_by_name(name, parameter):
    value, error = BAD_PARAMETERS[parameter]
    if parameter not in new(name).get_params():
        pytest.skip(f"has no {parameter}")
    with pytest.raises(error, match=f"{parameter} .*must be|{parameter} == .* cannot be used here"):
        new(name, **{parameter: value}).fit(*demonstrations())


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf, "short", [0.1, 0.2]])
def test_length_scales_that_are_none_are_refused(value):
    with pytest.raises(ValueError, match=r"length_scale == .*must be"):
        new("cholesky", length_scale=value).fit(*demonstrations())


@pytest.mark.parametrize("name", VARIANTS)
def test_24_far_away_everything_is_finite(name):
    X = np.array([[1e6], [-1e6], [1e300], [-1e300], [np.finfo(float).max]])
    model = fitted(name)
    mean, covariance = model.predict(X, return_cov=True)
    assert np.isfinite(mean).all()
    assert_covariances(covariance, 5, 2)
    if name in LATENT:
        np.testing.assert_allclose(covariance, np.broadcast_to(covariance[:1], covariance.shape), rtol=1e-12)


@pytest.mark.parametrize("name", DEFAULTS)
def test_25_misuse_of_a_fitted_model_is_told(name):
    X, y = demonstrations()
    for method in ("predict", "predict_cov", "predict_uncertainty", "sample_y"):
        with pytest.raises(NotFittedError, match="not fitted yet"):
            getattr(new(name), method)(X)
        with pytest.raises(ValueError, match=r"X has 2 features, but .* is expecting 1"):
            getattr(fitted(name), method)(np.hstack([X, X]))
    for method in ("score", "log_likelihood"):
        with pytest.raises(NotFittedError):
            getattr(new(name), method)(X, y)
        with pytest.raises(ValueError, match="y has 1 outputs, but the model was fitted with 2"):
            getattr(fitted(name), method)(X, y[:, 0])
        with pytest.raises(ValueError, match="inconsistent numbers of samples"):
            getattr(fitted(name), method)(X, y[:5])
    with pytest.raises(ValueError, match="At most one of return_std and return_cov"):
        fitted(name).predict(X, return_std=True, return_cov=True)
    with pytest.raises(ValueError, match="n_samples == 0, must be >= 1"):
        fitted(name).sample_y(X, 0)


@pytest.mark.parametrize("name", VARIANTS)
def test_27_the_floor_holds_where_an_entry_of_the_factor_crosses_zero(name):
    X, y = demonstrations(1, n_inputs=9, n_demos=6)
    y *= np.where(X > 0.0, 1.0, 1e-5)
    model = fit(new(name), X, y)
    assert_covariances(model.predict_cov(np.linspace(-1.5, 1.5, 2001)[:, np.newaxis]), 2001, 1)


@pytest.mark.parametrize("name", VARIANTS)
def test_28_inputs_that_nearly_coincide(name, rng):
    """Kernel matrices far beyond a condition number of 1e16."""
    X, y = demonstrations(n_inputs=6, n_demos=6)
    close = np.vstack([X, X + 1e-10, X + 1e-8])
    model = fit(new(name), close, np.vstack([y, y, y]) + 0.1 * rng.normal(size=(108, 2)))
    assert 0.0 <= model.jitter_ <= 1e-6
    assert_covariances(model.predict_cov(queries(1)), 45, 2)


def test_28_a_length_scale_beyond_the_inputs_without_noise_says_what_to_do():
    X, y = demonstrations(n_inputs=30, n_demos=4)
    with pytest.raises(NotPositiveDefiniteError, match=r"noise_scale=None.*shorter length_scale"):
        fit(CholeskyCovRegressor(noise_scale=0.0, length_scale=1e4), X, y)

"""Priors, parameters, queries and numerics that the estimators must survive, or refuse and say what to do.

Numbers in the names are those of the list of faults that the project keeps.
"""

import math
import warnings

import numpy as np
import pytest
import torch
from estimators.zoo import DEFAULTS, LATENT, VARIANTS, assert_covariances, demonstrations, fit, fitted, new, queries
from sklearn.exceptions import ConvergenceWarning, NotFittedError

from torch_pbd import CholeskyCovRegressor, WishartProcessRegressor
from torch_pbd.exceptions import DataRankWarning, NotPositiveDefiniteError
from torch_pbd.gp import evidence
from torch_pbd.models import costs

NEAR = np.linspace(-1.5, 1.5, 31)[:, np.newaxis]


@pytest.mark.parametrize(
    ("prior", "message"),
    [
        (-1.0, "the smallest eigenvalue of prior is -1.0, must be above zero, positive definite"),
        (0.0, "the smallest eigenvalue of prior is 0.0"),
        (
            [[1.0, 2.0], [2.0, 1.0]],
            r"smallest eigenvalue of prior is -1.*give every direction some variance",
        ),
        (np.ones((2, 2)), "the smallest eigenvalue of prior is .*, must be above zero"),
        ([[1.0, 0.5], [0.4, 1.0]], r"the asymmetry of prior is 0\.\d+, must be zero: symmetrize it"),
        ([1.0, 2.0], r"prior has shape \(2,\), must have shape \(2, 2\)"),
        (np.eye(3), r"prior has shape \(3, 3\), must have shape \(2, 2\)"),
        (np.nan, r"prior\[0, 0\] is nan, must be finite"),
        ("papr", r"prior is 'papr', must be one of 'paper'"),
        ({}, r"prior is \{\}, must be numbers"),
        (lambda X: np.eye(2), r"prior\(X\) has shape \(2, 2\), must have shape \(8, 2, 2\)"),
        (lambda X: -np.ones((len(X), 2, 2)), r"the smallest eigenvalue of prior\(X\)\[0\] is -2"),
        (lambda X: "wide", r"prior\(X\) is 'wide', must be numbers"),
    ],
    ids=lambda value: "callable" if callable(value) else str(value),
)
@pytest.mark.parametrize(
    "name", ["cholesky", "cholesky-likelihood", "wishart", "wishart-likelihood", "heteroscedastic"]
)
def test_22_priors_that_are_no_covariance_are_refused_by_fit(name, prior, message):
    if name == "heteroscedastic":  # knows no word for a prior
        message = message.replace("must be one of 'paper'", "must be numbers .*text")
    estimator = new(name, prior=prior)  # not here, says scikit-learn
    with pytest.raises(ValueError, match=message):
        estimator.fit(*demonstrations())


@pytest.mark.parametrize("name", ["cholesky", "wishart-likelihood", "heteroscedastic"])
def test_22_what_a_callable_prior_raises_or_changes_stays_with_the_caller(name):
    X, y = demonstrations()
    kept = X.copy()

    def changes(inputs):
        inputs[:] = 0.0
        return np.broadcast_to(np.eye(2), (len(inputs), 2, 2))

    fit(new(name, prior=changes), X, y).predict_cov(X)
    np.testing.assert_array_equal(X, kept)

    def fails(inputs):
        raise KeyError("table")

    with pytest.raises(KeyError, match="table") as raised:
        new(name, prior=fails).fit(X, y)
    assert any("Raised by prior(X)" in note for note in raised.value.__notes__)


@pytest.mark.parametrize("prior", [1e-9, 1e9, np.diag([1e-4, 1e4])], ids=str)
@pytest.mark.parametrize("name", ["cholesky", "wishart", "heteroscedastic"])
def test_22_a_prior_that_is_not_held_beside_the_data_is_told(name, prior):
    with pytest.warns(UserWarning, match=r"prior has variances of .* times those of y"):
        new(name, prior=prior).fit(*demonstrations())


def test_22_a_callable_prior_is_held_to_it_when_it_predicts_too():
    def prior(X):
        return np.where(X[:, :, np.newaxis] < 2.0, 1.0, -1.0) * np.eye(2)

    model = fit(new("cholesky", prior=prior), *demonstrations())
    with pytest.raises(ValueError, match=r"the smallest eigenvalue of prior\(X\)\[1\] is"):
        model.predict_cov([[0.0], [3.0]])


@pytest.mark.parametrize(
    ("df", "error", "message"),
    [
        (1, ValueError, "df is 1, must be at least 2, the number of outputs"),
        (0, ValueError, "df is 0, must be an integer of at least 1"),
        (2.5, TypeError, "df is .*, must be an integer"),
        ("many", TypeError, "df is .*, must be an integer"),
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
    "latent_prior": ("False", ValueError),
    "bias_correction": (None, ValueError),
}


def those_with(parameters):
    """Estimators and parameters that they have."""
    return [(name, parameter) for name in DEFAULTS for parameter in parameters if parameter in new(name).get_params()]


@pytest.mark.parametrize(("name", "parameter"), those_with(BAD_PARAMETERS))
def test_parameters_out_of_range_are_refused_by_name(name, parameter):
    value, error = BAD_PARAMETERS[parameter]
    with pytest.raises(error, match=f"{parameter} .*must be|{parameter} is .* cannot be used here"):
        new(name, **{parameter: value}).fit(*demonstrations())


def test_a_noise_beyond_numbers_and_a_device_without_them_are_refused():
    for name, parameter, value in [("cholesky", "noise_scale", 1e300), ("heteroscedastic", "device", "meta")]:
        with pytest.raises(ValueError, match=f"{parameter}( is |=)"):
            new(name, **{parameter: value}).fit(*demonstrations())


def test_numbers_of_any_type_are_the_same_number():
    X, y = demonstrations()
    model = new("cholesky", length_scale=np.float32(0.25), prior=torch.tensor(2.0)).fit(X, y)
    np.testing.assert_array_equal(
        model.predict_cov(NEAR), new("cholesky", length_scale=0.25, prior=2.0).fit(X, y).predict_cov(NEAR)
    )
    assert new("mixture", n_components=np.int8(3)).fit(X, y).converged_


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf, "short", "1e-3", True, 10**400, [0.1, 0.2], [[1.0], []]])
@pytest.mark.parametrize("name", ["cholesky", "wishart", "heteroscedastic"])
def test_length_scales_that_are_none_are_refused(name, value):
    with pytest.raises(ValueError, match=r"length_scale is .*must be"):
        new(name, length_scale=value).fit(*demonstrations())


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, "1.0", True, [1.0, 2.0]])
def test_periods_that_are_none_are_refused(value):
    with pytest.raises(ValueError, match=r"period is .*must be"):
        new("heteroscedastic", kernel="periodic", period=value).fit(*demonstrations())


NUMBERS = ["max_iter", "tol", "n_restarts", "n_components", "max_inputs", "reg_covar"]


@pytest.mark.parametrize("value", ["1", None, True, np.nan, -1, 10**400, [3], 2.5j])
@pytest.mark.parametrize(("name", "parameter"), those_with(NUMBERS))
def test_numbers_that_are_none_are_refused_by_name(name, parameter, value):
    with pytest.raises((TypeError, ValueError), match=f"{parameter} is .*must be"):
        new(name, **{parameter: value}).fit(*demonstrations())


@pytest.mark.parametrize("value", ["seed", -1, 2**32, 0.5, np.nan, True, [1], np.random.default_rng(0)])
@pytest.mark.parametrize("name", DEFAULTS)
def test_seeds_that_are_none_are_refused_by_name(name, value):
    with pytest.raises(ValueError, match=r"random_state is .*must be None, an integer from 0 to"):
        new(name, random_state=value).fit(*demonstrations())
    with pytest.raises(ValueError, match=r"random_state is .*must be None"):
        fitted(name).sample_y([[0.0]], random_state=value)


@pytest.mark.parametrize("name", DEFAULTS)
def test_a_fit_that_fails_leaves_no_mixture_of_two(name):
    X, y = demonstrations()
    model = fit(new(name), X, y)
    with pytest.raises(ValueError, match="X is constant"):
        model.fit(np.ones((4, 3)), np.ones((4, 5)) * np.arange(4.0)[:, np.newaxis])
    with pytest.raises(NotFittedError):
        model.predict(X)


@pytest.mark.parametrize("name", VARIANTS)
def test_24_far_away_everything_is_finite(name):
    X = np.array([[1e6], [-1e6], [1e300], [-1e300], [np.finfo(float).max]])
    model = fitted(name)
    mean, covariance = model.predict(X, return_cov=True)
    assert np.isfinite(mean).all()
    assert_covariances(covariance, 5, 2)
    if name in LATENT:
        np.testing.assert_allclose(covariance, np.broadcast_to(covariance[:1], covariance.shape), rtol=1e-12)


@pytest.mark.parametrize("name", LATENT)
def test_24_far_away_is_the_prior_to_ten_digits(name):
    prior = np.array([[2.0, 0.5], [0.5, 1.0]])
    model = fit(new(name, prior=prior), *demonstrations())
    far = model.predict_cov([[1e6], [-1e300]])
    np.testing.assert_allclose(far, np.broadcast_to(prior, far.shape), rtol=1e-10)


@pytest.mark.parametrize("name", VARIANTS)
def test_26_no_rows_are_predicted_as_none(name):
    assert fitted(name).predict_cov(np.empty((0, 1))).shape == (0, 2, 2)
    assert fitted(name).predict(np.empty((0, 1))).shape == (0, 2)


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
    with pytest.raises(ValueError, match="n_samples is 0, must be an integer of at least 1"):
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
    close = np.vstack([X, X + 3e-7, X + 1e-6])
    model = fit(new(name), close, np.vstack([y, y, y]) + 0.1 * rng.normal(size=(108, 2)))
    assert 0.0 <= model.jitter_ <= 1e-6
    assert_covariances(model.predict_cov(queries(1)), 45, 2)


def test_28_a_length_scale_beyond_the_inputs_without_noise_says_what_to_do():
    X, y = demonstrations(n_inputs=30, n_demos=4)
    with pytest.raises(NotPositiveDefiniteError, match=r"noise_scale=None.*shorter length_scale"):
        fit(CholeskyCovRegressor(noise_scale=0.0, length_scale=1e4), X, y)


class NotANumberFrom:
    """A function whose results are NaN from a call on."""

    def __init__(self, monkeypatch, owner, name, first):
        self.n_calls, self.first, self.function = 0, first, getattr(owner, name)
        outer = self
        monkeypatch.setattr(owner, name, lambda *given, **named: outer(*given, **named))

    def __call__(self, *given, **named):
        self.n_calls += 1
        result = self.function(*given, **named)
        if self.n_calls < self.first:
            return result
        if isinstance(result, tuple):
            return tuple(part * math.nan if isinstance(part, torch.Tensor) else part for part in result)
        return result * math.nan


TRAINED = [
    ("cholesky-likelihood", "at_root"),
    ("cholesky-likelihood", "gradient"),
    ("cholesky-eq12", "at_root"),
    ("wishart-likelihood", "at_root"),
    ("wishart-likelihood", "gradient"),
]


@pytest.mark.parametrize("first", [2, 3, 4])
@pytest.mark.parametrize(("name", "function"), TRAINED)
def test_29_a_loss_that_is_no_number_keeps_the_best_point_and_is_told(name, function, first, monkeypatch):
    broken = NotANumberFrom(monkeypatch, costs.Likelihood, function, first)
    with pytest.warns(ConvergenceWarning, match=r"stopped early: .*The best point found is kept"):
        model = new(name).fit(*demonstrations())
    assert broken.n_calls >= first
    assert not model.converged_
    assert math.isfinite(model.loss_)
    assert model.loss_ <= model.loss_curve_[0]
    assert_covariances(model.predict_cov(NEAR), 31, 2)


@pytest.mark.parametrize(("name", "function"), TRAINED)
def test_29_a_loss_that_is_none_at_the_start_is_an_error(name, function, monkeypatch):
    NotANumberFrom(monkeypatch, costs.Likelihood, function, 1)
    with pytest.raises(ValueError, match=r"The optimization cannot start: "):
        new(name).fit(*demonstrations())


@pytest.mark.parametrize("first", [2, 4])
@pytest.mark.parametrize("name", ["cholesky", "cholesky-likelihood", "wishart-likelihood"])
def test_29_evidence_that_is_no_number_counts_as_too_far(name, first, monkeypatch):
    whole = fitted(name).predict_cov(NEAR)
    broken = NotANumberFrom(monkeypatch, evidence.Evidence, "__call__", first)
    with pytest.warns(ConvergenceWarning, match="not finite"):
        model = new(name).fit(*demonstrations())
    covariance = model.predict_cov(NEAR)
    assert broken.n_calls >= first
    assert_covariances(covariance, 31, 2)
    assert np.abs(np.log(covariance[:, 0, 0] / whole[:, 0, 0])).max() < 1.0  # the grid's point is no bad one


@pytest.mark.parametrize("name", ["cholesky", "wishart"])
def test_29_evidence_that_is_never_a_number_is_an_error(name, monkeypatch):
    NotANumberFrom(monkeypatch, evidence.Evidence, "__call__", 1)
    with pytest.raises(NotPositiveDefiniteError, match=r"wherever the hyperparameters were searched.*noise_scale=None"):
        new(name).fit(*demonstrations())


@pytest.mark.parametrize("name", ["cholesky", "wishart", "cholesky-likelihood", "heteroscedastic"])
def test_30_between_inputs_the_mean_has_no_needles(name, rng):
    """A length scale far below the spacing would explain each input by itself."""
    X = np.tile(np.linspace(0.0, 1.0, 12)[:, np.newaxis], (6, 1))
    y = np.sin(6.0 * X) + 0.3 * rng.normal(size=X.shape)
    model = fit(new(name), X, y)
    dense = model.predict(np.linspace(0.0, 1.0, 1200)[:, np.newaxis])[:, 0]
    at_inputs = model.predict(X[:12])[:, 0]
    assert np.abs(np.diff(dense)).sum() < 1.1 * np.abs(np.diff(at_inputs)).sum() + 0.2


FEW = [name for name in VARIANTS if any(part in name for part in ("likelihood", "eq1", "heteroscedastic", "mixture"))]


@pytest.mark.parametrize("d", [1, 2])
@pytest.mark.parametrize("name", FEW)
def test_31_the_likelihood_of_two_points_is_bounded(name, d):
    few = {"n_components": 1} if "mixture" in name else {}
    model = new(name, **few, max_iter=5000)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataRankWarning)
        fit(model, [[0.0], [1.0]], np.array([[1.0, 2.0], [3.0, 5.0]])[:, :d])
    assert -50.0 < model.loss_ < 50.0  # its mean passes through both: without a floor there is no least loss
    variance = np.diagonal(model.predict_cov([[0.0], [1.0]]), axis1=1, axis2=2)
    assert (variance > 1e-13).all()

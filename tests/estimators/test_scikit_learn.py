"""The estimators among those of scikit-learn: its own checks, and its tools for selection and composition."""

import copy
import io
import pickle
import tempfile
import warnings

import joblib
import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
import skops.io
import torch
from sklearn.base import clone, is_regressor
from sklearn.exceptions import ConvergenceWarning
from sklearn.model_selection import GridSearchCV, GroupKFold, cross_val_score
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from sklearn.utils.estimator_checks import parametrize_with_checks

from estimators.zoo import (
    DEFAULTS,
    VARIANTS,
    assert_same_model,
    demonstrations,
    fit,
    fitted,
    new,
    predictions,
    queries,
    random_states,
)
from torch_pbd import Demonstrations
from torch_pbd.metrics import log_likelihood_scorer

# Their data have no two inputs alike, where these two take longest; what is checked does not need an optimum.
BRIEF = [new("wishart", max_iter=5), new("heteroscedastic", max_iter=5, n_inducing=16)]


def of_other_data(test):
    """Test whose data are no demonstrations: more outputs than rows at an input, columns that repeat, one iteration."""
    for category in ("torch_pbd.exceptions.DataRankWarning", "sklearn.exceptions.ConvergenceWarning"):
        test = pytest.mark.filterwarnings(f"ignore::{category}")(test)
    return pytest.mark.filterwarnings("ignore::sklearn.exceptions.SkipTestWarning")(test)


@of_other_data
@parametrize_with_checks([*(new(name) for name in ("cholesky", "mixture")), *BRIEF])
def test_scikit_learn_checks(estimator, check):
    check(estimator)


@pytest.mark.slow
@of_other_data
@parametrize_with_checks([new(name) for name in ("wishart", "heteroscedastic")])
def test_scikit_learn_checks_as_they_are(estimator, check):
    check(estimator)


@pytest.mark.parametrize("name", VARIANTS)
def test_it_is_a_regressor_whose_parameters_come_back(name):
    estimator = VARIANTS[name]
    assert is_regressor(estimator)
    assert repr(clone(estimator)) == repr(estimator)
    assert type(estimator)(**estimator.get_params()).get_params() == estimator.get_params()


@pytest.mark.filterwarnings("ignore:length_scale is so long")  # the one given here is, and it does not matter
@pytest.mark.parametrize("name", VARIANTS)
def test_a_fit_edits_no_parameter(name):
    length_scale = [0.5]
    estimator = new(
        name, **({} if "mixture" in name else {"length_scale": length_scale, "prior": [[4.0, 1.0], [1, 3]]})
    )
    before = copy.deepcopy(estimator.get_params())
    fit(estimator, *demonstrations())
    assert estimator.get_params() == before
    assert not hasattr(clone(estimator), "module_")


def by_pickle(model):
    return pickle.loads(pickle.dumps(model))


def by_joblib(model):
    file = io.BytesIO()
    joblib.dump(model, file)
    file.seek(0)
    return joblib.load(file)


def by_skops(model):
    return skops.io.loads(skops.io.dumps(model), trusted=[f"{type(model).__module__}.{type(model).__name__}"])


@pytest.mark.parametrize("copied", [copy.copy, copy.deepcopy, by_pickle, by_joblib, by_skops])
@pytest.mark.parametrize("name", VARIANTS)
def test_a_copy_predicts_the_same_to_the_bit(name, copied):
    model = fitted(name)
    twin = copied(model)
    assert_same_model(twin, model, queries(1))
    assert twin.get_params() == model.get_params()
    learned = {key: value for key, value in vars(model).items() if key.endswith("_") and key != "module_"}
    assert {key: vars(twin)[key] for key in learned} == learned


def test_so_does_one_whose_processes_rest_on_nodes(rng):
    """What is kept of them must have the same strides in the copy: sums of others are in another order."""
    X = np.tile(np.linspace(0.0, 1.0, 60), 6)[:, np.newaxis]
    model = new("cholesky").fit(X, rng.normal(size=(360, 2)).cumsum(axis=0))
    assert_same_model(by_pickle(model), model, np.linspace(-1.0, 2.0, 40)[:, np.newaxis])


@pytest.mark.parametrize("name", DEFAULTS)
def test_an_unfitted_estimator_can_be_copied_too(name):
    assert repr(by_pickle(new(name))) == repr(by_skops(new(name))) == repr(new(name))


@pytest.mark.parametrize("name", DEFAULTS)
def test_the_copy_is_still_differentiable(name):
    module = by_pickle(fitted(name)).module_
    x = torch.tensor([[0.3]], dtype=torch.float64, requires_grad=True)
    module(x)[1].sum().backward()
    assert x.grad.abs().sum() > 0


@pytest.mark.parametrize("name", VARIANTS)
def test_two_fits_are_equal_to_the_bit_and_leave_the_process_as_it_was(name):
    X, y = demonstrations()
    kept = X.copy(), y.copy()
    before = random_states()
    estimator = fit(new(name), X, y)
    predictions(estimator, X)
    assert random_states() == before
    np.testing.assert_array_equal(X, kept[0])
    np.testing.assert_array_equal(y, kept[1])
    assert_same_model(estimator, fitted(name), queries(1))
    assert_same_model(fit(estimator, X, y), fitted(name), queries(1))  # a second fit starts afresh


@pytest.mark.parametrize("name", DEFAULTS)
def test_random_state_decides_what_is_drawn(name):
    model, X = fitted(name), queries(1)
    drawn = model.sample_y(X, 2, random_state=1)
    np.testing.assert_array_equal(drawn, model.sample_y(X, 2, random_state=np.random.RandomState(1)))
    assert (drawn != model.sample_y(X, 2, random_state=2)).any()
    before = random_states()
    model.sample_y(X, random_state=0)
    assert random_states() == before


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", VARIANTS)
def test_the_default_dtype_does_not_matter(name, dtype):
    previous = torch.get_default_dtype()
    try:
        torch.set_default_dtype(dtype)
        model = fit(new(name), *demonstrations())
        assert torch.get_default_dtype() == dtype
        assert_same_model(model, fitted(name), queries(1))
    finally:
        torch.set_default_dtype(previous)


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
@pytest.mark.parametrize("name", VARIANTS)
def test_it_fits_where_gradients_are_switched_off(name, mode):
    expected = fitted(name)
    with mode():
        model = fit(new(name), *demonstrations())
        assert_same_model(model, expected, queries(1))
        copied = by_pickle(model)
    for module in (model.module_, copied.module_):
        x = torch.zeros(1, 1, dtype=torch.float64, requires_grad=True)
        module(x)[0].sum().backward()
        assert x.grad is not None


@pytest.mark.parametrize("name", DEFAULTS)
def test_deterministic_algorithms_are_enough(name):
    try:
        torch.use_deterministic_algorithms(True)
        model = fit(new(name), *demonstrations())
        assert torch.are_deterministic_algorithms_enabled()
    finally:
        torch.use_deterministic_algorithms(False)
    assert_same_model(model, fitted(name), queries(1))


@pytest.mark.parametrize("name", VARIANTS)
def test_the_order_of_the_rows_does_not_matter(name, rng):
    X, y = demonstrations()
    order = rng.permutation(len(X))
    assert_same_model(fit(new(name), X[order], y[order]), fitted(name), queries(1))


def read_only(array):
    array = array.copy()
    array.flags.writeable = False
    return array


def memory_map(array):
    with tempfile.TemporaryFile() as file:
        mapped = np.memmap(file, dtype=array.dtype, shape=array.shape)
    mapped[...] = array
    return mapped


def reversed_view(array):
    return array[::-1].copy()[::-1]


def needing_gradients(array):
    return torch.tensor(array, requires_grad=True)


FORMS = [list, np.asfortranarray, read_only, memory_map, reversed_view, needing_gradients, torch.tensor]
FORMS += [lambda array: pd.DataFrame(array, columns=[f"c{i}" for i in range(array.shape[1])])]


@pytest.mark.parametrize("form", FORMS, ids=lambda form: form.__name__)
@pytest.mark.parametrize("name", DEFAULTS)
def test_the_form_of_the_arrays_does_not_matter(name, form):
    X, y = demonstrations(1, 2)
    X_query = queries(2)
    model = fit(new(name), form(X), form(y))
    expected = *predictions(fitted(name, 1, 2), X_query), fitted(name, 1, 2).log_likelihood(X, y)
    for part, truth in zip(
        (*predictions(model, form(X_query)), model.log_likelihood(form(X), form(y))), expected, strict=True
    ):
        assert type(part) is np.ndarray
        np.testing.assert_array_equal(part, truth)


@pytest.mark.parametrize("name", DEFAULTS)
@pytest.mark.parametrize("dtype", [np.float32, np.int64, np.int8, bool])
def test_numbers_of_other_types_are_computed_in_float64(name, dtype, rng):
    X, y = rng.integers(2 if dtype is bool else 5, size=(2, 60, 2)).astype(dtype)
    model = fit(new(name), X, y)
    assert_same_model(model, fit(new(name), X.astype(np.float64), y.astype(np.float64)), X)
    assert model.predict(X).dtype == np.float64


@pytest.mark.parametrize("name", DEFAULTS)
def test_names_of_columns_are_kept_and_held_to(name):
    X, y = demonstrations(2, 2, n_inputs=5)
    frame = pd.DataFrame(X, columns=["time", "place"])
    model = fit(new(name), frame, pd.DataFrame(y, columns=["x", "y"]))
    assert model.feature_names_in_.tolist() == ["time", "place"]
    assert by_pickle(model).feature_names_in_.tolist() == ["time", "place"]
    with pytest.raises(ValueError, match="feature names should match"):
        model.predict_cov(frame[["place", "time"]])
    with pytest.warns(UserWarning, match="does not have valid feature names"):
        model.predict_cov(X)


def test_tables_of_pyarrow_are_read_and_equal_names_refused():
    X, y = demonstrations(2)
    table = pa.table({"time": X[:, 0]})
    model = new("mixture").fit(table, pa.table({"x": y[:, 0], "y": y[:, 1]}))
    np.testing.assert_array_equal(model.predict_cov(table), new("mixture").fit(X, y).predict_cov(X))
    with pytest.raises(ValueError, match=r"X has several columns 'time', must have one of each name"):
        new("mixture").fit(pd.DataFrame(np.hstack([X, X]), columns=["time", "time"]), y)
    with pytest.raises(ValueError, match=r"table must have one column of each name: rename"):
        Demonstrations.from_frame(pd.DataFrame(np.hstack([X, y, y]), columns=["time", "x", "y", "x", "y"]))


@pytest.mark.parametrize("name", DEFAULTS)
def test_y_may_be_one_dimensional_or_a_column(name):
    X, y = demonstrations(1)
    flat, column = fit(new(name), X, y[:, 0]), fitted(name, 1)
    queried = queries(1)
    for method in ("predict", "sample_y"):
        flat_result, column_result = getattr(flat, method)(queried), getattr(column, method)(queried)
        assert column_result.ndim == flat_result.ndim + 1
    assert flat.predict(queried).shape == (len(queried),)
    assert flat.predict(queried, return_std=True)[1].shape == (len(queried),)
    assert column.predict(queried, return_std=True)[1].shape == (len(queried), 1)
    assert flat.sample_y(queried, 3).shape == (len(queried), 3)
    np.testing.assert_array_equal(flat.predict_cov(queried), column.predict_cov(queried))
    np.testing.assert_array_equal(flat.log_likelihood(X, y), column.log_likelihood(X, y[:, 0]))


@pytest.mark.parametrize("name", DEFAULTS)
def test_covariances_pass_through_a_pipeline(name):
    X, y = demonstrations(1, 2)
    pipeline = make_pipeline(StandardScaler(), new(name))
    fit(pipeline, X, y)
    mean, covariance = pipeline.predict(X, return_cov=True)
    alone, scaled = fitted(name, 1, 2), pipeline[0].transform(X)
    np.testing.assert_array_equal(covariance, pipeline[-1].predict_cov(scaled))
    # The estimator standardizes by itself: a scaler before it changes nothing but rounding.
    np.testing.assert_allclose(mean, alone.predict(X), rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(covariance, alone.predict_cov(X), rtol=1e-6, atol=1e-6)
    assert pipeline.score(X, y) == pytest.approx(alone.score(X, y), abs=1e-6)


def small_grid(name):
    return {"n_components": [1, 3]} if name == "mixture" else {"length_scale": [0.25, 0.4]}


@pytest.mark.parametrize(("name", "n_jobs"), [*((name, 1) for name in DEFAULTS), ("heteroscedastic", 2)])
def test_selection_over_left_out_demonstrations_in_one_process_and_in_two(name, n_jobs):
    X, y = demonstrations()
    groups = np.repeat(np.arange(12), 8)
    folds = GroupKFold(3)
    options = {"cv": folds, "n_jobs": n_jobs, "error_score": "raise"}
    search = GridSearchCV(new(name), small_grid(name), **options)
    search.fit(X, y, groups=groups)
    scores = cross_val_score(search.best_estimator_, X, y, groups=groups, **options)
    assert np.isfinite(scores).all()
    assert scores.mean() == pytest.approx(search.best_score_, rel=1e-12)
    # Here torch has one thread, there as many as the workers leave it: sums in another order.
    serial = cross_val_score(search.best_estimator_, X, y, cv=folds, groups=groups, scoring=log_likelihood_scorer)
    np.testing.assert_allclose(serial, scores, rtol=1e-6)


@pytest.mark.parametrize("name", ["cholesky-likelihood", "wishart-likelihood", "mixture", "mixture-lbfgs"])
def test_a_fit_that_stops_early_says_so_and_keeps_its_best_point(name):
    X, y = demonstrations(aligned=False)
    model = new(name, max_iter=2, tol=1e-12)
    with pytest.warns(ConvergenceWarning, match=r"stopped early: .*max_iter.*raise max_iter \(now 2\)"):
        model.fit(X, y)
    assert not model.converged_
    assert model.n_iter_ <= 2
    assert model.loss_ == min(model.loss_curve_) < model.loss_curve_[0]
    assert model.loss_ >= fitted(name, aligned=False).loss_


@pytest.mark.parametrize("name", VARIANTS)
def test_what_a_fit_reports(name):
    model = fitted(name)
    assert isinstance(model.converged_, bool)
    assert isinstance(model.n_iter_, int)
    assert model.n_iter_ >= 1
    assert isinstance(model.loss_curve_, list)
    assert model.loss_ == model.loss_curve_[-1]
    if not name.startswith("heteroscedastic"):  # whose losses are each of residuals from another mean
        assert model.loss_ == min(model.loss_curve_)
    assert np.isfinite(model.loss_curve_).all()
    assert 0.0 <= model.jitter_ <= 1e-6
    assert (model.n_features_in_, model.n_outputs_) == (1, 2)
    assert all(not parameter.requires_grad for parameter in model.module_.parameters())


def test_a_search_that_stops_early_says_so():
    X, y = demonstrations(aligned=False)
    model = new("heteroscedastic", max_iter=1, tol=1e-12)
    with pytest.warns(ConvergenceWarning, match=r"stopped early: .*max_iter.*raise max_iter \(now 1\)"):
        model.fit(X, y)
    assert not model.converged_
    assert model.n_iter_ == 1
    assert len(model.loss_curve_) == 3
    assert fitted("heteroscedastic", aligned=False).converged_


@pytest.mark.parametrize("name", ["cholesky-likelihood", "heteroscedastic", "mixture-lbfgs"])
def test_verbose_prints_the_loss_to_standard_error(name, capsys):
    fit(new(name, verbose=1), *demonstrations())
    out, err = capsys.readouterr()
    assert out == ""
    assert "loss" in err


def test_a_warning_is_told_where_fit_was_called():
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        new("wishart-likelihood", max_iter=1, tol=1e-12).fit(*demonstrations())
    assert [warning.filename for warning in caught] == [__file__]

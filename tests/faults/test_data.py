"""Data and parameters that the estimators must survive, or refuse with a message that says what to do.

Numbers in the names are those of the list of faults that the project keeps.
"""

import warnings

import numpy as np
import pandas as pd
import pytest
import scipy.sparse
import torch
from estimators.zoo import DEFAULTS, LATENT, VARIANTS, assert_covariances, demonstrations, fit, fitted, new
from sklearn import config_context

import torch_pbd.files.memory
from torch_pbd import CholeskyCovRegressor, DMPController, GMMBaseline, WishartProcessRegressor
from torch_pbd.data import make_tunnel_demonstrations
from torch_pbd.estimators.door import by_chunks
from torch_pbd.exceptions import DataRankWarning, UnimodalityWarning
from torch_pbd.models.heteroscedastic.search import check_memory

EMPIRICAL = [CholeskyCovRegressor(objective="empirical"), WishartProcessRegressor(objective="mse")]
LIKELIHOOD = ["cholesky-likelihood", "wishart-likelihood"]
NEAR = np.linspace(-1.5, 1.5, 31)[:, np.newaxis]


def warned(estimator, X, y, category=DataRankWarning):
    """Fit, and the messages of this category, told where fit was called."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        estimator.fit(X, y)
    caught = [warning for warning in caught if issubclass(warning.category, category)]
    assert {warning.filename for warning in caught} <= {__file__}
    return [str(warning.message) for warning in caught]


@pytest.mark.parametrize("estimator", EMPIRICAL, ids=["cholesky", "wishart"])
def test_1_one_demonstration_has_no_empirical_covariance(estimator):
    X, y = demonstrations(n_demos=1)
    with pytest.raises(ValueError, match=r"needs >= 2 demonstrations .* got 1 .*8 of 8.* use objective='likelihood'"):
        estimator.fit(X, y)
    X, y = demonstrations(n_demos=4)
    with pytest.raises(ValueError, match=r"got 1 at X = \[0\.5\] \(1 of 9 inputs have one row\)"):
        estimator.fit(np.vstack([X, [[0.5]]]), np.vstack([y, [[0.0, 0.0]]]))


# Towards a covariance of zero, where likelihoods go, L-BFGS takes a thousand iterations.
held_short = pytest.mark.parametrize("options", [{"max_iter": 100}, pytest.param({}, marks=pytest.mark.slow)], ids=str)


@held_short
@pytest.mark.parametrize("name", [*LIKELIHOOD, "cholesky", "wishart", "heteroscedastic", "mixture", "mixture-lbfgs"])
def test_1_one_demonstration_is_enough_for_a_likelihood(name, options):
    model = fit(new(name, **options), *demonstrations(n_demos=1))
    assert_covariances(model.predict_cov(NEAR), 31, 2)


def test_1_groups_with_one_demonstration_are_told():
    X, y = demonstrations(n_demos=1)
    model = new("heteroscedastic")
    with pytest.warns(DataRankWarning, match="groups has one demonstration: how far its samples repeat each other"):
        model.fit(X, y, groups=np.zeros(len(X)))
    assert_covariances(model.predict_cov(NEAR), 31, 2)


@pytest.mark.parametrize("name", ["cholesky", "cholesky-log", "wishart"])
@pytest.mark.parametrize(("d", "n_demos"), [(5, 3), (2, 2), (9, 9)])
def test_2_fewer_demonstrations_than_outputs_are_shrunk_and_told(name, d, n_demos):
    model = new(name)
    messages = warned(model, *demonstrations(d, n_demos=n_demos))
    assert len(messages) == 1
    assert f"y has {n_demos} demonstrations at an input but {d} outputs" in messages[0]
    assert f"{d + 1} or more" in messages[0]
    covariance = model.predict_cov(demonstrations(d)[0][:8])
    assert_covariances(covariance, 8, d)
    assert np.linalg.eigvalsh(covariance)[:, 0].min() > 1e-3  # not the floor, 1e-12


@pytest.mark.parametrize("name", ["heteroscedastic", "mixture"])
def test_2_fewer_demonstrations_than_outputs_are_enough_where_inputs_are_pooled(name):
    model = new(name)
    assert warned(model, *demonstrations(5, n_demos=3)) == []
    covariance = model.predict_cov(demonstrations(5)[0][:8])
    assert_covariances(covariance, 8, 5)
    assert np.linalg.eigvalsh(covariance)[:, 0].min() > 1e-3


@held_short
@pytest.mark.parametrize("name", LIKELIHOOD)
def test_2_a_likelihood_of_fewer_demonstrations_than_outputs_is_told(name, options):
    model = new(name, **options)
    messages = warned(model, *demonstrations(5, n_demos=3))
    assert len(messages) == 1
    assert "y has 3 demonstrations at an input but 5 outputs: the likelihood takes for certain" in messages[0]
    assert "objective='auto' shrinks it. 6 or more demonstrations determine the covariance" in messages[0]
    assert_covariances(model.predict_cov(demonstrations(5)[0][:8]), 8, 5)


@pytest.mark.parametrize("name", ["mixture", "mixture-lbfgs"])
def test_2_fewer_rows_than_outputs_are_told_by_a_mixture(name):
    messages = warned(new(name, n_components=1), *demonstrations(3, n_inputs=3, n_demos=1))
    assert messages == [
        "y has 3 distinct rows but 3 outputs: they leave directions of the covariance undetermined, which reg_covar "
        "decides. Record more."
    ]


@pytest.mark.parametrize("name", [*LIKELIHOOD, "heteroscedastic"])
def test_2_fewer_rows_than_outputs_are_told(name):
    messages = warned(new(name), *demonstrations(3, n_inputs=3, n_demos=1))
    assert messages == [
        "y has 3 rows but 3 outputs: they leave directions of the covariance undetermined, which the prior decides. "
        "Record more."
    ]


@pytest.mark.parametrize("noise", [0.0, 1e-12])
@pytest.mark.parametrize("name", VARIANTS)
def test_3_a_constant_output_is_precise_beside_the_others(name, noise, rng):
    X, y = demonstrations()
    y[:, 1] = 0.5 + noise * rng.normal(size=len(y))
    model = new(name)
    assert warned(model, X, y) == []
    mean, covariance = model.predict(NEAR, return_cov=True)
    assert_covariances(covariance, 31, 2)
    on_data = model.predict_cov(X[:8])
    # Vectors that L-BFGS drives to zero get there slowly: 1 % of the other's deviation is where it stops.
    trained = name in ("wishart-likelihood", "wishart-eq11")
    assert (on_data[:, 1, 1] < (1e-4 if trained else 1e-9) * on_data[:, 0, 0]).all()
    np.testing.assert_allclose(mean[:, 1], 0.5, rtol=0, atol=1e-9)
    other = fitted(name).predict_cov(X[:8])[:, 0, 0]
    if name in ("cholesky-interpolating", "wishart"):  # those that see each output by itself
        np.testing.assert_allclose(on_data[:, 0, 0], other, rtol=1e-6)


@pytest.mark.parametrize("value", [0.0, 0.5, -1e9])
@pytest.mark.parametrize("name", VARIANTS)
def test_3_outputs_that_are_all_constant_are_told(name, value):
    X, y = demonstrations()
    model = new(name)
    messages = warned(model, X, np.full_like(y, value))
    assert len(messages) == 1
    assert "covariance is zero, and the smallest that can be told from it is used" in messages[0]
    mean, covariance = model.predict(X, return_cov=True)
    assert_covariances(covariance, len(X), 2)
    assert np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)).max() < 5e-3 * max(abs(value), 1.0)
    np.testing.assert_allclose(mean, value, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", LATENT)
def test_4_identical_demonstrations_are_told(name):
    X, y = demonstrations()
    model = new(name)
    messages = warned(model, X, np.tile(y[:8], (12, 1)))
    assert len(messages) == 1
    assert messages[0].startswith("The demonstrations are identical: their covariance is zero")
    covariance = model.predict_cov(NEAR)
    assert_covariances(covariance, 31, 2)
    if model.get_params().get("objective") != "likelihood":
        assert np.diagonal(model.predict_cov(X), axis1=1, axis2=2).max() < 1e-9


@pytest.mark.parametrize("name", ["mixture", "mixture-lbfgs"])
def test_4_identical_demonstrations_are_no_special_case_of_a_mixture(name):
    """It knows no demonstrations: between its components there is as much spread as if each row were one."""
    X, y = demonstrations()
    model = new(name)
    assert warned(model, X, np.tile(y[:8], (12, 1))) == []
    assert_covariances(model.predict_cov(NEAR), 31, 2)


@pytest.mark.parametrize("name", ["cholesky", "wishart"])
def test_4_demonstrations_that_start_at_one_point_are_no_special_case(name):
    X, y = demonstrations()
    y[X[:, 0] == -1.0] = 0.0
    model = new(name)
    assert warned(model, X, y) == []
    covariance = model.predict_cov(NEAR)
    assert_covariances(covariance, 31, 2)
    assert model.predict_cov(np.array([[-1.0]])).max() < 0.3 * model.predict_cov(np.array([[0.0]])).max()


@pytest.mark.parametrize("name", ["cholesky", "wishart", "cholesky-likelihood", "wishart-likelihood"])
def test_5_rows_of_one_input_are_one_input_however_they_are_ordered(name, rng):
    X, y = demonstrations()
    order = rng.permutation(len(X))
    model = fit(new(name), X[order], y[order])
    assert len(model.module_.core.covariance.latent.inputs) == 8
    np.testing.assert_array_equal(model.predict_cov(NEAR), fitted(name).predict_cov(NEAR))


@pytest.mark.parametrize("name", LIKELIHOOD)
def test_5_inputs_that_nearly_repeat_give_what_repeated_ones_do(name):
    X, y = demonstrations(1, n_inputs=6, n_demos=8)
    near = X + 1e-9 * np.arange(len(X))[:, np.newaxis]
    exact = fit(new(name), X, y)
    with pytest.warns(UserWarning, match="X has 42 values in column 0 that differ from others by a rounding"):
        close = fit(new(name), near, y)
    np.testing.assert_allclose(close.predict_cov(X), exact.predict_cov(X), rtol=1e-5)


@pytest.mark.parametrize("name", DEFAULTS)
def test_6_inputs_that_are_all_equal_are_refused(name):
    X, y = demonstrations()
    with pytest.raises(ValueError, match=r"X is constant: its columns .* in all 96 rows.*Give the time, phase"):
        new(name).fit(np.full_like(X, 3.0), y)
    with pytest.raises(ValueError, match=r"X is constant: its columns"):
        new(name).fit(np.tile([[1e9, -2.0]], (96, 1)), y)


@pytest.mark.parametrize("name", DEFAULTS)
def test_7_unequal_lengths_are_refused_with_both(name):
    X, y = demonstrations()
    with pytest.raises(ValueError, match=r"inconsistent numbers of samples: \[96, 50\]"):
        new(name).fit(X, y[:50])
    with pytest.raises(ValueError, match="inhomogeneous"):
        new(name).fit([[0.0], [1.0, 2.0]], y[:2])


@pytest.mark.parametrize("name", ["heteroscedastic", "mixture", "mixture-lbfgs", "wishart-likelihood"])
def test_5_rows_in_another_order_are_the_same_model(name, rng):
    X, y = demonstrations()
    order = rng.permutation(len(X))
    model = fit(new(name), X[order], y[order])
    np.testing.assert_array_equal(model.predict_cov(NEAR), fitted(name).predict_cov(NEAR))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("name", DEFAULTS)
def test_8_what_is_not_finite_is_refused(name, value):
    X, y = demonstrations()
    for column in ("X", "y"):
        broken = {"X": X.copy(), "y": y.copy()}
        broken[column][17, -1] = value
        last = broken[column].shape[1] - 1
        place = rf"{column}\[17, {last}\] is (nan|-?inf), must be finite.*: leave such rows out"
        with pytest.raises(ValueError, match=place):
            new(name).fit(**broken)
        objects = broken | {column: [[None if entry == value or entry != entry else entry for entry in row]
                                     for row in broken[column].tolist()]}  # fmt: skip
        with pytest.raises(ValueError, match=rf"{column}\[17, {last}\] is nan, must be finite"):
            new(name).fit(**objects)
        with pytest.raises(ValueError, match=rf"{column}\[17, {last}\] is nan, must be finite"):
            fitted(name).score(**objects)
        frames = {key: pd.DataFrame(part, columns=["a", "b"][: part.shape[1]]) for key, part in broken.items()}
        with pytest.raises(ValueError, match=rf"{column}\['{'ab'[last]}'\]\[17\] is .*, must be finite"):
            new(name).fit(**frames)
        with config_context(assume_finite=True), pytest.raises(ValueError, match=rf"{column}\[17, {last}\] is"):
            new(name).fit(**broken)
        with pytest.raises(ValueError, match=rf"{column}\[17, {last}\] is"):
            fitted(name).log_likelihood(**broken)
    with pytest.raises(ValueError, match=r"X\[0, 0\] is"):
        fitted(name).predict_cov([[value]])


@pytest.mark.parametrize("name", DEFAULTS)
def test_12_13_too_little_data_is_refused(name):
    X, y = demonstrations()
    with pytest.raises(ValueError, match=r"1 sample\(s\) .* minimum of 2 is required"):
        new(name).fit(X[:1], y[:1])
    with pytest.raises(ValueError, match=r"0 sample\(s\)"):
        new(name).fit(X[:0], y[:0])
    with pytest.raises(ValueError, match=r"0 feature\(s\)"):
        new(name).fit(X[:, :0], y)
    with pytest.raises(ValueError, match=r"0 feature\(s\) \(shape=\(96, 0\)\)"):
        new(name).fit(X, y[:, :0])
    with pytest.raises(ValueError, match="Expected 2D array"):
        new(name).fit(X[:, 0], y)
    with pytest.raises(ValueError, match="dim 3"):
        new(name).fit(X, y[:, :, np.newaxis])
    with pytest.raises(ValueError, match="Expected 2D array"):
        new(name).fit([], [])


@pytest.mark.parametrize("name", VARIANTS)
def test_12_two_samples_are_enough_for_one_output(name):
    model = new(name, **({"n_components": 1} if "mixture" in name else {}), **objective_for_few(name))
    fit(model, [[0.0], [1.0]], [1.0, 2.0])
    assert_covariances(model.predict_cov([[0.0], [0.5], [1.0], [9.0]]), 4, 1)


def objective_for_few(name):
    return {"objective": "likelihood"} if name in LATENT and name != "heteroscedastic" else {}


@pytest.mark.parametrize("name", DEFAULTS)
@pytest.mark.parametrize("form", [np.array, torch.tensor, pd.DataFrame], ids=["array", "tensor", "frame"])
def test_15_unix_time_in_float32_is_refused(name, form):
    """It has steps of 128 s, or 203 s by the bound that is checked."""
    y = demonstrations()[1]
    time = form(np.float32(1.7e9 + np.arange(96.0))[:, np.newaxis])
    with pytest.raises(
        ValueError,
        match=r"resolution of float32 in X.*0\]? is 202.*, must be at most a thousandth of its range: subtract",
    ):
        new(name).fit(time, y)
    fit(new(name), np.arange(96.0, dtype=np.float32)[:, np.newaxis], y)  # less an offset


@pytest.mark.parametrize("name", [*DEFAULTS, *LIKELIHOOD])
def test_15_coordinates_with_large_offsets(name):
    X, y = demonstrations()
    model = fit(new(name), X + 1.7e9, y + np.array([5e5, 5.5e6]))  # unix time, UTM
    expected = fitted(name).predict_cov(X)
    # A float64 holds this time to 2e-7 s of 2 s.
    np.testing.assert_allclose(model.predict_cov(X + 1.7e9), expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("name", DEFAULTS)
def test_16_what_is_coarser_than_float32_is_refused(name):
    X, y = demonstrations()
    with pytest.raises(ValueError, match=r"X is a tensor of torch\.bfloat16, which is too coarse: record it"):
        new(name).fit(torch.tensor(X, dtype=torch.bfloat16), y)
    with pytest.raises(ValueError, match=r"the resolution of float16 in y\[1\] is .*, must be at most a thousandth"):
        new(name).fit(X, (y + np.array([0.0, 2000.0])).astype(np.float16))


@pytest.mark.parametrize("name", VARIANTS)
def test_16_float32_is_computed_in_float64(name):
    X, y = (part.astype(np.float32) for part in demonstrations())
    single = fit(new(name), X, y)
    double = fit(new(name), X.astype(np.float64), y.astype(np.float64))
    np.testing.assert_array_equal(single.predict_cov(NEAR), double.predict_cov(NEAR))
    mean, covariance = single.predict(NEAR.astype(np.float32), return_cov=True)
    assert (mean.dtype, covariance.dtype) == (np.float64, np.float64)


STRINGS = [
    lambda array: array.astype(str),
    lambda array: array.astype(str).astype(object),
    lambda array: array.astype(str).tolist(),
    lambda array: pd.DataFrame(array.astype(str)),
    lambda array: pd.DataFrame(array.astype(str).astype(object)),
]


@pytest.mark.parametrize("form", STRINGS, ids=["array", "object", "list", "frame", "object frame"])
@pytest.mark.parametrize("name", DEFAULTS)
def test_17_numbers_as_text_are_refused(name, form):
    X, y = demonstrations()
    for column in ("X", "y"):
        texts = {"X": X, "y": y}
        texts[column] = form(texts[column])
        with pytest.raises(ValueError, match=f"{column} holds text, .*: convert it to numbers first"):
            new(name).fit(**texts)
    with pytest.raises(ValueError, match="X holds text"):
        fitted(name).predict(form(X))


@pytest.mark.parametrize("name", DEFAULTS)
def test_17_what_is_no_number_is_refused(name):
    X, y = demonstrations()
    for X_bad, y_bad, error, message in [
        (X + 1j, y, ValueError, "Complex data not supported"),
        (X, y + 1j, ValueError, "Complex data not supported"),
        (scipy.sparse.csr_matrix(X), y, TypeError, "Sparse data was passed for X"),
        (X, scipy.sparse.csr_matrix(y), TypeError, "Sparse data was passed for y"),
        (None, y, ValueError, "Expected 2D array"),
        (X, None, ValueError, "requires y to be passed"),
        (np.full((96, 1), None), y, ValueError, r"X\[0, 0\] is nan, must be finite, no NaN"),
        (np.full((96, 1), {}), y, TypeError, "X holds what is no number, as entry 0: .* argument must be .* a real"),
    ]:
        with pytest.raises(error, match=message):
            new(name).fit(X_bad, y_bad)


@pytest.mark.parametrize("factor", [1e200, 1e-200])
@pytest.mark.parametrize("name", DEFAULTS)
def test_14_numbers_whose_squares_are_none_are_refused(name, factor):
    X, y = demonstrations()
    with pytest.raises(ValueError, match=r"the largest value of y\[0\] is .*, must be zero, or between 1e-140"):
        new(name).fit(X, y * factor)
    with pytest.raises(
        ValueError, match=r"the largest value of X\[0\] is .*, must be zero, or between .* use other units"
    ):
        new(name).fit(X * factor, y)


@pytest.mark.parametrize("name", VARIANTS)
def test_19_collinear_and_constant_inputs_are_told(name):
    X, y = demonstrations(n_inputs=5)
    x = np.linspace(-1.5, 1.5, 7)[:, np.newaxis]
    for other, message in [(2.0 * X, "its columns are collinear"), (np.full_like(X, 7.0), "column 1 is constant")]:
        model = new(name)
        messages = warned(model, np.hstack([X, other]), y)
        assert len(messages) == 1
        assert "X has 2 columns but varies in 1 directions only: " + message in messages[0]
        also = 2.0 * x if "collinear" in message else np.full_like(x, 7.0)
        covariance = model.predict_cov(np.hstack([x, also]))
        assert_covariances(covariance, 7, 2)


@pytest.mark.parametrize("name", ["cholesky", "wishart", "heteroscedastic"])
def test_19_an_input_that_tells_nothing_has_a_bounded_length_scale(name, rng):
    X, y = demonstrations(n_inputs=10)
    noise = np.tile(rng.uniform(-1.0, 1.0, size=(10, 1)), (12, 1))
    model = fit(new(name), np.hstack([X, noise]), y)
    along = [np.column_stack([np.zeros(9), np.linspace(-1.0, 1.0, 9) * scale]) for scale in (1.0, 100.0)]
    within, beyond = (model.predict_uncertainty(rows).type1 for rows in along)
    assert np.isfinite(within).all()
    assert beyond[[0, -1]].min() > 0.99  # a length scale without bound would know everything there


@pytest.mark.parametrize("name", ["cholesky", "wishart-likelihood"])
def test_20_memory_is_counted_before_it_is_taken(name):
    X, y = np.arange(50_000.0)[:, np.newaxis], np.zeros((50_000, 6))
    with pytest.raises(ValueError, match=r"max_inputs=100000 lets .* GiB.* Lower (df or )?max_inputs"):
        new(name, max_inputs=100_000).fit(X, y)


def test_20_memory_of_inducing_inputs_components_draws_and_predictions_is_counted(monkeypatch):
    X = demonstrations()[0]
    monkeypatch.setattr(torch_pbd.files.memory, "available_bytes", lambda: 2**27)
    many = np.linspace(0.0, 1.0, 5000)[:, np.newaxis]
    wide = np.hstack([np.sin(many), np.cos(many)])
    for refused, words in [
        (lambda: new("heteroscedastic", n_inducing=4000, max_inputs=4000).fit(many, wide), "n_inducing=4000 .*lets"),
        (lambda: new("mixture", n_components=2000).fit(many, wide), "n_components=2000 for 5000 rows"),
        (lambda: new("wishart", df=10**15).fit(*demonstrations()), "processes, which"),
        (lambda: fitted("heteroscedastic").sample_cov(X[:8], 10**8), r"n_samples=100000000 at 8 rows"),
        (lambda: fitted("cholesky").sample_y(X[:8], 10**8), r"n_samples=100000000 at 8 rows"),
        (lambda: fitted("cholesky").predict_cov(np.zeros((3_000_000, 1))), "predicted for 3000000 rows"),
        (lambda: fitted("mixture").predict_cov(np.zeros((3_000_000, 1))), "predicted for 3000000 rows"),
    ]:
        with pytest.raises(ValueError, match=rf"{words}.* needs about .* GiB of memory"):
            refused()


@pytest.mark.parametrize("n_outputs", [1, 2, 6, 12])
def test_20_memory_is_counted_by_the_squares_of_inducing_inputs_and_what_fits_is_fitted(n_outputs, monkeypatch):
    """Features take 8 bytes times their outputs, squared, times 24: of 128 inducing inputs 3 MiB an output, squared."""
    features = 8 * 24 * (128 * n_outputs) ** 2
    monkeypatch.setattr(torch_pbd.files.memory, "available_bytes", lambda: 10 * features + 2**27)
    check_memory(128, 256, (256, 1, n_outputs))
    check_memory(128, 10**9, (256, 1, n_outputs))
    monkeypatch.setattr(torch_pbd.files.memory, "available_bytes", lambda: features)
    if features > 2**26:  # less is not worth the question
        with pytest.raises(ValueError, match="lets 256 distinct inputs and 128 inducing ones"):
            check_memory(128, 256, (256, 1, n_outputs))


def test_20_what_predicts_many_rows_holds_few_at_a_time(monkeypatch):
    seen = []
    model, rows = fitted("mixture"), np.zeros((5000, 1))
    monkeypatch.setattr(type(model), "_arrays", lambda self, function, X: by_chunks(function, X))
    model._arrays(lambda part: (seen.append(len(part)), (part,))[1], rows)
    assert sum(seen) == 5000
    assert max(seen) <= 1024


@pytest.mark.parametrize("name", DEFAULTS)
def test_21_two_ways_are_a_warning_of_the_controller_whatever_learns_them(name):
    two_ways = make_tunnel_demonstrations(12, 10.0, 5.0, random_state=0, variant="two_path")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        controller = DMPController(new(name), n_steps=20).fit(two_ways)
    told = [warning for warning in caught if issubclass(warning.category, UnimodalityWarning)]
    assert len(told) == 1
    assert "seem to follow two ways" in str(told[0].message)
    assert_covariances(controller.schedule(4.0).stiffness, 41, 2)


def test_21_two_ways_are_a_warning_of_the_regressor_that_is_told_the_demonstrations():
    X, y, groups = make_tunnel_demonstrations(12, 10.0, 5.0, random_state=0, variant="two_path").stack()
    with pytest.warns(UnimodalityWarning, match="seem to follow two ways"):
        model = new("heteroscedastic").fit(X, y, groups=groups)
    assert_covariances(model.predict_cov(X[:5]), 5, 2)


def test_more_components_than_samples_are_refused_with_both_numbers():
    X, y = demonstrations(n_inputs=2, n_demos=2)
    with pytest.raises(ValueError, match=r"n_components is 5, must not be above .* 4 of n_samples = 4"):
        GMMBaseline().fit(X, y)
    with pytest.raises(ValueError, match=r"distinct samples, which is 4 of n_samples = 8"):
        GMMBaseline().fit(np.vstack([X, X]), np.vstack([y, y]))

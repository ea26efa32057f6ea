"""Laws that every covariance regressor keeps, whatever its objective."""

from functools import cache

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_normal, multivariate_t

from estimators.zoo import (
    CASES,
    LATENT,
    PLAIN,
    UNALIGNED,
    VARIANTS,
    assert_covariances,
    demonstrations,
    fit,
    fitted,
    new,
    queries,
    truth,
)
from torch_pbd import CholeskyCovRegressor, WishartProcessRegressor
from torch_pbd.metrics import relative_frobenius_error

# A likelihood that shrinks without bound, or is flat in a direction: its optimizer turns the last digits that a
# large constant leaves of the data into more, so the law of the constant is not asked of it.
SENSITIVE = [("cholesky-eq12", False), ("wishart-eq11", False)]
STEADY = [case for case in PLAIN if (case[0], case[3]) not in SENSITIVE]
INTERPOLATING = ["cholesky-interpolating", "wishart"]


def relative(covariance, reference):
    """Largest error of an entry, relative to the deviations it belongs to: blind to the units of the outputs."""
    deviation = np.sqrt(np.diagonal(reference, axis1=1, axis2=2))
    return np.abs(covariance - reference) / deviation[:, :, np.newaxis] / deviation[:, np.newaxis, :]


@pytest.mark.parametrize(("name", "d", "e", "aligned"), CASES)
def test_what_predictions_look_like(name, d, e, aligned):
    model, X = fitted(name, d, e, aligned), queries(e)
    n = len(X)
    mean, covariance = model.predict(X, return_cov=True)
    assert_covariances(covariance, n, d)
    np.testing.assert_array_equal(model.predict_cov(X), covariance)
    np.testing.assert_array_equal(model.predict(X), mean)
    assert mean.shape == (n, d)
    assert mean.dtype == np.float64
    assert np.isfinite(mean).all()
    same_mean, std = model.predict(X, return_std=True)
    np.testing.assert_array_equal(same_mean, mean)
    np.testing.assert_array_equal(std, np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)))
    type1, type2 = model.predict_uncertainty(X)
    assert type1.shape == (n,)
    assert ((type1 >= 0.0) & (type1 <= 1.0 + 1e-15)).all()
    assert_covariances(type2, n, d)
    assert model.sample_y(X, 3, random_state=0).shape == (n, d, 3)


@pytest.mark.parametrize(("name", "d", "e", "aligned"), CASES)
def test_a_row_does_not_depend_on_the_rows_beside_it(name, d, e, aligned):
    model, X = fitted(name, d, e, aligned), queries(e)
    mean, covariance = model.predict(X, return_cov=True)
    type1 = model.predict_uncertainty(X).type1
    for rows in ([7], [3, 1], range(20)):
        some_mean, some_covariance = model.predict(X[rows], return_cov=True)
        # Weights of alternating sign up to 1e8 (eq. 12 fitted to rounding): sums in another order differ.
        np.testing.assert_allclose(some_mean, mean[rows], rtol=1e-9, atol=1e-9)
        assert relative(some_covariance, covariance[rows]).max() < 1e-8
        np.testing.assert_allclose(model.predict_uncertainty(X[rows]).type1, type1[rows], rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", VARIANTS)
def test_more_rows_than_are_predicted_at_a_time(name):
    model, X = fitted(name), np.linspace(-2.0, 2.0, 2500)[:, np.newaxis]
    covariance = model.predict_cov(X)
    assert_covariances(covariance, 2500, 2)
    assert relative(model.predict_cov(X[::100]), covariance[::100]).max() < 1e-8


@pytest.mark.parametrize("name", VARIANTS)
def test_no_rows_give_no_predictions(name):
    model, X = fitted(name), np.empty((0, 1))
    assert model.predict(X).shape == (0, 2)
    assert model.predict_cov(X).shape == (0, 2, 2)
    assert model.sample_y(X, 5).shape == (0, 2, 5)


@pytest.mark.parametrize("name", VARIANTS)
def test_no_rows_give_no_uncertainty(name):
    model, X = fitted(name), np.empty((0, 1))
    type1, type2 = model.predict_uncertainty(X)
    assert (type1.shape, type2.shape) == ((0,), (0, 2, 2))


def dyadic(d=2):
    """Demonstrations whose numbers, sums and means are exact in binary, and stay so when shifted by 2^20."""
    X, y = demonstrations(d, n_demos=16)
    return np.round(X * 2.0**20) / 2.0**20, np.round(y * 2.0**20) / 2.0**20


@cache
def fitted_to_dyadic(name):
    return fit(new(name), *dyadic())


@pytest.mark.parametrize(
    ("factor", "shift", "x_factor", "x_shift"),
    [
        ([2.0**-30, 2.0**30], 0.0, 1.0, 0.0),
        ([1.0, 1.0], 2.0**20, 1.0, 0.0),
        ([1.0, 1.0], 0.0, 2.0**30, 2.0**50),
    ],
    ids=["units", "offset", "input"],
)
@pytest.mark.parametrize("name", VARIANTS)
def test_units_and_origins_that_are_exact_in_binary_change_nothing(name, factor, shift, x_factor, x_shift):
    X, y = dyadic()
    x = np.round(queries(1)[:40] * 2.0**20) / 2.0**20
    mean, covariance = fitted_to_dyadic(name).predict(x, return_cov=True)
    factor = np.array(factor)
    changed = fit(new(name), X * x_factor + x_shift, y * factor + shift)
    mean2, covariance2 = changed.predict(x * x_factor + x_shift, return_cov=True)
    np.testing.assert_allclose((mean2 - shift) / factor, mean, rtol=0, atol=1e-9)
    assert relative(covariance2 / factor / factor[:, np.newaxis], covariance).max() < 1e-12


@pytest.mark.parametrize(("name", "d", "e", "aligned"), PLAIN)
def test_y_in_other_units_gives_the_same_model_in_other_units(name, d, e, aligned):
    X, y = demonstrations(d, e, aligned)
    factor = np.array([1e3, 1e-9])
    mean, covariance = fitted(name, d, e, aligned).predict(X, return_cov=True)
    mean2, covariance2 = fit(new(name), X, y * factor).predict(X, return_cov=True)
    np.testing.assert_allclose(mean2 / factor, mean, rtol=1e-6, atol=1e-9)
    assert relative(covariance2 / factor / factor[:, np.newaxis], covariance).max() < 1e-6


@pytest.mark.parametrize(("name", "d", "e", "aligned"), [case for case in STEADY if "likelihood" not in case[0]])
def test_a_constant_added_to_y_changes_no_covariance(name, d, e, aligned):
    X, y = demonstrations(d, e, aligned)
    mean, covariance = fitted(name, d, e, aligned).predict(X, return_cov=True)
    mean2, covariance2 = fit(new(name), X, y + 1e6).predict(X, return_cov=True)
    np.testing.assert_allclose(mean2 - 1e6, mean, rtol=0, atol=1e-6)
    assert relative(covariance2, covariance).max() < 1e-6


@pytest.mark.parametrize(("factor", "shift"), [(1e-9, 0.0), (1e9, 0.0), (7.0, 1.7e9)], ids=["ns", "Gs", "unix time"])
@pytest.mark.parametrize("name", ["cholesky", "cholesky-interpolating", "wishart", "heteroscedastic", "mixture"])
def test_units_and_origin_of_x_change_nothing(name, factor, shift):
    X, y = demonstrations()
    mean, covariance = fitted(name).predict(X, return_cov=True)
    mean2, covariance2 = fit(new(name), X * factor + shift, y).predict(X * factor + shift, return_cov=True)
    # A float64 holds unix time to 2e-7 s, over 14 s here: 2e-8 of the range, times what the models make of it.
    np.testing.assert_allclose(mean2, mean, rtol=0, atol=1e-6)
    assert relative(covariance2, covariance).max() < 1e-6


WIDE = [[40.0, 12.0], [12.0, 60.0]]
PRIORS = [(name, aligned, WIDE) for name, _, _, aligned in PLAIN if name in LATENT]
PRIORS += [(name, True, 50.0) for name in LATENT]


@pytest.mark.parametrize(("name", "aligned", "prior"), PRIORS)
def test_far_from_data_the_covariance_is_the_prior(name, aligned, prior):
    model = fit(new(name, prior=prior), *demonstrations(aligned=aligned))
    covariance = prior * np.eye(2) if prior == 50.0 else np.array(prior)
    X = queries(1)[-3:]
    np.testing.assert_allclose(model.predict_cov(X), np.broadcast_to(covariance, (3, 2, 2)), rtol=1e-10)
    mean = demonstrations(aligned=aligned)[1].mean(0)
    np.testing.assert_allclose(model.predict(X), np.broadcast_to(mean, (3, 2)), rtol=1e-9)


@pytest.mark.parametrize(
    ("name", "d"), [(name, 1) for name in LATENT] + [("cholesky", 9), ("wishart", 9), ("heteroscedastic", 9)]
)
def test_the_prior_learned_from_the_data_is_wide(name, d):
    _, y = demonstrations(d)
    far = fitted(name, d).predict_cov(queries(1)[-3:])
    spread = np.cov(y.T).reshape(d, d)
    # Four times the covariance, a thousandth of it replaced by that of independent outputs.
    expected = 4.0 * (0.999 * spread + 0.001 * np.diag(y.var(0)))
    np.testing.assert_allclose(far, np.broadcast_to(expected, (3, d, d)), rtol=1e-8, atol=1e-8 * spread.max())


def changing_prior(X):
    """A covariance that goes on changing with the input."""
    angle = np.arctan(1e-3 * X[:, 0])
    return np.array([[40.0, 12.0], [12.0, 60.0]]) * (2.0 + np.sin(angle))[:, np.newaxis, np.newaxis]


@pytest.mark.parametrize("name", LATENT)
def test_a_prior_may_depend_on_the_input(name):
    model = fit(new(name, prior=changing_prior), *demonstrations())
    X = queries(1)
    mean, covariance = model.predict(X, return_cov=True)
    assert_covariances(covariance, len(X), 2)
    np.testing.assert_allclose(covariance[-3:], changing_prior(X[-3:]), rtol=1e-10)
    drawn = model.sample_y(X[-3:], 20_000, random_state=0)
    expected = np.stack([np.cov(rows) for rows in drawn])
    assert relative(expected, covariance[-3:]).max() < 0.05
    # Where only the prior speaks the density is normal for all; of Student's t as near as its 1e7 degrees.
    score = multivariate_normal(mean[-1], changing_prior(X[-1:])[0]).logpdf(mean[-1] + 1.0)
    error = 1e-6 if name.startswith("heteroscedastic") else 0.0
    assert model.log_likelihood(X[-1:], mean[-1:] + 1.0)[0] == pytest.approx(score, rel=1e-9, abs=error)


@pytest.mark.parametrize("name", ["cholesky", "wishart", "heteroscedastic"])
def test_a_prior_that_writes_into_its_argument_changes_no_prediction(name):
    def prior(X):
        covariance = changing_prior(X)
        X[:] = 1e3
        return covariance

    X = queries(1)
    for mine, theirs in zip(
        fit(new(name, prior=prior), *demonstrations()).predict(X, return_cov=True),
        fit(new(name, prior=changing_prior), *demonstrations()).predict(X, return_cov=True),
        strict=True,
    ):
        np.testing.assert_array_equal(mine, theirs)
    np.testing.assert_array_equal(X, queries(1))


@pytest.mark.parametrize(("name", "d", "e", "aligned"), PLAIN)
def test_predictions_are_continuous(name, d, e, aligned):
    """Halving the step halves the largest change, on the training inputs as between them."""
    model, (X, _) = fitted(name, d, e, aligned), demonstrations(d, e, aligned)
    x = np.concatenate([X[:8], np.linspace(-3.0, 3.0, 400)[:, np.newaxis]])
    for part in (0, 1):
        start = model.predict(x, return_cov=True)[part]
        change = [np.abs(model.predict(x + step, return_cov=True)[part] - start).max() for step in (1e-6, 5e-7)]
        assert change[0] < 1e-2 * np.abs(start).max()
        assert change[1] == pytest.approx(0.5 * change[0], rel=1e-2)


@pytest.mark.parametrize("name", ["cholesky", "cholesky-interpolating", "cholesky-log", "wishart", "heteroscedastic"])
@pytest.mark.parametrize("d", [1, 2, 9])
def test_many_demonstrations_converge_to_the_truth(name, d):
    """The error falls like the root of their number: sixteen times as many, a quarter of the error."""
    x = np.linspace(-1.0, 1.0, 8)[:, np.newaxis]
    errors = []
    for n_demos in (250, 4000):
        model = fit(new(name), *demonstrations(d, n_demos=n_demos))
        _, factor = truth(x, d)
        errors.append(relative_frobenius_error(model.predict_cov(x), factor @ factor.transpose(0, 2, 1)))
    assert errors[0] < 0.12 * (1 + d) ** 0.5
    assert 0.1 < errors[1] / errors[0] < 0.5


@pytest.mark.parametrize("name", LATENT)
@pytest.mark.parametrize("aligned", [True, False])
def test_missing_data_and_variability_are_told_apart(name, aligned):
    if not aligned and name not in UNALIGNED:
        pytest.skip("works on aligned data")
    model, (X, _) = fitted(name, aligned=aligned), demonstrations(aligned=aligned)
    type1, type2 = model.predict_uncertainty(X)
    # Of 96 inputs the heteroscedastic model keeps 32 neighbourhoods, between which a little is missing.
    np.testing.assert_allclose(type1, 0.0, atol=1e-3 if "heteroscedastic" in name and not aligned else 1e-9)
    covariance = model.predict_cov(X)
    if name in INTERPOLATING or (aligned and ("likelihood" in name or "eq" in name)):
        assert relative(type2, covariance).max() < 1e-9
    else:  # observed with noise, or at more inputs than the kernel matrix has rank: near it
        assert relative_frobenius_error(type2, covariance) < 0.25
    type1, type2 = model.predict_uncertainty(queries(1)[-3:])
    np.testing.assert_allclose(type1, 1.0, rtol=1e-14)
    assert np.abs(type2).max() < 1e-10 * np.abs(covariance).max()
    between = model.predict_uncertainty(np.linspace(1.0, 8.0, 100)[:, np.newaxis]).type1
    assert (np.diff(between) >= -1e-9).all()  # grows with the distance from data


@pytest.mark.parametrize("name", ["mixture", "mixture-lbfgs"])
def test_a_mixture_tells_where_it_has_no_data_but_does_not_return_to_a_prior(name):
    model, (X, _) = fitted(name), demonstrations()
    type1, type2 = model.predict_uncertainty(X)
    np.testing.assert_array_equal(type1, 0.0)
    np.testing.assert_array_equal(type2, model.predict_cov(X))
    type1, type2 = model.predict_uncertainty(queries(1)[-3:])
    np.testing.assert_array_equal(type1, 1.0)
    edge = model.predict_cov(np.array([[-1e3], [1e3]]))
    assert min(np.abs(part - whole).max() for part in edge for whole in type2) < 1e-9


@pytest.mark.parametrize(("name", "d", "e", "aligned"), PLAIN)
def test_draws_have_the_predicted_moments(name, d, e, aligned):
    model, X, n = fitted(name, d, e, aligned), queries(e)[[0, 1, 20, -3]], 40_000
    mean, covariance = model.predict(X, return_cov=True)
    drawn = model.sample_y(X, n, random_state=0)
    deviation = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    assert (np.abs(drawn.mean(-1) - mean) / deviation).max() < 5.0 / n**0.5
    assert relative(np.stack([np.cov(rows) for rows in drawn]), covariance).max() < 5.0 * (2.0 / n) ** 0.5
    rows = np.corrcoef(drawn.reshape(len(X) * d, n))[:d, d:]
    assert np.abs(rows).max() < 5.0 / n**0.5  # rows are independent


def density(mean, covariance, degrees):
    """The normal distribution, or for finitely many degrees Student's t of that covariance."""
    if np.isinf(degrees):
        return multivariate_normal(mean, covariance)
    return multivariate_t(mean, covariance * (degrees - 2.0) / degrees, degrees)


@pytest.mark.parametrize(("name", "d", "e", "aligned"), CASES)
def test_log_likelihood_is_that_of_scipy(name, d, e, aligned):
    model, (X, y) = fitted(name, d, e, aligned), demonstrations(d, e, aligned)
    mean, covariance = model.predict(X[:20], return_cov=True)
    sound = np.linalg.cond(covariance) < 1e6  # scipy inverts the covariance, we its factor
    assert sound.sum() > 5
    degrees = model.module_.degrees(torch.tensor(X[:20]))
    degrees = np.full(20, np.inf) if degrees is None else degrees.numpy()
    expected = [
        density(m, c, nu).logpdf(row)
        for m, c, nu, row in zip(mean[sound], covariance[sound], degrees[sound], y[:20][sound], strict=True)
    ]
    np.testing.assert_allclose(model.log_likelihood(X[:20], y[:20])[sound], expected, rtol=1e-8, atol=1e-8)
    assert model.score(X, y) == pytest.approx(model.log_likelihood(X, y).mean(), rel=1e-14)
    weight = np.arange(len(X))
    expected = weight @ model.log_likelihood(X, y) / weight.sum()
    assert model.score(X, y, sample_weight=weight) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize(("name", "d", "e", "aligned"), PLAIN)
def test_the_module_is_what_the_estimator_predicts_with(name, d, e, aligned):
    model, X = fitted(name, d, e, aligned), queries(e)
    mean, scale_tril = model.module_(torch.tensor(X))
    np.testing.assert_allclose(mean.numpy(), model.predict(X), rtol=1e-12, atol=1e-12)
    product = (scale_tril @ scale_tril.mT).numpy()
    assert relative(product, model.predict_cov(X)).max() < 1e-9
    assert (scale_tril.diagonal(dim1=1, dim2=2) > 0).all()
    assert torch.equal(scale_tril, scale_tril.tril())


@pytest.mark.parametrize(("d", "e"), [(1, 1), (2, 2)])
@pytest.mark.parametrize("name", VARIANTS)
def test_the_module_is_differentiable_in_x(name, d, e):
    module = fitted(name, d, e).module_
    x = torch.tensor(queries(e)[:4], requires_grad=True)
    # Finite differences of an interpolation lose digits to its large weights: 1e-5 is what they have left.
    assert torch.autograd.gradcheck(module, x, eps=1e-6, atol=1e-4, rtol=1e-4)
    assert torch.autograd.gradcheck(module.moments, x, eps=1e-6, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("name", VARIANTS)
def test_the_gradient_is_finite_on_data_and_far_away(name):
    module = fitted(name).module_
    x = torch.tensor(np.vstack([demonstrations()[0][:8], queries(1)[-5:]]), requires_grad=True)
    mean, scale_tril = module(x)
    (mean.sum() + scale_tril.sum()).backward()
    assert torch.isfinite(x.grad).all()


@pytest.mark.parametrize("d", [1, 2, 9])
def test_every_row_twice_is_the_same_scatter_twice(d):
    """Interpolated empirical covariances of 2 K rows: twice the scatter over 2 K - 1."""
    X, y = demonstrations(d)
    once = fitted("cholesky-interpolating", d).predict_cov(X[:8])
    twice = fit(new("cholesky-interpolating"), np.vstack([X, X]), np.vstack([y, y])).predict_cov(X[:8])
    np.testing.assert_allclose(twice, once * (22.0 / 23.0), rtol=1e-6)


def test_every_row_twice_is_the_same_mixture():
    X, y = demonstrations()
    twice = fit(new("mixture", n_components=1), np.vstack([X, X]), np.vstack([y, y]))
    once = fit(new("mixture", n_components=1), X, y)
    np.testing.assert_allclose(twice.predict_cov(X), once.predict_cov(X), rtol=1e-6)


@pytest.mark.parametrize(
    "name", ["cholesky", "cholesky-likelihood", "wishart", "wishart-likelihood", "heteroscedastic"]
)
def test_minus_zero_is_zero(name):
    X, y = demonstrations(n_inputs=3, n_demos=6)
    signed = np.where((X == 0) & (np.arange(18)[:, np.newaxis] % 2 == 0), -0.0, X)
    assert (np.signbit(signed) != np.signbit(X)).any()
    x = queries(1)
    expected = fit(new(name), X, y).predict_cov(x)
    np.testing.assert_allclose(fit(new(name), signed, y).predict_cov(x), expected, rtol=1e-9)


@pytest.mark.parametrize("name", ["cholesky", "cholesky-likelihood", "wishart", "wishart-likelihood"])
def test_more_inputs_than_max_inputs_are_merged(name):
    x = np.linspace(-1.0, 1.0, 50)[:, np.newaxis]
    factor = truth(x, 2)[1]
    errors = []
    for seed in range(5):
        X, y = demonstrations(aligned="likelihood" not in name, n_inputs=40, n_demos=6, seed=seed)
        whole, merged = (fit(new(name, max_inputs=size), X, y) for size in (256, 16))
        assert len(merged.module_.core.covariance.latent.inputs) <= 16
        assert_covariances(merged.predict_cov(queries(1)), 45, 2)
        law = factor @ factor.transpose(0, 2, 1)
        errors.append([relative_frobenius_error(model.predict_cov(x), law) for model in (merged, whole)])
    merged_error, whole_error = np.mean(errors, axis=0)
    assert merged_error < 1.1 * whole_error


@pytest.mark.parametrize("estimator", [CholeskyCovRegressor, WishartProcessRegressor])
@pytest.mark.parametrize("e", [2, 3])
def test_few_rows_of_several_inputs_are_not_explained_each_by_itself(estimator, e):
    for seed in range(3):  # 120 rows of three inputs: fresh ones lost 1e9 nats, once
        rng = np.random.default_rng(seed)
        X, fresh = rng.random((120, e)), rng.random((1000, e))
        y, fresh_y = (x[:, :2] + 0.1 * rng.normal(size=(len(x), 2)) for x in (X, fresh))
        truth = -np.log(2.0 * np.pi * 0.1**2) - 1.0
        assert fit(estimator(), X, y).score(fresh, fresh_y) > truth - 0.7

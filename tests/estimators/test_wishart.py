import warnings

import numpy as np
import pytest
from sklearn.exceptions import ConvergenceWarning

from estimators.zoo import assert_covariances, demonstrations, fit, fitted, new, queries
from torch_pbd import CholeskyCovRegressor, WishartProcessRegressor
from torch_pbd.data import make_paper_simulation
from torch_pbd.exceptions import DataRankWarning
from torch_pbd.metrics import covariance_mse


def empirical_covariances(X, y):
    inputs, index = np.unique(X, axis=0, return_inverse=True)
    return inputs, np.stack([np.cov(y[index.ravel() == i].T) for i in range(len(inputs))])


@pytest.mark.parametrize("reading", ["bell", "printed", "bowl"])
def test_table_1(reading):
    errors = []
    for seed in range(10):
        X, y, _ = make_paper_simulation(reading=reading, random_state=seed)
        inputs, empirical = empirical_covariances(X, y)
        model = fit(WishartProcessRegressor(objective="mse"), X, y)
        errors.append(covariance_mse(model.predict_cov(inputs), empirical, on="cholesky"))
    assert np.median(errors) <= 1e-3


def test_random_state_is_the_seed_of_the_start():
    X, y = demonstrations(aligned=False)
    x = queries(1)
    one, same, other = (
        fit(new("wishart-likelihood", random_state=seed, max_iter=3), X, y).predict_cov(x) for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(one, same)
    assert (one != other).any()


@pytest.mark.parametrize("df", [2, 3, 5, 8])
@pytest.mark.parametrize("objective", ["mse", "likelihood"])
def test_any_number_of_vectors_from_the_number_of_outputs_on(df, objective):
    X, y = demonstrations()
    model = fit(WishartProcessRegressor(df=df, objective=objective, prior=[[40.0, 12.0], [12.0, 60.0]]), X, y)
    assert model.df_ == df
    covariance = model.predict_cov(queries(1))
    assert_covariances(covariance, 45, 2)
    np.testing.assert_allclose(covariance[-1], [[40.0, 12.0], [12.0, 60.0]], rtol=1e-10)


@pytest.mark.parametrize("d", [1, 2, 9])
def test_df_is_one_more_than_the_outputs_unless_given(d):
    X, y = demonstrations(d)
    assert fitted("wishart", d).df_ == d + 1
    assert fit(WishartProcessRegressor(df="auto"), X, y).df_ == d + 1


def test_the_prior_of_the_paper_has_rank_one():
    """All vectors' means at 8, so V = L L' times 64 nu in every entry; only the floor is added."""
    model = fit(WishartProcessRegressor(prior="paper"), *demonstrations())
    far = model.predict_cov(queries(1)[-1:])[0]
    np.testing.assert_allclose(far, np.full((2, 2), 3 * 64.0), rtol=1e-9)
    assert_covariances(far[np.newaxis], 1, 2)


def test_auto_is_mse_where_every_input_repeats_and_likelihood_elsewhere():
    x = queries(1)
    for aligned, objective in [(True, "mse"), (False, "likelihood")]:
        X, y = demonstrations(aligned=aligned)
        auto, chosen = (fit(new("wishart", objective=name), X, y) for name in ("auto", objective))
        np.testing.assert_array_equal(auto.predict_cov(x), chosen.predict_cov(x))


def test_the_loss_of_mse_is_equation_9_in_standardized_units():
    X, y = demonstrations()
    model = fitted("wishart")
    inputs, empirical = empirical_covariances(X, y)
    scale = y.std(0)
    units = scale[:, np.newaxis] * scale
    expected = covariance_mse(model.predict_cov(inputs) / units, empirical / units)
    assert model.loss_ == pytest.approx(expected, rel=1e-6, abs=1e-12)


def test_both_solvers_predict_the_same():
    """Of one output; of more L-BFGS crawls along the valleys in which the vectors turn."""
    X, y = demonstrations(1)
    models = [
        fit(WishartProcessRegressor(objective="likelihood", solver=solver, tol=1e-10), X, y)
        for solver in ("auto", "fisher", "lbfgs")
    ]
    covariances = [model.predict_cov(X) for model in models]
    np.testing.assert_array_equal(covariances[0], covariances[1])
    np.testing.assert_allclose(covariances[2], covariances[1], rtol=1e-3)
    assert models[2].loss_ == pytest.approx(models[1].loss_, abs=1e-8)


def test_the_solver_is_checked():
    X, y = demonstrations(aligned=False)
    with pytest.raises(ValueError, match="solver is 'em', must be one of 'auto', 'fisher', 'lbfgs'"):
        WishartProcessRegressor(solver="em").fit(X, y)
    with pytest.raises(ValueError, match="solver='fisher' holds the hyperparameters, which latent_prior=False"):
        WishartProcessRegressor(solver="fisher", latent_prior=False).fit(X, y)


def test_inputs_too_near_to_interpolate_are_smoothed_and_told(rng):
    """Bursts of samples a billionth of the range apart: without noise every kernel matrix of the search is singular."""
    X = np.repeat(np.add.outer(np.linspace(0.0, 1.0, 3), 1e-9 * np.arange(20)).ravel(), 3)[:, np.newaxis]
    y = rng.normal(size=(180, 2))
    with pytest.warns(DataRankWarning, match="rows so near to each other") as told:
        model = WishartProcessRegressor(objective="mse").fit(X, y)
    assert {warning.filename for warning in told} == {__file__}
    variance = np.diagonal(model.predict_cov(X), axis1=1, axis2=2)
    assert 0.1 < variance.min() < variance.max() < 2.0


def test_a_constant_output_is_as_precise_by_likelihood_as_with_factors(rng):
    """Newton's steps fall far short of what they promise there: the search must not take that for its end."""
    X = np.sort(rng.uniform(size=60))[:, np.newaxis]
    y = np.column_stack([np.sin(5.0 * X[:, 0]) + 0.1 * rng.normal(size=60), np.full(60, 0.5)])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        scores = [
            regressor(objective="likelihood", max_iter=300).fit(X, y).score(X, y)
            for regressor in (WishartProcessRegressor, CholeskyCovRegressor)
        ]
    assert scores[0] == pytest.approx(scores[1], abs=0.5)

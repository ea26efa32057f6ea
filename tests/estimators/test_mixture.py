import warnings

import gmr
import numpy as np
import pytest
import sklearn.mixture
from sklearn.cluster import KMeans
from sklearn.exceptions import ConvergenceWarning

from estimators.zoo import demonstrations, fit, fitted, new, queries
from torch_pbd import GMMBaseline
from torch_pbd.data import make_paper_simulation
from torch_pbd.exceptions import DataRankWarning


def standardized(model, X, y):
    """Rows [x, y] as the mixture saw them."""
    module = model.module_
    x_part = (X - module.x_shift.numpy()) / module.x_scale.numpy()
    return np.hstack([x_part, (y - module.y_shift.numpy()) / module.y_scale.numpy()])


def sklearn_from_labels(data, labels, k):
    shares = np.eye(k)[labels]
    means = shares.T @ data / shares.sum(0)[:, np.newaxis]
    covariances = np.stack([np.cov(data.T, aweights=share, bias=True) for share in shares.T])
    start = np.linalg.inv(covariances + 1e-6 * np.eye(data.shape[1]))
    mixture = sklearn.mixture.GaussianMixture(
        k,
        reg_covar=1e-6,
        tol=1e-10,
        max_iter=5000,
        weights_init=shares.mean(0),
        means_init=means,
        precisions_init=start,
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        return mixture.fit(data)


@pytest.mark.parametrize("k", [1, 3, 5])
@pytest.mark.parametrize("seed", range(3))
def test_it_is_as_likely_as_scikit_learns_from_the_same_start(k, seed):
    X, y, _ = make_paper_simulation(random_state=seed)
    order = np.lexsort(np.hstack([X, y]).T)  # the order in which k-means sees the rows
    X, y = X[order], y[order]
    model = fit(GMMBaseline(n_components=k, n_restarts=0, tol=1e-10, max_iter=5000), X, y)
    joint = np.hstack([X, y])
    points = (joint - joint.mean(0)) / joint.std(0)
    start = np.random.RandomState(0).randint(2**31 - 1)
    labels = KMeans(k, n_init=1, random_state=start).fit(points).labels_
    data = standardized(model, X, y)
    reference = sklearn_from_labels(data, labels, k)
    assert -model.loss_ == pytest.approx(reference.score(data), abs=1e-6)
    assert -model.loss_ == pytest.approx(reference.lower_bound_, abs=1e-6)


@pytest.mark.parametrize("d", [1, 2, 9])
def test_its_regression_is_that_of_gmr(d):
    model = fitted("mixture", d)
    core = model.module_.core
    scale = core.scale_tril.numpy()
    weights = core.log_weight.softmax(0).numpy()
    reference = gmr.GMM(len(weights), weights, core.mean.numpy(), scale @ scale.transpose(0, 2, 1))
    X = queries(1)[:20]
    x = standardized(model, X, np.zeros((20, d)))[:, :1]
    mean, covariance = model.predict(X, return_cov=True)
    y_scale, y_shift = model.module_.y_scale.numpy(), model.module_.y_shift.numpy()
    for row, m, c in zip(x, mean, covariance, strict=True):
        conditional = reference.condition([0], row)
        between = conditional.means - conditional.priors @ conditional.means
        whole = np.einsum("k,kij->ij", conditional.priors, conditional.covariances)
        whole += np.einsum("k,ki,kj->ij", conditional.priors, between, between)
        np.testing.assert_allclose(
            m, y_shift + y_scale * (conditional.priors @ conditional.means), rtol=1e-8, atol=1e-8
        )
        np.testing.assert_allclose(c, y_scale[:, np.newaxis] * y_scale * whole, rtol=1e-7, atol=1e-9)


def test_l_bfgs_is_never_less_likely_than_the_em_it_starts_from():
    for aligned in (True, False):
        assert fitted("mixture-lbfgs", aligned=aligned).loss_ <= fitted("mixture", aligned=aligned).loss_


def test_more_restarts_are_never_less_likely():
    X, y = demonstrations()
    losses = [fit(new("mixture", n_restarts=n, n_components=5), X, y).loss_ for n in (0, 1, 4)]
    assert losses == sorted(losses, reverse=True)


def test_one_component_is_linear_regression():
    X, y = demonstrations(2, 2, aligned=False)
    model = fit(GMMBaseline(n_components=1, reg_covar=1e-12), X, y)
    design = np.hstack([np.ones((len(X), 1)), X])
    coefficients = np.linalg.lstsq(design, y, rcond=None)[0]
    residual = y - design @ coefficients
    mean, covariance = model.predict(X, return_cov=True)
    np.testing.assert_allclose(mean, design @ coefficients, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(covariance[0], residual.T @ residual / len(X), rtol=1e-8)


def test_a_small_variance_survives_beside_a_large_mean():
    """An absolute regularization of 1e-6 would make of this output's variance of 1e-8 one of 1e-6."""
    rng = np.random.default_rng(0)
    x = np.tile(np.linspace(0.0, 1.0, 50), 10)[:, np.newaxis]
    y = np.column_stack([x[:, 0] + 1e-4 * rng.normal(size=500), 100.0 + rng.normal(size=500)])
    model = fit(GMMBaseline(n_components=1, reg_covar=1e-8), x, y)
    assert model.predict(x[:1], return_std=True)[1][0, 0] == pytest.approx(1e-4, rel=0.1)


@pytest.mark.parametrize("solver", ["em", "lbfgs"])
def test_the_regularization_is_relative_to_the_residual(solver):
    X, y = demonstrations()
    whole, small = (
        fit(GMMBaseline(n_components=2, n_restarts=0, solver=solver, reg_covar=0.1), X, y * unit).predict_cov(X)
        for unit in (1.0, 1e-6)
    )
    np.testing.assert_allclose(small * 1e12, whole, rtol=1e-6, atol=1e-6)


def test_more_components_than_rows_is_an_error_with_both_numbers():
    X, y = demonstrations(n_inputs=2, n_demos=2)
    with pytest.raises(ValueError, match=r"n_components is 5, must not be above .* 4 of n_samples = 4"):
        GMMBaseline().fit(X, y)


@pytest.mark.parametrize("solver", ["em", "lbfgs"])
@pytest.mark.parametrize("constant", [0.7, 1e9 / 3.0])
def test_a_constant_input_is_as_if_it_were_not_there(solver, constant, rng):
    """Its deviation is 1e-14 of it, which is rounding and not a scale."""
    X, y = demonstrations()
    both = np.hstack([X, constant * (1.0 + 1e-14 * rng.normal(size=X.shape))])
    with pytest.warns(DataRankWarning, match="column 1 is constant"):
        model = GMMBaseline(n_components=3, solver=solver).fit(both, y)
    alone = GMMBaseline(n_components=3, solver=solver).fit(X, y)
    x = queries(1)[:40]
    for mine, others in zip(
        model.predict(np.hstack([x, np.full_like(x, constant)]), return_cov=True),
        alone.predict(x, return_cov=True),
        strict=True,
    ):
        np.testing.assert_allclose(mine, others, rtol=1e-4, atol=1e-4)


@pytest.mark.filterwarnings("ignore:X has 9 values in column 0 that differ from others by a rounding")
def test_rows_that_differ_by_rounding_are_no_different_samples():
    """Else k-means finds fewer clusters than it is asked for, and says so in its own words."""
    X = np.repeat([[-1.0], [0.0], [1.0]], 4, axis=0) + 1e-9 * np.arange(12.0)[:, np.newaxis]
    y = np.where(X > 0.5, 1.0, 0.0)
    with pytest.raises(ValueError, match=r"n_components is 5, .* distinct samples, which is 3 of n_samples = 12"):
        GMMBaseline(n_components=5).fit(X, y)
    assert fit(GMMBaseline(n_components=3), X, y).predict_cov(X).shape == (12, 1, 1)

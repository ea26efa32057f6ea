"""Faults 82 and 85: regressors take the demonstrations' labels, refuse wrong ones, and tell of too few."""

import copy
import warnings

import numpy as np
import pytest
import sklearn
from scipy.stats import f, multivariate_t
from sklearn.model_selection import GridSearchCV, GroupKFold
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from torch_pbd import (
    CholeskyCovRegressor,
    GMMBaseline,
    HeteroscedasticGPRegressor,
    WishartProcessRegressor,
    load_demonstrations,
)
from torch_pbd.exceptions import DataRankWarning

REGRESSORS = {
    "choleskycovregressor": CholeskyCovRegressor(),
    "wishartprocessregressor": WishartProcessRegressor(),
    "gmmbaseline": GMMBaseline(n_components=2),
    "heteroscedasticgpregressor": HeteroscedasticGPRegressor(),
}
X = np.tile(np.linspace(0.0, 1.0, 6), 6)[:, np.newaxis]
Y = np.sin(3.0 * X[:, 0]) + 0.1 * np.random.default_rng(0).normal(size=36)
GROUPS = np.repeat(np.arange(6), 6)


@pytest.mark.parametrize("name", ["choleskycovregressor", "wishartprocessregressor", "gmmbaseline"])
def test_85_regressors_that_need_no_groups_give_the_same_with_them(name):
    model = REGRESSORS[name]
    plain = model.fit(X, Y).predict(X, return_std=True)
    for groups in (GROUPS, [f"demo {label}" for label in GROUPS], None):
        np.testing.assert_array_equal(model.fit(X, Y, groups=groups).predict(X, return_std=True), plain)


@pytest.mark.parametrize("name", REGRESSORS)
@pytest.mark.parametrize(
    ("groups", "message"),
    [
        (GROUPS[:-1], r"groups has shape \(35,\), must have shape \(36,\)"),
        (np.where(GROUPS == 3, np.nan, GROUPS), "not finite, at index 18"),
        ([None, *GROUPS[1:]], "no label at index 0"),
    ],
)
def test_85_wrong_groups_are_an_error_in_words(name, groups, message):
    with pytest.raises(ValueError, match=message):
        REGRESSORS[name].fit(X, Y, groups=groups)


@pytest.mark.parametrize("name", REGRESSORS)
def test_85_groups_are_routed_through_pipeline_and_search(name):
    with sklearn.config_context(enable_metadata_routing=True):
        pipeline = make_pipeline(StandardScaler(), sklearn.clone(REGRESSORS[name]).set_fit_request(groups=True))
        pipeline.fit(X, Y, groups=GROUPS)
        with pytest.raises(ValueError, match=r"groups has shape \(35,\)"):
            pipeline.fit(X, Y, groups=GROUPS[:-1])
        search = GridSearchCV(pipeline, {f"{name}__tol": [1e-3]}, cv=GroupKFold(2), error_score="raise")
        search.fit(X, Y, groups=GROUPS)
    assert np.isfinite(search.cv_results_["mean_test_score"]).all()


def smooth(n_demos, n_outputs, seed):
    """Demonstrations (K, 40, d) of one covariance, whose deviations have the correlation length of a tenth."""
    rng = np.random.default_rng(seed)
    x = np.linspace(0.0, 1.0, 40)
    along = np.linalg.cholesky(np.exp(-0.5 * np.square(np.subtract.outer(x, x) / 0.1)) + 1e-8 * np.eye(40))
    factor = np.tril(np.random.default_rng(1).normal(size=(n_outputs, n_outputs)), -1) + np.eye(n_outputs)
    y = np.sin(3.0 * x)[:, np.newaxis] + along @ rng.normal(size=(n_demos, 40, n_outputs)) @ factor.T
    return x[:, np.newaxis], y


def messages(regressor, X, y, groups):
    """What a fit warns of, told where it was called."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        regressor.fit(X, y, groups=groups)
    caught = [warning for warning in caught if issubclass(warning.category, DataRankWarning)]
    assert {warning.filename for warning in caught} <= {__file__}
    return [str(warning.message) for warning in caught]


@pytest.mark.parametrize("repeats", [True, False])
@pytest.mark.parametrize("name", REGRESSORS)
def test_82_no_more_demonstrations_than_outputs_are_told_once(name, repeats):
    x, y = smooth(3, 3, seed=0)
    X = np.tile(x[::4], (3, 1)) + (0.0 if repeats else 0.01 * np.repeat(np.arange(3), 10)[:, np.newaxis])
    regressor = sklearn.clone(REGRESSORS[name]).set_params(max_iter=5)  # it is told before, whatever the optimum
    rows, groups = y[:, ::4].reshape(-1, 3), np.repeat(np.arange(3), 10)
    (message,) = messages(regressor, X, rows, groups)
    assert message.startswith("y has 3 demonstrations")
    assert "but 3 outputs" in message
    assert "4 or more" in message
    assert messages(regressor, X, rows[:, :2], groups) == []


def test_82_one_demonstration_of_one_output_leaves_open_how_it_varies():
    (message,) = messages(GMMBaseline(n_components=2), np.arange(10.0)[:, None], np.arange(10.0) ** 2, np.zeros(10))
    assert message.startswith("y has one demonstration, which leaves open how")


def test_82_regions_of_three_demonstrations_of_six_outputs_hold_what_they_say():
    """Of a hundred others, in the mean of four draws; the law of independent samples held .33 and .90."""
    held, before = [], []
    for seed in range(4):
        x, y = smooth(103, 6, seed)
        with pytest.warns(DataRankWarning, match="3 demonstrations but 6 outputs"):
            model = HeteroscedasticGPRegressor().fit(
                np.tile(x, (3, 1)), y[:3].reshape(-1, 6), groups=np.repeat(np.arange(3), 40)
            )
        plain = copy.deepcopy(model)
        plain.module_.core._buffers.pop("correlation_variance")
        for one, found in ((model, held), (plain, before)):
            mean, covariance = one.predict(x, return_cov=True)
            df, deviation = one.predict_df(x), (y[3:] - mean)[..., np.newaxis]
            square = (deviation * np.linalg.solve(covariance, deviation)).sum((2, 3)) * df / (df - 2.0)
            found.append([(square / 6.0 <= f(6, df).ppf(level)).mean() for level in (0.5, 0.95)])
    (half, most), (half_before, most_before) = np.mean(held, axis=0), np.mean(before, axis=0)
    assert half > 0.42 > half_before
    assert 0.98 > most > 0.93 > most_before


def test_82_joints_that_move_together_are_not_taken_for_apart(recordings):
    """Twelve joints of a hand: shrunk as two outputs are, what six demonstrations show of them lost a nat a step."""
    hand = load_demonstrations(recordings / "adroit_door_joints.npz").align(n=50).to_array()[..., ::2][..., :12]
    X, groups = np.tile(np.linspace(0.0, 1.0, 50), 6)[:, np.newaxis], np.repeat(np.arange(6), 50)
    with pytest.warns(DataRankWarning):
        model = HeteroscedasticGPRegressor().fit(X, hand[:6].reshape(-1, 12), groups=groups)
    apart = copy.deepcopy(model)
    apart.module_.core._buffers.pop("correlation_error")
    rows = np.tile(X[:50], (19, 1)), hand[6:].reshape(-1, 12)
    assert model.score(*rows) > apart.score(*rows) + 0.5


def test_82_the_law_of_few_demonstrations_is_one():
    """Density, covariance, degrees of freedom and draws are of the same Student's t."""
    x, y = smooth(4, 2, seed=0)
    model = HeteroscedasticGPRegressor().fit(np.tile(x, (4, 1)), y.reshape(-1, 2), groups=np.repeat(np.arange(4), 40))
    assert float(model.module_.core.correlation_variance) > 0.0
    at, points = x[[7]], y[:, 7] + 0.3
    (mean,), (covariance,) = model.predict(at, return_cov=True)
    (df,) = model.predict_df(at)
    law = multivariate_t(mean, covariance * (df - 2.0) / df, df=df)
    np.testing.assert_allclose(model.log_likelihood(np.tile(at, (4, 1)), points), law.logpdf(points), rtol=1e-10)
    drawn = model.sample_y(at, 20_000, random_state=0)[0].T - mean
    square = (drawn * np.linalg.solve(law.shape, drawn.T).T).sum(1) / 2.0
    assert (square <= f(2, df).ppf(0.9)).mean() == pytest.approx(0.9, abs=5.0 * (0.09 / 20_000) ** 0.5)
    whole, known = model.predict_cov(at)[0], model.predict_uncertainty(at).type2[0]
    assert (np.linalg.eigvalsh(whole - known) > 0.0).all()

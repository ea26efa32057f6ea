"""Fault 85: every regressor takes the demonstrations' labels, and refuses wrong ones."""

import numpy as np
import pytest
import sklearn
from sklearn.model_selection import GridSearchCV, GroupKFold
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from torch_pbd import CholeskyCovRegressor, GMMBaseline, HeteroscedasticGPRegressor, WishartProcessRegressor

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

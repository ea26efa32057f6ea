"""The mean against what rows that repeat an input say of it."""

import numpy as np
import pytest

from torch_pbd import CholeskyCovRegressor, WishartProcessRegressor
from torch_pbd.data import load_demonstrations, make_paper_simulation
from torch_pbd.exceptions import DataRankWarning

REGRESSORS = [CholeskyCovRegressor, WishartProcessRegressor]


def standardized_error(model, X, y):
    """Of the mean at each input, in standard errors of the mean of the rows there: (n, d)."""
    inputs, index = np.unique(X, axis=0, return_inverse=True)
    rows = [y[index.ravel() == i] for i in range(len(inputs))]
    error = np.stack([part.std(axis=0, ddof=1) / len(part) ** 0.5 for part in rows])
    return (model.predict(inputs).reshape(len(inputs), -1) - np.stack([part.mean(axis=0) for part in rows])) / error


@pytest.mark.parametrize("objective", ["auto", "likelihood"])
@pytest.mark.parametrize("regressor", REGRESSORS)
@pytest.mark.parametrize("n_inputs", [2, 20])
def test_what_all_demonstrations_agree_on_is_no_noise(regressor, n_inputs, objective, rng):
    """A step, of which the evidence of the means alone takes half for noise."""
    X = np.tile(np.linspace(0.0, 1.0, n_inputs), 6)[:, np.newaxis]
    y = 10.0 * (X > 0.5) + 0.1 * rng.normal(size=X.shape)
    model = regressor(objective=objective).fit(X, y)
    assert np.abs(standardized_error(model, X, y)).max() < 1.0
    assert model.score(X, y) > 0.5  # of the law it is .88


@pytest.mark.parametrize("regressor", REGRESSORS)
def test_what_they_do_not_agree_on_is_smoothed(regressor):
    X, y, _ = make_paper_simulation(random_state=0)
    error = standardized_error(regressor().fit(X, y), X, y)
    assert 0.3 < np.sqrt(np.square(error).mean()) < 1.5


@pytest.mark.parametrize("regressor", REGRESSORS)
def test_where_it_would_have_to_swing_wildly_it_does_not_and_says_so(regressor, rng):
    """Pairs of inputs a millionth of the range apart, whose means differ by ten."""
    X = np.repeat(np.add.outer(np.linspace(0.0, 1.0, 6), [0.0, 1e-6]).ravel(), 6)[:, np.newaxis]
    y = np.tile(np.repeat([0.0, 10.0], 6), 6)[:, np.newaxis] + 0.1 * rng.normal(size=X.shape)
    with pytest.warns(DataRankWarning, match="too near to each other for a smooth mean"):
        model = regressor(objective="likelihood").fit(X, y)
    assert np.abs(model.predict(np.linspace(0.0, 1.0, 200)[:, np.newaxis])).max() < 20.0


@pytest.mark.parametrize("regressor", REGRESSORS)
@pytest.mark.parametrize(("name", "n_steps"), [("handwriting_fda", 20), ("letter_L", 3), ("letter_Z", 5)])
def test_of_recordings_at_few_steps_the_mean_is_that_of_the_demonstrations(regressor, name, n_steps, recordings):
    X, y, _ = load_demonstrations(recordings / f"{name}.npz").resample(n_steps).stack()
    assert np.abs(standardized_error(regressor().fit(X, y), X, y)).max() < 10.0

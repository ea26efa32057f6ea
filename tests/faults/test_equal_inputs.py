"""Faults 67, 86 and 87: inputs equal but for a rounding to float32, periods too short, spacings of many inputs."""

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from torch_pbd import CholeskyCovRegressor, GMMBaseline, HeteroscedasticGPRegressor, WishartProcessRegressor
from torch_pbd.estimators.validation import without_rounding
from torch_pbd.gp.observations import spacing

REGRESSORS = [CholeskyCovRegressor, WishartProcessRegressor, HeteroscedasticGPRegressor, GMMBaseline]
EXACT = np.arange(20) / 30.0  # no float32
PATH = np.sin(5.0 * EXACT) + 0.1 * np.random.default_rng(0).normal(size=(8, 20))


def stamps(offset=0.0, unit=1.0):
    """Of 8 recordings, every other one stored in float32."""
    time = np.tile(unit * (EXACT + offset), (8, 1))
    time[::2] = time[::2].astype(np.float32)
    return time.reshape(-1, 1)


@pytest.mark.parametrize("regressor", REGRESSORS)
def test_67_float32_stamps_in_every_other_recording_are_those_of_the_others(regressor):
    grid = np.linspace(0.0, 0.6, 50)[:, np.newaxis]
    mean, deviation = regressor().fit(np.tile(EXACT, 8)[:, np.newaxis], PATH.ravel()).predict(grid, return_std=True)
    with pytest.warns(UserWarning, match=r"X has 1\d values in column 0 that differ from others by a rounding") as told:
        found = regressor().fit(stamps(), PATH.ravel())
    assert [warning.filename for warning in told] == [__file__]
    found_mean, found_deviation = found.predict(grid, return_std=True)
    np.testing.assert_allclose(found_mean, mean, atol=1e-5)
    np.testing.assert_allclose(found_deviation, deviation, rtol=1e-5)


@pytest.mark.filterwarnings("ignore:X has .* a rounding to float32")
@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize(("offset", "shift"), [(0.0, 0.0), (100.0, 0.0), (0.0, 100.0), (-0.3, 1e5)])
def test_67_in_any_unit_and_from_any_origin(unit, offset, shift):
    given = stamps(offset, unit) + unit * shift
    columns = without_rounding(np.hstack([given, np.random.default_rng(1).normal(size=given.shape)]))
    assert len(np.unique(columns[:, 0])) == 20
    np.testing.assert_allclose(columns[:, 0], given[:, 0], atol=unit * 1e-7 * (1.0 + abs(offset)))


@pytest.mark.parametrize(
    "values",
    [
        np.append(1e-9 * np.arange(100), 1.0),  # a regular spacing, far below the resolution of the range
        1.7e9 + 1e-3 * np.arange(100),  # unix time
        np.repeat(np.linspace(0.0, 1.0, 6), 2) + 1e-6 * (np.arange(12) % 2),
        np.array([0.0, 1e-9]),
        np.random.default_rng(0).uniform(size=300),
        1e135 * np.arange(5.0),
    ],
)
def test_67_inputs_that_are_apart_stay_so(values):
    np.testing.assert_array_equal(without_rounding(values[:, np.newaxis])[:, 0], values)


def test_67_a_few_that_chance_brings_near_are_merged_without_a_word(rng):
    values = rng.uniform(size=(20_000, 1))
    merged = without_rounding(values)
    assert 0 < (merged != values).sum() < 100
    np.testing.assert_allclose(merged, values, atol=2.0 * np.finfo(np.float32).eps)


@pytest.mark.parametrize("kernel", ["periodic", "squared_exponential"])
@pytest.mark.parametrize("period", [5e-324, 1e-308, 1e-100, 1e-10])
def test_86_a_period_below_the_resolution_of_the_inputs_is_an_error_in_words(kernel, period):
    X, y = np.tile(EXACT, 8)[:, np.newaxis], PATH.ravel()
    with pytest.raises(ValueError, match=f"period is {period}, must be .* no shorter than 1e-08 of its range"):
        HeteroscedasticGPRegressor(kernel=kernel, period=period).fit(X, y)


@pytest.mark.parametrize("n_inputs", [1999, 2001, 10_000])
def test_87_the_spacing_of_many_inputs_is_that_of_all(n_inputs, rng):
    inputs = rng.uniform(size=(n_inputs, 2))
    inputs = inputs[np.lexsort(inputs.T)]
    nearest = cKDTree(inputs).query(inputs, k=2)[0][:, 1]
    assert spacing(torch.tensor(inputs)) == pytest.approx(np.quantile(nearest, 0.9), rel=0.05)

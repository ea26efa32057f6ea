import numpy as np
import pytest

from torch_pbd.estimators.door import Standardization, distinct_rows, or_magnitude


@pytest.mark.parametrize("e", [1, 2, 3])
def test_distinct_rows_are_those_of_numpy(e, rng):
    X = rng.integers(-2, 3, size=(200, e)) / 7.0
    expected, index = np.unique(X, axis=0, return_inverse=True)
    found = distinct_rows(X)
    np.testing.assert_array_equal(found[0], expected)
    np.testing.assert_array_equal(found[1], index.reshape(-1))
    np.testing.assert_array_equal(found[0][found[1]], X)


def test_minus_zero_is_no_other_row_than_zero():
    inputs, index = distinct_rows(np.array([[0.0, 1.0], [-0.0, 1.0], [0.0, -0.0], [-0.0, 0.0]]))
    assert inputs.tolist() == [[0.0, 0.0], [0.0, 1.0]]
    assert not np.signbit(inputs).any()
    assert index.tolist() == [1, 1, 0, 0]


@pytest.mark.parametrize("offset", [1e6, 1.7e9, -3.3e10])
def test_an_origin_far_away_changes_no_bit_of_standardized_numbers(offset, rng):
    """The same numbers with the offset and without: what float64 loses of them it has lost before."""
    X, y = rng.uniform(-1.0, 1.0, size=(50, 2)) + offset, rng.normal(size=(50, 3)) + offset
    far, near = Standardization.fit(X, y), Standardization.fit(X - offset, y - offset)
    np.testing.assert_array_equal(far.inputs(X), near.inputs(X - offset))
    np.testing.assert_array_equal(far.outputs(y), near.outputs(y - offset))


@pytest.mark.parametrize("unit", [1e-9, 1.0, 1e9])
def test_rounding_in_a_constant_input_is_nothing_in_any_unit(unit, rng):
    """0.7 has a deviation of 1e-16 by NumPy; to divide by it made noise of an input."""
    X = np.column_stack([rng.normal(size=90), np.full(90, 0.7), 0.7 + 1e-13 * rng.normal(size=90)]) * unit
    assert X[:, 1:].std(axis=0).max() > 0.0
    assert (Standardization.fit(X, X).inputs(X)[:, 1:] == 0.0).all()
    np.testing.assert_allclose(or_magnitude(X.std(axis=0), X)[1:], 0.7 * unit, rtol=1e-12)


@pytest.mark.parametrize("unit", [1e-9, 1e9])
def test_outputs_that_are_all_constant_have_a_scale_in_their_unit(unit):
    y = np.tile([0.0, -3.0], (5, 1))
    X = np.arange(5.0)[:, np.newaxis]
    np.testing.assert_allclose(Standardization.fit(X, unit * y).y_scale, unit * Standardization.fit(X, y).y_scale)
    assert Standardization.fit(X, 0.0 * y).y_scale.tolist() == [1.0, 1.0]

import numpy as np
import pytest

from torch_pbd.estimators._scaling import distinct_rows


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

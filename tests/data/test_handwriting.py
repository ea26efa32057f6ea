"""Made handwriting against the law it is drawn from."""

from typing import get_args

import numpy as np
import pytest

from torch_pbd.data import handwriting_covariance, handwriting_mean, make_handwriting_demonstrations
from torch_pbd.data.via_points import Shape

N_DEMOS = 2000
SHAPES = get_args(Shape)


@pytest.mark.parametrize(
    ("shape", "via_precision"),
    [
        pytest.param(shape, (None, 0.004)[(place + other) % 2], marks=[pytest.mark.slow] if other else [])
        for other in (0, 1)
        for place, shape in enumerate(SHAPES)
    ],
)
def test_thousands_of_demonstrations_have_the_mean_and_the_covariance(shape, via_precision):
    options = {"rate": 10.0, "timing": 0.0, "via_precision": via_precision, "random_state": 0}
    made = make_handwriting_demonstrations(shape, N_DEMOS, **options)
    phase, y = np.linspace(0.0, 1.0, 21), made.to_array()
    np.testing.assert_allclose(made.times[0], 2.0 * phase, atol=1e-12)
    root = np.linalg.cholesky(handwriting_covariance(phase, shape, via_precision=via_precision))
    # Whitened positions are standard normal; 5 standard errors of 2000.
    z = np.linalg.solve(root, (y - handwriting_mean(phase, shape))[..., np.newaxis])[..., 0]
    np.testing.assert_allclose(z.mean(axis=0), 0.0, atol=5.0 / np.sqrt(N_DEMOS))
    covariance = np.einsum("kti,ktj->tij", z, z) / N_DEMOS
    np.testing.assert_allclose(covariance, np.tile(np.eye(2), (21, 1, 1)), atol=5.0 * np.sqrt(2.0 / N_DEMOS))


@pytest.mark.parametrize("shape", SHAPES)
def test_between_via_points_the_mean_has_the_least_jerk(shape):
    """Its sixth derivative vanishes between via points, of which there are at most seven, and it rests at the ends."""
    phase = np.linspace(0.0, 1.0, 2001)
    mean = handwriting_mean(phase, shape)
    sixth = np.abs(np.diff(mean, n=6, axis=0)).max(axis=1)
    assert (sixth > 1e-13).sum() <= 7 * 6  # a knot is seen by six differences; rounding makes 1e-15
    speed = np.linalg.norm(np.diff(mean, axis=0), axis=1)
    assert speed[[0, -1]].max() < 1e-4 * speed.max()  # the cube of a step


def test_demonstrations_differ_in_duration_and_pace():
    made = make_handwriting_demonstrations("Z", 300, timing=0.2, random_state=1)
    durations = np.log([time[-1] for time in made.times])
    np.testing.assert_allclose([durations.mean(), durations.std()], [np.log(2.0), 0.2], atol=0.03)
    # Mean pace is even: half of the time is half of the phase, where the law says what the spread is.
    middle = np.stack([position[len(position) // 2] for position in made.positions])
    np.testing.assert_allclose(middle.mean(axis=0), handwriting_mean([0.5], "Z")[0], atol=3e-3)
    assert not made.is_aligned


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"shape": "Q"}, "shape is 'Q', must be one of 'C'"),
        ({"n_demos": 0}, "n_demos is 0"),
        ({"timing": 0.5}, "timing is 0.5, must be a finite number of at least 0 and below 0.5"),
        ({"via_precision": [0.001]}, r"via_precision has shape \(1,\), must have shape \(7,\)"),
        ({"via_precision": 0.0}, r"via_precision\[0\] is 0.0, must be above zero: a standard deviation in m"),
        ({"rate": 0.5}, "number of steps, is 1.0"),
    ],
)
def test_arguments_are_checked(arguments, words):
    with pytest.raises(ValueError, match=words):
        make_handwriting_demonstrations(**arguments)
    with pytest.raises(ValueError, match=r"phase\[1\] is 1.5, must be from 0 to 1"):
        handwriting_covariance([0.0, 1.5])

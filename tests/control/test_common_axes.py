"""Axes that covariances have in common: of all times alike, whatever the size of what varies."""

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from torch_pbd.control.primitive.outputs import common_axes

TRUE = Rotation.from_rotvec([0.4, -0.9, 0.5]).as_matrix()


@pytest.fixture
def shown(rng):
    """Twelve demonstrations: a long free phase that is large, round but for chance, and a short precise one."""
    spread = np.where(np.arange(40)[:, None] < 30, [30.0, 30.0, 30.0], [0.5, 3.0, 15.0])
    smooth = np.exp(-0.5 * (np.subtract.outer(np.arange(40), np.linspace(0.0, 39.0, 9)) / 5.0) ** 2)
    values = spread * np.einsum("nm,kmd->knd", smooth, rng.normal(size=(12, 9, 3)))
    return (values - values.mean(axis=0)) @ TRUE.T


def apart(axes, others):
    """Degrees by which columns differ, but for their signs."""
    return np.rad2deg(np.arccos(np.abs((axes * others).sum(axis=0)).clip(max=1.0)))


def axes_of(deviation):
    return common_axes(deviation, np.full(deviation.shape[1], len(deviation) - 1), 1e-9)


def oracle_approximating(covariance, degrees):
    """Equation (23) of Chen et al. for one covariance."""
    d, trace, square = len(covariance), np.trace(covariance), np.trace(covariance @ covariance)
    share = ((1 - 2 / d) * square + trace**2) / ((degrees + 1 - 2 / d) * (square - trace**2 / d))
    share = min(share, 1.0)
    return (1.0 - share) * covariance + share * trace / d * np.eye(d)


def test_the_axes_are_most_likely(shown):
    """Against a search over all rotations, from other starts."""
    shrunk = np.array([oracle_approximating(np.cov(at.T), 11) for at in np.swapaxes(shown, 0, 1)])

    def loss(vector):
        turn = Rotation.from_rotvec(vector).as_matrix()
        return np.log(np.einsum("ia,nij,ja->na", turn, shrunk, turn)).mean()

    starts = Rotation.random(8, random_state=0).as_rotvec()
    best = min((minimize(loss, start, tol=1e-12) for start in starts), key=lambda result: result.fun)
    axes = axes_of(shown)
    assert abs(loss(Rotation.from_matrix(axes * np.linalg.det(axes)).as_rotvec()) - best.fun) < 1e-8
    along = np.log(np.einsum("ia,nij,ja->na", axes, shrunk, axes)).mean(axis=0)
    assert (np.diff(along) > 0.0).all()


def test_precise_phases_choose_however_large_free_ones_are(shown):
    axes = axes_of(shown)
    assert apart(axes, TRUE).max() < 5.0
    pooled = np.linalg.eigh(np.einsum("kni,knj->ij", shown, shown))[1]
    assert apart(pooled, TRUE).max() > 20.0
    by_size = axes_of(shown * np.linspace(1.0, 100.0, 40)[:, None])
    assert apart(axes, by_size).max() < 1e-4


def test_axes_turn_with_what_varies(shown):
    turn = Rotation.from_rotvec([1.2, 0.3, -2.0]).as_matrix()
    assert apart(axes_of(shown @ turn.T), turn @ axes_of(shown)).max() < 1e-5


def test_of_two_demonstrations_the_pooled_axes_are_left(shown):
    """One degree of freedom tells nothing of a shape."""
    two = shown[:2] - shown[:2].mean(axis=0)
    pooled = np.linalg.eigh(np.einsum("kni,knj->ij", two, two))[1]
    # In any order: as spheres all axes are as large.
    assert np.allclose(np.sort(np.abs(axes_of(two).T @ pooled), axis=1), [[0, 0, 1]] * 3, atol=1e-9)


def test_times_that_one_alone_knows_and_those_without_variability_have_no_say(shown):
    degrees = np.repeat([11, 0], [40, 5])
    more = np.concatenate([shown, np.zeros((12, 5, 3))], axis=1)
    assert apart(common_axes(more, degrees, 1e-9), axes_of(shown)).max() < 1e-5
    assert apart(common_axes(more, np.full(45, 11), 1e-9), axes_of(shown)).max() < 1e-5

"""Judgement of whole movements: by hand, and by laws that hold their own draws."""

import numpy as np
import pytest

from torch_pbd import GMMBaseline, ProMPBaseline, TrajectoryRegressor
from torch_pbd.experiments.comparison import MOVEMENT_STATISTICS, judge_movement, movement_statistics


def test_statistics_of_whole_movements():
    mean, std = np.zeros((3, 2)), np.full((3, 2), 2.0)
    still, moved = np.zeros((3, 2)), np.array([[0.0, 0.0], [3.0, 4.0], [3.0, 0.0]])
    rows = movement_statistics(np.stack([still, moved]), mean, std)
    np.testing.assert_array_equal(rows[0], 0.0)
    # Offsets 1 and 2/3 standard deviations; a path of 5 and 4.
    np.testing.assert_allclose(rows[1], [34.0 / 4.0 / 6.0, np.hypot(1.0, 2.0 / 3.0), 9.0, 2.0])


@pytest.mark.parametrize(
    "model", [TrajectoryRegressor(GMMBaseline(n_restarts=0)), ProMPBaseline(n_basis=8, overlap=0.7)]
)
def test_regions_of_a_law_hold_its_own_draws(model):
    # And of independent rows they do not: smooth movements are shorter and lie to one side.
    grid = np.linspace(0.0, 1.0, 20)[:, np.newaxis]
    rng = np.random.default_rng(0)
    waves = np.concatenate([np.ones_like(grid), grid, np.sin(6.0 * grid)], axis=1)
    demos = waves @ rng.standard_normal((8, 3, 2)) + 0.01 * rng.standard_normal((8, 20, 2))
    data = np.tile(grid, (8, 1)), demos.reshape(-1, 2)
    model.fit(*data, groups=np.repeat(np.arange(8), 20))
    judged = [judge_movement(model, grid, draw) for draw in model.sample_demonstrations(grid, 200, 1)]
    for name in MOVEMENT_STATISTICS:
        assert np.mean([row[name] for row in judged]) == pytest.approx(0.9, abs=0.08)
    assert judged[0]["joint"] == model.score_demonstrations(grid, model.sample_demonstrations(grid, 200, 1)[0])[0]
    regressor = GMMBaseline(n_restarts=0).fit(*data)
    rows = [judge_movement(regressor, grid, demo) for demo in demos]
    assert np.mean([row["length"] for row in rows]) == 0.0
    assert rows[0]["joint"] == pytest.approx(regressor.log_likelihood(grid, demos[0]).sum())

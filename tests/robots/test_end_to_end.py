"""Learn a task, give it the inertia of an arm, push the arm: what happens is what the plant foretells."""

import numpy as np
import pytest

pytest.importorskip("mujoco")

import arm_pushes


def check(outcomes, peaks):
    """Pushes of 12 N and 1.2 Nm at once; where the arm is pushed to, its inertia is not that of the schedule."""
    assert len(outcomes) == 4
    assert np.max([outcome.peak_error for outcome in outcomes]) < 0.05
    assert np.max([outcome.path_error for outcome in outcomes]) < 0.08
    assert min(outcome.ratio for outcome in outcomes) > 0.99
    assert min(outcome.ratio_pushed for outcome in outcomes) > 0.9
    assert (np.max([outcome.peak for outcome in outcomes], axis=0) > peaks).all()


@pytest.mark.slow
def test_the_made_pose_task():
    # At 50 N/m a push takes the tool 64 mm away, where the arm's inertia is another: its path is then 11 % off.
    check(list(arm_pushes.pushed(arm_pushes.peg(200.0), n_directions=1)), peaks=[0.01, 0.04])


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:The movement starts at")
def test_recorded_positions_with_a_turning_tool(recordings):
    check(list(arm_pushes.pushed(arm_pushes.cube(recordings, 50.0), n_directions=1)), peaks=[0.02, 0.04])

"""The robot of the page is the one that `simulate` predicts."""

import math

import numpy as np
import pytest

from torch_pbd import DMPController, GMMBaseline
from torch_pbd.data import make_tunnel_demonstrations

pytest.importorskip("uvicorn", reason="the extra 'playground' is not installed")
from torch_pbd.playground.server import Robot


@pytest.fixture(scope="module")
def controller():
    return DMPController(GMMBaseline(random_state=0)).fit(make_tunnel_demonstrations(rate=20.0, random_state=1))


def test_a_push_moves_it_as_simulate_says(controller):
    schedule = controller.schedule(rate=1000.0)
    robot, frames = Robot(), 1 / 60
    robot.follow(schedule)
    deviations, times = [], []
    for _ in range(round(0.6 * schedule.duration / frames)):
        is_pushed = bool(times) and 2.0 < times[-1] < 4.0
        state = robot.advance(frames, None, (5.0, 0.0) if is_pushed else (0.0, 0.0))
        deviations.append(state["deviation"])
        times.append(state["time"])
    start = round(1000 * next(time for time in times if time > 2.0))
    force = np.zeros_like(schedule.position)
    force[start : start + 2000, 0] = 5.0
    simulated = controller.simulate(force=force, rate=1000.0)
    expected = np.linalg.norm(simulated.deviation, axis=1).max()
    assert max(deviations) == pytest.approx(expected, rel=0.02)


def test_it_follows_another_schedule_from_where_it_is(controller):
    robot = Robot()
    assert not robot.advance(0.1, None, (0.0, 0.0))["is_there"]
    robot.follow(controller.schedule(rate=1000.0))
    for _ in range(60):
        before = robot.advance(1 / 60, None, (0.0, 0.0))
    robot.follow(controller.schedule(rate=1000.0, speed=2.0))
    after = robot.advance(1 / 60, None, (0.0, 0.0))
    assert math.dist(before["position"], after["position"]) < 0.01
    assert after["time"] == pytest.approx(0.5 * before["time"], abs=0.1)


def test_a_hand_pulls_no_harder_than_a_person_and_a_hidden_page_moves_nothing_far(controller):
    robot = Robot()
    robot.follow(controller.schedule(rate=1000.0))
    state = robot.advance(0.1, (100.0, 100.0), (0.0, 0.0))
    assert math.hypot(*state["force"]) == pytest.approx(25.0)
    time = robot.advance(3600.0, None, (0.0, 0.0))["time"]
    assert time <= 0.2

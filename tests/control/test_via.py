"""Movements bent through via points, to goals, and on from where a robot was pushed, by models of whole movements."""

import numpy as np
import pytest

from torch_pbd import (
    Demonstrations,
    DMPController,
    GMMBaseline,
    ProMPBaseline,
    TrajectoryRegressor,
    load_demonstrations,
)
from torch_pbd.data import make_tunnel_demonstrations

TIME = np.linspace(0.0, 2.0, 101)


def demonstrations(n_demos=8, seed=0):
    """From one place to another, by ways that differ by some cm in the middle: m and s."""
    rng = np.random.default_rng(seed)
    s = TIME / 2.0
    rise = s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
    bow = np.sin(np.pi * s) ** 2
    position = np.stack([0.4 * rise, 0.1 * bow], axis=1) + 0.03 * bow[:, np.newaxis] * rng.normal(size=(n_demos, 1, 2))
    position += 0.005 * rise[:, np.newaxis] * rng.normal(size=(n_demos, 1, 2))
    return Demonstrations(TIME, list(position), units="m")


@pytest.fixture(scope="module")
def controller():
    return DMPController(TrajectoryRegressor()).fit(demonstrations())


def test_a_via_point_is_met_and_the_rest_of_the_movement_follows(controller):
    plain, via = controller.schedule(rate=100.0), np.array([0.22, 0.13])
    bent = controller.schedule(rate=100.0, via=[(1.0, via)])
    np.testing.assert_allclose(bent.position[100], via, atol=1e-4)
    np.testing.assert_allclose(bent.position[[0, -1]], plain.position[[0, -1]], atol=1e-4)
    # As the demonstrations do: what deviates in the middle deviates beside it too, and less far from it.
    change = np.linalg.norm(bent.position - plain.position, axis=1)
    assert change[80] > 0.5 * change[100]
    assert change[20] < 0.5 * change[100]
    # The velocity is the derivative of the position.
    slope = np.gradient(bent.position, bent.time, axis=0)
    np.testing.assert_allclose(slope[2:-2], bent.velocity[2:-2], atol=0.02 * np.abs(bent.velocity).max())


def test_the_stiffness_rises_where_a_point_must_be_met(controller):
    plain = controller.schedule(rate=100.0)
    bent = controller.schedule(rate=100.0, via=[(1.0, plain.position[100])])
    stiffness = np.linalg.eigvalsh(bent.stiffness)
    assert stiffness[100].min() == pytest.approx(1000.0, rel=1e-3)
    assert stiffness[100].min() > 2.0 * np.linalg.eigvalsh(plain.stiffness)[100].min()
    np.testing.assert_allclose(bent.position, plain.position, atol=1e-4)


def test_outputs_of_a_via_point_may_be_free(controller):
    plain = controller.schedule(rate=100.0)
    bent = controller.schedule(rate=100.0, via=[(1.0, [np.nan, 0.14]), (1.5, [np.nan, 0.06])])
    assert bent.position[100, 1] == pytest.approx(0.14, abs=1e-4)
    assert bent.position[150, 1] == pytest.approx(0.06, abs=1e-4)
    assert np.abs(bent.position[:, 0] - plain.position[:, 0]).max() < 0.05


def test_likely_goals_bend_the_movement_and_the_primitive_does_the_rest(controller):
    plain = controller.schedule(rate=100.0)
    near, far = controller.goal_ + np.array([0.003, 0.0]), controller.goal_ + np.array([0.2, 0.0])
    for goal in (near, far):
        bent = controller.schedule(rate=100.0, goal=goal)
        np.testing.assert_allclose(bent.position[-1], goal, atol=1e-3)
        np.testing.assert_allclose(bent.position[0], plain.position[0], atol=1e-3)
        acceleration = np.gradient(bent.velocity, bent.time, axis=0)
        assert np.abs(acceleration).max() < 2.5 * np.abs(np.gradient(plain.velocity, plain.time, axis=0)).max()
    start = controller.start_ + np.array([0.0, 0.05])  # where nobody started
    bent = controller.schedule(rate=100.0, start=start, via=[(1.0, [0.22, 0.13])])
    np.testing.assert_allclose(bent.position[[0, 100]], [start, [0.22, 0.13]], atol=2e-3)


def test_an_unlikely_point_is_told_and_met(controller):
    with pytest.warns(UserWarning, match=r"via\[0\], at 1 s, is .* standard deviations .* hold 95%"):
        bent = controller.schedule(rate=100.0, via=[(1.0, [0.2, 0.6])])
    np.testing.assert_allclose(bent.position[100], [0.2, 0.6], atol=1e-3)


@pytest.mark.filterwarnings("ignore:via")
def test_an_unlikely_point_of_one_output_moves_the_others_no_more_than_is_likely():
    shown = make_tunnel_demonstrations(rate=25.0, random_state=0)
    controller = DMPController(TrajectoryRegressor()).fit(shown)
    plain, deviation = controller.schedule(rate=25.0), shown.to_array().std(axis=0)[:, 0]
    for at, given in ((0.0, plain.position[0, 0]), (5.0, plain.position[125, 0]), (5.0, np.nan), (10.0, np.nan)):
        # Beyond the 2 um by which y varies by ten thousand times as much.
        bent = controller.schedule(rate=25.0, via=[(at, [given, plain.position[round(25.0 * at), 1] + 0.02])])
        change = bent.position - plain.position
        assert change[round(25.0 * at), 1] == pytest.approx(0.02, rel=1e-6)
        assert (np.abs(change[:, 0]) < 2.6 * deviation.max()).all()
        assert np.abs(change[:, 1]).max() < 0.02001
    near_end = controller.schedule(rate=25.0, via=[(9.6, plain.position[240] + [0.3, 0.0])])
    assert np.abs(near_end.position - plain.position)[:, 0].max() < 0.32


def test_an_error_of_the_robot_is_no_deviation_of_people():
    """A millimetre off where demonstrations agree to micrometres: told, and with the robot's error no matter."""
    controller = DMPController(TrajectoryRegressor()).fit(make_tunnel_demonstrations(random_state=0).resample(60))
    time, X = np.array([5.0]), np.linspace(0.0, 10.0, 21)[:, np.newaxis]
    position = controller.predict(time[:, np.newaxis]) + np.array([0.0, 1e-3])
    with pytest.warns(UserWarning, match=r"positions\[0, 1\] is \d+ standard deviations .* Give noise_scale"):
        controller.condition(time, position)
    bent = controller.condition(time, position, noise_scale=1e-3)  # and no warning, which would be an error
    np.testing.assert_allclose(bent.predict(X), controller.predict(X), rtol=0, atol=1e-3)


def test_a_movement_that_was_pushed_goes_on_from_where_it_is(controller):
    pushed = controller.predict([[1.0]])[0] + [0.02, -0.02]
    again = controller.condition([1.0], [pushed])
    np.testing.assert_allclose(again.predict([[1.0]])[0], pushed, atol=1e-6)
    before, after = controller.predict([[1.2], [2.0]]), again.predict([[1.2], [2.0]])
    change = np.linalg.norm(after - before, axis=1)
    assert change[0] > 0.01
    assert change[1] < 0.01
    twice = again.condition([1.5], [again.predict([[1.5]])[0] + [0.005, 0.0]], noise_scale=1e-3)
    assert 0.002 < twice.predict([[1.5]])[0, 0] - again.predict([[1.5]])[0, 0] < 0.0051
    np.testing.assert_array_equal(controller.predict([[1.2]]), before[:1])


@pytest.mark.parametrize("name", ["letter_G", pytest.param("kuka_cshape_top", marks=pytest.mark.slow)])
@pytest.mark.filterwarnings("ignore")  # of the recordings: their units, and how they end
def test_a_left_out_demonstration_is_nearer_to_what_goes_on_from_its_half(name, recordings):
    shown = load_demonstrations(recordings / f"{name}.npz").align(n=100)
    closer = []
    for left_out in range(4):
        train, test = shown.split(left_out)
        controller = DMPController(TrajectoryRegressor(), duration=1.0).fit(train)
        movement = controller.smooth(test, 101)
        time, position = movement.time, movement.position[0]
        # From where it is; and from where it was a moment before too, which tells of its velocity.
        plans = [controller.condition(time[known], position[known]) for known in ([50], [46, 50])]
        ahead = time[51:, np.newaxis]
        *errors, of_mean = (np.square(each.predict(ahead) - position[51:]).mean() for each in (*plans, controller))
        closer.append(np.log(np.array(errors) / of_mean))
    assert (np.exp(np.mean(closer, axis=0)) < [0.95, 0.9]).all()


def test_a_movement_whose_start_is_known_still_meets_its_via_points(controller):
    known = controller.condition([0.0], [controller.start_])
    bent = known.schedule(rate=100.0, via=[(1.0, [0.22, 0.13])])
    np.testing.assert_allclose(bent.position[[0, 100]], [controller.start_, [0.22, 0.13]], atol=1e-3)


def test_any_model_of_movements_bends(controller):
    other = DMPController(ProMPBaseline()).fit(demonstrations())
    bent = other.schedule(rate=100.0, via=[(1.0, [0.22, 0.13])])
    np.testing.assert_allclose(bent.position[100], [0.22, 0.13], atol=1e-3)


@pytest.mark.parametrize(
    ("via", "message"),
    [
        ([(3.0, [0.2, 0.1])], "the time of via\\[0\\] is 3.0 s, must be a finite number of at least 0 and at most 2"),
        ([(1.0, [0.2])], "the position of via\\[0\\] is \\[0.2\\], must be 2 numbers, NaN where free"),
        ([(1.0, [np.nan, np.nan])], "must be 2 numbers, NaN where free"),
        ([1.0], "via\\[0\\] is 1.0, must be a time in s and a position"),
        (1.0, "via is 1.0, must be a list of pairs, each a time in s and a position"),
        (np.array([[1.0, 0.2, 0.1]]), "via\\[0\\] is array.*, must be a time in s and a position"),
        ([(1.0, [0.2, 0.1]), (1.0, [0.2, 0.1])], "given twice"),
    ],
)
def test_via_points_are_checked(controller, via, message):
    with pytest.raises(ValueError, match=message):
        controller.schedule(via=via)


def test_a_goal_that_moves_goes_without_via_points(controller):
    moving = np.tile(controller.goal_, (201, 1))
    with pytest.raises(ValueError, match=r"goal has shape \(201, 2\), must have shape \(2,\)"):
        controller.schedule(rate=100.0, goal=moving, via=[(1.0, [0.2, 0.1])])


def test_a_model_of_samples_cannot_bend():
    plain = DMPController(GMMBaseline()).fit(demonstrations())
    with pytest.raises(ValueError, match=r"covariance is GMMBaseline\(\), must be a model of whole movements"):
        plain.schedule(via=[(1.0, [0.2, 0.1])])
    with pytest.raises(ValueError, match="must be a model of whole movements"):
        plain.condition([1.0], [[0.2, 0.1]])
    with pytest.raises(ValueError, match=r"positions has shape \(2,\), must have shape \(1, 2\)"):
        plain.condition([1.0], [0.2, 0.1])

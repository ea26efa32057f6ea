"""Movements bent through via points, to goals, and on from where a robot was pushed, by models of whole movements."""

import copy

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from torch_pbd import (
    CholeskyCovRegressor,
    Demonstrations,
    DMPController,
    GMMBaseline,
    KMPBaseline,
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
    bent = controller.schedule(rate=100.0, via=[(1.0, [np.nan, 0.13]), (1.5, [np.nan, 0.06])])
    assert bent.position[100, 1] == pytest.approx(0.13, abs=1e-4)
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
    shown = make_tunnel_demonstrations(random_state=0).resample(60).in_units(time_unit="ms")
    controller = DMPController(TrajectoryRegressor()).fit(shown)
    time, X = np.array([5000.0]), np.linspace(0.0, 10000.0, 21)[:, np.newaxis]
    position = controller.predict(time[:, np.newaxis]) + np.array([0.0, 1e-3])
    with pytest.warns(UserWarning, match=r"y of positions, at 5000 ms, is \d+ standard deviations .* Give noise_scale"):
        controller.condition(time, position)
    bent = controller.condition(time, position, noise_scale=1e-3)  # and no warning, which would be an error
    np.testing.assert_allclose(bent.predict(X), controller.predict(X), rtol=0, atol=1e-3)


@pytest.mark.parametrize(
    ("noise_scale", "message"),
    [
        ("a", "noise_scale holds text"),
        (None, "noise_scale is nan, must be a finite number of at least 0"),
        ([0.0, -1.0], r"noise_scale\[1\] is -1.0, must be"),
        ([0.1, 0.2, 0.3], r"noise_scale has shape \(3,\), must be one number or have shape \(2,\)"),
    ],
)
def test_noise_is_checked_before_it_is_used(controller, noise_scale, message):
    with pytest.raises(ValueError, match=message):
        controller.condition([1.0], [controller.goal_], noise_scale=noise_scale)


def test_nothing_to_condition_on_changes_nothing(controller):
    plain = controller.schedule(rate=100.0)
    for bent in (
        controller.schedule(rate=100.0, goal=controller.goal_),
        controller.schedule(rate=100.0, start=controller.start_),
        controller.schedule(rate=100.0, via=[]),
        controller.condition([], np.zeros((0, 2))).schedule(rate=100.0),
    ):
        np.testing.assert_allclose(bent.position, plain.position, rtol=0, atol=1e-12)
    assert controller.predict_cov(np.zeros((0, 1))).shape == (0, 2, 2)


def test_a_controller_is_conditioned_within_its_movement():
    """Recordings of a clock that starts at different times count from 0 s; a common start is one up to a sample."""
    shown = demonstrations()
    apart = Demonstrations([TIME + 5.0 + 0.1 * k for k in range(len(shown))], shown.positions, units="m")
    controller = DMPController(ProMPBaseline()).fit(apart)
    for time in (6.0, -0.5, 2.5, 1000.0, 1.7e9):
        message = rf"times\[1\] is {time} s, must be near the movement, -0.4 to 2.4: times are those of the demonstr"
        with pytest.raises(ValueError, match=message):
            controller.condition([1.0, time], [controller.goal_] * 2)
    controller.condition([-0.4, 2.4], [controller.start_, controller.goal_], noise_scale=1e-3)


def test_a_controller_is_conditioned_on_all_samples_that_it_was_trained_on():
    shown = demonstrations()
    shown = Demonstrations([TIME * (1.0 + 0.15 * (k % 3 - 1)) for k in range(len(shown))], shown.positions, units="m")
    controller = DMPController(ProMPBaseline()).fit(shown)
    for times, positions in zip(shown.times[:3], shown.positions, strict=False):
        bent = controller.condition(times[-1:], positions[-1:] + 0.02, noise_scale=1e-3)
        assert np.linalg.norm(bent.predict([[2.0]]) - controller.predict([[2.0]])) > 0.01


def test_phases_are_told_without_a_unit():
    shown = demonstrations()
    shown = Demonstrations([TIME / TIME[-1]] * len(shown), shown.positions, time_unit="1", units="m")
    controller = DMPController(ProMPBaseline(), duration=2.0).fit(shown)
    with pytest.raises(ValueError, match=r"times\[0\] is -0.3, must be near the movement, -0.2 to 1.2: times"):
        controller.condition([-0.3], [controller.goal_])


@pytest.mark.filterwarnings("ignore:via", "ignore:The reproduced movement is")
@pytest.mark.parametrize("phase_input", ["time", "s", "log_s"])
def test_what_is_known_stays_where_an_unlikely_point_follows(phase_input):
    controller = DMPController(TrajectoryRegressor(), phase_input=phase_input).fit(demonstrations())
    time = np.linspace(0.0, 0.8, 9)
    pushed = controller.predict(time[:, np.newaxis]) + np.array([0.005, 0.0])
    known = controller.condition(time, pushed, noise_scale=1e-3)
    pushed_on = controller.predict([[1.0]])[0, 0] + 0.01
    known = known.condition([1.0], [[pushed_on, np.nan]])
    before = known.schedule(rate=100.0).position
    bent = known.schedule(rate=100.0, via=[(1.5, before[150] + [0.3, np.nan])]).position
    np.testing.assert_allclose(bent[150, 0], before[150, 0] + 0.3, rtol=0, atol=1e-4)
    np.testing.assert_allclose([before[100, 0], bent[100, 0]], pushed_on, rtol=0, atol=1e-5)
    # The past moves by no more than its noise: the likely share of the change is conditioned on, as before.
    np.testing.assert_allclose(bent[:81], before[:81], rtol=0, atol=2e-3)


@pytest.mark.filterwarnings("ignore:via")
def test_an_output_that_is_free_at_a_point_passes_it_as_if_it_were_not_there(controller):
    place = controller.schedule(rate=100.0).position
    one = controller.schedule(rate=100.0, via=[(1.0, place[100] + [0.3, np.nan])])
    two = controller.schedule(
        rate=100.0, via=[(1.0, place[100] + [0.3, np.nan]), (1.1, [np.nan, one.position[110, 1]])]
    )
    np.testing.assert_allclose(two.position, one.position, rtol=0, atol=1e-3)


@pytest.mark.filterwarnings("ignore:via")
def test_points_at_one_time_are_one_point(controller):
    place, late = controller.predict([[1.0]])[0] + [0.3, 0.2], 1.0 + 1e-10
    whole = controller.schedule(rate=100.0, via=[(1.0, place)])
    for via in ([(1.0, [place[0], np.nan]), (late, [np.nan, place[1]])], [(1.0, place), (late, place)]):
        np.testing.assert_allclose(
            controller.schedule(rate=100.0, via=via).position, whole.position, rtol=0, atol=1e-12
        )


def test_a_via_point_at_a_given_end_is_that_end(controller):
    goal = controller.goal_ + np.array([0.01, 0.0])
    at_end = controller.schedule(rate=100.0, goal=goal, via=[(2.0, [np.nan, goal[1]])])
    np.testing.assert_array_equal(at_end.position, controller.schedule(rate=100.0, goal=goal, via=[]).position)
    with pytest.raises(ValueError, match=r"of via\[0\] is .*, must be .* as of goal, which is at the same time, 2 s"):
        controller.schedule(rate=100.0, goal=goal, via=[(2.0, goal + 0.1)])


def test_points_that_are_likely_each_and_not_together_are_told_and_throw_nothing(controller):
    """Half a standard deviation to either side within 30 ms: a movement through both, as these vary, swings far out."""
    plain, deviation = controller.schedule(rate=100.0), np.sqrt(controller.predict_cov([[1.0]])[0, 0, 0])
    via = [
        (1.0 + dt, plain.position[round(100 + 100 * dt)] + [sign * 0.5 * deviation, 0.0])
        for dt, sign in ((0, 1), (0.03, -1))
    ]
    for point in via:
        controller.schedule(rate=100.0, via=[point])
    with pytest.warns(UserWarning, match=r"via\[1\], at 1.03 s, is .* standard deviations from the movement"):
        bent = controller.schedule(rate=100.0, via=via, limits=None)
    np.testing.assert_allclose(bent.position[[100, 103]], [position for _, position in via], rtol=0, atol=1e-6)
    assert np.abs(bent.position - plain.position)[:, 0].max() < 2.0 * deviation  # taken for likely both, 4.7


def test_what_a_controller_was_conditioned_on_stays_where_goal_and_start_are_others(controller):
    where = controller.predict([[1.0]])[0] + [0.02, 0.01]
    known = controller.condition([1.0], [where])
    for ends in ({"goal": controller.goal_ + 0.2}, {"start": controller.start_ - 0.2}):
        moved = known.schedule(rate=100.0, **ends)
        np.testing.assert_allclose(moved.position[100], where, rtol=0, atol=1e-6)
        at_ends = known.schedule(rate=100.0).position[[0, -1]]
        expected = [ends.get("start", at_ends[0]), ends.get("goal", at_ends[1])]
        np.testing.assert_allclose(moved.position[[0, -1]], expected, rtol=0, atol=1e-9)
    with pytest.raises(ValueError, match=r"y0 of via\[0\] is .* as of what is known, which is at the same time"):
        known.schedule(rate=100.0, via=[(1.0, where + 0.1)])
    about = controller.condition([2.0], [controller.goal_ + 0.01], noise_scale=0.01)
    goal = controller.goal_ + 0.02
    np.testing.assert_allclose(about.schedule(rate=100.0, goal=goal).position[-1], goal, rtol=0, atol=1e-9)


@pytest.mark.parametrize("model", [TrajectoryRegressor(), ProMPBaseline()])
def test_outputs_are_known_one_by_one_at_one_time(model):
    controller = DMPController(model).fit(demonstrations())
    where = controller.predict([[1.0]])[0] + [0.02, 0.01]
    known = controller.condition([1.0], [[np.nan, where[1]]])
    both = known.condition([1.0], [[where[0], np.nan]])
    for bent, options in (
        (known, {"via": [(1.0, [where[0], np.nan])]}),
        (both, {}),
        (both, {"goal": controller.goal_ + 0.1}),
    ):
        np.testing.assert_allclose(bent.schedule(rate=100.0, **options).position[100], where, rtol=0, atol=1e-9)
    end = known.condition([2.0], [[np.nan, controller.goal_[1] + 0.002]])
    goal = [controller.goal_[0] + 0.003, end.schedule(rate=100.0).position[-1, 1]]
    np.testing.assert_allclose(end.schedule(rate=100.0, goal=goal).position[-1], goal, rtol=0, atol=1e-9)
    with pytest.raises(ValueError, match=r"y1 of via\[0\] is .* as of what is known"):
        known.schedule(rate=100.0, via=[(1.0, where + 0.05)])


@pytest.mark.filterwarnings("ignore:via")
def test_the_order_in_which_points_are_given_does_not_matter(controller):
    via = [(at, controller.predict([[at]])[0] + [0.05, 0.0]) for at in (0.6, 1.0, 1.4)]
    paths = [controller.schedule(rate=100.0, via=[via[i] for i in order]).position for order in ((0, 1, 2), (2, 0, 1))]
    np.testing.assert_array_equal(*paths)


@pytest.mark.filterwarnings("ignore:The reproduced movement is .* off the mean")
@pytest.mark.parametrize(("options", "atol"), [({"adaptation": "additive"}, 1e-6), ({"phase_input": "s"}, 1e-9)])
def test_own_ends_change_no_path_and_what_is_known_stays_in_any_form_of_movement(options, atol):
    controller = DMPController(ProMPBaseline(), **options).fit(demonstrations())
    plain = controller.schedule(rate=100.0)
    own = controller.schedule(rate=100.0, goal=controller.goal_, start=controller.start_)
    np.testing.assert_allclose(own.position, plain.position, rtol=0, atol=1e-9)
    # Ends that are given are met: as stiffly where they are those shown as a nanometre beside.
    near = controller.schedule(rate=100.0, goal=controller.goal_ + 1e-9, start=controller.start_ + 1e-9)
    np.testing.assert_allclose(own.stiffness, near.stiffness, rtol=1e-6)
    where = controller.predict([[1.0]])[0] + [0.02, 0.01]
    known = controller.condition([1.0], [where])
    known = known.condition([1.2], known.predict([[1.2]]) + 0.002)
    moved = known.schedule(rate=100.0, start=controller.start_ + 0.05)
    np.testing.assert_allclose(moved.position[100], where, rtol=0, atol=atol)


def test_a_bent_movement_brakes_from_its_own_speed(controller):
    bent = copy.copy(controller)
    bent.reproduction_ = copy.copy(controller.reproduction_)
    change = [[0.0, 0.0], [0.0, 0.0], [0.02, 0.0]]
    bent.reproduction_.bend = CubicSpline([0.0, 1.0, 2.0], change, bc_type=((1, [0.0, 0.0]), (1, [0.05, 0.0])))
    plain, plan = (each.schedule(rate=1000.0, settle=0.5) for each in (controller, bent))
    assert np.linalg.norm(plan.velocity[-1]) == 0.0
    # By the speed of the movement before it was bent it would stand within 3 ms, at 16 m/s^2.
    most = [np.linalg.norm(each.acceleration, axis=1).max() for each in (plain, plan)]
    assert most[1] < 2.0 * most[0]


@pytest.mark.parametrize("regressor", [ProMPBaseline(), TrajectoryRegressor(GMMBaseline())])
def test_an_end_known_nearly_without_noise_is_no_singular_one(regressor):
    controller = DMPController(regressor).fit(demonstrations())
    known = controller.condition([0.0], [controller.start_], noise_scale=1e-12)
    plan = known.schedule(rate=100.0, start=controller.start_)
    np.testing.assert_allclose(plan.position, controller.schedule(rate=100.0).position, rtol=0, atol=1e-6)


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


def test_noise_of_recordings_is_no_kink_of_a_plan():
    """A step's own noise was once passed at each observed time: accelerations of 39 m/s^2, where 0.25 were shown."""
    rng, s = np.random.default_rng(0), TIME / 2.0
    rise, bow = s**3 * (10.0 - 15.0 * s + 6.0 * s**2), np.sin(np.pi * s) ** 2
    ways = [
        np.stack([0.5 * rise + 0.02 * a * bow, (0.15 + 0.03 * b) * bow], axis=1) for a, b in rng.normal(size=(8, 2))
    ]
    shown = Demonstrations(TIME, np.stack(ways) + 5e-4 * rng.normal(size=(8, 101, 2)), units="m")
    plain = running = DMPController(TrajectoryRegressor(CholeskyCovRegressor())).fit(shown)

    def roughest(controller, **options):
        plan = controller.schedule(rate=500.0, **options)
        return np.abs(plan.acceleration).max(), np.abs(plan.velocity[-1]).max()

    shake, last = roughest(plain)
    for time in np.arange(0.5, 1.0, 0.02):
        where = running.predict([[time]]) + 5e-4 * rng.normal(size=(1, 2))
        running = running.condition([time], where, noise_scale=5e-4)
    assert roughest(running)[0] < 2.5 * shake
    np.testing.assert_allclose(running.predict([[time]]), where, atol=2e-3)
    aside = np.array([0.02, 0.0])
    for options in ({"goal": plain.goal_ + aside}, {"via": [(1.0, plain.predict([[1.0]])[0] + aside)]}):
        bent, at_end = roughest(plain, **options)
        assert bent < 3.0 * shake
        assert at_end < last + 0.01


def test_a_via_point_is_met_by_a_model_that_passes_it_nearly(controller):
    kmp = DMPController(KMPBaseline()).fit(demonstrations())
    where = kmp.predict([[1.0]])[0] + [0.0, 0.03]
    passed = kmp.condition([1.0], [where])
    np.testing.assert_allclose(passed.predict([[1.0]])[0], where, rtol=0, atol=1e-9)


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


def test_what_is_known_before_the_start_moves_no_point_within_the_movement(controller):
    path = controller.predict([[0.0], [0.4], [1.0]])
    known = controller.condition([-0.1], [path[0] + 0.001]).condition([0.4], [path[1] + 0.005])
    via, start = known.predict([[1.0]])[0] + 0.01, known.predict([[0.0]])[0] + [0.02, 0.0]
    plan = known.schedule(rate=100.0, start=start, via=[(1.0, via)]).position
    np.testing.assert_allclose(plan[[0, 40, 100]], [start, path[1] + 0.005, via], rtol=0, atol=1e-6)


def test_a_movement_whose_start_is_known_still_meets_its_via_points(controller):
    known = controller.condition([0.0], [controller.start_])
    bent = known.schedule(rate=100.0, via=[(1.0, [0.22, 0.13])])
    np.testing.assert_allclose(bent.position[[0, 100]], [controller.start_, [0.22, 0.13]], atol=1e-3)


def test_what_is_known_exactly_of_an_output_beside_a_precise_one_has_no_variance():
    # The tunnel's y varies a billion times less than its x: rounding of the variance of x is much beside it.
    controller = DMPController(TrajectoryRegressor()).fit(make_tunnel_demonstrations(random_state=0))
    place = controller.predict([[3.0], [6.0]])
    via = [(3.0, np.add(place[0], [0.01, np.nan])), (6.0, np.add(place[1], [0.02, 0.0]))]
    bent = controller.schedule(rate=200.0, via=via, goal=np.add(controller.goal_, [0.05, 0.0]))
    np.testing.assert_allclose(bent.position[600, 0], via[0][1][0], atol=1e-6)
    assert (np.linalg.eigvalsh(bent.covariance[600]) >= 0.0).all()


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
        (
            [(0.5, [0.2, 0.1]), (1.0, [0.2, np.nan]), (1.0 + 1e-10, [0.3, 0.1])],
            "y0 of via\\[2\\] is 0.3, must be 0.2 as of via\\[1\\], which is at the same time, 1 s: leave one",
        ),
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

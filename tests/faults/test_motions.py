"""Schedules that end where they should, at rest, within what robots do. Numbers are those of the list of faults."""

import json
from contextlib import nullcontext
from functools import cache

import numpy as np
import pytest

import torch_pbd
from torch_pbd import CholeskyCovRegressor, Demonstrations, DMPController, load_demonstrations
from torch_pbd.control import MotionLimits, RealTimeAdmittance, simulate_many
from torch_pbd.data import make_tunnel_demonstrations

SCALES = (0.98, 1.0, 1.02)


def minimum_jerk(u):
    return 10.0 * u**3 - 15.0 * u**4 + 6.0 * u**5


def fitted(path, lasting=2.0, *, units="m", time_unit="s", **parameters):
    """A controller of three demonstrations of a path of the share of the movement."""
    time = np.linspace(0.0, lasting, 81)
    position = np.column_stack(np.broadcast_arrays(*path(time / lasting)))
    shown = Demonstrations([time] * 3, [scale * position for scale in SCALES], units=units, time_unit=time_unit)
    controller = DMPController(CholeskyCovRegressor(max_iter=2), n_steps=50, **parameters)
    told = "tell no units" if units is None else f"in '{units}', which is no known length"
    with nullcontext() if units in ("m", "mm", "deg") else pytest.warns(UserWarning, match=told):
        return controller.fit(shown)


@cache
def reaching():
    return fitted(lambda u: (minimum_jerk(u), 0.3 * minimum_jerk(u) + 0.1 * np.sin(np.pi * u) ** 2))


@cache
def cut():
    """A reach of 1 m in 4 s, cut in the middle: at its highest speed, 15 / 8 of the mean."""
    with pytest.warns(UserWarning, match=r"ends at 0\.469 m/s, where its largest is 0\.469: .* cut while"):
        return fitted(lambda u: (minimum_jerk(0.5 * u), 0.0))


@pytest.mark.parametrize("rate", [33.3, 7.3, 999.9, 1000.0])
def test_68_the_last_row_is_at_the_end(rate):
    schedule = reaching().schedule(rate)
    assert schedule.time[-1] == 2.0
    np.testing.assert_allclose(np.diff(schedule.time)[:-1], 1.0 / rate)
    np.testing.assert_allclose(schedule.position[-1], reaching().goal_, atol=1e-12)
    assert reaching().schedule(rate, settle=0.01, speed=0.7).time[-1] == pytest.approx(2.0 / 0.7 + 0.01, rel=1e-15)
    assert schedule.resample(0.9 * rate).time[-1] == 2.0


def test_68_a_shorter_last_row_is_simulated_certified_and_driven(tmp_path):
    schedule = reaching().schedule(33.3)
    run = reaching().simulate(rate=33.3)
    np.testing.assert_allclose(np.diff(run.time), 1.0 / 33.3)
    np.testing.assert_array_equal(run.desired_position, schedule.position)
    many = simulate_many(schedule, 3, peak=1e-9, random_state=0)
    np.testing.assert_allclose(many.peak_deviation, np.linalg.norm(run.deviation, axis=1).max(), rtol=1e-6)
    assert simulate_many(schedule.resample(45.1), 3, random_state=0).deviation.shape == (92, 3)
    report, even = (each.certify() for each in (schedule, reaching().schedule(33.5)))
    assert (report.stable, report.gain) == (True, pytest.approx(even.gain, rel=1e-3))
    robot = RealTimeAdmittance(schedule, rate=33.3, max_step=0.1)
    robot.start(0.0)
    for tick in range(1, 200):
        robot.tick(tick / 33.3, [0.0, 0.0])
    np.testing.assert_allclose(robot.position, reaching().goal_, atol=1e-3)
    schedule.save(tmp_path / "short.csv")
    assert type(schedule).load(tmp_path / "short.csv") == schedule


def test_gains_are_those_of_movement_time():
    fast, slow = (reaching().schedule(rate, speed=speed) for rate, speed in ((100.0, 1.0), (50.0, 0.5)))
    assert slow.duration == 2.0 * fast.duration
    np.testing.assert_allclose(slow.position, fast.position, atol=1e-12)
    np.testing.assert_allclose(slow.velocity, 0.5 * fast.velocity, atol=1e-12)
    for name in ("stiffness", "damping", "covariance", "type1"):
        np.testing.assert_allclose(getattr(slow, name), getattr(fast, name), rtol=1e-9)
    adapted = reaching().schedule(100.0, goal=[0.5, 0.5])
    np.testing.assert_array_equal(adapted.stiffness, fast.stiffness)
    assert adapted.certify().stable


BAD = [
    ({"goal": [1.0]}, r"goal has shape \(1,\), must have shape \(2,\)"),
    ({"start": [np.nan, 0.0]}, r"start\[0\] is nan, must be finite"),
    *[({"speed": speed}, "speed is") for speed in (0.0, -1.0, np.nan, "1", True)],
    ({"speed": [1.0, 1.0]}, "speed is"),
    ({"limits": 10.0}, "limits is 10.0, must be a MotionLimits or None"),
]


@pytest.mark.parametrize(("options", "message"), BAD, ids=[message for _, message in BAD])
def test_arguments_of_a_schedule_are_refused_by_name(options, message):
    with pytest.raises(ValueError, match=message):
        reaching().schedule(100.0, **options)


@pytest.mark.parametrize("name", ["duration", "distance", "speed"])
@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, "1", None])
def test_66_limits_are_positive_numbers(name, value):
    with pytest.raises(ValueError, match=f"{name} is .*, must be a finite number above 0"):
        MotionLimits(**{name: value})


def test_66_what_no_robot_does_is_refused():
    """Millimetres and milliseconds without a word, as m and s: 628 m in 2,631 s."""
    unsaid = fitted(lambda u: (628.0 * minimum_jerk(u), 0.0), 2631.0, units=None)
    with pytest.raises(
        ValueError,
        match=r"duration of the schedule is 2631 s, must be at most limits.duration, 600 s: correct units \(none\)",
    ):
        unsaid.schedule(10.0)
    with pytest.raises(
        ValueError, match=r"distance of the schedule is 628 m, must be at most limits.distance, 10 m.*time_unit \(s\)"
    ):
        unsaid.schedule(10.0, speed=10.0)
    assert len(unsaid.schedule(1.0, limits=None)) == 2632
    assert len(unsaid.schedule(1.0, limits=MotionLimits(3000.0, 1000.0, 1.0))) == 2632
    fast = fitted(lambda u: (5.0 * minimum_jerk(u), 0.0), 0.5, units="m")
    with pytest.raises(ValueError, match=r"speed of the schedule is 18.75 m/s, must be at most limits.speed, 10 m/s"):
        fast.schedule(100.0)
    with pytest.raises(ValueError, match="speed of the schedule is"):
        reaching().schedule(100.0, goal=[9.0, 0.0], speed=2.0)


def test_66_places_arbitrary_units_and_angles_are_no_limits():
    far = fitted(lambda u: (5e5 + minimum_jerk(u), 4.5e6 + 0.0 * u), units=None)
    assert len(far.schedule(10.0)) == 21
    for units in ("pixels", "deg"):
        assert len(fitted(lambda u: (600.0 * minimum_jerk(u), 0.0), units=units).schedule(10.0)) == 21
    millimetres = fitted(lambda u: (600.0 * minimum_jerk(u), 0.0), units="mm").schedule(10.0)
    assert np.ptp(millimetres.position, axis=0)[0] == pytest.approx(0.6, rel=1e-4)


def test_73_a_movement_that_was_cut_is_told_and_ends_at_rest_at_its_goal():
    plain = cut().schedule(500.0)
    settled = cut().schedule(500.0, settle=1.0)
    assert plain.velocity[-1, 0] == pytest.approx(15.0 / 32.0, rel=1e-3)  # as it was shown
    np.testing.assert_allclose(plain.position, cut().predict(plain.time[:, None]), atol=1e-12)
    np.testing.assert_allclose(settled.position[-1], cut().goal_, atol=1e-9)
    assert np.abs(settled.velocity[-1]).max() == 0.0
    reach = np.ptp(plain.position, axis=0).max()
    assert settled.position.max() - cut().goal_.max() <= 1e-9 * reach
    accelerations = [np.abs(np.gradient(each.velocity[:, 0], each.time)).max() for each in (plain, settled)]
    # In a fifth of 2 s at most, by a speed that falls as 1 - 3 u^2 + 2 u^3, whose steepest slope is 1.5.
    assert accelerations[1] <= 1.01 * max(accelerations[0], 1.5 * 15.0 / 32.0 / 0.4)
    np.testing.assert_allclose(cut().predict([[2.0], [50.0]]), [cut().goal_] * 2, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["kuka_cube_pick", "adroit_door_palm"])
def test_73_recordings_that_were_cut(name, recordings):
    shown = load_demonstrations(recordings / f"{name}.npz")[:20]
    with pytest.warns(UserWarning, match="cut while moving"):
        controller = DMPController(CholeskyCovRegressor(max_iter=2)).fit(shown)
    plain, settled = controller.schedule(200.0), controller.schedule(200.0, settle=1.0)
    low, high = plain.position.min(axis=0), plain.position.max(axis=0)
    assert (np.maximum(settled.position - high, low - settled.position) <= 1e-6 * (high - low)).all()
    np.testing.assert_allclose(settled.position[-1], controller.goal_, atol=1e-9 * np.abs(high).max())
    assert np.abs(settled.velocity[-1]).max() == 0.0


def test_73_movements_from_rest_to_rest_or_at_a_steady_pace_are_not_told_of(recordings):
    model = CholeskyCovRegressor(max_iter=2)
    with pytest.warns(UserWarning, match="which is no known length") as told:
        DMPController(model).fit(load_demonstrations(recordings / "letter_G.npz"))
    assert len(told) == 1
    tunnel = DMPController(model).fit(make_tunnel_demonstrations(4, rate=20.0, random_state=0))
    settled = tunnel.schedule(100.0, settle=2.0)  # 0.06 m/s to the last: stops on its path
    assert settled.position[:, 1].max() <= tunnel.goal_[1] + 1e-9
    fitted(lambda u: (u, 2.0 * u))
    # Slow, in other units than lengths, or over a phase: nothing that a robot would be hurt by is known.
    fitted(lambda u: (0.1 * minimum_jerk(0.5 * u), 0.0))
    fitted(lambda u: (minimum_jerk(0.5 * u), 0.0), units="deg")
    fitted(lambda u: (minimum_jerk(0.5 * u), 0.0), time_unit="1", duration=2.0)


def test_files_keep_how_a_movement_adapts_and_old_ones_are_of_the_printed_equation(tmp_path):
    for adaptation in ("safe", "additive"):
        controller = fitted(lambda u: (minimum_jerk(u), 0.0), adaptation=adaptation)
        torch_pbd.save(controller, tmp_path / "skill.safetensors")
        again = torch_pbd.load(tmp_path / "skill.safetensors")
        assert (again.adaptation, again.dmp_.tau) == (adaptation, controller.dmp_.tau)
        mine, its = (each.schedule(50.0, goal=[0.5, 0.0], start=[0.1, 0.1]) for each in (controller, again))
        assert mine == its
    from torch_pbd.persistence.plain import decode_parameters

    described = json.loads('{"class": "DMPController", "params": {"alpha": 9.0}}')
    assert decode_parameters(described).adaptation == "additive"


@pytest.mark.parametrize("value", ["hoffmann", None, 1.0])
def test_other_adaptations_are_refused(value):
    with pytest.raises(ValueError, match=r"adaptation is .*, must be one of 'safe', 'additive'"):
        fitted(lambda u: (minimum_jerk(u), 0.0), adaptation=value)

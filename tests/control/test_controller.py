import pickle
from contextlib import nullcontext

import numpy as np
import pandas as pd
import pytest
import torch
from sklearn.base import clone

from torch_pbd import CholeskyCovRegressor, Demonstrations, DMPController, GMMBaseline, HeteroscedasticGPRegressor
from torch_pbd.control import AdmittancePlant, ForceSensor, RealTimeAdmittance, Schedule, StiffnessLaw
from torch_pbd.data import make_tunnel_demonstrations
from torch_pbd.exceptions import DataRankWarning, UnimodalityWarning

PAPER_LAW = StiffnessLaw(sigma_low=3.5e-4, sigma_high=1.2e-3, bounds="variance")
CD = CholeskyCovRegressor()  # the paper's; and fitted sooner, where the regressor does not matter
PAPER = {
    "covariance": CD, "alpha": 1.0, "beta": 1.0, "adaptation": "additive", "gate": "none", "variability": "forcing",
    "cutoff": 3.0,
    "damping_ratio": "paper", "on_unknown": "prior", "stiffness_law": PAPER_LAW,
}  # fmt: skip


@pytest.fixture(scope="module")
def tunnel():
    return make_tunnel_demonstrations(random_state=0)


@pytest.fixture(scope="module")
def controller(tunnel):
    return DMPController().fit(tunnel)


def test_the_regressor_is_heteroscedastic_unless_another_is_given(controller):
    assert type(controller.covariance_) is HeteroscedasticGPRegressor


def pulse(time, centre):
    u = np.clip((time - centre) / 0.8 + 0.5, 0.0, 1.0)
    return 5.0 * np.sin(np.pi * u) ** 2


def test_the_reproduction_is_the_mean_of_the_demonstrations(tunnel, controller):
    error = controller.predict(tunnel.times[0][:, None]) - tunnel.to_array().mean(axis=0)
    assert np.abs(error).max() < 5e-4  # the tremor is 0.1 mm; the tunnel 10 mm on either side
    assert np.sqrt(np.mean(error**2)) < 1e-4


def test_it_comes_to_rest_at_the_goal_and_stays(controller):
    late = controller.predict(np.array([[30.0], [1e3], [1e6]]))
    np.testing.assert_allclose(late, np.tile(controller.goal_, (3, 1)), atol=1e-6)
    end = controller.schedule(100.0, settle=5.0)
    assert np.abs(end.velocity[-1]).max() < 1e-6
    beyond = end.position[:, 1].max() - controller.goal_[1]
    assert 0.0 <= beyond < 0.06 * 1.0 / 6.25  # tau v_end / beta, what it would be without a gate


def test_the_goal_is_held_at_first_and_the_robot_compliant_long_after_the_end(controller):
    at_end, soon, late = (
        np.linalg.eigvalsh(controller.schedule(20.0, settle=settle).stiffness[-1]) for settle in (0.0, 1.0, 10.0)
    )
    np.testing.assert_allclose(soon, at_end, rtol=0.02)
    np.testing.assert_allclose(late, 50.0)


def test_the_papers_primitive_goes_past_the_goal(tunnel):
    paper = DMPController(**PAPER).fit(tunnel)
    beyond = paper.predict(np.array([[45.0]]))[0, 1] - paper.goal_[1]
    assert beyond == pytest.approx(0.06, rel=0.02)  # tau v_end / beta


def test_figure_8_in_the_papers_parameters(tunnel):
    paper = DMPController(**PAPER).fit(tunnel)
    schedule = paper.schedule()
    force = np.zeros_like(schedule.position)
    force[:, 0] = pulse(schedule.time, 2.0) + pulse(schedule.time, 8.0)
    deviation = np.abs(paper.simulate(force=force).deviation[:, 0])
    early, late = deviation[:5000].max(), deviation[5000:].max()
    assert 15.0 <= early / late <= 25.0
    assert schedule.stiffness[2000, 0, 0] == pytest.approx(50.0)
    assert schedule.stiffness[8000, 0, 0] == pytest.approx(1000.0)
    np.testing.assert_allclose(schedule.stiffness[:, 1, 1], 1000.0, rtol=1e-4)


def test_the_schedule_says_what_predict_says(controller):
    schedule = controller.schedule(50.0)
    X = schedule.time[:, None]
    np.testing.assert_allclose(schedule.position, controller.predict(X), rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(schedule.stiffness, controller.predict_stiffness(X), rtol=1e-12)
    np.testing.assert_allclose(schedule.damping, controller.predict_damping(X), rtol=1e-12)
    np.testing.assert_allclose(schedule.covariance, controller.covariance_.predict_cov(X), rtol=1e-12)
    np.testing.assert_allclose(np.gradient(schedule.position, 0.02, axis=0)[1:-1], schedule.velocity[1:-1], atol=2e-4)
    eigenvalues = np.linalg.eigvalsh(schedule.stiffness)
    assert 50.0 - 1e-9 <= eigenvalues.min() <= eigenvalues.max() <= 1000.0 + 1e-9
    assert (schedule.names, schedule.units, schedule.stiffness_limits) == (("x", "y"), "m", (50.0, 1000.0))
    assert schedule.provenance["n_demos"] == 6
    assert schedule.provenance["controller"]["DMPController"]["alpha"] == 25.0
    assert schedule.provenance["covariance"]["HeteroscedasticGPRegressor"]["prior"] is None


def test_a_schedule_of_a_controller_survives_its_file(controller, tmp_path):
    schedule = controller.schedule(20.0)
    schedule.save(tmp_path / "tunnel.json")
    assert Schedule.load(tmp_path / "tunnel.json") == schedule


def test_what_is_unknown_is_soft_apart_from_what_varies(tunnel):
    far = np.array([[30.0], [60.0]])
    within = np.linspace(0.0, 10.0, 50)[:, None]
    narrow = CholeskyCovRegressor(prior=1e-12)  # a prior that claims to know: stiff
    with pytest.warns(UserWarning, match="prior has variances"):
        soft, prior, refusing = (
            DMPController(narrow, on_unknown=policy).fit(tunnel) for policy in ("soft", "prior", "raise")
        )
    np.testing.assert_allclose(soft.predict_stiffness(far), np.tile(50.0 * np.eye(2), (2, 1, 1)), atol=1e-6)
    np.testing.assert_allclose(prior.predict_stiffness(far), np.tile(1000.0 * np.eye(2), (2, 1, 1)), rtol=1e-6)
    np.testing.assert_allclose(soft.predict_stiffness(within), prior.predict_stiffness(within), rtol=1e-6)
    refusing.predict_stiffness(within)
    with pytest.raises(ValueError, match="no data at time 30"):
        refusing.predict_stiffness(far)


def test_time_and_the_logarithm_of_the_phase_are_the_same_model(tunnel):
    X = np.linspace(0.0, 10.0, 40)[:, None]
    time, phase = (DMPController(CD, phase_input=kind).fit(tunnel).predict_stiffness(X) for kind in ("time", "log_s"))
    np.testing.assert_allclose(phase, time, rtol=1e-6, atol=1e-6)


def test_times_positions_and_groups_are_the_same_as_demonstrations(tunnel, controller):
    X, y, groups = tunnel.stack()
    stacked = DMPController().fit(X, y, groups=np.array([f"hand {k}" for k in groups]))
    query = np.linspace(0.0, 10.0, 11)[:, None]
    np.testing.assert_array_equal(stacked.predict_stiffness(query), controller.predict_stiffness(query))
    assert DMPController(CD).fit(X, pd.DataFrame(y, columns=["across", "along"]), groups=groups).names_[1] == "along"
    with pytest.raises(ValueError, match=r"X does not increase at row 1001.*groups"):
        DMPController().fit(X, y)


def test_times_count_as_those_of_the_demonstrations(tunnel, controller):
    query = np.linspace(0.0, 10.0, 11)[:, None]
    later = Demonstrations([time + 1.7e9 for time in tunnel.times], tunnel.positions, names=tunnel.names, units="m")
    shifted = DMPController().fit(later)
    np.testing.assert_allclose(shifted.predict(query + 1.7e9), controller.predict(query), atol=1e-5)
    np.testing.assert_allclose(
        shifted.predict_stiffness(query + 1.7e9), controller.predict_stiffness(query), rtol=1e-2, atol=1e-3
    )
    assert shifted.schedule(10.0).time[0] == 0.0
    apart = Demonstrations([time + 20.0 * k for k, time in enumerate(tunnel.times)], tunnel.positions, units="m")
    np.testing.assert_allclose(DMPController(CD).fit(apart).predict(query), controller.predict(query), atol=1e-9)


@pytest.mark.parametrize("variant", ["unequal", "dropped", "jitter"])
def test_unaligned_demonstrations_give_about_the_same(variant, controller):
    other = DMPController(CD).fit(make_tunnel_demonstrations(random_state=0, variant=variant))
    share = np.linspace(0.0, 1.0, 40)[:, None]
    narrow = slice(30, 40)  # where all are precise, whatever their lanes are
    stiffness = other.predict_stiffness(share * other.duration_)[narrow, 0, 0]
    assert stiffness.min() > 700.0
    end = other.predict(share * other.duration_)[narrow] - controller.predict(share * controller.duration_)[narrow]
    assert np.abs(end).max() < 5e-3


def test_two_ways_through_are_told_of():
    with pytest.warns(UnimodalityWarning):
        DMPController(CD).fit(make_tunnel_demonstrations(12, random_state=0, variant="two_path"))


def test_the_regressor_is_cloned_and_any_will_do(tunnel):
    mixture = GMMBaseline(n_components=3, random_state=0)
    fitted = DMPController(mixture).fit(tunnel)
    assert fitted.covariance is mixture
    assert not hasattr(mixture, "module_")
    assert isinstance(fitted.covariance_, GMMBaseline)
    X = np.array([[1.0], [9.0]])
    assert fitted.predict_stiffness(X)[0, 0, 0] < 100.0 < 700.0 < fitted.predict_stiffness(X)[1, 0, 0]


def test_parameters_clone_and_pickle(controller):
    law = StiffnessLaw(20.0, 500.0)
    copied = clone(DMPController(GMMBaseline(), alpha=9.0, stiffness_law=law))
    assert (copied.alpha, copied.stiffness_law) == (9.0, law)
    again = pickle.loads(pickle.dumps(controller))
    assert again.schedule(20.0) == controller.schedule(20.0)


def test_two_fits_are_equal_and_leave_the_callers_state_alone(tunnel, controller):
    before = torch.get_rng_state(), torch.get_default_dtype()
    again = DMPController().fit(tunnel)
    assert torch.equal(torch.get_rng_state(), before[0])
    assert torch.get_default_dtype() == before[1]
    assert again.schedule(20.0) == controller.schedule(20.0)


def test_millimetres_and_milliseconds_plan_and_move_as_metres_and_seconds(tunnel, controller):
    # Along the tunnel demonstrations agree to 1e-6 m, where rounding must not decide the fit.
    milli = [1e3 * position for position in tunnel.positions]
    other = DMPController().fit(Demonstrations([1e3 * t for t in tunnel.times], milli, units="mm", time_unit="ms"))
    assert (other.schedule(50.0).units, other.schedule(50.0).duration) == ("m", pytest.approx(10.0))
    force = np.zeros((501, 2))
    force[80:120, 0] = 5.0
    mine, theirs = (fitted.simulate(force=force, rate=50.0) for fitted in (other, controller))
    np.testing.assert_allclose(mine.position, theirs.position, rtol=1e-6, atol=1e-8)
    X = np.linspace(0.0, 10.0, 21)[:, None]
    np.testing.assert_allclose(other.predict(1e3 * X), 1e3 * controller.predict(X), rtol=1e-6, atol=1e-5)
    # Of matrices of 1000 N/m; entries off the diagonal are millionths of that, and differ by rounding of other units.
    np.testing.assert_allclose(other.predict_stiffness(1e3 * X), controller.predict_stiffness(X), rtol=1e-6, atol=1e-5)
    expected = controller.schedule(5.0).covariance
    np.testing.assert_allclose(other.schedule(5.0).covariance, expected, rtol=1e-5, atol=1e-7 * np.abs(expected).max())


def test_outputs_in_different_units_are_told_of(tunnel):
    mixed = Demonstrations(tunnel.times, [position * [1e3, 1.0] for position in tunnel.positions], units=["mm", "m"])
    with pytest.warns(
        UserWarning, match=r"in different units, mm, m: their principal axes mix them.*\.in_units\('m'\)"
    ):
        controller = DMPController(CD).fit(mixed)
    with pytest.raises(ValueError, match="distance"):  # limits of lengths apply
        controller.schedule()


def test_phases_need_a_duration(tunnel, controller):
    phases = Demonstrations([time / 10.0 for time in tunnel.times], tunnel.positions, units="m", time_unit="1")
    with pytest.warns(UserWarning, match=r"in '1', not in s: the movement is taken to last 1 s\. Give duration"):
        fitted = DMPController(CD).fit(phases)
    assert (fitted.schedule(100.0).duration, fitted.cutoff_, controller.cutoff_) == (1.0, 40.0, 4.0)
    timed = DMPController(CD, duration=10.0, cutoff=4.0).fit(phases)
    plan = timed.schedule(50.0)
    np.testing.assert_allclose(plan.velocity, controller.schedule(50.0).velocity, atol=1e-6)
    np.testing.assert_allclose(timed.predict([[0.5]]), controller.predict([[5.0]]), atol=1e-7)


@pytest.mark.parametrize("factor", [1e3, 1e-3])
def test_other_units_without_a_name_give_the_same_stiffness(tunnel, controller, factor):
    scaled = Demonstrations(tunnel.times, [factor * position for position in tunnel.positions])
    with pytest.warns(UserWarning, match="tell no units"):
        other = DMPController().fit(scaled)
    X = np.linspace(0.0, 10.0, 21)[:, None]
    np.testing.assert_allclose(other.predict(X) / factor, controller.predict(X), rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(other.predict_stiffness(X), controller.predict_stiffness(X), rtol=1e-4)


def test_a_constant_output_is_precise():
    tunnel = make_tunnel_demonstrations(random_state=0)
    flat = [np.column_stack([position[:, 0], np.full(len(position), 0.5)]) for position in tunnel.positions]
    fitted = DMPController().fit(Demonstrations(tunnel.times, flat, units="m"))
    X = np.linspace(0.0, 10.0, 21)[:, None]
    np.testing.assert_allclose(fitted.predict(X)[:, 1], 0.5, rtol=1e-9)
    np.testing.assert_allclose(fitted.predict_stiffness(X)[:, 1, 1], 1000.0, rtol=1e-6)


def test_a_goal_changes_at_run_time_without_overshoot(controller):
    plan = controller.schedule(200.0, settle=4.0)
    time, plain = plan.time, plan.position
    goal = np.tile(controller.goal_, (len(time), 1))
    goal[time > 6.0] += [0.0, 0.1]
    moved = controller.schedule(200.0, settle=4.0, goal=goal).position
    step = (moved - plain)[:, 1]
    assert (np.diff(step) >= -1e-12).all()
    assert step[time <= 6.0].max() < 1e-12
    assert 0.0999 < step[-1] <= 0.1 + 1e-9


def test_a_plant_of_another_mass_is_told_of_and_a_noisy_sensor_is_seeded(controller):
    with pytest.warns(UserWarning, match=r"mass=2\.0 kg.* damping_ratio was met for mass=1 kg"):
        controller.simulate(AdmittancePlant(2.0), rate=50.0)
    noisy = AdmittancePlant(sensor=ForceSensor.jr3())
    runs = [controller.simulate(noisy, rate=50.0, random_state=seed).position for seed in (0, 0, 1)]
    np.testing.assert_array_equal(runs[0], runs[1])
    assert np.abs(runs[0] - runs[2]).max() > 0.0


def test_the_mass_goes_with_the_schedule(tunnel, tmp_path):
    heavy = DMPController(CD, mass=4.0).fit(tunnel)
    heavy.schedule(50.0).save(tmp_path / "heavy.json")
    schedule = Schedule.load(tmp_path / "heavy.json")
    assert schedule.mass == 4.0
    assert schedule.certify().inertia == ((4.0, 4.0),)
    assert schedule.certify().damping_ratio == pytest.approx(1.0, abs=1e-6)
    mine, told = (RealTimeAdmittance(schedule, rate=50.0, max_step=0.1, **mass) for mass in ({}, {"mass": 4.0}))
    for each in (mine, told):
        each.start(0.0)
        for tick in range(1, 100):
            each.tick(0.02 * tick, [1.0, 0.0])
    assert mine.position == told.position


def test_a_cutoff_that_takes_the_movement_away_is_told_of(tunnel):
    with pytest.warns(UserWarning, match="off the mean of the demonstrations.*try a higher cutoff"):
        blurred = DMPController(CD, cutoff=0.05).fit(tunnel)
    assert blurred.reproduction_error_ > 1e-3


@pytest.mark.parametrize(
    ("options", "message"), [({"goal": [np.nan, 0.0]}, r"goal\[0\] is nan"), ({"speed": np.inf}, "speed is inf")]
)
def test_what_cannot_be_reproduced_is_refused(controller, options, message):
    with pytest.raises(ValueError, match=message):
        controller.schedule(50.0, **options)


def test_demonstrations_that_stand_still_are_precise():
    still = Demonstrations(np.arange(100) * 0.02, np.full((6, 100, 2), 0.3), units="m")
    with pytest.warns(DataRankWarning, match="identical"), pytest.warns(UserWarning, match="do not vary"):
        fitted = DMPController().fit(still)
    np.testing.assert_allclose(fitted.predict_stiffness([[1.0]]), 1000.0 * np.eye(2)[None], rtol=1e-9)


def test_simulation_follows_the_schedule_and_takes_any_plant(controller):
    rollout = controller.simulate(rate=500.0)
    assert isinstance(rollout.position, np.ndarray)
    assert np.abs(rollout.deviation).max() < 2e-3
    exact = controller.simulate(AdmittancePlant(feed_forward=True), rate=500.0)
    assert np.abs(exact.deviation).max() < 0.1 * np.abs(rollout.deviation).max()
    with pytest.raises(ValueError, match=r"force has shape \(3, 2\), must have shape \(5001, 2\)"):
        controller.simulate(force=np.zeros((3, 2)), rate=500.0)


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"alpha": 0.0}, "alpha is 0.0, must be a finite number above 0"),
        ({"beta": -1.0}, "beta is -1.0, must be a finite number above 0"),
        ({"tau": 0.0}, "tau is 0"),
        ({"phase_input": "phase"}, "phase_input is 'phase', must be one of 'time', 'log_s', 's'"),
        ({"variability": "velocity"}, "variability is 'velocity'"),
        ({"on_unknown": "stiff"}, "on_unknown is 'stiff'"),
        ({"gate": "open"}, "gate is 'open'"),
        ({"cutoff": -3.0}, "cutoff is -3.0 Hz, must be a finite number above 0"),
        ({"n_steps": 2}, "n_steps is 2"),
        ({"mass": 0.0}, "mass is 0.0 kg"),
        ({"damping_ratio": -1.0}, "damping_ratio is -1"),
    ],
)
def test_parameters_that_cannot_be_used_are_told_before_work(tunnel, parameters, message):
    with pytest.raises(ValueError, match=message):
        DMPController(**parameters).fit(tunnel)


def test_data_that_cannot_be_used():
    one = make_tunnel_demonstrations(1, random_state=0)
    with pytest.raises(ValueError, match="needs >= 2 demonstrations, got 1"):
        DMPController().fit(one)
    with pytest.raises(ValueError, match="y is None"):
        DMPController().fit(np.zeros((5, 1)))
    with pytest.raises(ValueError, match="demonstration 0 has 4 samples, needs at least 5"):
        DMPController().fit(make_tunnel_demonstrations(3, duration=1.0, rate=3.0, random_state=0))


@pytest.mark.parametrize(("scale", "noise"), [(1.0, 0.0), (1e-4, 0.0), (1e4, 1e-9)])
def test_identical_demonstrations_are_stiff_and_told_of(scale, noise, rng):
    once = make_tunnel_demonstrations(1, rate=20.0, random_state=0)
    same = [scale * (once.positions[0] + noise * rng.normal(size=once.positions[0].shape)) for _ in range(3)]
    told = pytest.warns(DataRankWarning, match="identical") if noise == 0.0 else nullcontext()
    with told, pytest.warns(UserWarning, match="do not vary"):
        fitted = DMPController(n_steps=50).fit(Demonstrations([once.times[0]] * 3, same, units="m"))
    stiffness = fitted.predict_stiffness(np.linspace(0.0, 10.0, 5)[:, None])
    np.testing.assert_allclose(stiffness, np.tile(1000.0 * np.eye(2), (5, 1, 1)), rtol=1e-6)


MORE = [pytest.param(name, marks=pytest.mark.slow) for name in ("snooker_skilled", "gait_hip_knee", "pen_a")]


@pytest.mark.parametrize("name", ["letter_G", "kuka_cube_pick", *MORE])
def test_recorded_skills_are_learned(name, recordings):
    from torch_pbd import load_demonstrations

    recorded = load_demonstrations(recordings / f"{name}.npz")
    known = recorded.units[0] in ("m", "deg")
    words = f"in '{recorded.units[0]}', which is no known"
    told = nullcontext() if known else pytest.warns(UserWarning, match=words)
    with told, pytest.warns(UserWarning, match="cut while moving") if name == "kuka_cube_pick" else nullcontext():
        fitted = DMPController(duration=None if recorded.time_unit == "s" else 2.0).fit(recorded)
    schedule = fitted.schedule(200.0 / fitted.duration_)
    eigenvalues = np.linalg.eigvalsh(schedule.stiffness)
    assert 50.0 - 1e-6 <= eigenvalues.min() < 200.0
    assert 800.0 < eigenvalues.max() <= 1000.0 + 1e-6
    aligned = recorded if recorded.is_aligned else recorded.align("phase", n=200)
    share = (aligned.times[0] - aligned.times[0][0]) / np.ptp(aligned.times[0])
    mean = aligned.to_array().mean(axis=0)
    own = fitted.start_time_ + share * fitted.duration_ / fitted.time_scale_
    error = fitted.predict(own[:, None]) - mean
    assert np.sqrt(np.mean(error**2)) < 0.05 * np.ptp(mean, axis=0).max()

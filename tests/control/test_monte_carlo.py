"""Many rollouts against the simulation of each, NumPy's quantiles, and laws of a linear system."""

import re
from dataclasses import replace

import numpy as np
import pytest
import scipy.stats
import torch

import torch_pbd.control.simulation.rollouts
import torch_pbd.files.memory
from torch_pbd import rotations
from torch_pbd.control import (
    AdmittancePlant,
    EnergyTank,
    ForceSensor,
    PositionLoop,
    RateLimit,
    Schedule,
    Tunnel,
    simulate,
    simulate_many,
)
from torch_pbd.control.matrices import damping_from_stiffness
from torch_pbd.control.simulation.ticks import admittance_rate

RATE = 200.0


def turning_schedule(n_ticks=301, d=2, mass=1.0, rate=RATE, start=0.0):
    """A curve, with a stiffness whose axes turn, and critical damping."""
    time = np.arange(n_ticks) / rate
    spin = np.zeros((n_ticks, d, d))
    for axis in range(d - 1):
        spin[:, axis, axis + 1] = 2.0 * time / (1 + axis)
    axes = torch.linalg.matrix_exp(torch.tensor(spin - spin.swapaxes(1, 2))).numpy()
    eigenvalues = 500.0 + 400.0 * np.sin(3.0 * time[:, None] + np.arange(d))
    stiffness = axes * eigenvalues[:, None] @ axes.swapaxes(1, 2)
    stiffness = 0.5 * (stiffness + stiffness.swapaxes(1, 2))
    damping = damping_from_stiffness(stiffness, mass).numpy()
    turn = 2.0 * time[:, None] + np.arange(d)
    covariance = np.broadcast_to(np.eye(d), stiffness.shape)
    position, velocity = 0.1 * np.sin(turn), 0.2 * np.cos(turn)
    return Schedule(time + start, position, velocity, stiffness, damping, covariance, 0.0 * time, mass=mass)


def standing(schedule):
    """The same gains, in one place."""
    return replace(schedule, position=0.0 * schedule.position, velocity=0.0 * schedule.velocity)


def one_by_one(schedule, summary, plant):
    """Distances (R, T) from the desired position, by AdmittancePlant.simulate, one rollout after the other."""
    share = (schedule.time - summary.onset[:, None]) / summary.duration[:, None]
    forces = np.sin(np.pi * share.clip(0.0, 1.0))[..., None] ** 2 * summary.push[:, None]
    motion = [getattr(schedule, name) for name in ("position", "velocity", "stiffness", "damping")]
    motion = [torch.tensor(each) for each in motion]
    dt = schedule.duration / (len(schedule) - 1)
    runs = [plant.simulate(*motion, torch.tensor(force), dt=dt).deviation.numpy() for force in forces]
    return np.linalg.norm(runs, axis=-1)


def check_against(distance, schedule, summary, rtol=1e-12):
    np.testing.assert_allclose(
        summary.deviation, np.quantile(distance, summary.quantiles, axis=0).T, rtol=rtol, atol=rtol * distance.max()
    )
    np.testing.assert_allclose(summary.peak_deviation, distance.max(axis=1), rtol=rtol)


@pytest.mark.parametrize("d", [1, 2, 3])
def test_it_is_each_rollout_by_itself(d):
    schedule, plant = turning_schedule(d=d, mass=0.7), AdmittancePlant(0.7)
    options = {"plant": plant, "peak": (2.0, 9.0), "duration": (0.1, 0.5), "quantiles": (0.0, 0.3, 0.5, 1.0)}
    summary = simulate_many(schedule, 12, **options, random_state=0)
    check_against(one_by_one(schedule, summary, plant), schedule, summary)
    (alone,) = one_by_one(schedule, simulate_many(schedule, 1, **options, random_state=1), plant)
    np.testing.assert_allclose(
        simulate_many(schedule, 1, **options, random_state=1).deviation[:, 0],
        alone,
        rtol=1e-12,
        atol=1e-12 * max(alone),
    )


@pytest.mark.parametrize(
    "parts",
    [
        {"position_loop": PositionLoop()},
        {"sensor": ForceSensor(bias=0.2, cutoff=30.0)},
        {"stiffness_filter": EnergyTank()},
        {"stiffness_filter": RateLimit()},
        {"environment": Tunnel(2e3), "substeps": 2},
    ],
    ids=lambda parts: "-".join(parts),
)
def test_what_acts_in_the_loop_acts_in_each(parts, monkeypatch):
    monkeypatch.setattr(torch_pbd.control.simulation.rollouts, "_CHUNK", 3)
    schedule, plant = turning_schedule(n_ticks=101), AdmittancePlant(**parts)
    summary = simulate_many(schedule, 5, plant=plant, duration=0.2, random_state=0)
    check_against(one_by_one(schedule, summary, plant), schedule, summary, rtol=1e-11)


def test_a_steady_push_is_composed_of_affine_maps():
    """The state at the end by the product of the maps of all ticks, under no force and under others that stand."""
    schedule, plant, dt = turning_schedule(), AdmittancePlant(), 1.0 / RATE
    motion = [torch.tensor(getattr(schedule, name)) for name in ("position", "velocity", "stiffness", "damping")]
    maps = torch.linalg.matrix_exp(dt * admittance_rate(*motion[2:], torch.eye(2).double())).numpy()[:, :4]
    forces = np.array([[0.0, 0.0], [4.0, -1.0], [0.5, 9.0]])
    whole, moved = np.eye(4), np.zeros((3, 4))
    for tick in range(len(schedule) - 1):
        push = forces + schedule.damping[tick] @ schedule.velocity[tick]
        step = schedule.position[tick + 1] - schedule.position[tick]
        whole = maps[tick, :, :4] @ whole
        moved = moved @ maps[tick, :, :4].T + push @ maps[tick, :, 4:].T - np.r_[step, 0.0, 0.0]
    final = whole @ np.r_[0.0, 0.0, schedule.velocity[0]] + moved
    run = plant.simulate(*motion, torch.tensor(forces)[:, None].expand(-1, len(schedule), -1), dt=dt)
    np.testing.assert_allclose(run.deviation[:, -1], final[:, :2], rtol=1e-10)
    np.testing.assert_allclose(run.velocity[:, -1], final[:, 2:], rtol=1e-10)
    summary = simulate_many(schedule, 3, plant=plant, peak=0.0, random_state=0)
    np.testing.assert_allclose(summary.deviation[-1], np.linalg.norm(final[0, :2]), rtol=1e-10)


def test_twice_the_push_is_twice_as_far():
    """Of a robot that is to stand still: the deviation of a linear system goes with the force."""
    schedule = standing(turning_schedule())
    once, twice = (simulate_many(schedule, 40, peak=peak, random_state=3) for peak in (2.5, 5.0))
    np.testing.assert_array_equal(2.0 * once.push, twice.push)
    np.testing.assert_allclose(twice.deviation, 2.0 * once.deviation, rtol=1e-10, atol=1e-14)
    np.testing.assert_allclose(twice.peak_deviation, 2.0 * once.peak_deviation, rtol=1e-10)
    np.testing.assert_array_equal(twice.return_time, once.return_time)
    # By a mass that gives way to a force F for t seconds: never further than without any spring
    assert (twice.peak_deviation < 5.0 * 0.8**2 / 2.0).all()
    assert (twice.deviation[0] == 0.0).all()


def check_returns(schedule, summary):
    distance = one_by_one(schedule, summary, AdmittancePlant())
    ends = summary.onset + summary.duration
    for far, end, found in zip(distance, ends, summary.return_time, strict=True):
        above = np.flatnonzero(far > 0.1 * far.max())
        expected = np.inf if above[-1] == len(far) - 1 else max(0.0, (above[-1] + 1) / RATE - end)
        assert found == pytest.approx(expected, abs=1e-12)


def test_it_returns_when_it_stays_below_a_tenth_of_its_peak():
    schedule = turning_schedule()
    summary = simulate_many(schedule, 60, duration=0.3, random_state=1)
    check_returns(schedule, summary)
    assert np.isinf(summary.return_time).any()
    for seed in range(20):  # alone, some return within the ticks that are computed together with the end of the push
        check_returns(schedule, simulate_many(schedule, 1, duration=0.3, random_state=seed))


def test_pushes_are_drawn_from_what_is_documented():
    summary = simulate_many(
        turning_schedule(d=3), 4000, peak=(1.0, 4.0), duration=(0.2, 0.4), onset=(0.3, 0.9), every=300, random_state=0
    )
    strength = np.linalg.norm(summary.push, axis=1)
    assert (np.diff(summary.onset) >= 0.0).all()
    for values, low, high in ((strength, 1.0, 4.0), (summary.duration, 0.2, 0.4), (summary.onset, 0.3, 0.9)):
        assert scipy.stats.kstest((values - low) / (high - low), "uniform").pvalue > 1e-3
    for axis in (summary.push / strength[:, None]).T:  # on the sphere in 3-D, each coordinate is uniform
        assert scipy.stats.kstest(0.5 * (axis + 1.0), "uniform").pvalue > 1e-3
    assert abs(np.corrcoef(np.c_[strength, summary.duration, summary.onset].T) - np.eye(3)).max() < 0.06
    assert len(summary.time) == len(summary.deviation) == 2


@pytest.mark.parametrize("plant", [None, AdmittancePlant(sensor=ForceSensor(noise_scale=0.5))], ids=["linear", "noisy"])
def test_a_seed_is_a_result_to_the_last_bit(plant, monkeypatch):
    monkeypatch.setattr(torch_pbd.control.simulation.rollouts, "_CHUNK", 7)
    schedule = standing(turning_schedule(n_ticks=60))
    runs = [
        simulate_many(schedule, 20, plant=plant, duration=0.1, random_state=seed)
        for seed in (0, np.random.RandomState(0), 1)
    ]
    for name in ("deviation", "peak_deviation", "return_time", "push"):
        first, again, other = (getattr(run, name) for run in runs)
        np.testing.assert_array_equal(first, again)
        assert not np.array_equal(first, other)


def test_chunks_make_no_difference(monkeypatch):
    schedule = turning_schedule(n_ticks=101)
    whole = simulate_many(schedule, 50, duration=0.1, random_state=0)
    monkeypatch.setattr(torch_pbd.control.simulation.rollouts, "_CHUNK", 8)
    parts = simulate_many(schedule, 50, duration=0.1, random_state=0)
    for name in ("deviation", "peak_deviation", "return_time"):
        np.testing.assert_allclose(getattr(parts, name), getattr(whole, name), rtol=1e-12, atol=1e-15)


def test_rows_of_quantiles_may_be_fewer():
    schedule = turning_schedule(n_ticks=150)
    dense, sparse = (simulate_many(schedule, 30, every=every, duration=0.2, random_state=0) for every in (1, 7))
    np.testing.assert_array_equal(sparse.deviation, dense.deviation[::7])
    np.testing.assert_array_equal(sparse.time, dense.time[::7])
    np.testing.assert_array_equal(sparse.peak_deviation, dense.peak_deviation)


def test_ticks_are_the_rows_of_the_schedule():
    schedule = turning_schedule(start=3.0)
    coarse, fine = (simulate_many(each, 20, random_state=0) for each in (schedule, schedule.resample(5.0 * RATE)))
    assert len(fine.time) == 5 * 300 + 1
    np.testing.assert_array_equal(fine.onset, coarse.onset)  # pushes do not depend on the ticks
    np.testing.assert_allclose(fine.peak_deviation, coarse.peak_deviation, rtol=0.1)
    assert coarse.onset.min() >= 3.0
    assert "n_rollouts=20" in repr(coarse)
    rows = np.r_[0, np.arange(2, 301)]
    uneven = Schedule(**{name: values[rows] for name, values in schedule._arrays().items()})
    for run in (simulate, simulate_many):
        with pytest.raises(ValueError, match=re.escape("must be evenly spaced: take schedule.resample(rate)")):
            run(uneven)


def test_a_schedule_from_a_file_is_run_as_its_rows_are(tmp_path):
    turning_schedule(start=3.0, mass=2.0).save(tmp_path / "schedule.csv")
    schedule, plant = Schedule.load(tmp_path / "schedule.csv"), AdmittancePlant(2.0)
    push = np.full_like(schedule.velocity, 20.0)
    run = simulate(schedule, push)
    rows = (schedule.position, schedule.velocity, schedule.stiffness, schedule.damping, push)
    alone = plant.simulate(*map(torch.tensor, rows), dt=1.0 / RATE).numpy()
    np.testing.assert_allclose(run.position, alone.position, rtol=0, atol=1e-12)
    np.testing.assert_allclose(run.time, schedule.time, rtol=1e-12)
    assert abs(run.deviation).max() > 2.0 * abs(simulate(schedule, plant=plant).deviation).max()
    with pytest.raises(ValueError, match=r"force has shape \(300, 2\), must have shape \(301, 2\)"):
        simulate(schedule, push[1:])


def test_a_plant_of_another_mass_is_told_of():
    with pytest.warns(UserWarning, match=r"mass=2\.0 kg.* damping_ratio was met for mass=1 kg"):
        simulate_many(turning_schedule(), 2, plant=AdmittancePlant(2.0))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"n_rollouts": 0}, "n_rollouts is 0, must be an integer of at least 1"),
        ({"every": 0}, "every is 0"),
        ({"peak": -1.0}, "peak is -1.0 N, must be a finite number of at least 0"),
        ({"peak": (3.0, 1.0)}, "peak is 1.0 N, must be a finite number of at least 3"),
        ({"duration": 0.0}, "duration is 0.0 s, must be a finite number above 0 and at most 1.5"),
        ({"duration": (0.1, 2.0)}, "duration is 2.0 s, must be a finite number above 0 and of at least 0.1"),
        ({"onset": (-1.0, 1.0)}, "onset is -1.0 s, must be a finite number of at least 0 and at most 1.5"),
        ({"onset": (0.1, 0.2, 0.3)}, "onset has shape (3,), must have shape (2,)"),
        ({"quantiles": (0.5, 1.5)}, "quantiles[1] is 1.5, must be from 0 to 1"),
        ({"quantiles": (0.5, -0.1)}, "quantiles[1] is -0.1"),
    ],
)
def test_arguments_are_checked(arguments, words):
    with pytest.raises(ValueError, match=re.escape(words)):
        simulate_many(turning_schedule(), **{"n_rollouts": 50, "random_state": 0, **arguments})


def test_too_many_rollouts_are_refused_before_they_are_drawn(monkeypatch):
    monkeypatch.setattr(torch_pbd.files.memory, "available_bytes", lambda: 2**20)
    with pytest.raises(
        ValueError, match=r"n_rollouts=100000 needs about 0\.\d+ GiB of memory, but 0\.000781 GiB can be"
    ):
        simulate_many(turning_schedule(), 100_000)


def pose_schedule(n_ticks=121):
    """The curve in space, of a tool that turns by 2 rad/s, with an inertia that doubles on the way."""
    plain = turning_schedule(n_ticks, d=3)
    time, d = plain.time, 6
    turning = np.stack([0.0 * time, 1.2 * time, 1.6 * time], axis=1)
    rows = [np.zeros((n_ticks, d, d)) for _ in range(3)]
    for row, block in zip(rows, (plain.stiffness, plain.damping, plain.covariance), strict=True):
        row[:, :3, :3], row[:, 3:, 3:] = block, 0.02 * block
    mass = np.linspace(1.0, 2.0, n_ticks)[:, None, None] * (np.diag([1.0] * 3 + [0.02] * 3) + 0.004)
    velocity = np.c_[plain.velocity, np.tile([0.0, 1.2, 1.6], (n_ticks, 1))]
    return Schedule(
        time,
        plain.position,
        velocity,
        *rows,
        plain.type1,
        acceleration=np.c_[-4.0 * plain.position, np.zeros((n_ticks, 3))],
        orientation=rotations.exp(turning),
        mass=mass,
    )


@pytest.mark.parametrize("feed_forward", [False, True])
def test_of_poses_it_is_each_rollout_by_itself_in_its_units(feed_forward):
    """Force and torque at once; distances in m and angles in rad apart; the inertia is the schedule's."""
    schedule = pose_schedule()
    plant = AdmittancePlant(None, feed_forward=feed_forward)
    options = {"peak": (2.0, 9.0), "torque": (0.1, 0.4), "duration": (0.1, 0.3), "quantiles": (0.3, 1.0)}
    summary = simulate_many(schedule, 9, plant=plant, **options, random_state=0)
    wrench = np.c_[summary.push, summary.rotation.push]
    share = (schedule.time - summary.onset[:, None]) / summary.duration[:, None]
    forces = np.sin(np.pi * share.clip(0.0, 1.0))[..., None] ** 2 * wrench[:, None]
    given = {name: getattr(schedule, name) for name in ("stiffness", "damping")}
    given |= {f"{name}_desired": getattr(schedule, name) for name in ("position", "velocity", "orientation")}
    given["acceleration_desired"] = schedule.acceleration
    robot = AdmittancePlant(schedule.mass, feed_forward=feed_forward)
    runs = np.stack([robot.simulate(**given, force=force, dt=1.0 / RATE).deviation.numpy() for force in forces])
    for part, block in ((summary, slice(0, 3)), (summary.rotation, slice(3, 6))):
        distance = np.linalg.norm(runs[..., block], axis=-1)
        check_against(distance, schedule, part, rtol=1e-11)
        limit = 0.1 * distance.max(axis=1, keepdims=True)
        assert (np.isinf(part.return_time) == (distance[:, -1:] > limit)[:, 0]).all()
    strength = np.linalg.norm(summary.rotation.push, axis=1)
    assert ((strength >= 0.1) & (strength <= 0.4)).all()
    assert re.search(r"mm at 5/50/95 %, \d+% return; .* degrees at 5/50/95 %", repr(summary))
    (alone,) = [simulate_many(schedule, 9, plant=robot, **options, random_state=0)]
    np.testing.assert_array_equal(alone.deviation, summary.deviation)


def test_noise_of_force_and_of_torque_moves_poses():
    noisy = AdmittancePlant(None, sensor=ForceSensor(noise_scale=(0.5,) * 3 + (0.01,) * 3))
    moved, calm = (
        simulate_many(pose_schedule(21), 3, plant=plant, peak=0.0, duration=0.05, random_state=0)
        for plant in (noisy, AdmittancePlant(None))
    )
    assert (moved.peak_deviation != calm.peak_deviation).all()
    assert (moved.rotation.peak_deviation != calm.rotation.peak_deviation).all()


def test_a_schedules_inertia_is_compared_with_that_of_the_plant():
    schedule = pose_schedule(31)
    for mass in (None, schedule.mass, lambda time: schedule.mass):
        simulate_many(schedule, 2, plant=AdmittancePlant(mass), duration=0.1, random_state=0)  # warnings are errors
    with pytest.warns(UserWarning, match="mass=.* was met for the inertia of the schedule, off by up to 10%"):
        simulate_many(schedule, 2, plant=AdmittancePlant(1.1 * schedule.mass), duration=0.1)
    with pytest.warns(UserWarning, match="mass=<function .* has another mass"):
        simulate_many(schedule, 2, plant=AdmittancePlant(lambda time: 2.0), duration=0.1)


def test_torques_are_checked():
    with pytest.raises(ValueError, match=re.escape("torque is -1.0 Nm, must be a finite number of at least 0")):
        simulate_many(pose_schedule(31), 5, torque=-1.0, duration=0.1)
    with pytest.raises(ValueError, match=re.escape("torque is 0.5 Nm, must be 0 for a schedule without orientation")):
        simulate_many(turning_schedule(), 5, torque=0.5)


def test_pushes_that_turn_a_tool_far_away_are_told_of():
    with pytest.warns(UserWarning, match=r"turned by up to .* rad from the desired orientation"):
        simulate_many(pose_schedule(31), 3, torque=60.0, duration=0.15, random_state=0)

"""What is guaranteed of poses, and where the inertia differs from row to row, against brute force."""

import itertools
import math
import re
from dataclasses import replace

import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
import torch
from control.loops import as_schedule
from control.test_stability import maps_between_knots, periodic_schedules
from scipy.spatial.transform import Rotation

from torch_pbd import rotations
from torch_pbd.control.matrices import damping_from_stiffness
from torch_pbd.control.schedule import Schedule
from torch_pbd.control.simulation.run import simulate
from torch_pbd.control.simulation.ticks import admittance_rate
from torch_pbd.control.stability import dynamics as module
from torch_pbd.control.stability.common_function import (
    common_function,
    scaled,
    search,
    searched_function,
    unpacked,
)
from torch_pbd.control.stability.dynamics import ErrorDynamics, largest_gain
from torch_pbd.control.stability.lyapunov import Knots, held_growth

START = np.array([1.0, 0.0, 0.0, 0.0])


def turned(eigenvalues, angle):
    """Matrices (..., 2, 2) of ``eigenvalues`` (..., 2) along axes at ``angle`` (...) in rad."""
    axes = np.moveaxis(np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]), (0, 1), (-2, -1))
    matrix = axes * eigenvalues[..., None, :] @ axes.swapaxes(-1, -2)
    return 0.5 * (matrix + matrix.swapaxes(-1, -2))


def random_definite(rng, n, d, low, high):
    axes = np.linalg.qr(rng.normal(size=(n, d, d)))[0]
    matrix = axes * np.exp(rng.uniform(math.log(low), math.log(high), size=(n, 1, d))) @ axes.swapaxes(1, 2)
    return torch.tensor(0.5 * (matrix + matrix.swapaxes(1, 2)))


def cross(vector):
    return np.stack([np.cross(each, np.eye(3), axisb=0, axisc=0) for each in vector])


def arm_rows(rng, n=40, *, softest=(200.0, 15.0), stiffest=(1000.0, 60.0), spin=0.5, duration=3.0, ratio=1.0):
    """Error dynamics of poses of an arm: 5 to 15 kg, .1 to .7 kg m^2, coupled, that change smoothly as the gains do."""
    time = np.linspace(0.0, duration, n)
    share = 0.5 + 0.5 * np.sin(2.0 * np.pi * time[:, None] / duration * rng.uniform(0.3, 1.0, 6) + rng.uniform(0, 6, 6))
    turns = [
        Rotation.from_rotvec(rng.normal(size=3) + np.outer(np.sin(time), rng.normal(size=3))).as_matrix()
        for _ in range(4)
    ]
    stiffness, mass = np.zeros((2, n, 6, 6))
    for b, block in enumerate((slice(0, 3), slice(3, 6))):
        low, high = softest[b], stiffest[b]
        values = low * (high / low) ** share[:, block]
        stiffness[:, block, block] = turns[b] * values[:, None] @ turns[b].swapaxes(1, 2)
        light, heavy = ((5.0, 15.0), (0.1, 0.7))[b]
        values = light * (heavy / light) ** share[:, block][:, ::-1]
        mass[:, block, block] = turns[2 + b] * values[:, None] @ turns[2 + b].swapaxes(1, 2)
    roots = [np.linalg.cholesky(mass[:, block, block]) for block in (slice(0, 3), slice(3, 6))]
    coupling = 0.5 * roots[0] @ np.diag([1.0, -0.6, 0.3]) @ roots[1].swapaxes(1, 2)
    mass[:, :3, 3:], mass[:, 3:, :3] = coupling, coupling.swapaxes(1, 2)
    transport = np.zeros((n, 6, 6))
    transport[:, 3:, 3:] = cross(spin * np.sin(np.pi * time / duration)[:, None] * np.array([0.6, -0.5, 0.6]))
    stiffness, mass, transport = (torch.tensor(each) for each in (stiffness, mass, transport))
    damping = damping_from_stiffness(stiffness, mass, ratio)
    return ErrorDynamics(torch.tensor(time), stiffness, damping, mass, transport if spin else None)


def rate_matrix(stiffness, damping, mass, transport):
    d = len(stiffness)
    lower = -np.linalg.solve(mass, np.hstack([stiffness, damping]))
    return np.vstack([np.hstack([transport, np.eye(d)]), lower])


@pytest.mark.parametrize("share", [0.0, 0.37, 1.0])
def test_the_change_of_the_function_along_a_motion_is_that_of_finite_differences(rng, share):
    """Gains, inertia and transport linear in time: Q is quadratic, of which the three matrices are the coefficients."""
    low, high = (0.5, 3.0, 0.2, 1.0), (9.0, 8.0, 2.0, 3.0)
    gains = [random_definite(rng, 2, 6, *pair) for pair in zip(low[:3], high[:3], strict=True)]
    transport = torch.zeros(2, 6, 6).double()
    transport[:, 3:, 3:] = torch.tensor(cross(rng.normal(size=(2, 3))))
    step, alpha = 0.4, 0.3
    knots = Knots(ErrorDynamics(torch.tensor([0.0, step]).double(), *gains, transport))
    first, last, mixed = knots.form(alpha, torch.tensor([0]), 1.0, 1.0, 0.0)[:, 0].numpy()
    dissipation = (1.0 - share) ** 2 * first + 2.0 * share * (1.0 - share) * mixed + share**2 * last

    def at(time):
        return [(each[0] + time / step * (each[1] - each[0])).numpy() for each in (*gains, transport)]

    def function(time, state):
        stiffness, damping, mass, _ = at(time)
        e, v = state[:6], state[6:]
        return 0.5 * v @ mass @ v + alpha * e @ mass @ v + 0.5 * e @ (stiffness + alpha * damping) @ e

    start = rng.normal(size=12)
    difference, now = 3e-5, share * step
    values = []
    for sign in (1.0, -1.0):
        moved = scipy.integrate.solve_ivp(
            lambda time, state: rate_matrix(*at(time)) @ state,
            (now, now + sign * difference), start, rtol=1e-12, atol=1e-13,
        )  # fmt: skip
        values.append(function(now + sign * difference, moved.y[:, -1]))
    slope = (values[0] - values[1]) / (2.0 * difference)
    assert slope == pytest.approx(-start @ dissipation @ start, rel=1e-6)


def reference_rate(dynamics, alpha):
    """Smallest eigenvalue of Q relative to P at the ends of every interval, in numpy, without transport."""
    stiffness, damping, mass, time = (
        getattr(dynamics, name).numpy() for name in ("stiffness", "damping", "mass", "time")
    )
    step, values = np.diff(time)[:, None, None], []
    rises = [np.diff(each, axis=0) / step for each in (stiffness, damping, mass)]
    for end in (slice(0, -1), slice(1, None)):
        k, c, m = stiffness[end], damping[end], mass[end]
        coupling = -0.5 * alpha * rises[2]
        falls = np.block(
            [
                [alpha * k - 0.5 * rises[0] - 0.5 * alpha * rises[1], coupling],
                [coupling, c - alpha * m - 0.5 * rises[2]],
            ]
        )
        function = np.block([[k + alpha * c, alpha * m], [alpha * m, m]])
        pairs = zip(falls, function, strict=True)
        values += [scipy.linalg.eigh(*pair, eigvals_only=True)[0] for pair in pairs]
    return min(values)


def test_the_margin_is_the_best_over_all_alpha_where_the_inertia_varies(rng):
    dynamics = arm_rows(rng, spin=0.0)
    alpha, rate, _ = Knots(dynamics).certificate()
    assert rate == pytest.approx(reference_rate(dynamics, alpha), rel=1e-9)
    pairs = zip(dynamics.damping, dynamics.mass, strict=True)
    most = min(scipy.linalg.eigh(*pair, eigvals_only=True)[0] for pair in pairs)
    others = [reference_rate(dynamics, share * most) for share in np.linspace(0.01, 1.0, 100)]
    assert max(others) <= rate + 1e-6 * abs(rate)


@pytest.mark.parametrize("spin", [0.0, 0.8])
def test_the_largest_speed_is_the_last_that_is_certified(rng, spin):
    dynamics = arm_rows(rng, spin=spin)
    fastest = Knots(dynamics).max_speed()
    assert 0.1 < fastest < 100.0

    def margin(speed):
        transport = None if dynamics.transport is None else speed * dynamics.transport
        return Knots(replace(dynamics, time=dynamics.time / speed, transport=transport)).certificate()[1]

    assert margin(0.999 * fastest) >= 0.0
    assert margin(1.001 * fastest) < 0.0


def test_units_of_rotation_change_no_rate_and_no_gain(rng):
    """Degrees for radians; in (a), (b), the speeds, and the growth, to rounding and to where a search ends."""
    dynamics = arm_rows(rng)
    scale = torch.tensor([1.0] * 3 + [math.pi / 180.0] * 3).double()
    both = scale[:, None] * scale
    degrees = replace(
        dynamics,
        stiffness=dynamics.stiffness * both,
        damping=dynamics.damping * both,
        mass=dynamics.mass * both,
    )
    found = [(*Knots(each).certificate()[:2], Knots(each).max_speed()) for each in (dynamics, degrees)]
    np.testing.assert_allclose(found[0], found[1], rtol=1e-6)
    np.testing.assert_allclose(*[common_function(each) for each in (dynamics, degrees)], rtol=2e-2)
    np.testing.assert_allclose(*[largest_gain(each.tick_maps()) for each in (dynamics, degrees)], rtol=1e-9)


def maps_of_state(dynamics):
    """Maps of (e, v), of those of a state whose squared length is the energy."""
    squared, axes, _ = dynamics.modes
    to_modes = axes.mT @ torch.linalg.cholesky(dynamics.mass).mT
    stacked = [(squared.sqrt()[..., None] * to_modes, to_modes), (dynamics.stiffness, dynamics.mass)]
    root, energy = (torch.stack([torch.block_diag(*pair) for pair in zip(*pairs, strict=True)]) for pairs in stacked)
    torch.testing.assert_close(root.mT @ root, energy, rtol=1e-9, atol=1e-9)
    return torch.linalg.solve(root[1:], dynamics.tick_maps() @ root[:-1])


def test_growth_over_ticks_that_are_held_is_that_of_scipy(rng):
    dynamics = arm_rows(rng, 7, softest=(50.0, 4.0), duration=0.3)
    rows = list(zip(*(each.numpy() for each in (dynamics.stiffness, dynamics.damping, dynamics.mass)), strict=True))
    maps, growth = maps_of_state(dynamics), []
    for alpha in (2.0, 1.0, 0.5):
        function = [np.block([[k + alpha * c, alpha * m], [alpha * m, m]]) for k, c, m in rows]
        for i, step in enumerate(np.diff(dynamics.time)):
            free = scipy.linalg.expm(step * rate_matrix(*rows[i], np.zeros((6, 6))))
            free[:6] = scipy.linalg.expm(step * dynamics.transport[i].numpy()) @ free[:6]
            np.testing.assert_allclose(maps[i], free, rtol=1e-9, atol=1e-11)
            grown = free.T @ function[i + 1] @ free
            growth.append(scipy.linalg.eigh(grown, function[i], eigvals_only=True)[-1])
    assert held_growth(dynamics, dynamics.tick_maps(), 2.0) == pytest.approx(
        np.reshape(growth, (3, 6)).max(1).min(), rel=1e-9
    )
    assert held_growth(dynamics, dynamics.tick_maps(), 2.0) > 1.1


def test_maps_are_those_of_the_simulated_robot(rng):
    """The difference of two runs of poses, one pushed by a millinewton in its first tick, goes by them from then on."""
    dynamics = arm_rows(rng, 101, duration=1.0, spin=1.5)
    schedule = as_poses(dynamics)
    turns = rotations.exp(0.01 * schedule.velocity[:-1, 3:])
    orientation = list(
        itertools.accumulate(turns, lambda before, turn: rotations.multiply(turn, before), initial=START)
    )
    schedule, push = replace(schedule, orientation=np.array(orientation)), np.zeros((101, 6))
    push[0] = 1e-3 * rng.normal(size=6)
    pushed, free = (simulate(schedule, force) for force in (push, None))
    state = np.concatenate([pushed.deviation - free.deviation, pushed.velocity - free.velocity], axis=1)
    carried = state[1]
    for tick, each in enumerate(maps_of_state(dynamics).numpy()[1:], start=1):
        carried = each @ carried
        np.testing.assert_allclose(carried, state[tick + 1], atol=1e-6 * abs(state[tick + 1]).max())


def counterexample(n_cycles=6):
    """Four rows of 18 ms, each critically damped in its own inertia, with a stiffness ratio of 20 in it."""
    angle = np.radians([96.0, 141.0, 186.0, 141.0])
    mass = turned(np.tile([1.0, 20.0], (4, 1)), angle)
    root = turned(np.tile(np.sqrt([1.0, 20.0]), (4, 1)), angle)
    stiffness = root @ np.diag([450.0, 9000.0]) @ root
    stiffness = 0.5 * (stiffness + stiffness.swapaxes(1, 2))
    damping = damping_from_stiffness(stiffness, mass).numpy()
    rows = np.arange(4 * n_cycles) % 4
    return 0.018 * np.arange(len(rows)), stiffness[rows], damping[rows], mass[rows]


def test_a_ratio_of_damping_guarantees_nothing_where_the_inertia_varies():
    time, stiffness, damping, mass = counterexample()
    values = np.array([scipy.linalg.eigh(*pair, eigvals_only=True) for pair in zip(stiffness, mass, strict=True)])
    assert values.max() / values.min() == pytest.approx(20.0)
    cycle = np.eye(4)
    for row in range(4):
        cycle = (
            scipy.linalg.expm(0.018 * rate_matrix(stiffness[row], damping[row], mass[row], np.zeros((2, 2)))) @ cycle
        )
    assert abs(np.linalg.eigvals(cycle)).max() > 1.2
    report = as_schedule(time, stiffness, damping, mass=mass).certify()
    assert report.damping_ratio == pytest.approx(1.0)
    assert math.isnan(report.stiffness_ratio)
    assert math.isnan(report.required_damping_ratio)
    assert not report.stable_at_any_schedule
    assert not report.stable
    assert "no ratio is enough" in str(report)


def test_poses_have_no_ratio_and_a_report_in_their_own_units(rng):
    schedule = as_poses(arm_rows(rng))
    report = schedule.certify()
    assert math.isnan(report.required_damping_ratio)
    assert report.stable_at_any_schedule
    assert not report.is_constant
    text = str(report)
    assert max(map(len, text.splitlines())) <= 80
    for words in ("kg and 0.", "kg m^2", "not asked", "not promised", "saturated", "clips", "elbow", "joints", "delay"):
        assert words in text
    held = schedule.certify(mass=2.0)
    assert held.damping_ratio < 1.0
    assert "the admittance at 2 kg and 2 kg m^2" in str(held)
    assert re.search(r"stiffest environment\s+\S+ N/m and \S+ Nm/rad", str(held))
    for block, found in zip(schedule.blocks, (held.environment_stiffness, held.environment_rotation), strict=True):
        part = as_schedule(schedule.time, schedule.stiffness[:, block, block], schedule.damping[:, block, block])
        assert found == pytest.approx(part.certify(mass=2.0).environment_stiffness, rel=1e-9)


def as_poses(dynamics):
    """Schedule of these rows, that turns as their transport says."""
    n = len(dynamics.time)
    velocity = np.zeros((n, 6))
    if dynamics.transport is not None:
        velocity[:, 3:] = dynamics.transport[:, [5, 3, 4], [4, 5, 3]]
    still = {"orientation": np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)), "type1": np.zeros(n), "mass": dynamics.mass.numpy()}
    gains = {"stiffness": dynamics.stiffness, "damping": dynamics.damping, "covariance": dynamics.stiffness}
    return Schedule(dynamics.time, np.zeros((n, 3)), velocity, **gains, **still)


def plane_rows(n=25, duration=2.0):
    """Positions in a plane: stiffness and inertia that change and turn, each by itself."""
    time = np.linspace(0.0, duration, n)
    swing = np.sin(2.0 * time[:, None] + np.array([0.0, 1.5]))
    stiffness, mass = turned(300.0 * 2.0**swing, time), turned(6.0 * 1.8 ** swing[:, ::-1], 0.5 - time)
    return as_schedule(time, stiffness, damping_from_stiffness(stiffness, mass).numpy(), mass=mass)


def test_masses_are_given_in_any_form():
    schedule = plane_rows()
    own, n, expected = schedule.mass, len(schedule), vars(schedule.certify())
    np.testing.assert_equal(vars(schedule.certify(mass=own)), expected)
    np.testing.assert_equal(
        vars(schedule.certify(mass=lambda time: own[np.searchsorted(schedule.time, time)])), expected
    )
    one = schedule.certify(mass=own[3])
    assert one.is_constant
    np.testing.assert_allclose(one.inertia, [np.linalg.eigvalsh(own[3])], rtol=1e-12)
    np.testing.assert_equal(vars(schedule.certify(mass=np.tile(own[3], (n, 1, 1)))), vars(one))
    np.testing.assert_equal(vars(replace(schedule, mass=own[3]).certify()), vars(one))
    np.testing.assert_equal(vars(replace(schedule, mass=None).certify()), vars(schedule.certify(mass=1.0)))
    with pytest.raises(ValueError, match=r"mass has shape \(5, 2, 2\), but stiffness has shape"):
        schedule.certify(mass=own[:5])


def test_what_is_certified_stays_so_resampled_and_at_any_speed():
    """Rows in between are blends of rows, of inertia too; with a diagonal stiffness it is asked anew."""
    schedule = plane_rows()
    report = schedule.certify()
    assert report.stable_at_any_schedule
    assert report.any_schedule_speed == math.inf
    for times in (np.linspace(0.0, 2.0, 7), np.linspace(0.1, 1.9, 41)):
        resampled = schedule.resample(times=times).certify()
        assert resampled.any_schedule_rate >= 0.95 * report.any_schedule_rate
    for speed in (0.01, 30.0):
        assert schedule.retime(speed, mass=schedule.mass).duration == pytest.approx(2.0 / speed)
    assert schedule.diagonal()[0].certify().stable_at_any_schedule
    with pytest.raises(ValueError, match=re.escape("speed is 30.0, must be certified to be stable")):
        schedule.retime(30.0, mass=20.0 * schedule.mass)


def test_a_function_with_axes_of_its_own_serves_ratios_that_no_other_does():
    """Each axis stays within a ratio of 29, both together of 70; a function for any axes ends at 33.9."""
    share = np.random.default_rng(0).uniform(size=(40, 2)).round()
    values = np.array([50.0, 120.0]) * np.array([29.0, 29.17]) ** share
    stiffness = turned(values, np.full(40, 0.7))
    schedule = as_schedule(0.01 * np.arange(40), stiffness, damping_from_stiffness(stiffness, 3.0).numpy(), mass=3.0)
    report = schedule.certify()
    assert report.stiffness_ratio == pytest.approx(70.0, rel=1e-3)
    assert report.required_damping_ratio > 1.2
    assert report.damping_ratio == pytest.approx(1.0)
    assert report.stable_at_any_schedule
    assert report.any_schedule_rate > 0.0


def test_one_function_of_poses_falls_at_the_rate_whatever_is_blended_held_or_turning(rng):
    """Six axes and transport, up to the speed that is said: in the norm of the function, over exact maps."""
    rows, frequency = scaled(arm_rows(rng, 12))
    function = searched_function(rows)
    rate, speed = -function.largest(rows), common_function(rows)[1]
    assert rate > 0.0
    assert 1.0 < speed < math.inf
    rows = rows.restrict(torch.arange(12))  # the others are at rest
    weight = torch.tensor(rng.dirichlet(np.full(12, 0.15), 200))
    gains = [torch.einsum("bn,nij->bij", weight, each) for each in (rows.stiffness, rows.damping, rows.mass)]
    carried = torch.einsum("bn,nij->bij", weight, rows.transport)
    length = torch.tensor(10.0 ** rng.uniform(-3.0, 0.5, 200))
    for fastest in (1.0, 0.99 * speed):
        share = torch.tensor(rng.uniform(size=200).round() * fastest)[:, None, None]
        free = admittance_rate(*gains)[..., :12, :12]
        free[:, :6, :6] = share * carried
        maps = function.root @ torch.linalg.matrix_exp(free * length[:, None, None]) @ torch.linalg.inv(function.root)
        falls = -torch.linalg.matrix_norm(maps, ord=2).log() / length
        assert falls.min() >= (rate if fastest == 1.0 else 0.0) - 1e-9
    assert frequency > 1.0


def test_the_gain_of_many_rows_is_that_of_all_of_them(monkeypatch, rng):
    dynamics = arm_rows(rng, 600, softest=(20.0, 1.0), ratio=0.2, duration=6.0)
    maps = dynamics.tick_maps()
    found = largest_gain(maps)
    monkeypatch.setattr(module, "_MAX_ROWS", 10_000)
    monkeypatch.setattr(module, "_MAX_PARTS", 10_000)
    assert found > 1.2
    assert found == pytest.approx(largest_gain(maps), rel=2e-3)


def switched_maps(time, stiffness, damping, mass, generator):
    """Maps (n, m, 4, 4), and times (n, m): rows and blends of rows held, and the smooth way from row to row.

    Held for 0.01 to 1 natural period; from row to row up to ten times as fast as it was.
    """
    n, n_knots = time.shape
    uniform = torch.rand(n, n_knots, n_knots, generator=generator, dtype=torch.float64)
    blend = (uniform**6 / (uniform**6).sum(-1, keepdim=True))[..., None, None]
    rows = [torch.cat([each, (blend * each[:, None]).sum(2)], dim=1) for each in (stiffness, damping, mass)]
    frequency = torch.linalg.eigvals(torch.linalg.solve(mass, stiffness)).real.log().mean((1, 2)).mul(0.5).exp()
    share = torch.rand(n, 3 * 2 * n_knots, generator=generator, dtype=torch.float64)
    length = 0.01 * 100.0**share * 2.0 * math.pi / frequency[:, None]
    rate = admittance_rate(*(each.repeat(1, 3, 1, 1) for each in rows))[..., :4, :4]
    held = torch.linalg.matrix_exp(rate * length[..., None, None])
    speed = 10.0 ** torch.rand(n, 1, generator=generator, dtype=torch.float64)
    smooth = maps_between_knots(time / speed, stiffness, damping, mass, n_steps=400)
    return torch.cat([held, smooth], dim=1), torch.cat([length, time.diff() / speed], dim=1)


def grows_most(maps, norm, n_steps=120):
    """Indices (n, n_steps) of the maps that an adversary takes, who looks at what grows most in this norm (n, 4, 4)."""
    every, state, chosen = torch.arange(len(maps)), torch.eye(4).double().expand(len(maps), 4, 4), []
    for _ in range(n_steps):
        after = maps @ state[:, None]
        best = torch.linalg.matrix_norm(norm[:, None] @ after).argmax(1)
        state = after[every, best]
        state = state / torch.linalg.matrix_norm(state)[:, None, None]
        chosen.append(best)
    return torch.stack(chosen, dim=1)


def worst_rates(maps, length, norm, generator):
    """Largest rate of growth (n,), 1/s, of cycles of up to 40 maps: as an adversary chose them last, and at random."""
    chosen = torch.cat([grows_most(maps, norm), torch.randint(maps.shape[1], (len(maps), 40), generator=generator)], 1)
    every, worst = torch.arange(len(maps)), torch.full((len(maps),), -math.inf).double()
    for part in (chosen[:, :120].flip(1), chosen[:, 120:]):
        cycle, time = torch.eye(4).double().expand(len(maps), 4, 4), torch.zeros(len(maps)).double()
        for index in part[:, :40].unbind(1):
            cycle, time = cycle @ maps[every, index], time + length[every, index]
            worst = torch.maximum(worst, torch.linalg.eigvals(cycle).abs().amax(-1).log() / time)
    return worst


@pytest.mark.parametrize("n_schedules", [12, pytest.param(250, marks=pytest.mark.slow)])
def test_none_that_is_certified_in_any_order_grows_in_any(n_schedules, generator):
    """Inertia that varies, two axes: no cycle falls more slowly than the rate says, chosen by whom it may be."""
    time, *gains = (each[:, :-1] for each in periodic_schedules(n_schedules, 2, generator, is_varying=True))
    gains[1] = gains[1] * (1.0 + 2.0 * torch.rand(n_schedules, 1, 1, 1, generator=generator, dtype=torch.float64))
    # As common_function, whose 24 first rows are all here: searched side by side, then certified one by one.
    found, frequency = zip(*(scaled(ErrorDynamics(*each)) for each in zip(time, *gains, strict=True)), strict=True)
    parts = ([getattr(each, name) for each in found] for name in ("time", "stiffness", "damping", "mass"))
    functions = search(ErrorDynamics(*map(torch.stack, parts)))[0]
    largest = [unpacked(free, 2).largest(rows) for free, rows in zip(functions, found, strict=True)]
    rate = -torch.tensor(np.multiply(largest, frequency))
    rate[rate <= 0.0] = math.nan
    for each in range(0, n_schedules, n_schedules // 5):
        alone = common_function(ErrorDynamics(*(part[each] for part in (time, *gains))))[0]
        assert alone == pytest.approx(rate[each].item(), rel=1e-4, nan_ok=True)
    maps, length = switched_maps(time, *gains, generator)
    worst = torch.full((n_schedules,), -math.inf).double()
    for _ in range(4):
        norm = torch.randn(n_schedules, 4, 4, generator=generator, dtype=torch.float64)
        stiff = torch.linalg.matrix_norm(gains[0]).mean(1).sqrt()[:, None]
        scale = torch.cat(
            [stiff, stiff, torch.linalg.matrix_norm(gains[2]).mean(1).sqrt()[:, None].expand(-1, 2)], dim=1
        )
        worst = torch.maximum(worst, worst_rates(maps, length, norm * scale[:, None], generator))
    assert torch.isfinite(worst).all()
    certified = ~rate.isnan()
    assert (worst[certified] <= -rate[certified] * (1.0 - 1e-9)).all()
    assert certified.sum() > 0.1 * n_schedules
    assert (worst > 0.0).sum() > 0.2 * n_schedules  # the adversary can find growth

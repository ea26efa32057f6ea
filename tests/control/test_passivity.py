"""Filters of a varying stiffness: what each promises, over random schedules, forces and ticks."""

import math
import re
from types import SimpleNamespace

import pytest
import torch

from torch_pbd.control.filters import EnergyTank, RateLimit, lyapunov_matrix
from torch_pbd.control.matrices import damping_from_stiffness
from torch_pbd.control.simulation.plant import AdmittancePlant
from torch_pbd.control.simulation.ticks import admittance_rate

SOFTEST, STIFFEST = 50.0, 1000.0
MASS = torch.tensor([[1.5, 0.4], [0.4, 0.8]], dtype=torch.float64)


def unstable(dt, duration=8.0):
    """10 kg on 525 + 475 sin(14.2 t) N/m, damped by the root of it: it oscillates at half that frequency."""
    time = torch.arange(round(duration / dt)).double() * dt
    stiffness = (525.0 + 475.0 * torch.sin(14.2 * time))[:, None, None]
    still = torch.zeros(len(time), 1).double()
    return {
        "position_desired": still,
        "velocity_desired": still,
        "stiffness": stiffness,
        "damping": damping_from_stiffness(stiffness, damping_ratio="paper"),
        "position0": torch.tensor([0.1]).double(),
        "dt": dt,
    }


def energy(run, mass):
    """Of spring and mass, at the start of each tick, in J."""
    return 0.5 * (quadratic(run.stiffness, run.deviation) + quadratic(mass, run.velocity))


def quadratic(matrix, vector):
    return (vector.unsqueeze(-2) @ matrix @ vector.unsqueeze(-1))[..., 0, 0]


def schedules(n_schedules, n_ticks, generator):
    """Random gains (n, T, 2, 2) whose axes turn, each schedule at its own pace, and jump now and then."""

    def uniform(*shape):
        return torch.rand(*shape, dtype=torch.float64, generator=generator)

    angle = (uniform(n_schedules, 1) * torch.randn(n_schedules, n_ticks, generator=generator)).cumsum(-1)
    axes = torch.stack([angle.cos(), -angle.sin(), angle.sin(), angle.cos()], dim=-1).unflatten(-1, (2, 2))
    pace = 2.0 * torch.pi * uniform(n_schedules, 1, 2)
    share = 0.5 + 0.5 * torch.sin(pace * torch.arange(n_ticks)[:, None] + 6.0 * uniform(n_schedules, 1, 2))
    share = torch.where(uniform(n_schedules, n_ticks, 2) < 0.02, uniform(n_schedules, n_ticks, 2).round(), share)
    stiffness = axes * (SOFTEST * (STIFFEST / SOFTEST) ** share).unsqueeze(-2) @ axes.mT
    stiffness = 0.5 * (stiffness + stiffness.mT)
    ratio = 0.05 + uniform(n_schedules, 1, 1, 1)
    return stiffness, ratio * damping_from_stiffness(stiffness, MASS)


def random_run(stiffness_filter, dt, generator, *, moving=True, pushed=True, n_schedules=250, n_ticks=80):
    """A batch of runs, and the desired velocity (n, T, 2) it was given."""
    stiffness, damping = schedules(n_schedules, n_ticks, generator)
    shape = stiffness.shape[:-1]
    noise = torch.randn(3, *shape, dtype=torch.float64, generator=generator)
    force = 20.0 * noise[0] * pushed
    position = (0.02 * noise[1] * moving).cumsum(-2)
    velocity = noise[2] * moving
    start = torch.randn(2, n_schedules, 2, dtype=torch.float64, generator=generator)
    plant = AdmittancePlant(MASS, stiffness_filter=stiffness_filter)
    run = plant.simulate(
        position, velocity, stiffness, damping, force, dt=dt, position0=position[:, 0] + 0.1 * start[0],
        velocity0=start[1],
    )  # fmt: skip
    eigenvalues = torch.linalg.eigvalsh(run.stiffness)
    assert eigenvalues.min() >= SOFTEST * (1.0 - 1e-12)
    assert eigenvalues.max() <= STIFFEST * (1.0 + 1e-12)
    assert 0.02 < (run.filter_share < 1.0).double().mean() < 0.999
    return run, velocity


def test_without_a_filter_the_papers_damping_feeds_a_heavy_robot():
    run = AdmittancePlant(10.0).simulate(**unstable(1e-3))
    stored = energy(run, 10.0 * torch.eye(1).double())
    assert (stored[-1] / stored[0]).item() == pytest.approx(7000.0, rel=0.1)


@pytest.mark.parametrize(
    ("stiffness_filter", "dt"),
    [
        (RateLimit(), 1.6e-2),
        (EnergyTank(), 4e-3),
        pytest.param(RateLimit(), 4e-3, marks=pytest.mark.slow),
        pytest.param(EnergyTank(), 1.6e-2, marks=pytest.mark.slow),
    ],
)
def test_with_either_filter_the_heavy_robot_comes_to_rest(stiffness_filter, dt):
    given = unstable(dt)
    unfiltered = energy(AdmittancePlant(10.0).simulate(**given), 10.0 * torch.eye(1).double())
    assert unfiltered[-1] > 1000.0 * unfiltered[0]
    run = AdmittancePlant(10.0, stiffness_filter=stiffness_filter).simulate(**given)
    stored = energy(run, 10.0 * torch.eye(1).double())
    assert stored[-1] < 1e-2 * stored[0]
    assert len(run.interventions) > 0
    assert run.stiffness.max() > 100.0  # it is not that nothing is let through


@pytest.mark.parametrize(("dt", "efficiency"), [(1e-3, 0.5), (1e-2, 0.99), (5e-2, 0.0), (0.1, 0.9)])
def test_the_tank_never_gives_more_than_it_was_given(dt, efficiency, generator):
    """``H + T - W <= H_0 + T_0``: 1000 schedules in all, under random forces along random desired motions."""
    tank = EnergyTank(energy=0.02, energy_max=5.0, efficiency=efficiency)
    run, velocity = random_run(tank, dt, generator)
    held = run.force + (run.damping @ velocity.unsqueeze(-1)).squeeze(-1)
    start = run.deviation[:, :-1]
    step = run.desired_position.diff(dim=1)
    end = run.deviation[:, 1:] + step  # before the desired position moves on
    spring = run.stiffness[:, :-1]
    work = (held[:, :-1] * (end - start)).sum(-1)
    work = work + 0.5 * (quadratic(spring, end - step) - quadratic(spring, end))
    stored = energy(run, MASS) + run.tank_energy
    excess = stored[:, 1:] - work.cumsum(-1) - (energy(run, MASS)[:, :1] + 0.02)
    scale = stored[:, :1] + work.abs().cumsum(-1)
    assert (excess / scale).max() <= 1e-12
    assert run.tank_energy.min() >= 0.0
    assert run.tank_energy.max() <= 5.0
    emptied = run.tank_energy[run.filter_share < 1.0]  # the share was the largest the tank could pay
    assert emptied.max() <= 1e-12 * STIFFEST


def test_half_of_what_is_dissipated_settles_and_all_of_it_need_not():
    mass = 10.0 * torch.eye(1).double()
    stored = {}
    for efficiency in (0.5, 0.9999):
        tank = EnergyTank(energy=0.1, efficiency=efficiency)
        run = AdmittancePlant(10.0, stiffness_filter=tank).simulate(**unstable(4e-2, duration=16.0))
        stored[efficiency] = (energy(run, mass)[-1] / energy(run, mass)[0]).item()
    assert stored[0.5] < 1e-3
    assert stored[0.9999] > 0.9


def function_of(run, alpha):
    state = torch.cat([run.deviation, run.velocity], dim=-1)
    return 0.5 * quadratic(lyapunov_matrix(run.stiffness, run.damping, MASS, alpha), state)


@pytest.mark.parametrize(("dt", "share_of_limit"), [(1e-3, None), (1e-2, 0.95), (5e-2, None), (0.1, 0.95)])
def test_the_rate_limits_function_never_grows_without_a_force(dt, share_of_limit, generator):
    seed = generator.get_state()
    damping = schedules(250, 80, generator)[1]
    root = torch.linalg.inv(torch.linalg.cholesky(MASS))
    limit = float(torch.linalg.eigvalsh(root @ damping @ root.mT).min())
    alpha = None if share_of_limit is None else share_of_limit * limit
    generator.set_state(seed)
    run, _ = random_run(RateLimit(alpha), dt, generator, moving=False, pushed=False)
    function = function_of(run, 0.5 * limit if alpha is None else alpha)
    assert (function[:, 1:] / function[:, :-1]).max() <= 1.0 + 1e-12
    assert run.tank_energy is None


@pytest.mark.parametrize("dt", [1e-3, 1e-2, 5e-2, 0.1])
def test_with_the_rate_limit_forces_alone_feed_its_function(dt, generator):
    """By no more than ``f' (v + a y)`` over a tick, where the integral of y is ``K^-1 (f h - M dv - D dy)``."""
    run, _ = random_run(RateLimit(alpha=0.2), dt, generator, moving=False)
    deviation, velocity = run.deviation.diff(dim=1), run.velocity.diff(dim=1)
    force, stiffness, damping = run.force[:, :-1], run.stiffness[:, :-1], run.damping[:, :-1]
    pull = force * dt - velocity @ MASS - (damping @ deviation.unsqueeze(-1)).squeeze(-1)
    area = torch.linalg.solve(stiffness, pull.unsqueeze(-1)).squeeze(-1)
    fed = (force * (deviation + 0.2 * area)).sum(-1)
    function = function_of(run, 0.2)
    scale = function[:, 1:] + function[:, :-1] + fed.abs()
    assert ((function.diff(dim=1) - fed) / scale).max() <= 1e-12


@pytest.mark.parametrize("dt", [1e-3, 1e-2, 0.1])
def test_the_worst_force_cannot_break_the_rate_limit_nor_is_a_share_too_small(dt, generator):
    """The largest eigenvalue over all states and held forces is zero where a rise was held back.

    The integral of the deviation comes from a fourth block of the exponential here.
    """
    stiffness, damping = schedules(200, 2, generator)
    alpha = 0.03
    limit = RateLimit(alpha).start(stiffness, damping, MASS)
    nowhere = torch.zeros(200, 2).double()
    gains = []
    for k in (0, 1):
        limit.select(stiffness[:, k], damping[:, k], MASS, dt, nowhere)
        gains.append(SimpleNamespace(**dict(zip(("stiffness", "damping", "share"), limit.gains, strict=True))))
    before, after = gains
    rate = torch.zeros(200, 8, 8).double()
    rate[:, :6, :6] = admittance_rate(before.stiffness, before.damping, MASS)
    rate[:, 6:, :2] = torch.eye(2)
    tick = torch.linalg.matrix_exp(rate * dt)[..., :6]
    end, area = tick[:, :4], tick[:, 6:]
    fed = end[:, :2] - torch.eye(6)[:2] + alpha * area
    function = [lyapunov_matrix(gains.stiffness, gains.damping, MASS, alpha) for gains in (before, after)]
    growth = end.mT @ function[1] @ end
    growth[:, :4, :4] -= function[0]
    growth[:, 4:] -= fed
    growth[..., 4:] -= fed.mT
    scale = torch.tensor([STIFFEST**-0.5] * 2 + [1.0] * 2 + [1.0 / dt] * 2).double()
    worst = torch.linalg.eigvalsh(scale[:, None] * growth * scale)[:, -1]
    assert worst.max() <= 1e-12
    assert (after.share < 1.0).sum() > 20
    further = lyapunov_matrix(
        torch.lerp(before.stiffness, stiffness[:, 1], 1.001 * after.share[:, None, None]),
        torch.lerp(before.damping, damping[:, 1], 1.001 * after.share[:, None, None]), MASS, alpha,
    )  # fmt: skip
    growth = growth + end.mT @ (further - function[1]) @ end
    beyond = torch.linalg.eigvalsh(scale[:, None] * growth * scale)[:, -1]
    assert (beyond[after.share < 1.0] > 1e-10 * dt).all()


@pytest.mark.parametrize("stiffness_filter", [RateLimit(), EnergyTank()], ids=["rate limit", "tank"])
def test_what_falls_or_stays_is_not_held_back(stiffness_filter):
    stiffness = torch.linspace(1000.0, 50.0, 60).double().clamp_min(400.0)[:, None, None] * torch.eye(2)
    still = torch.zeros(60, 2).double()
    start = {"position0": torch.tensor([0.1, -0.2]).double()}
    given = {"stiffness": stiffness, "damping": damping_from_stiffness(stiffness), "dt": 0.01, **start}
    run = AdmittancePlant(stiffness_filter=stiffness_filter).simulate(still, still, **given)
    assert (run.filter_share == 1.0).all()
    assert len(run.interventions) == 0
    free = AdmittancePlant().simulate(still, still, **given)
    torch.testing.assert_close(run.position, free.position, rtol=1e-12, atol=1e-15)
    assert torch.equal(run.stiffness, stiffness)


def test_the_function_is_that_of_kronander_and_billard(generator):
    """``1/2 (v + a y)' M (v + a y) + 1/2 y' (K + a D - a^2 M) y``; its rate where K and D vary is theirs too."""
    stiffness, damping = schedules(5, 2, generator)
    y, v = torch.randn(2, 5, 2, 2, dtype=torch.float64, generator=generator)
    alpha = 0.7
    potential = quadratic(stiffness + alpha * damping - alpha**2 * MASS, y)
    expected = 0.5 * (quadratic(MASS, v + alpha * y) + potential)
    matrix = lyapunov_matrix(stiffness, damping, MASS, alpha)
    torch.testing.assert_close(0.5 * quadratic(matrix, torch.cat([y, v], dim=-1)), expected, rtol=1e-12, atol=0)
    rate = admittance_rate(stiffness, damping, MASS)[..., :4, :4]
    slope = quadratic(matrix @ rate, torch.cat([y, v], dim=-1))
    held = quadratic(alpha * MASS - damping, v) - alpha * quadratic(stiffness, y)
    torch.testing.assert_close(slope, held, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: EnergyTank(energy=-1.0), "energy is -1.0 J"),
        (lambda: EnergyTank(energy=11.0), "energy is 11.0 J, must be a finite number of at least 0 and at most 10"),
        (lambda: EnergyTank(efficiency=1.0), "efficiency is 1.0, must be a finite number of at least 0 and below 1"),
        (lambda: EnergyTank(energy_max=math.inf), "energy_max is inf"),
        (lambda: RateLimit(alpha=math.nan), "alpha is nan"),
    ],
)
def test_parameters_are_checked(make, words):
    with pytest.raises(ValueError, match=re.escape(words)):
        make()


@pytest.mark.parametrize(
    ("alpha", "lowest", "words"),
    [
        (5.0, 100.0, "below 4: leave it None"),
        (0.0, 100.0, "alpha is 0.0 1/s, must be a finite number above 0"),
        (1.0, 0.0, "must be a finite number above 0: a rate limit needs it"),
    ],
)
def test_a_rate_limit_needs_damping_and_stiffness(alpha, lowest, words):
    stiffness = torch.diag_embed(torch.tensor([[100.0, 200.0], [lowest, 200.0]]).double())
    damping = (4.0 * torch.eye(2).double()).expand(2, 2, 2)
    still = torch.zeros(2, 2).double()
    with pytest.raises(ValueError, match=re.escape(words)):
        AdmittancePlant(stiffness_filter=RateLimit(alpha)).simulate(still, still, stiffness, damping, dt=0.01)


def test_a_filtered_tick_is_the_transition_of_the_gains_it_reports(generator):
    """The rollout's gains are those in effect: moving on by them gives the next state."""
    run, velocity = random_run(EnergyTank(energy=0.01), 0.02, generator, n_schedules=20, n_ticks=50)
    maps = torch.linalg.matrix_exp(0.02 * admittance_rate(run.stiffness, run.damping, MASS))[..., :4, :]
    held = run.force + (run.damping @ velocity.unsqueeze(-1)).squeeze(-1)
    state = torch.cat([run.deviation, run.velocity, held], dim=-1).unsqueeze(-1)
    after = (maps @ state).squeeze(-1)[:, :-1]
    step = torch.nn.functional.pad(run.desired_position.diff(dim=1), (0, 2))
    expected = torch.cat([run.deviation, run.velocity], dim=-1)[:, 1:]
    torch.testing.assert_close(after - step, expected, rtol=1e-9, atol=1e-12)


def test_filters_need_whole_ticks():
    with pytest.raises(ValueError, match=r"substeps is 2, .* at most 1: .* filters act once a tick"):
        AdmittancePlant(stiffness_filter=EnergyTank(), substeps=2)

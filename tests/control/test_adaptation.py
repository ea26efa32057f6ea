"""Other goals and starts than those demonstrated: what acceleration and which places the record allows."""

import itertools
from functools import cache

import numpy as np
import pytest
import torch

from torch_pbd import CholeskyCovRegressor, Demonstrations, DMPController, load_demonstrations
from torch_pbd.control import DMP
from torch_pbd.control.primitive.dmp import _QUINTICS

SHARES = (0.0, 0.3, 0.5, 0.7, 0.9, 1.0, 1.8)  # of the way to the demonstrated goal
AWAY = np.array([[0.0, 0.0], [0.1, 0.0], [0.0, 0.1], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0], [1.0, 1.0]])


def minimum_jerk(share):
    u = np.clip(share, 0.0, 1.0)
    return 10.0 * u**3 - 15.0 * u**4 + 6.0 * u**5


def bump(share, cycles=0.0):
    return np.sin(np.pi * share) ** 2 * np.cos(2.0 * np.pi * cycles * share)


SHAPES = {
    "reaching": lambda u: (minimum_jerk(u), 0.0 * u),
    "fast at first": lambda u: (minimum_jerk(4.0 * u), 0.2 * bump(u)),
    "late": lambda u: (minimum_jerk(4.0 * u - 3.0), 0.3 * bump(u, 1.0)),
    "overshooting": lambda u: (minimum_jerk(u) + 0.4 * bump(u), minimum_jerk(u)),
    "cycles": lambda u: (minimum_jerk(u), 0.3 * bump(u, 3.0)),
    "closed": lambda u: (
        0.5 - 0.5 * np.cos(2.0 * np.pi * minimum_jerk(u)),
        0.5 * np.sin(2.0 * np.pi * minimum_jerk(u)),
    ),
}


@cache
def learned(shape, duration=2.0, *, units="m", offset=0.0, **parameters):
    time = np.linspace(0.0, duration, 101)
    path = np.column_stack(shape(time / duration))
    positions = [offset + scale * path for scale in (0.97, 0.99, 1.01, 1.03)]
    model = CholeskyCovRegressor(max_iter=2)
    return DMPController(model, cutoff=None, **parameters).fit(Demonstrations([time] * 4, positions, units=units))


def motion(controller, rate, **options):
    """Time, position and velocity of a schedule."""
    plan = controller.schedule(rate, limits=None, **options)
    return plan.time, plan.position, plan.velocity


def peak(time, velocity):
    return np.linalg.norm(np.gradient(velocity, time, axis=0), axis=1).max()


def judge(motion, recorded, blended, ends):
    """Peak acceleration over that of the record or of the blend; farthest out of the hull, over its extent."""
    (time, position, velocity), bound = motion, max(peak(motion[0], recorded[1]), peak(motion[0], blended))
    places = np.concatenate([recorded[0], ends])
    low, high = places.min(axis=0), places.max(axis=0)
    out = np.maximum(low - position, position - high) / np.where(high > low, high - low, 1.0)
    return peak(time, velocity) / bound, out.max()


def worst(controller, away, rate):
    """Largest of `judge` over goals and starts; the goal is reached, and the velocity is that of the position."""
    time, *plain = motion(controller, rate)
    way, share, found = controller.goal_ - controller.start_, (time / time[-1])[:, None], []
    for along, off in itertools.product(SHARES, away):
        goal, start = controller.start_ + along * way, controller.start_ + off
        _, position, velocity = motion(controller, rate, goal=goal, start=start)
        blended = plain[1] + (goal - controller.goal_ - off) * 30.0 * (share * (1.0 - share)) ** 2 / time[-1]
        found.append(judge((time, position, velocity), plain, blended, (start, goal)))
        np.testing.assert_allclose(position[[0, -1]], [start, goal], atol=1e-6)
        moved = np.trapezoid(velocity, time, axis=0)
        np.testing.assert_allclose(moved, goal - start, atol=1e-3 * np.ptp(plain[0], axis=0).max())
    return np.max(found, axis=0)


@pytest.mark.parametrize("name", SHAPES)
def test_72_no_goal_and_no_start_throw_the_robot(name):
    acceleration, out = worst(learned(SHAPES[name]), AWAY, 100.0)
    assert acceleration <= 1.5
    assert out <= 0.1


@pytest.mark.parametrize("duration", [1.0, 60.0])
def test_72_the_same_movement_in_another_time_is_the_same_path(duration):
    options = {"goal": [0.4, 0.1], "start": [-0.3, 0.2]}
    usual = learned(SHAPES["late"]).schedule(100.0, **options)
    other = learned(SHAPES["late"], duration).schedule(200.0 / duration, **options)
    np.testing.assert_allclose(other.position, usual.position, atol=1e-6)
    np.testing.assert_allclose(other.velocity * duration / 2.0, usual.velocity, atol=1e-5)


def test_72_the_papers_equation_does():
    """Goal 0.5 of a movement of 10 s by 1 m: the spring alone has (alpha beta) 0.5 = 78 m/s^2; recorded are 0.06."""
    thrown = learned(SHAPES["reaching"], 10.0, adaptation="additive").schedule(1000.0, goal=[0.5, 0.0])
    assert peak(thrown.time, thrown.velocity) == pytest.approx(0.5 * 25.0 * 6.25, rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["kuka_cube_pick", "kuka_cshape_top", "letter_G"])
def test_72_on_recordings(name, recordings):
    recorded = load_demonstrations(recordings / f"{name}.npz")
    controller = DMPController(CholeskyCovRegressor(max_iter=2))
    told = "cut while moving" if name.startswith("kuka") else "which is no known length"
    with pytest.warns(UserWarning, match=told):
        controller.fit(recorded)
    path = motion(controller, 100.0)[1]
    extent, axes = np.ptp(path, axis=0).max(), np.eye(path.shape[1])
    away = extent * np.concatenate([0.0 * axes[:1], 0.1 * axes, axes, -axes])
    acceleration, out = worst(controller, away, 200.0 / controller.duration_)
    assert acceleration <= 1.5
    assert out <= 0.1


@pytest.mark.parametrize("at", [0.1, 0.5, 0.98, 1.2])
@pytest.mark.parametrize("name", ["reaching", "fast at first", "late"])
def test_72_a_goal_that_changes_on_the_way_is_filtered(name, at):
    controller = learned(SHAPES[name])
    time, *recorded = motion(controller, 200.0, settle=2.0)
    ticks = time >= 2.0 * at
    for change in ([0.5, 0.0], [-1.0, 0.3]):
        goals = controller.goal_ + np.outer(ticks, change)
        moved = motion(controller, 200.0, settle=2.0, goal=goals)
        lasting = max(2.0 - 2.0 * at, 1.0)
        share = np.clip((time - time[ticks][0]) / lasting, 0.0, 1.0)[:, None]
        blended = recorded[1] + np.array(change) * 30.0 * (share * (1.0 - share)) ** 2 / lasting
        acceleration, out = judge(moved, recorded, blended, (goals[0], goals[-1]))
        assert acceleration <= 1.5
        assert out <= 0.15  # the motion under way has a speed of its own
        np.testing.assert_allclose(moved[1][~ticks], recorded[0][~ticks], atol=1e-14)
        np.testing.assert_allclose(moved[1][-1], goals[-1], atol=1e-9)
        assert np.abs(moved[2][-1]).max() < 1e-9


def test_a_goal_that_moves_at_every_tick_is_followed_smoothly():
    controller = learned(SHAPES["reaching"])
    time = motion(controller, 100.0, settle=4.0)[0]
    moving = np.minimum(0.1 * time, 0.3)[:, None]
    goals = controller.goal_ + moving
    _, position, velocity = motion(controller, 100.0, settle=4.0, goal=goals)
    np.testing.assert_allclose(np.gradient(position, time, axis=0)[1:-1], velocity[1:-1], atol=5e-3)
    assert peak(time, velocity) < 2.0 * peak(time, motion(controller, 100.0, settle=4.0)[2])
    np.testing.assert_allclose(position[-1], goals[-1], atol=1e-9)


def test_goals_and_starts_are_in_the_units_of_the_recordings():
    metres = learned(SHAPES["fast at first"]).schedule(100.0, goal=[0.4, 0.1], start=[0.2, 0.0])
    shape = SHAPES["fast at first"]
    controller = learned(lambda u: [1e3 * part for part in shape(u)], units="mm", offset=4e6)
    plan = controller.schedule(100.0, goal=[4e6 + 400.0, 4e6 + 100.0], start=[4e6 + 200.0, 4e6])
    np.testing.assert_allclose(plan.position - 4e3, metres.position, atol=1e-5)
    np.testing.assert_allclose(plan.velocity, metres.velocity, atol=1e-3)


def test_the_primitive_takes_start_and_goal_along():
    """A straight blend where the demonstration is one: closed form, in a batch."""
    time = torch.arange(1001).double() / 500.0
    rise = torch.tensor(minimum_jerk(time.numpy() / 2.0))[:, None]
    rate = 30.0 * ((time / 2.0) * (1.0 - time / 2.0))[:, None] ** 2 / 2.0
    change = 60.0 * (time / 2.0 * (1.0 - time / 2.0) * (1.0 - time))[:, None] / 4.0
    dmp, goal = DMP(duration=2.0), torch.ones(1).double()
    forcing = dmp.forcing(rise, rate, change, goal)
    starts, goals = (torch.tensor(ends).double() for ends in ([[0.0], [1.0], [-2.0]], [[[0.5]], [[1.0]], [[-2.0]]]))
    shown = {"demonstrated_start": torch.zeros(1).double(), "demonstrated_goal": goal}
    position, velocity = dmp.rollout(forcing, 0.002, goal=goals, position0=starts, **shown)
    expected = starts[:, None] + (goals - starts[:, None]) * rise
    torch.testing.assert_close(position, expected, rtol=0, atol=1e-5)
    torch.testing.assert_close(velocity, (goals - starts[:, None]) * rate, rtol=0, atol=1e-4)


def test_an_adapted_rollout_is_differentiable_and_a_batch_is_its_members(rng):
    forcing, start = (torch.tensor(rng.normal(size=shape)).requires_grad_() for shape in ((6, 1), (1,)))
    goals = torch.tensor(rng.normal(size=(3, 6, 1))).cumsum(1)
    goals[0, :5], goals[1, 2:] = goals[0, 0].clone(), goals[1, 2].clone()
    shown = {"demonstrated_start": torch.zeros(1).double(), "demonstrated_goal": torch.ones(1).double()}
    dmp = DMP(duration=0.5)

    def run(force, begin, goal=goals):
        return dmp.rollout(force, 0.1, goal=goal, position0=begin, **shown)

    batch = run(forcing, start)
    for member, goal in enumerate(goals):
        alone = run(forcing, start, goal)
        torch.testing.assert_close((batch[0][member], batch[1][member]), alone, rtol=1e-12, atol=1e-13)
    assert torch.autograd.gradcheck(run, (forcing, start))


def test_the_quintics_are_those_of_their_ends():
    """Unit position, velocity, acceleration at 0; at rest at 0 after 1; each row is the derivative of that before."""
    derivatives = [[np.polynomial.Polynomial(row) for row in rows] for rows in _QUINTICS]
    np.testing.assert_array_equal([[p(0.0) for p in rows] for rows in derivatives], np.eye(3))
    np.testing.assert_array_equal([[p(1.0) for p in rows] for rows in derivatives], np.zeros((3, 3)))
    for before, after in itertools.pairwise(derivatives):
        assert [p.deriv().trim() for p in before] == [p.trim() for p in after]

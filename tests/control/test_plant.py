"""The simulated robot against scipy and closed forms: exactness, orders, laws of a linear system, what acts in it."""

import math
import re

import numpy as np
import pytest
import scipy.linalg
import scipy.signal
import torch

from torch_pbd.control.filters import EnergyTank
from torch_pbd.control.matrices import damping_from_stiffness
from torch_pbd.control.simulation.plant import AdmittancePlant
from torch_pbd.control.simulation.sensor import ForceSensor, PositionLoop


def tensor(*values):
    return torch.tensor(values, dtype=torch.float64)


def turning(n_ticks, dt, d, low, high, rate):
    """Symmetric matrices (T, d, d) of eigenvalues between low and high, which vary while their axes turn."""
    time = torch.arange(n_ticks).double()[:, None] * dt
    share = 0.5 + 0.5 * torch.sin(rate * time + torch.arange(d))
    spin = torch.zeros(n_ticks, d, d).double()
    for axis in range(d - 1):
        spin[:, axis, axis + 1] = rate * time[:, 0] / (1 + axis)
    axes = torch.linalg.matrix_exp(spin - spin.mT)
    matrix = axes * (low * (high / low) ** share).unsqueeze(-2) @ axes.mT
    return 0.5 * (matrix + matrix.mT)


def task(n_ticks, dt, d, stiffest=1e4):
    """A desired motion, gains that turn and do not commute, and forces (..., T, d)."""
    time = torch.arange(n_ticks).double()[:, None] * dt
    turn = 3.0 * time + torch.arange(d)
    return {
        "position_desired": 0.2 * torch.sin(turn),
        "velocity_desired": 0.6 * torch.cos(turn),
        "stiffness": turning(n_ticks, dt, d, 50.0, stiffest, 14.0),
        "damping": turning(n_ticks, dt, d, 5.0, 90.0, -9.0),
        "force": 20.0 * torch.sin(7.0 * turn),
    }


def uneven(d):
    """A mass matrix, kg."""
    mass = torch.full((d, d), 0.3).double() + torch.diag(torch.linspace(0.4, 4.0, d).double())
    return tensor([0.5]) if d == 1 else mass


def scipy_run(mass, dt, position0, velocity0, position_desired, velocity_desired, stiffness, damping, force):
    """About the equilibrium of each tick, ``x_d + K^-1 (f + D v_d)``, by scipy's exponential of the free system."""
    n_ticks, d = force.shape
    inverse = np.linalg.inv(mass)
    state, states = np.r_[position0, velocity0], []
    for tick in range(n_ticks):
        states.append(state)
        pull = force[tick] + damping[tick] @ velocity_desired[tick]
        rest = np.r_[position_desired[tick] + np.linalg.solve(stiffness[tick], pull), np.zeros(d)]
        free = np.block([[np.zeros((d, d)), np.eye(d)], [-inverse @ stiffness[tick], -inverse @ damping[tick]]])
        state = rest + scipy.linalg.expm(free * dt) @ (state - rest)
    return np.array(states)[:, :d], np.array(states)[:, d:]


def usual_run(
    integrator, mass, dt, position_desired, velocity_desired, stiffness, damping, force, position0, velocity0
):
    """Positions by the integrators of simulators: rk4 (order 4), trapezoid (2), semi-implicit Euler (1)."""
    inverse, x, v, positions = torch.linalg.inv(mass), position0, velocity0, []
    for desired, speed, stiff, damp, push in zip(
        position_desired, velocity_desired, stiffness, damping, force, strict=True
    ):
        positions.append(x)

        def acceleration(x, v, desired=desired, speed=speed, stiff=stiff, damp=damp, push=push):
            return inverse @ (push + stiff @ (desired - x) + damp @ (speed - v))

        if integrator == "semi_implicit_euler":
            v = v + dt * acceleration(x, v)
            x = x + dt * v
        elif integrator == "trapezoid":
            half = 0.5 * dt * inverse
            left = torch.eye(len(x)).double() + half @ damp + 0.5 * dt * half @ stiff
            faster = torch.linalg.solve(left, v + half @ (2.0 * push + stiff @ (2.0 * (desired - x) - 0.5 * dt * v)
                                                          + damp @ (2.0 * speed - v)))  # fmt: skip
            x, v = x + 0.5 * dt * (v + faster), faster
        else:
            x1, v1 = v, acceleration(x, v)
            x2, v2 = v + 0.5 * dt * v1, acceleration(x + 0.5 * dt * x1, v + 0.5 * dt * v1)
            x3, v3 = v + 0.5 * dt * v2, acceleration(x + 0.5 * dt * x2, v + 0.5 * dt * v2)
            x4, v4 = v + dt * v3, acceleration(x + dt * x3, v + dt * v3)
            x, v = x + dt / 6.0 * (x1 + 2.0 * (x2 + x3) + x4), v + dt / 6.0 * (v1 + 2.0 * (v2 + v3) + v4)
    return torch.stack(positions)


@pytest.mark.parametrize(("d", "dt"), [(1, 1e-3), (2, 1e-3), (2, 1e-2), (3, 1e-2)])
def test_a_tick_is_exact_whatever_turns_in_it(d, dt):
    """To 1e-8 m against scipy, from 50 N/m to 1e4 N/m, where the usual integrator misses by far more than 0.1 mm."""
    given = task(250, dt, d)
    start = {"position0": torch.full((d,), 0.1).double(), "velocity0": torch.full((d,), -0.5).double()}
    reference = {name: value.numpy() for name, value in given.items()}
    position, velocity = scipy_run(uneven(d).numpy(), dt, *(value.numpy() for value in start.values()), **reference)
    run = AdmittancePlant(uneven(d)).simulate(**given, **start, dt=dt)
    np.testing.assert_allclose(run.position, position, rtol=0, atol=1e-8)
    np.testing.assert_allclose(run.velocity, velocity, rtol=0, atol=1e-7)
    assert abs(position).max() < 2.0
    # In full sight of what acts in the loop, none of which does: the other path through the code
    loop = AdmittancePlant(uneven(d), stiffness_filter=None, sensor=ForceSensor(range=math.inf))
    np.testing.assert_allclose(loop.simulate(**given, **start, dt=dt).position, position, rtol=0, atol=1e-8)
    usual = usual_run("semi_implicit_euler", uneven(d), dt, **given, **start)
    assert not ((usual - torch.tensor(position)).abs().max() < 1e-4)  # it may be infinite


@pytest.mark.parametrize("ratio", [0.3, 0.7, 1.0 - 1e-9, 1.0, 1.5, 20.0])
@pytest.mark.parametrize("dt", [1e-3, 1e-2])
def test_free_motion_is_the_closed_form(ratio, dt):
    """Of one axis, ``e^{-at} (cosh wt, sinh wt / w)``, for M = 0.5 kg and 1e4 N/m, below and above critical damping."""
    mass, stiffness = 0.5, 1e4
    time = dt * torch.arange(300).double()
    gains = {"stiffness": torch.full((300, 1, 1), stiffness).double()}
    gains["damping"] = damping_from_stiffness(gains["stiffness"], mass, ratio)
    still = torch.zeros(300, 1).double()
    run = AdmittancePlant(mass).simulate(still, still, **gains, dt=dt, position0=tensor(1.0), velocity0=tensor(-3.0))
    decay, frequency = ratio * math.sqrt(stiffness / mass), math.sqrt(stiffness / mass)
    spread = torch.tensor(complex(decay**2 - frequency**2)).to(torch.complex128).sqrt()
    slow, fast = torch.exp((spread - decay) * time), torch.exp((-spread - decay) * time)
    sine = 0.5 * (slow - fast) / spread if abs(spread) > 1e-6 * decay else time * slow
    expected = (0.5 * (slow + fast) + (decay - 3.0) * sine).real
    # Near critical damping the closed form itself has lost half its digits
    torch.testing.assert_close(run.position[:, 0], expected, rtol=0, atol=1e-9 if abs(ratio - 1.0) > 1e-6 else 1e-7)


@pytest.mark.parametrize(("integrator", "order"), [("semi_implicit_euler", 1.0), ("trapezoid", 2.0), ("rk4", 4.0)])
def test_other_integrators_converge_to_it_at_their_orders(integrator, order):
    """Inputs are held on a coarse grid of 20 ms; ticks are refined by repeating them."""
    given = task(50, 0.02, 2, stiffest=800.0)
    still = {"position0": given["position_desired"][0], "velocity0": given["velocity_desired"][0]}
    exact = AdmittancePlant(uneven(2)).simulate(**given, dt=0.02).position
    errors, refinements = [], [4, 8, 16, 32]
    for times in refinements:
        finer = {name: value.repeat_interleave(times, dim=0) for name, value in given.items()}
        positions = usual_run(integrator, uneven(2), 0.02 / times, **finer, **still)
        errors.append((positions[::times] - exact).abs().max().item())
    fitted = -np.polyfit(np.log(refinements), np.log(errors), 1)[0]
    assert fitted == pytest.approx(order, abs=0.2)
    same = {name: value.repeat_interleave(8, dim=0) for name, value in given.items()}
    again = AdmittancePlant(uneven(2)).simulate(**same, dt=0.02 / 8).position[::8]
    torch.testing.assert_close(again, exact, rtol=0, atol=1e-12)


@pytest.mark.parametrize("d", [1, 2, 3])
def test_a_constant_push_rests_where_the_spring_holds_it(d):
    stiffness = turning(1, 1.0, d, 50.0, 1000.0, 1.0).expand(1500, d, d)
    push = torch.linspace(5.0, -3.0, d).double()
    run = AdmittancePlant(2.0).simulate(
        torch.full((1500, d), 0.3).double(),
        torch.zeros(1500, d).double(),
        stiffness,
        damping_from_stiffness(stiffness, 2.0),
        push.expand(1500, d),
        dt=0.01,
    )
    torch.testing.assert_close(run.deviation[-1], torch.linalg.solve(stiffness[0], push), rtol=1e-10, atol=0)
    torch.testing.assert_close(run.position[0], torch.full((d,), 0.3).double(), rtol=0, atol=0)
    assert run.velocity[-1].abs().max() < 1e-12


def test_feed_forward_leaves_half_a_tick_of_lag_and_no_more():
    """The desired position stands still in a tick: on the average half a tick's motion behind, which goes with dt."""
    errors = []
    for dt in (8e-3, 4e-3, 2e-3):
        n_ticks = round(2.0 / dt)
        given = task(n_ticks, dt, 2, stiffest=500.0) | {"force": None}
        given["damping"] = damping_from_stiffness(given["stiffness"], uneven(2))
        acceleration = -9.0 * given["position_desired"]
        plant = AdmittancePlant(uneven(2), feed_forward=True)
        run = plant.simulate(**given, acceleration_desired=acceleration, dt=dt)
        errors.append(run.deviation.abs().max().item())
        # Half a tick at 0.6 m/s is 0.3 dt, and the gains that turn may double it
        assert errors[-1] < 0.6 * dt
        assert plant.simulate(**given, dt=dt).deviation[:-1].abs().max().item() < 0.6 * dt
    assert np.polyfit(np.log([4, 2, 1]), np.log(errors), 1)[0] == pytest.approx(1.0, abs=0.1)
    assert AdmittancePlant(uneven(2)).simulate(**given, dt=dt).deviation.abs().max() > 0.01


def test_a_batch_is_its_members_and_broadcasts(rng):
    given = task(40, 0.01, 2)
    given["force"] = torch.tensor(rng.normal(size=(3, 1, 40, 2)))
    given["stiffness"] = given["stiffness"] * tensor(0.5, 1.0)[:, None, None, None]
    starts = {"position0": torch.tensor(rng.normal(size=(2, 2)))}
    for hooks in ({}, {"stiffness_filter": EnergyTank(energy=0.1)}):
        run = AdmittancePlant(0.8, **hooks).simulate(**given, **starts, dt=0.01)
        assert run.position.shape == run.velocity.shape == run.deviation.shape == (3, 2, 40, 2)
        for k, j in np.ndindex(3, 2):
            one = given | {"force": given["force"][k, 0], "stiffness": given["stiffness"][j]}
            alone = AdmittancePlant(0.8, **hooks).simulate(**one, position0=starts["position0"][j], dt=0.01)
            torch.testing.assert_close(run.position[k, j], alone.position, rtol=1e-12, atol=1e-13)
            torch.testing.assert_close(run.force[k, j], alone.force, rtol=0, atol=0)


@pytest.mark.parametrize("hooks", [{}, {"position_loop": PositionLoop()}])
def test_rollouts_are_differentiable(hooks, generator):
    root = torch.randn(2, 3, 2, 2, dtype=torch.float64, generator=generator)
    motion = torch.randn(4, 3, 2, dtype=torch.float64, generator=generator)

    def positions(root, desired, velocity, force, start):
        stiffness, damping = root @ root.mT + torch.eye(2)
        plant = AdmittancePlant(0.7, **hooks)
        return plant.simulate(desired, velocity, stiffness, damping, force, dt=0.2, position0=start[0]).position

    inputs = [value.requires_grad_() for value in (root, *motion)]
    assert torch.autograd.gradcheck(positions, inputs)


def test_far_from_the_origin_nothing_is_lost():
    """To the last bit: the motion is reckoned from the desired position."""
    given = task(300, 0.01, 2)
    given["position_desired"] = (given["position_desired"] * 2**20).round() / 2**20  # so that a shift is exact
    shifted = given | {"position_desired": given["position_desired"] + 2.0**20}
    here, there = (AdmittancePlant(0.5).simulate(**each, dt=0.01) for each in (given, shifted))
    assert torch.equal(here.velocity, there.velocity)
    torch.testing.assert_close(there.position - 2.0**20, here.position, rtol=0, atol=2.0**-32)


def test_float32_stays_float32():
    given = {name: value.float() for name, value in task(20, 0.01, 2).items()}
    run = AdmittancePlant(uneven(2)).simulate(**given, dt=0.01)
    assert run.position.dtype == run.time.dtype == torch.float32


def test_the_position_loop_is_that_of_scipy():
    """The state behind a zero-order hold, one command late; scipy discretizes the loop."""
    dt, w = 1e-3, 2.0 * np.pi * 20.0
    given = task(400, dt, 1, stiffest=500.0)
    run = AdmittancePlant(position_loop=PositionLoop(bandwidth=20.0, delay_steps=3)).simulate(**given, dt=dt)
    system = (np.array([[0, 1], [-w * w, -2 * w]]), np.array([[0], [w * w]]), np.eye(2), np.zeros((2, 1)))
    a, b, *_ = scipy.signal.cont2discrete(system, dt, method="zoh")
    command = np.r_[np.full(3, run.position[0, 0]), run.commanded_position[:, 0]]
    state = np.array([run.position[0, 0], run.velocity[0, 0]])
    for tick in range(400):
        np.testing.assert_allclose([run.position[tick, 0], run.velocity[tick, 0]], state, rtol=1e-9, atol=1e-10)
        state = a @ state + b[:, 0] * command[tick]
    direct = AdmittancePlant().simulate(**given, dt=dt)  # no force depends on the position: the command is the same
    torch.testing.assert_close(run.commanded_position, direct.position, rtol=0, atol=1e-12)


@pytest.mark.parametrize("delay_steps", [0, 1, 4])
def test_the_position_loop_follows_a_ramp_late_by_its_lag(delay_steps):
    loop, dt = PositionLoop(bandwidth=10.0, delay_steps=delay_steps), 2e-3
    ramp, gain = 0.3 * dt * torch.arange(1000).double()[:, None], torch.full((1000, 1, 1), 400.0).double()
    plant = AdmittancePlant(position_loop=loop)
    run = plant.simulate(ramp, torch.full_like(ramp, 0.3), gain, damping_from_stiffness(gain), dt=dt)
    # What is left of the staircase behind the loop, 0.6 mm a tick, is a few nm
    lag = 1.0 / (math.pi * 10.0) + (delay_steps + 0.5) * dt
    assert (run.commanded_position - run.position)[-1].item() == pytest.approx(0.3 * lag, rel=0, abs=1e-8)


def test_a_biased_sensor_moves_the_axis_by_bias_over_stiffness():
    still = torch.zeros(400, 2).double()
    stiffness = torch.diag(tensor(50.0, 400.0)).expand(400, 2, 2)
    plant = AdmittancePlant(sensor=ForceSensor(bias=(0.5, -0.2)))
    run = plant.simulate(still, still, stiffness, damping_from_stiffness(stiffness), dt=2e-2)
    torch.testing.assert_close(run.position[-1], tensor(0.5 / 50.0, -0.2 / 400.0), rtol=1e-9, atol=0)
    assert (run.force == 0.0).all()
    assert not run.saturated.any()


class Wall:
    """A wall of 1e5 N/m and 100 N s/m across the first axis, at 0.01 m."""

    def force(self, position, velocity):
        inside = position[..., 0] > 0.01
        press = (1e5 * (position[..., 0] - 0.01) + 100.0 * velocity[..., 0]).clamp_min(0.0)
        return torch.stack([torch.where(inside, -press, 0.0), torch.zeros_like(press)], dim=-1)


def pressed(substeps, dt=2e-3, duration=0.06):
    """A robot that a force of 40 N drives into a wall of 1e5 N/m at 0.01 m."""
    n_ticks = round(duration / dt)
    still = torch.zeros(n_ticks, 2).double()
    stiffness = (100.0 * torch.eye(2).double()).expand(n_ticks, 2, 2)
    force = tensor(40.0, 0.0).expand(n_ticks, 2)
    plant = AdmittancePlant(1.0, environment=Wall(), substeps=substeps)
    return plant.simulate(still, still, stiffness, damping_from_stiffness(stiffness), force, dt=dt)


def test_substeps_are_shorter_ticks_with_inputs_repeated():
    several, shorter = (pressed(times, 2e-3 * times / 4, duration=0.3) for times in (4, 1))
    torch.testing.assert_close(several.position, shorter.position[::4], rtol=0, atol=1e-12)
    torch.testing.assert_close(several.force, shorter.force[::4], rtol=1e-9, atol=1e-9)
    rest = 0.01 + (40.0 - 100.0 * 0.01) / (1e5 + 100.0)  # the force against wall and spring
    assert several.position[-1, 0].item() == pytest.approx(rest, rel=1e-3)


def test_substeps_make_walls_accurate():
    truth = pressed(64).position
    errors = [(pressed(times).position - truth).abs().max().item() for times in (1, 4, 16)]
    assert errors[0] > 3.0 * errors[1] > 9.0 * errors[2] > 1e-4


GIVEN = task(5, 0.01, 2)


def changed(name, index, value):
    values = GIVEN[name].clone()
    values[index] = value
    return {name: values}


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (changed("force", (3, 0), math.nan), "force[3, 0] is nan, must be finite"),
        (changed("position_desired", (1, 1), math.inf), "position_desired[1, 1] is inf, must be finite"),
        (changed("velocity_desired", (4, 0), math.nan), "velocity_desired[4, 0] is nan, must be finite"),
        (changed("stiffness", (2, 0, 0), math.nan), "the largest entry of stiffness[2] is nan"),
        (changed("stiffness", (2, 0, 1), 1e9), "the asymmetry of stiffness[2] is "),
        (changed("damping", (1, 0, 0), -1e3), "the smallest eigenvalue of damping[1] is "),
        ({"force": GIVEN["force"][:4]}, "force has shape (4, 2)"),
        ({"force": GIVEN["force"][:, :1]}, "force has shape (5, 1)"),
        ({"damping": GIVEN["damping"][0]}, "damping has shape (2, 2)"),
        ({"stiffness": GIVEN["stiffness"][:4]}, "stiffness has shape (4, 2, 2)"),
        ({"position_desired": GIVEN["force"][:0]}, "position_desired has shape (0, 2)"),
        ({"dt": 0.0}, "dt is 0.0 s"),
        ({"dt": math.nan}, "dt is nan"),
        ({"position0": tensor(0.0, math.nan)}, "position0"),
        ({"velocity0": tensor(0.0, 1.0, 2.0)}, "velocity0"),
        ({"mass": uneven(3)}, "mass has shape (3, 3)"),
        ({"acceleration_desired": GIVEN["force"][:4]}, "acceleration_desired"),
    ],
)
def test_inputs_are_refused_by_name_and_tick(arguments, words):
    given = {**GIVEN, "dt": 0.01, **arguments}
    plant = AdmittancePlant(given.pop("mass", 1.0), feed_forward=True)
    with pytest.raises(ValueError, match=re.escape(words)):
        plant.simulate(**given)


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        ({"mass": 0.0}, "mass is 0.0 kg"),
        ({"mass": torch.diag(tensor(1.0, -1.0))}, "the smallest eigenvalue of mass is -1.0, must be above zero"),
        ({"substeps": 0}, "substeps is 0"),
        (
            {"substeps": 2, "sensor": ForceSensor()},
            "substeps is 2, must be an integer of at least 1 and at most 1: sensors, position loops",
        ),
    ],
)
def test_parameters_are_checked(parameters, words):
    with pytest.raises(ValueError, match=re.escape(words)):
        AdmittancePlant(**parameters)


@pytest.mark.parametrize(
    ("parameters", "words"), [({"bandwidth": 0.0}, "bandwidth is 0.0 Hz"), ({"delay_steps": -1}, "delay_steps is -1")]
)
def test_parameters_of_the_position_loop_are_checked(parameters, words):
    with pytest.raises(ValueError, match=re.escape(words)):
        PositionLoop(**parameters)


def test_as_arrays_it_is_the_same_run():
    run = AdmittancePlant(stiffness_filter=EnergyTank()).simulate(**GIVEN, dt=0.01)
    arrays = run.numpy()
    np.testing.assert_array_equal(arrays.deviation, run.deviation.numpy())
    np.testing.assert_array_equal(arrays.interventions, arrays.time[arrays.filter_share < 1.0])
    assert arrays.saturated is None
    assert len(AdmittancePlant().simulate(**GIVEN, dt=0.01).interventions) == 0


@pytest.mark.parametrize(
    ("name", "part", "problem"),
    [
        ("sensor", 3, "must be a ForceSensor or None"),
        ("position_loop", 20.0, "must be a PositionLoop or None"),
        ("environment", "wall", "must be an Environment or None"),
        ("stiffness_filter", 5, "must be a StiffnessFilter or None"),
        ("stiffness_filter", EnergyTank, "must be a StiffnessFilter or None"),
        ("sensor", ForceSensor, "must be a ForceSensor or None"),
    ],
)
def test_parts_of_other_kinds_are_refused_at_once(name, part, problem):
    unchecked = getattr(
        AdmittancePlant.__init__, "__wrapped__", AdmittancePlant.__init__
    )  # beartype would refuse first
    with pytest.raises(ValueError, match=rf"{name} is .* {problem}"):
        unchecked(AdmittancePlant.__new__(AdmittancePlant), **{name: part})

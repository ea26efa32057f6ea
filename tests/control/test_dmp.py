"""Dynamic movement primitives: round trip, integration against scipy, and laws of a linear system."""

import math
import re

import numpy as np
import pytest
import scipy.integrate
import scipy.signal
import torch

from torch_pbd.control.primitive.dmp import DMP

PAPER = {"alpha": 1.0, "beta": 1.0}
DEFAULT = {}


def tensor(*values):
    return torch.tensor(values, dtype=torch.float64)


def movement(time):
    """Position, velocity and acceleration (T, 3), smooth, and still moving at the end."""
    size, rate = tensor(0.3, 0.1, 0.02), tensor(0.7, 2.3, 9.0)
    angle = rate * time[:, None] + tensor(0.0, 1.0, 2.0)
    position = size * torch.sin(angle) + 0.06 * time[:, None]
    return position, size * rate * torch.cos(angle) + 0.06, -size * rate**2 * torch.sin(angle)


def ticks(n, dt):
    return torch.arange(n).double() * dt


@pytest.mark.parametrize(
    ("parameters", "gate"), [(PAPER, "none"), (DEFAULT, "time"), ({"alpha": 25.0, "tau": 10.0}, "phase")]
)
def test_the_forcing_of_a_demonstration_drives_it_again(parameters, gate):
    """10 s at 1 kHz to 1e-6 m: the forcing is linear between ticks, an error of second order."""
    position, velocity, acceleration = movement(ticks(10_001, 1e-3))
    dmp = DMP(**parameters, duration=10.0, gate=gate)
    goal = position[-1]
    forcing = dmp.forcing(position, velocity, acceleration, goal)
    start = {"position0": position[0], "velocity0": velocity[0]}
    again, speed = dmp.rollout(forcing, 1e-3, goal=goal, **start)
    torch.testing.assert_close(again, position, rtol=0, atol=1e-6)
    torch.testing.assert_close(speed, velocity, rtol=0, atol=1e-5)


@pytest.mark.parametrize("parameters", [PAPER, DEFAULT, {"alpha": 4.0, "beta": 9.0, "tau": 0.4}])
def test_forcing_that_is_linear_between_ticks_is_solved_to_rounding(parameters, rng):
    """scipy.signal.lsim is exact for inputs that are linear between samples."""
    dmp = DMP(**parameters)
    alpha, beta, tau, dt = dmp.alpha, dmp.beta, dmp.tau, 0.02
    forcing, goal, start, speed = rng.normal(size=200), 0.7, 0.2, -0.5
    system = ([[0, 1 / tau], [-alpha * beta / tau, -alpha / tau]], [[0], [1 / tau]], np.eye(2), np.zeros((2, 1)))
    time = dt * np.arange(200)
    _, expected, _ = scipy.signal.lsim(system, alpha * beta * goal + forcing, time, X0=[start, tau * speed])
    position, velocity = dmp.rollout(
        torch.tensor(forcing)[:, None],
        dt,
        goal=tensor(goal),
        position0=tensor(start),
        velocity0=tensor(speed),
    )
    np.testing.assert_allclose(position[:, 0], expected[:, 0], rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(velocity[:, 0], expected[:, 1] / tau, rtol=1e-9, atol=1e-10)


def convergence(dmp, forcing, sizes):
    """Order fitted over ticks of 1 s / size, of the largest error of the position."""
    errors = []
    position, velocity, _ = movement(ticks(1, 1.0))
    start = {"goal": torch.zeros(3).double(), "position0": position[0], "velocity0": velocity[0]}
    for size in sizes:
        time = ticks(4 * size + 1, 1.0 / size)
        again, _ = dmp.rollout(forcing(time), 1.0 / size, **start)
        errors.append((again - movement(time)[0]).abs().max().item())
    return -np.polyfit(np.log(sizes), np.log(errors), 1)[0]


@pytest.mark.parametrize("parameters", [PAPER, DEFAULT])
def test_the_order_of_convergence_under_an_active_forcing(parameters):
    dmp = DMP(**parameters)

    def forcing(time):
        return dmp.forcing(*movement(time), torch.zeros(3).double())

    assert convergence(dmp, forcing, [32, 64, 128, 256]) == pytest.approx(2.0, abs=0.1)

    def one_step_late(time):  # movement_primitives 0.9.1 has this defect
        return forcing(time - (time[1] - time[0]))

    assert convergence(dmp, one_step_late, [32, 64, 128, 256]) < 1.2


def test_a_smooth_forcing_is_that_of_an_adaptive_integrator():
    """With the gate closing on the way, against scipy's DOP853."""
    dmp = DMP(alpha=9.0, beta=3.0, tau=0.8, duration=1.5)

    def forcing(time):
        return torch.stack([torch.sin(3.0 * time), 5.0 * torch.exp(-time)], dim=-1)

    def rate(t, state):
        u = np.clip((t - 1.5) / 0.15, 0.0, 1.0)
        drive = (1.0 - (10.0 * u**3 - 15.0 * u**4 + 6.0 * u**5)) * np.array([np.sin(3.0 * t), 5.0 * np.exp(-t)])
        return np.r_[state[2:] / 0.8, (9.0 * (3.0 * (np.array([1.0, -1.0]) - state[:2]) - state[2:]) + drive) / 0.8]

    time = 1e-3 * np.arange(2501)
    options = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-14, "max_step": 0.02}
    expected = scipy.integrate.solve_ivp(rate, (0.0, 2.5), np.zeros(4), t_eval=time, **options).y
    goal = tensor(1.0, -1.0)
    position, velocity = dmp.rollout(forcing(ticks(2501, 1e-3)), 1e-3, goal=goal)
    np.testing.assert_allclose(position, expected[:2].T, rtol=0, atol=1e-5)  # the forcing is linear over 1 ms
    np.testing.assert_allclose(velocity, expected[2:].T / 0.8, rtol=0, atol=1e-4)


def test_one_tick_is_the_first_of_two():
    """That is the state at its start, which no forcing has acted on yet."""
    dmp, goal = DMP(tau=2.0), tensor(1.0)
    paths = [dmp.rollout(torch.ones(n, 1).double(), 1e-2, goal=goal)[0] for n in (1, 2)]
    assert paths[0].shape == (1, 1)
    torch.testing.assert_close(paths[0], paths[1][:1], rtol=0.0, atol=0.0)


def test_as_printed_a_new_goal_adds_a_step_response_that_never_passes_it():
    position, velocity, acceleration = movement(ticks(3001, 1e-3))
    dmp = DMP(tau=0.5, adaptation="additive")
    forcing = dmp.forcing(position, velocity, acceleration, position[-1])
    start = {"position0": position[0], "velocity0": velocity[0]}
    goals = position[-1].repeat(3001, 1)
    goals[800:] += tensor(0.5, -0.2, 0.1)
    before, _ = dmp.rollout(forcing, 1e-3, goal=position[-1], **start)
    after, _ = dmp.rollout(forcing, 1e-3, goal=goals, **start)
    response = (after - before) / (goals[-1] - goals[0])
    passed = (ticks(3001, 1e-3) - 0.8).clamp_min(0.0) * math.sqrt(25.0 * 6.25) / 0.5
    expected = 1.0 - (1.0 + passed) * torch.exp(-passed)  # of a critically damped system of the second order
    torch.testing.assert_close(response, expected[:, None].expand(3001, 3), rtol=0, atol=1e-10)
    assert response.diff(dim=0).min() >= -1e-12
    assert response.max() <= 1.0 + 1e-12


def test_the_papers_parameters_overshoot():
    """A damping ratio of 0.5: by exp(-pi / sqrt(3)), 16 %."""
    position, _ = DMP(**PAPER).rollout(torch.zeros(2001, 1).double(), 5e-3, goal=torch.ones(1).double())
    assert position.max().item() - 1.0 == pytest.approx(math.exp(-math.pi / math.sqrt(3.0)), rel=1e-5)


def test_twice_the_tau_is_the_same_path_at_half_the_speed(rng):
    forcing = torch.tensor(rng.normal(size=(51, 2)))
    between = torch.cat([torch.stack([forcing[:-1], 0.5 * (forcing[:-1] + forcing[1:])], dim=1).reshape(-1, 2),
                         forcing[-1:]])  # fmt: skip
    goal, velocity0 = tensor(1.0, 2.0), tensor(1.0, -1.0)
    position, velocity = DMP().rollout(forcing, 0.02, goal=goal, velocity0=velocity0)
    slow, half = DMP(tau=2.0).rollout(between, 0.02, goal=goal, velocity0=0.5 * velocity0)
    torch.testing.assert_close(slow[::2], position, rtol=1e-10, atol=1e-12)
    torch.testing.assert_close(half[::2], 0.5 * velocity, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize(("gate", "beyond"), [("none", 0.06 * 2.0 / 6.25), ("time", 0.0), ("phase", 0.0)])
def test_a_gate_brings_a_movement_to_rest_at_its_goal(gate, beyond):
    """Without one the forcing of a movement that ends at 0.06 m/s holds the robot ``tau v_end / beta`` beyond."""
    time = ticks(6001, 2e-3)
    position, zero = 0.06 * time[:, None], torch.zeros(6001, 1).double()
    dmp = DMP(tau=2.0, gamma=8.0, duration=4.0, gate=gate)
    goal = position[2000]
    forcing = dmp.forcing(position, zero + 0.06, zero, goal)
    forcing[2000:] = forcing[2000]
    where, speed = dmp.rollout(forcing, 2e-3, goal=goal, velocity0=zero[0] + 0.06)
    torch.testing.assert_close(where[:2001], position[:2001], rtol=0, atol=1e-10)
    assert where[-1].item() == pytest.approx(goal.item() + beyond, abs=1e-7)
    assert speed[-1].abs().item() < 1e-6


def test_phase_and_gates_are_closed_forms():
    time = ticks(501, 0.01)
    for tau, gamma in ((1.0, 0.7), (2.5, 3.0)):
        dmp = DMP(tau=tau, gamma=gamma, duration=2.0, gate="phase")
        leaf = time.clone().requires_grad_()
        phase = dmp.phase(leaf)
        (rate,) = torch.autograd.grad(phase.sum(), leaf)
        torch.testing.assert_close(tau * rate, -gamma * phase, rtol=1e-12, atol=0)  # eq. (17)
        assert phase[0] == 1.0
        after = (dmp.phase(time) / dmp.phase(tensor(2.0)[0])).clamp_max(1.0)
        torch.testing.assert_close(dmp.gate_at(time), after, rtol=1e-12, atol=0)
    assert DMP(gamma=0.7).phase(torch.tensor(10.0)).item() == pytest.approx(9.1e-4, rel=0.01)
    gate = DMP(duration=2.0).gate_at(time)
    assert gate[200] == 1.0
    assert gate[210].item() == pytest.approx(0.5, rel=1e-9)
    assert (gate[220:] == 0.0).all()
    assert (gate.diff() <= 0.0).all()
    for never in (DMP(), DMP(duration=2.0, gate="none")):
        assert (never.gate_at(time) == 1.0).all()


def test_a_batch_is_its_members(rng):
    forcing = torch.tensor(rng.normal(size=(4, 30, 2)))
    goal = torch.tensor(rng.normal(size=(4, 30, 2)))
    starts = {name: torch.tensor(rng.normal(size=(4, 2))) for name in ("position0", "velocity0")}
    position, velocity = DMP().rollout(forcing, 0.05, goal=goal, **starts)
    for k in range(4):
        one = {name: value[k] for name, value in starts.items()}
        alone = DMP().rollout(forcing[k], 0.05, goal=goal[k], **one)
        torch.testing.assert_close((position[k], velocity[k]), alone, rtol=1e-12, atol=1e-14)
    shared = DMP().rollout(forcing[0], 0.05, goal=goal[0], **starts)[0]
    one = {name: value[2] for name, value in starts.items()}
    torch.testing.assert_close(
        shared[2], DMP().rollout(forcing[0], 0.05, goal=goal[0], **one)[0], rtol=1e-12, atol=1e-14
    )


def test_rollouts_are_differentiable(rng):
    forcing, goal = (torch.tensor(rng.normal(size=shape)).requires_grad_() for shape in ((4, 2), (2,)))
    assert torch.autograd.gradcheck(lambda f, g: DMP().rollout(f, 0.1, goal=g), (forcing, goal))


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        ({"alpha": 0.0}, "alpha is 0"),
        ({"beta": -1.0}, "beta is -1"),
        ({"gamma": math.nan}, "gamma is nan"),
        ({"tau": math.inf}, "tau is inf"),
        ({"duration": 0.0}, "duration is 0"),
    ],
)
def test_parameters_are_checked(parameters, words):
    with pytest.raises(ValueError, match=re.escape(words)):
        DMP(**parameters)


STILL = torch.zeros(5, 2).double()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"dt": 0.0}, "dt is 0.0 s"),
        ({"dt": math.nan}, "dt is nan"),
        ({"goal": torch.zeros(3).double()}, "'goal': (1, 3)"),
        ({"goal": torch.zeros(4, 2).double()}, "'goal': (4, 2)"),
    ],
)
def test_arguments_of_a_rollout_are_checked(arguments, words):
    given = {"dt": 0.1, "goal": torch.zeros(2).double(), **arguments}
    with pytest.raises(ValueError, match=re.escape(words)):
        DMP().rollout(STILL, given.pop("dt"), **given)

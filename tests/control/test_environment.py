import math
import re

import numpy as np
import pytest
import torch

from torch_pbd.control.simulation import walls
from torch_pbd.control.simulation.walls import Tunnel, corridor
from torch_pbd.data import synthetic


@pytest.fixture
def straight(monkeypatch):
    """Makes the corridor straight, of half width 0.1 m; its slope is 0.75 unless set."""

    def make(slope=0.75):
        constant = torch.full_like
        monkeypatch.setattr(
            walls, "corridor", lambda y: (slope * y, constant(y, slope), constant(y, 0.1), constant(y, 0.0))
        )

    make()  # by default it leans: its walls' normals are (-0.8, 0.6) and (0.8, -0.6)
    return make


def tunnel_center(y):
    return corridor(y)[0]


def tunnel_half_width(y):
    return corridor(y)[2]


def tensor(*values):
    return torch.tensor(values, dtype=torch.float64)


def beyond(depth, y):
    """Points to the right of the task's right wall and to the left of its left wall, off it by depth along x."""
    center, half_width = tunnel_center(y), tunnel_half_width(y)
    return [torch.stack([center + side * (half_width + depth), y], dim=-1) for side in (1.0, -1.0)]


def press(tunnel, mass, push, dt, n_steps, position, velocity):
    """A free mass under a constant force, the wall's force held for a tick: exact between ticks."""
    positions, velocities = [], []
    for _ in range(n_steps):
        positions.append(position)
        velocities.append(velocity)
        acceleration = (push + tunnel.force(position, velocity)) / mass
        position = position + dt * velocity + 0.5 * dt**2 * acceleration
        velocity = velocity + dt * acceleration
    return torch.stack(positions), torch.stack(velocities)


def test_the_task_is_that_of_the_demonstrations():
    y = torch.linspace(-0.2, 0.8, 501).double()
    np.testing.assert_allclose(tunnel_center(y), synthetic.tunnel_center(y.numpy()), rtol=1e-12, atol=1e-16)
    np.testing.assert_allclose(tunnel_half_width(y), synthetic.tunnel_half_width(y.numpy()), rtol=1e-12, atol=0)
    assert tunnel_half_width(y.float()).dtype == torch.float32


@pytest.mark.usefixtures("straight")
def test_depth_and_normal_of_a_straight_wall_are_exact():
    along, inward = tensor(0.6, 0.8), tensor(-0.8, 0.6)
    on_wall = tensor(0.1, 0.0) + along * torch.linspace(-1, 1, 7)[:, None]
    depth = torch.linspace(-0.05, 0.3, 8).double()[:, None]
    position = on_wall - depth[..., None] * inward
    tunnel = Tunnel()
    torch.testing.assert_close(tunnel.penetration(position), depth.clamp_min(0).expand(8, 7), rtol=1e-12, atol=1e-15)
    torch.testing.assert_close(tunnel._contact(position)[1], inward.expand(8, 7, 2), rtol=1e-12, atol=0)
    torch.testing.assert_close(tunnel._contact(-position)[1], -inward.expand(8, 7, 2), rtol=1e-12, atol=0)


def test_depth_is_the_distance_from_a_curved_wall_to_first_order():
    y = torch.linspace(-0.1, 0.7, 33).double()
    fine = torch.linspace(-0.3, 0.9, 24001).double()
    errors = []
    for depth in (4e-3, 2e-3):
        worst = 0.0
        for position, wall in zip(beyond(depth, y), beyond(0.0, fine), strict=True):
            distance = torch.cdist(position, wall, compute_mode="donot_use_mm_for_euclid_dist").min(-1).values
            worst = max(worst, ((Tunnel().penetration(position) - distance) / distance).abs().max().item())
        errors.append(worst)
    assert errors[0] < 0.05
    assert errors[1] < 0.55 * errors[0]


def test_normals_are_unit_vectors_across_the_wall():
    y = torch.linspace(-0.1, 0.7, 32).double()
    step = 1e-6
    for here, ahead, behind in zip(beyond(0.0, y), beyond(0.0, y + step), beyond(0.0, y - step), strict=True):
        normal = Tunnel()._contact(here)[1]
        along = (ahead - behind) / (2 * step)
        torch.testing.assert_close(
            torch.linalg.vector_norm(normal, dim=-1), torch.ones(32).double(), rtol=1e-12, atol=0
        )
        assert ((normal * along).sum(-1)).abs().max() < 1e-8  # central differences
        assert (normal[:, 0] * (tunnel_center(y) - here[:, 0]) > 0).all()  # into the corridor


@pytest.mark.parametrize("curve", [0, 2])
def test_slopes_of_the_curves_are_those_of_autograd(curve):
    y = torch.linspace(-0.1, 0.7, 33).double().requires_grad_()
    curves = corridor(y)
    (slope,) = torch.autograd.grad(curves[curve].sum(), y)
    torch.testing.assert_close(curves[curve + 1].detach(), slope, rtol=1e-9, atol=1e-12)
    assert slope.abs().max() > 0.1


@pytest.mark.usefixtures("straight")
def test_a_mass_pressed_against_a_wall_rests_at_force_over_stiffness():
    push = 5.0 * tensor(0.8, -0.6)  # straight into the right wall
    tunnel = Tunnel(stiffness=2000.0)
    position, velocity = press(tunnel, 1.0, push, 1e-3, 1500, tensor(0.0, 0.0), tensor(0.0, 0.0))
    assert tunnel.penetration(position[-1]).item() == pytest.approx(5.0 / 2000.0, rel=1e-9)
    torch.testing.assert_close(tunnel.force(position[-1], velocity[-1]), -push, rtol=1e-9, atol=0)
    peak = tunnel.report(position, velocity, 1e-3).max_penetration.item()
    assert peak > 1.5 * 5.0 / 2000.0  # it came with speed


@pytest.mark.parametrize(
    ("mass", "damping", "rests"),
    [(1.0, 6.0, True), (1.0, 4.0, False), (0.051, 100.0, True), (0.049, 100.0, False)],
)
@pytest.mark.usefixtures("straight")
def test_a_held_wall_is_stable_between_the_limits_of_the_docstring(mass, damping, rests):
    # k h / 2 = 5 N s/m, and 2 m / h = 100 N s/m at 0.05 kg
    push = 50.0 * tensor(0.8, -0.6)
    rest = tensor(0.1, 0.0) + (50.0 / 1e4) * tensor(0.8, -0.6)
    start = rest + 1e-5 * tensor(0.8, -0.6)
    tunnel = Tunnel(stiffness=1e4, damping=damping)
    position, _ = press(tunnel, mass, push, 1e-3, 500, start, tensor(0.0, 0.0))
    error = torch.linalg.vector_norm(position - rest, dim=-1)
    assert (error[-100:].max() < 0.9 * error[:100].max()) == rests


def test_a_wall_pushes_and_never_pulls(rng):
    y = torch.tensor(rng.uniform(-0.1, 0.7, size=500))
    tunnel = Tunnel()
    for position in beyond(torch.tensor(rng.uniform(0.0, 0.01, size=500)), y):
        velocity = torch.tensor(rng.normal(size=(500, 2)))
        normal, depth = tunnel._contact(position)[1], tunnel.penetration(position)
        force = tunnel.force(position, velocity)
        press = 1e4 * depth - 100.0 * (velocity * normal).sum(-1)
        assert 100 < (press < 0).sum() < 400
        expected = press.clamp_min(0)[:, None] * normal
        torch.testing.assert_close(force, expected, rtol=1e-9, atol=1e-9)
    inside = torch.stack([tunnel_center(y) + 0.99 * tunnel_half_width(y), y], dim=-1)
    assert (tunnel.force(inside, torch.full_like(inside, 1.0)) == 0).all()


def test_walls_of_a_symmetric_corridor_are_mirror_images(rng, straight):
    straight(slope=0.0)
    tunnel = Tunnel()
    mirror = tensor(-1.0, 1.0)
    position = torch.tensor(rng.uniform([-0.2, 0.0], [0.2, 0.6], size=(200, 2)))
    velocity = torch.tensor(rng.normal(size=(200, 2)))
    force = tunnel.force(position, velocity)
    assert torch.equal(tunnel.force(mirror * position, mirror * velocity), mirror * force)
    assert 20 < force.any(-1).sum() < 180


def test_gradients_away_from_the_edge():
    tunnel = Tunnel(100.0)
    y = tensor(0.1, 0.25, 0.35, 0.5)
    for position in [*beyond(0.1, y), *beyond(-0.005, y)]:
        velocity = 0.1 * torch.sin(50 * position)
        inputs = (position.clone().requires_grad_(), velocity.requires_grad_())
        assert torch.autograd.gradcheck(tunnel.force, inputs)


def straight_path(x, vx, dt=0.1):
    """A path along x at y = 0, of the columns x and vx."""
    x, vx = tensor(*x), tensor(*vx)
    return torch.stack([x, 0 * x], -1), torch.stack([vx, 0 * vx], -1), dt


def test_a_report_of_a_path_made_by_hand(straight):
    straight(slope=0.0)
    tunnel = Tunnel(1000.0, 10.0)
    # starts in the wall, leaves it, touches the edge only, enters the right wall, leaves too fast to be pushed
    path = straight_path([0.12, 0.05, 0.10, 0.13, 0.11, 0.0], [0.0, -1.0, 1.0, 0.5, -2.0, -1.0])
    report = tunnel.report(*path)
    values = [report.max_penetration, report.time_in_wall, report.impulse]
    torch.testing.assert_close(torch.stack(values), tensor(0.03, 0.3, 0.1 * (20 + 35 + 0)), rtol=1e-12, atol=0)
    virtual = Tunnel(virtual=True)
    drawn = virtual.report(*path)
    assert (virtual.force(*path[:2]) == 0).all()
    assert drawn == (*report[:2], 0.0)


def test_a_report_has_a_value_for_each_rollout(rng):
    position = torch.tensor(rng.uniform([-0.2, 0.0], [0.2, 0.6], size=(2, 3, 50, 2)))
    velocity = torch.tensor(rng.normal(size=(2, 3, 50, 2)))
    batch = Tunnel().report(position, velocity, 0.01)
    for i, j in np.ndindex(2, 3):
        single = Tunnel().report(position[i, j], velocity[i, j], 0.01)
        for name in ("max_penetration", "time_in_wall", "impulse"):
            torch.testing.assert_close(getattr(batch, name)[i, j], getattr(single, name), rtol=1e-12, atol=0)


def test_what_is_not_finite_never_becomes_a_force_of_zero():
    tunnel = Tunnel()
    position, velocity = tensor([0.0, 0.3], [math.nan, 0.3], [0.0, math.nan]), torch.zeros(3, 2).double()
    assert tunnel.force(position, velocity).isnan().any(-1).tolist() == [False, True, True]
    assert tunnel.penetration(position).isnan().tolist() == [False, True, True]
    with pytest.raises(ValueError, match=re.escape("rollout_position[1, 0] is nan")):
        tunnel.report(position, velocity, 0.1)
    with pytest.raises(ValueError, match=re.escape("velocity[1, 0] is nan")):
        tunnel.report(velocity, position, 0.1)


def test_arguments_are_checked():
    for stiffness in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(ValueError, match="stiffness is "):
            Tunnel(stiffness)
    for damping in (-1.0, math.nan):
        with pytest.raises(ValueError, match="damping is "):
            Tunnel(damping=damping)
    path = torch.zeros(4, 2)
    for dt in (0.0, math.nan):
        with pytest.raises(ValueError, match="dt is "):
            Tunnel().report(path, path, dt)
    with pytest.raises(ValueError, match="none of it empty"):
        Tunnel().report(path[:0], path[:0], 0.1)
    with pytest.raises(ValueError, match=r"velocity has shape \(3, 2\), must have shape \(4, 2\)"):
        Tunnel().force(path, path[:3])

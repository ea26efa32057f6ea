"""What the robot may touch: the limit of the linear analysis against the simulated robot."""

import math

import pytest
import torch

from torch_pbd.control.matrices import damping_from_stiffness
from torch_pbd.control.simulation.plant import AdmittancePlant
from torch_pbd.control.simulation.sensor import ForceSensor, PositionLoop
from torch_pbd.control.stability.certify import stiffest_environment

DT = 1e-3


def gains(*stiffness, mass=1.0, ratio="paper"):
    matrix = torch.diag_embed(torch.tensor(stiffness, dtype=torch.float64))
    return matrix, damping_from_stiffness(matrix, mass, ratio)


class Springs:
    """Environments of several stiffnesses (n, 1), one for each run of a batch; they press and pull."""

    def __init__(self, stiffness):
        self.stiffness = stiffness

    def force(self, position, velocity):
        return -self.stiffness * position


def amplitudes(stiffness, damping, mass, loop, cutoff, environments):
    """How far each run strays in the first and the last half second of two, from 1 mm."""
    n_ticks = 2000
    still = torch.zeros(len(environments), n_ticks, 1).double()
    plant = AdmittancePlant(mass, position_loop=loop, sensor=ForceSensor(range=math.inf, cutoff=cutoff))
    plant.environment = Springs(torch.tensor(environments, dtype=torch.float64)[:, None])
    start = torch.full((len(environments), 1), 1e-3).double()
    held = (each.expand(n_ticks, 1, 1) for each in (stiffness, damping))
    strayed = plant.simulate(still, still, *held, dt=DT, position0=start).position.abs()[..., 0]
    return strayed[:, :500].amax(-1), strayed[:, -500:].amax(-1)


@pytest.mark.parametrize(
    ("mass", "ratio", "loop", "cutoff"),
    [
        (1.0, "paper", PositionLoop(20.0), 500.0),
        (3.0, 1.0, PositionLoop(50.0, 3), 125.0),
        (0.5, 0.7, PositionLoop(20.0, 0), None),
    ],
)
def test_a_softer_environment_is_stable_and_a_stiffer_is_not(mass, ratio, loop, cutoff):
    stiffness, damping = gains([50.0], mass=mass, ratio=ratio)
    limit = stiffest_environment(stiffness, damping, mass * torch.eye(1).double(), loop, cutoff, DT)
    first, last = amplitudes(stiffness[0], damping[0], mass, loop, cutoff, [0.9 * limit, 1.1 * limit])
    assert last[0] < 0.8 * first[0]
    assert last[1] > 1.25 * first[1]


@pytest.mark.parametrize(
    ("bandwidth", "ratio", "expected"), [(20.0, "paper", 403.0), (50.0, "paper", 776.0), (20.0, 1.0, 838.0)]
)
def test_the_limits_are_about_damping_over_lag(bandwidth, ratio, expected):
    """1 kg on 50 N/m at 1 kHz behind a sensor of 500 Hz and one tick: 403 to 838 N/m, and the rule within a fifth."""
    stiffness, damping = gains([50.0], ratio=ratio)
    loop = PositionLoop(bandwidth)
    limit = stiffest_environment(stiffness, damping, torch.eye(1).double(), loop, 500.0, DT)
    assert limit == pytest.approx(expected, rel=0.1)
    lag = 1.0 / (math.pi * bandwidth) + 1.5 * DT + 1.0 / (2.0 * math.pi * 500.0)
    assert limit == pytest.approx(damping.item() / lag, rel=0.2)


def test_the_softest_axis_of_a_schedule_decides(generator):
    """Turned by any angle, and whatever the order: the limit is that of the axis with the least damping."""
    stiffness, damping = gains([1000.0, 800.0], [50.0, 400.0], [200.0, 300.0])
    alone = stiffest_environment(*gains([50.0]), torch.eye(1).double(), PositionLoop(), 500.0, DT)
    axes = torch.linalg.qr(torch.randn(3, 2, 2, dtype=torch.float64, generator=generator)).Q
    turned = [axes @ each @ axes.mT for each in (stiffness, damping)]
    for each in ((stiffness, damping), turned):
        limit = stiffest_environment(*each, torch.eye(2).double(), PositionLoop(), 500.0, DT)
        assert limit == pytest.approx(alone, rel=1e-6)


@pytest.mark.parametrize("dt", [1e-3, 1e-4])
def test_of_an_ideal_robot_the_tick_is_what_is_left(dt):
    """Its command takes effect a tick late, and a force is held for one: 1.5 ticks of lag."""
    stiffness, damping = gains([50.0], ratio=1.0)
    limit = stiffest_environment(stiffness, damping, torch.eye(1).double(), PositionLoop(1e6, 0), None, dt)
    assert limit == pytest.approx(damping.item() / (1.5 * dt), rel=0.02)

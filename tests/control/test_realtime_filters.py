"""Filters of the stiffness in the loop: those of the simulation, without torch."""

import math
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from control.loops import MASS, arm_inertia, constant, make_pose_schedule, make_schedule
from scipy.spatial.transform import Rotation

from torch_pbd.control import AdmittancePlant, EnergyTank, RateLimit, simulate
from torch_pbd.control.realtime import RealTimeAdmittance, TickStatus

QUIET = {"soft_start": 0.0, "spring_limit": 1e6}


@pytest.mark.parametrize(
    "wanted", [EnergyTank(energy=0.02), EnergyTank(energy_max=0.05, efficiency=0.9), RateLimit(alpha=0.8)]
)
@pytest.mark.parametrize(("d", "mass"), [(1, MASS), (2, MASS), (3, np.diag([0.5, 0.8, 1.0]) + 0.1)])
def test_over_the_same_ticks_a_filter_does_what_it_does_in_the_simulation(wanted, d, mass, rng):
    n = 300  # the end is slowed
    schedule = make_schedule(d, duration=0.7).with_inertia(mass, 0.3)
    push = 20.0 * np.sin(np.outer(np.arange(n) / 50, rng.uniform(1.0, 3.0, size=d)))
    arrays = [getattr(schedule, name)[:n] for name in ("position", "velocity", "stiffness", "damping")]
    told = AdmittancePlant(mass, stiffness_filter=wanted).simulate(*arrays, push, dt=0.001).numpy()
    controller = RealTimeAdmittance(schedule, stiffness_filter=wanted, **QUIET)
    controller.start(0.0, velocity=schedule.velocity[0])
    held = 0
    for i in range(n - 1):
        assert controller.tick((i + 1) / 1000, push[i]) == 0
        held += controller.filter_share < 1.0
        np.testing.assert_allclose(controller.filter_share, told.filter_share[i], rtol=0, atol=1e-9)
        for name in ("stiffness", "damping"):
            whole = getattr(told, name)[i]
            np.testing.assert_allclose(getattr(controller, name), whole, rtol=0, atol=1e-9 * np.abs(whole).max())
        np.testing.assert_allclose(controller.position, told.position[i + 1], rtol=0, atol=1e-9 * np.ptp(told.position))
    assert 10 < held < n - 10
    assert (controller.tank_energy is None) == isinstance(wanted, RateLimit)


def swinging(schedule):
    """The same rows without motion, whose stiffness doubles and halves 8 times a second along each axis in turn."""
    time, d = schedule.time, schedule.n_outputs
    swing = np.sin(50.0 * time[:, None] + np.arange(d))
    if d == 6:
        swing[:, 4:] = swing[:, 3:4]  # springs that differ about axes are no potentials
    scale = 2.0 ** (0.5 * swing)
    base = np.diag([*[300.0] * min(d, 3), *[20.0] * (d - 3)])
    stiffness = scale[:, :, None] * base * scale[:, None, :]
    return replace(schedule, stiffness=stiffness, damping=stiffness)


def stored(controller, schedule, mass, limits):
    """Energy of tank, robot and springs in J; each spring's is quadratic up to a pull that its stiffest row defines."""
    off = np.array(controller.position) - schedule.position[0]
    if schedule.orientation is not None:
        here, rest = (
            Rotation.from_quat(q, scalar_first=True) for q in (controller.orientation, schedule.orientation[0])
        )
        off = np.append(off, (here * rest.inv()).as_rotvec())
    total = controller.tank_energy + 0.5 * np.array(controller.velocity) @ mass @ controller.velocity
    for block, limit in zip(schedule.blocks, limits, strict=True):
        top = np.linalg.norm(schedule.stiffness[:, block, block], 2, axis=(1, 2)).max() / limit**2
        stretch = off[block] @ controller._motion.gains[0][block, block] @ off[block]
        total += 0.5 * stretch if top * stretch <= 1.0 else math.sqrt(stretch / top) - 0.5 / top
    return total


@pytest.mark.parametrize("limits", [(1e6,), (15.0,), (1e6, 1e6), (15.0, 2.0)])
def test_what_a_tank_holds_and_the_robot_has_never_grows_whatever_the_ticks(limits, rng):
    """Also where springs are limited, on poses each by itself."""
    is_pose, pull = len(limits) == 2, limits if len(limits) == 2 else limits[0]
    still = make_pose_schedule(1.0, still=True, inertia=1.0) if is_pose else make_schedule(2, duration=1.0)
    still = replace(still, position=0.0 * still.position + still.position[0], velocity=0.0 * still.velocity)
    mass = arm_inertia(np.zeros(1))[0] if is_pose else np.array([[2.0, 0.5], [0.5, 1.0]])
    schedule = swinging(still).with_inertia(mass, 0.1)
    options = {"velocity_limit": (1e3, 1e3) if is_pose else 1e3, "soft_start": 0.0, "max_step": 0.1}
    tank = EnergyTank(energy=0.02, energy_max=0.02, efficiency=0.2)
    controller = RealTimeAdmittance(schedule, stiffness_filter=tank, spring_limit=pull, **options)
    turned = Rotation.from_rotvec([0.4, -0.3, 0.2])
    turn = {}
    if is_pose:
        rest = Rotation.from_quat(schedule.orientation[0], scalar_first=True)
        turn = {"orientation": (turned * rest).as_quat(scalar_first=True)}
    d = schedule.n_outputs
    controller.start(0.0, schedule.position[0] + 0.15, 0.2 * rng.normal(size=d), **turn)
    now, shares, energies = 0.0, [], [stored(controller, schedule, mass, limits)]
    for step in np.exp(rng.uniform(np.log(1e-4), np.log(0.01), size=250)):
        controller.tick(now := now + step, [0.0] * d)
        shares.append(controller.filter_share)
        energies.append(stored(controller, schedule, mass, limits))
    assert (np.diff(energies) <= 1e-13 * energies[0]).all()
    assert np.count_nonzero(np.array(shares) < 0.99) > 10
    assert controller.faults == (TickStatus.SPRING_LIMITED if limits[0] < 1e6 else 0)


def test_a_filter_without_a_proof_is_refused():
    varying, one = make_pose_schedule(0.05), make_pose_schedule(0.05, inertia=2.0)
    for schedule, wanted, words in [
        (varying, RateLimit(), "stiffness_filter is RateLimit.*, must be an EnergyTank for poses and masses that vary"),
        (one, RateLimit(), "stiffness_filter is RateLimit.*, must be an EnergyTank for poses and masses that vary"),
        (constant(100.0, 10.0), RateLimit(alpha=10.0), "alpha is 10.0 1/s, must be .* above 0 and below 10: leave it"),
        (constant(0.0, 10.0), RateLimit(), "smallest eigenvalue of stiffness is 0.0 N/m, must be .* above 0: a rate"),
        (one, "tank", "stiffness_filter is 'tank', must be a StiffnessFilter"),
    ]:
        with pytest.raises(ValueError, match=words):
            RealTimeAdmittance(schedule, stiffness_filter=wanted)


@pytest.mark.parametrize("wanted", [EnergyTank(), RateLimit()])
def test_faults_do_not_disturb_a_filter(wanted):
    schedule = make_schedule(2, duration=1.0)
    controller = RealTimeAdmittance(schedule, mass=MASS, stiffness_filter=wanted, velocity_limit=2.0)
    np.testing.assert_array_equal(controller.stiffness, schedule.stiffness[0])
    for at in (0.0, 0.5):
        controller.start(0.0, at=at)
        np.testing.assert_array_equal(controller.stiffness, schedule.stiffness[round(1000 * at)])
        for i in range(1, 300):
            now = i / 1000 + (i > 100) * 0.5
            controller.tick(math.nan if i == 150 else now, [math.nan if i % 50 == 0 else 20.0, -20.0])
            assert np.isfinite([*controller.position, *controller.velocity]).all()
            assert 0.0 <= controller.filter_share <= 1.0
    assert controller.faults & TickStatus.CLOCK


def test_filters_in_the_loop_need_no_torch():
    program = """
import sys
import numpy as np
from torch_pbd.control import EnergyTank, RateLimit, RealTimeAdmittance, Schedule
rows, still = np.stack([np.diag([100.0, 200.0]), np.diag([1000.0, 200.0])]), np.zeros((2, 2))
for wanted in (EnergyTank(), RateLimit()):
    schedule = Schedule([0.0, 1.0], still, still, rows, rows, rows, [0, 0])
    controller = RealTimeAdmittance(schedule, stiffness_filter=wanted)
    controller.start(0.0, [0.1, 0.2])
    for i in range(1, 100):
        controller.tick(i / 1000, (1.0, 2.0))
print([name for name in ("torch", "scipy", "sklearn") if name in sys.modules])
"""
    ran = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert ran.stdout.strip() == "[]"


@pytest.mark.parametrize("wanted", [None, EnergyTank(energy_max=1e-4, efficiency=0.05)])
def test_on_poses_along_an_inertia_the_loop_is_the_plant_of_torch_to_first_order(wanted):
    """Halving the push halves deviations, and the difference between the two relative to them."""
    n, still = 400, make_pose_schedule(1.0)  # the end is slowed
    swing = 2.0 ** (0.5 * np.sin(80.0 * still.time))[:, None, None]
    schedule = replace(still, stiffness=swing * still.stiffness).with_inertia(arm_inertia(still.time), 0.3)
    differences = []
    for size in (0.5, 0.25):
        push = size * np.outer(np.sin(np.arange(len(schedule)) / 40) ** 2, [10.0, -8.0, 6.0, 1.2, 0.8, -1.0])
        plant = AdmittancePlant(None, stiffness_filter=wanted)
        told = simulate(schedule, push, plant=plant)
        controller = RealTimeAdmittance(schedule, stiffness_filter=wanted, soft_start=0.0)
        controller.start(0.0, velocity=schedule.velocity[0])
        off, shares = [], []
        for i in range(n):
            assert controller.tick((i + 1) / 1000, push[i]) == 0
            shares.append(controller.filter_share)
            turn, plain = (
                Rotation.from_quat(q, scalar_first=True) for q in (controller.orientation, told.orientation[i + 1])
            )
            off.append([*(controller.position - told.position[i + 1]), *(turn * plain.inv()).as_rotvec()])
        away = np.linalg.norm(told.deviation[: n + 1, 3:], axis=1).max()
        differences.append(np.linalg.norm(np.array(off)[:, 3:], axis=1).max() / away)
        assert away > 0.05 * size
        if wanted is not None:
            assert min(shares) < 0.9
            np.testing.assert_allclose(shares[:40], told.filter_share[:40], rtol=0, atol=0.02)
    assert differences[0] < 0.03
    assert differences[1] < 0.7 * differences[0]

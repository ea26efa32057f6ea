"""Actions for robosuite's controller against its own law, and in its own simulation where it is installed."""

import numpy as np
import pytest
from arm_tasks import made_schedule, on_arm

from torch_pbd import rotations
from torch_pbd.control import Schedule
from torch_pbd.robots.robosuite import CONTROLLER, to_actions

FREQUENCY = 50.0


def diagonal_schedule(position, orientation, duration=3.0, mass=1.0):
    time = np.arange(round(duration * FREQUENCY) + 1) / FREQUENCY
    s, way = time / duration, np.array([0.1, 0.1, 0.08, 0.1, -0.1, 0.6])
    share = 10.0 * s**3 - 15.0 * s**4 + 6.0 * s**5
    speed = (30.0 * s**2 - 60.0 * s**3 + 30.0 * s**4) / duration
    rise = (60.0 * s - 180.0 * s**2 + 120.0 * s**3) / duration**2
    gains = np.array([np.diag(level) for level in np.linspace([150, 200, 250, 150, 200, 300], 280.0, len(time))])
    return Schedule(
        time, position + np.outer(share, way[:3]), np.outer(speed, way), gains, gains, 0.0 * gains, 0.0 * time,
        acceleration=np.outer(rise, way),
        orientation=rotations.multiply(rotations.exp(np.outer(share, way[3:])), orientation),
    ).with_inertia(mass)  # fmt: skip


@pytest.mark.parametrize("mass", [1.0, 2.5])
def test_the_controllers_law_is_that_of_the_schedule(mass, rng):
    """kp (goal - x) - kd v, with kd = 2 ratio kp^1/2, is the acceleration of eq. (15) with the desired velocity."""
    schedule = diagonal_schedule(np.array([0.4, 0.0, 0.5]), np.array([0.0, 1.0, 0.0, 0.0]), mass=mass)
    ratio, kp, goal, turn = np.split(to_actions(schedule, FREQUENCY), [6, 12, 15], axis=1)
    offset, velocity = rng.normal(size=(2, len(schedule), 6))
    turned = rotations.multiply(rotations.exp(turn), rotations.conjugate(schedule.orientation))
    error = np.hstack([goal - schedule.position, rotations.log(turned)]) - offset
    found = kp * error - 2.0 * ratio * np.sqrt(kp) * velocity
    spring = np.einsum("nij,nj->ni", schedule.stiffness, -offset)
    damper = np.einsum("nij,nj->ni", schedule.damping, schedule.velocity - velocity)
    np.testing.assert_allclose(found, (spring + damper) / mass + schedule.acceleration, rtol=0, atol=1e-9)


def test_an_arms_inertia_is_refused_and_what_is_lost_is_told():
    pytest.importorskip("mujoco")
    from torch_pbd.robots import panda

    schedule, _ = on_arm(made_schedule(duration=1.0, rate=50.0), panda())
    with pytest.raises(ValueError, match=r"give schedule\.with_inertia\(1\.0\)"):
        to_actions(schedule)
    with pytest.warns(UserWarning, match="diagonal gains lose"):
        to_actions(schedule.with_inertia(1.0))
    stiff = made_schedule(duration=1.0, rate=50.0, stiffness=(200.0, 4000.0))
    with (
        pytest.raises(ValueError, match=r"kp\[\d+, \d\] is .*, must be above zero and at most 3000"),
        pytest.warns(UserWarning, match="diagonal gains"),
    ):
        to_actions(stiff.with_inertia(1.0))


def test_damping_beyond_the_controllers_limits_is_refused():
    schedule = diagonal_schedule(np.array([0.4, 0.0, 0.5]), np.array([0.0, 1.0, 0.0, 0.0]))
    assert to_actions(schedule.with_inertia(1.0, damping_ratio=10.0))[:, :6].max() == pytest.approx(10.0)
    with pytest.raises(ValueError, match=r"damping_ratio\[0, 0\] is 12\..*, must be at most 10: give"):
        to_actions(schedule.with_inertia(1.0, damping_ratio=12.0))


def test_in_robosuite_the_arm_is_on_its_way():
    """Of the real library: 2 mm at 20 Hz, at which goals stand still for 50 ms."""
    robosuite = pytest.importorskip("robosuite")
    parts = {"right": {**CONTROLLER, "gripper": {"type": "GRIP"}}}
    env = robosuite.make(
        "Lift", robots="Panda", controller_configs={"type": "BASIC", "body_parts": parts}, control_freq=20,
        has_renderer=False, has_offscreen_renderer=False, use_camera_obs=False, initialization_noise=None,
    )  # fmt: skip
    env.reset()
    data, site = env.sim.data, env.robots[0].eef_site_id["right"]

    def pose():
        return data.site_xpos[site].copy(), rotations.from_matrix(data.site_xmat[site].reshape(3, 3))

    schedule, found = diagonal_schedule(*pose()), []
    for action in to_actions(schedule, env.control_freq):
        found.append(pose())
        env.step(np.append(action, 0.0))  # and the gripper
    position, orientation = map(np.array, zip(*found, strict=True))
    desired = schedule.resample(env.control_freq)
    turn = rotations.log(rotations.multiply(orientation, rotations.conjugate(desired.orientation)))
    assert np.linalg.norm(position - desired.position, axis=1).max() < 5e-3
    assert np.linalg.norm(turn, axis=1).max() < 0.03

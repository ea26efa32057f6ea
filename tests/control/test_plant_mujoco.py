"""The simulated robot against another simulator: MuJoCo's error falls with its own time step, at its own order.

A mass on two slides, the impedance as a passive force: MuJoCo evaluates it wherever its integrator asks. Desired
motion, gains and pushes are held over ticks of 10 ms in both, for 10 s.
"""

import numpy as np
import pytest
import torch

from torch_pbd.control.matrices import damping_from_stiffness
from torch_pbd.control.simulation.plant import AdmittancePlant

mujoco = pytest.importorskip("mujoco")

TICK, N_TICKS, MASS = 0.01, 1000, 1.5


def bench():
    """Desired motion, gains that turn and range from 50 to 1000 N/m, and two half-sine-squared pushes of 5 N."""
    time = TICK * torch.arange(N_TICKS).double()
    angle = 0.8 * time
    axes = torch.stack([angle.cos(), -angle.sin(), angle.sin(), angle.cos()], dim=-1).unflatten(-1, (2, 2))
    along = torch.stack([525.0 - 475.0 * torch.cos(0.9 * time), 200.0 + 150.0 * torch.sin(2.0 * time)], dim=-1)
    stiffness = axes * along.unsqueeze(-2) @ axes.mT
    stiffness = 0.5 * (stiffness + stiffness.mT)
    pulse = sum(
        torch.where((time - at).abs() < 0.4, torch.cos(torch.pi * (time - at) / 0.8) ** 2, 0.0) for at in (2.0, 8.0)
    )
    return {
        "position_desired": torch.stack([0.02 * torch.sin(time), 0.06 * time], dim=-1),
        "velocity_desired": torch.stack([0.02 * torch.cos(time), torch.full_like(time, 0.06)], dim=-1),
        "stiffness": stiffness,
        "damping": damping_from_stiffness(stiffness, MASS, 0.7),
        "force": 5.0 * pulse[:, None] * torch.tensor([1.0, -0.5]).double(),
    }


def mujoco_run(given, integrator, steps_a_tick):
    """Positions (T, 2) at the start of ticks."""
    model = mujoco.MjModel.from_xml_string(f"""
        <mujoco>
          <option timestep="{TICK / steps_a_tick}" integrator="{integrator}" gravity="0 0 0"/>
          <worldbody><body>
            <inertial pos="0 0 0" mass="{MASS}" diaginertia="1 1 1"/>
            <joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 1 0"/>
          </body></worldbody>
        </mujoco>""")
    data = mujoco.MjData(model)
    desired, speed, stiffness, damping, push = (value.numpy() for value in given.values())
    data.qpos[:], data.qvel[:] = desired[0], speed[0]
    positions, tick = np.empty((N_TICKS, 2)), 0

    def impedance(model, data):
        pull = stiffness[tick] @ (desired[tick] - data.qpos) + damping[tick] @ (speed[tick] - data.qvel)
        data.qfrc_passive[:] = pull + push[tick]

    mujoco.set_mjcb_passive(impedance)
    try:
        for tick in range(N_TICKS):  # the callback reads it
            positions[tick] = data.qpos
            mujoco.mj_step(model, data, nstep=steps_a_tick)
    finally:
        mujoco.set_mjcb_passive(None)
    return positions


@pytest.mark.parametrize(
    ("integrator", "refinements", "order", "finest"),
    [("Euler", [2, 4, 8, 16], 1.0, 1e-4), ("RK4", [1, 2, 4], 4.0, 1e-8)],
)
def test_mujoco_comes_nearer_with_its_time_step(integrator, refinements, order, finest):
    """Euler: 0.77 mm at 5 ms, 0.096 mm at 0.625 ms, order 1.00. RK4: 1.8e-7 m at 10 ms, 6.5e-10 m at 2.5 ms, 4.06."""
    given = bench()
    exact = AdmittancePlant(MASS).simulate(**given, dt=TICK).position.numpy()
    errors = [abs(mujoco_run(given, integrator, times) - exact).max() for times in refinements]
    fitted = -np.polyfit(np.log(refinements), np.log(errors), 1)[0]
    assert fitted == pytest.approx(order, abs=0.2)
    assert errors[-1] < finest

"""
An energy tank
==============

The unsafe schedule of the example before, behind a filter: each rise of the stiffness must be paid for from a tank that
dissipation fills. Where the tank is empty the stiffness does not rise, and the robot comes to rest.
"""

import matplotlib.pyplot as plt
import numpy as np

from torch_pbd.control import AdmittancePlant, EnergyTank, damping_from_stiffness
from torch_pbd.plotting import SERIES, legend_below

rate = 500.0  # Hz
time = np.arange(0.0, 4.0, 1.0 / rate)
resting = np.zeros((len(time), 1))
stiffness = 500.0 * (1.0 + 0.8 * np.sin(2.0 * np.sqrt(500.0) * time))[:, np.newaxis, np.newaxis]
damping = damping_from_stiffness(stiffness, damping_ratio=0.05)

figure, axes = plt.subplots(3, 1, figsize=(7.0, 7.0), sharex=True, layout="constrained")
for filtered, color, dashes in ((None, SERIES[3], "--"), (EnergyTank(), SERIES[1], "-")):
    plant = AdmittancePlant(mass=1.0, stiffness_filter=filtered)
    run = plant.simulate(resting, resting, stiffness, damping, resting, dt=1.0 / rate, position0=[0.01]).numpy()
    name = "with a tank" if filtered else "as planned"
    axes[0].plot(time, run.stiffness[:, 0, 0], dashes, color=color, label=name, lw=1.0)
    axes[1].semilogy(time, 1e3 * np.abs(run.deviation[:, 0]) + 1e-6, dashes, color=color, lw=1.0)
    if filtered:
        axes[2].plot(time, 1e3 * run.tank_energy, color=color)
        print(f"the filter held the stiffness back at {len(run.interventions)} of {len(time)} ticks")
axes[0].set(ylabel="stiffness [N/m]")
axes[1].set(ylabel="deviation [mm]", ylim=(1e-4, None))
axes[2].set(xlabel="time [s]", ylabel="tank [mJ]", xlim=(0.0, 4.0))
legend_below(figure, axes[0])
plt.show()

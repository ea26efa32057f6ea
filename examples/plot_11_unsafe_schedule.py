"""
A certificate, and an unsafe schedule
=====================================

A stiffness that changes feeds energy into the robot. With enough damping none of it stays; with little, a stiffness
that swings at the right pace throws the robot off, with no force on it. The report says it before the robot does.
"""

import matplotlib.pyplot as plt
import numpy as np

from torch_pbd.control import AdmittancePlant, Schedule, damping_from_stiffness
from torch_pbd.plotting import ROBOT, SERIES, legend_below

rate, mean_stiffness = 500.0, 500.0  # Hz, N/m
time = np.arange(0.0, 4.0, 1.0 / rate)
resting = np.zeros((len(time), 1))
# Twice in a period of the free swing of 1 kg: as one pumps a swing.
swing = 1.0 + 0.8 * np.sin(2.0 * np.sqrt(mean_stiffness) * time)
stiffness = (mean_stiffness * swing)[:, np.newaxis, np.newaxis]

figure, axes = plt.subplots(2, 1, figsize=(7.0, 5.6), sharex=True, layout="constrained")
axes[0].plot(time, stiffness[:, 0, 0], color=ROBOT, label="stiffness")
axes[0].set(ylabel="stiffness [N/m]", ylim=(0.0, None))
for ratio, color, dashes in ((1.0, SERIES[1], "-"), (0.05, SERIES[3], "--")):
    damping = damping_from_stiffness(stiffness, damping_ratio=ratio)
    schedule = Schedule(
        time, resting, resting, stiffness, damping, covariance=0.0 * stiffness, type1=0.0 * time, units="m"
    )
    report = schedule.certify(mass=1.0)
    print(f"damping ratio {ratio}\n{report}\n")
    run = AdmittancePlant(mass=1.0).simulate(
        resting, resting, stiffness, damping, resting, dt=1.0 / rate, position0=[0.01]
    )
    verdict = "guaranteed" if report.stable else "not guaranteed"
    deviation = 1e3 * np.abs(run.numpy().deviation[:, 0])
    axes[1].semilogy(time, deviation + 1e-6, dashes, color=color, label=f"damping ratio {ratio}: {verdict}")
axes[1].set(xlabel="time [s]", ylabel="deviation [mm]", xlim=(0.0, 4.0), ylim=(1e-4, None))
legend_below(figure, axes, 3)
plt.show()

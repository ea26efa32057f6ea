"""
Stiff where a point must be met
===============================

Where people were free to go the robot is soft. A via point leaves nothing free where it is, and little beside it: the
covariance, given the point, is small there, and what is small gets a high stiffness.
"""

import matplotlib.pyplot as plt
import numpy as np

from torch_pbd import Demonstrations, DMPController, TrajectoryRegressor
from torch_pbd.plotting import legend_below, plot_covariance_ellipses, plot_demonstrations

time = np.linspace(0.0, 4.0, 101)
s = time / 4.0
rise, rng = s**3 * (10.0 - 15.0 * s + 6.0 * s**2), np.random.default_rng(0)
reaches = []
for wide, early, end, along in rng.standard_normal((12, 4)):  # around something in the way, more or less wide
    bow = np.sin(np.pi * s ** np.exp(0.08 * early)) ** 2
    reaches.append(
        np.stack([0.5 * rise + 0.012 * along * bow, (0.15 + 0.03 * wide) * bow + 0.002 * end * rise], axis=1)
    )
shown = Demonstrations(time, reaches + 0.0005 * rng.standard_normal((12, 101, 2)), names=("x", "y"), units="m")

controller = DMPController(TrajectoryRegressor()).fit(shown)
point = controller.predict([[1.6]])[0] + [0.0, 0.04]
plain, bent = controller.schedule(100.0), controller.schedule(100.0, via=[(1.6, point)])
print(f"the point is missed by {1e3 * np.linalg.norm(bent.position[160] - point):.3f} mm")
for row in (40, 100, 140, 160, 180, 220, 280):
    gains = f"{plain.stiffness[row, 1, 1]:4.0f} -> {bent.stiffness[row, 1, 1]:4.0f} N/m"
    print(f"{bent.time[row]:.1f} s: stiffness along y {gains}")

figure, (plane, over_time) = plt.subplots(1, 2, figsize=(10.0, 4.2), layout="constrained")
plot_demonstrations(shown, [0, 1], plane)
some = slice(10, None, 15)
plot_covariance_ellipses(bent.position[some], bent.covariance[some], plane, color="tab:blue", label="2 sd")
for schedule, color, label in ((plain, "tab:orange", "without the point"), (bent, "tab:blue", "through the point")):
    plane.plot(*schedule.position.T, color=color, lw=1.8, label=label)
    over_time.plot(schedule.time, schedule.stiffness[:, 1, 1], color=color, lw=1.8)
plane.plot(*point, "o", color="black", ms=6, zorder=5, label="via point")
over_time.axvline(1.6, color="black", lw=0.8, ls=":")
over_time.set(xlabel="time [s]", ylabel="stiffness along y [N/m]", ylim=(0.0, None))
legend_below(figure, plane, 5)
plt.show()

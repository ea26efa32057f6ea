"""
A robot that was pushed away
============================

Halfway through a reach a robot is pushed 5 cm aside. That is no error to undo at once: conditioning on where it is
gives the rest of the movement as demonstrations make it likely from there, and how free it is: stiff at first, softer
later.
"""

import matplotlib.pyplot as plt
import numpy as np

from torch_pbd import Demonstrations, DMPController, TrajectoryRegressor
from torch_pbd.plotting import legend_below, plot_demonstrations, plot_std_band

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
plan = controller.schedule(100.0)
pushed = controller.predict([[2.0]]) + np.array([0.0, 0.05])
rest = controller.condition([2.0], pushed).schedule(100.0)
for row in range(200, 401, 50):
    away = 1e3 * (rest.position - plan.position)[row, 1]
    gains = f"{plan.stiffness[row, 1, 1]:4.0f} -> {rest.stiffness[row, 1, 1]:4.0f} N/m"
    print(f"{rest.time[row]:.1f} s: {away:4.1f} mm from the first plan, stiffness along y {gains}")

figure, (plane, over_time) = plt.subplots(1, 2, figsize=(10.0, 4.2), layout="constrained")
after = rest.time >= 2.0
plot_demonstrations(shown, [0, 1], plane)
plot_demonstrations(shown, [1], over_time)
plane.plot(*plan.position.T, color="tab:orange", lw=1.5, label="first plan")
over_time.plot(plan.time, plan.position[:, 1], color="tab:orange", lw=1.5)
plane.plot(*rest.position[after].T, color="tab:blue", lw=2.0, label="planned anew, 2 sd")
deviation = np.sqrt(rest.covariance[after, 1, 1])
plot_std_band(rest.time[after], rest.position[after, 1], deviation, over_time, color="tab:blue")
arrow = {"arrowstyle": "-|>", "color": "black", "lw": 1.5, "shrinkA": 0, "shrinkB": 0}
for ax, at in ((plane, pushed[0, 0]), (over_time, 2.0)):
    ax.annotate("", (at, pushed[0, 1]), (at, pushed[0, 1] - 0.05), arrowprops=arrow)
    ax.annotate("pushed here", (at, pushed[0, 1]), (-6, 2), textcoords="offset points", ha="right")
legend_below(figure, plane)
plt.show()

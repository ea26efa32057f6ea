"""
A tool that turns
=================

Recorded poses are positions and quaternions. `rotation=` names the four columns of a quaternion, in the order w x y z,
and what is learned of them are rotation vectors around the mean rotation. The controller has limits of its own for
rotations, in Nm/rad, and its schedule is in world axes: twists, 6 x 6 gains, orientations as quaternions.

A peg that is put into a hole that leans is precise across the hole and about two axes, and free along and about its
own. `pose_mean` and `pose_covariance` are the law it was made by.
"""

import matplotlib.pyplot as plt
import numpy as np

from torch_pbd import Demonstrations, DMPController
from torch_pbd.control import RotationLimits, StiffnessLaw
from torch_pbd.data import make_pose_demonstrations, pose_covariance
from torch_pbd.plotting import legend_below, plot_outputs, principal

made = make_pose_demonstrations(12, rate=50.0, timing=0.0, random_state=0)
places, quaternions = made.to_poses()

# As a robot would have recorded them, here with the real part last.
columns = [np.hstack([place, np.roll(turn, -1, axis=1)]) for place, turn in zip(places, quaternions, strict=True)]
recorded = Demonstrations(
    made.times,
    columns,
    names=["x", "y", "z", "qx", "qy", "qz", "qw"],
    units="m",
    rotation=["qw", "qx", "qy", "qz"],
)
print(recorded.describe())
recorded.plot()

# %%
# What was learned
# ----------------
#
# The covariance is that at the planned pose, and each block has a law and limits of its own. At the hole the stiffest
# axes are those across it.

limits = RotationLimits(stiffness_min=2.0, stiffness_max=60.0)
law = StiffnessLaw(stiffness_min=100.0, stiffness_max=1500.0, rotation=limits)
schedule = DMPController(stiffness_law=law).fit(recorded).schedule(200.0)
schedule.plot()

# %%
# Against the law they were made by
# ---------------------------------
#
# Standard deviations in principal axes: of positions in mm, of rotations in degrees.

truth = pose_covariance(np.clip(schedule.time / schedule.duration, 0.0, 1.0))
figure, axes = plt.subplots(1, 2, figsize=(9.6, 3.8), layout="constrained")
for block, scale, unit, ax in zip(schedule.blocks, (1e3, 180.0 / np.pi), ("mm", "deg"), axes, strict=True):
    for covariance, name, color in ((schedule.covariance, "inferred", "tab:blue"), (truth, "true", "black")):
        deviations = scale * np.sqrt(principal(covariance[:, block, block]))
        labels = [f"{name}: {axis} axis" for axis in ("most precise", "middle", "freest")]
        plot_outputs(schedule.time, deviations, ax, labels, [color])
    ax.set(xlabel="time [s]", ylabel=f"1 sd [{unit}]", ylim=(0.0, None))
legend_below(figure, axes[0], 3)

# %%
# On an arm
# ---------
#
# An arm that is controlled by torques moves with its own inertia, here a constant one; the damping is made for it, and
# `for_arm.save("peg.npz")` is what a robot takes.

inertia = np.diag([6.0, 6.0, 8.0, 0.2, 0.2, 0.05])
for_arm = schedule.with_inertia(inertia)
hole = for_arm.orientation[-1]
print(f"in the hole the tool is at w x y z = {np.array2string(hole, precision=3)}, with a stiffness of")
for block, unit in zip(for_arm.blocks, ("N/m", "Nm/rad"), strict=True):
    print(np.array2string(np.linalg.eigvalsh(for_arm.stiffness[-1, block, block]), precision=1), unit)
plt.show()

"""
A tool that turns
=================

Recorded poses are positions and quaternions. ``rotation=`` names the four columns of a quaternion, as w x y z;
learned are rotation vectors around the mean rotation. Stiffness has limits of its own for rotations, in Nm/rad, and the
schedule is in world axes: twists, 6 x 6 gains, orientations.

A peg in a hole that leans is precise across the hole and about two axes, and free along and about its own.
"""

import matplotlib.pyplot as plt
import numpy as np

from torch_pbd import Demonstrations, DMPController
from torch_pbd.control import RotationLimits, StiffnessLaw
from torch_pbd.data import make_pose_demonstrations, pose_covariance

made = make_pose_demonstrations(12, rate=50.0, timing=0.0, random_state=0)
# As a robot would have recorded them, here with the real part last.
columns = [np.hstack([place, np.roll(turn, -1, axis=1)]) for place, turn in zip(*made.to_poses(), strict=True)]
names = ["x", "y", "z", "qx", "qy", "qz", "qw"]
recorded = Demonstrations(made.times, columns, names=names, units="m", rotation=["qw", "qx", "qy", "qz"])
print(recorded.names, recorded.units, recorded.rotation_reference.round(3))

law = StiffnessLaw(stiffness_min=300.0, stiffness_max=1500.0, rotation=RotationLimits(5.0, 60.0))
schedule = DMPController(stiffness_law=law).fit(recorded).schedule(200.0)

# The covariance is that at the planned pose; in black that of the law which the demonstrations were made by.
space, moved, turned, *_ = schedule.plot()
for place, _ in zip(*recorded.to_poses(), strict=True):
    space.plot(*place.T, color="tab:gray", lw=0.7)
truth = pose_covariance(np.clip(schedule.time / schedule.duration, 0.0, 1.0))
for block, scale, ax in zip(schedule.blocks, (1e3, 180.0 / np.pi), (moved, turned), strict=True):
    ax.plot(schedule.time, scale * np.sqrt(np.linalg.eigvalsh(truth[:, block, block])), color="black", lw=0.8)

# An arm that is controlled by torques moves with its own inertia, here a constant one. The damping is made for it, and
# for_arm.save("peg.npz") is what a robot takes.
for_arm = schedule.with_inertia(np.diag([6.0, 6.0, 8.0, 0.2, 0.2, 0.05]))  # kg, kg m^2
for block, unit in zip(for_arm.blocks, ("N/m", "Nm/rad"), strict=True):
    print("in the hole:", np.linalg.eigvalsh(for_arm.stiffness[-1, block, block]).round(1), unit)
plt.show()

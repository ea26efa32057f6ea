"""
An arm that is pushed
=====================

A learned pose task on a torque-controlled Panda in MuJoCo (``pip install 'torch_pbd[robot]'``), whose tool weighs 5 to
16 kg, more along some axes than along others and changing on the way. With that inertia in the schedule every mode is
critically damped, and the plant, which like the arm feeds the planned acceleration forward, foretells what a push by
force and torque does to the arm.
"""

import matplotlib.pyplot as plt
import numpy as np

from torch_pbd import DMPController
from torch_pbd.control import AdmittancePlant, RotationLimits, StiffnessLaw, simulate
from torch_pbd.data import make_pose_demonstrations
from torch_pbd.plotting import FORCE, MODEL, ROBOT, plot_arm, plot_covariance_ellipsoids, plot_frames
from torch_pbd.robots import HOME, inverse_kinematics, operational_inertia, panda
from torch_pbd.robots.mujoco import run

law = StiffnessLaw(stiffness_min=200.0, stiffness_max=1000.0, rotation=RotationLimits(5.0, 50.0))
planned = DMPController(stiffness_law=law).fit(make_pose_demonstrations(random_state=0)).schedule(1000.0)
arm = panda()
joints = inverse_kinematics(arm, planned.position, planned.orientation, "tool", start=HOME)
schedule = planned.with_inertia(operational_inertia(arm, joints, "tool"))
weights = np.linalg.eigvalsh(schedule.mass[:, :3, :3])
print(f"the tool weighs {weights.min():.1f} to {weights.max():.1f} kg")

share = np.sin(np.pi * np.clip((schedule.time - 0.8) / 0.8, 0.0, 1.0)) ** 2
wrench = np.outer(share, [5.0, -9.0, 6.0, 0.6, 0.8, -0.6])  # N and Nm
pushed = run(arm, schedule, joints, wrench=wrench)
plant = simulate(schedule, wrench, plant=AdmittancePlant(None, feed_forward=True)).deviation

figure = plt.figure(figsize=(11.0, 5.6), layout="constrained")
columns = figure.add_gridspec(2, 2, width_ratios=(1.2, 1.0))
space = figure.add_subplot(columns[:, 0], projection="3d", computed_zorder=False)
at = int(share.argmax()) + 100
plot_arm(arm, pushed.joints[at], space)
few = np.linspace(0, len(schedule) - 1, 7).astype(int)
plot_covariance_ellipsoids(schedule.position[few], schedule.covariance[few, :3, :3], space, label="2 sd")
space.plot(*schedule.position.T, color=MODEL, zorder=5, label="planned")
space.plot(*pushed.position.T, "--", color=ROBOT, zorder=6, label="the arm")
tip, force = pushed.position[at], 0.02 * wrench[at, :3]
space.quiver(*(tip - force), *force, color=FORCE, zorder=7, label="push")
plot_frames(schedule.position[few], schedule.orientation[few], space, length=0.05, label=None)
space.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]", aspect="equal")
space.view_init(elev=18.0, azim=-50.0)
space.legend(loc="upper left")

for row, (block, scale, unit) in enumerate(((slice(3), 1e3, "mm"), (slice(3, 6), 180.0 / np.pi, "degrees"))):
    band = figure.add_subplot(columns[row, 1])
    for motion, style, color, label in ((pushed.deviation, "-", ROBOT, "arm"), (plant, ":", "k", "plant")):
        band.plot(schedule.time, scale * np.linalg.norm(motion[:, block], axis=1), style, color=color, label=label)
    band.set(ylabel=f"deviation [{unit}]", xlabel="time [s]")
    band.legend()
plt.show()

"""
Stiffness along a task
======================

From the covariance to the gains of a robot: stiff where and in the direction in which people agreed, compliant where
they differed. The dotted lines are the limits of the stiffness.
"""

import matplotlib.pyplot as plt
import numpy as np

from torch_pbd import DMPController
from torch_pbd.data import make_handwriting_demonstrations
from torch_pbd.plotting import ROBOT, legend_below, plot_covariance_ellipses

strokes = make_handwriting_demonstrations("S", duration=6.0, timing=0.0, rate=25.0, random_state=3)
controller = DMPController().fit(strokes)
schedule = controller.schedule(rate=200.0)
print(schedule)

plane, *_ = schedule.plot()

# %%
# The stiffness beside the covariance: an ellipse is long in its stiff direction, 1 cm for 1000 N/m.
rows = np.linspace(0, len(schedule) - 1, 25).round().astype(int)
gains = 1e-5 * schedule.stiffness[rows]
label = "stiffness, 1 cm = 1000 N/m"
plot_covariance_ellipses(schedule.position[rows], gains @ gains, plane, n_std=1.0, color=ROBOT, label=label)
plane.figure.legends[0].remove()
legend_below(plane.figure, plane.figure.axes)
plt.show()

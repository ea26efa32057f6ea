"""
Pushes early and late
=====================

The experiment of the paper's Figure 8: a robot follows the tunnel task and is pushed twice with 5 N, where the tunnel
is wide and where it is narrow. The covariance has made it compliant in the one and stiff in the other.
"""

import matplotlib.pyplot as plt
import numpy as np

from torch_pbd import DMPController
from torch_pbd.data import make_tunnel_demonstrations

demonstrations = make_tunnel_demonstrations(rate=25.0, random_state=0)
controller = DMPController().fit(demonstrations)
rate = 500.0
schedule = controller.schedule(rate)
print(schedule.certify())

force = np.zeros_like(schedule.position)
for start in (1.6, 7.6):
    force[:, 0] += 5.0 * np.sin(np.pi * np.clip((schedule.time - start) / 0.8, 0.0, 1.0)) ** 2

run = controller.simulate(force=force, rate=rate)
run.plot(unpushed=controller.simulate(rate=rate), names=schedule.names)
plt.show()

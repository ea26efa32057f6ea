"""
Alignment and timing
====================

People differ in pace. Over time, a difference of pace looks like a difference of position; over phase, the duration is
taken out; dynamic time warping takes out the pace within a stroke too. What is left is the variability of the path.
"""

import matplotlib.pyplot as plt
import numpy as np

from torch_pbd.data import handwriting_covariance, make_handwriting_demonstrations
from torch_pbd.plotting import EMPIRICAL, TRUTH, legend_below, plot_demonstrations

strokes = make_handwriting_demonstrations("Z", n_demos=12, timing=0.2, rate=50.0, random_state=1)
versions = {
    "over time": strokes,
    'align("phase")': strokes.align("phase", n=120),
    'align("dtw")': strokes.align("dtw", n=120),
}
phase = np.linspace(0.0, 1.0, 120)
true_sd = 1e3 * np.sqrt(handwriting_covariance(phase, "Z")[:, 0, 0])

figure, axes = plt.subplots(2, 3, figsize=(11.0, 5.4), sharey="row", layout="constrained")
for (name, version), (above, below) in zip(versions.items(), axes.T, strict=True):
    plot_demonstrations(version, ["x"], above)
    above.set_title(name)
    if version.is_aligned:
        sd = 1e3 * version.to_array()[:, :, 0].std(axis=0, ddof=1)
        below.plot(phase, sd, color=EMPIRICAL, label="empirical: 1 sd")
    else:
        shortest = min(time[-1] for time in version.times)
        grid = np.linspace(0.0, shortest, 120)
        x = [np.interp(grid, time, position[:, 0]) for time, position in version]
        below.plot(grid, 1e3 * np.std(x, axis=0, ddof=1), color=EMPIRICAL, label="empirical: 1 sd")
        below.set_xlabel("time [s]")
        continue
    below.plot(phase, true_sd, "--", color=TRUTH, label="truth of the path: 1 sd")
    below.set_xlabel("phase")
axes[1, 0].set_ylabel("sd of x [mm]")
legend_below(figure, [axes[0, 1], axes[1, 1]])
plt.show()

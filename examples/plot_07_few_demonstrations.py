"""
Few demonstrations, and what they leave open
============================================

The covariance itself is uncertain, the more the fewer demonstrations there are. Draws of the covariance function show
by how much: four demonstrations leave much open, sixteen less. Both can be off by chance, as the empirical deviation
is: even sixteen demonstrations miss the second peak of the truth.
"""

import matplotlib.pyplot as plt
import numpy as np

from torch_pbd import HeteroscedasticGPRegressor
from torch_pbd.data import handwriting_covariance, make_handwriting_demonstrations
from torch_pbd.plotting import EMPIRICAL, MODEL, TRUTH, legend_below

times = np.linspace(0.0, 2.0, 101)[:, np.newaxis]
true_sd = 1e3 * np.sqrt(handwriting_covariance(times / 2.0)[:, 1, 1])

figure, axes = plt.subplots(1, 2, figsize=(10.0, 4.0), sharey=True, layout="constrained")
for ax, n_demos in zip(axes, [4, 16], strict=True):
    strokes = make_handwriting_demonstrations("S", n_demos, timing=0.0, rate=50.0, random_state=5)
    X, y, groups = strokes.stack()
    model = HeteroscedasticGPRegressor().fit(X, y, groups=groups)
    draws = 1e3 * np.sqrt(model.sample_cov(times, n_samples=30, random_state=0)[:, 1, 1])
    ax.plot(times, draws, color=MODEL, lw=0.8, alpha=0.4)[0].set_label("draws of the covariance function")
    sd = 1e3 * np.sqrt(model.predict_cov(times)[:, 1, 1])
    ax.plot(times, sd, color=MODEL, lw=2.0, label="predicted: 1 sd")
    ax.plot(times, 1e3 * strokes.to_array()[:, :, 1].std(axis=0, ddof=1), color=EMPIRICAL, label="empirical: 1 sd")
    ax.plot(times, true_sd, "--", color=TRUTH, label="truth: 1 sd")
    ax.set(title=f"{n_demos} demonstrations", xlabel="time [s]", ylim=(0.0, 15.0), xlim=(0.0, 2.0))
axes[0].set_ylabel("standard deviation of y [mm]")
legend_below(figure, axes[0])
plt.show()

"""
Samples of whole movements
==========================

A regressor knows what one sample may be, and its draws jump from row to row. A demonstration is smooth: a model of
whole movements adds how its samples hang together, and leaves mean and covariance of each row as they are.
"""

import matplotlib.pyplot as plt
import numpy as np

from torch_pbd import TrajectoryRegressor
from torch_pbd.data import make_handwriting_demonstrations
from torch_pbd.plotting import MODEL, legend_below, plot_demonstrations

strokes = make_handwriting_demonstrations("S", n_demos=8, timing=0.0, rate=50.0, random_state=0)
times = strokes.times[0][:, np.newaxis]
movement = TrajectoryRegressor().fit(strokes)

rows = movement.sample_y(times, n_samples=4, random_state=0).transpose(2, 0, 1)
whole = movement.sample_demonstrations(times, n_samples=4, random_state=0)

figure, axes = plt.subplots(1, 3, figsize=(10.0, 5.0), sharex=True, sharey=True, layout="constrained")
for ax, draws, title in zip(
    axes,
    [[], rows, whole],
    ["eight demonstrations", "rows independent: 4 draws", "whole movements: 4 draws"],
    strict=True,
):
    plot_demonstrations(strokes, ["x", "y"], ax)
    for i, draw in enumerate(draws):
        ax.plot(*draw.T, color=MODEL, lw=1.2, label="draws" if i == 0 else None)
    ax.set(title=title, aspect="equal")
    ax.label_outer()
legend_below(figure, list(axes))
plt.show()

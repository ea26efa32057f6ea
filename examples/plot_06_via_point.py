"""
A via point
===========

A movement shall pass somewhere at a given time. Conditioning bends the whole movement as people would: near the via
point by all of it, elsewhere by what the demonstrations say, and it is certain there and as free as before elsewhere.
"""

import matplotlib.pyplot as plt
import numpy as np

from torch_pbd import TrajectoryRegressor
from torch_pbd.data import make_handwriting_demonstrations
from torch_pbd.plotting import MovementDisplay, legend_below

strokes = make_handwriting_demonstrations("C", n_demos=8, timing=0.0, rate=50.0, random_state=0)
movement = TrajectoryRegressor().fit(strokes)

time = [[1.0]]
via = movement.predict(time) - np.array([[0.012, 0.0]])  # 12 mm further out than usual
bent = movement.condition(time, via)

figure, ax = plt.subplots(figsize=(5.6, 5.6), layout="constrained")
MovementDisplay.from_estimator(bent, strokes, other=movement, names=["through the via point", "before"], ax=ax)
ax.plot(*via[0], "X", color="black", ms=9, ls="", label="via point", zorder=7)
legend_below(figure, ax, 2)
plt.show()

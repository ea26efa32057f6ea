"""
Six strokes of a letter
=======================

A letter written six times: precise at its middle and its end, free in its bows. The recommended model learns mean and
covariance over time; the truth, from which the strokes were drawn, is dashed.
"""

import matplotlib.pyplot as plt

from torch_pbd import HeteroscedasticGPRegressor
from torch_pbd.data import handwriting_covariance, handwriting_mean, make_handwriting_demonstrations
from torch_pbd.plotting import MovementDisplay

strokes = make_handwriting_demonstrations("S", n_demos=6, timing=0.0, rate=50.0, random_state=2)
X, y, groups = strokes.stack()
model = HeteroscedasticGPRegressor().fit(X, y, groups=groups)


def truth(time):
    """Law of the letter at times in s; it is written in two."""
    return handwriting_mean(time / 2.0), handwriting_covariance(time / 2.0)


MovementDisplay.from_estimator(model, strokes, truth=truth)
plt.show()

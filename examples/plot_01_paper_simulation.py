"""
The paper's simulation, by all models
=====================================

Fifty draws at each of ten inputs, from the law of eq. (14). All models see the same data. Beyond the data, right and
left of the dotted lines, those with a prior become uncertain, and the mixture does not.
"""

import matplotlib.pyplot as plt
import numpy as np

from torch_pbd import CholeskyCovRegressor, GMMBaseline, HeteroscedasticGPRegressor, WishartProcessRegressor
from torch_pbd.data import make_paper_simulation, paper_covariance, paper_mean
from torch_pbd.plotting import legend_below, plot_model_bands

X, y, groups = make_paper_simulation(n_inputs=10, n_demos=50, reading="bell", random_state=0)
models = {
    "HeteroscedasticGPRegressor": HeteroscedasticGPRegressor(),
    "CholeskyCovRegressor": CholeskyCovRegressor(),
    "WishartProcessRegressor": WishartProcessRegressor(),
    "GMMBaseline": GMMBaseline(random_state=0),
}


def truth(xi):
    """Mean and standard deviation of eq. (14), whose variance is positive above -150 only."""
    known = xi.clip(-149.0)
    return paper_mean(known), np.sqrt(np.diagonal(paper_covariance(known), axis1=1, axis2=2))


figure, axes = plt.subplots(2, 4, figsize=(13.0, 6.0), sharex=True, sharey="row", layout="constrained")
for (name, model), column in zip(models.items(), axes.T, strict=True):
    plot_model_bands(model.fit(X, y, groups=groups), X, y, column, true_std=truth)
    column[0].set_title(name, fontsize=11)
    column[1].set_xlabel("input")
axes[0, 0].set_ylabel("first output")
axes[1, 0].set_ylabel("second output")
legend_below(figure, axes[0, 0])
plt.show()

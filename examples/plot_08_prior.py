"""
Prior and unknown regions
=========================

Where nobody showed anything the covariance becomes the prior that one gives, and ``type1`` says how much of it: 0 on
the data, 1 where only the prior speaks. It rises over a length scale, so a hole that is short beside it is bridged. A
mixture has no prior: its covariance there is that of its nearest component, and only ``type1`` warns.
"""

import matplotlib.pyplot as plt
import numpy as np

from torch_pbd import Demonstrations, GMMBaseline, HeteroscedasticGPRegressor
from torch_pbd.data import make_handwriting_demonstrations
from torch_pbd.plotting import MODEL, OTHER, legend_below, plot_demonstrations, plot_std_band

strokes = make_handwriting_demonstrations("S", n_demos=8, timing=0.0, rate=50.0, random_state=0)
seen = (strokes.times[0] < 0.5) | (strokes.times[0] > 1.5)  # the middle was not recorded
X, y, groups = Demonstrations(strokes.times[0][seen], strokes.to_array()[:, seen], units="m").stack()

models = {
    "HeteroscedasticGPRegressor, prior of 2 cm": HeteroscedasticGPRegressor(prior=0.02**2),
    "GMMBaseline": GMMBaseline(random_state=0),
}
query = np.linspace(-1.0, 3.0, 401)[:, np.newaxis]

figure, axes = plt.subplots(2, 1, figsize=(8.0, 6.0), sharex=True, layout="constrained", height_ratios=(2.0, 1.0))
for part in (strokes.times[0] < 0.5, strokes.times[0] > 1.5):
    shown = Demonstrations(strokes.times[0][part], strokes.to_array()[:, part], names=["x", "y"], units="m")
    plot_demonstrations(shown, ["x"], axes[0], label="demonstrations" if part[0] else None)
for (name, model), color in zip(models.items(), [MODEL, OTHER], strict=True):
    model.fit(X, y, groups=groups)
    mean, covariance = model.predict(query, return_cov=True)
    plot_std_band(query, mean[:, 0], np.sqrt(covariance[:, 0, 0]), axes[0], color=color, label=f"{name}: 2 sd")
    axes[1].plot(query, model.predict_uncertainty(query).type1, color=color)
axes[0].set(xlabel="", ylim=(-0.1, 0.15))
axes[1].set(xlabel="time [s]", ylabel="type1", ylim=(0.0, 1.05), xlim=(-1.0, 3.0))
legend_below(figure, axes[0], 2)
plt.show()

"""
Your own csv
============

A table as a tracker writes it: semicolons, times in ms, positions in mm, columns with names of its own. Options say
which column is what; units are needed where a controller shall follow.
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt

from torch_pbd import HeteroscedasticGPRegressor, load_demonstrations
from torch_pbd.data import make_handwriting_demonstrations
from torch_pbd.plotting import MovementDisplay

# %%
# Here such a file is made first.
lines = ["trial;stamp;px;py"]
for trial, (time, position) in enumerate(make_handwriting_demonstrations("G", n_demos=8, rate=50.0, random_state=0)):
    lines += [
        f"take {trial};{1e3 * t:.0f};{1e3 * x:.2f};{1e3 * y:.2f}" for t, (x, y) in zip(time, position, strict=True)
    ]
path = Path(tempfile.mkdtemp()) / "tracker.csv"
path.write_text("\n".join(lines))
print("\n".join(lines[:4]))

# %%
# It is loaded, brought onto one grid of phases, and learned.
strokes = load_demonstrations(
    path, demo="trial", time="stamp", outputs=["px", "py"], delimiter=";", units="mm", time_unit="ms"
)
print(strokes)
aligned = strokes.align("phase", n=80)
X, y, groups = aligned.stack()
MovementDisplay.from_estimator(HeteroscedasticGPRegressor().fit(X, y, groups=groups), aligned)
plt.show()

"""Make the golden files of a format version, once, by the code that brings the version in::

    python tests/golden/make.py tests/golden/v1

Files of a version that was released are never made again: that they load is what they are for. What estimators of today
learn is made anew by a change that means to change it::

    python tests/golden/make.py tests/golden/fits.json
"""

import json
import sys
from pathlib import Path

import numpy as np
import pandas as pd

import torch_pbd
from torch_pbd import (
    CholeskyCovRegressor,
    DMPController,
    GMMBaseline,
    HeteroscedasticGPRegressor,
    WishartProcessRegressor,
)
from torch_pbd.data import make_tunnel_demonstrations, save_demonstrations

QUERIES = [[-3.0], [-1.0], [-0.35], [0.0], [0.6], [1.0], [40.0]]
RATE = 1.0


def models():
    """One fitted regressor a class, with parameters and labels of every kind that a header holds."""
    rng = np.random.default_rng(0)
    X = np.tile(np.linspace(-1.0, 1.0, 6), 8)[:, np.newaxis]
    y = np.column_stack([np.tanh(2.0 * X[:, 0]), X[:, 0] ** 2])
    y += (0.3 + 0.2 * X) * rng.normal(size=(len(X), 2)) @ np.array([[1.0, 0.4], [0.0, 0.7]])
    prior = np.array([[2.0, 0.5], [0.5, 1.0]])
    return {
        "CholeskyCovRegressor": CholeskyCovRegressor(length_scale=[0.4]).fit(pd.DataFrame(X, columns=["time"]), y),
        "WishartProcessRegressor": WishartProcessRegressor(prior=prior, length_scale=0.4).fit(X, y),
        "HeteroscedasticGPRegressor": HeteroscedasticGPRegressor(kernel="matern52").fit(X, y),
        "GMMBaseline": GMMBaseline(n_components=2, random_state=0).fit(X, y[:, 0]),
    }


def fits():
    """Estimators as they are by default, fitted to recordings along the tunnel that agree nowhere and repeat inputs."""
    X, y, groups = make_tunnel_demonstrations(6, rate=5.0, random_state=1).stack()
    grid = np.linspace(0.3, 9.7, 8)[:, np.newaxis]  # beyond them a kernel matrix without noise tells rounding
    estimators = {
        "CholeskyCovRegressor": CholeskyCovRegressor(),
        "WishartProcessRegressor": WishartProcessRegressor(),
        "HeteroscedasticGPRegressor": HeteroscedasticGPRegressor(),
        "GMMBaseline": GMMBaseline(n_components=2, random_state=0),
    }
    learned = {name: predictions(estimator.fit(X, y, groups), grid) for name, estimator in estimators.items()}
    return {name: {part: of[part] for part in ("mean", "covariance", "type1", "type2")} for name, of in learned.items()}


def predictions(model, X):
    """What a model says at X, as lists."""
    mean, covariance = model.predict(X, return_cov=True)
    type1, type2 = model.predict_uncertainty(X)
    parts = {"mean": mean, "covariance": covariance, "type1": type1, "type2": type2}
    parts["log_likelihood"] = model.log_likelihood(X, np.zeros_like(mean))
    return {name: part.tolist() for name, part in parts.items()}


def main(folder):
    """Write all files of one version."""
    folder.mkdir()
    expected = {}
    for name, model in models().items():
        torch_pbd.save(model, folder / f"{name}.safetensors")
        X = pd.DataFrame(QUERIES, columns=["time"]) if hasattr(model, "feature_names_in_") else np.array(QUERIES)
        expected[name] = predictions(model, X)
    recorded = make_tunnel_demonstrations(4, rate=10.0, random_state=0)
    controller = DMPController(GMMBaseline(n_components=2, random_state=0), mass=2.0).fit(recorded)
    torch_pbd.save(controller, folder / "DMPController.safetensors")
    for suffix in ("npz", "json", "csv"):
        controller.schedule(RATE).save(folder / f"schedule.{suffix}")
    for suffix in ("npz", "csv"):
        save_demonstrations(recorded.resample(5), folder / f"demonstrations.{suffix}")
    schedule = controller.schedule(RATE)
    expected["DMPController"] = {
        name: getattr(schedule, name).tolist()
        for name in ("position", "velocity", "stiffness", "damping", "covariance")
    }
    (folder / "predictions.json").write_text(json.dumps(expected, indent=1) + "\n")


if __name__ == "__main__":
    if sys.argv[1].endswith("fits.json"):
        Path(sys.argv[1]).write_text(json.dumps(fits(), indent=1) + "\n")
    else:
        main(Path(sys.argv[1]))

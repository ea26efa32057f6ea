"""Fits every kind of estimator, and tells the bits of what it predicts; also a program, for other processes."""

import hashlib
import sys

import numpy as np
import torch

from torch_pbd import (
    CholeskyCovRegressor,
    DMPController,
    GMMBaseline,
    HeteroscedasticGPRegressor,
    WishartProcessRegressor,
)
from torch_pbd.data import make_tunnel_demonstrations

MODELS = {
    "cholesky": CholeskyCovRegressor(),
    "cholesky-likelihood": CholeskyCovRegressor(objective="likelihood"),
    "wishart-likelihood": WishartProcessRegressor(objective="likelihood", max_iter=500, random_state=3),
    "heteroscedastic": HeteroscedasticGPRegressor(),
    "mixture": GMMBaseline(n_components=3, random_state=3),
    "controller": DMPController(HeteroscedasticGPRegressor(), n_steps=40),
}


def data():
    """X, y and groups: 5 demonstrations of 21 samples."""
    return make_tunnel_demonstrations(5, rate=2.0, random_state=0).stack()


def learned(name):
    """The estimator of this name, fitted afresh."""
    X, y, groups = data()
    model = type(MODELS[name])(**MODELS[name].get_params(deep=False))
    told = {"groups": groups} if name in ("heteroscedastic", "controller") else {}
    return model.fit(X, y, **told)


def predictions(model):
    """Arrays: all that it predicts, draws included."""
    X = np.linspace(-2.0, 12.0, 29)[:, np.newaxis]
    if isinstance(model, DMPController):
        schedule = model.schedule(20.0)
        pushed = model.simulate(force=np.ones_like(schedule.position), rate=20.0)
        parts = (schedule.position, schedule.velocity, schedule.stiffness, schedule.damping, schedule.covariance)
        return [model.predict(X), model.predict_stiffness(X), *parts, pushed.position, pushed.force]
    mean, covariance = model.predict(X, return_cov=True)
    return [mean, covariance, *model.predict_uncertainty(X), model.sample_y(X, 2, random_state=0)]


def digest(name):
    """Hash of the bits that the estimator of this name predicts."""
    together = hashlib.sha256()
    for part in predictions(learned(name)):
        together.update(np.ascontiguousarray(part).tobytes())
    return f"{name} {together.hexdigest()}"


def digests():
    """One line an estimator."""
    return [digest(name) for name in MODELS]


def put_digests(queue):
    """The same, told to another process; on one thread, as that: sums over more are in another order."""
    torch.set_num_threads(1)
    queue.put(digests())


if __name__ == "__main__":
    if len(sys.argv) > 1:
        np.savez(sys.argv[1], **{f"{n} {i}": part for n in MODELS for i, part in enumerate(predictions(learned(n)))})
    else:
        print("\n".join(digests()))

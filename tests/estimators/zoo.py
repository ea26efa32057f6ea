"""The estimators under test, one of each objective, and demonstrations to fit them on."""

import warnings
from functools import cache

import numpy as np
import torch
from sklearn.base import clone
from sklearn.exceptions import ConvergenceWarning

from torch_pbd import CholeskyCovRegressor, GMMBaseline, HeteroscedasticGPRegressor, WishartProcessRegressor

PAPER = {"objective": "likelihood", "latent_prior": False}
VARIANTS = {
    "cholesky": CholeskyCovRegressor(),
    "cholesky-interpolating": CholeskyCovRegressor(noise_scale=0.0),
    "cholesky-log": CholeskyCovRegressor(diagonal="log", bias_correction=True),
    "cholesky-likelihood": CholeskyCovRegressor(objective="likelihood"),
    "cholesky-likelihood-raw": CholeskyCovRegressor(objective="likelihood", diagonal="raw"),
    "cholesky-eq12": CholeskyCovRegressor(**PAPER, max_iter=50),
    "wishart": WishartProcessRegressor(),
    "wishart-likelihood": WishartProcessRegressor(objective="likelihood"),
    "wishart-eq11": WishartProcessRegressor(**PAPER, max_iter=50),
    "heteroscedastic": HeteroscedasticGPRegressor(),
    "mixture": GMMBaseline(n_components=3),
    "mixture-lbfgs": GMMBaseline(n_components=3, solver="lbfgs"),
}
DEFAULTS = ["cholesky", "wishart", "heteroscedastic", "mixture"]
LATENT = [name for name in VARIANTS if not name.startswith("mixture")]  # those that return to a prior
UNALIGNED = [
    name for name in VARIANTS if any(part in name for part in ("likelihood", "eq", "heteroscedastic", "mixture"))
]
# Name, outputs d, inputs e, whether the inputs repeat.
CASES = [(name, d, e, True) for name in VARIANTS for d, e in [(1, 1), (2, 1), (2, 2)]]
CASES += [(name, d, e, False) for name in UNALIGNED for d, e in [(1, 1), (2, 1), (1, 2)]]
CASES += [(name, 9, 1, True) for name in (*DEFAULTS, "cholesky-interpolating", "cholesky-likelihood")]
CASES += [(name, 9, 1, False) for name in ("cholesky-likelihood", "wishart-likelihood", "heteroscedastic", "mixture")]
PLAIN = [(name, 2, 1, True) for name in VARIANTS] + [(name, 2, 1, False) for name in UNALIGNED]


def new(name, **parameters):
    return clone(VARIANTS[name]).set_params(**parameters)


def demonstrations(d=2, e=1, aligned=True, *, n_inputs=8, n_demos=12, seed=0):
    """X and y: a bend with noise whose factor changes along the input; n_demos rows at each of n_inputs inputs."""
    rng = np.random.default_rng(seed)
    n_rows = n_inputs * n_demos
    if not aligned:
        X = rng.uniform(-1.0, 1.0, size=(n_rows, e))
    elif e == 1:
        X = np.tile(np.linspace(-1.0, 1.0, n_inputs)[:, np.newaxis], (n_demos, 1))
    else:
        X = np.tile(rng.uniform(-1.0, 1.0, size=(n_inputs, e)), (n_demos, 1))
    mean, factor = truth(X, d)
    return X, mean + (factor @ rng.normal(size=(n_rows, d, 1)))[..., 0]


def truth(X, d):
    """Mean (n, d) and factor of the covariance (n, d, d) behind the demonstrations."""
    rng = np.random.default_rng(100 + d)
    slope, bend = rng.normal(size=(X.shape[1], d)), rng.normal(size=(d, d))
    factor = np.eye(d) + 0.3 * np.cos(1.5 * X[:, 0])[:, np.newaxis, np.newaxis] * np.tril(bend)
    return 3.0 * np.tanh(X @ slope), factor


def fit(estimator, X, y):
    """Fit, and let it stop early: some variants are held short on purpose."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        return estimator.fit(X, y)


@cache
def fitted(name, d=2, e=1, aligned=True):
    """The estimator, fitted; shared by the tests, which only predict."""
    return fit(new(name), *demonstrations(d, e, aligned))


def queries(e, n=40, seed=1):
    """Inputs between, on the edge of, outside, and far away from the demonstrations, in every direction."""
    rng = np.random.default_rng(seed)
    near = rng.uniform(-1.5, 1.5, size=(n, e))
    direction = rng.normal(size=(5, e))
    far = np.sign(direction) * np.array([3.0, 10.0, 1e3, 1e6, 1e300])[:, np.newaxis]
    return np.vstack([near, far])


def assert_covariances(covariance, n, d):
    """Shape, symmetric to the last bit, positive definite whatever the units."""
    assert covariance.shape == (n, d, d)
    assert covariance.dtype == np.float64
    np.testing.assert_array_equal(covariance, covariance.transpose(0, 2, 1))
    assert np.isfinite(covariance).all()
    deviation = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    assert (deviation > 0).all()
    correlation = covariance / deviation[:, :, np.newaxis] / deviation[:, np.newaxis, :]
    assert (np.linalg.eigvalsh(correlation) > 0).all()


def assert_same_model(model, other, X):
    """Predictions equal to the bit."""
    for mine, others in zip(predictions(model, X), predictions(other, X), strict=True):
        np.testing.assert_array_equal(mine, others)


def predictions(model, X):
    mean, covariance = model.predict(X, return_cov=True)
    return mean, covariance, *model.predict_uncertainty(X), model.sample_y(X, random_state=0)


def random_states():
    """What a fit must leave alone: generators, threads, types, modes."""
    algorithm, keys, *rest = np.random.get_state()  # noqa: NPY002 - the one to leave alone
    return (
        (algorithm, keys.tobytes(), *rest),
        torch.get_rng_state().numpy().tobytes(),
        torch.get_num_threads(),
        torch.get_default_dtype(),
        torch.is_grad_enabled(),
        torch.are_deterministic_algorithms_enabled(),
        warnings.filters[:],
    )

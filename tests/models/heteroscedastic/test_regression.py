import numpy as np
import pytest
import torch
from scipy.linalg import block_diag
from scipy.stats import multivariate_normal

from torch_pbd.models.heteroscedastic.regression import Regression, bidiagonal

# A ridge of 1e-8 beside the standardized outputs' scatter keeps it regular, and moves results by as much.
RTOL = 1e-6
INDEPENDENT = torch.ones(3, 1).double()


class Rows:
    """Residuals of i + 1 outputs at n inputs, and the factor of the covariance of all but the last."""

    def __init__(self, rng, n=3, i=2, k=8, whitener=INDEPENDENT, precision=(1.0, 1.0, 1.0)):
        factor = np.tril(rng.normal(size=(n, i + 1, i + 1)), -1) + np.eye(i + 1) * rng.uniform(0.5, 2.0, (n, 1, i + 1))
        normal = rng.normal(size=(n, k, i + 1))
        self.residual = normal @ factor.transpose(0, 2, 1)
        self.tril, self.before = factor[:, :-1, :-1], normal[..., :-1]
        self.last = self.residual[..., -1]
        scatter = torch.tensor(self.residual.transpose(0, 2, 1) @ self.residual)
        self.regression = Regression.standardize(
            scatter, torch.tensor(self.tril), torch.tensor(precision).double(), whitener
        )


def fitted(regression, features):
    return regression.weights(features[None])


@pytest.mark.parametrize("i", [1, 2, 8])
def test_free_coefficients_are_those_of_least_squares_at_each_input(i, rng):
    precision = [0.5, 2.0, 30.0]
    rows = Rows(rng, i=i, k=12, precision=precision)
    features = 1e4 * torch.eye(3, dtype=torch.float64)  # one weight for each input, hardly held to zero
    weights = fitted(rows.regression, features)
    coefficients = (features @ weights.mean.reshape(i, 3).mT).numpy()
    covariance = (weights.root @ weights.root.mT).numpy().reshape(i, 3, i, 3) * 1e8
    for t in range(3):
        expected = np.linalg.lstsq(rows.before[t], rows.last[t])[0]
        np.testing.assert_allclose(coefficients[t], expected, rtol=RTOL, atol=RTOL)
        inverse = np.linalg.inv(rows.before[t].T @ rows.before[t]) / precision[t]
        np.testing.assert_allclose(covariance[:, t, :, t], inverse, rtol=1e-5, atol=1e-5 * inverse.max())


def correlations(whitened, n=3):
    """Along a line: of a Markov process, whose inverse is zero but for neighbours, and of one that is none."""
    distance = np.abs(np.subtract.outer(range(n), range(n)))
    return np.exp(-distance / 2.0) if whitened != "smooth" else np.exp(-np.square(distance / 2.0))


def whitener_of(whitened):
    """Inverse factor of the correlation; of independent inputs its diagonal."""
    if whitened is None:
        return INDEPENDENT
    return bidiagonal(torch.tensor(np.linalg.inv(np.linalg.cholesky(correlations(whitened)))))


@pytest.mark.parametrize("whitened", [None, "markov", "smooth"])
def test_log_evidence_is_the_density_of_the_rows_but_for_what_no_features_change(whitened, rng):
    """With a whitener the mean of one row a time: the roots' rows stand for the directions at an input."""
    correlation = correlations(whitened)
    precision = np.array([0.5, 2.0, 5.0])
    rows = Rows(rng, whitener=whitener_of(whitened), precision=precision)
    assert (rows.regression.couplings is None) == (whitened == "smooth")
    features = rng.normal(size=(4, 3, 5)) * np.geomspace(0.1, 3.0, 4)[:, np.newaxis, np.newaxis]
    mixing = rows.regression.mixing.numpy()
    if whitened:
        before, response = mixing, rows.regression.response.numpy()
        noise = np.kron(correlation, np.eye(2))
    else:
        before, response, noise = rows.before, rows.last, np.diag(np.repeat(1.0 / precision, 8))
    expected = []
    for phi in features:
        one = block_diag(*before) @ np.kron(phi, np.eye(2))
        expected.append(multivariate_normal(cov=noise + one @ one.T).logpdf(response.ravel()))
    found = rows.regression.fit(torch.tensor(features).unsqueeze(1)).value.numpy()
    np.testing.assert_allclose(np.diff(found), np.diff(expected), rtol=RTOL, atol=RTOL)


def test_squares_are_those_of_the_rows_and_what_the_error_of_the_coefficients_adds(rng):
    rows = Rows(rng)
    features = rng.normal(size=(3, 4))
    mean, root = rng.normal(size=8), np.triu(rng.normal(size=(8, 8)))
    parameters = torch.tensor(features), torch.tensor(mean), torch.tensor(root @ root.T)
    expected = rows.regression.expected_squares(*parameters)
    for t in range(3):
        spread = np.kron(np.eye(2), features[t])  # coefficients from weights
        residual = rows.last[t] - rows.before[t] @ (spread @ mean)
        covariance = spread @ root @ root.T @ spread.T
        trace = sum(row @ covariance @ row for row in rows.before[t])
        assert float(expected[t]) == pytest.approx(residual @ residual + trace, rel=RTOL)


@pytest.mark.parametrize(("i", "k"), [(1, 5), (2, 8), (8, 20)])
def test_local_squares_are_the_residual_sum_of_squares(i, k, rng):
    rows = Rows(rng, i=i, k=k)
    expected = [np.sum((y - z @ np.linalg.lstsq(z, y)[0]) ** 2) for z, y in zip(rows.before, rows.last, strict=True)]
    np.testing.assert_allclose(rows.regression.local_squares(), expected, rtol=RTOL)


@pytest.mark.parametrize(("i", "k"), [(2, 2), (4, 2), (8, 1)])
def test_fewer_rows_than_outputs_leave_no_squares_and_do_not_fail(i, k, rng):
    rows = Rows(rng, i=i, k=k)
    size = (rows.last**2).sum(1)
    local = rows.regression.local_squares().numpy()
    assert (local >= 0.0).all()
    assert (local < 1e-4 * size).all()
    features = torch.ones(3, 1, dtype=torch.float64)
    weights = fitted(rows.regression, features)
    # A ridge regression: what the rows do not tell stays at the prior.
    gram = sum(z.T @ z for z in rows.before) + np.eye(i)
    cross = sum(z.T @ y for z, y in zip(rows.before, rows.last, strict=True))
    np.testing.assert_allclose(weights.mean, np.linalg.solve(gram, cross), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("whitened", [None, "markov", "smooth"])
@pytest.mark.parametrize("i", [1, 3])
def test_gradient_of_the_log_evidence_is_that_of_autograd(i, whitened, rng):
    known = Rows(rng, i=i, whitener=whitener_of(whitened), precision=[0.5, 2.0, 5.0]).regression
    features = torch.tensor(rng.normal(size=(2, 3, 4))).requires_grad_()
    (expected,) = torch.autograd.grad(known.fit(features.unsqueeze(1)).value.sum(), features)
    with torch.no_grad():
        found = known.gradient(known.fit(features.unsqueeze(1)), features)
    torch.testing.assert_close(found, expected, rtol=1e-8, atol=1e-8)


def test_the_weights_are_those_of_the_design_whose_precision_is_too_large_to_form(rng):
    """By blocks up to where these lose the prior's digits, and by QR beyond: the same within what is left."""
    known = Rows(rng, precision=[0.5, 2.0, 5.0]).regression
    features = torch.tensor(rng.normal(size=(1, 1, 3, 2)))
    by_blocks, by_design = (known.fit(scale * features) for scale in (1e3, 1e5))
    torch.testing.assert_close(by_blocks.mean / 1e2, by_design.mean, rtol=1e-5, atol=1e-10)
    both = known.fit(torch.cat([1e3 * features, 1e5 * features])).value  # all by the design, for the second
    torch.testing.assert_close(both[0], by_blocks.value[0], rtol=1e-6, atol=0)

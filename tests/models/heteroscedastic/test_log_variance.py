import numpy as np
import pytest
import torch
from scipy.integrate import trapezoid
from scipy.optimize import minimize
from scipy.special import digamma, polygamma
from scipy.stats import chi2, lognorm, multivariate_normal
from torch.distributions import MultivariateNormal, kl_divergence

from torch_pbd.models.heteroscedastic import log_variance
from torch_pbd.models.heteroscedastic.log_variance import Squares
from torch_pbd.models.heteroscedastic.regression import NoiseCorrelation, bidiagonal

INDEPENDENT = None


def fit(squares, features, start=None):
    return log_variance.fit_log_variance(squares, features, squares.log_pooled if start is None else start)


def fit_log_variance(squares, features):
    found = fit(squares, features)
    return found.posterior.weights, found.posterior.value


def squares_at(n, rng, degrees=None, outputs=2, noise=INDEPENDENT):
    """Sums of squares around a log variance that bends, of fractional degrees of freedom too."""
    degrees = rng.uniform(0.7, 12.0, size=(outputs, n)) if degrees is None else np.full((outputs, n), degrees)
    total = np.exp(np.sin(np.linspace(0.0, 4.0, n))) * rng.chisquare(degrees)
    return Squares(torch.tensor(total), torch.tensor(degrees), noise)


def lower_bound(mean, covariance, features, total, degrees):
    """E_q[log density of the normal residuals] less KL(q, prior)."""
    location = features @ mean
    variance = np.einsum("np,pq,nq->n", features, covariance, features)
    precision = lognorm(s=np.sqrt(variance), scale=np.exp(-location)).mean()
    prior = MultivariateNormal(torch.zeros(len(mean)).double(), torch.eye(len(mean)).double())
    divergence = kl_divergence(MultivariateNormal(torch.tensor(mean), torch.tensor(covariance)), prior)
    log_density = -0.5 * (degrees * (np.log(2.0 * np.pi) + location) + total * precision)
    return float(log_density.sum() - divergence)


@pytest.mark.parametrize("theta", [[-1.0, 0.0], [0.5, 0.0], [-1.0, 1.5], [-3.0, -2.0]])
def test_the_evidence_is_the_lower_bound(theta, family, inputs, rng):
    squares = squares_at(9, rng)
    features = family.prepared(torch.tensor([theta] * 2, dtype=torch.float64))(inputs)
    weights, evidence = fit_log_variance(squares, features)
    covariance = (weights.root @ weights.root.mT).numpy()
    parts = (weights.mean.numpy(), covariance, features.numpy(), squares.total.numpy(), squares.degrees.numpy())
    expected = [lower_bound(*(part[i] for part in parts)) for i in range(2)]
    np.testing.assert_allclose(evidence, expected, rtol=1e-9)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3], ids=["far below", "near", "far above"])
def test_the_posterior_mean_maximizes_the_lower_bound(scale, family, inputs, rng):
    """The bound is concave in the mean: where its gradient is zero is its maximum."""
    squares = squares_at(9, rng)
    squares = Squares(scale * squares.total, squares.degrees, INDEPENDENT)
    features = family.prepared(torch.tensor([[-1.0, 0.5]] * 2, dtype=torch.float64))(inputs)
    weights, _ = fit_log_variance(squares, features)
    mean = weights.mean.requires_grad_()
    location = (features @ mean.unsqueeze(-1)).squeeze(-1)
    variance = (features @ weights.root @ weights.root.mT * features).sum(-1)
    expected = -0.5 * (squares.degrees * location + squares.total * torch.exp(0.5 * variance - location))
    (gradient,) = torch.autograd.grad(expected.sum() - 0.5 * mean.square().sum(), mean)
    # Steps end at 1e-8; a weight's information is up to its square of features times the degrees, here 1e2.
    torch.testing.assert_close(gradient, torch.zeros_like(gradient), rtol=0, atol=1e-5)


class Evidence(torch.autograd.Function):
    """The evidence with its closed-form gradient, for gradcheck."""

    @staticmethod
    def forward(ctx, features, squares):
        found = fit(squares, features.detach())
        ctx.save_for_backward(found.gradient())
        return found.posterior.value

    @staticmethod
    def backward(ctx, upstream):
        return upstream[:, None, None] * ctx.saved_tensors[0], None


@pytest.mark.parametrize("correlated", [None, "along a line", "with all"])
def test_gradient_of_the_evidence(correlated, family, inputs, rng):
    """The mean is at its maximum: its derivative does not enter (the envelope)."""
    copies = torch.tensor(rng.uniform(1.0, 3.0, size=(2, 9)))
    whitener = torch.tensor(np.tril(rng.normal(size=(2, 9, 9)), -1) + np.eye(9))
    whitener = bidiagonal(whitener.triu(-1)) if correlated == "along a line" else whitener
    assert whitener.shape[-1] == (2 if correlated == "along a line" else 9)
    squares = squares_at(9, rng, noise=NoiseCorrelation(whitener, copies) if correlated else INDEPENDENT)
    theta = torch.tensor([[-1.0, 0.3], [-0.4, -0.6]], dtype=torch.float64)
    features = family.prepared(theta)(inputs).requires_grad_()
    assert torch.autograd.gradcheck(lambda features: Evidence.apply(features, squares), features, atol=1e-4)


@pytest.mark.parametrize("start", [-30.0, 0.0, 30.0])
def test_the_posterior_does_not_depend_on_where_it_starts(start, family, inputs, rng):
    squares = squares_at(9, rng, degrees=1.0)
    features = family.prepared(torch.tensor([[-1.0, 0.5]] * 2, dtype=torch.float64))(inputs)
    expected, found = fit(squares, features), fit(squares, features, torch.full((2, 9), start).double())
    torch.testing.assert_close(found.location, expected.location, rtol=0, atol=1e-7)
    torch.testing.assert_close(found.posterior.value, expected.posterior.value, rtol=1e-12, atol=1e-12)


def exact_posterior(features, total, degrees):
    """Mean and deviation of two weights, and the log evidence, by quadrature on a grid."""
    axis = np.linspace(-6.0, 6.0, 201)
    weights = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1)
    location = weights @ features.T
    log_density = -0.5 * (degrees * location + total * np.exp(-location)).sum(-1)
    log_density -= 0.5 * np.square(weights).sum(-1) + np.log(2.0 * np.pi)
    most = log_density.max()
    density = np.exp(log_density - most)

    def integral(values):
        return trapezoid(trapezoid(values, axis), axis)

    norm = integral(density)
    mean = np.array([integral(weights[..., i] * density) for i in (0, 1)]) / norm
    square = np.array([integral(np.square(weights[..., i] - mean[i]) * density) for i in (0, 1)]) / norm
    return mean, np.sqrt(square), most + np.log(norm)


def laplace(features, total, degrees):
    """The same by the normal distribution with the mode and the curvature of the posterior."""

    def loss(weights):
        location = features @ weights
        return 0.5 * (degrees * location + total * np.exp(-location)).sum() + 0.5 * weights @ weights

    mode = minimize(loss, np.zeros(2), tol=1e-12).x
    hessian = np.eye(2) + features.T @ np.diag(0.5 * total * np.exp(-features @ mode)) @ features
    return mode, np.sqrt(np.diag(np.linalg.inv(hessian))), -loss(mode) - 0.5 * np.linalg.slogdet(hessian)[1]


# Measured: mean .048 / .032 / .003 of a deviation against Laplace's .34 / .27 / .10, deviation .136 / .101 / .034
# against .051 / .035 / .005, evidence -.062 / -.039 / -.004 nats against -.017 / -.016 / -.002.
@pytest.mark.parametrize(
    ("degrees", "bars"), [(2, [0.07, 0.17, 0.08]), (5, [0.05, 0.13, 0.05]), (49, [0.006, 0.05, 0.006])]
)
def test_the_posterior_is_near_the_exact_one_and_that_of_laplace(degrees, bars):
    """Medians over 20 draws of the errors in mean (deviations), deviation (relative) and evidence (nats).

    The mean is several times nearer to quadrature's than the mode is, which the skewness of the likelihood
    shifts; deviation and evidence are Laplace's by a few hundredths, whose curvature is the observed one.
    """
    features = np.column_stack([np.linspace(-0.9, 1.1, 4), np.full(4, 1.5)])
    errors = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        total = np.exp(features @ [0.8, -0.4]) * rng.chisquare(degrees, size=4)
        count = torch.full((1, 4), float(degrees), dtype=torch.float64)
        squares = Squares(torch.tensor(total)[None], count, INDEPENDENT)
        weights, evidence = fit_log_variance(squares, torch.tensor(features)[None])
        bound = float(evidence) + 0.5 * 4 * degrees * np.log(2.0 * np.pi)
        ours = weights.mean[0].numpy(), weights.root[0].square().sum(1).sqrt().numpy(), bound
        mean, deviation, log_evidence = exact_posterior(features, total, degrees)
        errors.append(
            [
                [np.abs((m - mean) / deviation).max(), np.abs(s / deviation - 1.0).max(), e - log_evidence]
                for m, s, e in (ours, laplace(features, total, degrees))
            ]
        )
    variational, curvature = np.median(np.abs(errors), axis=0)
    assert (variational < bars).all()
    assert variational[0] < curvature[0] / 5.0
    assert np.abs(variational - curvature)[1:].max() < 0.1
    assert (np.array(errors)[:, 0, 2] < 1e-6).all()  # a bound lies below


def test_the_posterior_covariance_is_of_the_fisher_information(family, inputs, rng):
    """Minus the expected second derivative of the log density of a chi-squared sum, in its log variance."""
    squares = squares_at(9, rng)
    features = family.prepared(torch.tensor([[-1.0, 0.5]] * 2, dtype=torch.float64))(inputs)
    weights, _ = fit_log_variance(squares, features)
    quantile = (np.arange(20_000) + 0.5) / 20_000
    for i in range(2):
        information = []
        for degrees, value in zip(squares.degrees[i].numpy(), (-3.0, 0.0, 2.0) * 3, strict=True):
            total = np.exp(value) * chi2(degrees).ppf(quantile)
            step = 1e-3
            log_density = [chi2(degrees).logpdf(total / np.exp(g)) - g for g in value + step * np.arange(-1.0, 2.0)]
            information.append(-np.mean(log_density[0] - 2.0 * log_density[1] + log_density[2]) / step**2)
        expected = np.eye(10) + features[i].numpy().T @ np.diag(information) @ features[i].numpy()
        covariance = (weights.root[i] @ weights.root[i].mT).numpy()
        # Midpoints of 20 000 quantiles lose a little of the tail.
        np.testing.assert_allclose(np.linalg.inv(covariance), expected, rtol=2e-3, atol=2e-3)


def test_correlated_squares_are_a_gaussian_process_regression_of_their_logarithms(family, inputs, rng):
    """Rows that are copies count once: means of ``degrees / copies`` squares, correlated along demonstrations."""
    copies = rng.uniform(1.0, 3.0, size=9)
    correlation = np.exp(-np.abs((inputs - inputs.T).numpy()) / 0.2)
    matrix = np.sqrt(copies)[:, np.newaxis] * correlation * np.sqrt(copies)
    whitener = np.linalg.inv(np.linalg.cholesky(matrix))
    squares = squares_at(
        9, rng, noise=NoiseCorrelation(*(torch.tensor(np.stack([part, part])) for part in (whitener, copies)))
    )
    features = family.prepared(torch.tensor([[-1.0, 0.5], [0.3, -0.5]], dtype=torch.float64))(inputs)
    weights, evidence = fit_log_variance(squares, features)
    for i in range(2):
        half, phi = 0.5 * squares.degrees[i].numpy() / copies, features[i].numpy()
        response = np.log(squares.total[i].numpy() / squares.degrees[i].numpy()) - digamma(half) + np.log(half)
        deviation = np.sqrt(polygamma(1, half))
        noise = deviation[:, np.newaxis] * correlation * deviation
        gram = phi @ phi.T
        gain = gram @ np.linalg.inv(gram + noise)
        np.testing.assert_allclose(phi @ weights.mean[i].numpy(), gain @ response, rtol=1e-9, atol=1e-9)
        root = phi @ weights.root[i].numpy()
        np.testing.assert_allclose(root @ root.T, gram - gain @ gram, rtol=1e-8, atol=1e-9)
        # The constants of the normal density and of the whitener are left out, which nothing changes.
        constant = 4.5 * np.log(2.0 * np.pi) + 0.5 * np.linalg.slogdet(matrix)[1]
        expected = multivariate_normal(cov=gram + noise).logpdf(response) + constant
        assert float(evidence[i]) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("degrees", [1.0, 2.5, 9.0])
def test_correlated_squares_have_no_bias(degrees, rng):
    """A logarithm of a chi-squared number over its degrees is below zero in the mean."""
    noise = NoiseCorrelation(torch.ones(20_000, 4, 1).double(), torch.ones(20_000, 4).double())
    squares = squares_at(4, rng, degrees, 20_000, noise)
    truth = np.sin(np.linspace(0.0, 4.0, 4))
    weights, _ = fit_log_variance(squares, 1e3 * torch.eye(4, dtype=torch.float64).expand(20_000, 4, 4))
    error = 1e3 * weights.mean.numpy() - truth
    limit = 4.0 * np.sqrt(polygamma(1, degrees / 2.0) / len(error))
    assert np.abs(error.mean(0)).max() < limit < 0.1


def test_processes_are_fitted_each_by_itself(family, inputs, rng):
    squares = squares_at(9, rng)
    features = family.prepared(torch.tensor([[-1.0, 0.5], [0.3, -0.5]], dtype=torch.float64))(inputs)
    weights, evidence = fit_log_variance(squares, features)
    for i in range(2):
        alone, own = fit_log_variance(squares.restrict(torch.tensor([i])), features[i : i + 1])
        torch.testing.assert_close(alone.mean[0], weights.mean[i], rtol=0, atol=1e-7)
        torch.testing.assert_close(own[0], evidence[i], rtol=1e-12, atol=1e-12)


def test_squares_of_zero_have_a_finite_posterior(family, inputs):
    features = family.prepared(torch.tensor([[-1.0, 0.5]], dtype=torch.float64))(inputs)
    total = torch.ones(1, 9, dtype=torch.float64)
    total[0, 4] = 0.0
    weights, evidence = fit_log_variance(Squares(total, 5.0 * torch.ones_like(total), INDEPENDENT), features)
    location = (features @ weights.mean.unsqueeze(-1)).flatten()
    assert torch.isfinite(evidence).all()
    assert location.argmin() == 4
    assert location.min() > -14.0  # the logarithm of the least mean square

import io
import warnings

import gmr
import numpy as np
import pytest
import sklearn.mixture
import torch
from scipy.stats import multivariate_normal
from sklearn.cluster import KMeans
from sklearn.exceptions import ConvergenceWarning

from torch_pbd.exceptions import NotPositiveDefiniteError
from torch_pbd.models.mixture import GaussianMixture, expectation_maximization, refine
from torch_pbd.optim.batch import Status

REG = 1e-6


def tensor(array):
    return torch.tensor(array, dtype=torch.float64)


def curve(rng, n=400):
    """A bend with noise that grows along it, standardized: one input, two outputs."""
    t = rng.uniform(size=n)
    y = np.column_stack([np.sin(6 * t), np.cos(4 * t)]) + rng.normal(size=(n, 2)) * (0.02 + 0.1 * t)[:, None]
    data = np.column_stack([t, y])
    return (data - data.mean(0)) / data.std(0)


def one_hot(data, k):
    labels = KMeans(k, n_init=1, random_state=0).fit_predict(data)
    return np.eye(k)[labels]


def fit(data, k, *, n_features=1, reg_covar=REG, tol=1e-10, max_iter=2000):
    shares = tensor(one_hot(data, k))
    return expectation_maximization(
        tensor(data), shares, n_features=n_features, reg_covar=reg_covar, tol=tol, max_iter=max_iter
    )


def fit_sklearn(data, k, *, reg_covar=REG, tol=1e-10, max_iter=2000):
    """scikit-learn's fit from the M step of the same responsibilities."""
    shares = one_hot(data, k)
    weights, means = shares.mean(0), shares.T @ data / shares.sum(0)[:, None]
    covariances = [np.cov(data.T, aweights=share, bias=True) for share in shares.T]
    precisions = np.linalg.inv(np.stack(covariances) + reg_covar * np.eye(data.shape[1]))
    model = sklearn.mixture.GaussianMixture(
        k,
        weights_init=weights,
        means_init=means,
        precisions_init=precisions,
        init_params="random",
        random_state=0,
        reg_covar=reg_covar,
        tol=tol,
        max_iter=max_iter,
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        return model.fit(data)


def random_mixture(k, e, d, generator):
    def randn(*shape):
        return torch.randn(*shape, dtype=torch.float64, generator=generator)

    lower, log_diagonal = 0.3 * randn(k, e + d, e + d).tril(-1), (0.5 + randn(k, e + d).abs()).log()
    return GaussianMixture(randn(k), randn(k, e + d), log_diagonal, lower, e)


def numpy_parts(mixture):
    with torch.no_grad():
        weight = mixture.log_weight.softmax(0).numpy()
        return weight, mixture.mean.numpy().copy(), (mixture.scale_tril @ mixture.scale_tril.mT).numpy()


def condition(mixture, x):
    """GMR by the textbook: Schur complements, one input at a time."""
    weight, mean, covariance = numpy_parts(mixture)
    e, means, covariances = mixture.n_features, [], []
    for query in x:
        density = [
            w * multivariate_normal(m[:e], c[:e, :e]).pdf(query)
            for w, m, c in zip(weight, mean, covariance, strict=True)
        ]
        h = np.array(density) / np.sum(density)
        gain = [c[e:, :e] @ np.linalg.inv(c[:e, :e]) for c in covariance]
        mu = np.stack([m[e:] + g @ (query - m[:e]) for m, g in zip(mean, gain, strict=True)])
        schur = np.stack([c[e:, e:] - g @ c[:e, e:] for c, g in zip(covariance, gain, strict=True)])
        means.append(h @ mu)
        spread = mu - means[-1]
        covariances.append(np.einsum("k,kij->ij", h, schur) + np.einsum("k,ki,kj->ij", h, spread, spread))
    return np.stack(means), np.stack(covariances)


def predict(mixture, x):
    with torch.no_grad():
        mean, root = mixture(tensor(x))
    return mean.numpy(), (root @ root.mT).numpy()


@pytest.mark.parametrize("k", [1, 3, 5, 8])
def test_em_makes_the_steps_of_scikit_learn(k, rng):
    data = curve(rng)
    mixture, report = fit(data, k, tol=0.0, max_iter=10)
    expected = fit_sklearn(data, k, tol=0.0, max_iter=10)
    weight, mean, covariance = numpy_parts(mixture)
    np.testing.assert_allclose(weight, expected.weights_, rtol=1e-9)
    np.testing.assert_allclose(mean, expected.means_, rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(covariance, expected.covariances_, rtol=1e-9, atol=1e-11)
    assert not report.converged
    assert report.loss == pytest.approx(-expected.score(data), rel=1e-11)


@pytest.mark.parametrize("k", [1, 3, 5, 8])
def test_em_ends_where_scikit_learn_does(k, rng):
    data = curve(rng)
    mixture, report = fit(data, k)
    assert report.converged
    # Both stop within tol of a step, so they may stand one step apart.
    assert report.loss == pytest.approx(-fit_sklearn(data, k).score(data), abs=1e-8)
    log_prob = mixture.log_prob(tensor(data)).mean()
    assert log_prob.item() == pytest.approx(-report.loss, rel=1e-11)


@pytest.mark.parametrize("k", [1, 3])
def test_em_agrees_on_data_that_are_all_but_degenerate(k, rng):
    axes = np.linalg.qr(rng.normal(size=(3, 3))).Q
    data = (curve(rng) * np.array([1.0, 1e-2, 1e-5])) @ axes
    assert np.linalg.cond(np.cov(data.T)) > 0.9e10
    _, report = fit(data, k, reg_covar=1e-20, tol=0.0, max_iter=10)
    expected = fit_sklearn(data, k, reg_covar=1e-20, tol=0.0, max_iter=10)
    # The covariances that scikit-learn factorizes carry the smallest variance to 1e10 * 1e-16.
    assert report.loss == pytest.approx(-expected.score(data), abs=1e-6)


@pytest.mark.parametrize("k", [1, 4])
def test_rotating_and_squeezing_the_data_shifts_the_likelihood_by_its_jacobian(k, rng):
    data = curve(rng)
    scale, axes = np.array([1.0, 1e-3, 1e-6]), np.linalg.qr(rng.normal(size=(3, 3))).Q
    shares = tensor(one_hot(data, k))
    options = {"n_features": 1, "tol": 0.0, "max_iter": 20}
    _, plain = expectation_maximization(tensor(data), shares, reg_covar=1e-30, **options)
    _, squeezed = expectation_maximization(tensor((data * scale) @ axes), shares, reg_covar=1e-30, **options)
    # Forming the rotated data rounds the smallest direction to 1e-16 / 1e-6.
    assert squeezed.loss - np.log(scale).sum() == pytest.approx(plain.loss, abs=1e-8)


@pytest.mark.parametrize("k", [1, 5])
def test_a_variance_far_below_the_movement_survives(k, rng):
    t = rng.uniform(-1, 1, size=2000)
    noise = 1e-6 * rng.normal(size=2000)
    mixture, _ = fit(np.column_stack([t, 0.5 * t + noise]), k, reg_covar=1e-16)
    _, covariance = predict(mixture, np.linspace(-0.9, 0.9, 7)[:, None])
    # Some 400 draws a component: 7 % of statistical error, 4 of them allowed.
    np.testing.assert_allclose(covariance.ravel(), 1e-12, rtol=0.28)


def test_em_splits_the_rows_into_blocks_without_a_trace(rng, monkeypatch):
    data = curve(rng)
    whole, _ = fit(data, 3, tol=0.0, max_iter=5)
    monkeypatch.setattr("torch_pbd.models.mixture._BLOCK", 77)
    blocks, _ = fit(data, 3, tol=0.0, max_iter=5)
    torch.testing.assert_close(blocks.state_dict(), whole.state_dict(), rtol=1e-9, atol=1e-11)


def test_em_returns_its_best_point_and_says_when_it_was_stopped(rng):
    data = curve(rng)
    _, first = fit(data, 5, max_iter=0)
    assert (first.n_iter, first.converged, first.loss_curve) == (0, False, (first.loss,))
    mixture, report = fit(data, 5, max_iter=3)
    assert report.status is Status.MAX_ITER
    assert report.n_iter == 3
    assert report.loss < first.loss
    assert list(report.loss_curve) == sorted(report.loss_curve, reverse=True)
    assert mixture.log_prob(tensor(data)).mean().item() == pytest.approx(-report.loss, rel=1e-11)


def test_em_goes_back_when_the_floor_makes_it_lose(rng):
    data = curve(rng)
    mixture, report = fit(data, 3, reg_covar=0.5, tol=0.0, max_iter=50)
    last = -fit_sklearn(data, 3, reg_covar=0.5, tol=0.0, max_iter=50).score(data)
    assert report.loss < last - 1e-3
    assert mixture.log_prob(tensor(data)).mean().item() == pytest.approx(-report.loss, rel=1e-11)


def test_a_component_on_one_point_needs_the_floor(rng):
    data = np.concatenate([rng.normal(size=(50, 2)), np.full((3, 2), 30.0)])
    shares = tensor(np.eye(2)[[0] * 50 + [1] * 3])
    options = {"n_features": 1, "tol": 1e-8, "max_iter": 10}
    mixture, _ = expectation_maximization(tensor(data), shares, reg_covar=REG, **options)
    np.testing.assert_allclose(numpy_parts(mixture)[2][1], REG * np.eye(2), rtol=1e-9, atol=1e-15)
    with pytest.raises(NotPositiveDefiniteError, match="raise reg_covar"):
        expectation_maximization(tensor(data), shares, reg_covar=0.0, **options)


@pytest.mark.parametrize(("e", "d"), [(1, 1), (1, 2), (2, 2), (2, 9)])
@pytest.mark.parametrize("k", [1, 4])
def test_conditioning_is_that_of_the_textbook(k, e, d, rng, generator):
    mixture = random_mixture(k, e, d, generator)
    x = 2 * rng.normal(size=(6, e))
    mean, covariance = predict(mixture, x)
    expected_mean, expected_covariance = condition(mixture, x)
    np.testing.assert_allclose(mean, expected_mean, rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(covariance, expected_covariance, rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize(("e", "d"), [(1, 2), (2, 9)])
def test_conditioning_is_that_of_gmr(e, d, rng, generator):
    mixture = random_mixture(4, e, d, generator)
    weight, mean, covariance = numpy_parts(mixture)
    peer = gmr.GMM(n_components=4, priors=weight, means=mean, covariances=covariance)
    x = rng.normal(size=(6, e))
    predicted_mean, predicted_covariance = predict(mixture, x)
    for row, query in enumerate(x):
        expected = peer.condition(np.arange(e), query).to_mvn()
        np.testing.assert_allclose(predicted_mean[row], expected.mean, rtol=1e-9, atol=1e-11)
        np.testing.assert_allclose(predicted_covariance[row], expected.covariance, rtol=1e-9, atol=1e-11)


def test_one_component_is_linear_regression(rng):
    data = curve(rng)
    mixture, _ = fit(data, 1, reg_covar=1e-14)
    design = np.column_stack([np.ones(len(data)), data[:, :1]])
    slope, *_ = np.linalg.lstsq(design, data[:, 1:])
    residual = data[:, 1:] - design @ slope
    x = np.linspace(-3, 3, 5)[:, None]
    mean, covariance = predict(mixture, x)
    np.testing.assert_allclose(mean, np.column_stack([np.ones(5), x]) @ slope, rtol=1e-9, atol=1e-11)
    expected = np.broadcast_to(residual.T @ residual / len(data), (5, 2, 2))
    np.testing.assert_allclose(covariance, expected, rtol=1e-9, atol=1e-11)


def test_densities_are_those_of_scipy(rng, generator):
    mixture = random_mixture(3, 2, 1, generator)
    data = rng.normal(size=(5, 3))
    parts = list(zip(*numpy_parts(mixture), strict=True))
    joint = np.sum([w * multivariate_normal(m, c).pdf(data) for w, m, c in parts], axis=0)
    inputs = np.sum([w * multivariate_normal(m[:2], c[:2, :2]).pdf(data[:, :2]) for w, m, c in parts], axis=0)
    with torch.no_grad():
        np.testing.assert_allclose(mixture.log_prob(tensor(data)), np.log(joint), rtol=1e-9)
        np.testing.assert_allclose(mixture.log_prob(tensor(data[:, :2])), np.log(inputs), rtol=1e-9)


def test_densities_and_conditioning_are_differentiable(rng, generator):
    mixture = random_mixture(3, 1, 2, generator)
    names, values = zip(*mixture.named_parameters(), strict=True)

    def call(method, data, *parameters):
        parameters = dict(zip(names, parameters, strict=True))
        if method == "forward":
            return torch.func.functional_call(mixture, parameters, (data,))
        return torch.func.functional_call(_Method(mixture, method), _inside(parameters), (data,))

    for method, width in [("log_prob", 3), ("log_prob", 1), ("forward", 1)]:
        data = tensor(rng.normal(size=(3, width))).requires_grad_()
        assert torch.autograd.gradcheck(lambda *inputs, m=method: call(m, *inputs), (data, *values))


class _Method(torch.nn.Module):
    def __init__(self, inner, method):
        super().__init__()
        self.inner = inner
        self.method = method

    def forward(self, data):
        return getattr(self.inner, self.method)(data)


def _inside(parameters):
    return {f"inner.{name}": value for name, value in parameters.items()}


@pytest.mark.parametrize("distance", [10.0, 1e3, 1e20, 1e100, 1e300, np.inf])
def test_far_inputs_stay_finite_with_their_gradients(distance, rng):
    mixture, _ = fit(curve(rng), 5)
    x = tensor([[-distance], [distance]]).requires_grad_()
    mean, root = mixture(x)
    density = mixture.log_prob(x)
    joint = mixture.log_prob(torch.cat([x, x, -x], dim=1))
    for value in (mean, root, root @ root.mT, density, joint, mixture.type1(x)):
        assert torch.isfinite(value).all()
    gradients = torch.autograd.grad(mean.sum() + root.sum() + density.sum(), [x, *mixture.parameters()])
    assert all(torch.isfinite(gradient).all() for gradient in gradients)


def test_an_input_that_is_not_a_number_shows(rng):
    mixture, _ = fit(curve(rng), 3)
    mean, _ = mixture(tensor([[np.nan], [0.0]]))
    assert torch.isnan(mean).all(-1).tolist() == [True, False]


def test_far_inputs_follow_one_component(rng):
    mixture, _ = fit(curve(rng), 5)
    _, covariance = predict(mixture, [[40.0], [80.0]])
    np.testing.assert_allclose(covariance[0], covariance[1], rtol=1e-9)


def test_type1_is_zero_on_training_inputs_and_one_far_away(rng):
    data = curve(rng)
    mixture, _ = fit(data, 5)
    inputs = data[:, :1]
    with torch.no_grad():
        np.testing.assert_allclose(mixture.type1(tensor(inputs)), 0.0, atol=1e-12)
        np.testing.assert_array_equal(mixture.type1(tensor([[-50.0], [50.0], [1e300]])), 1.0)
        outside = mixture.type1(tensor(np.linspace(inputs.max(), 10 * inputs.max(), 50)[:, None])).numpy()
    assert (np.diff(outside) >= 0).all()
    assert ((outside >= 0) & (outside <= 1)).all()


def test_refining_a_stopped_fit_improves_it_and_moves_its_density_floor(rng):
    data = tensor(curve(rng))
    mixture, report = fit(data.numpy(), 5, max_iter=3)
    refined = refine(mixture, data, reg_covar=REG, tol=1e-7, max_iter=300)
    assert refined.loss_curve[0] == pytest.approx(report.loss, rel=1e-9)
    assert refined.loss < report.loss - 0.01
    assert -mixture.log_prob(data).mean().item() == pytest.approx(refined.loss, rel=1e-11)
    assert mixture.log_density_floor.item() == mixture.log_prob(data[:, :1]).min().item()
    assert np.linalg.eigvalsh(numpy_parts(mixture)[2]).min() >= REG * (1 - 1e-6)


@pytest.mark.parametrize("k", [1, 3, 8])
def test_refining_is_never_worse_than_a_converged_fit(k, rng):
    data = tensor(curve(rng))
    mixture, report = fit(data.numpy(), k)
    refined = refine(mixture, data, reg_covar=REG, tol=1e-8, max_iter=100)
    assert refined.loss <= report.loss + 1e-12
    assert -mixture.log_prob(data).mean().item() <= report.loss + 1e-12


def test_refining_keeps_the_floor_under_a_collapsed_component(rng):
    data = np.concatenate([rng.normal(size=(60, 2)), np.full((3, 2), 5.0)])
    shares = tensor(np.eye(2)[[0] * 60 + [1] * 3])
    options = {"reg_covar": 1e-3, "tol": 1e-8}
    mixture, report = expectation_maximization(tensor(data), shares, n_features=1, max_iter=5, **options)
    refined = refine(mixture, tensor(data), max_iter=100, **options)
    assert refined.loss <= report.loss
    np.testing.assert_allclose(numpy_parts(mixture)[2][1], 1e-3 * np.eye(2), rtol=1e-3, atol=1e-6)


def test_the_state_is_the_model(rng):
    mixture, _ = fit(curve(rng), 3)
    file = io.BytesIO()
    torch.save(mixture.state_dict(), file)
    file.seek(0)
    zeros = [torch.zeros_like(parameter) for parameter in mixture.parameters()]
    copy = GaussianMixture(*zeros, 1)
    copy.load_state_dict(torch.load(file, weights_only=True))
    x = tensor([[0.3], [9.0]])
    assert all(torch.equal(a, b) for a, b in zip(copy(x), mixture(x), strict=True))
    assert torch.equal(copy.type1(x), mixture.type1(x))


def test_single_precision_stays_single(rng):
    data = torch.tensor(curve(rng), dtype=torch.float32)
    shares = torch.tensor(one_hot(data.numpy(), 3), dtype=torch.float32)
    mixture, report = expectation_maximization(data, shares, n_features=1, reg_covar=1e-4, tol=1e-5, max_iter=100)
    mean, root = mixture(data[:, :1])
    assert {mean.dtype, root.dtype, mixture.log_density_floor.dtype} == {torch.float32}
    assert torch.isfinite(mixture(torch.tensor([[1e38]]))[1]).all()
    _, double = fit(data.double().numpy(), 3, reg_covar=1e-4, tol=1e-5, max_iter=100)
    assert report.loss == pytest.approx(double.loss, abs=1e-4)

import numpy as np
import pytest
import torch
from scipy.special import gammaln
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel

from estimators.zoo import demonstrations, fit, fitted, new, queries
from torch_pbd import CholeskyCovRegressor
from torch_pbd.data import make_paper_simulation
from torch_pbd.data.synthetic import paper_covariance
from torch_pbd.exceptions import DataRankWarning
from torch_pbd.metrics import covariance_mse, gaussian_kl


def empirical_covariances(X, y):
    """Distinct inputs, and np.cov of the rows at each."""
    inputs, index = np.unique(X, axis=0, return_inverse=True)
    d = y.shape[1]
    return inputs, np.stack([np.cov(y[index.ravel() == i].T).reshape(d, d) for i in range(len(inputs))])


@pytest.mark.parametrize("reading", ["bell", "printed", "bowl"])
def test_table_1_interpolation_repeats_the_empirical_covariances(reading):
    errors = []
    for seed in range(10):
        X, y, _ = make_paper_simulation(reading=reading, random_state=seed)
        inputs, empirical = empirical_covariances(X, y)
        model = fit(CholeskyCovRegressor(noise_scale=0.0), X, y)
        errors.append(covariance_mse(model.predict_cov(inputs), empirical, on="cholesky"))
    assert np.median(errors) <= 1e-12


@pytest.mark.parametrize("d", [1, 2, 9])
@pytest.mark.parametrize("kernel", ["squared_exponential", "matern32", "matern52"])
def test_without_noise_the_empirical_covariances_are_interpolated(d, kernel):
    X, y = demonstrations(d)
    model = fit(CholeskyCovRegressor(noise_scale=0.0, kernel=kernel), X, y)
    inputs, empirical = empirical_covariances(X, y)
    np.testing.assert_allclose(model.predict_cov(inputs), empirical, rtol=1e-8, atol=1e-8)


def test_the_factor_of_one_output_is_a_gaussian_process_like_that_of_scikit_learn():
    """Held hyperparameters, one output: the standard deviation is scikit-learn's GP through the empirical ones."""
    X, y = demonstrations(1)
    inputs, empirical = empirical_covariances(X, y)
    prior, length_scale = 4.0, 0.4
    model = fit(CholeskyCovRegressor(noise_scale=0.0, prior=prior, length_scale=length_scale), X, y)
    kernel = ConstantKernel(1.0, "fixed") * RBF(length_scale, "fixed")
    process = GaussianProcessRegressor(kernel, alpha=0.0, optimizer=None)
    process.fit(inputs, np.sqrt(empirical[:, 0, 0]) - np.sqrt(prior))
    x = queries(1)[:40]
    # The floor under a variance is 1e-12 of it; the kernel matrices have condition numbers of 1e9.
    expected = np.sqrt(prior) + process.predict(x)
    np.testing.assert_allclose(model.predict_cov(x)[:, 0, 0], expected**2, rtol=1e-6, atol=1e-8)


def test_a_held_noise_smooths_and_a_large_one_leaves_the_prior():
    X, y = demonstrations()
    inputs, empirical = empirical_covariances(X, y)
    errors = [
        covariance_mse(
            fit(CholeskyCovRegressor(noise_scale=noise, length_scale=0.3), X, y).predict_cov(inputs), empirical
        )
        for noise in (0.0, 0.05, 0.3)
    ]
    assert errors[0] < 1e-12 < errors[1] < errors[2]


def test_noise_scale_is_in_units_of_y():
    X, y = demonstrations()
    whole = fit(CholeskyCovRegressor(noise_scale=0.2), X, y).predict_cov(X)
    in_mm = fit(CholeskyCovRegressor(noise_scale=200.0), X, 1e3 * y).predict_cov(X)
    np.testing.assert_allclose(in_mm / 1e6, whole, rtol=1e-5)


@pytest.mark.parametrize("diagonal", ["raw", "log"])
def test_bias_correction_divides_each_column_by_its_expectation(diagonal):
    """Interpolated, so column i of every factor is larger by 1 / c_i (Bartlett)."""
    X, y = demonstrations(3, n_demos=6)
    plain, corrected = (
        fit(CholeskyCovRegressor(noise_scale=0.0, diagonal=diagonal, bias_correction=b), X, y).predict_cov(X[:8])
        for b in (False, True)
    )
    k, i = 6, np.arange(1, 4)
    expectation = np.sqrt(2.0 / (k - 1)) * np.exp(gammaln((k - i + 1) / 2) - gammaln((k - i) / 2))
    ratio = np.linalg.cholesky(corrected) / np.where(np.linalg.cholesky(plain) == 0, np.inf, np.linalg.cholesky(plain))
    np.testing.assert_allclose(
        ratio, np.tril(np.broadcast_to(1.0 / expectation, (3, 3)))[np.newaxis].repeat(8, 0), rtol=1e-6
    )


def test_bias_correction_makes_many_small_fits_right_on_average():
    """Mean over 60 sets of 5 demonstrations of one output: the standard deviation is the true one, 1."""
    deviations = []
    for seed in range(60):
        y = np.random.default_rng(seed).normal(size=(5, 8)).ravel()
        X = np.tile(np.arange(8.0)[:, np.newaxis], (5, 1))
        model = fit(CholeskyCovRegressor(noise_scale=0.0, length_scale=0.1, bias_correction=True, n_restarts=0), X, y)
        deviations.append(model.predict(X[:8], return_std=True)[1].mean())
    standard_error = np.std(deviations) / len(deviations) ** 0.5
    assert abs(np.mean(deviations) - 1.0) < 4.0 * standard_error < 0.08


@pytest.mark.parametrize("objective", ["empirical", "likelihood"])
def test_it_beats_one_covariance_for_all_inputs(objective):
    """On the paper's simulation, medians over seeds: KL from the truth at the inputs and between."""
    x = np.linspace(-95.0, 95.0, 40)[:, np.newaxis]
    truth = paper_covariance(x, "bell")
    learned, constant = [], []
    for seed in range(5):
        X, y, _ = make_paper_simulation(random_state=seed)
        model = fit(CholeskyCovRegressor(objective=objective), X, y)
        _, empirical = empirical_covariances(X, y)
        learned.append(gaussian_kl(truth, model.predict_cov(x)))
        constant.append(gaussian_kl(truth, np.broadcast_to(empirical.mean(0), truth.shape)))
    assert np.median(learned) < 0.1 < 0.25 < np.median(constant)


def test_few_demonstrations_are_shrunk_towards_the_pooled_covariance():
    X, y = demonstrations(5, n_demos=3)
    with pytest.warns(DataRankWarning, match="3 demonstrations at an input but 5 outputs") as caught:
        model = CholeskyCovRegressor(noise_scale=0.0, max_iter=2000).fit(X, y)
    assert [warning.filename for warning in caught] == [__file__]
    inputs, empirical = empirical_covariances(X, y)
    # An inverse-Wishart prior of d + 1 degrees of freedom beside the two of the data.
    expected = (2.0 * empirical + 6.0 * empirical.mean(0)) / 8.0
    np.testing.assert_allclose(model.predict_cov(inputs), expected, rtol=1e-6, atol=1e-6)


def test_the_logarithm_keeps_the_diagonal_from_crossing_zero():
    """A deviation that falls to nearly nothing at one input: raw processes swing through zero beside it."""
    rng = np.random.default_rng(0)
    x = np.linspace(0.0, 1.0, 9)
    deviation = np.where(x == 0.5, 1e-3, 1.0)
    X, y = np.tile(x, 40)[:, np.newaxis], (rng.normal(size=(40, 9)) * deviation).ravel()
    model = fit(CholeskyCovRegressor(noise_scale=0.0, diagonal="log"), X, y)
    predicted = model.predict(np.linspace(0.0, 1.0, 200)[:, np.newaxis], return_std=True)[1]
    assert (predicted > 2e-4).all()


def test_the_paper_likelihood_fits_more_than_the_posterior_does():
    X, y = demonstrations(aligned=False)
    paper, posterior = fitted("cholesky-eq12", aligned=False), fitted("cholesky-likelihood", aligned=False)
    assert paper.score(X, y) > posterior.score(X, y)
    X_new, y_new = demonstrations(aligned=False, seed=5)
    assert paper.score(X_new, y_new) < posterior.score(X_new, y_new)  # and so overfits


def test_auto_is_empirical_where_every_input_repeats_and_likelihood_elsewhere():
    x = queries(1)
    for aligned, objective in [(True, "empirical"), (False, "likelihood")]:
        X, y = demonstrations(aligned=aligned)
        auto, chosen = (fit(new("cholesky", objective=name), X, y) for name in ("auto", objective))
        np.testing.assert_array_equal(auto.predict_cov(x), chosen.predict_cov(x))


def test_a_given_length_scale_is_that_of_the_covariance():
    X, y = demonstrations(2, 2)
    model = fit(CholeskyCovRegressor(length_scale=[0.3, 2.0]), X, y)
    module = model.module_
    learned = module.core.covariance.latent.length_scale * module.x_scale
    torch.testing.assert_close(learned, torch.tensor([[0.3, 2.0]], dtype=torch.float64).expand(len(learned), -1))


def test_a_length_scale_that_lets_the_covariance_overshoot_is_warned_of():
    t = np.tile(np.linspace(0.0, 1.0, 12), 20)[:, np.newaxis]
    y = (1.2 + np.sin(12.0 * t)) * np.repeat(np.random.default_rng(0).normal(size=20), 12)[:, np.newaxis]
    with pytest.warns(UserWarning, match="length_scale is so long"):
        fit(CholeskyCovRegressor(noise_scale=0.0, length_scale=0.5), t, y)
    model = fit(CholeskyCovRegressor(noise_scale=0.0, length_scale=0.15), t, y)
    beside = model.predict_cov(np.linspace(-0.5, 0.0, 50)[:, np.newaxis])
    assert beside.max() < 1.5 * model.predict_cov([[-100.0]]).max()


@pytest.mark.parametrize("aligned", [True, False])
@pytest.mark.parametrize(("d", "diagonal"), [(1, "log"), (2, "log"), (2, "raw")])
def test_both_solvers_of_the_likelihood_predict_the_same(d, diagonal, aligned):
    X, y = demonstrations(d, aligned=aligned)
    models = [
        fit(CholeskyCovRegressor(objective="likelihood", diagonal=diagonal, solver=solver, tol=1e-11), X, y)
        for solver in ("auto", "fisher", "lbfgs")
    ]
    covariances = [model.predict_cov(queries(1)) for model in models]
    np.testing.assert_array_equal(covariances[0], covariances[1])
    np.testing.assert_allclose(covariances[2], covariances[1], rtol=0, atol=1e-3 * covariances[1].max())
    assert models[2].loss_ == pytest.approx(models[1].loss_, abs=1e-9)
    assert models[1].converged_


def test_the_solver_is_checked():
    X, y = demonstrations(aligned=False)
    with pytest.raises(ValueError, match="solver is 'newton', must be one of 'auto', 'fisher', 'lbfgs'"):
        CholeskyCovRegressor(solver="newton").fit(X, y)
    with pytest.raises(ValueError, match="solver='fisher' holds the hyperparameters, which latent_prior=False"):
        CholeskyCovRegressor(solver="fisher", latent_prior=False).fit(X, y)

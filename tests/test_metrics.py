import pickle

import numpy as np
import pytest
from scipy.stats import chi2, multivariate_normal
from sklearn.base import BaseEstimator, RegressorMixin
from sklearn.linear_model import LinearRegression
from sklearn.model_selection import GridSearchCV, cross_val_score
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from torch_pbd.metrics import (
    covariance_mse,
    gaussian_kl,
    log_likelihood_scorer,
    mahalanobis_coverage,
    negative_log_likelihood,
    relative_frobenius_error,
)

SIZES = pytest.mark.parametrize("d", [1, 2, 9])


def covariances(rng, n, d):
    root = rng.normal(size=(n, d, d + 3))
    return root @ root.mT


class ConstantGaussian(RegressorMixin, BaseEstimator):
    """The least an estimator must have for the scorers: one Gaussian for all inputs."""

    def __init__(self, scale=1.0):
        self.scale = scale

    def fit(self, X, y):
        self.mean_ = np.mean(y, axis=0)
        self.covariance_ = self.scale * np.atleast_2d(np.cov(np.transpose(y), bias=True))
        return self

    def predict(self, X, *, return_cov=False):
        mean = np.broadcast_to(self.mean_, (len(X), *np.shape(self.mean_)))
        return (mean, np.stack([self.covariance_] * len(X))) if return_cov else mean

    def log_likelihood(self, X, y):
        return multivariate_normal(self.mean_, self.covariance_).logpdf(y)

    def score(self, X, y):
        return np.mean(self.log_likelihood(X, y))


@pytest.fixture(params=[1, 2])
def problem(request, rng):
    X, y = rng.normal(size=(60, 2)), rng.normal(size=(60, request.param))
    return (X, y) if request.param > 1 else (X, y.ravel())


@SIZES
def test_error_on_cholesky_factors_is_that_of_their_vectors(d, rng):
    estimated, reference = covariances(rng, 7, d), covariances(rng, 7, d)
    rows, columns = np.tril_indices(d)
    vectors = np.linalg.cholesky(np.stack([estimated, reference]))[..., rows, columns]
    expected = np.mean(np.linalg.norm(vectors[0] - vectors[1], axis=-1) ** 2)
    assert covariance_mse(estimated, reference) == pytest.approx(expected, rel=1e-12)
    assert covariance_mse(estimated, reference, "cholesky") == pytest.approx(expected, rel=1e-12)


@SIZES
def test_error_on_matrices_is_the_squared_frobenius_norm(d, rng):
    estimated, reference = covariances(rng, 7, d), covariances(rng, 7, d)
    expected = np.mean(np.linalg.norm(estimated - reference, axis=(1, 2)) ** 2)
    assert covariance_mse(estimated, reference, on="matrix") == pytest.approx(expected, rel=1e-12)


@SIZES
def test_the_factor_of_a_regular_matrix_is_known_to_1e13(d, rng):
    reference = covariances(rng, 7, d)
    factor = np.linalg.cholesky(reference)
    zero = np.zeros_like(reference)
    squared_norm = np.mean(np.square(factor).sum(axis=(1, 2)))
    assert covariance_mse(zero, reference) == pytest.approx(squared_norm, rel=1e-13)
    assert covariance_mse(factor @ factor.mT, reference) < 1e-24 * squared_norm


@pytest.mark.parametrize("rank", [0, 1, 4, 8])
def test_a_singular_reference_has_the_factor_it_was_made_of(rank, rng):
    factor = np.tril(rng.normal(size=(7, 9, 9)))
    diagonal = np.arange(9)
    factor[:, diagonal, diagonal] = 1.0 + rng.uniform(size=(7, 9))
    factor[:, :, rank:] = 0.0
    reference = factor @ factor.mT
    regular = covariances(rng, 7, 9)
    expected = np.mean(np.square(np.linalg.cholesky(regular) - factor).sum(axis=(1, 2)))
    # Its zero pivots are known to the square root of the rounding at worst.
    assert covariance_mse(regular, reference) == pytest.approx(expected, rel=1e-6)
    assert covariance_mse(reference, reference) == 0.0


def test_an_output_without_variance_leaves_the_others_alone():
    # [[0, 0], [1, 0]] has the same square; the limit of matrix + epsilon I is meant.
    estimated, reference = np.array([[[0.0, 0.0], [0.0, 4.0]]]), np.array([[[0.0, 0.0], [0.0, 9.0]]])
    assert covariance_mse(estimated, reference) == 1.0
    tiny = np.diag([1e-20, 9.0])[None]
    assert covariance_mse(tiny, reference) == pytest.approx(1e-20, rel=1e-9)


@SIZES
def test_error_on_factors_scales_with_the_unit_and_on_matrices_with_its_square(d, rng):
    estimated, reference = covariances(rng, 7, d), covariances(rng, 7, d)
    for on, power in [("cholesky", 2), ("matrix", 4)]:
        metres, millimetres = (covariance_mse(u * estimated, u * reference, on=on) for u in (1.0, 1e6))
        assert millimetres == pytest.approx(1e3**power * metres, rel=1e-12)


@SIZES
def test_relative_frobenius_error(d, rng):
    reference = covariances(rng, 7, d)
    assert relative_frobenius_error(reference, reference) == 0.0
    assert relative_frobenius_error(1.25 * reference, reference) == pytest.approx(0.25, rel=1e-12)
    assert relative_frobenius_error(np.zeros_like(reference), reference) == pytest.approx(1.0, rel=1e-12)
    estimated = covariances(rng, 7, d)
    ratios = [np.linalg.norm(e - r) / np.linalg.norm(r) for e, r in zip(estimated, reference, strict=True)]
    assert relative_frobenius_error(estimated, reference) == pytest.approx(np.mean(ratios), rel=1e-12)


def test_divergence_of_scaled_gaussians_in_closed_form():
    reference, estimated = np.full((1, 1, 1), 4.0), np.full((1, 1, 1), 9.0)
    assert gaussian_kl(reference, estimated) == pytest.approx(np.log(3 / 2) + 4 / 18 - 0.5, rel=1e-12)
    shifted = gaussian_kl(reference, estimated, reference_mean=[1.0], estimated_mean=[3.0])
    assert shifted == pytest.approx(np.log(3 / 2) + 4 / 18 + 4 / 18 - 0.5, rel=1e-12)


@SIZES
def test_divergence_by_the_textbook_and_in_every_unit(d, rng):
    reference, estimated = covariances(rng, 7, d), covariances(rng, 7, d)
    means = rng.normal(size=(2, 7, d))
    terms = []
    for r, e, shift in zip(reference, estimated, means[0] - means[1], strict=True):
        ratio = np.linalg.slogdet(e).logabsdet - np.linalg.slogdet(r).logabsdet
        inverse = np.linalg.inv(e)
        terms.append(0.5 * (np.trace(inverse @ r) + shift @ inverse @ shift - d + ratio))
    divergence = gaussian_kl(reference, estimated, reference_mean=means[0], estimated_mean=means[1])
    assert divergence == pytest.approx(np.mean(terms), rel=1e-9)
    millimetres = gaussian_kl(
        1e6 * reference, 1e6 * estimated, reference_mean=1e3 * means[0], estimated_mean=1e3 * means[1]
    )
    assert millimetres == pytest.approx(divergence, rel=1e-9)
    assert 0.0 <= gaussian_kl(reference, reference) < 1e-12


def test_divergence_is_the_likelihood_lost_by_draws_from_the_reference(rng):
    reference, estimated = covariances(rng, 1, 2)[0], covariances(rng, 1, 2)[0]
    draws = rng.multivariate_normal(np.zeros(2), reference, size=40_000)
    lost = multivariate_normal(cov=reference).logpdf(draws) - multivariate_normal(cov=estimated).logpdf(draws)
    error = lost.std() / np.sqrt(len(draws))
    assert gaussian_kl(reference[None], estimated[None]) == pytest.approx(lost.mean(), abs=4 * error)


@SIZES
def test_negative_log_likelihood_is_that_of_scipy(d, rng):
    covariance, mean, y = covariances(rng, 7, d), rng.normal(size=(7, d)), rng.normal(size=(7, d))
    rows = zip(mean, covariance, y, strict=True)
    expected = -np.mean([multivariate_normal(m, c).logpdf(target) for m, c, target in rows])
    assert negative_log_likelihood(mean, covariance, y) == pytest.approx(expected, rel=1e-9)
    if d == 1:
        assert negative_log_likelihood(mean.ravel(), covariance, y.ravel()) == pytest.approx(expected, rel=1e-9)


@SIZES
@pytest.mark.parametrize("level", [0.5, 0.95])
def test_coverage_counts_rows_within_the_chi_squared_quantile(d, level, rng):
    covariance, mean = covariances(rng, 200, d), rng.normal(size=(200, d))
    y = mean + np.einsum("nij,nj->ni", np.linalg.cholesky(covariance), rng.normal(size=(200, d)))
    distance = [r @ np.linalg.inv(c) @ r for r, c in zip(y - mean, covariance, strict=True)]
    expected = np.mean(np.array(distance) <= chi2.ppf(level, d))
    assert 0 < expected < 1
    assert mahalanobis_coverage(mean, covariance, y, level=level) == expected
    assert mahalanobis_coverage(mean, covariance, y, level) == expected


@SIZES
def test_coverage_of_the_truth_is_the_level(d, rng):
    n, level = 20_000, 0.9
    scale_tril = np.linalg.cholesky(covariances(rng, 1, d))
    y = (scale_tril @ rng.normal(size=(n, d, 1)))[..., 0]
    covariance = np.broadcast_to(scale_tril @ scale_tril.mT, (n, d, d))
    error = np.sqrt(level * (1 - level) / n)
    coverage = mahalanobis_coverage(np.zeros((n, d)), covariance, y, level=level)
    assert coverage == pytest.approx(level, abs=4 * error)


def test_scorers_see_the_estimator_as_the_functions_see_its_predictions(problem):
    X, y = problem
    estimator = ConstantGaussian().fit(X, y)
    mean, covariance = estimator.predict(X, return_cov=True)
    nll = negative_log_likelihood(mean, covariance, y)
    assert negative_log_likelihood(estimator, X, y) == pytest.approx(nll, rel=1e-12)
    assert log_likelihood_scorer(estimator, X, y) == pytest.approx(-nll, rel=1e-12)
    expected = mahalanobis_coverage(mean, covariance, y, level=0.8)
    assert mahalanobis_coverage(0.8)(estimator, X, y) == expected
    assert mahalanobis_coverage(level=0.8)(estimator, X, y) == expected
    assert mahalanobis_coverage(np.float64(0.8))(estimator, X, y) == expected
    assert mahalanobis_coverage(estimator, X, y, level=0.8) == expected


def test_scorers_pass_through_a_pipeline(problem):
    X, y = problem
    pipeline = make_pipeline(StandardScaler(), ConstantGaussian()).fit(X, y)
    plain = ConstantGaussian().fit(X, y)
    for scorer in (negative_log_likelihood, log_likelihood_scorer, mahalanobis_coverage(0.8)):
        assert scorer(pipeline, X, y) == pytest.approx(scorer(plain, X, y), rel=1e-12)


@pytest.mark.parametrize("scorer", [log_likelihood_scorer, negative_log_likelihood, mahalanobis_coverage(0.8)])
def test_scorers_work_in_model_selection_and_pickle(scorer, problem):
    X, y = problem
    scores = cross_val_score(ConstantGaussian(), X, y, scoring=scorer, cv=3, error_score="raise")
    copy = pickle.loads(pickle.dumps(scorer))
    again = cross_val_score(ConstantGaussian(), X, y, scoring=copy, cv=3, n_jobs=2, error_score="raise")
    np.testing.assert_array_equal(again, scores)


def test_the_log_likelihood_scorer_selects_the_right_covariance(problem):
    grid = {"scale": [0.01, 1.0, 100.0]}
    search = GridSearchCV(ConstantGaussian(), grid, scoring=log_likelihood_scorer, cv=3).fit(*problem)
    assert search.best_params_ == {"scale": 1.0}


def test_arguments_are_not_written_to(rng):
    arrays = [rng.normal(size=(5, 2)), covariances(rng, 5, 2), rng.normal(size=(5, 2))]
    for array in arrays:
        array.setflags(write=False)
    mean, covariance, y = arrays
    singular = np.zeros((5, 2, 2))
    singular.setflags(write=False)
    covariance_mse(covariance, singular)
    gaussian_kl(covariance, covariance, reference_mean=mean, estimated_mean=y)
    negative_log_likelihood(mean, covariance, y)
    mahalanobis_coverage(mean, covariance, y)


EYE = np.stack([np.eye(2)] * 3)
INDEFINITE = EYE.copy()
INDEFINITE[1] = [[1.0, 2.0], [2.0, 1.0]]
SKEW = EYE + np.array([[0.0, 0.1], [0.0, 0.0]])
ROWS = np.zeros((3, 2))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: covariance_mse(EYE[0], EYE), r"estimated has shape \(2, 2\), must have shape \(n, d, d\)"),
        (
            lambda: covariance_mse(EYE, EYE[:2]),
            r"reference has shape \(2, 2, 2\), must have shape \(3, 2, 2\)",
        ),
        (lambda: covariance_mse(EYE, EYE[:0]), r"reference has shape \(0, 2, 2\)"),
        (lambda: covariance_mse(np.nan * EYE, EYE), r"estimated\[0, 0, 0\] is nan, must be finite"),
        (
            lambda: covariance_mse(EYE, SKEW),
            r"asymmetry of reference\[0\] is 0\.1, must be zero",
        ),
        (lambda: covariance_mse(EYE, INDEFINITE), r"eigenvalue of reference\[1\] is -1\..*semidefinite"),
        (
            lambda: covariance_mse(EYE, EYE, on="trace"),
            "on is 'trace', must be one of 'cholesky', 'matrix'",
        ),
        (lambda: relative_frobenius_error(EYE, 0 * EYE), r"norm of reference\[0\] is 0\.0, must be above zero"),
        (lambda: gaussian_kl(EYE, INDEFINITE), r"eigenvalue of estimated\[1\] is -1\..*positive definite"),
        (lambda: gaussian_kl(0 * EYE, EYE), r"eigenvalue of reference\[0\] is 0\..*positive definite"),
        (lambda: gaussian_kl(EYE, EYE, reference_mean=ROWS), "give both or none"),
        (
            lambda: gaussian_kl(EYE, EYE, reference_mean=ROWS, estimated_mean=ROWS[0]),
            r"estimated_mean .* \(2,\)",
        ),
        (lambda: negative_log_likelihood(ROWS, EYE, ROWS[:2]), r"y has shape \(2, 2\), must have shape \(3, 2\)"),
        (lambda: negative_log_likelihood(ROWS[:, :1], EYE, ROWS), r"mean has shape \(3, 1\)"),
        (lambda: negative_log_likelihood(ROWS, EYE, np.inf * SKEW[:, 0]), r"y\[0, 0\] is inf, must be finite"),
        (
            lambda: negative_log_likelihood(ROWS, INDEFINITE, ROWS),
            r"eigenvalue of covariance\[1\] is .*positive definite",
        ),
        (
            lambda: mahalanobis_coverage(ROWS, EYE, ROWS, level=95),
            "level is 95, must be a finite number above 0 and below 1",
        ),
        (lambda: mahalanobis_coverage(1.0), "level is 1.0"),
    ],
)
def test_what_cannot_be_scored_is_an_error_that_names_it(call, message):
    with np.errstate(invalid="ignore"), pytest.raises(ValueError, match=message):
        call()


def test_what_is_no_covariance_estimator_is_a_type_error(rng):
    X, y = rng.normal(size=(9, 2)), rng.normal(size=9)
    for estimator in (LinearRegression(), make_pipeline(StandardScaler(), LinearRegression())):
        with pytest.raises(TypeError, match="LinearRegression has no log_likelihood"):
            negative_log_likelihood(estimator.fit(X, y), X, y)
    with pytest.raises(TypeError, match="takes mean, covariance, y"):
        mahalanobis_coverage(y, y)

import numpy as np
import pytest
from covariance_libraries import MixtureRegression
from sklearn.base import BaseEstimator

from torch_pbd import GMMBaseline
from torch_pbd.data import make_paper_simulation, paper_covariance
from torch_pbd.experiments.comparison import compare_models, empirical_covariances, explained
from torch_pbd.metrics import covariance_mse


class Witness(BaseEstimator):
    """Predicts a unit covariance around zero, and notes how many rows it was fitted to."""

    fits: list = []  # noqa: RUF012 - shared by the clones

    def fit(self, X, y):
        Witness.fits.append(len(X))
        return self

    def predict(self, X, return_cov=False):
        mean = np.zeros((len(X), 2))
        return (mean, self.predict_cov(X)) if return_cov else mean

    def predict_cov(self, X):
        return np.tile(np.eye(2), (len(X), 1, 1))

    def log_likelihood(self, X, y):
        return -0.5 * np.square(y).sum(axis=1)


def test_whole_demonstrations_are_left_out_and_scored():
    X, y, groups = make_paper_simulation(8, 5, random_state=0)
    Witness.fits.clear()
    score = compare_models({"witness": Witness()}, X, y, groups, max_folds=3)["witness"]
    assert Witness.fits == [40, 32, 32, 32]
    expected = [-0.5 * np.square(y[groups == k]).sum(axis=1).mean() for k in (0, 2, 4)]
    np.testing.assert_allclose([fold["log_likelihood"] for fold in score.folds], expected)
    assert score.row["+-"] == pytest.approx(np.std(expected, ddof=1) / 3**0.5)
    assert score.row["least eig."] == 1.0


def test_errors_are_those_to_the_empirical_and_to_the_true_covariances():
    X, y, groups = make_paper_simulation(8, 5, random_state=0)
    score = compare_models({"witness": Witness()}, X, y, groups, truth=paper_covariance, max_folds=0)["witness"]
    inputs = np.unique(X)
    empirical = np.stack([np.cov(y[X[:, 0] == xi].T) for xi in inputs])
    unit = np.tile(np.eye(2), (8, 1, 1))
    assert score.row["MSE"] == pytest.approx(covariance_mse(unit, empirical), rel=1e-9)
    true = paper_covariance(inputs)
    ratio = np.linalg.norm(unit - true, axis=(1, 2)) / np.linalg.norm(true, axis=(1, 2))
    assert score.row["error to truth"] == pytest.approx(ratio.mean(), rel=1e-9)
    assert np.isnan(score.row["held-out LL"])


def test_data_that_do_not_repeat_have_no_empirical_covariance(rng):
    X, y = rng.normal(size=(20, 1)), rng.normal(size=(20, 2))
    assert empirical_covariances(X, y)[1] is None
    score = compare_models({"witness": Witness()}, X, y, np.arange(20) % 4, max_folds=0)["witness"]
    assert np.isnan(score.row["MSE"])


@pytest.mark.parametrize("n_components", [1, 5])
def test_our_mixture_regression_is_that_of_scikit_learn(n_components):
    X, y, _ = make_paper_simulation(40, 30, reading="bell", random_state=0)
    ours = GMMBaseline(n_components=n_components, tol=1e-10, max_iter=10_000).fit(X, y)
    theirs = MixtureRegression(n_components).fit(X, y)
    expected = theirs.log_likelihood(X, y).mean()
    assert ours.score(X, y) == pytest.approx(expected, abs=1e-2)  # they may end in different optima
    if n_components == 1:  # one optimum: but theirs adds 1e-6 to variances of other scales
        np.testing.assert_allclose(ours.predict_cov(X[:40]), theirs.predict(X[:40])[1], rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize(("least", "told"), [(-1.0, True), (-np.inf, False)])
def test_the_best_is_told_in_short_lines_with_a_finite_margin(least, told):
    text = explained([{"model": "long " * 20, "LL": 1.0}, {"model": "other", "LL": least}], "LL")
    best = [part for part in text.split("\n\n") if part.startswith("best LL: long long")]
    assert len(best) == told
    assert all(len(line) <= 80 for part in best for line in part.splitlines())

import numpy as np
import pytest
import torch

from torch_pbd.gp.observations import Hyperparameters, Observations, condition
from torch_pbd.models.conditional import MeanAndWishart
from torch_pbd.models.links import WishartLink, padded

INPUTS = torch.linspace(0, 1, 5, dtype=torch.float64)[:, None]
FAR = torch.tensor([[100.0], [-1e300]], dtype=torch.float64)
SIZES = [(1, 1), (1, 2), (2, 3), (2, 7), (9, 10)]


def tensor(array):
    return torch.tensor(array, dtype=torch.float64)


def lower(d, rng):
    return tensor(np.tril(rng.normal(size=(d, d))) + 2 * np.eye(d))


def wishart_root(deviation, prior_root, matrix=None):
    return WishartLink(prior_root, scale_matrix_tril=matrix).root(deviation)


def model_of(latent, prior_root, matrix):
    link = WishartLink(prior_root, scale_matrix_tril=matrix)
    return MeanAndWishart(processes(len(matrix), 1, np.random.default_rng(0)), latent, link)


def processes(d, df, rng):
    """Random vectors u_i, one process after the other, and the value without a prior."""
    count = d * df
    shared = Hyperparameters(tensor([[0.15]]), torch.ones(count).double(), torch.zeros(count).double())
    targets, values = tensor(rng.normal(size=(2, count, 5)))
    return condition(Observations(INPUTS, targets, torch.ones(5).double()), shared, values=values)[0]


@pytest.mark.parametrize(("d", "df"), SIZES)
def test_the_covariance_is_the_sum_of_outer_products(d, df, rng):
    """Eq. (8), term by term: vector i has the entries i * d to i * d + d - 1."""
    deviation, prior_mean, matrix = rng.normal(size=(4, df * d)), rng.normal(size=(df, d)), lower(d, rng).numpy()
    root = wishart_root(tensor(deviation), tensor(matrix @ prior_mean.T), tensor(matrix)).numpy()
    for row in range(4):
        expected = np.zeros((d, d))
        for i in range(df):
            u = deviation[row, i * d : (i + 1) * d] + prior_mean[i]
            expected += np.outer(matrix @ u, matrix @ u)
        np.testing.assert_allclose(root[row] @ root[row].T, expected, rtol=1e-9, atol=1e-11)


def test_only_the_lower_triangle_of_the_scale_matrix_factor_counts(rng):
    deviation, full = tensor(rng.normal(size=(4, 6))), tensor(rng.normal(size=(2, 2)))
    prior_root = torch.zeros(2, 3).double()
    torch.testing.assert_close(
        wishart_root(deviation, prior_root, full), wishart_root(deviation, prior_root, full.tril()), rtol=0, atol=0
    )


def test_independent_standard_normal_vectors_have_the_mean_of_a_wishart_distribution(rng):
    """E[Sigma] = df V, exactly, for a design of vectors whose second moments are those of N(0, I)."""
    d, df = 2, 3
    signs = 1.0 - 2.0 * tensor([[(row >> bit) & 1 for bit in range(d * df)] for row in range(2 ** (d * df))])
    matrix = lower(d, rng)
    root = wishart_root(signs, torch.zeros(d, df).double(), matrix)
    torch.testing.assert_close((root @ root.mT).mean(0), df * matrix @ matrix.mT, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(("d", "df"), SIZES)
def test_a_padded_root_has_the_covariance_of_its_factor(d, df, rng):
    prior_tril = torch.stack([lower(d, rng) for _ in range(3)])
    root = padded(prior_tril, df)
    assert root.shape == (3, d, df)
    torch.testing.assert_close(root @ root.mT, prior_tril @ prior_tril.mT, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(("d", "df"), SIZES)
def test_far_from_data_the_covariance_is_exactly_the_prior(d, df, rng):
    prior_tril = lower(d, rng)
    model = model_of(processes(d, df, rng), padded(prior_tril, df), lower(d, rng))
    root = model.predict_root(FAR)
    assert torch.equal(root, padded(prior_tril, df).expand(2, d, df))
    other = torch.stack([lower(d, rng), lower(d, rng)])
    assert torch.equal(model.predict_root(FAR, other), padded(other, df))


@pytest.mark.parametrize(("d", "df"), SIZES)
def test_at_the_inputs_the_root_is_that_of_the_vectors(d, df, rng):
    latent, prior_root, matrix = processes(d, df, rng), tensor(rng.normal(size=(d, df))), lower(d, rng)
    model = model_of(latent, prior_root, matrix)
    vectors = latent(INPUTS).detach().numpy().reshape(5, df, d)
    expected = prior_root.numpy() + np.einsum("ab,nib->nai", matrix.numpy(), vectors)
    np.testing.assert_allclose(model.predict_root(INPUTS).detach(), expected, rtol=1e-9, atol=1e-12)


def test_without_its_prior_the_root_is_that_of_the_values_and_zero_far_away(rng):
    latent = processes(2, 3, rng)
    model = model_of(latent, torch.ones(2, 3).double(), lower(2, rng))
    expected = latent.values(INPUTS).numpy().reshape(5, 3, 2).swapaxes(1, 2)
    np.testing.assert_array_equal(model.variability(INPUTS), expected)
    assert (model.variability(FAR) == 0).all()


def test_the_root_is_differentiable_in_x_and_in_the_factor(rng):
    model = model_of(processes(2, 3, rng), padded(lower(2, rng), 3), lower(2, rng))
    x = tensor(rng.uniform(size=(3, 1))).requires_grad_()
    matrix = lower(2, rng).requires_grad_()

    def root(x, matrix):
        return torch.func.functional_call(model, {"covariance.scale_matrix_tril": matrix}, (x,))[1]

    assert torch.autograd.gradcheck(root, (x, matrix))

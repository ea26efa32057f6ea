import numpy as np
import pytest
import torch

from torch_pbd.gp.observations import Hyperparameters, Observations, condition
from torch_pbd.models.conditional import MeanAndCholesky
from torch_pbd.models.links import CholeskyLink

INPUTS = torch.linspace(0, 1, 5, dtype=torch.float64)[:, None]
FAR = torch.tensor([[100.0], [-1e300]], dtype=torch.float64)


def tensor(array):
    return torch.tensor(array, dtype=torch.float64)


def factors(n, d, rng):
    return tensor(
        np.linalg.cholesky(np.stack([np.cov(rng.normal(size=(d, 3 * d + 2))).reshape(d, d) for _ in range(n)]))
    )


def interpolating(scale_tril, prior_tril, *, log_diagonal):
    """A model whose factor at the inputs is ``scale_tril``."""
    link = CholeskyLink(prior_tril, log_diagonal)
    deviation, values = link.deviation(scale_tril), link.flatten(scale_tril)
    count = deviation.shape[1]
    shared = Hyperparameters(tensor([[0.15]]), torch.ones(count).double(), torch.zeros(count).double())
    observations = Observations(INPUTS, deviation.mT.contiguous(), torch.ones(5).double())
    latent, _ = condition(observations, shared, values=values.mT.contiguous())
    return MeanAndCholesky(latent, latent, link)


@pytest.mark.parametrize("log_diagonal", [False, True])
@pytest.mark.parametrize("d", [1, 2, 9])
@pytest.mark.parametrize("one_prior", [False, True])
def test_a_factor_and_its_deviation_are_inverse(log_diagonal, d, one_prior, rng):
    scale_tril, prior_tril = factors(5, d, rng), factors(5, d, rng)
    prior_tril = prior_tril[0] if one_prior else prior_tril
    deviation = CholeskyLink(prior_tril, log_diagonal).deviation(scale_tril)
    assert deviation.shape == (5, d * (d + 1) // 2)
    found = CholeskyLink(prior_tril, log_diagonal).root(deviation)
    torch.testing.assert_close(found, scale_tril, rtol=1e-9, atol=1e-12)


def test_deviations_are_differences_of_entries_or_of_their_logarithms():
    scale_tril, prior_tril = tensor([[[3.0, 0.0], [5.0, 8.0]]]), tensor([[1.0, 0.0], [2.0, 4.0]])
    assert CholeskyLink(prior_tril, False).deviation(scale_tril).tolist() == [[2.0, 3.0, 4.0]]
    found = CholeskyLink(prior_tril, True).deviation(scale_tril)
    np.testing.assert_allclose(found, [[np.log(3.0), 3.0, np.log(2.0)]], rtol=1e-12)


@pytest.mark.parametrize("size", [-1e4, 1e4])
def test_a_logarithm_of_any_size_gives_a_finite_positive_diagonal_and_gradient(size):
    deviation = tensor([[size, size, size]]).requires_grad_()
    factor = CholeskyLink(torch.eye(2).double(), True).root(deviation)
    assert factor.isfinite().all()
    assert (factor.diagonal(dim1=-2, dim2=-1) >= 0).all()
    assert torch.autograd.grad(factor.sum(), deviation)[0].isfinite().all()


def test_a_variance_of_zero_has_a_finite_logarithm():
    zero = torch.zeros(1, 2, 2, dtype=torch.float64)
    deviation = CholeskyLink(torch.eye(2).double(), True).deviation(zero)
    assert deviation.isfinite().all()
    assert CholeskyLink(torch.eye(2).double(), True).root(deviation).abs().max() < 1e-5


@pytest.mark.parametrize("log_diagonal", [False, True])
@pytest.mark.parametrize("d", [1, 2, 9])
def test_the_model_goes_through_its_factors_and_returns_to_the_prior(log_diagonal, d, rng):
    scale_tril, prior_tril = factors(5, d, rng), factors(1, d, rng)[0]
    model = interpolating(scale_tril, prior_tril, log_diagonal=log_diagonal)
    torch.testing.assert_close(model.predict_root(INPUTS), scale_tril, rtol=1e-9, atol=1e-11)
    # The logarithm and its exponential round.
    torch.testing.assert_close(model.predict_root(FAR), prior_tril.expand(2, d, d), rtol=1e-14, atol=0)


@pytest.mark.parametrize("log_diagonal", [False, True])
def test_a_prior_handed_in_replaces_that_of_the_fit(log_diagonal, rng):
    scale_tril, prior_tril, other = factors(5, 2, rng), factors(1, 2, rng)[0], factors(2, 2, rng)
    model = interpolating(scale_tril, prior_tril, log_diagonal=log_diagonal)
    torch.testing.assert_close(model.predict_root(FAR, other), other, rtol=1e-14, atol=0)
    same = model.predict_root(INPUTS, prior_tril.expand(5, 2, 2).contiguous())
    torch.testing.assert_close(same, model.predict_root(INPUTS), rtol=1e-14, atol=0)


@pytest.mark.parametrize("log_diagonal", [False, True])
@pytest.mark.parametrize("d", [1, 2, 9])
def test_without_its_prior_the_model_goes_through_its_factors_and_returns_to_zero(log_diagonal, d, rng):
    scale_tril, prior_tril = factors(5, d, rng), factors(1, d, rng)[0]
    model = interpolating(scale_tril, prior_tril, log_diagonal=log_diagonal)
    torch.testing.assert_close(model.variability(INPUTS), scale_tril, rtol=1e-9, atol=1e-11)
    assert (model.variability(FAR) == 0).all()


def test_the_factor_is_lower_triangular_and_positive_between_inputs(rng):
    prior_tril = factors(1, 2, rng)[0]
    model = interpolating(factors(5, 2, rng), prior_tril, log_diagonal=True)
    factor = model.predict_root(torch.linspace(-1, 2, 200, dtype=torch.float64)[:, None])
    assert torch.equal(factor, factor.tril())
    assert (factor.diagonal(dim1=-2, dim2=-1) > 0).all()


@pytest.mark.parametrize("log_diagonal", [False, True])
def test_the_model_is_differentiable(log_diagonal, rng):
    model = interpolating(factors(5, 2, rng), factors(1, 2, rng)[0], log_diagonal=log_diagonal)
    x = tensor(rng.uniform(size=(3, 1))).requires_grad_()
    assert torch.autograd.gradcheck(model.predict_root, x)

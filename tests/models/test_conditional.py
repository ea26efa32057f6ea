import copy

import numpy as np
import pytest
import torch

from torch_pbd.gp.observations import Hyperparameters, Observations, condition
from torch_pbd.models import VARIANCE_FLOOR
from torch_pbd.models.conditional import ConditionalNormal, MeanAndCholesky, MeanAndWishart
from torch_pbd.models.links import CholeskyLink, WishartLink, padded
from torch_pbd.models.mixture import GaussianMixture

MODELS = ["cholesky", "cholesky, logarithmic", "wishart", "mixture"]
WITH_PRIOR = MODELS[:3]
FAR = torch.tensor([[1e4, -1e4], [1e200, 0.0]], dtype=torch.float64)


def tensor(array):
    return torch.tensor(array, dtype=torch.float64)


def lower(d, rng):
    return tensor(np.tril(0.3 * rng.normal(size=(d, d)), -1) + np.diag(rng.uniform(0.5, 2.0, size=d)))


def processes(count, rng, n=6, noise=0.1):
    """Independent processes over two inputs, each with its own hyperparameters."""
    targets, values = tensor(0.5 * rng.normal(size=(2, count, n)))
    hyperparameters = Hyperparameters(
        tensor(rng.uniform(0.3, 1.0, size=(count, 2))),
        tensor(rng.uniform(0.5, 2.0, size=count)),
        torch.full((count,), noise).double(),
    )
    inputs, counts = tensor(rng.normal(size=(n, 2))), tensor(rng.integers(1, 5, size=n).astype(float))
    return condition(Observations(inputs, targets, counts), hyperparameters, "matern52", values)[0]


def core(kind, d, rng):
    if kind == "mixture":
        factor = torch.stack([lower(d + 2, rng) for _ in range(3)])
        parts = factor.diagonal(dim1=-2, dim2=-1).log(), factor.tril(-1)
        return GaussianMixture(tensor([0.2, 0.3, 0.5]).log(), tensor(rng.normal(size=(3, d + 2))), *parts, 2)
    if kind == "wishart":
        latent = processes(d * (d + 1), rng)
        link = WishartLink(padded(lower(d, rng), d + 1), scale_matrix_tril=lower(d, rng))
        return MeanAndWishart(processes(d, rng), latent, link)
    latent = processes(d * (d + 1) // 2, rng)
    link = CholeskyLink(lower(d, rng), "logarithmic" in kind)
    return MeanAndCholesky(processes(d, rng), latent, link)


def model_of(kind, d, rng):
    x_shift, x_scale = tensor([3.0, -1.0]), tensor([10.0, 0.5])
    y_scale = tensor(10.0 ** np.linspace(0, 3, d))
    return ConditionalNormal(core(kind, d, rng), x_shift, x_scale, tensor(rng.normal(size=d)), y_scale)


def queries(rng, n=7):
    return tensor(rng.normal(size=(n, 2)) * [10.0, 0.5] + [3.0, -1.0])


@pytest.mark.parametrize("kind", MODELS)
@pytest.mark.parametrize("d", [1, 2, 9])
def test_the_covariance_is_the_square_of_the_factor(kind, d, rng):
    model, x = model_of(kind, d, rng), queries(rng)
    mean, factor = model(x)
    same_mean, covariance = model.moments(x)
    assert torch.equal(mean, same_mean)
    assert torch.equal(factor, factor.tril())
    assert (factor.diagonal(dim1=-2, dim2=-1) > 0).all()
    assert torch.equal(covariance, covariance.mT)
    scale = covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    error = (factor @ factor.mT - covariance) / scale[:, :, None] / scale[:, None, :]
    assert error.abs().max() < 1e-12


@pytest.mark.parametrize("kind", MODELS)
def test_mean_and_covariance_can_be_had_alone(kind, rng):
    model, x = model_of(kind, 3, rng), queries(rng)
    mean, covariance = model.moments(x)
    assert torch.equal(model.mean(x), mean)
    assert torch.equal(model.covariance(x), covariance)
    if kind in WITH_PRIOR:
        prior = torch.stack([lower(3, rng) for _ in x])
        assert torch.equal(model.covariance(x, prior), model.moments(x, prior)[1])


@pytest.mark.parametrize("kind", MODELS)
def test_the_moments_are_those_of_the_core_in_the_units_of_the_data(kind, rng):
    model, x = model_of(kind, 2, rng), queries(rng)
    standardized = (x.numpy() - [3.0, -1.0]) / [10.0, 0.5]
    core_mean, core_root = (part.detach().numpy() for part in model.core(tensor(standardized)))
    np.testing.assert_allclose(
        model.type1(x).detach(), model.core.type1(tensor(standardized)).detach(), rtol=1e-9, atol=1e-12
    )
    mean, covariance = (part.detach().numpy() for part in model.moments(x))
    shift, scale = model.y_shift.numpy(), model.y_scale.numpy()
    np.testing.assert_allclose(mean, shift + scale * core_mean, rtol=1e-9)
    core_covariance = core_root @ core_root.swapaxes(1, 2)
    # The floor, 1e-12 of the trace, is below the tolerance but for a singular covariance.
    np.testing.assert_allclose(
        covariance, scale[:, None] * scale * core_covariance, rtol=1e-9, atol=1e-11 * scale.max() ** 2
    )


@pytest.mark.parametrize("kind", MODELS)
def test_outputs_in_millimetres_have_variances_a_million_times_as_large(kind, rng):
    model, x = model_of(kind, 2, rng), queries(rng)
    metres = [*model.moments(x), *model(x), model.type2(x)]
    type1 = model.type1(x)
    model.y_scale *= 1000.0
    model.y_shift *= 1000.0
    for found, expected, factor in zip(
        [*model.moments(x), *model(x), model.type2(x)], metres, [1e3, 1e6, 1e3, 1e3, 1e6], strict=True
    ):
        torch.testing.assert_close(found, factor * expected, rtol=1e-9, atol=1e-9)
    assert torch.equal(model.type1(x), type1)


@pytest.mark.parametrize("kind", WITH_PRIOR)
@pytest.mark.parametrize("d", [1, 2, 9])
def test_far_away_the_prior_speaks(kind, d, rng):
    model = model_of(kind, d, rng)
    prior = model.core.covariance.prior_root if kind == "wishart" else model.core.covariance.prior_tril
    mean, covariance = model.moments(FAR)
    torch.testing.assert_close(mean, model.y_shift.expand(2, d), rtol=1e-12, atol=0)
    root = model.y_scale[:, None] * prior
    # To the floor: 1e-12 of the trace.
    torch.testing.assert_close(covariance, (root @ root.mT).expand(2, d, d), rtol=1e-9, atol=1e-9)
    assert model.type1(FAR).tolist() == pytest.approx([1.0, 1.0], rel=1e-12)
    floor = torch.diag(VARIANCE_FLOOR * model.y_scale**2).expand(2, d, d)
    torch.testing.assert_close(model.type2(FAR), floor, rtol=1e-9, atol=0)


@pytest.mark.parametrize("kind", WITH_PRIOR)
def test_a_prior_handed_in_is_in_the_units_of_the_data(kind, rng):
    model = model_of(kind, 2, rng)
    prior = model.y_scale[:, None] * torch.stack([lower(2, rng), lower(2, rng)])
    mean, factor = model(FAR, prior)
    torch.testing.assert_close(factor, prior, rtol=1e-9, atol=1e-9)
    _, covariance = model.moments(FAR, prior)
    torch.testing.assert_close(covariance, prior @ prior.mT, rtol=1e-9, atol=1e-9)
    assert torch.equal(mean, model(FAR)[0])


@pytest.mark.parametrize("kind", WITH_PRIOR)
def test_type2_is_the_covariance_without_the_prior(kind, rng):
    model, x = model_of(kind, 2, rng), queries(rng)
    root = model.core.variability((x - model.x_shift) / model.x_scale)
    root = model.y_scale[:, None] * root
    found = model.type2(x)
    assert torch.equal(found, found.mT)
    torch.testing.assert_close(found, root @ root.mT, rtol=1e-6, atol=1e-9 * float(found.max()))


def test_type2_of_a_mixture_is_its_covariance(rng):
    model, x = model_of("mixture", 2, rng), queries(rng)
    assert torch.equal(model.type2(x), model.moments(x)[1])


@pytest.mark.parametrize("kind", MODELS)
def test_the_result_of_a_row_does_not_depend_on_its_batch(kind, rng):
    model, x = model_of(kind, 2, rng), queries(rng)
    for batch, alone in zip(model.moments(x), model.moments(x[3:4]), strict=True):
        # Products of other shapes may add in another order.
        torch.testing.assert_close(batch[3:4], alone, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("kind", MODELS)
@pytest.mark.parametrize("d", [1, 2])
def test_all_outputs_are_differentiable_in_x(kind, d, rng):
    model, x = model_of(kind, d, rng), queries(rng, 3).requires_grad_()
    model.x_scale.fill_(1.0)  # steps of gradcheck are absolute
    model.y_scale.fill_(1.0)
    for function in (model, model.moments, model.type2, model.type1):
        assert torch.autograd.gradcheck(function, x)


@pytest.mark.parametrize("kind", MODELS)
def test_inference_mode_and_copies_change_nothing(kind, rng):
    model, x = model_of(kind, 2, rng), queries(rng)
    expected = [*model(x), *model.moments(x), model.type1(x), model.type2(x)]
    twin = copy.deepcopy(model)
    with torch.inference_mode():
        found = [*twin(x), *twin.moments(x), twin.type1(x), twin.type2(x)]
    assert all(torch.equal(a, b) for a, b in zip(found, expected, strict=True))
    twin.y_shift += 1.0
    assert not torch.equal(model(x)[0], twin(x)[0])


@pytest.mark.parametrize("kind", MODELS)
def test_the_model_in_single_precision_answers_in_it(kind, rng):
    model, x = model_of(kind, 2, rng), queries(rng)
    expected = model.moments(x)
    found = model.float().moments(x.float())
    for single, double in zip(found, expected, strict=True):
        assert single.dtype == torch.float32
        torch.testing.assert_close(single.double(), double, rtol=1e-2, atol=1e-3 * float(double.detach().abs().max()))

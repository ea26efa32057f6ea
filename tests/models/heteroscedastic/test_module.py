import copy
import json
import pickle

import numpy as np
import pytest
import torch
from scipy.optimize import brentq
from scipy.special import polygamma

from torch_pbd.models.conditional import ConditionalNormal
from torch_pbd.models.heteroscedastic.fit import fit_heteroscedastic
from torch_pbd.models.heteroscedastic.module import HeteroscedasticModel
from torch_pbd.models.heteroscedastic.processes import ProcessFamily
from torch_pbd.models.heteroscedastic.search import Families, SearchOptions
from torch_pbd.models.training import TrainingSet

PRIOR = 3.0


def fitted(d=2, *, period=None, length_scale=None, n=12, n_demos=8, seed=0):
    """A model of bends whose noise grows along the input."""
    rng = np.random.default_rng(seed)
    inputs = np.linspace(-0.5, 0.5, n)[:, np.newaxis]
    x, index = np.tile(inputs, (n_demos, 1)), np.tile(np.arange(n), n_demos)
    factor = 0.3 * np.exp(x)[:, :, np.newaxis] * (np.eye(d) + 0.4 * np.tril(np.ones((d, d)), -1))
    y = np.sin(3.0 * x + np.arange(d)) + (factor @ rng.normal(size=(n * n_demos, d, 1)))[..., 0]
    training = TrainingSet(*map(torch.tensor, (x, y, inputs, index)))
    families = Families(
        ProcessFamily(torch.tensor(inputs), 0.3, 1.2, 0.0, None, "matern52", period, exact=True),
        ProcessFamily(torch.tensor(inputs), 0.5, 1.0, 2.0, length_scale, "matern52", period, exact=True),
    )
    fit = fit_heteroscedastic(training, None, [families], SearchOptions())
    return HeteroscedasticModel(fit, PRIOR * torch.eye(d, dtype=torch.float64))


def restored(config, state):
    """The core of a whole model of one input."""
    n_outputs = len(state["pooled_tril"])
    scaling = {"x_shift": torch.zeros(1), "x_scale": torch.ones(1)}
    scaling |= {"y_shift": torch.zeros(n_outputs), "y_scale": torch.ones(n_outputs)}
    whole = {f"core.{name}": tensor for name, tensor in state.items()} | scaling
    return ConditionalNormal.restored(HeteroscedasticModel, config, whole).core


@pytest.fixture(scope="module")
def model():
    return fitted()


def queries():
    return torch.tensor([[-0.5], [0.1], [0.23], [0.9], [4.0], [1e6]], dtype=torch.float64)


@pytest.mark.parametrize(
    ("d", "period", "length_scale"),
    [(1, None, None), (3, None, None), (2, [1.0], None), (2, None, [0.4])],
    ids=["one output", "three", "period", "length scale"],
)
def test_a_model_comes_back_from_its_spec_and_its_tensors(d, period, length_scale):
    period, length_scale = (each and torch.tensor(each, dtype=torch.float64) for each in (period, length_scale))
    model = fitted(d, period=period, length_scale=length_scale)
    again = restored(json.loads(json.dumps(model.config())), model.state_dict())
    x = queries()
    for mine, others in zip(
        (*model(x), model.variability(x), model.degrees(x), model.type1(x)),
        (*again(x), again.variability(x), again.degrees(x), again.type1(x)),
        strict=True,
    ):
        assert torch.equal(mine, others)
    assert again.draw_sizes() == model.draw_sizes()
    assert again.config() == model.config()


def test_nothing_is_missing_at_the_inducing_inputs_and_all_far_away(model):
    assert float(model.type1(model.inducing).max()) < 1e-9
    far = torch.tensor([[20.0], [-1e6]], dtype=torch.float64)
    torch.testing.assert_close(model.type1(far), torch.ones(2).double(), rtol=1e-14, atol=0)
    between = model.type1(torch.linspace(0.5, 3.0, 200, dtype=torch.float64)[:, None])
    assert (between.diff() >= -1e-12).all()


def test_far_away_the_covariance_is_the_prior_exactly(model):
    far = torch.tensor([[1e6], [-1e6]], dtype=torch.float64)
    mean, root = model(far)
    expected = PRIOR**2 * torch.eye(2, dtype=torch.float64).expand(2, 2, 2)
    torch.testing.assert_close(root @ root.mT, expected, rtol=1e-12, atol=1e-14)
    assert torch.equal(mean, torch.zeros(2, 2).double())
    assert float(model.variability(far).abs().max()) == 0.0
    other = torch.tensor([[[2.0, 0.0], [1.0, 1.0]]], dtype=torch.float64).expand(2, 2, 2)
    root = model(far, other)[1]
    torch.testing.assert_close(root @ root.mT, other @ other.mT, rtol=1e-12, atol=1e-14)


def test_on_data_the_covariance_is_the_sum_of_its_parts(model):
    """The expected covariance of the variability and the error of the mean, with no share of the prior."""
    x = model.inducing
    _, root = model(x)
    moments = model.processes.covariance.at(x)
    variability = model.pooled_tril @ moments.expected_root(2.0)
    error = model.processes.mean.at(x)[1]
    expected = variability @ variability.mT + error
    torch.testing.assert_close(root @ root.mT, expected, rtol=1e-7, atol=1e-9)
    alone = model.pooled_tril @ moments.tril()
    torch.testing.assert_close(model.variability(x), alone, rtol=1e-9, atol=1e-9)
    assert (torch.linalg.eigvalsh(root @ root.mT - alone @ alone.mT) > 0).all()


@pytest.mark.parametrize(("low", "high", "rtol"), [(1e-3, 0.25, 0.01), (0.25, 0.87, 0.05)])
def test_degrees_are_those_of_a_variance_whose_logarithm_is_as_uncertain(low, high, rtol):
    """The variance of the log of a chi-squared number is trigamma(degrees / 2), here inverted by bisection."""
    model = fitted(1)
    x = model.inducing
    root = model.log_variance_root.clone()
    start = float(model.processes.covariance.at(x).log_variance_variance[0])
    for variance in np.geomspace(low, high, 10):
        model.log_variance_root = root * (variance / start) ** 0.5
        known = float(model.processes.covariance.at(x).log_variance_variance[0])
        assert known == pytest.approx(variance, rel=1e-2)
        expected = brentq(lambda degrees, known=known: polygamma(1, degrees / 2.0) - known, 1e-3, 1e6)
        assert float(model.degrees(x)[0]) == pytest.approx(max(3.0, expected), rel=rtol)


def test_degrees_are_of_the_mean_over_the_outputs_and_unlimited_far_away(model):
    variance = model.processes.covariance.at(model.inducing).log_variance_variance.mean(1)
    expected = (1.0 + (1.0 + 2.0 * variance).sqrt()) / variance
    torch.testing.assert_close(model.degrees(model.inducing), expected, rtol=1e-9, atol=0)
    assert float(model.degrees(torch.tensor([[1e6]]).double())) > 1e10


def test_the_forward_pass_is_differentiable(model):
    x = torch.tensor([[-0.41], [0.07], [0.8]], dtype=torch.float64, requires_grad=True)

    def moments(x):
        mean, root = model(x)
        return mean, root @ root.mT, model.degrees(x)

    assert torch.autograd.gradcheck(moments, x, atol=1e-4, rtol=1e-4)


def test_a_draw_is_a_root_of_the_same_function_at_all_inputs(model):
    """Asked at fewer inputs it has the values it has there among others; far away it is the prior."""
    normal = [torch.full((size,), 0.3, dtype=torch.float64) for size in model.draw_sizes()]
    x = queries()
    whole = model.draw(x, normal)
    torch.testing.assert_close(model.draw(x[2:4], normal), whole[2:4], rtol=1e-9, atol=1e-9)
    covariance = whole[-1] @ whole[-1].mT
    torch.testing.assert_close(covariance, PRIOR**2 * torch.eye(2).double(), rtol=1e-12, atol=1e-14)


def everything(model, x):
    normal = [torch.full((size,), 0.3, dtype=torch.float64) for size in model.draw_sizes()]
    return (*model(x), model.variability(x), model.degrees(x), model.type1(x), model.draw(x, normal))


def test_several_draws_are_those_asked_for_one_by_one(model, generator):
    normal = [torch.randn(3, size, dtype=torch.float64, generator=generator) for size in model.draw_sizes()]
    together = model.draw(queries(), normal)
    for k in range(3):
        torch.testing.assert_close(
            together[k], model.draw(queries(), [part[k] for part in normal]), rtol=1e-9, atol=1e-12
        )


def change_in_place(model):
    model.log_variance_theta += 0.1


def put_another(model):
    model.log_variance_theta = model.log_variance_theta + 0.1


def load(model):
    state = {name: tensor.clone() for name, tensor in model.state_dict().items()}
    state["log_variance_theta"] += 0.1
    model.load_state_dict(state)


@pytest.mark.parametrize("change", [change_in_place, put_another, load])
@pytest.mark.parametrize("inference", [False, True])
def test_a_buffer_that_changes_changes_what_is_predicted(change, inference):
    """What was computed of the old one is not kept."""
    model, x = fitted(), queries()
    with torch.inference_mode(inference):
        before = model(x)[1]
    change(model)
    anew = restored(model.config(), model.state_dict())
    for mine, others in zip(everything(model, x), everything(anew, x), strict=True):
        assert torch.equal(mine, others)
    assert not torch.equal(before, model(x)[1])


def test_predictions_in_inference_mode_leave_the_model_differentiable():
    model = fitted()
    x = queries()
    with torch.inference_mode():
        expected = model(x)[1]
    x.requires_grad_()
    found = model(x)[1]
    torch.testing.assert_close(found.detach(), expected, rtol=1e-12, atol=1e-12)
    found.square().sum().backward()
    assert torch.isfinite(x.grad).all()


def test_a_copy_and_a_pickle_predict_the_same(model):
    x = queries()
    expected = everything(model, x)
    for other in (copy.deepcopy(model), pickle.loads(pickle.dumps(model))):
        for mine, others in zip(everything(other, x), expected, strict=True):
            assert torch.equal(mine, others)

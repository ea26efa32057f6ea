import io
import json

import pytest
import torch

from torch_pbd.gp import Hyperparameters, Observations, condition
from torch_pbd.models.cholesky import CholeskyCovariance
from torch_pbd.models.conditional import ConditionalNormal, MeanAndCovariance
from torch_pbd.models.mixture import GaussianMixture
from torch_pbd.models.spec import module_from_spec, module_spec
from torch_pbd.models.wishart import WishartCovariance, padded

MODELS = ["cholesky", "cholesky, logarithmic", "wishart", "mixture"]


def tensor(array):
    return torch.tensor(array, dtype=torch.float64)


def processes(count, kernel, rng, *, shared=False):
    """Processes over two inputs; ``shared`` has one length scale for all."""
    length_scale = rng.uniform(0.3, 1.0, size=(1 if shared else count, 2))
    hyperparameters = Hyperparameters(
        tensor(length_scale), tensor(rng.uniform(0.5, 2.0, size=count)), torch.full((count,), 0.1).double()
    )
    observations = Observations(
        tensor(rng.normal(size=(6, 2))),
        tensor(rng.normal(size=(count, 6))),
        tensor(rng.integers(1, 5, size=6)).double(),
    )
    return condition(observations, hyperparameters, kernel, tensor(rng.normal(size=(count, 6))))[0]


def model_of(kind, rng):
    factor = tensor([[1.3, 0.0], [0.4, 0.7]])
    if kind == "mixture":
        scale_tril = torch.stack([torch.eye(4).double(), 2.3 * torch.eye(4).double()])
        core = GaussianMixture(tensor([0.3, 0.7]).log(), tensor(rng.normal(size=(2, 4))), scale_tril, 2)
    elif kind == "wishart":
        latent = processes(6, "matern32", rng, shared=True)
        core = MeanAndCovariance(processes(2, "matern52", rng), WishartCovariance(latent, padded(factor, 3), factor))
    else:
        covariance = CholeskyCovariance(processes(3, "matern32", rng), factor, log_diagonal="logarithmic" in kind)
        core = MeanAndCovariance(processes(2, "squared_exponential", rng), covariance)
    return ConditionalNormal(core, *(tensor(rng.uniform(1, 2, size=2)) for _ in range(4)))


def outputs(model, x):
    return [*model(x), *model.moments(x), model.type1(x), model.type2(x)]


@pytest.mark.parametrize("kind", MODELS)
def test_a_model_comes_back_from_plain_data_equal_to_the_bit(kind, rng):
    model, x = model_of(kind, rng), tensor(rng.normal(size=(7, 2)))
    if kind != "mixture":
        model.core.mean.value_weight.add_(1.0)  # what prediction of the mean does not read is kept too
    file = io.BytesIO()
    torch.save(model.state_dict(), file)
    file.seek(0)
    spec = json.loads(json.dumps(module_spec(model)))
    copy = module_from_spec(spec, torch.load(file, weights_only=True))
    assert all(torch.equal(a, b) for a, b in zip(outputs(model, x), outputs(copy, x), strict=True))
    assert module_spec(copy) == module_spec(model)
    state, copied = model.state_dict(), copy.state_dict()
    assert state.keys() == copied.keys()
    assert all(torch.equal(state[name], copied[name]) for name in state)


@pytest.mark.parametrize("kind", MODELS)
def test_each_tensor_is_needed(kind, rng):
    model = model_of(kind, rng)
    state = model.state_dict()
    for name in state:
        part = {key: value for key, value in state.items() if key != name}
        with pytest.raises(ValueError, match=f"there is no .{name}"):
            module_from_spec(module_spec(model), part)


def test_a_tensor_too_many_is_an_error(rng):
    model = model_of("cholesky", rng)
    with pytest.raises(ValueError, match="there is an unknown 'stranger'"):
        module_from_spec(module_spec(model), {**model.state_dict(), "stranger": torch.zeros(1)})


def test_a_model_of_another_kind_is_an_error(rng):
    model = model_of("cholesky", rng)
    with pytest.raises(ValueError, match="unknown covariance model 'splines'"):
        module_from_spec({**module_spec(model), "covariance": "splines"}, model.state_dict())


@pytest.mark.parametrize("kind", MODELS)
def test_the_copy_does_not_share_memory_with_what_it_was_made_of(kind, rng):
    model = model_of(kind, rng)
    copy = module_from_spec(module_spec(model), model.state_dict())
    shared = {tensor.data_ptr() for tensor in model.state_dict().values()}
    assert not shared & {tensor.data_ptr() for tensor in copy.state_dict().values()}

import io
import json
import sys

import pytest
import torch

from torch_pbd.gp.observations import Hyperparameters, Observations, condition
from torch_pbd.models.conditional import ConditionalNormal, MeanAndCholesky, MeanAndWishart
from torch_pbd.models.links import CholeskyLink, WishartLink, padded
from torch_pbd.models.mixture import GaussianMixture

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
        log_diagonal, lower = tensor([[1.0] * 4, [2.3] * 4]).log(), torch.zeros(2, 4, 4).double()
        core = GaussianMixture(tensor([0.3, 0.7]).log(), tensor(rng.normal(size=(2, 4))), log_diagonal, lower, 2)
    elif kind == "wishart":
        latent = processes(6, "matern32", rng, shared=True)
        link = WishartLink(padded(factor, 3), scale_matrix_tril=factor)
        core = MeanAndWishart(processes(2, "matern52", rng), latent, link)
    else:
        latent, link = processes(3, "matern32", rng), CholeskyLink(factor, "logarithmic" in kind)
        core = MeanAndCholesky(processes(2, "squared_exponential", rng), latent, link)
    return ConditionalNormal(core, *(tensor(rng.uniform(1, 2, size=2)) for _ in range(4)))


def outputs(model, x):
    return [*model(x), *model.moments(x), model.type1(x), model.type2(x)]


def test_a_skeleton_does_not_load_the_compiler(monkeypatch):
    """Arithmetic on tensors without numbers does, which takes seconds."""
    monkeypatch.setitem(sys.modules, "torch._dynamo", None)  # as if it were not there
    core = GaussianMixture.skeleton({}, {"log_weight": torch.Size([3])}, 1, 2)
    assert core.strict_lower.is_meta
    assert core.log_diagonal.shape == (3, 3)


@pytest.mark.parametrize("kind", MODELS)
def test_a_model_comes_back_from_plain_data_equal_to_the_bit(kind, rng):
    model, x = model_of(kind, rng), tensor(rng.normal(size=(7, 2)))
    if kind != "mixture":
        model.core.mean.value_weight.add_(1.0)  # what prediction of the mean does not read is kept too
    file = io.BytesIO()
    torch.save(model.state_dict(), file)
    file.seek(0)
    config = json.loads(json.dumps(model.core.config()))
    copy = ConditionalNormal.restored(type(model.core), config, torch.load(file, weights_only=True))
    assert all(torch.equal(a, b) for a, b in zip(outputs(model, x), outputs(copy, x), strict=True))
    assert copy.core.config() == model.core.config()
    state, copied = model.state_dict(), copy.state_dict()
    assert state.keys() == copied.keys()
    assert all(torch.equal(state[name], copied[name]) for name in state)


@pytest.mark.parametrize("kind", MODELS)
def test_each_tensor_is_needed(kind, rng):
    model = model_of(kind, rng)
    state = model.state_dict()
    for name in state:
        part = {key: value for key, value in state.items() if key != name}
        with pytest.raises((ValueError, RuntimeError), match=f"{name.removeprefix('core.')}"):
            ConditionalNormal.restored(type(model.core), model.core.config(), part)


def test_a_tensor_too_many_is_an_error(rng):
    model = model_of("cholesky", rng)
    state = {**model.state_dict(), "stranger": torch.zeros(1)}
    with pytest.raises(RuntimeError, match=r'Unexpected key.* "stranger"'):
        ConditionalNormal.restored(type(model.core), model.core.config(), state)


def test_a_model_of_another_kind_is_an_error(rng):
    model = model_of("cholesky", rng)
    with pytest.raises(ValueError, match="its model is of another class"):
        ConditionalNormal.restored(
            type(model.core), {**model.core.config(), "covariance": "splines"}, model.state_dict()
        )


@pytest.mark.parametrize("kind", MODELS)
def test_shapes_that_do_not_agree_are_refused_before_anything_is_allocated(kind, rng):
    model = model_of(kind, rng)
    state = model.state_dict()
    for name, tensor in state.items():
        wide = tensor.new_zeros(()).expand(*([10**6] * tensor.ndim))  # of one number in memory
        with pytest.raises((ValueError, RuntimeError), match=r"size mismatch|inputs needs about|is described by"):
            ConditionalNormal.restored(type(model.core), model.core.config(), {**state, name: wide})

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ExpSineSquared, Matern

from torch_pbd.gp.observations import spacing
from torch_pbd.kernels import KERNELS
from torch_pbd.models.heteroscedastic.processes import FixedFeatures, ProcessFamily, inducing_inputs
from torch_pbd.models.heteroscedastic.regression import LinearEvidence

ORACLES = {
    "squared_exponential": RBF,
    "matern32": lambda length_scale: Matern(length_scale, nu=1.5),
    "matern52": lambda length_scale: Matern(length_scale, nu=2.5),
}


def tensor(array):
    return torch.tensor(array, dtype=torch.float64)


def family_on(inducing, kernel="squared_exponential", period=None, **options):
    return ProcessFamily(inducing, 0.5, 1.0, 0.0, kernel=kernel, period=period, **options)


def features(family, length_scale, x):
    """Features of a process of unit variance."""
    held = replace(family, fixed_length_scale=length_scale)
    return held.prepared(torch.zeros(1, x.shape[1] + 1).double())(x)[0]


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("length_scale", [[0.3], [0.4, 2.0]])
def test_inner_products_of_features_are_the_kernel_at_the_inducing_inputs(kernel, length_scale, rng):
    """And with any other input, whatever lies between."""
    x, other = (rng.uniform(-1.0, 1.0, size=(n, len(length_scale))) for n in (10, 7))
    family = family_on(tensor(x), kernel)
    first, second = (features(family, tensor(length_scale), tensor(z)) for z in (x, other))
    expected = ORACLES[kernel](length_scale)
    # The jitter of 1e-10, times what is left of other directions of the kernel matrix.
    np.testing.assert_allclose(first @ first.mT, expected(x), rtol=0, atol=2e-10)
    np.testing.assert_allclose(first @ second.mT, expected(x, other), rtol=0, atol=1e-5)


def test_each_length_scale_of_a_batch_is_on_its_own(generator):
    x = torch.rand(6, 2, dtype=torch.float64, generator=generator)
    theta = tensor([[0.3, 2.0, 1.0], [1.0, 0.2, 1.0], [0.5, 0.5, 1.0]]).log()
    family = family_on(x[:4])
    batch = family.prepared(theta)(x)
    for i in range(3):
        torch.testing.assert_close(batch[i], family.prepared(theta[i : i + 1])(x)[0], rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("kernel", KERNELS)
def test_features_are_differentiable_in_inputs_and_length_scales(kernel, generator):
    family = family_on(torch.rand(5, 2, dtype=torch.float64, generator=generator), kernel)
    x = torch.rand(3, 2, dtype=torch.float64, generator=generator).requires_grad_()
    theta = tensor([[0.3, 0.8, 1.0], [0.5, 0.4, 1.0]]).log().requires_grad_()
    assert torch.autograd.gradcheck(lambda x, theta: family.prepared(theta)(x), (x, theta))


def test_periodic_predictions_are_those_of_scikit_learn(rng):
    """Its ExpSineSquared is exp(-2 sin(pi r / period)^2 / l^2); with chords of a circle of circumference ``period``
    the same is a squared exponential of length scale ``period * l / (2 pi)``.
    """
    period, length_scale = 1.3, 0.25
    peer_kernel = ExpSineSquared(2.0 * np.pi * length_scale / period, period)
    x, y = rng.uniform(0.0, period, size=(9, 1)), rng.normal(size=9)
    peer = GaussianProcessRegressor(peer_kernel, alpha=0.04, optimizer=None).fit(x, y)
    family = family_on(tensor(x), period=tensor([period]), exact=True)

    def predict(query):
        design = features(family, tensor([length_scale]), tensor(query))
        root = design @ weights.root
        return (design @ weights.mean).numpy(), (1.0 - design.square().sum(1) + root.square().sum(1)).sqrt().numpy()

    weights = LinearEvidence.fit(5.0 * features(family, tensor([length_scale]), tensor(x)), tensor(5.0 * y)).weights
    query = rng.uniform(-2.0, 3.0, size=(20, 1))
    mean, std = peer.predict(query, return_std=True)
    np.testing.assert_allclose(predict(query)[0], mean, rtol=0, atol=1e-7)
    np.testing.assert_allclose(predict(query)[1], std, rtol=0, atol=1e-7)
    for turns in (1, -3):
        np.testing.assert_allclose(predict(query + turns * period), predict(query), rtol=0, atol=1e-9)


def test_an_input_without_a_period_does_not_repeat(generator):
    x = torch.rand(6, 2, dtype=torch.float64, generator=generator)
    family = family_on(x, "matern32", tensor([0.8, torch.inf]))
    start = features(family, tensor([0.3, 0.3]), x)
    turned = features(family, tensor([0.3, 0.3]), x + tensor([0.8, 0.0]))
    torch.testing.assert_close(turned, start, rtol=0, atol=1e-6)
    assert (features(family, tensor([0.3, 0.3]), x + tensor([0.0, 0.8])) - start).abs().max() > 0.1


def missing(family, x, length_scale):
    return 1.0 - features(family, length_scale, x).square().sum(-1)


@pytest.mark.parametrize("kernel", KERNELS)
def test_the_more_inducing_inputs_the_less_variance_is_missing(kernel):
    x = torch.linspace(-0.5, 0.5, 301, dtype=torch.float64)[:, None]
    families = [family_on(inducing_inputs(x, n), kernel) for n in (3, 5, 9, 17, 33)]
    worst = [float(missing(family, x, tensor([0.2])).max()) for family in families]
    assert worst[0] > 0.2
    # Of a smooth kernel only the jitter's share is missing soon, 1e-10 of each feature.
    assert all(after < 0.6 * before for before, after in pairwise(worst) if after > 1e-8)
    assert worst[-1] < {"squared_exponential": 1e-8, "matern32": 0.05, "matern52": 0.005}[kernel]


def test_at_the_shortest_length_scale_features_carry_nearly_all_of_the_variance_between():
    z = torch.linspace(-0.5, 0.5, 21, dtype=torch.float64)[:, None]
    family = family_on(z)
    shortest = family.shortest_length_scale
    assert shortest == pytest.approx(spacing(z), rel=1e-9)
    between = torch.linspace(-0.5, 0.5, 401, dtype=torch.float64)[:, None]
    lacking = missing(family, between, tensor([shortest]))
    assert float(lacking[80:-80].max()) < 5.5e-3
    assert float(lacking.max()) < 1.5e-2  # between the last two, which have neighbours on one side
    assert family_on(z, exact=True).shortest_length_scale == pytest.approx(0.75 * spacing(z), rel=1e-9)


def test_inducing_inputs_are_the_inputs_or_the_ends_and_the_means_of_runs_of_the_others(rng):
    x = tensor(rng.uniform(size=(66, 1)))
    assert inducing_inputs(x, 66) is x
    order = x[:, 0].sort().values
    expected = torch.cat([order[:1], order[1:-1].reshape(16, 4).mean(1), order[-1:]])
    torch.testing.assert_close(inducing_inputs(x, 18)[:, 0].sort().values, expected, rtol=1e-12, atol=0)
    assert [len(inducing_inputs(x, n)) for n in (2, 3, 20)] == [2, 3, 20]


def test_stretched_features_are_those_of_inputs_with_more_length_at_the_ends():
    x = tensor(np.linspace(-0.5, 0.5, 41)[:, np.newaxis])
    stretched = family_on(x[::4], stretch=tensor([[0.4, 0.1], [1.0, 0.02]]))
    at = stretched.warped(x)
    assert float(at.diff(dim=0).min()) > 0.0
    # Of the length one that is added at the end exp(-1) is more than the width away from it, and of .4 at the start.
    np.testing.assert_allclose(at[[0, 4, -1], 0] - at[20, 0], [-0.9, -0.5 + 0.1 - 0.4 * np.exp(-1), 1.5], atol=0.01)
    plain = family_on(stretched.warped(x[::4]))
    np.testing.assert_array_equal(features(stretched, tensor([0.3]), x), features(plain, tensor([0.3]), at))
    held = replace(stretched, fixed_length_scale=tensor([0.3]))
    values, _ = FixedFeatures(held, x).design_vjp(torch.zeros(1, 2).double(), tensor([1e99]))
    expected = features(stretched, tensor([0.3]), x)
    torch.testing.assert_close(values[0] @ values[0].mT, expected @ expected.mT, rtol=0, atol=1e-6)
    assert stretched.shortest_length_scale == plain.shortest_length_scale
    # Beyond the ends no length is added.
    beyond = stretched.warped(tensor([[-0.5], [-0.8], [0.5], [0.7]])).diff(dim=0).flatten()
    np.testing.assert_allclose(beyond[[0, 2]], [-0.3, 0.2], atol=1e-4)

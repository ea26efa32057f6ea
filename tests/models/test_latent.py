import gpytorch
import numpy as np
import pytest
import torch
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, Matern

from torch_pbd.gp.observations import Hyperparameters, Observations, condition
from torch_pbd.kernels import correlation
from torch_pbd.models.costs import LatentValues

LENGTH_SCALE = {1: [[0.2], [0.5]], 2: [[0.2, 1.0], [0.5, 0.3]]}
AMPLITUDE, NOISE_SCALE = [1.5, 0.7], [0.2, 0.1]


def tensor(array):
    return torch.tensor(array, dtype=torch.float64)


def hyperparameters(e):
    noise_ratio = (tensor(NOISE_SCALE) / tensor(AMPLITUDE)) ** 2
    return Hyperparameters(tensor(LENGTH_SCALE[e]), tensor(AMPLITUDE), noise_ratio)


def data(e, rng, n=15):
    return rng.uniform(size=(n, e)), rng.normal(size=(2, n)), rng.uniform(-0.2, 1.2, size=(40, e))


def regressor(x, y, length_scale, amplitude, alpha, oracle=RBF):
    kernel = ConstantKernel(amplitude**2) * oracle(length_scale)
    return GaussianProcessRegressor(kernel, alpha=alpha, optimizer=None).fit(x, y)


@pytest.mark.parametrize(
    ("kernel", "oracle"), [("squared_exponential", RBF), ("matern32", lambda length: Matern(length, nu=1.5))]
)
@pytest.mark.parametrize("e", [1, 2])
def test_the_mean_is_that_of_scikit_learn(kernel, oracle, e, rng):
    x, y, queries = data(e, rng)
    gp, jitter = condition(
        Observations(tensor(x), tensor(y), torch.ones(15, dtype=torch.float64)), hyperparameters(e), kernel
    )
    assert jitter == 0.0
    for row in range(2):
        model = regressor(x, y[row], LENGTH_SCALE[e][row], AMPLITUDE[row], NOISE_SCALE[row] ** 2, oracle)
        mean = model.predict(queries)
        np.testing.assert_allclose(gp(tensor(queries)).detach()[:, row], mean, rtol=1e-9, atol=1e-12)


class ExactGP(gpytorch.models.ExactGP):
    def __init__(self, x, y, likelihood, length_scale, amplitude):
        super().__init__(x, y, likelihood)
        self.mean_module = gpytorch.means.ZeroMean()
        self.covar_module = gpytorch.kernels.ScaleKernel(gpytorch.kernels.RBFKernel(ard_num_dims=len(length_scale)))
        self.double()
        self.covar_module.base_kernel.lengthscale = tensor(length_scale)
        self.covar_module.outputscale = tensor(amplitude**2)  # a float would be rounded to single precision

    def forward(self, x):
        return gpytorch.distributions.MultivariateNormal(self.mean_module(x), self.covar_module(x))


@pytest.mark.parametrize("e", [1, 2])
def test_the_mean_is_that_of_gpytorch(e, rng):
    x, y, queries = data(e, rng)
    counts = rng.integers(1, 9, size=15).astype(float)
    gp, _ = condition(Observations(tensor(x), tensor(y), tensor(counts)), hyperparameters(e))
    for row in range(2):
        likelihood = gpytorch.likelihoods.FixedNoiseGaussianLikelihood(tensor(NOISE_SCALE[row] ** 2 / counts))
        model = ExactGP(tensor(x), tensor(y[row]), likelihood, LENGTH_SCALE[e][row], AMPLITUDE[row]).eval()
        with torch.no_grad(), gpytorch.settings.fast_computations(False, False, False):
            mean = model(tensor(queries)).mean
        np.testing.assert_allclose(gp(tensor(queries)).detach()[:, row], mean, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("e", [1, 2])
def test_means_with_their_counts_say_what_all_rows_say(e, rng):
    x, _, queries = data(e, rng)
    index = np.repeat(np.arange(15), rng.integers(1, 9, size=15))
    rows = rng.normal(size=(2, len(index)))
    counts = np.bincount(index)
    means = np.stack([np.bincount(index, weights=row) / counts for row in rows])
    gp, _ = condition(Observations(tensor(x), tensor(means), tensor(counts)), hyperparameters(e))
    for row in range(2):
        model = regressor(x[index], rows[row], LENGTH_SCALE[e][row], AMPLITUDE[row], NOISE_SCALE[row] ** 2)
        mean = model.predict(queries)
        np.testing.assert_allclose(gp(tensor(queries)).detach()[:, row], mean, rtol=1e-9, atol=1e-12)


def test_values_are_the_means_of_other_targets(rng):
    x, y, queries = data(1, rng)
    others = rng.normal(size=(2, 15))
    observations = Observations(tensor(x), tensor(y), torch.ones(15, dtype=torch.float64))
    gp, _ = condition(observations, hyperparameters(1), values=tensor(others))
    for row in range(2):
        model = regressor(x, others[row], LENGTH_SCALE[1][row], AMPLITUDE[row], NOISE_SCALE[row] ** 2)
        np.testing.assert_allclose(gp.values(tensor(queries))[:, row], model.predict(queries), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("count", [1.0, 7.0])
def test_one_observation_gives_the_closed_form(count):
    x, y, length_scale, amplitude, noise_scale = 0.3, 2.0, 0.4, 1.5, 0.6
    shared = Hyperparameters(tensor([[length_scale]]), tensor([amplitude]), tensor([(noise_scale / amplitude) ** 2]))
    gp, _ = condition(Observations(tensor([[x]]), tensor([[y]]), tensor([count])), shared)
    query = np.array([0.0, 0.3, 1.0])
    decay = np.exp(-0.5 * ((query - x) / length_scale) ** 2)
    total = amplitude**2 + noise_scale**2 / count
    np.testing.assert_allclose(gp(tensor(query[:, None])).detach()[:, 0], amplitude**2 * decay * y / total, rtol=1e-9)
    np.testing.assert_allclose(gp.type1(tensor(query[:, None])), 1.0 - decay**2, rtol=1e-9, atol=1e-15)


def test_far_from_data_the_prior_speaks(rng):
    x, y, _ = data(2, rng)
    gp, _ = condition(Observations(tensor(x), tensor(y), torch.ones(15, dtype=torch.float64)), hyperparameters(2))
    for far in (1e3, 1e300):
        query = tensor([[far, -far]])
        assert gp(query).tolist() == gp.values(query).tolist() == [[0.0, 0.0]]
        assert gp.type1(query).item() == pytest.approx(1.0, rel=1e-15)


@pytest.mark.parametrize(
    ("kernel", "oracle"), [("squared_exponential", RBF), ("matern32", lambda length: Matern(length, nu=1.5))]
)
@pytest.mark.parametrize("e", [1, 2])
def test_type1_is_the_variance_of_scikit_learn_without_noise(kernel, oracle, e, rng):
    x, y, queries = data(e, rng, n=5)  # apart from each other: more would leave nothing but rounding
    x[:, 0] = np.linspace(0.0, 1.0, 5)
    own = hyperparameters(e)
    gp, _ = condition(Observations(tensor(x), tensor(y), torch.ones(5, dtype=torch.float64)), own, kernel)
    variance = np.zeros(len(queries))
    for row in range(2):
        model = regressor(x, y[row], LENGTH_SCALE[e][row], AMPLITUDE[row], 0.0, oracle)
        variance += model.predict(queries, return_std=True)[1] ** 2
    expected = variance / np.square(AMPLITUDE).sum()
    np.testing.assert_allclose(gp.type1(tensor(queries)), expected, rtol=1e-8, atol=1e-12)


@pytest.mark.parametrize("length_scale", [[[0.2]], [[0.2], [0.05]], [[10.0]]])
@pytest.mark.parametrize("noise_ratio", [0.0, 0.5])
def test_type1_is_zero_on_data_and_rises_to_one_leaving_them(length_scale, noise_ratio, rng):
    x = rng.uniform(size=(12, 1))
    count = len(length_scale)
    shared = Hyperparameters(
        tensor(length_scale), tensor([1.0, 3.0][:count]), torch.full((count,), noise_ratio).double()
    )
    gp, _ = condition(Observations(tensor(x), tensor(rng.normal(size=(count, 12))), torch.ones(12).double()), shared)
    assert gp.type1(tensor(x)).abs().max() <= 1e-6
    leaving = gp.type1(torch.linspace(float(x.max()), 100.0, 500, dtype=torch.float64)[:, None])
    assert (leaving.diff() >= -1e-12).all()
    assert leaving[-1].item() == pytest.approx(1.0, rel=1e-12)


def test_type1_averages_the_processes_with_their_variances_for_weights():
    length_scale, amplitude = np.array([0.2, 1.0]), np.array([1.0, 3.0])
    shared = Hyperparameters(tensor(length_scale[:, None]), tensor(amplitude), tensor([0.3, 0.0]))
    gp, _ = condition(Observations(tensor([[0.0]]), tensor([[1.0], [1.0]]), tensor([1.0])), shared)
    reduced = 1 - np.exp(-((0.5 / length_scale) ** 2))
    expected = (amplitude**2 * reduced).sum() / (amplitude**2).sum()
    assert gp.type1(tensor([[0.5]])).item() == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_type1_does_not_need_an_amplitude(dtype):
    """Targets that are all zero have the smallest amplitude there is, which is zero in single precision."""
    shared = Hyperparameters(tensor([[0.2], [0.2]]), tensor([1e-200, 1e-200]), tensor([0.1, 0.2]))
    gp, _ = condition(Observations(tensor([[0.0]]), tensor([[0.0], [0.0]]), tensor([1.0])), shared)
    np.testing.assert_allclose(gp.to(dtype).type1(torch.tensor([[0.0], [9.0]], dtype=dtype)), [0.0, 1.0], atol=1e-12)


@pytest.mark.parametrize("e", [1, 2])
def test_prediction_is_differentiable(e, rng):
    x, y, queries = data(e, rng)
    gp, _ = condition(Observations(tensor(x), tensor(y), torch.ones(15, dtype=torch.float64)), hyperparameters(e))
    query = tensor(queries[:5]).requires_grad_()
    for predict in (gp, gp.type1):
        assert torch.autograd.gradcheck(predict, query)


GRID = torch.linspace(0, 1, 30, dtype=torch.float64)[:, None]


def smooth(length_scale, train_hyperparameters):
    """Deviations that the processes themselves could have drawn, and the latent values that start there."""
    amplitude = tensor([2.0, 0.5])
    gram = correlation(GRID, GRID, length_scale.expand(2, -1))
    combination = torch.randn(2, 30, 1, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    deviation = amplitude[:, None] * (gram @ combination).squeeze(-1)
    return deviation, LatentValues(
        GRID, deviation, amplitude, length_scale, train_hyperparameters=train_hyperparameters
    )


# Eigenvalues of a kernel matrix below 1e-11 of the largest carry nothing: a root of that, relative, is lost
# at worst. Where hyperparameters are trained it is the condition of the matrix, up to 1e14, that costs digits.
LATENT_TOLERANCE = 1e-6


@pytest.mark.parametrize("train_hyperparameters", [False, True])
@pytest.mark.parametrize("length_scale", [[[0.05]], [[0.2]], [[0.05], [0.1]]])
def test_latent_values_start_at_the_deviation_given(length_scale, train_hyperparameters):
    deviation, latent = smooth(tensor(length_scale), train_hyperparameters)
    torch.testing.assert_close(latent().mT, deviation, rtol=0, atol=LATENT_TOLERANCE)


def test_a_deviation_that_is_too_rough_starts_at_the_nearest_smooth_one(generator):
    rough = torch.randn(1, 30, dtype=torch.float64, generator=generator)
    latent = LatentValues(GRID, rough, tensor([1.5]), tensor([[0.5]]))
    nearest = latent()[:, 0].detach()
    assert latent.basis.shape[-1] < 20
    assert (nearest - rough[0]).abs().max() > 0.1
    np.testing.assert_allclose((rough[0] - nearest) @ latent.basis[0], 0.0, atol=1e-12)


@pytest.mark.parametrize("e", [1, 2])
@pytest.mark.parametrize("kernel", ["squared_exponential", "matern32", "matern52"])
def test_the_basis_is_an_orthogonal_root_of_the_kernel_matrix_of_any_rank(kernel, e, generator):
    """By pivots where the rank is low or the inputs few, else by the eigenvectors of the whole matrix."""
    for n_inputs in (1, 20, 200):
        inputs = torch.rand(n_inputs, e, dtype=torch.float64, generator=generator) - 0.5
        length_scale = torch.full((1, e), 0.3, dtype=torch.float64)
        latent = LatentValues(
            inputs, torch.zeros(2, n_inputs).double(), tensor([1.0, 2.0]), length_scale, kernel=kernel
        )
        basis, gram = latent.basis[0], correlation(inputs, inputs, length_scale[0], kernel)
        torch.testing.assert_close(basis @ basis.mT, gram, rtol=0, atol=1e-8)
        square = basis.mT @ basis
        assert (square - torch.diag(square.diagonal())).abs().max() < 1e-12 * n_inputs
        eigenvalues = torch.linalg.eigvalsh(gram).flip(0)
        matter = int((eigenvalues > 1e-11 * eigenvalues[0]).sum())
        assert abs(basis.shape[1] - matter) <= 1  # that on the edge may be rounded to either side
        largest = square.diagonal().sort(descending=True).values[: matter - 1]
        torch.testing.assert_close(largest, eigenvalues[: matter - 1], rtol=1e-3, atol=0)


@pytest.mark.parametrize("length_scale", [[[0.2]], [[0.2], [0.05], [0.1]]])
@pytest.mark.parametrize("members", [[0], [0, 1, 2], [2, 0]])
def test_the_normal_matrix_is_the_hessian_of_autograd(length_scale, members, generator):
    deviation = torch.randn(3, 30, dtype=torch.float64, generator=generator)
    latent = LatentValues(GRID, deviation, tensor([2.0, 0.5, 1.0]), tensor(length_scale))
    root = torch.randn(30, len(members), len(members), dtype=torch.float64, generator=generator)
    shape = (len(members), latent.whitened.shape[1])

    def square(flat):
        whitened = latent.whitened.detach().index_copy(0, torch.tensor(members), flat.reshape(shape))
        moved = latent(whitened)[:, members].unsqueeze(-1)
        return 0.5 * (root.mT @ moved).square().sum()

    hessian = torch.autograd.functional.hessian(square, torch.zeros(shape).double().flatten())
    found = latent.normal_matrix(torch.tensor(members), root @ root.mT)
    torch.testing.assert_close(found.tril(), hessian.tril(), rtol=1e-9, atol=1e-12 * float(hessian.abs().max()))


def test_the_vjp_is_that_of_autograd(generator):
    _, latent = smooth(tensor([[0.1]]), False)
    weight = torch.randn(30, 2, dtype=torch.float64, generator=generator)
    (expected,) = torch.autograd.grad((weight * latent()).sum(), latent.whitened)
    torch.testing.assert_close(latent.vjp(weight), expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("train_hyperparameters", [False, True])
def test_whitened_values_are_independent_and_standard_normal_a_priori(train_hyperparameters):
    """The covariance that follows for the deviations is that of the kernel."""
    length_scale = tensor([[0.2]])
    _, latent = smooth(length_scale, train_hyperparameters)

    def deviations(whitened):
        return torch.func.functional_call(latent, {"whitened": whitened}, ())

    jacobian = torch.autograd.functional.jacobian(deviations, latent.whitened.detach())
    for row, amplitude in enumerate([2.0, 0.5]):
        root = jacobian[:, row, row]
        expected = amplitude**2 * correlation(GRID, GRID, length_scale[0])
        # Eigenvalues below 1e-11 of the largest are left out.
        torch.testing.assert_close(root @ root.mT, expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("train_hyperparameters", [False, True])
@pytest.mark.parametrize("length_scale", [[[0.05]], [[0.2]], [[0.05], [0.1]], [[0.05], [0.4]]])
def test_interpolation_goes_through_the_deviations_and_the_values(length_scale, train_hyperparameters):
    deviation, latent = smooth(tensor(length_scale), train_hyperparameters)
    values = 3.0 * deviation.flip(0)
    values = values if len(length_scale) == 1 else 3.0 * deviation
    gp = latent.interpolate(values)
    with torch.no_grad():
        torch.testing.assert_close(gp(GRID), latent(), rtol=0, atol=LATENT_TOLERANCE)
        torch.testing.assert_close(gp.values(GRID).mT, values, rtol=0, atol=10 * LATENT_TOLERANCE)
        assert gp(tensor([[100.0], [1e300]])).tolist() == [[0.0, 0.0]] * 2
        assert gp.values(tensor([[100.0]])).tolist() == [[0.0, 0.0]]


@pytest.mark.parametrize("train_hyperparameters", [False, True])
def test_interpolation_between_inputs_is_that_without_noise(train_hyperparameters, rng):
    length_scale = 0.03
    deviation, latent = smooth(tensor([[length_scale]]), train_hyperparameters)
    gp = latent.interpolate(deviation)
    queries = rng.uniform(-0.1, 1.1, size=(50, 1))
    weight = np.linalg.solve(RBF(length_scale)(GRID.numpy()), deviation.numpy().T)
    expected = RBF(length_scale)(queries, GRID.numpy()) @ weight
    np.testing.assert_allclose(gp(tensor(queries)).detach(), expected, rtol=0, atol=1e-9)
    np.testing.assert_allclose(gp.values(tensor(queries)), expected, rtol=0, atol=1e-9)
    assert gp.type1(GRID).abs().max() <= 1e-9


def test_interpolation_follows_hyperparameters_that_were_trained():
    _, latent = smooth(tensor([[0.05]]), True)
    with torch.no_grad():
        latent.log_length_scale[0] = np.log(0.1)
        latent.log_amplitude[1] = np.log(3.0)
        latent.whitened.mul_(0.5)
        gp = latent.interpolate(latent().mT.contiguous())
        torch.testing.assert_close(gp(GRID), latent(), rtol=0, atol=LATENT_TOLERANCE)
    np.testing.assert_allclose(gp.length_scale, [[0.1], [0.05]], rtol=1e-12)
    np.testing.assert_allclose(gp.amplitude, [2.0, 3.0], rtol=1e-12)


@pytest.mark.parametrize("kernel", ["squared_exponential", "matern32", "matern52"])
@pytest.mark.parametrize("train_hyperparameters", [False, True])
def test_latent_values_are_differentiable_in_all_that_is_trained(kernel, train_hyperparameters, generator):
    inputs = torch.rand(5, 2, dtype=torch.float64, generator=generator)
    deviation = torch.randn(2, 5, dtype=torch.float64, generator=generator)
    latent = LatentValues(
        inputs,
        deviation,
        tensor([2.0, 0.5]),
        tensor([[0.2, 0.5]]),
        kernel=kernel,
        train_hyperparameters=train_hyperparameters,
    )
    names = [name for name, parameter in latent.named_parameters() if parameter.requires_grad]
    assert names == (["log_amplitude", "log_length_scale", "whitened"] if train_hyperparameters else ["whitened"])
    assert [id(parameter) for parameter in latent.trained()] == [id(latent.get_parameter(name)) for name in names]

    def deviations(*values):
        return torch.func.functional_call(latent, dict(zip(names, values, strict=True)), ())

    start = [latent.get_parameter(name).detach().clone().requires_grad_() for name in names]
    assert torch.autograd.gradcheck(deviations, start)

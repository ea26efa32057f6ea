"""What others make of gpytorch: an exact batch of Gaussian processes, and sampled variational factors."""

import gpytorch
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Floats = NDArray[np.float64]
_N_SAMPLES = 64


def _door(array: Floats) -> Tensor:
    return torch.tensor(np.ascontiguousarray(array), dtype=torch.float64)


def _scaled_kernel(n_processes: int, n_features: int) -> gpytorch.kernels.Kernel:
    """Squared exponential with a length scale an input, a fifth of the range to begin with."""
    batch = torch.Size([n_processes])
    kernel = gpytorch.kernels.RBFKernel(
        batch_shape=batch,
        ard_num_dims=n_features,
        lengthscale_constraint=gpytorch.constraints.GreaterThan(0.02),
    )
    kernel.lengthscale = 0.2
    return gpytorch.kernels.ScaleKernel(kernel, batch_shape=batch)


class _Exact(gpytorch.models.ExactGP):
    def __init__(self, x: Tensor, targets: Tensor, likelihood: gpytorch.likelihoods.Likelihood) -> None:
        super().__init__(x, targets, likelihood)
        self.mean_module = gpytorch.means.ConstantMean(batch_shape=targets.shape[:1])
        self.covar_module = _scaled_kernel(len(targets), x.shape[-1])

    def forward(self, x: Tensor) -> gpytorch.distributions.MultivariateNormal:
        return gpytorch.distributions.MultivariateNormal(self.mean_module(x), self.covar_module(x))


class ExactBatch:
    """One exact process for each column of ``targets`` (n, q), standardized, by marginal likelihood."""

    def __init__(self, x: Floats, targets: Floats, n_steps: int = 100) -> None:
        self._shift, spread = targets.mean(axis=0), targets.std(axis=0)
        self._scale = np.where(spread > 0, spread, 1.0)
        values = _door(((targets - self._shift) / self._scale).T)
        inputs = _door(x).expand(len(values), -1, -1)
        likelihood = gpytorch.likelihoods.GaussianLikelihood(
            batch_shape=values.shape[:1], noise_constraint=gpytorch.constraints.GreaterThan(1e-6)
        )
        self._model = _Exact(inputs, values, likelihood).double().train()
        objective = gpytorch.mlls.ExactMarginalLogLikelihood(likelihood, self._model)
        optimizer = torch.optim.Adam(self._model.parameters(), lr=0.1)
        for _ in range(n_steps):
            optimizer.zero_grad()
            loss = -objective(self._model(inputs), values).sum()
            loss.backward()
            optimizer.step()
        self._model.eval()

    def predict(self, x: Floats) -> Floats:
        """Means (m, q)."""
        with torch.no_grad(), gpytorch.settings.skip_posterior_variances():
            mean = self._model(_door(x).expand(len(self._scale), -1, -1)).mean
        return self._shift + self._scale * mean.numpy().T


class _Sparse(gpytorch.models.ApproximateGP):
    def __init__(self, inducing: Tensor, n_processes: int) -> None:
        batch = torch.Size([n_processes])
        distribution = gpytorch.variational.CholeskyVariationalDistribution(len(inducing), batch_shape=batch)
        points = inducing.expand(n_processes, -1, -1).clone()
        super().__init__(
            gpytorch.variational.VariationalStrategy(self, points, distribution, learn_inducing_locations=True)
        )
        self.mean_module = gpytorch.means.ConstantMean(batch_shape=batch)
        self.covar_module = _scaled_kernel(n_processes, inducing.shape[1])

    def forward(self, x: Tensor) -> gpytorch.distributions.MultivariateNormal:
        return gpytorch.distributions.MultivariateNormal(self.mean_module(x), self.covar_module(x))


class SampledFactors:
    """Mean and Cholesky factor with a log-diagonal, each entry a sparse process, by the sampled bound.

    The bound is maximized by Adam on all rows, 8 draws a step, its step size falling to zero by a cosine.
    """

    def __init__(self, x: Floats, y: Floats, n_steps: int = 1000) -> None:
        self._d = y.shape[1]
        self._generator = torch.Generator().manual_seed(0)
        inputs, targets = _door(x), _door(y)
        chosen = torch.linspace(0, len(inputs) - 1, 25 * x.shape[1]).round().long()
        inducing = inputs[torch.argsort(inputs[:, 0])][chosen]
        inducing = inducing + 1e-3 * torch.randn(inducing.shape, generator=self._generator, dtype=torch.float64)
        self._model = _Sparse(inducing, self._d + self._d * (self._d + 1) // 2).double().train()
        optimizer = torch.optim.Adam(self._model.parameters(), lr=0.03)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, n_steps)
        for _ in range(n_steps):
            optimizer.zero_grad()
            mean, factor = self._draw(inputs, 8)
            whitened = torch.linalg.solve_triangular(factor, (targets - mean)[..., None], upper=False)[..., 0]
            log_det = torch.diagonal(factor, dim1=-2, dim2=-1).log().sum(-1)
            expected = (-0.5 * whitened.square().sum(-1) - log_det).mean(0).sum()
            divergence = self._model.variational_strategy.kl_divergence().sum()
            loss = (divergence - expected) / len(inputs)
            loss.backward()
            optimizer.step()
            schedule.step()
        self._model.eval()

    def sample(self, x: Floats) -> tuple[Floats, Floats]:
        """Posterior draws of the mean (s, n, d) and of the factor (s, n, d, d)."""
        self._generator.manual_seed(1)
        with torch.no_grad():
            mean, factor = self._draw(_door(x), _N_SAMPLES)
        return mean.numpy(), factor.numpy()

    def _draw(self, x: Tensor, n_samples: int) -> tuple[Tensor, Tensor]:
        latent = self._model(x)
        noise = torch.randn((n_samples, *latent.mean.shape), generator=self._generator, dtype=torch.float64)
        values = (latent.mean + latent.variance.clamp_min(1e-10).sqrt() * noise).mT
        rows, columns = torch.tril_indices(self._d, self._d)
        factor = values.new_zeros(*values.shape[:2], self._d, self._d)
        factor[..., rows, columns] = values[..., self._d :]
        diagonal = torch.diagonal(factor, dim1=-2, dim2=-1)
        return values[..., : self._d], factor.tril(-1) + torch.diag_embed(diagonal.clamp(-12.0, 6.0).exp())

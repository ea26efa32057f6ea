"""The fitted model as a module: everything that predicts is in its buffers."""

import math
import operator
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from torch_pbd import checks
from torch_pbd.kernels import KERNELS
from torch_pbd.linalg import safe_cholesky, symmetrize
from torch_pbd.models import Core, Shapes, blank, size_of
from torch_pbd.models.heteroscedastic.fit import HeteroscedasticFit
from torch_pbd.models.heteroscedastic.posterior import (
    FactorMoments,
    LatentCovariance,
    LatentMean,
    as_inverse_gamma,
    degrees_of_freedom,
    log_correlation_moments,
    nearness,
    shrink_correlation,
    under_expected_noise,
)
from torch_pbd.models.heteroscedastic.processes import Processes, ProcessFamily
from torch_pbd.models.heteroscedastic.regression import Weights

# Far from data a log variance may be anything: of its variance no more than this enters an expectation.
_MOST_LOG_VARIANCE = 2.0
_FAMILIES = ("mean", "log_variance", "coefficient")


class Prepared(NamedTuple):
    """Processes of a module's buffers, with what does not depend on x computed."""

    buffers: tuple[Tensor, ...]
    versions: list[int]
    mean: LatentMean
    covariance: LatentCovariance
    """Of residuals multiplied by the inverse of ``pooled_tril``."""
    nearness: Processes
    """Process of unit variance that tells how far data are."""


class HeteroscedasticModel(Core):
    """Predictive density in standardized units: Student's t, its moments from the latent processes.

    Where samples of demonstrations are correlated it is that of ``posterior.py``. ``prior_tril`` is the factor of the
    covariance far from data.
    """

    kind = "heteroscedastic"
    pooled_tril: Tensor
    prior_tril: Tensor
    correlation_variance: Tensor
    _kept: Prepared | None = None

    def __init__(self, fit: HeteroscedasticFit, prior_tril: Float[Tensor, "d d"]) -> None:
        super().__init__()
        mean, covariance = fit.mean, fit.covariance
        assert covariance is not None
        families = mean.processes.family, covariance.log_variances.family, covariance.rows.family
        tensors = {
            "inducing": families[1].inducing,
            "mean_inducing": families[0].inducing,
            "mean_theta": mean.processes.theta,
            "mean_weights": mean.weights.mean,
            "mean_root": mean.weights.root,
            "log_variance_theta": covariance.log_variances.theta,
            "log_variance_weights": covariance.log_variance.mean,
            "log_variance_root": covariance.log_variance.root,
            "coefficient_theta": covariance.rows.theta,
            "pooled_tril": fit.pooled_tril,
            "prior_tril": prior_tril,
            "period": families[0].period,
            "stretch": families[1].stretch,
        }
        for name, family in zip(_FAMILIES, families, strict=True):
            tensors[f"{name}_length_scale"] = family.fixed_length_scale
        for i, weights in enumerate(covariance.coefficients, start=1):
            tensors[f"coefficient_weights_{i}"], tensors[f"coefficient_root_{i}"] = weights
        for name, tensor in tensors.items():
            if tensor is not None:
                self.register_buffer(name, tensor.detach().clone().contiguous())
        self.kernel: str = families[0].kernel
        self.exact = [family.exact for family in families]
        self.medians = [(family.length_scale, family.amplitude, family.constant) for family in families]
        if fit.correlation is not None:
            n_places = float(fit.correlation.share.mean()) * len(fit.training.x) / fit.n_demos
            root, degrees = self._root_of_demonstrations(*self._known(fit.training.inputs)[1:])
            moments = log_correlation_moments(root, degrees, n_places, fit.n_demos)
            for name, moment in zip(("correlation_error", "correlation_variance"), moments, strict=True):
                self.register_buffer(name, moment)

    def config(self) -> dict[str, Any]:
        """Kernel, and what the three families of processes are but for their length scales."""
        medians = [list(row) for row in self.medians]
        return {"covariance": self.kind, "kernel": self.kernel, "exact": self.exact, "medians": medians}

    @classmethod
    def skeleton(
        cls, config: Mapping[str, Any], shapes: Shapes, n_features: int, n_outputs: int
    ) -> "HeteroscedasticModel":
        """Model without numbers."""
        medians = checks.array(config["medians"], "medians", (len(_FAMILIES), 3))  # length scale, amplitude, constant
        checks.require(medians[:, :2] > 0.0, medians[:, :2], "medians", "above 0")
        checks.require(medians >= 0.0, medians, "medians", "at least 0")
        if len(config["exact"]) != len(_FAMILIES):
            raise ValueError(f"exact is {config['exact']!r:.80}, must be for {', '.join(_FAMILIES)}")
        n = sum(name.startswith("coefficient_weights_") for name in shapes)
        if n != n_outputs - 1:
            raise ValueError(f"it has coefficients of {n} outputs, must have them of all {n_outputs} but the first")
        e, d, m, a = n_features, n_outputs, size_of(shapes, "inducing"), size_of(shapes, "mean_inducing")
        # A constant is one more feature.
        in_mean, in_log_variance, in_row = (n + bool(row[2]) for n, row in zip((a, m, m), medians, strict=True))
        sizes: dict[str, tuple[int, ...]] = {
            "inducing": (m, e),
            "mean_inducing": (a, e),
            "mean_theta": (d, e + 1),
            "mean_weights": (d * in_mean,),
            "mean_root": (d * in_mean, d * in_mean),
            "log_variance_theta": (d, e + 1),
            "log_variance_weights": (d, in_log_variance),
            "log_variance_root": (d, in_log_variance, in_log_variance),
            "coefficient_theta": (d - 1, e + 1),
            "pooled_tril": (d, d),
            "prior_tril": (d, d),
        }
        for i in range(1, d):
            sizes |= {f"coefficient_weights_{i}": (i * in_row,), f"coefficient_root_{i}": (i * in_row, i * in_row)}
        optional: dict[str, tuple[int, ...]] = {f"{name}_length_scale": (e,) for name in _FAMILIES}
        optional |= {"period": (e,), "stretch": (2, 2), "correlation_error": (d, d), "correlation_variance": ()}
        model = cls.__new__(cls)
        nn.Module.__init__(model)
        for name, size in (sizes | {name: size for name, size in optional.items() if name in shapes}).items():
            model.register_buffer(name, blank(*size))
        model.kernel = checks.choice(config["kernel"], "kernel", KERNELS)
        model.exact = [checks.flag(exact, "exact") for exact in config["exact"]]
        model.medians = [tuple(row) for row in medians.tolist()]
        return model

    def forward(
        self, x: Float[Tensor, "n e"], prior_tril: Float[Tensor, "n d d"] | None = None
    ) -> tuple[Float[Tensor, "n d"], Float[Tensor, "n d r"]]:
        """Mean, and a root of the predictive covariance: of the variability, of the error of its estimate and
        of the mean's, and of the prior with the share that missing data leave it.
        """
        # It looks at numbers on its way, which no graph can hold.
        moments = torch.compiler.disable(self._moments) if torch.compiler.is_compiling() else self._moments
        return moments(x, prior_tril)

    def _moments(self, x: Tensor, prior_tril: Tensor | None) -> tuple[Tensor, Tensor]:
        mean, factor, error_root = self._known(x)
        if hasattr(self, "correlation_variance"):
            root = self._shrunk(*self._root_of_demonstrations(factor, error_root))
        else:
            root = torch.cat([self.pooled_tril @ factor.expected_root(_MOST_LOG_VARIANCE), error_root], dim=-1)
        return mean, self._with_prior(root, self.type1(x), prior_tril)

    def _known(self, x: Tensor) -> tuple[Tensor, FactorMoments, Tensor]:
        """Mean, moments of the factor, and root of the covariance of the mean's error."""
        processes = self.processes
        mean, error = processes.mean.at(x)
        # Where the data leave nothing to err about, rounding must not make it negative.
        least = 1e-12 * torch.diag_embed(1e-30 + error.diagonal(dim1=-2, dim2=-1))
        error_root = safe_cholesky(symmetrize(error) + least, name="the covariance of the mean's error")
        return mean, processes.covariance.at(x), error_root

    def _root_of_demonstrations(self, factor: FactorMoments, error_root: Tensor) -> tuple[Tensor, Tensor]:
        """Root of the expected covariance of correlated samples before its correlations are shrunk, and degrees."""
        degrees = factor.degrees
        factor = replace(factor, log_variance_variance=as_inverse_gamma(factor.log_variance_variance))
        error_root = under_expected_noise(error_root, degrees, self.processes.mean.processes.amplitude.square())
        return torch.cat([self.pooled_tril @ factor.expected_root(math.inf), error_root], dim=-1), degrees

    def _shrunk(self, root: Tensor, degrees: Tensor, draws: Tensor | None = None) -> Tensor:
        """Root, or draws around it, with correlations shrunk where samples of demonstrations are correlated."""
        if not hasattr(self, "correlation_variance"):
            return root if draws is None else draws
        error = getattr(self, "correlation_error", None)
        return shrink_correlation(root, degrees, error, self.correlation_variance, draws)

    def _with_prior(self, root: Tensor, missing: Tensor, prior_tril: Tensor | None) -> Tensor:
        """Root of a covariance and of the prior, each with its share."""
        prior = self.prior_tril if prior_tril is None else prior_tril
        share = (_square_root(missing)[:, None, None] * prior).expand(*root.shape[:-1], -1)
        return torch.cat([_square_root(1.0 - missing)[:, None, None] * root, share], dim=-1)

    def predict_mean(self, x: Float[Tensor, "n e"]) -> Float[Tensor, "n d"]:
        """Mean alone, equal to the bit."""
        return self.processes.mean.expected_at(x)

    def variability(self, x: Float[Tensor, "n e"]) -> Float[Tensor, "n d d"]:
        """Root of the covariance at the means of the latent processes, without prior and without errors."""
        factor = self.processes.covariance.at(x)
        root = self._shrunk(self.pooled_tril @ factor.tril(), factor.degrees)
        return _square_root(1.0 - self.type1(x))[:, None, None] * root

    def degrees(self, x: Float[Tensor, "n e"]) -> Float[Tensor, " n"]:
        """Degrees of freedom of the predictive density, infinite where only the prior speaks.

        They are of a variance whose logarithm has the mean of the variances of the log variances.
        """
        variance = self.processes.covariance.log_variance_at(x)[1].mean(-1)
        # Of the prior they are infinite: with the share of the data, 1 - missing, going to zero the law becomes normal.
        return degrees_of_freedom(variance) / (1.0 - self.type1(x)).clamp_min(1e-12)

    def type1(self, x: Float[Tensor, "n e"]) -> Float[Tensor, " n"]:
        """Type I uncertainty: eq. (6) without noise over the prior variance, 0 at the inducing inputs."""
        process = self.processes.nearness
        return process.unexplained(process(x))[0]

    def draw(
        self,
        x: Float[Tensor, "n e"],
        normal: list[Float[Tensor, "*s _"]],
        prior_tril: Float[Tensor, "n d d"] | None = None,
    ) -> Float[Tensor, "*s n d r"]:
        """Roots of posterior draws of the covariance function at x, with the prior's share in them."""
        factor, draws = self.processes.covariance.at(x), self.pooled_tril @ self.processes.covariance.draw(x, normal)
        root = self._shrunk(self.pooled_tril @ factor.tril(), factor.degrees, draws)
        return self._with_prior(root, self.type1(x), prior_tril)

    def draw_sizes(self) -> list[int]:
        """Sizes of the standard normal vectors that :meth:`draw` takes."""
        rows, size = self.processes.covariance.log_variance.mean.shape
        return [size] * rows + [len(weights.mean) for weights in self.processes.covariance.coefficients]

    @property
    def processes(self) -> Prepared:
        """Processes of the buffers, with what does not depend on x computed; anew where a buffer is another."""
        buffers = {name: buffer for name, buffer in self._buffers.items() if buffer is not None}
        if any(buffer.is_inference() or buffer.requires_grad for buffer in buffers.values()):
            return self._prepare(buffers, [])
        kept, versions = self._kept, [buffer._version for buffer in buffers.values()]
        if kept is None or kept.versions != versions or not all(map(operator.is_, buffers.values(), kept.buffers)):
            # Else, asked for in inference mode, these would be of no use to autograd later.
            with torch.inference_mode(False), torch.no_grad():
                kept = self._kept = self._prepare(buffers, versions)
        return kept

    def _prepare(self, buffers: Mapping[str, Tensor], versions: list[int]) -> Prepared:
        def processes(i: int, inducing: str, stretch: Tensor | None) -> Processes:
            name, period = _FAMILIES[i], buffers.get("period")
            length_scale, exact = buffers.get(f"{name}_length_scale"), self.exact[i]
            family = ProcessFamily(
                buffers[inducing], *self.medians[i], length_scale, self.kernel, period, exact, stretch
            )
            return family.prepared(buffers[f"{name}_theta"])

        def weights(name: str, number: str = "") -> Weights:
            return Weights(buffers[f"{name}_weights{number}"], buffers[f"{name}_root{number}"])

        # The mean rests on inducing inputs of its own, and is never stretched.
        mean = LatentMean(processes(0, "mean_inducing", None), weights("mean"))
        of_variances, rows = (processes(i, "inducing", buffers.get("stretch")) for i in (1, 2))
        coefficients = [weights("coefficient", f"_{i}") for i in range(1, len(rows.theta) + 1)]
        covariance = LatentCovariance(of_variances, weights("log_variance"), rows, coefficients)
        return Prepared(tuple(buffers.values()), versions, mean, covariance, nearness(of_variances))

    def __getstate__(self) -> dict[str, Any]:
        """State for copies and pickle: without what is computed from the buffers."""
        return {**self.__dict__, "_kept": None}


def _square_root(share: Tensor) -> Tensor:
    """Square root whose gradient at zero, where the share has a minimum, is zero and not infinite."""
    positive = share > 0
    return torch.where(positive, share.where(positive, 1.0).sqrt(), 0.0)

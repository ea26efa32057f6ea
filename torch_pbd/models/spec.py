"""A fitted model as plain data and tensors, and back: what files and pickles hold."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from torch_pbd.gp import Hyperparameters, LatentGP
from torch_pbd.models.cholesky import CholeskyCovariance
from torch_pbd.models.conditional import ConditionalNormal, MeanAndCovariance
from torch_pbd.models.heteroscedastic import HeteroscedasticModel
from torch_pbd.models.layout import check_layout
from torch_pbd.models.mixture import GaussianMixture
from torch_pbd.models.wishart import WishartCovariance


def module_spec(module: ConditionalNormal) -> dict[str, Any]:
    """All of the model that is not in its ``state_dict``: JSON-able."""
    core = module.core
    if isinstance(core, GaussianMixture):
        return {"covariance": "mixture", "n_features": core.n_features}
    if isinstance(core, HeteroscedasticModel):
        return {"covariance": "heteroscedastic", **core.spec()}
    spec: dict[str, Any] = {"mean_kernel": core.mean.kernel, "kernel": core.covariance.latent.kernel}
    spec |= {"bounded": core.covariance.bounded}
    if isinstance(core.covariance, CholeskyCovariance):
        return {"covariance": "cholesky", "log_diagonal": core.covariance.log_diagonal, **spec}
    return {"covariance": "wishart", **spec}


def module_from_spec(spec: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> ConditionalNormal:
    """Model of which ``module_spec`` gave ``spec`` and ``state_dict`` the tensors.

    Raises
    ------
    ValueError
        If the tensors are not those of such a model, or the spec is of no model of this package.
    """
    check_layout(spec, tensors)
    tensors = {name: tensor.clone() for name, tensor in tensors.items()}
    parts = {name.removeprefix("core."): tensor for name, tensor in tensors.items()}
    if spec["covariance"] == "mixture":
        core: MeanAndCovariance | HeteroscedasticModel | GaussianMixture = GaussianMixture(
            parts["log_weight"],
            parts["mean"],
            torch.diag_embed(parts["log_diagonal"].exp()) + parts["strict_lower"],
            spec["n_features"],
        )
    elif spec["covariance"] == "heteroscedastic":
        scaling_names = ("x_shift", "x_scale", "y_shift", "y_scale")
        core = HeteroscedasticModel.restored(dict(spec), {k: v for k, v in parts.items() if k not in scaling_names})
    else:
        latent = _latent("covariance.latent.", parts, spec["kernel"])
        bounded = spec.get("bounded", False)  # which the first files do not say
        if spec["covariance"] == "cholesky":
            prior_tril = parts["covariance.prior_tril"]
            covariance: Any = CholeskyCovariance(latent, prior_tril, log_diagonal=spec["log_diagonal"], bounded=bounded)
        else:
            matrix = parts["covariance.scale_matrix_tril"]
            covariance = WishartCovariance(latent, parts["covariance.prior_root"], matrix, bounded)
        core = MeanAndCovariance(_latent("mean.", parts, spec["mean_kernel"]), covariance)
    scaling = [tensors[name] for name in ("x_shift", "x_scale", "y_shift", "y_scale")]
    module = ConditionalNormal(core, *scaling)
    module.load_state_dict(tensors)
    return module


def _latent(prefix: str, parts: Mapping[str, Tensor], kernel: Any) -> LatentGP:
    def part(name: str) -> Tensor:
        return parts[prefix + name]

    hyperparameters = Hyperparameters(part("length_scale"), part("amplitude"), part("noise_ratio"))
    weights = (part("weight"), part("value_weight"))
    root = parts.get(prefix + "root")
    return LatentGP(part("inputs"), *weights, hyperparameters, part("counts"), kernel, root)

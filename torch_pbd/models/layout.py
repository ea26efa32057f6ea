"""What the tensors of a stored model must be, checked before a model is built of them: names, shapes, ranges."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from torch_pbd.files.memory import require_memory
from torch_pbd.kernels import KERNELS

Tensors = Mapping[str, Tensor]
Sizes = dict[str, int]

# Letters of one model stand for one size each: e inputs, d outputs.
_SCALING = {"x_shift": "e", "x_scale": "e", "y_shift": "d", "y_scale": "d"}
_LATENT = {
    "weight": "b n",
    "inputs": "n e",
    "value_weight": "b n",
    "length_scale": "s e",
    "amplitude": "b",
    "noise_ratio": "b",
    "counts": "n",
}
_MIXTURE = {
    "core.log_weight": "k",
    "core.mean": "k p",
    "core.log_diagonal": "k p",
    "core.strict_lower": "k p p",
    "core.log_density_floor": "",
}
_HETEROSCEDASTIC = {
    "core.inducing": "m e",
    "core.mean_inducing": "a e",
    "core.mean_theta": "d q",
    "core.mean_weights": "of_mean",
    "core.mean_root": "of_mean of_mean",
    "core.log_variance_theta": "d q",
    "core.log_variance_weights": "d of_log_variance",
    "core.log_variance_root": "d of_log_variance of_log_variance",
    "core.coefficient_theta": "others q",
    "core.pooled_tril": "d d",
    "core.prior_tril": "d d",
}
_HETEROSCEDASTIC_OPTIONAL = {
    "core.period": "e",
    "core.mean_length_scale": "e",
    "core.log_variance_length_scale": "e",
    "core.coefficient_length_scale": "e",
}

_LARGEST_LOGARITHM = 300.0
_UNBOUNDED = {"core.period", "core.log_density_floor"}  # infinite for none
_POSITIVE = ("x_scale", "y_scale", "length_scale", "counts", "period")
_NOT_NEGATIVE = ("amplitude", "noise_ratio")
_FACTORS = ("prior_tril", "pooled_tril")


def check_layout(spec: Any, tensors: Tensors) -> None:
    """Check that tensors are those of the model that a spec describes.

    What they say together is believed: this finds what would not run, or run on other shapes than were meant.

    Raises
    ------
    ValueError
        If a tensor is missing, unknown, of another shape, not finite or out of its range; if the spec is of no model
        of this package; or if the model would not fit in memory.
    """
    kind = spec.get("covariance") if isinstance(spec, Mapping) else None
    if kind == "mixture":
        _check_mixture(spec, tensors)
    elif kind == "heteroscedastic":
        _check_heteroscedastic(spec, tensors)
    elif kind in ("cholesky", "wishart"):
        _check_processes(spec, tensors)
    else:
        raise ValueError(f"unknown covariance model {kind!r:.80}")
    for name, tensor in tensors.items():
        _check_values(name, tensor)


def _check_mixture(spec: Mapping[str, Any], tensors: Tensors) -> None:
    _check_entries(spec, {"n_features": int})
    sizes = _check_shapes(tensors, _SCALING | _MIXTURE, {})
    if sizes["p"] != sizes["e"] + sizes["d"] or spec["n_features"] != sizes["e"]:
        raise ValueError(
            f"its components are over {sizes['p']} variables, of which {spec['n_features']} are inputs, but it has "
            f"{sizes['e']} inputs and {sizes['d']} outputs"
        )


def _check_processes(spec: Mapping[str, Any], tensors: Tensors) -> None:
    cholesky = spec["covariance"] == "cholesky"
    entries = {"kernel": str, "mean_kernel": str} | ({"log_diagonal": bool} if cholesky else {})
    _check_entries(spec, entries | ({"bounded": bool} if "bounded" in spec else {}))
    _check_kernels(spec["kernel"], spec["mean_kernel"])
    own = {"prior_tril": "d d"} if cholesky else {"prior_root": "d df", "scale_matrix_tril": "d d"}
    shapes = _SCALING | {f"core.covariance.{name}": shape for name, shape in own.items()}
    mean, latent = _part(tensors, "core.mean."), _part(tensors, "core.covariance.latent.")
    rest = {name: tensors[name] for name in tensors if name not in mean and name not in latent}
    sizes = _check_shapes(rest, shapes, {})
    d = sizes["d"]
    _check_latent("core.mean.", mean, {"e": sizes["e"], "b": d})
    _check_latent(
        "core.covariance.latent.", latent, {"e": sizes["e"], "b": d * (d + 1) // 2 if cholesky else d * sizes["df"]}
    )


def _check_latent(prefix: str, tensors: Tensors, sizes: Sizes) -> None:
    shapes = {prefix + name: shape for name, shape in _LATENT.items()}
    found = _check_shapes(tensors, shapes, sizes, optional={prefix + "root": "r n"})
    if found["s"] not in (1, found["b"]):
        raise ValueError(f"{prefix}length_scale is of {found['s']} processes, but there are {found['b']}")
    # The matrices of eq. (6), which are made anew from the inputs.
    require_memory(
        2 * 8 * found["s"] * found["n"] ** 2, what=f"a model of {found['n']} inputs", remedy="Take one with fewer."
    )


def _check_heteroscedastic(spec: Mapping[str, Any], tensors: Tensors) -> None:
    _check_entries(spec, {"kernel": str, "exact": list, "medians": list})
    _check_kernels(spec["kernel"])
    exact, medians = spec["exact"], spec["medians"]
    if len(exact) != 3 or not all(isinstance(entry, bool) for entry in exact):
        raise ValueError(f"exact is {exact!r:.80}, it must be three of true and false")
    if len(medians) != 3 or not all(isinstance(row, list) and len(row) == 3 for row in medians):
        raise ValueError(f"medians is {medians!r:.80}, it must be three rows of three numbers")
    for scale, amplitude, constant in medians:
        known = [isinstance(entry, float) and 0.0 <= entry < 1e100 for entry in (scale, amplitude, constant)]
        if not all(known) or not scale > 0.0 or not amplitude > 0.0:
            raise ValueError(f"medians is {medians!r:.80}, it must hold positive numbers")
    sizes = _check_shapes(_part(tensors, ("x_", "y_")), _SCALING, {})
    for name in ("core.inducing", "core.mean_inducing"):
        sizes |= _check_shapes(_part(tensors, name), {name: _HETEROSCEDASTIC[name]}, sizes)
    e, d = sizes["e"], sizes["d"]
    of_mean, of_log_variance, of_coefficient = (
        sizes[letter] + (row[2] != 0.0) for letter, row in zip("amm", medians, strict=True)
    )
    sizes |= {"q": e + 1, "others": d - 1, "of_mean": d * of_mean, "of_log_variance": of_log_variance}
    shapes = _SCALING | _HETEROSCEDASTIC
    for i in range(1, d):
        sizes[f"of_{i}"] = i * of_coefficient
        shapes |= {f"core.coefficient_weights_{i}": f"of_{i}", f"core.coefficient_root_{i}": f"of_{i} of_{i}"}
    _check_shapes(tensors, shapes, sizes, optional=_HETEROSCEDASTIC_OPTIONAL)


def _part(tensors: Tensors, prefix: str | tuple[str, ...]) -> Tensors:
    return {name: tensor for name, tensor in tensors.items() if name.startswith(prefix)}


def _check_entries(spec: Mapping[str, Any], types: Mapping[str, type]) -> None:
    if set(spec) != {"covariance", *types}:
        raise ValueError(f"its model has {', '.join(map(repr, spec))}, it must have {', '.join(types)}")
    for name, kind in types.items():
        if type(spec[name]) is not kind:
            raise ValueError(f"{name} is {spec[name]!r:.80}, it must be of type {kind.__name__}")


def _check_kernels(*names: str) -> None:
    for name in names:
        if name not in KERNELS:
            raise ValueError(f"its kernel is {name!r:.80}; known are {', '.join(KERNELS)}")


def _check_shapes(
    tensors: Tensors, shapes: Mapping[str, str], sizes: Sizes, optional: Mapping[str, str] | None = None
) -> Sizes:
    """Sizes of all letters; those that are given must be as they are."""
    allowed = {**shapes, **(optional or {})}
    for words, names in (("no", set(shapes) - set(tensors)), ("an unknown", set(tensors) - set(allowed))):
        if names:
            raise ValueError(f"there is {words} {min(names)!r:.80}")
    found = dict(sizes)
    for name, tensor in tensors.items():
        letters = allowed[name].split()
        shape = tensor.shape if letters or tensor.shape != (1,) else ()  # files hold one number as an array of one
        good = len(shape) == len(letters) and all(
            found.setdefault(letter, size) == size for letter, size in zip(letters, shape, strict=True)
        )
        if not good:
            expected = ", ".join(str(found.get(letter, letter)) for letter in letters)
            raise ValueError(f"{name} has shape {tuple(tensor.shape)}, it must be ({expected})")
    empty = [letter for letter, size in found.items() if size == 0 and letter != "others"]
    if empty:
        raise ValueError(f"it has no {empty[0]!r}: an array is empty")
    return found


def _check_values(name: str, tensor: Tensor) -> None:
    last = name.rpartition(".")[2]
    wrong = tensor.isnan() if name in _UNBOUNDED else ~tensor.isfinite()
    if bool(wrong.any()):
        raise ValueError(f"{name} holds a number that is not finite")
    if last.endswith(_POSITIVE) and not bool((tensor > 0).all()):
        raise ValueError(f"{name} must be positive")
    if last.endswith(_NOT_NEGATIVE) and not bool((tensor >= 0).all()):
        raise ValueError(f"{name} must not be negative")
    if last == "log_diagonal" and not bool((tensor.abs() < _LARGEST_LOGARITHM).all()):
        raise ValueError(f"{name} is of factors whose squares are no numbers")
    if last in _FACTORS and not bool((tensor.diagonal() > 0).all() and torch.equal(tensor, tensor.tril())):
        raise ValueError(f"{name} must be the lower factor of a positive definite matrix")

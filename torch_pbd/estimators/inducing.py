"""How many inducing inputs a fit takes, the memory that they need, and what they resolve."""

from torch import Tensor

from torch_pbd import checks
from torch_pbd.files.memory import require_much
from torch_pbd.gp.inducing import FeatureMap

# By default, for one column of X and for several, and where these do not resolve what is learned. At most of all
# outputs together, for the mean and for the covariance, as a fit takes the cube of these; but a dozen for each output.
_OF_ONE, _OF_SEVERAL, _MOST, _TOGETHER, _FEWEST = 48, 128, 128, (800, 400), 12


def inducing_sizes(n_inducing: int | None, n_features: int, n_outputs: int) -> list[tuple[int, int]]:
    """Inducing inputs of the mean's processes and of the covariance's, to be tried one after another."""
    if n_inducing is not None:
        return [(n_inducing, n_inducing)]
    most_mean, most_covariance = (max(_FEWEST, most // n_outputs) for most in _TOGETHER)
    few = _OF_ONE if n_features == 1 else _OF_SEVERAL
    return list(dict.fromkeys((min(size, most_mean), min(size, most_covariance)) for size in (few, _MOST)))


def check_memory(n_inducing: int | None, max_inputs: int, shape: tuple[int, int, int]) -> None:
    """Check that a fit of ``shape``, distinct inputs, their columns and outputs, has the memory that it needs.

    Measured: each output's features for the differences that start a search take the most, and then all outputs'
    together.

    Raises
    ------
    ValueError
        If it has not.
    """
    n_distinct, n_features, n_outputs = shape
    n_inputs = min(n_distinct, max_inputs)
    size = min(n_inputs, max(max(pair) for pair in inducing_sizes(n_inducing, n_features, n_outputs)))
    searched = 4 * (n_features + 1) * (n_features + 2) * n_outputs * size * (n_inputs + size)
    require_much(
        8.0 * (searched + 24 * (n_outputs * size) ** 2),
        what=f"max_inputs={max_inputs} with n_inducing={n_inducing} lets {n_inputs} distinct "
        f"inputs and {size} inducing ones into the fit, which",
        remedy="Lower them, n_inducing first.",
    )


def warn_if_unresolved(length_scale: Tensor | None, features: FeatureMap) -> None:
    """Warn where a length scale that the user gave is shorter than the inputs resolve."""
    least = features.shortest_length_scale
    if length_scale is not None and bool((length_scale < least).any()):
        checks.warn(
            f"length_scale is below {least:.3g} of the range of X, which is what the inputs (or n_inducing of them) "
            "resolve: between them the covariance says nothing. Give a longer one, or None to learn it."
        )

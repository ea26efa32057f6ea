"""Predicting many rows a bounded number at a time."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torch_pbd.estimators.validation import Floats
from torch_pbd.files.memory import require_much

_CHUNK = 1024


def by_chunks(function: Callable[[Any], Any], x: Tensor | Floats) -> Any:
    """What a function of rows gives for all rows of x; what it needs on the way is of a bounded number of them."""
    if len(x) <= _CHUNK:
        return function(x)
    first = function(x[:_CHUNK])
    require_much(
        2.0 * len(x) / _CHUNK * sum(part.nbytes for part in first),  # in parts, and joined
        what=f"what is predicted for {len(x)} rows",
        remedy="Predict fewer at a time.",
    )
    others = (function(x[start : start + _CHUNK]) for start in range(_CHUNK, len(x), _CHUNK))
    joined: Any = torch.cat if isinstance(x, Tensor) else np.concatenate
    return tuple(joined(part) for part in zip(first, *others, strict=True))

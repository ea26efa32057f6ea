"""The door between NumPy and torch: arrays to the device, and a fitted module into pickles and back."""

from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import numpy as np
import torch
from sklearn.base import BaseEstimator
from torch import Tensor

from torch_pbd import checks
from torch_pbd.estimators.validation import Floats
from torch_pbd.files.memory import require_much
from torch_pbd.models.conditional import ConditionalNormal, Core

_CHUNK = 1024  # rows: what a prediction needs on the way is then some tens of MB for ten outputs


class TorchEstimator(BaseEstimator):
    """Base of estimators that keep what they learned in a torch module, ``module_``, on ``device``."""

    device: str | None
    module_: ConditionalNormal

    _core_class: ClassVar[type[Core]]
    """Class of the core of ``module_``."""
    _learned: ClassVar[Mapping[str, Callable[[Any, str], Any]]] = {}
    """Attributes that only fits of this class learn, and how model files check them."""

    def _prepare(self) -> None:
        """Work out what predictions need of the module alone."""

    def _door(self, array: Any) -> Tensor:
        """Copy of an array; contiguous, since torch takes no negative strides."""
        return torch.tensor(np.asarray(array, order="C"), dtype=torch.float64, device=self.device)

    def _device_problem(self) -> str:
        """Why no tensor can be put on the device; empty if it can."""
        try:
            self._door(0.0).cpu()  # of a meta tensor there are no numbers
        except (AssertionError, OverflowError, RuntimeError, TypeError, ValueError) as error:  # by build and by device
            return str(error).partition("\n")[0].rstrip(".")
        return ""

    def __getstate__(self) -> dict[str, Any]:
        """State without tensors: arrays, and what the module is, for pickle, joblib and skops."""
        state = dict(super().__getstate__())
        if "module_" in state:
            module = state.pop("module_")
            state["_module_config"] = module.core.config()
            state["_module_arrays"] = {k: v.cpu().numpy() for k, v in module.state_dict().items()}
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        state = dict(state)
        arrays, config = state.pop("_module_arrays", None), state.pop("_module_config", None)
        super().__setstate__(state)
        if arrays is not None:
            if problem := self._device_problem():
                checks.warn(
                    f"The model was fitted on device {self.device!r}, which this machine lacks ({problem}): it is now "
                    "on the CPU."
                )
                self.device = None
            with torch.inference_mode(False):  # else autograd would refuse the module
                tensors = {name: self._door(array) for name, array in arrays.items()}
                self.module_ = ConditionalNormal.restored(self._core_class, config, tensors).requires_grad_(False)
            self._prepare()


def by_chunks(function: Callable[[Any], Any], x: Tensor | Floats) -> Any:
    """Tuple of arrays that a function of rows gives for x, called for a bounded number of rows at a time."""
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

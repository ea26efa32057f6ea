"""The forcing that reproduces the mean movement: a Gaussian process over the phase, eq. (5)."""

import numpy as np
import torch
from numpy.typing import NDArray

from torch_pbd.estimators.scaling import Standardization
from torch_pbd.gp import EvidenceSearch, Observations, condition, fit_together

Floats = NDArray[np.float64]


class ForcingProcess:
    """Gaussian processes through the mean forcing of demonstrations, one for each output.

    Hyperparameters by their evidence, as those of the regressors' means.

    Parameters
    ----------
    X : ndarray of shape (n, 1)
        Phase, its logarithm or time, no two alike.
    forcing : ndarray of shape (n, d)
        Mean forcing of the demonstrations there.
    n_demos : int
        Demonstrations behind each mean.
    """

    def __init__(self, X: Floats, forcing: Floats, n_demos: int) -> None:
        self._scaling = Standardization.fit(X, forcing)
        inputs = torch.tensor(self._scaling.inputs(X))
        targets = torch.tensor(self._scaling.outputs(forcing)).mT.contiguous()
        counts = torch.full((len(X),), float(n_demos), dtype=torch.float64)
        observations = Observations(inputs, targets, counts)
        # No length scale below what the knots resolve: it would be a needle at each of them.
        search = EvidenceSearch(length_scale_bounds=(min(0.5, 0.75 / len(X)), 10.0))
        (found,) = fit_together([(observations, search)])
        self._process, _ = condition(observations, found.hyperparameters, basis=found.basis)

    def predict(self, X: Floats) -> Floats:
        """Forcing (m, d) at X (m, 1)."""
        x = torch.tensor(self._scaling.inputs(X))
        with torch.inference_mode():
            mean = self._process(x).numpy()
        return self._scaling.y_shift + self._scaling.y_scale * mean

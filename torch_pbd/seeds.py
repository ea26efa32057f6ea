"""Seeds that users pass: refused by the name of the argument."""

from typing import Any

import numpy as np
from sklearn.utils import check_random_state


def as_random_state(random_state: Any, name: str = "random_state") -> np.random.RandomState:
    """The RandomState of a seed, as scikit-learn makes it; None is NumPy's global one.

    Raises
    ------
    ValueError
        If it is none.
    """
    try:
        if isinstance(random_state, bool):
            raise ValueError("a seed is a number, not a bool")
        return check_random_state(random_state)
    except ValueError as error:
        raise ValueError(
            f"{name} == {random_state!r}, must be None, an integer from 0 to 2**32 - 1 or a numpy.random.RandomState "
            f"({error})."
        ) from error

import numpy as np
import pytest

import torch_pbd
from torch_pbd import Demonstrations


@pytest.fixture(scope="session")
def data(tmp_path_factory):
    """File of four short demonstrations."""
    path = tmp_path_factory.mktemp("data") / "made.npz"
    positions = np.random.default_rng(0).normal(size=(4, 20, 2)).cumsum(axis=1)
    torch_pbd.save_demonstrations(Demonstrations(np.linspace(0.0, 2.0, 20), positions), path)
    return path

import pytest
import torch

from torch_pbd.models.heteroscedastic.processes import ProcessFamily


@pytest.fixture
def inputs():
    """Nine of them, not evenly spaced, over a range of one."""
    return torch.linspace(0.0, 1.0, 9, dtype=torch.float64)[:, None] ** 1.3 - 0.5


@pytest.fixture
def family(inputs):
    """Processes with the inputs as inducing ones, and a constant."""
    return ProcessFamily(inputs, 0.5, 1.0, 2.0, kernel="matern52", exact=True)

import pytest
import torch
from jaxtyping import TypeCheckError

from torch_pbd import linalg


def test_shapes_of_the_torch_floors_are_checked_while_the_tests_run():
    with pytest.raises(TypeCheckError, match="scale_tril"):  # and not broadcast
        linalg.log_density(torch.zeros(1, 2), torch.eye(2).expand(3, 2, 2))

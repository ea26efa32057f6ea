import pytest
import shapes
import torch
from jaxtyping import TypeCheckError

from torch_pbd import linalg

WRONG = torch.zeros(1, 2), torch.eye(2).expand(3, 2, 2)  # which would be broadcast


def test_shapes_of_the_torch_floors_are_checked_while_the_tests_run():
    with pytest.raises(TypeCheckError, match="scale_tril"):
        linalg.log_density(*WRONG)


@pytest.mark.parametrize("slow", [False, True])
def test_the_first_calls_are_checked_and_ever_fewer_of_the_later_ones(slow):
    shapes.begin_test(slow=slow)
    refused = []
    for call in range(1, 257):
        try:
            linalg.log_density(*WRONG)
        except TypeCheckError:
            refused.append(call)
    first = range(1, 51) if slow else range(1, 4)
    assert refused == sorted({*first, 4, 8, 16, 32, 64, 128, 256})

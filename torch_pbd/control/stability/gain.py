"""Largest growth of a deviation over a part of a schedule."""

import math

import torch
from jaxtyping import Float, Int64
from torch import Tensor

# Rows between which growth is looked for, and parts that are followed from row to row: enough for 27 outputs at 2,701
# rows to find what all of them do.
_MAX_ROWS, _MAX_PARTS, _AT_ONCE = 150, 64, 64


def largest_gain(steps: Float[Tensor, "k s s"]) -> float:
    """Largest norm of a product of successive maps, in coordinates in which the squared length is the energy.

    That is ``||P_j^1/2 Phi(j, i) P_i^-1/2||`` over i < j, with P = diag(K, M) and the exact maps Phi.
    Of long schedules it is looked for between 150 rows, the closer together the more the energy changes there, and then
    among all rows around where such a part begins and ends.
    """
    every = torch.arange(len(steps) + 1)
    if len(steps) <= _MAX_ROWS:
        return _largest_growth(steps)[0]
    identity = torch.eye(steps.shape[-1]).to(steps)
    change = torch.cat([torch.linalg.matrix_norm(each.mT @ each - identity) for each in steps.split(_AT_ONCE)]).cumsum(
        0
    )
    shares = torch.linspace(0.0, float(change[-1]), _MAX_ROWS + 1).to(change)[1:-1]
    rows = torch.cat([every[:1], torch.searchsorted(change, shares) + 1, every[-1:]]).unique()
    ends = _largest_growth(_products(steps, rows))[1:]
    around = [every[rows[max(end - 1, 0)] : rows[min(end + 1, len(rows) - 1)] + 1] for end in ends]
    return _largest_growth(_products(steps, torch.cat([rows, *around]).unique()))[0]


def _largest_growth(steps: Float[Tensor, "k s s"]) -> tuple[float, int, int]:
    """Growth of the part that grows the most, and the rows where it begins and ends."""
    begun, identity = steps[:0], torch.eye(steps.shape[-1]).to(steps)
    since, largest, part = torch.empty(0, dtype=torch.long), 1.0, (0, 0)
    for row, each in enumerate(steps):
        begun, since = each @ torch.cat([begun, identity[None]]), torch.cat([since, torch.tensor([row])])
        squared = begun.mT @ begun
        # A part that has not grown so far gains no more than one that begins here. Whether all eigenvalues are below
        # a limit is seen sooner than what they are.
        grown = torch.linalg.cholesky_ex((1.0 + 1e-12) * identity - squared).info > 0
        begun, squared, since = begun[grown], squared[grown], since[grown]
        record = torch.linalg.cholesky_ex(largest * (1.0 + 1e-12) * identity - squared).info > 0
        if bool(record.any()):
            values = torch.linalg.eigvalsh(squared[record])[:, -1]
            largest, part = float(values.max()), (int(since[record][values.argmax()]), row + 1)
        if len(begun) > _MAX_PARTS:
            kept = torch.linalg.matrix_norm(begun).topk(_MAX_PARTS).indices
            begun, since = begun[kept], since[kept]
    return math.sqrt(largest), *part


def _products(steps: Float[Tensor, "k s s"], rows: Int64[Tensor, " c1"]) -> Float[Tensor, "c s s"]:
    """Maps from each of some rows to the next of them."""
    begins, lengths = rows[:-1], rows.diff()
    products = steps[begins]
    for later in range(1, int(lengths.max())):
        longer = lengths > later
        products[longer] = steps[begins[longer] + later] @ products[longer]
    return products

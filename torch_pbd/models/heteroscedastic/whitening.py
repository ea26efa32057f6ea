"""Whiteners: lower triangular matrices W that make correlated noise independent and of variance one.

Along a line an exponential correlation is that of a Markov process, in which a sample depends on the one before alone:
W is bidiagonal and W'W tridiagonal. W is stored as the matrix (n, n), n > 2; as its diagonal and subdiagonal (n, 2),
which begins with a zero; or as its diagonal (n, 1).
"""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

_ROUNDING = 1e-9  # share of a row's diagonal entry that an entry beside the two diagonals has by rounding


class NoiseCorrelation(NamedTuple):
    """Correlation of means, or of mean squares, of each output at n inputs."""

    whitener: Float[Tensor, "d n m"]
    """Makes them independent, of the variances of independent rows' ones."""
    copies: Float[Tensor, "d n"]
    """Rows at each input that count for one."""


def bidiagonal(matrix: Float[Tensor, "*b n n"]) -> Float[Tensor, "*b n m"]:
    """Whitener stored as its two diagonals, or as it is where it has more than these."""
    own, before = matrix.diagonal(dim1=-2, dim2=-1), matrix.diagonal(-1, dim1=-2, dim2=-1)
    if bool((matrix.tril(-2).abs() > _ROUNDING * own.unsqueeze(-1)).any()):
        return matrix
    return torch.stack([own, pad(before, (1, 0))], dim=-1)


def whiten(whitener: Float[Tensor, "*#b n m"], values: Float[Tensor, "*#b n p"]) -> Float[Tensor, "... n p"]:
    """Product W v."""
    if whitener.shape[-1] > 2:
        return whitener @ values
    own = whitener[..., :1] * values
    return own if whitener.shape[-1] == 1 else own + whitener[..., 1:] * values.roll(1, -2)


def whiten_vjp(whitener: Float[Tensor, "*#b n m"], gradient: Float[Tensor, "*#b n p"]) -> Float[Tensor, "... n p"]:
    """Product W'g."""
    if whitener.shape[-1] > 2:
        return whitener.mT @ gradient
    own = whitener[..., :1] * gradient
    return own if whitener.shape[-1] == 1 else own + (whitener[..., 1:] * gradient).roll(-1, -2)


def tridiagonal(whitener: Float[Tensor, "*b n m"]) -> tuple[Float[Tensor, "*b n"], Float[Tensor, "*b k"]] | None:
    """Diagonal of W'W and, k of n - 1, what is beside it; None where it has more than these."""
    if whitener.shape[-1] > 2:
        return None
    own, before = whitener[..., 0], whitener[..., 1:, 1:].flatten(-2)
    if whitener.shape[-1] == 1:
        return own.square(), before
    return own.square() + pad(before.square(), (0, 1)), before * own[..., 1:]

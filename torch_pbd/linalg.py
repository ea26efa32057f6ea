"""Algebra of symmetric positive definite matrices, batched: ``...`` dimensions come first."""

import math
from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from torch_pbd.exceptions import NotPositiveDefiniteError

MAX_JITTER = 1e-6
"""Largest jitter that :func:`safe_cholesky` adds, relative to the mean of the diagonal."""

Pencil = Callable[[Tensor, float, float], Tensor]
"""``q Q + p P`` of some of m rows, by their indices, q and p: symmetric Q and positive definite P (..., m, s, s)."""

# Rows among which the least eigenvalue is searched first, and rows factored together, which fit the cache.
_N_SOME, _AT_ONCE = 24, 64


def symmetrize(matrix: Float[Tensor, "*b d d"]) -> Float[Tensor, "*b d d"]:
    """Matrix made symmetric to the last bit, which ``factor @ factor.mT`` is not for every size."""
    return 0.5 * (matrix + matrix.mT)


def block_matrix(first: Tensor, upper: Tensor, lower: Tensor, last: Tensor) -> Float[Tensor, "*b d2 d2"]:
    """Matrices ``[[first, upper], [lower, last]]`` of blocks that broadcast."""
    first, upper, lower, last = torch.broadcast_tensors(first, upper, lower, last)
    return torch.cat([torch.cat([first, upper], dim=-1), torch.cat([lower, last], dim=-1)], dim=-2)


def broadcast_shapes(*shapes: torch.Size) -> torch.Size:
    """Shape that all broadcast to, as ``torch.broadcast_shapes`` has it, which loads sympy: a third of a second."""
    return torch.broadcast_tensors(*(torch.empty(()).expand(shape) for shape in shapes))[0].shape


def tril_to_vector(scale_tril: Float[Tensor, "*b d d"]) -> Float[Tensor, "*b p"]:
    """Entries of the lower triangle row by row: (0, 0), (1, 0), (1, 1), (2, 0), ..."""
    row, column = torch.tril_indices(*scale_tril.shape[-2:], device=scale_tril.device)
    return scale_tril[..., row, column]


def vector_to_tril(vector: Float[Tensor, "*b p"]) -> Float[Tensor, "*b d d"]:
    """Lower triangular matrix of the entries :func:`tril_to_vector` reads, p = d(d+1)/2."""
    size = (math.isqrt(8 * vector.shape[-1] + 1) - 1) // 2
    row, column = torch.tril_indices(size, size, device=vector.device)
    scale_tril = vector.new_zeros(*vector.shape[:-1], size, size)
    scale_tril[..., row, column] = vector
    return scale_tril


def triangular_inverse(factor: Float[Tensor, "*b d d"], *, upper: bool = False) -> Float[Tensor, "*b d d"]:
    """Inverses of triangular matrices."""
    identity = torch.eye(factor.shape[-1]).to(factor).expand_as(factor)
    return torch.linalg.solve_triangular(factor, identity, upper=upper)


def smallest_eigenvalues(pencil: Pencil, rows: Int64[Tensor, " m"]) -> Float[Tensor, "*b m"]:
    """Smallest eigenvalues of Q relative to P at the given rows of a pencil."""
    factor = torch.linalg.cholesky(pencil(rows, 0.0, 1.0))
    half = torch.linalg.solve_triangular(factor, pencil(rows, 1.0, 0.0), upper=False)
    whole = torch.linalg.solve_triangular(factor.mT, half, upper=True, left=False)
    return torch.linalg.eigvalsh(symmetrize(whole))[..., 0]


def rows_below(pencil: Pencil, value: float, n: int) -> Int64[Tensor, " k"]:
    """Rows, of n, with an eigenvalue of Q relative to P below a value, by the cheaper Cholesky factorization."""
    found = []
    for rows in torch.arange(n).split(max(_AT_ONCE, n // _AT_ONCE)):
        failed = torch.linalg.cholesky_ex(pencil(rows, 1.0, -value)).info > 0
        found.append(rows[failed.reshape(-1, len(rows)).any(0)])
    return torch.cat(found)


def least_eigenvalue(pencil: Pencil, n: int) -> tuple[float, int]:
    """Smallest eigenvalue over the n rows of a pencil, and its row, from some rows and then those below them."""
    some = evenly(n, _N_SOME)
    least = float(smallest_eigenvalues(pencil, some).min())
    rows = torch.cat([some, rows_below(pencil, least, n)])
    values = smallest_eigenvalues(pencil, rows).reshape(-1, len(rows)).amin(0)
    return float(values.min()), int(rows[values.argmin()])


def evenly(n: int, most: int) -> Int64[Tensor, " m"]:
    """At most ``most`` evenly spaced indices of n, including the first and last."""
    return torch.linspace(0, n - 1, min(n, most)).round().long().unique()


def scale_tril_from_root(root: Float[Tensor, "*b d r"], least: float | Tensor = 0.0) -> Float[Tensor, "*b d d"]:
    """Lower Cholesky factor of ``root @ root.mT``, its diagonal not negative.

    A QR decomposition of the transpose never forms the product: small variances keep all their digits beside large
    ones, and a root of rank below d (fewer demonstrations than outputs, a constant output) gives zeros on the diagonal
    instead of a failure. ``least`` is a deviation besides, of one number or of numbers (d,), that each output has.
    """
    n_outputs, rank = root.shape[-2:]
    if rank < n_outputs or isinstance(least, Tensor) or least > 0.0:
        own = least * torch.eye(n_outputs).to(root)
        root = torch.cat([root, own.expand(*root.shape[:-1], n_outputs)], dim=-1)
    # The decomposition leaves the signs of the rows of R open.
    upper = torch.linalg.qr(root.mT).R
    sign = torch.where(upper.diagonal(dim1=-2, dim2=-1) < 0, -1.0, 1.0).to(upper)
    return (sign.unsqueeze(-1) * upper).mT


def cholesky_with_jitter(matrix: Float[Tensor, "*b n n"], *, name: str) -> tuple[Float[Tensor, "*b n n"], float]:
    """Lower Cholesky factors, and the largest jitter any of them needed.

    The jitter is relative to the mean of a matrix's diagonal: none first, then 1e-14 to 1e-6 by factors of ten, only
    for the matrices of the batch that need it. Beyond, or where an entry is not finite, it is a
    NotPositiveDefiniteError.
    """
    factor, info = torch.linalg.cholesky_ex(matrix)
    failed = info > 0
    # An entry that is not finite leaves one in the diagonal of the factor, or ends the factorization.
    if not bool((failed | ~torch.isfinite(factor.diagonal(dim1=-2, dim2=-1)).all(-1)).any()):
        return factor, 0.0
    if not torch.isfinite(matrix).all():
        raise NotPositiveDefiniteError(f"{name} has entries that are not finite.")
    # The gradient of a factorization that failed is NaN: find the jitter first, then factorize once.
    scale = matrix.detach().diagonal(dim1=-2, dim2=-1).mean(-1).abs()
    jitter = torch.zeros_like(scale)
    for exponent in range(-14, round(math.log10(MAX_JITTER)) + 1):
        jitter = torch.where(failed, 10.0**exponent, jitter)
        regular = matrix + torch.diag_embed((jitter * scale).unsqueeze(-1).expand(matrix.shape[:-1]))
        failed = failed & (torch.linalg.cholesky_ex(regular.detach()).info > 0)
        if not bool(failed.any()):
            return torch.linalg.cholesky_ex(regular).L, float(jitter.max())
    raise NotPositiveDefiniteError(
        f"{name} is not positive definite, even with {MAX_JITTER:g} of its mean diagonal added. "
        "Look for inputs that nearly coincide, a length_scale far above the range of the inputs, "
        "or a noise_scale of zero on noisy data."
    )


def safe_cholesky(matrix: Float[Tensor, "*b n n"], *, name: str) -> Float[Tensor, "*b n n"]:
    """Lower Cholesky factors, with the least relative jitter they need; see :func:`cholesky_with_jitter`."""
    return cholesky_with_jitter(matrix, name=name)[0]


def log_det(factor: Float[Tensor, "*b d d"]) -> Float[Tensor, "*b"]:
    """Log determinants of triangular matrices, but for their signs."""
    return factor.diagonal(dim1=-2, dim2=-1).abs().log().sum(-1)


def log_density(
    residual: Float[Tensor, "*b d"], scale_tril: Float[Tensor, "*b d d"], degrees: Float[Tensor, "*b"] | None = None
) -> Float[Tensor, "*b"]:
    """Log density of a law with the covariance ``scale_tril @ scale_tril.mT`` at each residual.

    It is normal, or multivariate Student's t of ``degrees`` above two; where these are many they are the same.
    """
    whitened = torch.linalg.solve_triangular(scale_tril, residual.unsqueeze(-1), upper=False)
    return log_density_at(whitened.square().sum((-2, -1)), residual.shape[-1], degrees) - log_det(scale_tril)


def log_density_at(square: Tensor, size: int | Tensor, degrees: Tensor | None = None) -> Tensor:
    """Log density of :func:`log_density` with unit covariance, in ``size`` dimensions, at squared distances."""
    if degrees is None:
        return -0.5 * square - 0.5 * size * math.log(2 * math.pi)
    # With the scale matrix (df - 2) / df times the covariance the density is
    # gamma((df + d) / 2) / gamma(df / 2) |(df - 2) pi S|^-1/2 (1 + x' S^-1 x / (df - 2))^-(df + d)/2.
    capped = degrees.clamp_max(1e7)  # beyond, the gamma functions lose more digits than the two densities differ by
    constant = torch.lgamma(0.5 * (capped + size)) - torch.lgamma(0.5 * capped)
    constant = constant - 0.5 * size * (math.pi * (capped - 2.0)).log()
    return constant - 0.5 * (capped + size) * torch.log1p(square / (capped - 2.0))


class _SpectralMap(torch.autograd.Function):
    """Function of a symmetric matrix whose gradient survives equal eigenvalues, which that of eigh does not."""

    @staticmethod
    def forward(
        ctx: Any, matrix: Tensor, function: Callable[[Tensor], Tensor], spectrum: tuple[Tensor, Tensor] | None
    ) -> Tensor:
        eigenvalues, axes = torch.linalg.eigh(matrix) if spectrum is None else spectrum
        with torch.enable_grad():
            leaf = eigenvalues.detach().requires_grad_(ctx.needs_input_grad[0])
            mapped = function(leaf)
            slope = torch.autograd.grad(mapped.sum(), leaf)[0] if ctx.needs_input_grad[0] else leaf
        mapped = mapped.detach()
        ctx.save_for_backward(eigenvalues, axes, mapped, slope)
        return symmetrize(axes * mapped.unsqueeze(-2) @ axes.mT)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, None]:
        if torch.is_grad_enabled():  # the axes are constants here: a second derivative would be wrong in silence
            raise RuntimeError("spectral_map has no second derivatives: call autograd without create_graph=True.")
        eigenvalues, axes, mapped, slope = ctx.saved_tensors
        gap = eigenvalues.unsqueeze(-1) - eigenvalues.unsqueeze(-2)
        # The difference of closer ones has lost half its digits, and the mean slope is at least as good.
        nearest = torch.finfo(gap.dtype).eps ** 0.5 * eigenvalues.abs().amax(-1)
        equal = gap.abs() <= nearest[..., None, None]
        rise = mapped.unsqueeze(-1) - mapped.unsqueeze(-2)
        mean_slope = 0.5 * (slope.unsqueeze(-1) + slope.unsqueeze(-2))
        divided = torch.where(equal, mean_slope, rise / torch.where(equal, 1.0, gap))
        return axes @ (divided * (axes.mT @ symmetrize(gradients[0]) @ axes)) @ axes.mT, None, None


def spectral_map(
    matrix: Float[Tensor, "*b d d"],
    function: Callable[[Tensor], Tensor],
    spectrum: tuple[Float[Tensor, "*b d"], Float[Tensor, "*b d d"]] | None = None,
) -> Float[Tensor, "*b d d"]:
    """``Q diag(function(eigenvalues)) Q'`` of the symmetric part of matrices, symmetric to the last bit.

    Continuous in the matrix wherever the elementwise ``function`` is in the eigenvalue, though the axes Q jump where
    eigenvalues cross. Its gradient is by divided differences (Daleckii and Krein), finite at equal eigenvalues; where
    ``function`` has a kink it is one-sided, that which autograd gives ``function``. ``spectrum`` are the eigenvalues
    and axes of the symmetric part, where they are known.
    """
    result: Tensor = _SpectralMap.apply(symmetrize(matrix), function, spectrum)
    return result

"""Stiffness from covariance, per block of outputs: eq. (19) and (20), or the minimal intervention principle."""

import math
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, replace
from numbers import Real
from typing import Any, Literal, final

import torch
from jaxtyping import Float
from torch import Tensor

from torch_pbd import checks
from torch_pbd.control.matrices import as_mass, as_semidefinite, as_tensor, masses_like
from torch_pbd.control.stiffness.limits import Block, Limit, RotationLimits, check_limits, of_outputs
from torch_pbd.control.stiffness.precision import matched_effort, precision_stiffness
from torch_pbd.exceptions import InvalidParameterError
from torch_pbd.linalg import spectral_map

Bounds = Literal["quantile", "sigma", "variance"]
Kind = Literal["linear", "precision"]

# On the tunnel task these spread K_xx over 50 to 1000 N/m, rising at 214 N/m/s, and at 1155 with the paper's bounds.
_QUANTILES = (0.1, 0.9)
# Smallest standard deviation that counts, since float64 does not hold squares of smaller ones.
_SMALLEST = 1e-150
_LIMITS = ("stiffness_min", "stiffness_max", "sigma_low", "sigma_high")


@final
@dataclass(frozen=True)
class StiffnessLaw:
    """Stiff where the standard deviation is small, compliant where it is large: eq. (19) and (20).

    Each principal axis of a covariance gets ``stiffness_max`` up to a standard deviation of ``sigma_low``,
    ``stiffness_min`` from ``sigma_high``, and linear interpolation between them. The stiffness is a continuous
    function of the covariance with finite gradients, even where eigenvalues cross and principal axes jump.

    Outputs of different units, or with separate limits, form blocks with bounds of their own: positions and the
    ``rotation`` of a pose, or each joint of an arm where a limit has one number per output. The stiffness is
    block-diagonal unless ``cross_terms`` is set, and as a matrix always lies between the limits.

    Parameters
    ----------
    stiffness_min, stiffness_max : float or sequence of float, default=50.0, 1000.0
        Limits of the stiffness in N/m (or force per unit of output, Nm/rad for angles), 0 < stiffness_min <=
        stiffness_max; defaults are those of Table II. One number per output makes each output a block.
    sigma_low, sigma_high : float or sequence of float, default=None
        Bounds of the standard deviation, in units of the outputs, 0 <= sigma_low < sigma_high. With bounds="quantile"
        they follow from the covariances of each call, or are fixed by :meth:`fitted`.
    bounds : {"quantile", "sigma", "variance"}, default="quantile"
        Meaning of the two bounds. "sigma" is standard deviations, eq. (20) as printed. "variance" is variances, whose
        roots are taken: only so do the paper's 3.5e-4 and 1.2e-3 reproduce its Figure 8. "quantile" takes the 10 % and
        90 % quantiles of the standard deviations along all axes of all covariances, per block, and needs both None.
    smooth : bool, default=False
        Replace the straight line by ``3 u^2 - 2 u^3``: the stiffness then has a continuous derivative.
    kind : {"linear", "precision"}, default="linear"
        "linear" is eq. (20). "precision" minimizes the expected cost ``e' Sigma^-1 e + r f' M^-1 f`` of deviations e
        and forces f on a mass M: ``K = (M # Sigma^-1) / r^1/2`` with the geometric mean # of matrices, clipped to the
        limits. Its damping ratio is 1/sqrt(2); at the limits, 1 costs less (scripts/benchmarks/precision_law.py).
    rotation : RotationLimits, default=None
        Limits of the last three outputs if they are a rotation in rad.
    cross_terms : bool, default=False
        Whether covariances between blocks couple these in the stiffness; otherwise they are ignored.
    effort : "match", float or sequence of float, default="match"
        Weight r of the forces for kind="precision", for all blocks or one per block, in kg/N^2. "match" takes, per
        block, the r that gives a mean mass ``stiffness_min`` at a standard deviation of ``sigma_high``.

    Examples
    --------
    >>> import torch
    >>> law = StiffnessLaw(sigma_low=0.01, sigma_high=0.03, bounds="sigma")
    >>> law(torch.diag(torch.tensor([0.001, 0.02]).double() ** 2)).diagonal().round(decimals=3).tolist()
    [1000.0, 525.0]
    >>> pose = StiffnessLaw(rotation=RotationLimits(2.5, 50.0))
    >>> pose(torch.diag_embed(torch.rand(9, 6).double())).shape
    torch.Size([9, 6, 6])
    """

    stiffness_min: Limit = 50.0
    stiffness_max: Limit = 1000.0
    sigma_low: Limit | None = None
    sigma_high: Limit | None = None
    bounds: Bounds = "quantile"
    smooth: bool = False
    _: KW_ONLY
    kind: Kind = "linear"
    rotation: RotationLimits | None = None
    cross_terms: bool = False
    effort: Literal["match"] | Limit = "match"

    def __post_init__(self) -> None:
        for name in (*_LIMITS, "effort"):
            if not isinstance(getattr(self, name), Real | str | None):
                object.__setattr__(self, name, tuple(checks.array(getattr(self, name), name, ("d",)).tolist()))
        checks.flag(self.smooth, "smooth")
        checks.flag(self.cross_terms, "cross_terms")
        checks.choice(self.bounds, "bounds", Bounds)
        checks.choice(self.kind, "kind", Kind)
        checks.instance(self.rotation, "rotation", RotationLimits, optional=True)
        if self.kind == "precision" and self.smooth:
            raise checks.refusal(True, "smooth", "False with kind='precision'", "it smooths the straight line")
        for entry in self.effort if isinstance(self.effort, tuple) else () if self.effort == "match" else [self.effort]:
            checks.number(entry, "effort", above=0.0, unit="kg/N^2", remedy="or 'match'")
        sizes = [len(limit) for limit in (getattr(self, name) for name in _LIMITS) if isinstance(limit, tuple)]
        if len(set(sizes)) > 1:
            listed = " and ".join(map(str, sizes))
            raise InvalidParameterError(f"limits have {listed} numbers, must have one, or one for each output.")
        for block in self.blocks(max(sizes, default=1) + (0 if self.rotation is None else 3)):
            check_limits(block, block.name, self.bounds)

    def __call__(
        self, covariance: Float[Tensor, "*b d d"] | Any, mass: Any = None, *, type1: Any = None
    ) -> Float[Tensor, "*b d d"]:
        """Stiffness in N/m for positive semidefinite covariances (..., d, d), symmetric to the last bit.

        Only kind="precision" uses ``mass``, a number in kg or matrices (..., d, d). Type I uncertainties ``type1``
        (...,) are the shares by which the stiffness moves to its minimum, as data are missing.
        """
        matrix, spectrum = as_semidefinite(covariance, "covariance")
        blocks = self.blocks(matrix.shape[-1])
        known = spectrum if len(blocks) == 1 else None
        if self.kind == "linear" or self.effort == "match":
            blocks = [self._with_bounds(block, matrix, known) for block in blocks]
        masses = matrix
        if self.kind == "precision":
            blocks, masses = self._with_efforts(blocks, mass, matrix)
            matrix, masses = torch.broadcast_tensors(matrix, masses)
        stiffness = torch.zeros_like(matrix)
        for group in [blocks] if self.cross_terms else [[block] for block in blocks]:
            outputs = slice(group[0].outputs.start, group[-1].outputs.stop)
            part = matrix[..., outputs, outputs]
            if self.kind == "precision":
                given = (of_outputs(group, name, part) for name in ("effort", "stiffness_min", "stiffness_max"))
                own = precision_stiffness(part, masses[..., outputs, outputs], *given)
            else:
                own = self._linear(group[0], part, known) if len(group) == 1 else self._coupled(group, part)
            stiffness[..., outputs, outputs] = own
        if type1 is None:
            return stiffness
        softest = torch.diag(of_outputs(blocks, "stiffness_min", stiffness))
        return softest + (1.0 - as_tensor(type1, "type1").to(stiffness))[..., None, None] * (stiffness - softest)

    def fitted(
        self, covariance: Float[Tensor, "*b d d"] | Any, *, resolution: Sequence[float] | None = None, mass: Any = None
    ) -> "StiffnessLaw":
        """Law whose bounds, as standard deviations, and effort are fixed to those of ``covariance`` (..., d, d).

        For quantiles, standard deviations are raised to at least ``resolution`` (d,). If the covariances do not vary at
        all, every axis counts as precise, with a warning.
        """
        matrix = as_semidefinite(covariance, "covariance")[0].detach()
        finest = [0.0] * matrix.shape[-1] if resolution is None else resolution
        blocks = self.blocks(matrix.shape[-1])
        blocks = [self._with_bounds(block, matrix, resolution=finest[block.outputs.start]) for block in blocks]
        names, changes = ["sigma_low", "sigma_high"], dict[str, Any]()
        if self.kind == "precision":
            blocks = self._with_efforts(blocks, mass, matrix)[0]
            changes["effort"] = _one_or_each(blocks, "effort")
        if self.rotation is not None:
            *blocks, last = blocks
            changes["rotation"] = replace(self.rotation, **{name: getattr(last, name) for name in names})
        return replace(self, bounds="sigma", **changes, **{name: _one_or_each(blocks, name) for name in names})

    def blocks(self, n_outputs: int) -> list[Block]:
        """Blocks of ``n_outputs`` outputs, in order."""
        n_positions = n_outputs - (0 if self.rotation is None else 3)
        rows = [getattr(self, name) for name in _LIMITS]
        size = next((len(row) for row in rows if isinstance(row, tuple)), None)
        if n_positions < 1 or size not in (None, n_positions):
            wanted = f"{size or 'one or more'}{'' if self.rotation is None else ' and then 3 of rotation'}"
            raise InvalidParameterError(f"covariance is of {n_outputs} outputs, must be of {wanted}, as the law is.")
        if size is not None:
            each = zip(*(row if isinstance(row, tuple) else [row] * size for row in rows), strict=True)
            blocks = [Block(slice(i, i + 1), f"output {i}", *row) for i, row in enumerate(each)]
        else:
            blocks = [Block(slice(0, n_positions), "" if self.rotation is None else "positions", *rows)]
        if self.rotation is not None:
            own = (getattr(self.rotation, name) for name in _LIMITS)
            blocks.append(Block(slice(n_positions, n_outputs), "rotations", *own))
        return blocks

    def limits(self, n_outputs: int) -> tuple[Limit, Limit]:
        """Least and largest stiffness of ``n_outputs`` outputs: numbers, or with several blocks one per output."""
        blocks = self.blocks(n_outputs)
        if len(blocks) == 1:
            return blocks[0].stiffness_min, blocks[0].stiffness_max
        least, most = (of_outputs(blocks, name, torch.empty(0).double()).tolist() for name in _LIMITS[:2])
        return tuple(least), tuple(most)

    def _linear(self, block: Block, matrix: Tensor, spectrum: tuple[Tensor, Tensor] | None) -> Tensor:
        """Stiffness of one block by eq. (19) and (20)."""
        low, high = block.sigma_low, block.sigma_high
        least, most = block.stiffness_min, block.stiffness_max

        def stiffness(variance: Tensor) -> Tensor:
            # The variance is clipped at the lower bound before the root, whose gradient at zero is infinite.
            scale = variance.clamp_min(max(low**2, torch.finfo(variance.dtype).tiny)).sqrt()
            share = ((scale - low) / (high - low)).clamp(0.0, 1.0)
            return most - (most - least) * self._eased(share)

        return spectral_map(matrix, stiffness, spectrum)

    def _coupled(self, blocks: list[Block], matrix: Tensor) -> Tensor:
        """Stiffness of all blocks with the coupling between them; without coupling, :meth:`_linear` of each.

        Eq. (20) is ``k_min + e^1/2 u e^1/2`` with e = k_max - k_min, where the share u = clip(g (1 - s / s_high)),
        g = s_high / (s_high - s_low), leads from the least to the largest stiffness. It becomes a law of matrices with
        diagonal H of 1 / s_high, G and E, and the unitless U = clip(G^1/2 (1 - (H Sigma H)^1/2) G^1/2): 0 <= U <= 1, so
        that K lies within its limits, and no length is needed to compare rotations with positions.
        """
        least, most, low, high = (of_outputs(blocks, name, matrix) for name in _LIMITS)
        gain, extent = (high / (high - low)).sqrt(), (most - least).sqrt()
        tiny = torch.finfo(matrix.dtype).tiny
        root = spectral_map(matrix / torch.outer(high, high), lambda variance: variance.clamp_min(tiny).sqrt())
        share = gain[:, None] * (torch.eye(len(gain)).to(matrix) - root) * gain
        eased = spectral_map(share, lambda u: self._eased(u.clamp(0.0, 1.0)))
        return torch.diag(least) + torch.outer(extent, extent) * eased

    def _eased(self, share: Tensor) -> Tensor:
        return share * share * (3.0 - 2.0 * share) if self.smooth else share

    def _with_efforts(self, blocks: list[Block], mass: Any, like: Tensor) -> tuple[list[Block], Tensor]:
        """Blocks with their effort r, as given or matched to their bounds, and the mass as matrices."""
        if mass is None:
            raise checks.refusal(None, "mass", "given", "the stiffness of kind='precision' depends on it")
        masses = masses_like(as_mass(mass), like, "covariance")
        efforts: Any = self.effort if isinstance(self.effort, tuple) else [self.effort] * len(blocks)
        if len(efforts) != len(blocks):
            raise InvalidParameterError(f"effort has {len(efforts)} numbers, must be one, or {len(blocks)}.")
        if self.effort == "match":
            efforts = [matched_effort(block.of(masses), block.sigma_high, block.stiffness_min) for block in blocks]
        return [block._replace(effort=effort) for block, effort in zip(blocks, efforts, strict=True)], masses

    def _with_bounds(
        self, block: Block, matrix: Tensor, spectrum: tuple[Tensor, Tensor] | None = None, resolution: float = 0.0
    ) -> Block:
        """Block with bounds of its standard deviation, as given or quantiles along all axes of its covariances.

        Standard deviations are raised to at least ``resolution``. Warns where they do not vary.
        """
        if self.bounds != "quantile":
            root = math.sqrt if self.bounds == "variance" else float
            return block._replace(sigma_low=root(block.sigma_low), sigma_high=root(block.sigma_high))
        variances = torch.linalg.eigvalsh(block.of(matrix).detach()) if spectrum is None else spectrum[0]
        if not variances.numel():
            raise InvalidParameterError(
                "covariance is empty, must have at least one matrix: bounds='quantile' takes quantiles of them."
            )
        scales = variances.clamp_min(0.0).sqrt().clamp_min(resolution).flatten()
        low, high = torch.quantile(scales, scales.new_tensor(_QUANTILES)).tolist()
        # Quantiles that differ only by rounding would turn the line between them into a step.
        if high <= low * (1.0 + checks.ROUNDING):
            checks.warn(
                f"The covariances {f'of {block.name} ' if block.name else ''}do not vary: their standard deviations "
                f"have quantiles {low:.3g} and {high:.3g}. Every direction counts as precise, and gets stiffness_max; "
                "give sigma_low and sigma_high with bounds='sigma' to say what is precise."
            )
            low = max(high * (1.0 + 1e-6), _SMALLEST) if high else 1.0
            high = 2.0 * low
        return block._replace(sigma_low=low, sigma_high=high)


def _one_or_each(blocks: Sequence[Block], name: str) -> Any:
    values = tuple(getattr(block, name) for block in blocks)
    return values[0] if len(values) == 1 else values

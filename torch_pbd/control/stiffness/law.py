"""Stiffness from covariance: eq. (19) and (20), for each block of outputs, and the law of minimal intervention."""

import math
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, replace
from typing import Any, Literal, final

import torch
from jaxtyping import Float
from torch import Tensor

from torch_pbd import checks
from torch_pbd.control.matrices import as_semidefinite
from torch_pbd.control.stiffness import limits
from torch_pbd.control.stiffness.limits import Block, Limit, RotationLimits
from torch_pbd.control.stiffness.precision import as_masses, matched_effort, precision_stiffness
from torch_pbd.exceptions import InvalidParameterError
from torch_pbd.linalg import broadcast_shapes, spectral_map

Bounds = Literal["quantile", "sigma", "variance"]
Kind = Literal["linear", "precision"]
Scales = tuple[float, float]


@final
@dataclass(frozen=True)
class StiffnessLaw:
    """Stiff where the standard deviation is small, compliant where it is large: eq. (19) and (20).

    Each principal axis of a covariance gets ``stiffness_max`` up to a standard deviation of ``sigma_low``,
    ``stiffness_min`` from ``sigma_high``, and a straight line between them. As a function of the covariance
    the result is continuous, through crossings of eigenvalues too, where its principal axes are not; its
    gradient is finite there.

    Outputs of different units, or with limits of their own, are blocks, of which each has its own bounds: positions
    and the ``rotation`` of a pose; each joint of an arm, where a limit is one number for each output. The stiffness
    is of these blocks alone unless ``cross_terms`` are asked for, and lies between the limits as a matrix either way.

    Parameters
    ----------
    stiffness_min, stiffness_max : float or sequence of float, default=50.0, 1000.0
        In N/m (or force per unit of output: Nm/rad of angles), 0 < stiffness_min <= stiffness_max. The paper's,
        Table II. One for each output makes each a block.
    sigma_low, sigma_high : float or sequence of float, default=None
        Bounds of the standard deviation in its units, 0 <= sigma_low < sigma_high. With bounds="quantile" they are
        taken from the covariances of each call, or once for all by :meth:`fitted`.
    bounds : {"quantile", "sigma", "variance"}, default="quantile"
        What the two bounds are. "sigma": standard deviations, eq. (20) as printed. "variance": variances, whose
        roots are taken; the paper's 3.5e-4 and 1.2e-3 give its Figure 8 only so. "quantile": the 10 % and 90 %
        quantiles of the standard deviations along all axes of all covariances given, block by block; leave the two
        None.
    smooth : bool, default=False
        Replace the straight line by ``3 u^2 - 2 u^3``: the stiffness then has a continuous derivative.
    kind : {"linear", "precision"}, default="linear"
        "precision" is what minimizes the expected cost ``e' Sigma^-1 e + r f' M^-1 f`` of deviations e and forces f of
        a mass M: ``K = (M # Sigma^-1) / r^1/2`` with the geometric mean # of matrices, then held within the limits.
        Its own damping ratio is 1/sqrt(2); where limits hold, 1 costs less (scripts/benchmarks/precision_law.py).
    rotation : RotationLimits, default=None
        Of the last three outputs, if they are a rotation in rad.
    cross_terms : bool, default=False
        Whether covariances between blocks couple them in the stiffness. Without, they do not count.
    effort : "match", float or sequence of float, default="match"
        The r of kind="precision", for all blocks or one for each, in kg/N^2. "match": the r that gives
        ``stiffness_min`` to a mean mass where the standard deviation is ``sigma_high``, block by block.

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
        for name in ("stiffness_min", "stiffness_max", "sigma_low", "sigma_high", "effort"):
            object.__setattr__(self, name, limits.plain(getattr(self, name), name))
        checks.flag(self.smooth, "smooth")
        checks.flag(self.cross_terms, "cross_terms")
        checks.choice(self.bounds, "bounds", Bounds)
        checks.choice(self.kind, "kind", Kind)
        checks.instance(self.rotation, "rotation", RotationLimits, optional=True)
        each = isinstance(self.stiffness_min, tuple) or isinstance(self.stiffness_max, tuple)
        limits.check_stiffness(self.stiffness_min, self.stiffness_max, unit="" if each else "N/m")
        if self.kind == "precision" and self.smooth:
            raise checks.refusal(True, "smooth", "False with kind='precision'", "it smooths the straight line")
        for entry in self.effort if isinstance(self.effort, tuple) else () if self.effort == "match" else [self.effort]:
            checks.number(entry, "effort", above=0.0, unit="kg/N^2", remedy="or 'match'")
        given: dict[str, StiffnessLaw | RotationLimits | None] = {"": self, "rotation.": self.rotation}
        for prefix, own in given.items():
            low, high = (None, None) if own is None else (own.sigma_low, own.sigma_high)
            if own is not None and self.bounds != "quantile":
                limits.check_scales(low, high, prefix)
            elif (low, high) != (None, None):
                raise InvalidParameterError(
                    f"{prefix}sigma_low={low} and {prefix}sigma_high={high} are standard deviations: give "
                    "bounds='sigma' with them (or 'variance'). bounds='quantile' takes its own from the covariances."
                )

    def __call__(self, covariance: Float[Tensor, "*b d d"] | Any, mass: Any = None) -> Float[Tensor, "*b d d"]:
        """Stiffness in N/m of covariances (..., d, d), positive semidefinite; symmetric to the last bit.

        The ``mass``, a number in kg or matrices (..., d, d), is what kind="precision" needs; else it does not count.
        """
        matrix, spectrum = as_semidefinite(covariance, "covariance")
        blocks = self.blocks(matrix.shape[-1])
        if self.kind == "precision":
            return self._precise(matrix, blocks, mass)
        if len(blocks) == 1:
            return self._linear(blocks[0], matrix, spectrum)
        if self.cross_terms:
            return self._coupled(matrix, blocks)
        stiffness = torch.zeros_like(matrix)
        for block in blocks:
            part = block.of(matrix)
            stiffness[..., block.outputs, block.outputs] = self._linear(block, part, None)
        return stiffness

    def fitted(
        self,
        covariance: Float[Tensor, "*b d d"] | Any,
        *,
        resolution: float | Sequence[float] = 0.0,
        mass: Any = None,
    ) -> "StiffnessLaw":
        """Law with its bounds fixed, as standard deviations, and its effort, to those of ``covariance`` (..., d, d).

        For quantiles, smaller standard deviations count as ``resolution``, a number or one for each output. If the
        covariances do not vary at all, every axis counts as precise, with a warning.
        """
        matrix = as_semidefinite(covariance, "covariance")[0].detach()
        blocks = self.blocks(matrix.shape[-1])
        each = [resolution] * matrix.shape[-1] if isinstance(resolution, float | int) else list(resolution)
        finest = [checks.number(each[block.outputs.start], "resolution", least=0.0) for block in blocks]
        scales = [
            self._scales(block, block.of(matrix), None, *least) for block, *least in zip(blocks, finest, strict=True)
        ]
        effort = self.effort
        if self.kind == "precision":
            efforts = self._efforts(matrix, blocks, mass, scales)
            effort = efforts[0] if len(blocks) == 1 else efforts
        rotation, own = self.rotation, scales
        if rotation is not None:
            rotation, own = replace(rotation, sigma_low=scales[-1][0], sigma_high=scales[-1][1]), scales[:-1]
        low, high = own[0] if len(own) == 1 else zip(*own, strict=True)
        changes: dict[str, Any] = {"sigma_low": low, "sigma_high": high, "rotation": rotation, "effort": effort}
        return replace(self, bounds="sigma", **changes)

    def blocks(self, n_outputs: int) -> list[Block]:
        """Blocks of so many outputs, in order."""
        rotation, n_positions = self.rotation, n_outputs - (0 if self.rotation is None else 3)
        rows = (self.stiffness_min, self.stiffness_max, self.sigma_low, self.sigma_high)
        sizes = {len(row) for row in rows if isinstance(row, tuple)}
        if n_positions < 1 or not sizes <= {n_positions}:
            wanted = " or ".join(map(str, sorted(sizes))) or "one or more"
            more = " and then 3 of rotation" if rotation is not None else ""
            raise InvalidParameterError(
                f"covariance is of {n_outputs} outputs, must be of {wanted}{more}, as the law is."
            )
        name = "positions" if rotation is not None else ""
        blocks = [Block(slice(0, n_positions), *rows, name=name)] if not sizes else []  # type: ignore[arg-type]
        if sizes:
            each = [row if isinstance(row, tuple) else [row] * n_positions for row in rows]
            blocks = [Block(slice(i, i + 1), *row, name=f"output {i}") for i, row in enumerate(zip(*each, strict=True))]
        if rotation is not None:
            own = rotation.stiffness_min, rotation.stiffness_max, rotation.sigma_low, rotation.sigma_high
            blocks.append(Block(slice(n_positions, n_outputs), *own, name="rotations"))
        return blocks

    def limits(self, n_outputs: int) -> tuple[Limit, Limit]:
        """Least and largest stiffness of so many outputs: numbers, or one for each output where there are blocks."""
        blocks = self.blocks(n_outputs)
        if len(blocks) == 1:
            return blocks[0].stiffness_min, blocks[0].stiffness_max
        low, high = zip(*[(block.stiffness_min, block.stiffness_max) for block in blocks], strict=True)
        return tuple(limits.of_outputs(blocks, low)), tuple(limits.of_outputs(blocks, high))

    def _linear(self, block: Block, matrix: Tensor, spectrum: tuple[Tensor, Tensor] | None) -> Tensor:
        """Stiffness of one block by eq. (19) and (20)."""
        spectrum = tuple(torch.linalg.eigh(matrix.detach())) if spectrum is None else spectrum
        low, high = self._scales(block, matrix, spectrum[0])
        least, most = block.stiffness_min, block.stiffness_max

        def stiffness(variance: Tensor) -> Tensor:
            # The root is taken of what is above the lower bound, so its gradient at zero is never asked for.
            scale = variance.clamp_min(max(low**2, torch.finfo(variance.dtype).tiny)).sqrt()
            share = ((scale - low) / (high - low)).clamp(0.0, 1.0)
            return most - (most - least) * self._eased(share)

        return spectral_map(matrix, stiffness, spectrum)

    def _coupled(self, matrix: Tensor, blocks: list[Block]) -> Tensor:
        """Stiffness of all blocks with what couples them, equal to :meth:`_linear` of each where nothing does.

        Eq. (20) is, with the share u = clip(g (1 - s / s_high)), g = s_high / (s_high - s_low), of the way from the
        least to the largest stiffness, ``k_min + e^1/2 u e^1/2``, e = k_max - k_min. With diagonal matrices H of
        1 / s_high, G and E, and U = clip(G^1/2 (1 - (H Sigma H)^1/2) G^1/2), which has no unit, all of it is a law of
        matrices: 0 <= U <= 1, so that K lies within its limits, and no length makes rotations of positions.
        """
        scales = [self._scales(block, block.of(matrix), None) for block in blocks]
        inverse = matrix.new_tensor(limits.of_outputs(blocks, [1.0 / high for _, high in scales]))
        gain = matrix.new_tensor(limits.of_outputs(blocks, [math.sqrt(high / (high - low)) for low, high in scales]))
        tiny = torch.finfo(matrix.dtype).tiny
        root = spectral_map(torch.outer(inverse, inverse) * matrix, lambda variance: variance.clamp_min(tiny).sqrt())
        share = gain[:, None] * (torch.eye(len(gain)).to(matrix) - root) * gain
        least, most = (matrix.new_tensor(limit) for limit in self.limits(len(gain)))
        extent = (most - least).sqrt()
        eased = spectral_map(share, lambda u: self._eased(u.clamp(0.0, 1.0)))
        return torch.diag(least) + torch.outer(extent, extent) * eased

    def _precise(self, matrix: Tensor, blocks: list[Block], mass: Any) -> Tensor:
        """Stiffness of minimal intervention, of each block or of all with what couples them."""
        scales = [self._scales(block, block.of(matrix), None) for block in blocks] if self.effort == "match" else []
        efforts = self._efforts(matrix, blocks, mass, scales)
        masses = as_masses(mass, matrix)
        shape = broadcast_shapes(matrix.shape, masses.shape)
        matrix, masses = matrix.expand(shape), masses.expand(shape)
        given = efforts, [block.stiffness_min for block in blocks], [block.stiffness_max for block in blocks]
        effort, low, high = (matrix.new_tensor(limits.of_outputs(blocks, values)) for values in given)
        if self.cross_terms or len(blocks) == 1:
            return precision_stiffness(matrix, masses, effort, low, high)
        stiffness = torch.zeros_like(matrix)
        for block in blocks:
            rows = [part[block.outputs] for part in (effort, low, high)]
            own = precision_stiffness(block.of(matrix), block.of(masses), *rows)
            stiffness[..., block.outputs, block.outputs] = own
        return stiffness

    def _efforts(self, matrix: Tensor, blocks: list[Block], mass: Any, scales: list[Scales]) -> tuple[float, ...]:
        """Effort r of each block."""
        if self.effort == "match":
            masses = as_masses(mass, matrix)
            ends = [
                (block.of(masses), high, block.stiffness_min) for block, (_, high) in zip(blocks, scales, strict=True)
            ]
            return tuple(matched_effort(*end) for end in ends)
        given: Any = self.effort
        efforts = tuple(map(float, given)) if isinstance(given, tuple) else (float(given),) * len(blocks)
        if len(efforts) != len(blocks):
            raise InvalidParameterError(
                f"effort has {len(efforts)} numbers, must be one, or {len(blocks)}: one a block."
            )
        return efforts

    def _eased(self, share: Tensor) -> Tensor:
        return share * share * (3.0 - 2.0 * share) if self.smooth else share

    def _scales(self, block: Block, part: Tensor, variances: Tensor | None, resolution: float = 0.0) -> Scales:
        """Bounds of the standard deviation of one block whose covariances are ``part``."""
        if self.bounds == "quantile":
            variances = torch.linalg.eigvalsh(part.detach()) if variances is None else variances
            return limits.quantiles(variances, resolution, block.name)
        assert block.sigma_low is not None
        assert block.sigma_high is not None
        low, high = block.sigma_low, block.sigma_high
        return (math.sqrt(low), math.sqrt(high)) if self.bounds == "variance" else (low, high)

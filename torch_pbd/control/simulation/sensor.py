"""Force-torque sensor and position loop of the simulated robot."""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import final

import torch
from jaxtyping import Float
from torch import Tensor

from torch_pbd import checks
from torch_pbd.exceptions import InvalidParameterError

_OF_AXES = ("bias", "noise_scale", "resolution", "range", "deadband")


@final
@dataclass(frozen=True)
class ForceSensor:
    """Model of a 6-axis force-torque sensor; works for any number of axes.

    The stages are, in order: true force plus ``bias``, low-pass, noise, saturation, quantization, delay, deadband. The
    force is held over each tick and read at its start, so that a filtered reading depends only on forces before its
    tick, and an unfiltered one also on that of its own tick. Before the first tick the force is zero and the filter has
    settled at the bias. A force that is not finite is a lost sample: its reading is NaN (after the delay), never zero,
    and the filter holds through it.

    Quantities in N are one number for all axes or d numbers; for poses, p numbers in N and three in Nm.

    Parameters
    ----------
    bias : float or sequence of d float, default=0.0
        Constant error [N].
    noise_scale : float or sequence of d float, default=0.0
        Standard deviation of white noise on the reading [N], added after the filter.
    resolution : float or sequence of d float, default=0.0
        Quantization step [N], at most ``range``; 0 for none. A step that does not divide ``range`` may round a
        clipped reading to half a step beyond it.
    range : float or sequence of d float, default=200.0
        Absolute force at which an axis saturates [N]; ``math.inf`` for never.
    cutoff : float or None, default=None
        Corner frequency of the first-order low-pass [Hz], discretized exactly; None for none.
    delay_steps : int, default=0
        Ticks by which the reading is late, in addition to the filter.
    deadband : float or sequence of d float, default=0.0
        Soft threshold [N]: smaller readings are zero, larger ones shrink by it. It acts on the bias too.

    Examples
    --------
    >>> import torch
    >>> from torch_pbd.control import ForceSensor
    >>> read = ForceSensor(resolution=0.5, range=10.0).start(torch.zeros(2), dt=1e-3)
    >>> force, saturated = read(torch.tensor([1.2, -25.0]))
    >>> force.tolist(), bool(saturated)
    ([1.0, -10.0], True)
    """

    bias: float | Sequence[float] = 0.0
    noise_scale: float | Sequence[float] = 0.0
    resolution: float | Sequence[float] = 0.0
    range: float | Sequence[float] = 200.0
    cutoff: float | None = None
    delay_steps: int = 0
    deadband: float | Sequence[float] = 0.0

    def __post_init__(self) -> None:
        for name in _OF_AXES:
            if isinstance(getattr(self, name), list):  # lists are neither immutable nor hashable
                object.__setattr__(self, name, tuple(getattr(self, name)))
            for value in self._values(name):
                above, least = (0.0, None) if name == "range" else (None, None if name == "bias" else 0.0)
                if (name, value) != ("range", math.inf):
                    checks.number(value, name, above=above, least=least, unit="N")
        steps, ranges = self._values("resolution"), self._values("range")
        for step, most in zip(steps, ranges, strict=True) if len(steps) == len(ranges) else product(steps, ranges):
            checks.number(step, "resolution", least=0.0, most=most, unit="N", remedy="0 is none")
        checks.number(self.cutoff, "cutoff", above=0.0, unit="Hz", optional=True)
        checks.count(self.delay_steps, "delay_steps", least=0)

    def _values(self, name: str) -> Sequence[float]:
        value = getattr(self, name)
        return value if isinstance(value, tuple) else (value,)

    @property
    def is_noisy(self) -> bool:
        """Whether readings are random."""
        return any(self._values("noise_scale"))

    @classmethod
    def jr3(cls, cutoff: float = 500.0, rate: float = 1000.0) -> "ForceSensor":
        """Sensor like the paper's JR3, with plausible values that are not from a data sheet or a measurement.

        It has a range of 200 N in 2^13 steps, noise of 0.05 N, a bias of 0.3 N on each axis (a drift of 0.2 to 0.5 N is
        usual), and a total delay of about ``1 / cutoff``, rounded to ticks of ``rate`` Hz. The JR3's digital filters
        have 500, 125, 31.25, 7.813, 1.953 and 0.4883 Hz.
        """
        checks.number(cutoff, "cutoff", above=0.0, unit="Hz")
        checks.number(rate, "rate", above=0.0, unit="Hz")
        # Lag, in ticks, of the sampled filter behind a ramp: the mean of its impulse response, a geometric series.
        lag = -1.0 / math.expm1(-2.0 * math.pi * cutoff / rate)
        delay_steps = max(0, round(rate / cutoff - lag))
        return cls(0.3, noise_scale=0.05, resolution=200.0 / 2**13, cutoff=cutoff, delay_steps=delay_steps)

    def start(self, like: Float[Tensor, "*b d"], dt: float, generator: torch.Generator | None = None) -> "ForceReader":
        """Sensor at rest, to be called with the true force (..., d) in N once per tick of ``dt`` s.

        Forces must have the shape, dtype and device of ``like``; the ``generator`` draws the noise.
        """
        for name in _OF_AXES:
            if (n_values := len(self._values(name))) not in (1, like.shape[-1]):
                raise InvalidParameterError(
                    f"{name} has {n_values} values, but the force has {like.shape[-1]} axes: give one for each axis, "
                    "or one number for all."
                )
        remedy = f"noise_scale is {self.noise_scale} N: pass torch.Generator().manual_seed(...), or set it to 0"
        checks.instance(generator, "generator", torch.Generator, optional=not self.is_noisy, remedy=remedy)
        return ForceReader(self, like, dt, generator)


@final
class ForceReader:
    """Running sensor, called with the true force once per tick: filter state and delayed readings."""

    def __init__(
        self, sensor: ForceSensor, like: Float[Tensor, "*b d"], dt: float, generator: torch.Generator | None
    ) -> None:
        self._generator = generator if sensor.is_noisy else None
        of_axes = (like.new_tensor(getattr(sensor, name)) for name in _OF_AXES)
        bias, self._noise_scale, self._resolution, self._range, self._deadband = of_axes
        self._bias = torch.zeros_like(like) + bias
        self._gain = None if sensor.cutoff is None else -math.expm1(-2.0 * math.pi * sensor.cutoff * dt)
        self._filtered = self._bias
        # Separate tensors, so that subtracting a bias in place from one does not change the next.
        self._under_way = deque(self._convert(self._bias) for _ in range(sensor.delay_steps))

    def __call__(self, force: Float[Tensor, "*b d"]) -> tuple[Tensor, Tensor]:
        """Force read (..., d) at this tick, over which the true one is held, and whether an axis was clipped (...)."""
        lost = ~torch.isfinite(force)
        level = torch.where(lost, self._filtered, force + self._bias)
        if self._gain is not None:
            # State of dx/dt = 2 pi cutoff (level - x) at the start of the tick, then advanced over it.
            level, self._filtered = self._filtered, torch.lerp(self._filtered, level, self._gain)
        if self._generator is not None:
            # Drawn on the generator's device, so that a seed gives the same noise on every device.
            at, like = self._generator.device, self._bias
            noise = torch.randn(like.shape, generator=self._generator, dtype=like.dtype, device=at)
            level = level + self._noise_scale * noise.to(like.device)
        reading, saturated = self._convert(level)
        self._under_way.append((reading.masked_fill(lost, math.nan), saturated))
        return self._under_way.popleft()

    def _convert(self, level: Tensor) -> tuple[Tensor, Tensor]:
        """Clip, round and apply the deadband, which may precede the delay since it has no memory."""
        saturated = (level.abs() >= self._range).any(-1)
        level = level.clamp(-self._range, self._range)
        step = torch.where(self._resolution > 0.0, self._resolution, 1.0)
        level = torch.where(self._resolution > 0.0, step * torch.round(level / step), level)
        return level - level.clamp(-self._deadband, self._deadband), saturated


@final
@dataclass(frozen=True)
class PositionLoop:
    """Inner position loop of the robot, critically damped and of second order, after a delay of whole ticks.

    ``x'' = w^2 (x_commanded - x) - 2 w x'`` with ``w = 2 pi bandwidth``. It lags behind a ramp by ``2 / w``, the
    delay, and half a tick of hold.

    Parameters
    ----------
    bandwidth : float, default=20.0
        Natural frequency of the loop in Hz.
    delay_steps : int, default=1
        Ticks between a command and its effect, at least 0.
    """

    bandwidth: float = 20.0
    delay_steps: int = 1

    def __post_init__(self) -> None:
        checks.number(self.bandwidth, "bandwidth", above=0.0, unit="Hz")
        checks.count(self.delay_steps, "delay_steps", least=0)

    def transition(self, dt: float, like: Tensor) -> Float[Tensor, "2 3"]:
        """Exact map of ``[position, velocity, command]`` to the position and velocity a tick later."""
        # For a held command c, x - c = e^-wt ((1 + w t) (x_0 - c) + t v_0): critical damping has one root, twice.
        w = 2.0 * math.pi * self.bandwidth
        decay = math.exp(-w * dt)
        rows = [
            [(1.0 + w * dt) * decay, dt * decay, 1.0 - (1.0 + w * dt) * decay],
            [-w * w * dt * decay, (1.0 - w * dt) * decay, w * w * dt * decay],
        ]
        return like.new_tensor(rows)

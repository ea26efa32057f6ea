"""Synthetic demonstrations of known covariance: the simulation of the paper and a narrowing tunnel."""

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.data.demonstrations import Demonstrations
from torch_pbd.files.memory import require_much

Reading = Literal["printed", "bell", "bowl"]
Variant = Literal["plain", "unequal", "dropped", "jitter", "outlier", "two_path"]
Random = np.random.Generator | np.random.RandomState
Seed = int | Random | None

PATH_LENGTH = 0.6
"""Distance that the tunnel task covers along y, in m."""

# Resolution of positions and noise along the path of a good optical tracker, and tremor of a hand, in m.
_QUANTUM, _NOISE, _TREMOR = 5e-6, 2e-6, 1e-4
# Scales of the unit-variance wandering and correcting of a lane, and the share of the half-width that it stays within.
_WANDER, _CORRECTION, _WITHIN = 0.12, 0.04, 0.85
_BLENDED = 0.15  # share of the path next to a common end in which lanes blend
_N_WAVES = 32  # cosines whose sum is nearly normal


def paper_mean(xi: ArrayLike) -> Floats:
    """Mean (n, 2) of eq. (14) at inputs (n,) or (n, 1): ``[30 sin(xi / 20), 30 tanh(xi / 20)]``."""
    x = column(xi, "xi")
    return np.column_stack([30.0 * np.sin(x / 20.0), 30.0 * np.tanh(x / 20.0)])


def paper_covariance(xi: ArrayLike, reading: Reading = "bell") -> Floats:
    """Covariance (n, 2, 2) of eq. (14): ``diag(s(xi), xi + 150)``.

    Parameters
    ----------
    xi : array_like of shape (n,) or (n, 1)
        Inputs above -150, where the variances are positive; the paper uses -100 to 100.
    reading : {"bell", "printed", "bowl"}, default="bell"
        The paper prints s as ``150 exp(-xi/50)^2``, which can be read as ``150 exp(-(xi/50)^2)`` ("bell"),
        as ``150 (exp(-xi/50))^2`` ("printed"), or with the sign inside the square, ``150 exp((xi/50)^2)``
        ("bowl"). The paper's Table I fits "bell" and "printed", and rules "bowl" out.
    """
    checks.choice(reading, "reading", Reading)
    x = column(xi, "xi")
    checks.require(x > -150.0, x, "xi", "above -150", "eq. (14) has a variance of xi + 150")
    exponent = {"printed": -2.0 * x / 50.0, "bell": -((x / 50.0) ** 2), "bowl": (x / 50.0) ** 2}[reading]
    covariance = np.zeros((len(x), 2, 2))
    covariance[:, 0, 0] = 150.0 * np.exp(exponent)
    covariance[:, 1, 1] = x + 150.0
    return covariance


def make_paper_simulation(
    n_inputs: int = 10, n_demos: int = 50, *, reading: Reading = "bell", random_state: Seed = None
) -> tuple[Floats, Floats, NDArray[np.intp]]:
    """Draws from eq. (14), independent of each other, at inputs evenly spaced over [-100, 100].

    Parameters
    ----------
    n_inputs : int, default=10
    n_demos : int, default=50
        Number of draws at each input.
    reading : {"bell", "printed", "bowl"}, default="bell"
        Reading of eq. (14), see `paper_covariance`.
    random_state : int, Generator, RandomState or None, default=None

    Returns
    -------
    X, y, groups : ndarray of shape (n, 1), (n, 2) and (n,), n = n_inputs * n_demos
        Inputs, which repeat exactly, draws and their indices, demonstration by demonstration.
    """
    n = checks.count(n_inputs, "n_inputs") * checks.count(n_demos, "n_demos")
    require_much(80.0 * n, what=f"n_inputs={n_inputs}, n_demos={n_demos}", remedy="Make fewer.")
    xi = np.linspace(-100.0, 100.0, n_inputs)
    scale = np.sqrt(np.diagonal(paper_covariance(xi, reading), axis1=1, axis2=2))
    y = paper_mean(xi) + scale * generator(random_state).normal(size=(n_demos, n_inputs, 2))
    return np.tile(xi, n_demos)[:, np.newaxis], y.reshape(-1, 2), np.repeat(np.arange(n_demos), n_inputs)


def tunnel_center(y: ArrayLike) -> Floats:
    """Centre line of the tunnel: x in m at y in m, one period of a 2 cm sine over the path of 0.6 m."""
    return 0.02 * np.sin(2.0 * np.pi * checks.real_floats(y, "y") / PATH_LENGTH)


def tunnel_half_width(y: ArrayLike) -> Floats:
    """Half the width of the tunnel in m at y in m: 12 cm up to y = 0.2, 1 cm from y = 0.45, a smoothstep between."""
    s = np.clip((checks.real_floats(y, "y") - 0.2) / 0.25, 0.0, 1.0)
    return 0.12 - 0.11 * s**2 * (3.0 - 2.0 * s)


def make_tunnel_demonstrations(
    n_demos: int = 6,
    duration: float = 10.0,
    rate: float = 100.0,
    *,
    random_state: Seed = None,
    variant: Variant = "plain",
    common_start: bool = False,
    common_goal: bool = False,
) -> Demonstrations:
    """Demonstrations, x and y in m, of a hand in a narrowing tunnel: free where it is wide, precise where it is narrow.

    The hand moves along y at constant speed over 0.6 m. Across, it is at ``tunnel_center(y) + 0.85
    tunnel_half_width(y) tanh(lane + 0.12 w(t) + 0.04 c(t))`` with a lane drawn uniformly from [-0.6, 0.6] for each
    demonstration, w wandering (up to 0.25 Hz) and c correcting (0.25 to 1 Hz) with unit variance. A tremor in x (0.1 mm
    rms, 8 to 12 Hz), noise in y (2 um rms) and quantization to 5 um are added. The standard deviation of x over
    demonstrations is 35 mm at the start and 2.9 mm at the end.

    Parameters
    ----------
    n_demos : int, default=6
    duration, rate : float, default=10.0 and 100.0
        Duration of each demonstration in s, and sampling rate in Hz.
    random_state : int, Generator, RandomState or None, default=None
    variant : str, default="plain"
        - "plain": aligned;
        - "unequal": each demonstration takes 0.8 to 1.25 times ``duration``;
        - "dropped": each sample but the ends is lost with a probability of 0.1;
        - "jitter": each sample but the ends is taken up to 20 % of a step early or late;
        - "outlier": the last demonstration leaves the tunnel, by 10 cm where it is narrow;
        - "two_path": lanes keep to one side or the other, 0.4 to 0.6 from the middle, in equal numbers.
    common_start, common_goal : bool, default=False
        Whether all start, or end, on the centre line, with a minimum-jerk blend from and to their lanes in the first
        and the last 15 % of the duration.
    """
    checks.choice(variant, "variant", Variant)
    check_recording(n_demos, duration, rate, least_steps=0.5)
    random = generator(random_state)
    lanes = random.uniform(-0.6, 0.6, size=n_demos)
    if variant == "two_path":
        # As many on either side; the lanes, 0 to 0.6 from the middle, go to 0.4 to 0.6.
        lanes = random.permutation(np.where(np.arange(n_demos) % 2, 1.0, -1.0)) * (0.4 + np.abs(lanes) / 3.0)
    times, positions = [], []
    for lane in lanes:
        lasting = duration * random.uniform(0.8, 1.25) if variant == "unequal" else duration
        time = np.arange(max(1, round(lasting * rate)) + 1) / rate
        if variant == "dropped":
            kept = random.uniform(size=len(time)) >= 0.1
            kept[[0, -1]] = True
            time = time[kept]
        if variant == "jitter":
            time[1:-1] += random.uniform(-0.2, 0.2, size=len(time) - 2) / rate
        bands = ((0.0, 0.25), (0.25, 1.0), (8.0, 12.0))
        wander, correction, tremor = (band_noise(time, low, high, random) for low, high in bands)
        # The lane is between the walls, whatever its noise adds: tanh keeps it within 0.85 of the half-width.
        along = PATH_LENGTH * time / lasting
        across = _WITHIN * tunnel_half_width(along) * np.tanh(lane + _WANDER * wander + _CORRECTION * correction)
        x = tunnel_center(along) + across * _blend(along, common_start, common_goal) + _TREMOR * tremor
        times.append(time)
        positions.append(np.column_stack([x, along + _NOISE * random.normal(size=len(time))]))
    if variant == "outlier":
        positions[-1][:, 0] += 0.1 * np.exp(-(((positions[-1][:, 1] - 0.5) / 0.05) ** 2))
    quantized = [np.round(position / _QUANTUM) * _QUANTUM for position in positions]
    return Demonstrations(times, quantized, names=("x", "y"), units="m")


def _blend(along: Floats, common_start: bool, common_goal: bool) -> Floats:
    """Weight of the lanes near common ends, by minimum jerk (Flash, Hogan 1985)."""
    result = np.ones_like(along)
    for distance in [along] * bool(common_start) + [PATH_LENGTH - along] * bool(common_goal):
        s = np.clip(distance / (_BLENDED * PATH_LENGTH), 0.0, 1.0)
        result = result * (s**3 * (10.0 - 15.0 * s + 6.0 * s**2))
    return result


def check_recording(n_demos: int, duration: float, rate: float, timing: float = 0.0, least_steps: float = 2.0) -> None:
    """Check the number, duration and sampling of synthetic demonstrations."""
    checks.count(n_demos, "n_demos")
    checks.number(duration, "duration", above=0.0, unit="s")
    checks.number(rate, "rate", above=0.0, unit="Hz")
    checks.number(timing, "timing", least=0.0, below=0.5)
    checks.number(duration * rate, "duration * rate, the number of steps,", least=least_steps)
    require_much(400.0 * n_demos * duration * rate, what=f"n_demos={n_demos}", remedy="Make fewer samples.")


def band_noise(time: Floats, low: float, high: float, random: Random) -> Floats:
    """Stationary noise of unit variance with frequencies between ``low`` and ``high``, in Hz.

    A sum of cosines with random frequencies and phases, which is exact at any times, evenly spaced or not
    (spectral representation: M. Shinozuka, G. Deodatis, Applied Mechanics Reviews 44, 1991).
    """
    frequency = random.uniform(low, high, size=_N_WAVES)
    shift = random.uniform(0.0, 2.0 * np.pi, size=_N_WAVES)
    return np.sqrt(2.0 / _N_WAVES) * np.cos(2.0 * np.pi * np.outer(time, frequency) + shift).sum(axis=1)


def generator(random_state: Seed) -> Random:
    """Random generator of a seed; a Generator is returned unchanged."""
    return random_state if isinstance(random_state, np.random.Generator) else checks.seed(random_state)


def column(values: ArrayLike, name: str) -> Floats:
    """Inputs as (n,), from (n,) or (n, 1)."""
    x = checks.real_floats(values, name)
    return checks.array(x.reshape(-1, 1) if x.ndim < 2 else x, name, ("n", 1))[:, 0]

"""Movements of unknown duration and pace, as mixtures of models of phase over both."""

import copy
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import Akima1DInterpolator
from torch import Tensor

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.console import say
from torch_pbd.data.alignment import interpolate
from torch_pbd.data.demonstrations import Demonstration
from torch_pbd.linalg import log_density, safe_cholesky
from torch_pbd.movement.base import MovementRegressor
from torch_pbd.movement.law import Known, check_arrays
from torch_pbd.movement.timing import Likelihood, Nodes, Timing, phases, register, time_of

_FEWEST = 4  # demonstrations needed to estimate how duration and pace vary together
_N_STEPS = 100  # steps of a curve whose pace is estimated
# Samples per movement from which its timing is estimated. Nearer ones repeat each other except for their smoothness,
# which the law hardly models: with 25 and 50 the posterior was two and three times too narrow.
_SEEN = 12.0
_MOST_FOLDS = 5
_SLACK = 1e-3  # share of a duration: where all last equally long, rounding may put the last sample later
# Most steps on which the correlation is learned: the nuggets' iterations are cubic in them, and movements are smooth.
_MOST_STEPS = 200
_GAP = 2.0  # sample spacings of a recording: a step farther than that from its samples counts as missing
_TOO_CLOSE = 0.1  # sample spacings: of two samples nearer than that the noise, over the time between them, is a slope


class TimedMovement(MovementRegressor):
    """Base of models whose law is over phase and whose input is time, where ``timing`` is not "none"."""

    regressor: Any
    timing: str
    timing_: str
    timing_gain_: float
    _timing: Any = None  # the Timing of movements; None where the law is over the input itself
    _nodes: Nodes  # posterior of duration and pace
    _predicted: tuple[Floats, Floats, Floats] | None = None  # increasing inputs, and the regressor's moments there

    def predict_phase(self, X: ArrayLike) -> tuple[Floats, Floats]:
        """Phase of the movement at times X, estimated from the observations of :meth:`condition`.

        Parameters
        ----------
        X : array-like of shape (n_samples, 1)
            Times since the start of the movement, whose timing must not be "none".

        Returns
        -------
        mean, std : ndarray of shape (n_samples,)
            Mean and standard deviation of the phase, which is 0 at the start and 1 from the end on.
        """
        time = self._times(X)
        if self._timing is None:
            raise checks.refusal(self.timing, "timing", "'warp' or 'auto' where phases are to be estimated")
        weight, phase = self._nodes.weight.numpy(), phases(torch.from_numpy(time), *self._nodes[:2]).numpy()
        mean = weight @ phase
        return mean, np.sqrt(weight @ np.square(phase - mean))

    def _times(self, X: ArrayLike) -> Floats:
        time = super()._times(X)
        if self._timing is not None and (time < -checks.ROUNDING).any():
            raise ValueError(f"X has a time of {time.min():.6g}, must be at least 0: count from the movement's start.")
        return time

    def condition(self, X: ArrayLike, y: ArrayLike, *, noise_scale: ArrayLike = 0.0) -> Self:
        """Fitted copy, conditioned on passing y at X; see ``MovementRegressor.condition``.

        With unknown timing, X is the time since the start of a movement that still runs at the last of them.
        """
        copied = super().condition(X, y, noise_scale=noise_scale)
        if copied._timing is not None:
            copied._locate(copied._timing)
        return copied

    def _locate(self, timing: Timing) -> None:
        """Find durations and paces given the observations, for movements of this timing."""
        self._timing, known = timing, self._known
        self._nodes = timing.posterior(self._log_likelihood(known), self._last(known.time))

    def _components(self, time: Floats) -> tuple[Floats, list[tuple[Self, Floats]]]:
        if self._timing is None:
            return super()._components(time)
        duration, pace, weight, _ = self._nodes
        return weight.numpy(), self._over_phase(time, duration, pace)

    def _over_phase(self, time: Floats, duration: Tensor, pace: Tensor) -> list[tuple[Self, Floats]]:
        """Laws over phase of movements of these durations and paces (b,), each with its phases at these times (n,)."""
        own, known = (phases(torch.from_numpy(part), duration, pace).numpy() for part in (time, self._known.time))
        laws = [copy.copy(self) for _ in known]
        # Once for all: the regressor takes about as long for some rows as for hundreds.
        at = np.unique(np.concatenate([own, known], axis=1))
        rows = at, *self._regressor_rows(at)
        for law, phase in zip(laws, known, strict=True):
            law._timing, law._known, law._predicted = None, self._known._replace(time=phase), rows
        return list(zip(laws, own, strict=True))

    def _score(self, time: Floats, position: Floats) -> float:
        if self._timing is None:
            return super()._score(time, position)
        before = self._log_likelihood(self._known)

        def exact(duration: Tensor, pace: Tensor) -> Tensor:
            scores = [law._score(own, position) for law, own in self._over_phase(time, duration, pace)]
            return before(duration, pace) + torch.tensor(scores, dtype=torch.float64)

        return self._log_density(self._known.and_also(time, position, np.zeros_like(position)), exact)

    def _log_density(self, whole: Known, exact: Likelihood | None = None, duration: float | None = None) -> float:
        """Log density of what goes beyond the observations: its mean over movements that run to the end of it."""
        last = self._last(whole.time)
        over = self._timing.posterior(self._log_likelihood(whole, duration), last, exact=exact).log_integral
        return float(over - self._timing.posterior(self._log_likelihood(self._known), last).log_integral)

    def _last(self, time: Floats) -> float:
        last, longest = float(time.max(initial=0.0)), self._timing.longest()
        if last > (1.0 + _SLACK) * longest:
            raise ValueError(
                f"X reaches {last:.6g}, must be at most {longest:.6g}: no movement like those shown lasts longer. "
                "Leave out what comes after its end."
            )
        return min(last, longest)

    def _log_likelihood(self, known: Known, duration: float | None = None) -> Likelihood:
        """Log density of what is known, at samples a twelfth of a movement apart, given durations and paces."""
        rows = _spread(known.time, duration or float(self._timing.location[0].exp()))
        time, value, noise = (torch.from_numpy(each[rows]) for each in known)
        given = ~value.flatten().isnan()
        if not bool(given.any()):
            return lambda duration, _: torch.zeros_like(duration)

        def log_likelihood(duration: Tensor, pace: Tensor) -> Tensor:
            phase = phases(time, duration, pace)
            mean, covariance = map(torch.from_numpy, self._regressor_rows(phase.flatten().numpy()))
            mean, whole = mean.reshape(len(phase), -1), self.module_.covariances(phase, covariance)
            whole = whole[:, given][:, :, given] + torch.diag(noise.square().flatten()[given])
            root = safe_cholesky(whole, name="the covariance of what is known")
            return log_density(value.flatten()[given] - mean[:, given], root, torch.full_like(duration, self.df_))

        return log_likelihood

    def _timed(self, recordings: list[Demonstration]) -> list[Demonstration]:
        """Recordings over the input of the law, once it is decided whether their timing varies."""
        self._timing, self.timing_ = None, self.timing
        if self.timing == "none":
            return recordings
        fewest = _FEWEST + (self.timing == "auto")
        if len(recordings) < fewest:
            raise ValueError(
                f"groups has {len(recordings)} demonstrations, must have {fewest} or more to learn how timing varies: "
                "record more, or take timing='none'."
            )
        if self.timing == "auto":
            self.timing_gain_ = self._gain(recordings)
            self.timing_ = "warp" if self.timing_gain_ > 0.0 else "none"
            if getattr(self.regressor, "verbose", 0):
                say(f"timing: a warp gains {self.timing_gain_:.3g} nats a step, taken is {self.timing_!r}")
        return self._phased(recordings, self.timing_)

    def _phased(self, recordings: list[Demonstration], timing: str) -> list[Demonstration]:
        """Recordings over phase, after their timing was learned."""
        first, duration = (np.array([recording.time[i] for recording in recordings]) for i in (0, -1))
        good = (first >= 0.0) & (first < 0.5 * duration)
        checks.require(good, first, "the first time of a demonstration", "0 or a little later", "count from its start")
        durations, pace = torch.from_numpy(duration), torch.zeros(len(duration), dtype=torch.float64)
        # Without a warp all movements take the mean duration, at an even pace.
        mean = Timing(torch.stack([durations.mean().log(), pace[0]]), torch.zeros(2, 2).to(pace), 1.0)
        if timing == "warp":
            grid = np.linspace(0.0, 1.0, _N_STEPS)
            curves = np.stack([interpolate(time, position, grid * time[-1]) for time, position in recordings])
            size = curves.std((0, 1))
            pace = register(torch.from_numpy(curves / np.where(size > 0.0, size, 1.0)))
        self._locate(Timing.learn(durations, pace) if timing == "warp" else mean)
        # On shared phases, as if the demonstrations were aligned.
        shared = np.linspace(0.0, 1.0, n_grid_steps(recordings))
        phased = []
        for (time, position), own in zip(recordings, pace, strict=True):
            at = time[-1] * time_of(torch.from_numpy(shared), own).numpy()
            seen = _is_near(time, at)
            phased.append(Demonstration(shared[seen], interpolate(time, position, at[seen])))
        return phased

    def _gain(self, recordings: list[Demonstration]) -> float:
        """Gain of a warp over the mean duration at an even pace, in nats per step of left-out demonstrations.

        Steps are a twelfth of a movement apart, as long as the movement runs under both.
        """
        n_folds = min(_MOST_FOLDS, len(recordings))
        mean = float(np.mean([recording.time[-1] for recording in recordings]))
        gain, n_steps = 0.0, 0
        for fold in range(n_folds):
            train = [recording for number, recording in enumerate(recordings) if number % n_folds != fold]
            warp, none = copy.copy(self), copy.copy(self)
            for model, timing in ((warp, "warp"), (none, "none")):
                model._fit_law(model._phased(train, timing))
            for time, position in recordings[fold::n_folds]:
                seen = time <= min(mean, warp._timing.longest(), none._timing.longest())
                known = Known(time[seen], position[seen], np.zeros_like(position[seen]))
                gain += warp._log_density(known, duration=mean) - none._log_density(known, duration=mean)
                n_steps += len(_spread(known.time, mean))
        return gain / n_steps

    def _timing_arrays(self) -> dict[str, Floats]:
        """Arrays of the timing for model files; none where timing is "none"."""
        if self._timing is None:
            return {}
        numbers = vars(self._timing) | ({"gain": self.timing_gain_} if self.timing == "auto" else {})
        return {f"timing_{name}": np.asarray(value) for name, value in numbers.items()}

    def _restore_timing(self, arrays: dict[str, Floats]) -> dict[str, Floats]:
        """Restore the timing from the arrays of a model file, and return the others."""
        self.timing_ = self.timing
        if self.timing == "none":
            return arrays
        own = {name.removeprefix("timing_"): arrays[name] for name in arrays if name.startswith("timing_")}
        shapes: dict[str, tuple[int | str, ...]] = {"location": (2,), "root": (2, 2), "df": ()}
        check_arrays(own, shapes | ({"gain": ()} if self.timing == "auto" else {}))
        checks.require(
            own["root"].diagonal() >= 0.0, own["root"].diagonal(), "the diagonal of timing_root", "at least 0"
        )
        df = checks.number(float(own["df"]), "timing_df", above=0.0)
        self._locate(Timing(torch.tensor(own["location"]), torch.tensor(own["root"]), df))
        if self.timing == "auto":
            self.timing_gain_, self.timing_ = float(own["gain"]), "warp" if own["gain"] > 0.0 else "none"
        return {name: array for name, array in arrays.items() if not name.startswith("timing_")}


def _spread(time: Floats, duration: float) -> NDArray[np.intp]:
    """Rows whose times are nearest to even ones, back from the last."""
    if not len(time):
        return np.empty(0, dtype=np.intp)
    even = np.arange(time.max(), time.min() - 0.5 * duration / _SEEN, -duration / _SEEN)
    return np.unique(np.abs(time[:, np.newaxis] - even).argmin(axis=0))


def n_grid_steps(recordings: list[Demonstration]) -> int:
    """Steps of the grid on which recordings are compared: their median number of samples, at most 200."""
    return max(2, min(_MOST_STEPS, round(float(np.median([len(recording.time) for recording in recordings])))))


def sampled(recording: Demonstration, grid: Floats) -> Floats:
    """Values of a recording at the steps of a grid, NaN where no sample is near.

    Chords between samples would be off by more than the noise where recordings have times of their own, and a spline
    would carry the noise of two samples that are close on to where they are far apart: Akima's polynomials are local.
    """
    time, position = recording
    close, kept = _TOO_CLOSE * np.median(np.diff(time)), [0]
    for number, each in enumerate(time.tolist()):
        if each - time[kept[-1]] > close:
            kept.append(number)
    kept[-1] = len(time) - 1  # nothing is extrapolated
    values = Akima1DInterpolator(time[kept], position[kept])(grid.clip(time[0], time[-1]))
    return np.where(_is_near(time, grid)[:, np.newaxis], values, np.nan)


def _is_near(time: Floats, grid: Floats) -> NDArray[np.bool_]:
    """Whether a sample is near each step of a grid."""
    right = np.clip(np.searchsorted(time, grid), 1, len(time) - 1)
    nearest = np.minimum(np.abs(grid - time[right - 1]), np.abs(time[right] - grid))
    return np.asarray(nearest <= _GAP * np.median(np.diff(time)))

"""Movements of unknown duration and pace, as mixtures of models of phase over both."""

import copy
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.console import say
from torch_pbd.linalg import safe_cholesky, student_log_density
from torch_pbd.movement.base import MovementRegressor
from torch_pbd.movement.law import Known, Recording
from torch_pbd.movement.timing import Likelihood, Nodes, Timing, phase_of, register, time_of

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


class TimedMovement(MovementRegressor):
    """Base of models whose law is over phase and whose input is time, where ``timing`` is not "none"."""

    regressor: Any
    timing: str
    timing_: str
    timing_gain_: float
    _timing: Timing | None = None
    _nodes: Nodes  # posterior of duration and pace

    def predict_phase(self, X: ArrayLike) -> tuple[Floats, Floats]:
        """Phase of the movement at times X, estimated from the observations of :meth:`condition`.

        Parameters
        ----------
        X : array-like of shape (n_samples, 1)
            Times since the start of the movement.

        Returns
        -------
        mean, std : ndarray of shape (n_samples,)
            Mean and standard deviation of the phase, which is 0 at the start and 1 from the end on.

        Raises
        ------
        ValueError
            If timing is "none".
        """
        time = self._times(X)
        if self._timing is None:
            raise checks.refusal(self.timing, "timing", "'warp' or 'auto' where phases are to be estimated")
        weight, phases = self._nodes.weight.numpy(), self._nodes.phases(torch.from_numpy(time)).numpy()
        mean = weight @ phases
        return mean, np.sqrt(weight @ np.square(phases - mean))

    def condition(self, X: ArrayLike, y: ArrayLike, *, noise_scale: ArrayLike = 0.0) -> Self:
        """Fitted copy, conditioned on passing y at X; see ``MovementRegressor.condition``.

        With unknown timing, X is the time since the start of a movement that still runs at the last of them.
        """
        copied = super().condition(X, y, noise_scale=noise_scale)
        if copied._timing is not None:
            known = copied._known
            copied._nodes = copied._timing.posterior(copied._log_likelihood(known), copied._last(known.time))
        return copied

    def _components(self, time: Floats) -> tuple[Floats, list[tuple[Self, Floats]]]:
        """Weights of durations and paces, with the law over phase and the phases of these times for each."""
        if self._timing is None:
            return super()._components(time)
        nodes = self._nodes
        laws = [self._over_phase(*node) for node in zip(nodes.duration, nodes.pace, strict=True)]
        phases = nodes.phases(torch.from_numpy(time)).numpy()
        return nodes.weight.numpy(), list(zip(laws, phases, strict=True))

    def _over_phase(self, duration: Tensor, pace: Tensor) -> Self:
        """Law over phase, of a movement of this duration and pace."""
        law = copy.copy(self)
        law._timing = None
        phase = phase_of(torch.from_numpy(self._known.time) / duration, pace).numpy()
        law._known = self._known._replace(time=phase)
        return law

    def _score(self, time: Floats, position: Floats) -> float:
        """Log of the mean density over the posterior, restricted to movements that still run."""
        if self._timing is None:
            return super()._score(time, position)
        whole = self._known.and_also(time, position, np.zeros_like(position))
        before = self._log_likelihood(self._known)

        def exact(duration: Tensor, pace: Tensor) -> Tensor:
            laws = [self._over_phase(*node) for node in zip(duration, pace, strict=True)]
            phases = phase_of(torch.from_numpy(time) / duration[:, None], pace[:, None]).numpy()
            scores = [law._score(own, position) for law, own in zip(laws, phases, strict=True)]
            return before(duration, pace) + torch.tensor(scores, dtype=torch.float64)

        return self._log_ratio(self._log_likelihood(whole), before, self._last(whole.time), exact)

    def _log_ratio(self, above: Likelihood, below: Likelihood, last: float, exact: Likelihood | None = None) -> float:
        """Log of the ratio of two mean likelihoods of movements that run at the time ``last``."""
        assert self._timing is not None
        over = self._timing.posterior(above, last, exact=exact).log_integral
        return over - self._timing.posterior(below, last).log_integral

    def _last(self, time: Floats) -> float:
        assert self._timing is not None
        last, longest = float(time.max(initial=0.0)), self._timing.longest()
        if last > (1.0 + _SLACK) * longest:
            raise ValueError(
                f"X reaches {last:.6g}, must be at most {longest:.6g}: no movement like those shown lasts longer. "
                "Leave out what comes after its end."
            )
        return min(last, longest)

    def _log_likelihood(self, known: Known) -> Likelihood:
        """Log density of what is known, at samples a twelfth of a movement apart, given durations and paces."""
        assert self._timing is not None
        rows = _spread(known.time, float(self._timing.location[0].exp()))
        time, value, noise = (torch.from_numpy(each[rows]) for each in known)
        given = ~value.flatten().isnan()
        if not bool(given.any()):
            return _flat

        def log_likelihood(duration: Tensor, pace: Tensor) -> Tensor:
            phases = phase_of(time / duration[:, None], pace[:, None])
            law = self._prior(phases.flatten().numpy())
            steps = torch.arange(phases.numel()).reshape(phases.shape)
            mean = law.mean[steps].flatten(1)[:, given]
            size = steps.shape[1] * law.mean.shape[1]
            whole = torch.stack([law.at(own).covariance().reshape(size, size) for own in steps])
            whole = whole[:, given][:, :, given] + torch.diag(noise.square().flatten()[given])
            root = safe_cholesky(whole, name="the covariance of what is known")
            degrees = torch.full_like(duration, self.df_)
            return student_log_density(value.flatten()[given] - mean, root, degrees)

        return log_likelihood

    def _timed(self, recordings: list[Recording]) -> list[Recording]:
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

    def _phased(self, recordings: list[Recording], timing: str) -> list[Recording]:
        """Recordings over phase, after their timing was learned."""
        first, duration = (np.array([recording.time[i] for recording in recordings]) for i in (0, -1))
        good = (first >= 0.0) & (first < 0.5 * duration)
        checks.require(good, first, "the first time of a demonstration", "0 or a little later", "count from its start")
        durations, pace = torch.from_numpy(duration), torch.zeros(len(duration), dtype=torch.float64)
        if timing == "warp":
            grid = np.linspace(0.0, 1.0, _N_STEPS)
            curves = np.stack([
                np.stack([np.interp(grid * time[-1], time, column) for column in position.T], axis=1)
                for time, position in recordings
            ])  # fmt: skip
            size = curves.std((0, 1))
            pace = register(torch.from_numpy(curves / np.where(size > 0.0, size, 1.0)))
        self._set_timing(Timing.learn(durations, pace) if timing == "warp" else Timing.even(durations))
        # On shared phases, as if the demonstrations were aligned.
        shared = np.linspace(0.0, 1.0, n_grid_steps(recordings))
        phased = []
        for (time, position), own in zip(recordings, pace, strict=True):
            values = sampled(Recording(time / time[-1], position), time_of(torch.from_numpy(shared), own).numpy())
            seen = ~np.isnan(values).any(axis=1)
            phased.append(Recording(shared[seen], values[seen]))
        return phased

    def _set_timing(self, timing: Timing) -> None:
        self._timing, self._nodes = timing, timing.posterior(_flat)

    def _gain(self, recordings: list[Recording]) -> float:
        """Gain of a warp over the mean duration at an even pace, in nats per step of left-out demonstrations.

        Steps are a twelfth of a movement apart, as long as the movement runs under both.
        """
        n_folds, mean = min(_MOST_FOLDS, len(recordings)), np.mean([recording.time[-1] for recording in recordings])
        gain, n_steps = 0.0, 0
        for fold in range(n_folds):
            train = [recording for number, recording in enumerate(recordings) if number % n_folds != fold]
            models: list[Any] = [copy.copy(self), copy.copy(self)]
            warp, none = models
            for model, timing in zip(models, ("warp", "none"), strict=True):
                model._fit_law(model._phased(train, timing))
            for time, position in recordings[fold::n_folds]:
                seen = time <= min(mean, warp._timing.longest(), none._timing.longest())
                known = Known(time[seen], position[seen], np.zeros_like(position[seen]))
                own, other = (m._log_ratio(m._log_likelihood(known), _flat, time[seen][-1]) for m in models)
                gain += own - other
                n_steps += len(_spread(known.time, float(mean)))
        return gain / n_steps

    def _timing_arrays(self) -> dict[str, Floats]:
        """Arrays of the timing for model files; none where timing is "none"."""
        if self._timing is None:
            return {}
        arrays = {name: np.asarray(getattr(self._timing, name)) for name in ("location", "root", "df")}
        arrays |= {"gain": np.array(self.timing_gain_)} if self.timing == "auto" else {}
        return {f"timing_{name}": array for name, array in arrays.items()}

    def _restore_timing(self, arrays: dict[str, Floats]) -> dict[str, Floats]:
        """Restore the timing from the arrays of a model file, and return the others."""
        self.timing_ = self.timing
        if self.timing == "none":
            return arrays
        shapes: dict[str, tuple[int, ...]] = {"location": (2,), "root": (2, 2), "df": ()}
        shapes |= {"gain": ()} if self.timing == "auto" else {}
        own = {n: checks.array(arrays.get(f"timing_{n}"), f"timing_{n}", shape).copy() for n, shape in shapes.items()}
        root = own["root"]
        checks.require((root >= 0.0) | ~np.eye(2, dtype=bool), root, "timing_root", "at least 0 on its diagonal")
        df = checks.number(float(own["df"]), "timing_df", above=0.0)
        self._set_timing(Timing(torch.from_numpy(own["location"]), torch.from_numpy(root), df))
        if "gain" in own:
            self.timing_gain_ = float(own["gain"])
            self.timing_ = "warp" if self.timing_gain_ > 0.0 else "none"
        return {name: array for name, array in arrays.items() if not name.startswith("timing_")}


def _flat(duration: Tensor, pace: Tensor) -> Tensor:
    return torch.zeros_like(duration)


def _spread(time: Floats, duration: float) -> NDArray[np.intp]:
    """Rows whose times are nearest to even ones, back from the last."""
    if not len(time):
        return np.empty(0, dtype=np.intp)
    even = np.arange(time.max(), time.min() - 0.5 * duration / _SEEN, -duration / _SEEN)
    return np.unique(np.abs(time[:, np.newaxis] - even).argmin(axis=0))


def n_grid_steps(recordings: list[Recording]) -> int:
    """Steps of the grid on which recordings are compared: their median number of samples, at most 200."""
    return max(2, min(_MOST_STEPS, round(float(np.median([len(recording.time) for recording in recordings])))))


def sampled(recording: Recording, grid: Floats) -> Floats:
    """Positions of a recording at the steps of a grid, linear between samples; NaN where no sample is near."""
    time, position = recording
    columns = [np.interp(grid, time, column) for column in position.T]
    right = np.clip(np.searchsorted(time, grid), 1, len(time) - 1)
    nearest = np.minimum(np.abs(grid - time[right - 1]), np.abs(time[right] - grid))
    seen = nearest <= _GAP * np.median(np.diff(time))
    return np.where(seen[:, np.newaxis], np.stack(columns, axis=1), np.nan)

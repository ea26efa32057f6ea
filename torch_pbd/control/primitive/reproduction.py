"""Reproduction of the demonstrations' mean movement by a movement primitive."""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike
from scipy.interpolate import CubicHermiteSpline, PPoly
from torch import Tensor

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.control.primitive.dmp import DMP, adapt
from torch_pbd.control.primitive.smoothing import CUTOFF_HZ, Movements, check_range
from torch_pbd.data.units import TIMES
from torch_pbd.estimators.door import Standardization
from torch_pbd.gp.evidence import EvidenceSearch
from torch_pbd.gp.observations import Observations, condition
from torch_pbd.gp.search import fit_together

# Ticks within the duration: with forcing that is linear between them eq. (16) reproduces 10 s to 1e-6 m.
_TICKS = 4000
_FAR = 0.01  # reproduction error as a share of the movement's extent above which a warning is raised
# Time constants after the end at which an additive movement is at rest: exp(-20) is 2e-9 of what it was.
_SETTLE = 20.0
_BRAKE = 0.2  # largest share of the duration for braking a movement that was cut
# Of the largest speed, the last in m/s and rad/s. Who cuts more than 6 % of a minimum jerk has a tenth of its largest
# there. Movements that keep above half of their largest are meant to pass, and a robot stops 0.1 m/s within 1 mm at
# 5 m/s^2, and 0.3 rad/s within 0.3 degrees at 10 rad/s^2.
_CUT, _STEADY, _STOPPED = 0.1, 0.5, (0.1, 0.3)
_BRIEFEST = 1e-100  # s: squares of what is briefer, or of its inverse, are no numbers
_CYCLES = 0.01, 1e6  # bounds of the cutoff in cycles per movement: fewer give a line, more do not smooth
# Time constants in a movement. A reach of 0.6 m is reproduced to 0.1 mm with 1e10 of alpha; rounding of the spring's
# force moves it by 41 mm with 1e13, and out of its range with 1e16; so does the forcing, integrated twice, with 0.01.
# With 0.02 of alpha, or 0.01 of the gamma of a gate, an additive movement is at rest a hundred durations late.
_CONSTANTS, _GATE_CONSTANTS = (0.02, 1e12), (0.01, math.inf)
# The phase must tell times apart: exp(-30) is 1e-13, and 1e-6 leaves ten digits. Its logarithm is time in other units.
_DECAY = {"s": (1e-6, 30.0), "log_s": (1e-6, 1e12)}


@dataclass(eq=False)
class Reproduction:
    """Movement primitive with its forcing, and the motion that follows from them.

    From ``start`` (d,) with ``velocity`` (d,) to ``goal`` (d,), by the ``forcing`` (m, d), which is linear between even
    times from 0 to the duration, held after it, and was learned over what ``phase_input`` says. With ``own_goals`` the
    goal in eq. (18) is the end of each movement, else the common one. ``blocks`` of outputs share a unit. The ``bend``
    is what observations add to the motion, over movement time, after it was adapted to a start and a goal.
    """

    dmp: DMP
    phase_input: str
    own_goals: bool
    blocks: tuple[slice, ...]
    start: Floats
    velocity: Floats
    goal: Floats
    forcing: Floats
    bend: PPoly | None = None

    @classmethod
    def learn(cls, movements: Movements, *settings: Any, blocks: tuple[slice, ...], own_goals: bool) -> "Reproduction":
        """Fit the forcing of the mean movement, eq. (18), and tabulate it over the duration."""
        start, goal = movements.position[:, 0].mean(axis=0), movements.position[:, -1].mean(axis=0)
        ends = {"start": start, "velocity": movements.velocity[:, 0].mean(axis=0), "goal": goal}
        still = np.zeros((_TICKS + 1, len(goal)))
        known = cls(*settings, own_goals=own_goals, blocks=blocks, forcing=still, **ends)
        mean = known.forcing_of(movements).mean(axis=0)
        # Poses use the principal axes of each block, since outputs are learned one by one and frames must not matter.
        axes, deviation = np.eye(len(goal)), mean - mean.mean(axis=0)
        for own in blocks if len(blocks) > 1 else ():
            axes[own, own] = np.linalg.eigh(deviation[:, own].T @ deviation[:, own])[1]
        n_demos, inputs = len(movements.position), known.phase(movements.time)
        return replace(known, forcing=_process_mean(inputs, mean @ axes, n_demos, known.phase(known.time)) @ axes.T)

    @cached_property
    def time(self) -> Floats:
        """Times (m,) of the forcing."""
        return np.linspace(0.0, self.dmp.duration or 0.0, len(self.forcing))

    def phase(self, time: Floats) -> Floats:
        """Inputs (n, 1) of the regressors at movement times (n,): the phase, its logarithm, or the time itself."""
        if self.phase_input == "s":
            time = self.dmp.phase(time).numpy()
        elif self.phase_input == "log_s":
            time = -self.dmp.gamma * time / self.dmp.tau
        return time[:, np.newaxis]

    def time_of(self, phase: Floats) -> Floats:
        """Movement times (n,) of inputs (n,) of the regressors, the inverse of :meth:`phase`."""
        if self.phase_input not in _DECAY:
            return phase
        # The phase of what is long after the end may be zero.
        log_phase = np.log(phase.clip(np.finfo(float).tiny)) if self.phase_input == "s" else phase
        return -self.dmp.tau * log_phase / self.dmp.gamma

    def forcing_of(self, movements: Movements) -> Floats:
        """Forcing (K, n, d) that reproduces each movement, eq. (18)."""
        goal = movements.position[:, -1:] if self.own_goals else self.goal
        return self.dmp.forcing(movements.position, movements.velocity, movements.acceleration, goal).numpy()

    def check_against(self, movements: Movements) -> float:
        """Root mean square distance of positions from the mean as recorded, of which more than 1 % is told."""
        path, bounds, errors = self.motion(movements.time)[0], movements.bounds, []
        check_range(path, bounds, "The reproduced movement")
        for own, unit in zip(self.blocks, ("", " rad of rotation"), strict=False):
            mean = movements.recorded_mean[:, own]
            errors.append(error := float(np.sqrt(np.square(path[:, own] - mean).sum(axis=1).mean())))
            extent = float(np.linalg.norm(np.ptp(bounds[:, own], axis=0)))
            if error > _FAR * extent + checks.ROUNDING * float(np.abs(mean).max()):
                remedy = "phase_input='time'" if self.phase_input == "s" else "a higher cutoff, or more n_steps"
                checks.warn(
                    f"The reproduced movement is {error:.3g}{unit} off the mean of the demonstrations, "
                    f"{error / extent:.1%} of its extent: try {remedy}."
                )
        return errors[0]

    def warn_if_cut(self, metres: float) -> None:
        """Warn of a movement, in units of ``metres``, that was cut while moving: a robot at rest cannot follow."""
        velocity, parts = self._curve(self.time, 1), zip(("m/s", "rad/s"), (metres, 1.0), _STOPPED, strict=True)
        for own, (unit, scale, stopped) in zip(self.blocks, parts, strict=False):
            speed = scale * np.linalg.norm(velocity[:, own], axis=1)
            ends, largest = max(float(speed[0]), float(speed[-1])), float(speed.max())
            if ends > max(_CUT * largest, stopped) and speed.min() < _STEADY * largest:
                checks.warn(
                    f"The movement starts at {speed[0]:.3g} {unit} and ends at {speed[-1]:.3g} {unit}, where its "
                    f"largest is {largest:.3g}: the recordings were cut while moving. Record from rest to rest; else a "
                    "robot at rest needs a ramp at the start, and settle > 0 at the end."
                )

    def motion(self, time: Floats) -> Floats:
        """Position, velocity and acceleration (3, n, d) at any times (n,): at rest before 0, and long after the end."""
        path = _held(self._curve, time)
        return path if self.bend is None else path + _held(self.bend, time)

    @cached_property
    def _curve(self) -> CubicHermiteSpline:
        """Movement to the demonstrated goal, until it is at rest: exact at its ticks, and cubics between."""
        step, dmp, n_ticks = float(self.time[1]), self.dmp, len(self.time)
        if dmp.adaptation != "safe":
            slowest = max(2.0 * dmp.tau / dmp.alpha, dmp.tau / dmp.gamma if dmp.gate == "phase" else 0.0)
            n_ticks += int((_SETTLE * slowest + 0.1 * self.time[-1]) / step)
        ticks = np.arange(n_ticks)
        time, forcing = step * ticks, self.forcing[np.minimum(ticks, len(self.time) - 1)]
        run = dmp.rollout(forcing, step, goal=self.goal, position0=self.start, velocity0=self.velocity)
        positions, velocities = (part.numpy() for part in run)
        if dmp.adaptation == "safe":
            # What is left at the end is taken out by minimum jerk, as a change of the goal is.
            left, share = positions[-1] - self.goal, time[:, np.newaxis] / time[-1]
            positions -= left * share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
            velocities -= left * 30.0 * (share * (1.0 - share)) ** 2 / time[-1]
        return CubicHermiteSpline(time, positions, velocities, axis=0)

    def plan(self, time: Floats, goal: Floats | None, start: Floats | None, speed: float) -> tuple[Floats, Floats]:
        """Position, velocity and acceleration (3, n, d) at times (n,) from 0, and movement time (n,) of the gains.

        To goals (d,) or (n, d), from a start (d,), None for those demonstrated. With adaptation="safe" it brakes to
        rest at the end of the movement, if the times go on after it.
        """
        begin = self.start if start is None else start
        goals = np.broadcast_to(self.goal if goal is None else goal, (len(time), len(self.goal)))
        plan = self._safe if self.dmp.adaptation == "safe" else self._additive
        path, known = plan(speed * time, goals, begin, goal is not None or start is not None)
        return path * np.array([1.0, speed, speed**2])[:, np.newaxis, np.newaxis], known

    def _additive(self, passed: Floats, goals: Floats, start: Floats, changed: bool) -> tuple[Floats, Floats]:
        """Motion by movement time, and that of the gains; the primitive is solved with the other start and goals."""
        path = self.motion(passed)
        if changed:
            # The primitive is linear: another start and goal add its answer to their change alone.
            still, step = np.zeros(goals.shape), float(passed[1])
            run = self.dmp.rollout(still, step, goal=goals - self.goal, position0=start - self.start)
            answer = CubicHermiteSpline(step * np.arange(len(passed)), *(part.numpy() for part in run), axis=0)
            path = path + np.stack([answer(passed, order) for order in range(3)])
        return path, passed

    def _safe(self, passed: Floats, goals: Floats, start: Floats, changed: bool) -> tuple[Floats, Floats]:
        """Motion by movement time, adapted without a throw, and that of the gains."""
        *braked, known = self._braked(passed)
        path = _along(self._curve, *braked)
        if changed:
            whole = _tensor(self._curve(self.time)), _tensor(self.time)
            ends = {"own_goal": _tensor(self.goal), "goals": _tensor(goals), "start": _tensor(start)}
            path = adapt(_tensor(path), _tensor(passed), whole, **ends, duration=float(self.time[-1])).numpy()
        return path if self.bend is None else path + _along(self.bend, *braked), known

    def _braked(self, passed: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """Movement time (n,) that comes to rest at the end of the movement, its derivatives, and that of the gains.

        What was cut at a speed v stops on its own path, half before the end and half after it, in 1.5 v / a, which
        takes its own largest acceleration a; or in a fifth of the duration, or in what time there is, if that is less.
        """
        end, curve = float(self.time[-1]), self._curve
        bends, last = curve(self.time, 2), curve(end, 1)
        if self.bend is not None:
            bends, last = bends + self.bend(self.time, 2), last + self.bend(end, 1)
        largest = [max(float(np.linalg.norm(bends[:, own], axis=1).max()), np.finfo(float).tiny) for own in self.blocks]
        needed = max(
            1.5 * float(np.linalg.norm(last[own])) / most for own, most in zip(self.blocks, largest, strict=True)
        )
        brake = max(0.0, min(needed, _BRAKE * end, 2.0 * (float(passed[-1]) - end)))
        # The rate of movement time falls from 1 to 0 by a smooth step of u; the time moved is its integral,
        # brake (u - u^3 + u^4 / 2), half of the brake when it stands.
        late, is_brief = (passed - end) / end, brake <= checks.ROUNDING * end
        share = 1.0 * (late > checks.ROUNDING) if is_brief else np.clip(late * end / brake + 0.5, 0.0, 1.0)
        moved = np.minimum(passed, end - 0.5 * brake) + brake * (share - share**3 + 0.5 * share**4)
        rate = 1.0 - share**2 * (3.0 - 2.0 * share)
        slope = np.zeros(len(passed)) if is_brief else -6.0 * share * (1.0 - share) / brake
        return np.minimum(moved, end), rate, slope, np.maximum(moved, passed - 0.5 * brake)


def _along(curve: PPoly, moved: Floats, rate: Floats, slope: Floats) -> Floats:
    """Motion (3, n, d) along a curve whose own time (n,) moves at a rate (n,), which changes at a slope (n,)."""
    rate, slope, velocity = rate[:, np.newaxis], slope[:, np.newaxis], curve(moved, 1)
    return np.stack([curve(moved), velocity * rate, curve(moved, 2) * rate**2 + velocity * slope])


def _held(curve: PPoly, time: Floats) -> Floats:
    """Motion (3, n, d) along a curve at times (n,): at rest before its start and after its end."""
    within = np.clip(time, curve.x[0], curve.x[-1])
    return _along(curve, within, 1.0 * (within == time), np.zeros(len(time)))


def primitive(controller: Any) -> DMP:
    """Primitive of a controller, whose parameters are checked for its duration; a "safe" tau is that of 10 s."""
    duration, cutoff, phase_input = controller.duration_, controller.cutoff_, controller.phase_input
    checks.number(duration, "duration", least=_BRIEFEST, most=1.0 / _BRIEFEST, unit="s")
    if cutoff is not None and not _CYCLES[0] <= cutoff * duration <= _CYCLES[1]:
        # Where the automatic one too would be out of range, the times are in another unit than they say.
        suspect = controller.cutoff == "auto" or CUTOFF_HZ * duration > _CYCLES[1]
        units = f"the unit of the times is suspect, time_unit={controller.time_unit_!r} (known: {', '.join(TIMES)})"
        remedy = units if suspect else "leave it 'auto'"
        raise ValueError(
            f"cutoff is {cutoff:g} Hz, {cutoff * duration:.3g} cycles in a movement of {duration:.3g} s, must be "
            f"{_CYCLES[0]:g} to {_CYCLES[1]:g} of them: {remedy}."
        )
    beta = None if controller.beta is None else float(controller.beta)
    tau = float(controller.tau) * (duration / 10.0 if controller.adaptation == "safe" else 1.0)
    options = {"duration": duration, "gate": controller.gate, "adaptation": controller.adaptation}
    dmp = DMP(float(controller.alpha), beta, float(controller.gamma), tau, **options)
    ranges = [("alpha", dmp.alpha, _CONSTANTS), ("beta", math.sqrt(dmp.alpha) * math.sqrt(dmp.beta), (0.0, 1e12))]
    ranges += [("gamma", dmp.gamma, _GATE_CONSTANTS)] if dmp.gate == "phase" else []
    ranges += [("gamma", dmp.gamma, _DECAY[phase_input])] if phase_input != "time" else []
    for name, rate, (least, most) in ranges:
        constants = rate * duration / dmp.tau
        if not least <= constants <= most:
            raise ValueError(
                f"{name} is {getattr(dmp, name):g} and tau is {dmp.tau:g} s, {constants:.3g} time constants in a "
                f"movement of {duration:.3g} s, must be {least:g} to {most:g} of them with gate={dmp.gate!r}, "
                f"phase_input={phase_input!r}: leave them as they are by default."
            )
    return dmp


def _process_mean(X: Floats, forcing: Floats, n_demos: int, at: Floats) -> Floats:
    """Mean (m, d) at inputs ``at`` (m, 1) of Gaussian processes, eq. (5), through the mean forcing at X (n, 1).

    One process for each output, with hyperparameters by its evidence. Behind each mean are ``n_demos`` demonstrations.
    """
    scaling = Standardization.fit(X, forcing)
    targets = torch.tensor(scaling.outputs(forcing)).mT.contiguous()
    counts = torch.full((len(X),), float(n_demos), dtype=torch.float64)
    observations = Observations(torch.tensor(scaling.inputs(X)), targets, counts)
    # No length scale below what the knots resolve: it would be a needle at each of them.
    search = EvidenceSearch(length_scale_bounds=(min(0.5, 0.75 / len(X)), 10.0))
    (found,) = fit_together([(observations, search)])
    process, _ = condition(observations, found.hyperparameters, basis=found.basis)
    with torch.inference_mode():
        mean = process(torch.tensor(scaling.inputs(at))).numpy()
    return scaling.y_shift + scaling.y_scale * mean


def _tensor(values: ArrayLike) -> Tensor:
    return torch.tensor(np.asarray(values, dtype=np.float64, order="C"))

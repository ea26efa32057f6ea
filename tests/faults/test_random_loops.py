"""Stalls, clock steps, dead clocks, spikes and losses in random order: what the loop's command never does.

Numbers in the names are those of the list of faults that the project keeps.
"""

import math

import numpy as np
import pytest
from control.loops import as_schedule
from hypothesis import settings
from scipy.linalg import expm

from torch_pbd import DMPController, GMMBaseline, load_demonstrations
from torch_pbd.control.realtime import RealTimeAdmittance, TickStatus

STEP = 0.001
QUIET = 1600  # ticks at the end without faults, in which the robot comes back to the schedule


def random_schedule(rng):
    """Some 0.5 s of a motion that begins and ends anywhere, at any velocity; 50..1000 N/m along axes that turn."""
    d, n = int(rng.integers(1, 4)), int(rng.integers(200, 800))
    time = np.arange(n) * STEP
    frequency, phase = rng.uniform(1.0, 6.0, size=d), rng.uniform(0.0, 6.3, size=d)
    size, angle = 0.05 * rng.normal(size=d), np.outer(time, frequency) + phase
    values = 50.0 * 20.0 ** (0.5 + 0.5 * np.sin(np.outer(time, rng.uniform(0.5, 3.0, size=d)) + rng.uniform(0, 6, d)))
    generator = rng.normal(size=(d, d))
    turns = np.stack([expm(t * (generator - generator.T)) for t in time[::50]]).repeat(50, axis=0)[:n]
    stiffness, damping = (turns * gain[:, None, :] @ turns.mT for gain in (values, 2.0 * np.sqrt(values)))
    if rng.random() < 0.03:  # matrices that share no axes take a hundred times as long
        damping = damping + np.diag(10.0 * np.arange(d))
    gains = {"stiffness": 0.5 * (stiffness + stiffness.mT), "damping": 0.5 * (damping + damping.mT)}
    motion = {"position": size * np.sin(angle), "velocity": size * frequency * np.cos(angle)}
    return as_schedule(time, **motion, **gains)


class Loop:
    """A loop of 1 kHz that things go wrong in, and what the controller was told and commanded."""

    def __init__(self, rng, controller, n_ticks, push):
        self.rng, self.controller, self.push, self.n_ticks = rng, controller, push, n_ticks
        self.true = self.offset = self.told = 0.0
        self.status = TickStatus(0)
        self.n_dead = self.n_lost = self.n_spikes = 0
        self.dead = math.nan
        controller.start(0.0)
        self.trace = [(controller.position, controller.velocity)]
        self.acting, self.steps, self.starts, self.stalls = [], [], {}, []
        self.n_quiet = QUIET

    def run(self):
        i = -1
        while (i := i + 1) < self.n_ticks + self.n_quiet:
            # While the clock is wrong nobody can know of a stall.
            is_sound = i < self.n_ticks and not self.n_dead and TickStatus.CLOCK not in self.status
            self.tick(self.rng.random() if is_sound else 1.0, is_quiet=i > self.n_ticks)

    def tick(self, luck, *, is_quiet):
        step, jump = STEP, 0.0
        if luck < 0.003:  # a stall
            step = 10.0 ** self.rng.uniform(-2.0, 0.7)
        elif luck < 0.005:
            self.offset -= 10.0 ** self.rng.uniform(-2.9, 0.9)  # a smaller step is a shorter tick
        elif luck < 0.006:  # which no controller can tell from a stall
            jump = 10.0 ** self.rng.uniform(-2.0, 0.9)
        elif luck < 0.009:
            self.n_dead, self.dead = self.rng.integers(2, 15), self.rng.choice([math.nan, math.inf, self.told])
        elif luck < 0.012:
            self.n_lost = self.rng.integers(1, 16)
        elif luck < 0.015:
            self.n_spikes = self.rng.integers(1, 3)
        self.true, self.offset, step = self.true + step, self.offset + jump, step + jump
        self.n_dead = 0 if is_quiet else max(0, self.n_dead - 1)
        now = self.dead if self.n_dead else self.true + self.offset
        if not self.n_dead:
            step = now - self.told if 0.0 < now - self.told < step else step
            self.told = now
        self.status = self.controller.tick(now, self.force(is_quiet=is_quiet))
        if TickStatus.LATE in self.status:
            self.stalls.append(len(self.acting))
        self.steps.append(step)
        self.acting.append(self.controller.force)
        self.trace.append((self.controller.position, self.controller.velocity))
        is_at_rest = TickStatus.STOPPED in self.status and not any(self.controller.velocity)
        if is_at_rest and not is_quiet and self.rng.random() < 0.05:
            self.n_dead, self.told = 0, self.true + self.offset
            self.starts[len(self.acting)] = self.controller.schedule_time
            # From where a push has held it the robot approaches by minimum jerk, at 0.5 m/s at most.
            self.n_quiet = QUIET + round(1.875 * self.restart() / STEP)

    def restart(self):
        """Begin again from where the robot is; returns the time of its way at the speed of an approach."""
        here, goal = self.controller.position, self.controller.desired_position
        self.controller.start(self.told, here, at=self.controller.schedule_time)
        return math.dist(here, goal) / 0.5

    def force(self, *, is_quiet):
        push = self.push * (not is_quiet) * math.sin(2.0 * self.true) ** 2
        if self.n_lost and not is_quiet:
            self.n_lost -= 1
            return np.full(len(push), math.nan)
        if self.n_spikes and self.push.any():
            self.n_spikes -= 1
            return push + 180.0 / math.sqrt(len(push)) * self.rng.choice([-1.0, 1.0], size=len(push))
        return push

    def extremes(self):
        """Largest speed and acceleration, of velocities and of differences of positions."""
        positions, velocities = map(np.array, zip(*self.trace, strict=True))
        assert np.isfinite(positions).all()
        assert np.isfinite(velocities).all()
        steps = np.array(self.steps)[:, None]
        means, between = np.diff(positions, axis=0) / steps, 0.5 * (steps[1:] + steps[:-1])
        speed = max(np.linalg.norm(each, axis=1).max() for each in (velocities, means))
        changes = np.diff(velocities, axis=0) / steps, np.diff(means, axis=0) / between
        return speed, max(np.linalg.norm(each, axis=1).max() for each in changes)


def undisturbed(schedule, soft_start):
    """Largest acceleration of the command without any fault: where stiffness jumps, a robot that lags is pulled."""
    controller = RealTimeAdmittance(schedule, soft_start=soft_start)
    controller.start(0.0)
    velocities = [controller.velocity]
    for i in range(len(schedule) + 200):
        controller.tick((i + 1) * STEP, [0.0] * schedule.n_outputs)
        velocities.append(controller.velocity)
    return np.linalg.norm(np.diff(velocities, axis=0), axis=1).max() / STEP


def answer(schedule, forces, starts, stalls):
    """Largest speed and acceleration that the forces cause without faults, where nothing else moves.

    Also where it begins again when the loop did, at rest under a force that it stood against before: what follows is
    not what would without, and on release can be more (seed 1145). And where it rests for a moment when the loop was
    late: a robot that was pushed away then meets its spring without the velocity that had balanced it (seed 9705).
    """
    runs = [_answer(schedule, forces, *each) for each in (({}, []), (starts, []), (starts, stalls))]
    return [max(values) for values in zip(*runs, strict=True)]


def _answer(schedule, forces, starts, stalls):
    still = as_schedule(schedule.time, schedule.stiffness, schedule.damping)
    controller = RealTimeAdmittance(still, soft_start=0.0)  # without an approach, a start at a place keeps the spring
    controller.start(0.0)
    speeds, changes = [0.0], [0.0]
    for i, force in enumerate(forces):
        if i in starts:
            controller.start(i * STEP, at=starts[i])
        if i in stalls:
            controller.start(i * STEP, controller.position, at=controller.schedule_time)
        before = controller.velocity
        controller.tick((i + 1) * STEP, force)
        speeds.append(math.hypot(*controller.velocity))
        changes.append(math.dist(before, controller.velocity) / STEP)
    at_once = np.linalg.norm(forces, axis=1).max()  # on 1 kg, where it is there when the robot begins again
    return max(speeds), max(*changes, at_once)


# A run takes a tenth of a second. All 10,000: --hypothesis-profile=thorough.
ALL = 10_000 if settings.get_current_profile_name() == "thorough" else 300
# Approaches that were caught up in or outlasted the schedule, springs that pulled a robot after a stall, also where the
# schedule had gone on faster than the robot meanwhile, and catching up without what the robot overshoots by (9210).
ONCE_TOO_FAST = [391, 718, 738, 749, 1018, 1145, 1183, 1333, 4766, 9210, 9705, 9824]


@pytest.mark.parametrize(
    "seeds", [[*range(12), *ONCE_TOO_FAST], pytest.param(range(12, ALL), marks=pytest.mark.slow)], ids=["few", "all"]
)
def test_73_to_76_random_faults_keep_the_command_within_its_limits(seeds):
    stopped = 0
    for seed in seeds:
        rng = np.random.default_rng(seed)
        schedule, soft_start = random_schedule(rng), rng.uniform(0.2, 0.4)
        d = schedule.position.shape[1]
        push = rng.uniform(0.0, 20.0) * rng.normal(size=d) / math.sqrt(d) * (seed % 2)
        on_gap = "resume" if seed % 4 > 1 else "pause"
        loop = Loop(rng, RealTimeAdmittance(schedule, on_gap=on_gap, soft_start=soft_start), 800, push)
        loop.run()
        own_speed = np.linalg.norm(schedule.velocity, axis=1).max()
        own = np.linalg.norm(np.diff(schedule.velocity, axis=0), axis=1).max() / STEP
        soft = max(own_speed, 0.5) / soft_start  # what a soft start takes: 10 / sqrt(3) / (15 / 8) of it
        most = max(1.5 * own, 1.25 * own + soft, 3.0792 * soft, 5.0, undisturbed(schedule, soft_start))
        pushed = (loop.acting, loop.starts, loop.stalls)
        speed, acceleration = answer(schedule, *pushed) if push.any() else (0.0, 0.0)
        reached = loop.extremes()
        assert reached[0] <= 1.5 * own_speed + 0.5 * 1.1 + speed, f"seed {seed}: speed"
        assert reached[1] <= (most + acceleration) * (1 + 1e-6), f"seed {seed}: acceleration"
        controller = loop.controller
        if controller.tick(loop.told + STEP, [0.0] * d) & TickStatus.STOPPED:
            stopped += 1
            assert math.hypot(*controller.velocity) <= 1e-9, f"seed {seed}: stopped, but moves"
        else:
            assert math.dist(controller.position, schedule.position[-1]) <= 0.003, f"seed {seed}: not back"
    assert 0 < stopped < len(seeds)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["kuka_cube_pick", "kuka_cshape_top", "handwriting_fda", "letter_A", "adroit_door_palm"]
)
@pytest.mark.filterwarnings("ignore")  # of the fits: how many demonstrations, their units
def test_73_74_recordings_that_were_cut_while_moving_are_begun_and_ended_within_limits(name, recordings):
    fitted = DMPController(GMMBaseline()).fit(load_demonstrations(recordings / f"{name}.npz"))
    schedule = fitted.schedule(rate=1000.0)
    own_speed = np.linalg.norm(schedule.velocity, axis=1).max()
    own = np.linalg.norm(np.diff(schedule.velocity, axis=0), axis=1).max() / STEP
    gain = max(0.25 * own, own_speed, 0.5)
    controller = RealTimeAdmittance(schedule, force_limit=1e6)
    controller.start(0.0)
    ticks = [i * STEP + (i > 700) * 1.0 for i in range(1, int(1000 * schedule.duration) + 8000)]
    velocities = [controller.velocity]
    for now in ticks:
        controller.tick(now, [0.0] * schedule.n_outputs)
        velocities.append(controller.velocity)
    accelerations = np.linalg.norm(np.diff(velocities, axis=0), axis=1) / np.diff(ticks, prepend=0.0)
    assert accelerations[:5].max() <= 1.25 * gain
    assert accelerations.max() <= max(1.5 * own, 1.25 * own + gain)
    assert np.linalg.norm(velocities, axis=1).max() <= 1.5 * own_speed
    np.testing.assert_allclose(
        controller.position, schedule.position[-1], rtol=0, atol=1e-6 * np.ptp(schedule.position)
    )

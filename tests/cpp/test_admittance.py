"""The controller in C++ against that of Python, tick by tick, whatever the ticks are."""

import re
import subprocess
from dataclasses import replace

import numpy as np
import pytest
from control.loops import MASS, arm_inertia, as_schedule, constant, make_pose_schedule, make_schedule
from cpp.bridge import ROOT, Both, CppAdmittance, compiled, needs_compiler
from faults.test_random_loops import Loop, random_schedule
from hypothesis import settings

from torch_pbd import rotations
from torch_pbd.control.realtime import RealTimeAdmittance, TickStatus

pytestmark = needs_compiler

BUSY = {
    "deadband": 0.1,
    "spring_limit": 5.0,
    "velocity_limit": 2.0,
    "acceleration_limit": 15.0,
    "force_rate_limit": 5000.0,
    "hold_ticks": 3,
    "max_bad_ticks": 4,
    "stop_deceleration": 2.0,
    "approach_speed": 0.2,
    "on_gap": "resume",
}


@pytest.mark.parametrize("options", [{}, BUSY], ids=["defaults", "every option"])
@pytest.mark.parametrize(("d", "coupled"), [(1, 0.0), (2, 0.0), (2, 1.0), (3, 0.0), (6, 0.0), (6, 1.0)])
def test_ticks_are_those_of_python(d, coupled, options, rng, tmp_path):
    schedule = make_schedule(d, coupled=coupled, offset=7.0, rate=400.0)
    both = Both(schedule, tmp_path, mass=MASS, soft_start=0.1, **options)
    both.start(3.0, schedule.position[0] + 0.01, np.full(d, 0.02), at=0.013, force_bias=[0.3] * d)
    for now in 3.0 + np.cumsum(rng.uniform(1e-4, 1.9e-3, size=400)):
        both.tick(now, 20.0 * rng.normal(size=d))
        gains = np.stack([both.stiffness, both.damping])
        np.testing.assert_allclose(both.cpp.gains, gains, rtol=0, atol=1e-12 * np.abs(gains).max())
    assert not options or both.faults & TickStatus.ACCELERATION_LIMITED


POSE_LIMITS = {"deadband": 0.05, "spring_limit": 0.5, "velocity_limit": 1.0, "acceleration_limit": 20.0}
POSE_LIMITS |= {"force_rate_limit": 500.0, "stop_deceleration": 2.0, "approach_speed": 0.5}
BUSY_POSE = {**BUSY, "force_limit": (20.0, 2.0), **{name: (BUSY[name], each) for name, each in POSE_LIMITS.items()}}


@pytest.mark.parametrize("options", [{}, BUSY_POSE], ids=["defaults", "every option"])
@pytest.mark.parametrize("coupled", [0.0, 1.0])
@pytest.mark.parametrize("inertia", [arm_inertia, 5.0 * np.diag([1.0, 1.0, 1.0, 0.05, 0.03, 0.02]), 1.0])
def test_ticks_of_poses_are_those_of_python(inertia, coupled, options, rng, tmp_path):
    schedule = make_pose_schedule(0.25, rate=300.0, inertia=inertia, coupled=coupled)
    both = Both(schedule, tmp_path, soft_start=0.1, **options)
    turned = rotations.multiply(rotations.exp(np.array([0.1, -0.2, 0.1])), -schedule.orientation[0])
    twist = np.array([0.02, 0.0, 0.01, 0.1, 0.0, -0.2])
    both.start(3.0, schedule.position[0] + 0.01, twist, orientation=turned, at=0.013, force_bias=[0.3] * 6)
    scales = np.repeat([20.0, 2.0], 3)
    for now in 3.0 + np.cumsum(rng.uniform(1e-4, 1.9e-3, size=330)):
        both.tick(now, scales * rng.normal(size=6))
        gains = np.stack([both.stiffness, both.damping])
        np.testing.assert_allclose(both.cpp.gains, gains, rtol=0, atol=1e-12 * np.abs(gains).max())
    assert not options or both.faults & TickStatus.ACCELERATION_LIMITED


def test_a_spring_that_couples_positions_and_rotations_is_limited_as_a_whole(rng, tmp_path):
    pose = make_pose_schedule(0.2)
    coupling = 30.0 * np.eye(6, k=3)
    pose = replace(pose, stiffness=pose.stiffness + coupling + coupling.T).with_inertia(pose.mass)
    both = Both(pose, tmp_path, soft_start=0.0, spring_limit=(5.0, 0.5))
    both.start(0.0, pose.position[0] + 0.02)
    for tick in range(1, 300):
        both.tick(1e-3 * tick, rng.normal(size=6))
        np.testing.assert_allclose(both.cpp.gains[0], both.stiffness, rtol=0, atol=1e-9)
    assert both.faults == TickStatus.SPRING_LIMITED


@pytest.mark.parametrize("rate", [1000.0, 100.0, 3.0])
def test_rows_between_those_of_the_schedule_are_the_same(rate, tmp_path):
    schedule = make_schedule(2, rate=130.0, duration=0.2538)
    both = Both(schedule, tmp_path, mass=MASS, rate=rate, soft_start=0.0, max_step=5.0 / rate)
    both.start(1.7e9)
    for i in range(1, 40):
        both.tick(1.7e9 + i / rate, [0.0, 1.0])


@pytest.mark.parametrize("seeds", [range(12), pytest.param(range(12, 80), marks=pytest.mark.slow)], ids=["few", "many"])
def test_random_faults_do_the_same(seeds, tmp_path):
    seen = TickStatus(0)
    for seed in seeds:
        rng = np.random.default_rng(seed)
        schedule, soft_start = random_schedule(rng), rng.uniform(0.2, 0.4)
        d = schedule.n_outputs
        push = rng.uniform(0.0, 20.0) * rng.normal(size=d) / np.sqrt(d) * (seed % 2)
        on_gap = "resume" if seed % 4 > 1 else "pause"
        loop = Loop(rng, Both(schedule, tmp_path, on_gap=on_gap, soft_start=soft_start), 800, push)
        loop.run()
        seen |= loop.controller.faults
    assert seen & TickStatus.CLOCK
    assert seen & TickStatus.LATE


def served(both, schedule, n_ticks, rng):
    """Ticks with jitter and every fault, begun again after a stop and after the end; the number of starts."""
    d, now, n_starts, lost, stuck, status = schedule.n_outputs, 0.0, 0, 0, 0, TickStatus.STOPPED
    scales = np.ones(d)
    scales[schedule.position.shape[1] :] = 0.1  # of torques
    push = np.zeros(d)
    for _ in range(n_ticks):
        is_over = TickStatus.STOPPED in status or both.schedule_time >= schedule.duration
        if is_over and (not n_starts or rng.random() < 0.01):  # and else goes on for some time as it is
            n_starts, now = n_starts + 1, 0.0  # a clock of an hour tells 5e-13 s apart
            begin(both, schedule, now, rng)
        luck = rng.random()
        now += 10.0 ** rng.uniform(-2.0, 0.5) if luck < 1e-3 else 1e-3 * rng.uniform(0.5, 1.5)
        lost = int(rng.integers(1, 16)) if 1e-3 < luck < 2e-3 else max(0, lost - 1)
        stuck = int(rng.integers(1, 13)) if 2e-3 < luck < 3e-3 else max(0, stuck - 1)
        if luck > 0.99:
            push = 10.0 ** rng.uniform(-1.0, 2.5) * scales * rng.normal(size=d)
        force = np.where(rng.random(d) < 0.5, np.nan, push) if lost else push
        status = both.tick(rng.choice([np.nan, np.inf, now - 1.0]) if stuck else now, force)
    return n_starts


def begin(both, schedule, now, rng):
    """Start somewhere in the schedule, near its first place or where it is, moving."""
    options = {"at": rng.uniform(0.0, schedule.duration), "velocity": 0.05 * rng.normal(size=schedule.n_outputs)}
    if rng.random() < 0.7:
        options["position"] = schedule.position[0] + 0.02 * rng.normal(size=schedule.position.shape[1])
    if schedule.orientation is not None and rng.random() < 0.7:
        turn = rotations.exp(10.0 ** rng.uniform(-2.0, 0.5) * rng.normal(size=3))
        options["orientation"] = rotations.multiply(turn, schedule.orientation[0])
    both.start(now, **options)


# At 1e5 N/s a force of 200 N would be there in two ticks, and rounding would say whether the second one was limited.
LONG = {"deadband": 0.05, "velocity_limit": 3.0, "force_rate_limit": 0.97e5}
# Ten thousand take a second. A million: --hypothesis-profile=thorough.
MANY = 1_000_000 if settings.get_current_profile_name() == "thorough" else 150_000


@pytest.mark.parametrize(
    ("d", "n_ticks"),
    [(2, 20_000), *(pytest.param(d, n, marks=pytest.mark.slow) for d, n in [(2, MANY), (6, MANY)])],
)
def test_a_long_run_with_every_fault_stays_the_same(d, n_ticks, rng, tmp_path):
    schedule = make_schedule(d, duration=5.0)
    both = Both(schedule, tmp_path, mass=MASS, on_gap="resume", **LONG)
    assert served(both, schedule, n_ticks, rng) > 5
    assert both.seen | TickStatus.ACCELERATION_LIMITED == sum(TickStatus)
    print(f"largest difference after {n_ticks} ticks: {both.worst:.2g}")


@pytest.mark.parametrize("n_ticks", [5_000, pytest.param(MANY, marks=pytest.mark.slow)])
def test_a_long_run_of_poses_stays_the_same(n_ticks, rng, tmp_path):
    schedule = make_pose_schedule(3.0)
    pairs = {name: (value, 0.5 * value) for name, value in LONG.items()}
    both = Both(schedule, tmp_path, on_gap="resume", **pairs)
    assert served(both, schedule, n_ticks, rng) > 1
    print(f"largest difference after {n_ticks} ticks: {both.worst:.2g}")


def test_a_loop_that_is_too_slow_stops(tmp_path):
    both = Both(constant(100.0, 10.0), tmp_path)
    both.start(0.0)
    assert both.cpp.tick(0.02, [1.0]) == both.cpp.tick(0.04, [1.0]) == TickStatus.LATE
    assert both.cpp.tick(0.06, [1.0]) == TickStatus.LATE | TickStatus.STOPPED
    both = Both(make_schedule(1), tmp_path)
    both.start(0.0)
    assert not any(both.tick(0.01 * i, [1.0]) for i in range(1, 100))  # as long as may be, but for rounding


@pytest.mark.parametrize("steps", [[0.0, 0.001], [0.0, *[0.001] * 9], [0.011, 0.001], [0.011, *[0.001] * 9]])
def test_a_loop_that_never_gets_going_stops_at_the_same_tick(steps, tmp_path):
    both = Both(make_schedule(1, duration=3.0), tmp_path)
    both.start(0.0)
    for now in np.cumsum(np.tile(steps, 1000 // len(steps))):
        both.tick(now, [1.0])
    assert both.seen & TickStatus.STOPPED


@pytest.mark.parametrize("fault", [0.0, 0.011])
def test_ten_good_ticks_however_long_make_up_for_one(fault, rng, tmp_path):
    both = Both(make_schedule(1, duration=3.0), tmp_path)
    both.start(0.0)
    for now in np.cumsum([step for _ in range(100) for step in (fault, *rng.uniform(0.5e-3, 1.5e-3, 10))]):
        assert not both.tick(now, [1.0]) & TickStatus.STOPPED


def test_before_start_it_stands(tmp_path):
    cpp = Both(constant(100.0, 10.0), tmp_path).cpp
    assert cpp.tick(0.001, [1.0]) == TickStatus.STOPPED
    assert cpp.told[1:3] == [0.0, 0.0]


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("mass", 0.0),
        ("mass", 1e60),
        ("rate", -1.0),
        ("rate", 1e9),
        ("max_step", 1e-3),
        ("force_limit", 0.0),
        ("deadband", -1.0),
        ("spring_limit", 0.0),
        ("velocity_limit", 0.0),
        ("acceleration_limit", -1.0),
        ("force_limit", float("inf")),
        ("max_step", float("inf")),
        ("hold_ticks", -1),
        ("max_bad_ticks", 0),
        ("stop_deceleration", 0.0),
        ("soft_start", -1.0),
        ("approach_speed", 0.0),
        ("force_rate_limit", 0.0),
    ],
)
def test_what_python_refuses_is_refused(name, value, tmp_path):
    schedule = constant(100.0, 10.0)
    schedule.save(tmp_path / "schedule.csv")
    with pytest.raises(ValueError, match=f"^{name} is "):
        RealTimeAdmittance(schedule, **{name: value})
    with pytest.raises(ValueError, match=f"^{name} is .*, must be .*\\.$"):
        CppAdmittance(tmp_path / "schedule.csv", 1, **{name: value})


@pytest.mark.parametrize(
    ("start", "name"),
    [
        ({"now": float("nan")}, "now"),
        ({"now": 1e18}, "now"),
        ({"position": [float("inf")]}, "position"),
        ({"velocity": [3.0]}, "the speed"),
        ({"force_bias": [float("nan")]}, "force_bias"),
        ({"at": 1e306}, "at"),
        ({"at": -0.1}, "at"),
    ],
)
def test_a_start_that_python_refuses_is_refused(start, name, tmp_path):
    both = Both(constant(100.0, 10.0), tmp_path, velocity_limit=2.0)
    for controller in (both.python, both.cpp):
        with pytest.raises(ValueError, match=f"^{name}"):
            controller.start(**{"now": 0.0, **start})


def test_what_of_poses_python_refuses_is_refused(tmp_path):
    pose = make_pose_schedule(0.1)
    both = Both(pose, tmp_path, velocity_limit=(2.0, 1.0))
    for name, options in [
        ("the angular speed", {"velocity": [0.0] * 5 + [1.1]}),
        ("the length of orientation", {"orientation": [1.0, 0.1, 0.0, 0.0]}),
    ]:
        for controller in (both.python, both.cpp):
            with pytest.raises(ValueError, match=f"^{name} is "):
                controller.start(0.0, **options)
    for name, value in [("force_limit", (200.0, 0.0)), ("deadband", (0.0, -1.0)), ("approach_speed", (1.0, np.inf))]:
        with pytest.raises(ValueError, match=rf"^{name}\[1\] is "):
            RealTimeAdmittance(pose, **{name: value})
        with pytest.raises(ValueError, match=f"^{name} is "):
            CppAdmittance(tmp_path / "schedule.csv", 6, is_pose=True, **{name: value})


def test_another_mass_than_that_of_the_damping_is_refused(tmp_path):
    as_schedule([0.0, 1.0], [[[100.0]]] * 2, [[[20.0]]] * 2, mass=2.0).save(tmp_path / "schedule.csv")
    with pytest.raises(ValueError, match="mass is 1, must be that of the schedule's damping"):
        CppAdmittance(tmp_path / "schedule.csv", 1, mass=1.0)
    CppAdmittance(tmp_path / "schedule.csv", 1, mass=2.0)
    make_pose_schedule(0.1).save(tmp_path / "pose.csv")
    with pytest.raises(ValueError, match="mass is 2, must be left out: the schedule has the inertia of its damping"):
        CppAdmittance(tmp_path / "pose.csv", 6, is_pose=True, mass=2.0)


def test_positions_in_millimetres_are_refused(tmp_path):
    replace(constant(100.0, 10.0), units="mm").save(tmp_path / "schedule.csv")
    with pytest.raises(ValueError, match='units of schedule is "mm", must be m or rad'):
        CppAdmittance(tmp_path / "schedule.csv", 1)


@pytest.mark.slow
def test_the_example_serves_a_loop_and_allocates_nothing(tmp_path):
    make_schedule(2, duration=1.0).save(tmp_path / "schedule.csv")
    program = compiled(ROOT / "cpp" / "examples" / "loop.cpp", "-O2")
    ran = subprocess.run([program, tmp_path / "schedule.csv"], capture_output=True, text=True, check=True)
    assert re.match(r"1001 rows read in [\d.]+ ms\n3000 ticks of 2 axes: median [\d.]+ us", ran.stdout)
    assert ran.stdout.endswith("0 allocations; faults 0\n")
    failed = subprocess.run([program, tmp_path / "missing.csv"], capture_output=True, text=True, check=False)
    assert failed.returncode == 1
    assert "missing.csv cannot be opened" in failed.stderr

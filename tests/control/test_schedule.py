"""The schedule: what it holds, what it refuses, what lies between its rows, what is lost; and its files."""

import copy
import errno
import itertools
import json
import os
import pickle
import re
import subprocess
import sys
import zipfile
from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline

from torch_pbd.control.schedule import contents
from torch_pbd.control.schedule import files as schedule_files
from torch_pbd.control.schedule.schedule import Schedule
from torch_pbd.exceptions import ModelFileError

ARRAYS = tuple(name for name in contents.SHAPES if name not in contents.OPTIONAL)
LINEAR = ("stiffness", "damping", "covariance", "type1")
SUFFIXES = (".npz", ".json", ".csv")


def spd(rng, n, d, low, high):
    """Matrices (n, d, d) with eigenvalues within low and high, and axes of their own in each row."""
    axes = np.linalg.qr(rng.normal(size=(n, d, d)))[0]
    return axes * rng.uniform(low, high, size=(n, 1, d)) @ axes.swapaxes(1, 2)


def values(rng, n=12, d=2):
    """Arguments of a schedule that is random in everything but symmetry and sign."""
    return {
        "time": 0.3 + np.cumsum(rng.uniform(0.01, 1.0, size=n)),
        "position": rng.normal(size=(n, d)),
        "velocity": rng.normal(size=(n, d)),
        "stiffness": spd(rng, n, d, 50.0, 1000.0),
        "damping": spd(rng, n, d, 5.0, 60.0),
        "covariance": spd(rng, n, d, 1e-8, 1e-2),
        "type1": rng.uniform(size=n),
    }


@pytest.fixture
def schedule(rng):
    return Schedule(**values(rng), names=["x", "y"], frame="base", stiffness_limits=(50, 1000))


def bits(schedule):
    arrays = {name: getattr(schedule, name) for name in ARRAYS}
    return {name: array.tobytes() for name, array in arrays.items() if isinstance(array, np.ndarray)}


def test_keeps_what_it_was_given_and_never_changes(rng):
    given = values(rng)
    schedule = Schedule(**given, provenance={"seed": 1, "bounds": (1, 2)})
    assert (len(schedule), schedule.n_outputs, schedule.units) == (12, 2, "m")
    assert schedule.duration == given["time"][-1] - given["time"][0]
    before = copy.deepcopy(given)
    for name in ARRAYS:
        given[name][:] = -1.0
        held = getattr(schedule, name)
        assert held.dtype == np.float64
        np.testing.assert_allclose(held, before[name], rtol=1e-12, atol=0)
        if held.ndim == 3:
            np.testing.assert_array_equal(held, held.swapaxes(1, 2))
    assert schedule.provenance == {"seed": 1, "bounds": [1, 2]}
    for same in (schedule, copy.copy(schedule), copy.deepcopy(schedule), pickle.loads(pickle.dumps(schedule))):
        assert same == schedule
        with pytest.raises(ValueError, match="read-only"):
            same.stiffness[0] = 0.0
        with pytest.raises(TypeError):
            same.provenance["seed"] = 2
    with pytest.raises(FrozenInstanceError):
        schedule.frame = "tool"


def test_equality_sees_every_part(schedule):
    for name in ARRAYS:
        changed = np.array(getattr(schedule, name))
        changed[(-1,) * changed.ndim] *= 1.0 - 1e-15
        assert replace(schedule, **{name: changed}) != schedule
    labels = {"names": ("a", "b"), "units": None, "frame": "tool", "stiffness_limits": (49.0, 1000.0)}
    for name, label in {**labels, "covariance_of": "forcing", "provenance": {"a": 1}}.items():
        assert replace(schedule, **{name: label}) != schedule
    assert schedule != "text"


def test_prints_on_one_line(schedule):
    eigenvalues = np.linalg.eigvalsh(schedule.stiffness)
    assert repr(schedule) == (
        f"Schedule(n=12, names=('x', 'y'), time={schedule.time[0]:.6g}..{schedule.time[-1]:.6g} s, "
        f"stiffness={eigenvalues.min():.4g}..{eigenvalues.max():.4g} N/m, frame='base')"
    )


def with_entry(name, place, value):
    def spoil(given):
        given[name][place] = value

    return spoil


def skewed(given):
    given["stiffness"][3, 0, 1] += 1e-5


def indefinite(given):
    given["covariance"][4] = [[1.0, 2.0], [2.0, 1.0]]


def free(given):
    given["stiffness"][5] = np.diag([100.0, 0.0])
    given["damping"][5] = np.diag([10.0, 0.0])


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (with_entry("stiffness", (3, 0, 1), np.nan), "stiffness[3, 0, 1] is nan, must be finite"),
        (with_entry("position", (2, 1), np.inf), "position[2, 1] is inf, must be finite"),
        (with_entry("velocity", (2, 1), 1e200), "velocity[2, 1] is 1e+200, must be finite and at most"),
        (with_entry("time", 6, 0.5), "time[6] is 0.5 s, must be later than the time before it: sort the rows"),
        (lambda given: given["time"].put(6, given["time"][5]), ", must be later than the time before it"),
        (with_entry("type1", 7, 1.1), "type1[7] is 1.1, must be from 0"),
        (with_entry("type1", 7, -0.1), "type1[7] is -0.1, must be from 0"),
        (with_entry("stiffness", 8, 2000 * np.eye(2)), "the share of stiffness beyond stiffness_limits[8] is "),
        (with_entry("stiffness", 8, 49.9 * np.eye(2)), "must be none: limit the stiffness to them"),
        (with_entry("stiffness", 8, -np.eye(2)), "the smallest eigenvalue of stiffness[8] is -1.0"),
        (with_entry("damping", 8, -np.eye(2)), "the smallest eigenvalue of damping[8] is -1.0"),
        (skewed, "the asymmetry of stiffness[3] is "),
        (indefinite, "the smallest eigenvalue of covariance[4] is -1.0"),
        (lambda given: given.update(velocity=np.zeros((12, 3))), "velocity has shape (12, 3), must have shape (12, 2)"),
        (lambda given: given.update(time=np.arange(11.0)), "time has shape (11,), must have shape (12,)"),
        (lambda given: given.update(damping=np.eye(2)), "damping has shape (2, 2), must have shape (12, 2, 2)"),
        (lambda given: given.update(type1=["0"] * 12), "type1 holds text"),
        (lambda given: given.update(type1=np.ma.masked_less(given["type1"], 0.5)), "type1 has masked entries"),
        (lambda given: given.update(position=[[0.0, 1.0], [0.0]]), "position is ragged"),
        (lambda given: given.update({name: given[name][:1] for name in given}), "(1, 2), must have at least 2 rows"),
    ],
)
def test_what_cannot_be_run_is_refused_with_its_place(rng, spoil, message):
    given = values(rng)
    spoil(given)
    with pytest.raises(ValueError, match=re.escape(message)):
        Schedule(**given, stiffness_limits=(50.0, 1000.0))


@pytest.mark.parametrize(
    ("label", "message"),
    [
        ({"names": ["x"]}, "names is ['x'], must be 2 different strings"),
        ({"names": "xy"}, "names is 'xy'"),
        ({"names": ["x", "x"]}, "names is ['x', 'x']"),
        ({"names": ["x", 1]}, "names is ['x', 1]"),
        ({"units": 1}, "units is 1, must be a str or None"),
        ({"frame": b"base"}, "frame is b'base'"),
        ({"names": ["x", "a\rb"]}, r"names[1] is 'a\rb', must be text without control characters"),
        ({"names": ["\ud800", "y"]}, r"names[0] is '\ud800', must be text without control characters"),
        ({"covariance_of": "velocity"}, "covariance_of is 'velocity', must be one of 'position', 'forcing'"),
        ({"stiffness_limits": (1000, 50)}, "stiffness_limits[1] is 50.0, must be a finite number above 0"),
        ({"stiffness_limits": (50,)}, "stiffness_limits is"),
        ({"stiffness_limits": (-1, 1000)}, "stiffness_limits[0] is -1.0,"),
        ({"provenance": ["seed"]}, "provenance is ['seed'], must be a Mapping"),
        ({"provenance": {"a": [1, np.ones(2)]}}, "provenance['a'][1] is array([1., 1.]), must be what JSON can"),
        ({"provenance": {"a": float("nan")}}, "provenance['a'] is nan"),
        ({"provenance": {"a": {1: 2}}}, "provenance['a'] is {1: 2}"),
    ],
)
def test_labels_are_checked(rng, label, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        Schedule(**values(rng), **label)


def test_a_provenance_without_a_bottom_is_refused(rng):
    lists, mappings, round_list, round_mapping = [], {}, [], {}
    for _ in range(5000):
        lists, mappings = [lists], {"below": mappings}
    round_list.append(round_list)
    round_mapping["self"] = round_mapping
    for provenance in ({"a": lists}, mappings, {"a": round_list}, round_mapping):
        with pytest.raises(ValueError, match="more than 100 levels deep, or holds itself"):
            Schedule(**values(rng), provenance=provenance)
    with pytest.raises(ValueError, match=re.escape("provenance['a'] is {1: [")):
        Schedule(**values(rng), provenance={"a": {1: lists}})


def test_a_free_axis_needs_damping(rng):
    given = values(rng)
    free(given)
    with pytest.raises(ValueError, match=r"eigenvalue of damping\[5\] is 0\.0, must be above zero where the stiffness"):
        Schedule(**given)
    given["damping"][5, 1, 1] = 0.1
    Schedule(**given)
    given["stiffness"][5] = 0.0
    Schedule(**given)


@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e12])
def test_tolerances_are_relative(rng, scale):
    given = values(rng)
    for name in ("stiffness", "damping", "covariance"):
        given[name] *= scale
    spectrum = np.linalg.eigvalsh(given["stiffness"])
    low, high = spectrum.min(), spectrum.max()
    Schedule(**given, stiffness_limits=(low * (1.0 + 1e-12), high * (1.0 - 1e-12)))
    for limits in [(low * (1.0 + 1e-6), high), (low, high * (1.0 - 1e-6))]:
        with pytest.raises(ValueError, match="share of stiffness beyond stiffness_limits"):
            Schedule(**given, stiffness_limits=limits)
    with pytest.raises(ValueError, match=r"smallest eigenvalue of covariance\[3\] is -"):
        Schedule(**{**given, "covariance": -1e-6 * given["covariance"] * (np.arange(12) == 3)[:, None, None]})
    for tilt, allowed in [(1e-11, True), (1e-7, False)]:
        tilted = copy.deepcopy(given)
        tilted["stiffness"][3, 0, 1] += tilt * np.abs(given["stiffness"][3]).max()
        if allowed:
            Schedule(**tilted)
        else:
            with pytest.raises(ValueError, match="asymmetry of stiffness"):
                Schedule(**tilted)


def test_rows_come_back_to_the_bit_and_lines_are_those_of_numpy(schedule, rng):
    assert bits(schedule.resample(times=schedule.time)) == bits(schedule)
    times = np.sort(np.r_[schedule.time, rng.uniform(*schedule.time[[0, -1]], size=300)])
    resampled = schedule.resample(times=times)
    for name in LINEAR:
        columns = getattr(schedule, name).reshape(len(schedule), -1).T
        expected = np.stack([np.interp(times, schedule.time, column) for column in columns], axis=1)
        found = getattr(resampled, name).reshape(len(times), -1)
        np.testing.assert_allclose(found, expected, rtol=1e-11, atol=1e-11 * np.abs(expected).max())
    spline = CubicHermiteSpline(schedule.time, schedule.position, schedule.velocity)
    np.testing.assert_allclose(resampled.position, spline(times), rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(resampled.velocity, spline(times, 1), rtol=1e-9, atol=1e-9)
    labels = [(s.names, s.frame, s.stiffness_limits) for s in (schedule, resampled)]
    assert labels[0] == labels[1]


@pytest.mark.parametrize("offset", [0.0, 1e6])
def test_a_cubic_motion_is_resampled_exactly(rng, offset):
    time = np.array([0.0, 0.4, 1.5, 1.6, 3.0])
    cubic = np.polynomial.Polynomial([offset, -2.0, 0.5, 0.25])
    given = {**values(rng, 5, 1), "time": time}
    given |= {"position": cubic(time)[:, None], "velocity": cubic.deriv()(time)[:, None]}
    fine = Schedule(**given).resample(rate=100.0)
    np.testing.assert_allclose(fine.position[:, 0], cubic(fine.time), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(fine.velocity[:, 0], cubic.deriv()(fine.time), rtol=1e-9, atol=1e-15 * offset + 1e-12)


def test_what_is_constant_stays_so_to_the_bit(rng):
    given = values(rng)
    given["stiffness"][:] = given["stiffness"][0]
    given["type1"][:] = 1.0
    fine = Schedule(**given).resample(rate=317.0)
    assert np.ptp(fine.stiffness, axis=0).max() == 0.0
    assert (fine.type1 == 1.0).all()


def test_68_a_rate_gives_even_ticks_and_a_last_one_at_the_end(rng):
    given = values(rng)
    cases = [(10.0, 1000.0, 10001), (1.0, 3.0, 4), (1.05, 10.0, 12), (0.29, 100.0, 30)]  # 0.29 * 100 < 29
    for start, (duration, rate, n) in itertools.product([0.0, 0.1], cases):
        given["time"] = start + np.linspace(0.0, duration, 12)
        ticks = Schedule(**given).resample(rate).time
        assert (len(ticks), ticks[0], ticks[-1]) == (n, start, given["time"][-1])
        np.testing.assert_allclose(np.diff(ticks)[:-1], 1.0 / rate, rtol=1e-9)
        assert 0.0 < ticks[-1] - ticks[-2] <= (1.0 + 1e-9) / rate


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "give either rate or times; got rate=None"),
        ({"rate": 10.0, "times": [1.0, 2.0]}, "give either rate or times"),
        ({"rate": 0.0}, "rate is 0.0 Hz, must be a finite number above 0"),
        ({"rate": 0.01}, "rate is 0.01 Hz, must be at least"),
        ({"times": [1.0, 99.0]}, "times[1] is 99.0 s, must be from 0."),
        ({"times": [0.0, 1.0]}, "times[0] is 0.0 s, must be from 0."),
        ({"times": [2.0, 1.0]}, "time[1] is 1.0 s, must be later than"),
        ({"times": [[1.0, 2.0]]}, "times has shape (1, 2), must have shape (m,)"),
    ],
)
def test_resample_refuses_times_outside(schedule, options, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        schedule.resample(**options)


def test_retimed_motion_is_the_same_path(schedule):
    fast = schedule.retime(2.0)
    times = np.linspace(*schedule.time[[0, -1]], 50)
    slow_rows, fast_rows = schedule.resample(times=times), fast.resample(times=times / 2.0)
    np.testing.assert_allclose(fast_rows.position, slow_rows.position, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(fast_rows.velocity, 2.0 * slow_rows.velocity, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(fast_rows.stiffness, slow_rows.stiffness, rtol=1e-9)
    assert fast.retime(0.5) == schedule
    for speed in (0.0, -1.0, np.nan, np.inf, True, "2"):
        with pytest.raises(ValueError, match=r"speed is .*, must be a finite number"):
            schedule.retime(speed)


def test_retime_with_a_mass_refuses_what_no_guarantee_covers():
    time = np.linspace(0.0, 1.0, 801)
    stiffness = (525.0 + 475.0 * np.sin(14.2 * time))[:, None, None]
    still = np.zeros((801, 1))
    rows = {"time": time, "position": still, "velocity": still, "covariance": 0.0 * stiffness, "type1": np.zeros(801)}
    weak = Schedule(**rows, stiffness=stiffness, damping=np.sqrt(stiffness))
    limit = weak.certify(mass=10.0).max_speed
    assert weak.retime(0.9 * limit, mass=10.0) == weak.retime(0.9 * limit)
    with pytest.raises(ValueError, match=rf"speed is 1.0, must be certified .* highest safe speed is {limit:.4g},"):
        weak.retime(1.0, mass=10.0)
    coarse = weak.resample(times=time[::10])
    with pytest.raises(ValueError, match=r"held between rows, its gains let V grow by .* resample it finer"):
        coarse.retime(0.99 * coarse.certify(mass=10.0).max_speed, mass=10.0)
    # Critical damping is safe at this ratio of stiffness whatever the speed, though no certificate holds.
    critical = Schedule(**rows, stiffness=stiffness, damping=2.0 * np.sqrt(10.0 * stiffness))
    assert critical.certify(mass=10.0, speed=5.0).margin < 0.0
    assert critical.retime(5.0, mass=10.0) == critical.retime(5.0)


@pytest.mark.parametrize("d", [1, 2, 3])
def test_what_diagonal_gains_lose_is_what_forces_in_all_directions_show(rng, d):
    schedule = Schedule(**values(rng, 6, d), stiffness_limits=(50.0, 1000.0))
    diagonal, loss = schedule.diagonal()
    forces = rng.normal(size=(d, 20_000))
    for name, told in (("damping", loss.velocity), ("stiffness", loss.displacement)):
        whole, kept = getattr(schedule, name), getattr(diagonal, name)
        np.testing.assert_array_equal(kept, np.stack([np.diag(np.diag(matrix)) for matrix in whole]))
        if d == 1:
            assert told == 0.0
            continue
        moved, moved_otherwise = np.linalg.inv(whole) @ forces, np.linalg.inv(kept) @ forces
        errors = np.linalg.norm(moved_otherwise - moved, axis=1) / np.linalg.norm(moved, axis=1)
        assert (errors <= told * (1.0 + 1e-12)).all()
        worst = errors.max(axis=1)
        np.testing.assert_allclose(worst.max(), told, rtol=2e-3)  # 20000 forces nearly hit the worst
    assert replace(diagonal, stiffness=schedule.stiffness, damping=schedule.damping) == schedule
    assert d == 1 or loss.time == schedule.time[worst.argmax()]


def test_loss_of_a_single_coupling_has_a_closed_form(rng):
    given = values(rng, 3, 2)
    given["stiffness"] = np.array([[[400.0, 60.0], [60.0, 100.0]], 50 * np.eye(2), np.zeros((2, 2))])
    given["damping"] = np.tile(np.eye(2), (3, 1, 1))
    _, loss = Schedule(**given).diagonal()
    np.testing.assert_allclose(loss.displacement, 60.0 / 100.0, rtol=1e-12)  # |k_xy| / min(k_xx, k_yy)
    assert (loss.velocity, loss.time) == (0.0, given["time"][0])
    assert f"60.0%, at {given['time'][0]:.6g} s" in str(loss)


EXTREMES = [-0.0, 5e-324, 1 / 3, np.pi, -1e-17, 9.9e99, 1e-300, 2.0**53 + 2]
LABELLED = {
    "plain": {},
    "labelled": {
        "names": 'x "1"',
        "units": None,
        "frame": "bäse\n# sha256: 1",
        "stiffness_limits": (1 / 3, 1e4),
        "covariance_of": "forcing",
        "provenance": {"seed": 7, "é": [1.5, None, True, {"b": -0.0}], "file": "a,b\r\n", "long": 2**70},
    },
}


@pytest.mark.parametrize("suffix", [*SUFFIXES, ".CSV"])
@pytest.mark.parametrize(("d", "kind"), [*itertools.product([1, 2, 3], LABELLED)])
def test_files_bring_everything_back_to_the_bit(tmp_path, rng, suffix, d, kind):
    given = values(rng, len(EXTREMES), d)
    given["position"][:, 0] = EXTREMES
    given["covariance"][0] *= 1e-300
    labels = dict(LABELLED[kind])
    if "names" in labels:
        labels["names"] = [labels["names"], "y,z", "# ü"][:d]
    schedule = Schedule(**given, **labels)
    path = tmp_path / f"schedule{suffix}"
    schedule.save(path)
    loaded = Schedule.load(str(path))
    assert loaded == schedule
    assert bits(loaded) == bits(schedule)  # -0.0 too
    assert repr(loaded.provenance) == repr(schedule.provenance)
    assert [*tmp_path.iterdir()] == [path]


def test_npz_and_csv_can_be_read_by_others(tmp_path, schedule):
    schedule.save(tmp_path / "schedule.npz")
    with np.load(tmp_path / "schedule.npz", allow_pickle=False) as archive:
        for name in ARRAYS:
            np.testing.assert_array_equal(archive[name], getattr(schedule, name))
        assert json.loads(str(archive["header"]))["names"] == ["x", "y"]
    schedule.save(tmp_path / "schedule.csv")
    table = np.genfromtxt(tmp_path / "schedule.csv", delimiter=",", skip_header=11)
    titles = (tmp_path / "schedule.csv").read_text().splitlines()[10]
    assert titles.startswith("time,position[x],position[y],velocity[x],velocity[y],stiffness[x][x],stiffness[x][y],")
    assert len(titles.split(",")) == table.shape[1]
    np.testing.assert_array_equal(table[:, 5:8], schedule.stiffness[:, [0, 0, 1], [0, 1, 1]])
    np.testing.assert_array_equal(table[:, -1], schedule.type1)


@pytest.fixture(params=SUFFIXES)
def saved(request, tmp_path, rng):
    """A file and what is in it."""
    schedule = Schedule(**values(rng, 4, 2), names=("x", "y"), provenance={"seed": 1})
    path = tmp_path / f"schedule{request.param}"
    schedule.save(path)
    return path, schedule


def load_bytes(path, content):
    path.write_bytes(content)
    return Schedule.load(path)


def test_torn_files_are_refused(saved):
    path, _ = saved
    whole = path.read_bytes()
    for share in (0.0, 0.3, 0.9, 0.999):
        with pytest.raises(ModelFileError, match=re.escape(f"{path} cannot be read as a schedule: ")):
            load_bytes(path, whole[: int(share * len(whole))])


def test_a_flipped_bit_is_refused_or_changes_nothing(saved, rng):
    path, schedule = saved
    whole = path.read_bytes()
    n_refused = 0
    for place in rng.choice(len(whole), size=min(400, len(whole)), replace=False):
        flipped = bytearray(whole)
        flipped[place] ^= 1 << rng.integers(8)
        try:
            loaded = load_bytes(path, bytes(flipped))
        except ModelFileError:
            n_refused += 1
        else:
            assert loaded == schedule, place  # a date of the archive, 1e-05 as 1E-05
    assert n_refused > 250


def rewritten(path, change):
    """The file after ``change(header, arrays)``, with a checksum that is right."""
    encode, decode = schedule_files._FORMATS[path.suffix]
    parts = decode(path.read_bytes())
    header, arrays = next(parts), dict(next(parts))
    header.pop("sha256")
    change(header, arrays)
    header["sha256"] = schedule_files._digest(header, arrays)
    path.write_bytes(encode(header, arrays))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda header, _: header.update(version=3), "it has version 3, must have 2 or 1: upgrade torch_pbd"),
        (lambda header, _: header.update(format="other"), "its format is 'other', must be 'torch_pbd.schedule'"),
        (lambda header, _: header.pop("frame"), "its header has no 'frame'"),
        (lambda header, _: header.update(colour=1.0), "its header has an unknown 'colour'"),
        (lambda header, _: header.update(names=["x", "x"]), "names is ['x', 'x'], must be 2 different strings"),
        (lambda header, _: header.update(provenance=None), "provenance is None, must be a Mapping"),
        (lambda header, _: header.update(stiffness_limits=[1, 2]), "the share of stiffness beyond stiffness_limits["),
        (lambda _, arrays: arrays.update(time=np.flip(arrays["time"])), "must be later than"),
        (lambda _, arrays: arrays.update(type1=arrays["type1"] * np.nan), "nan"),
        (lambda _, arrays: arrays.update(damping=-arrays["damping"]), "the smallest eigenvalue of damping"),
    ],
)
def test_files_that_are_whole_but_wrong_are_refused(saved, change, message):
    path, _ = saved
    rewritten(path, change)
    with pytest.raises(ModelFileError, match="(?i)" + re.escape(str(path)) + ".*" + re.escape(message)):
        Schedule.load(path)


def test_other_versions_are_told_before_their_arrays_are_read(tmp_path, schedule):
    path = tmp_path / "schedule.json"
    schedule.save(path)
    document = json.loads(path.read_text())
    with pytest.raises(ModelFileError, match="it has version 7"):
        load_bytes(path, json.dumps({**document, "version": 7, "arrays": "elsewhere"}).encode())
    with pytest.raises(ModelFileError, match="its header has no 'sha256'"):
        load_bytes(path, json.dumps({key: value for key, value in document.items() if key != "sha256"}).encode())
    for arrays in ("elsewhere", {"time": [0, 1]}, None, {**document["arrays"], "time": [[1], 2]}):
        with pytest.raises(ModelFileError, match=re.escape(str(path))):
            load_bytes(path, json.dumps({**document, "arrays": arrays}).encode())
    for deep in (b"[" * 100_000, json.dumps({**document, "provenance": 0}).encode().replace(b"0,", b"1" * 5000 + b",")):
        with pytest.raises(ModelFileError, match=re.escape(str(path))):
            load_bytes(path, deep)


def packed(path, **members):
    """The archive at ``path`` with members replaced."""
    with zipfile.ZipFile(path) as archive:
        kept = {info.filename: archive.read(info) for info in archive.infolist()}
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in {**kept, **{f"{name}.npy": content for name, content in members.items()}}.items():
            archive.writestr(name, content)


class Canary:
    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


def test_pickles_and_huge_shapes_are_neither_executed_nor_allocated(tmp_path, schedule):
    canary, path = tmp_path / "canary", tmp_path / "schedule.npz"
    schedule.save(path)
    np.save(tmp_path / "object.npy", np.array([Canary(canary)], dtype=object), allow_pickle=True)
    packed(path, type1=(tmp_path / "object.npy").read_bytes())
    with pytest.raises(ModelFileError, match="type1 is not an array of numbers or text"):
        Schedule.load(path)
    for suffix in SUFFIXES:
        with pytest.raises(ModelFileError, match="cannot be read as a schedule"):
            load_bytes(tmp_path / f"pickle{suffix}", pickle.dumps(Canary(canary)))
    assert not canary.exists()
    schedule.save(path)
    np.save(tmp_path / "small.npy", np.zeros(8))
    header = (tmp_path / "small.npy").read_bytes().replace(b"(8,), }          ", b"(1000000000000,), }")
    assert b"1000000000000" in header
    packed(path, type1=header)
    with pytest.raises(ModelFileError, match=r"type1 declares shape \(1000000000000,\), 8000000000000 bytes, but has"):
        Schedule.load(path)


def test_files_too_large_to_read_are_not_written_and_not_read(saved, monkeypatch):
    path, schedule = saved
    monkeypatch.setattr(schedule_files, "MAX_BYTES", 100)
    with pytest.raises(ModelFileError, match="a schedule has at most 100"):
        Schedule.load(path)
    with pytest.raises(ValueError, match="resample the schedule at a lower rate"):
        schedule.save(path)


def test_packed_archives_load_but_not_beyond_the_limit(tmp_path, schedule, monkeypatch):
    path = tmp_path / "schedule.npz"
    schedule.save(path)
    with np.load(path) as archive:
        np.savez_compressed(path, **dict(archive))
    assert Schedule.load(path) == schedule
    monkeypatch.setattr(schedule_files, "MAX_BYTES", path.stat().st_size)
    with pytest.raises(ModelFileError, match="it unpacks to more than"):
        Schedule.load(path)


def test_an_edited_csv_loads_once_its_checksum_is_deleted(tmp_path, schedule):
    path = tmp_path / "schedule.csv"
    schedule = replace(schedule, stiffness_limits=None)
    schedule.save(path)
    text = path.read_text()
    assert load_bytes(path, ("\ufeff" + text.replace("\n", "\r\n")).encode()) == schedule  # a spreadsheet's line ends
    row = text.splitlines()[13]
    cells = row.split(",")
    cells[5] = "123.0"
    edited = text.replace(row, ",".join(cells))
    with pytest.raises(ModelFileError, match="delete the line that starts with '# sha256:' to accept it"):
        load_bytes(path, edited.encode())
    accepted = load_bytes(path, re.sub("# sha256.*\n", "", edited).encode())
    assert accepted.stiffness[2, 0, 0] == 123.0
    np.testing.assert_array_equal(accepted.position, schedule.position)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("# frame: ", "# a remark ", "line 5 must be '# key: value' with a new key, but is '# a remark"),
        ("# units:", "# names:", "line 4 must be '# key: value' with a new key"),
        ("null", "NaN", "it does not match its checksum"),
        ('["x", "y"]', '["x"]', "names is ['x'], but there are 2 columns of velocities"),
        ("position[y]", "position[z]", "line 11 must name the columns time,position[x],position[y],velocity[x]"),
        ("\n0.9,", "\n0.9,1,", "line 13 has 16 cells, but there are 15 columns"),
        ("\n0.9,", "\nnan,", "line 13, column 'time': 'nan' is not a finite number"),
        ("\n0.9,", "\n1e999,", "line 13, column 'time': '1e999' is not a finite number"),
        ("\n0.9,", "\n1_0,", "line 13, column 'time': '1_0' is not a finite number"),
        ("\n0.9,", "\n,", "line 13, column 'time': '' is not a finite number"),
    ],
)
def test_csv_that_cannot_be_read_is_refused_with_its_place(tmp_path, rng, old, new, message):
    path = tmp_path / "schedule.csv"
    Schedule(**{**values(rng, 2), "time": [0.5, 0.9]}, names=("x", "y")).save(path)
    text = path.read_text()
    assert old in text
    with pytest.raises(ModelFileError, match=re.escape(f"{path} cannot be read as a schedule: {message}")):
        load_bytes(path, text.replace(old, new, 1).encode())


def test_a_failed_save_names_the_path_and_leaves_the_old_file_and_nothing_else(saved, monkeypatch):
    path, schedule = saved
    before = path.read_bytes()

    def full(_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match=r"No space left on device: '.*schedule\.") as raised:
        schedule.retime(2.0).save(path)
    assert raised.value.errno == errno.ENOSPC
    assert path.read_bytes() == before
    assert [*path.parent.iterdir()] == [path]


def test_who_reads_while_a_file_is_replaced_reads_the_old_one(saved):
    path, schedule = saved
    before = path.read_bytes()
    with path.open("rb") as reader:
        schedule.retime(2.0).save(path)
        assert reader.read() == before
    assert Schedule.load(path) == schedule.retime(2.0)


def test_paths_are_checked(tmp_path, schedule):
    with pytest.raises(ValueError, match=r"has the suffix '\.mat', must have \.npz, \.json or \.csv"):
        schedule.save(tmp_path / "schedule.mat")
    with pytest.raises(ValueError, match=r"has the suffix '', must have \.npz, \.json or \.csv"):
        Schedule.load(tmp_path / "schedule")
    with pytest.raises(FileNotFoundError, match=r"schedule\.csv does not exist"):
        Schedule.load(tmp_path / "schedule.csv")
    with pytest.raises(FileNotFoundError, match=r"missing does not exist"):
        schedule.save(tmp_path / "missing" / "schedule.csv")
    (tmp_path / "folder.csv").mkdir()
    with pytest.raises(OSError, match=r"folder\.csv"):
        schedule.save(tmp_path / "folder.csv")


def test_torch_is_not_imported():
    code = "import sys, torch_pbd.control.schedule.schedule; sys.exit('torch' in sys.modules or 'scipy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0

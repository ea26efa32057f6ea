"""Recordings as new users bring them: stamps of clocks, spelled-out units, tables of other programs, rotations.

Numbers in the names are those of the list of faults that the project keeps.
"""

import io
import pickle
import re
import warnings
from functools import cache

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

import torch_pbd
from torch_pbd import Demonstrations, DMPController, GMMBaseline
from torch_pbd.cli.main import main
from torch_pbd.control import Schedule
from torch_pbd.control.learning import as_demonstrations
from torch_pbd.control.primitive.outputs import Outputs
from torch_pbd.control.primitive.smoothing import duration_of
from torch_pbd.data import load_demonstrations, make_tunnel_demonstrations, save_demonstrations
from torch_pbd.data.units import TIMES
from torch_pbd.exceptions import DataFormatError, ModelFileError

UNIX = 1_700_000_000
NS = UNIX * 10**9
FIT = ["--model", "GMMBaseline", "--model.n_components", "2"]
SETS = [
    *(f"letter_{letter}" for letter in "ACGLNPSZ"), "pen_a", "handwriting_fda", "gait_hip_knee", "kuka_cube_pick",
    "kuka_cshape_top", "adroit_door_palm", "adroit_door_joints", "snooker_skilled", "mouse_choice_1",
]  # fmt: skip


@cache
def tunnel():
    return make_tunnel_demonstrations(4, 2.0, 50.0, random_state=0)


def controller(**parameters):
    return DMPController(GMMBaseline(n_components=2, random_state=0), n_steps=20).set_params(**parameters)


@cache
def schedule():
    return controller().fit(tunnel()).schedule(50.0)


@cache
def model():
    return GMMBaseline(n_components=1).fit(*tunnel().stack()[:2])


def csv_of(tmp_path, table, **options):
    table.to_csv(tmp_path / "set.csv", **{"index": False, **options})
    return tmp_path / "set.csv"


def as_table(recorded, **columns):
    """Long table of demonstrations, with more columns: functions of the number of a demonstration and its length."""
    parts = []
    for k, (time, position) in enumerate(recorded):
        made = {name: column(k, len(time)) for name, column in columns.items()}
        parts.append(
            pd.DataFrame({"demo": k, "time": time, **made, **dict(zip(recorded.names, position.T, strict=True))})
        )
    return pd.concat(parts, ignore_index=True)


# 64: recordings that do not overlap


def shifted(offsets):
    times = [time + offset for time, offset in zip(tunnel().times, offsets, strict=True)]
    return Demonstrations(times, tunnel().positions, names=("x", "y"), units="m")


APART = {
    "a minute": [UNIX + 60.0 * k for k in range(4)],
    "backwards": [-3.0 * k for k in range(4)],
    "one": [0, 0, 0, 1.5],
}


@pytest.mark.parametrize("offsets", APART.values(), ids=list(APART))
def test_64_recordings_that_do_not_overlap_are_not_stacked_by_time(offsets):
    apart = shifted(offsets)
    with pytest.raises(ValueError, match=r"in common: number \d.*\.from_start\(\).*from_start=True.*\.align\("):
        apart.stack()
    X, y, groups = apart.from_start().stack()
    wanted = tunnel().stack()
    np.testing.assert_allclose(X, wanted[0], atol=4 * np.spacing(np.abs(offsets).max()))
    assert len(np.unique(X)) == len(np.unique(wanted[0]))  # aligned to the last bit
    np.testing.assert_array_equal(y, wanted[1])
    np.testing.assert_array_equal(groups, wanted[2])
    assert np.ptp(apart.stack("phase")[0]) == 1.0


def test_64_half_of_the_median_duration_is_enough():
    times = [np.linspace(start, start + 2.0, 11) for start in (0.0, 0.5, 1.0)]
    assert Demonstrations(times, np.zeros((3, 11, 1))).stack()[0].max() == 3.0
    with pytest.raises(ValueError, match=r"have 0\.99 of a median duration of 2 s in common"):
        Demonstrations([*times[:2], times[2] + 0.01], np.zeros((3, 11, 1))).stack()
    huge = Demonstrations([[-1.7e308, -1.6e308], [1.6e308, 1.7e308]], [[0, 1], [0, 1]])
    with pytest.raises(ValueError, match="have 0 of a median"):
        huge.stack()


@pytest.mark.parametrize("offsets", APART.values(), ids=list(APART))
def test_15_an_offset_of_each_recording_changes_nothing(offsets):
    made = controller().fit(shifted(offsets)).schedule(50.0)
    # Stamps of 1970 are stored in steps of 2.4e-7 s, in which the hand moves 1e-7 m.
    loose = max(np.spacing(np.abs(offsets).max()) / 2.4e-7, 1e-2)
    np.testing.assert_allclose(made.position, schedule().position, atol=1e-6 * loose)
    np.testing.assert_allclose(made.stiffness, schedule().stiffness, rtol=1e-3 * loose, atol=1e-1 * loose)


@pytest.mark.parametrize("suffix", [".npz", ".csv"])
def test_64_the_loader_counts_from_the_start_too(suffix, tmp_path):
    apart = shifted(APART["a minute"])
    save_demonstrations(apart, tmp_path / f"set{suffix}")
    loaded = load_demonstrations(tmp_path / f"set{suffix}", from_start=True)
    assert [time[0] for time in loaded.times] == [0.0] * 4
    assert loaded.is_aligned


def test_64_so_does_the_command_line(tmp_path, capsys):
    save_demonstrations(shifted(APART["a minute"]), tmp_path / "set.csv")
    raw = ["fit", "--data", str(tmp_path / "set.csv"), *FIT, "--align", "none", "--output", str(tmp_path / "out")]
    assert main(raw) == 1
    shown = capsys.readouterr().err
    assert shown.count("\n") == 1
    assert "from_start" in shown
    assert main([*raw, "--from_start", "true"]) == 0


# 65: stamps in ns


def stamps(step=20_000_000, n=101, k=0):
    return NS + 1 + k * 60 * 10**9 + step * np.arange(n, dtype=np.int64)


@pytest.mark.parametrize("dtype", [np.int64, np.uint64])
def test_65_whole_stamps_in_ns_keep_their_exact_steps(dtype, tmp_path):
    steps = np.random.default_rng(0).integers(1, 300, size=(2, 50))
    times = [(NS + 10**10 * k + np.cumsum(step)).astype(dtype) for k, step in enumerate(steps)]
    positions = np.random.default_rng(1).normal(size=(2, 50, 1))
    np.savez(tmp_path / "set.npz", t_0=times[0], x_0=positions[0], t_1=times[1], x_1=positions[1])
    rows = [[k, t, x] for k in range(2) for t, x in zip(times[k], positions[k, :, 0], strict=True)]
    table = pd.DataFrame(rows, columns=["demo", "time", "x"]).astype({"time": dtype})
    made = [
        Demonstrations(times, positions, time_unit="ns"),
        load_demonstrations(tmp_path / "set.npz", time_unit="ns"),
        load_demonstrations(csv_of(tmp_path, table), time_unit="ns"),
    ]
    for recorded in made:
        for k, time in enumerate(recorded.times):
            np.testing.assert_array_equal(np.diff(time), steps[k, 1:])
        assert recorded.times[1][0] - recorded.times[0][0] == int(times[1][0]) - int(times[0][0])
        assert recorded.time_unit == "ns"


def test_65_stamps_over_all_of_int64_do_not_wrap():
    ends = np.iinfo(np.int64)
    recorded = Demonstrations([[ends.min, 0, ends.max]], [[0.0, 1.0, 2.0]])
    np.testing.assert_allclose(np.diff(recorded.times[0]), [2.0**63, 2.0**63])


def test_65_a_schedule_of_stamps_in_ns_is_that_in_s():
    times = [stamps(k=k) for k in range(4)]
    recorded = Demonstrations(times, tunnel().positions, names=("x", "y"), units="m", time_unit="ns")
    made = controller().fit(recorded).schedule(50.0)
    assert made.duration == pytest.approx(2.0, rel=1e-12)
    np.testing.assert_allclose(made.position, schedule().position, atol=1e-9)
    np.testing.assert_allclose(made.stiffness, schedule().stiffness, rtol=1e-3, atol=1e-2)


@pytest.mark.parametrize(
    ("unit", "seconds"), [("ns", 1e-9), ("us", 1e-6), ("ms", 1e-3), ("s", 1), ("min", 60), ("h", 3600)]
)
def test_65_units_of_time_are_known(unit, seconds):
    assert TIMES[unit] == seconds
    recorded = Demonstrations([t / seconds for t in tunnel().times], tunnel().positions, units="m", time_unit=unit)
    assert duration_of(recorded, None) == pytest.approx((2.0, seconds), rel=1e-12)


@pytest.mark.parametrize("cutoff", ["auto", 5.0])
@pytest.mark.parametrize("factor", [1e9, 1e6])
def test_65_the_unit_of_times_is_suspected_and_not_the_cutoff(factor, cutoff):
    recorded = Demonstrations([factor * time for time in tunnel().times], tunnel().positions, units="m")
    with pytest.raises(ValueError, match=r"unit of the times is suspect, time_unit='s' \(known: .*ms, us, ns\)") as e:
        controller(cutoff=cutoff).fit(recorded)
    assert "leave it" not in str(e.value)
    with pytest.raises(ValueError, match="leave it 'auto'"):
        controller(cutoff=1e7).fit(tunnel())


def test_65_stamps_in_errors_have_all_their_digits(tmp_path):
    falling = NS + np.array([300, 700, 600, 900])
    text = f"{NS + 600} after {NS + 700}.*look like ns \\(time_unit='ns'\\)"
    with pytest.raises(ValueError, match=text):
        Demonstrations([falling], np.zeros((1, 4, 1)))
    # In float64 these are one number, of which that is told.
    with pytest.raises(ValueError, match=f"at {NS} after {NS}.*float64 tells 256 apart: give integers"):
        Demonstrations([np.array([0, 1, 2, 3]) + float(NS)], np.zeros((1, 4, 1)))
    lines = "".join(f"a,{t},0.5\n" for t in falling)
    (tmp_path / "set.csv").write_text("demo,time,x\n" + lines)
    with pytest.raises(DataFormatError, match=text):
        load_demonstrations(tmp_path / "set.csv")
    with pytest.raises(ValueError, match=r"at 1\.5 after 1\.5\. Sort the samples by time and drop repeated ones\.$"):
        Demonstrations([[0.0, 1.5, 1.5]], np.zeros((1, 3, 1)))
    with pytest.raises(ValueError, match=r"\.astype\('M8\[ns\]'\)\.astype\('int64'\) does in ns"):
        Demonstrations([falling.astype("M8[ns]")], np.zeros((1, 4, 1)))
    kept = Demonstrations([np.sort(falling).astype("M8[ns]").astype("int64")], np.zeros((1, 4, 1)), time_unit="ns")
    np.testing.assert_array_equal(kept.times[0], [0, 300, 400, 600])


# 66: units

WRONG = [
    "MM", "Mm", "M", "Cm", " mm", "mm.", "mms", "millimeter", "Millimetres", "milimeter", "milimeters", "meters",
    "Metre", "inch", "inches", "in", "ft", "feet", "micron", "micrometers", "µm", "μm", "yards", "miles",
    "degrees", "Degree", "Deg", "DEG", "degs", "°", "radians", "Rad", "radian", "rads", "milliradians", "kilometer",
]  # fmt: skip
WRONG_TIMES = [
    "sec", "secs", "seconds", "Second", "S", "Ms", "MS", "milliseconds", "Milliseconds", "millisecnds", "NS", "nsec",
    "usec", "µs", "minutes", "mins", "Min", "hours", "hr", "H", "nanoseconds", "microsecond",
    "m", "mm", "deg",
]  # fmt: skip
OWN = [
    "pixels", "px", "tablet units", "arbitrary drawing units", "normalized", "normalized by the authors", "N", "Nm",
    "Ns", "m/s", "1", "", "V", "counts", "units", "kg", "degC", "%", "tablet", "nm", "perimeter", "diameter", "mT",
    "s", "ms",
]  # fmt: skip


@pytest.mark.parametrize("unit", WRONG)
def test_66_misspelt_lengths_and_angles_are_refused_with_the_known_ones(unit, tmp_path):
    known = re.escape("the known units, km, m, dm, cm, mm, um; rad, deg; h, min, s, ms, us, ns")
    with pytest.raises(ValueError, match=rf"units\[1\] is {unit!r}, must be written as one of {known}"):
        Demonstrations([0.0, 1.0], np.zeros((1, 2, 2)), units=["m", unit])
    np.savez(tmp_path / "set.npz", t=np.arange(2.0), x=np.zeros((1, 2, 1)), meta=np.array(f'{{"unit": "{unit}"}}'))
    with pytest.raises(DataFormatError, match=f"units is {unit!r}, must be"):
        load_demonstrations(tmp_path / "set.npz")
    assert load_demonstrations(tmp_path / "set.npz", units="mm").units == ("mm",)


@pytest.mark.parametrize("unit", WRONG_TIMES)
def test_66_so_are_misspelt_times(unit, tmp_path):
    with pytest.raises(ValueError, match=f"time_unit is {unit!r}, must be written as one of the known units"):
        Demonstrations([0.0, 1.0], np.zeros((1, 2, 2)), time_unit=unit)
    (tmp_path / "set.csv").write_text("demo,time,x\na,0,1.5\na,1,2.5\n")
    with pytest.raises(ValueError, match="time_unit is"):
        load_demonstrations(tmp_path / "set.csv", time_unit=unit)


def test_66_known_units_and_words_that_are_none_stay():
    for unit in ("km", "m", "dm", "cm", "mm", "um", "rad", "deg", *OWN):
        assert Demonstrations([0.0, 1.0], np.zeros((1, 2, 1)), units=unit).units == (unit,)
    for unit in ("h", "min", "s", "ms", "us", "ns", "1", "phase", "frames", "normalized time in [0,1]"):
        assert Demonstrations([0.0, 1.0], np.zeros((1, 2, 1)), time_unit=unit).time_unit == unit
    shown = [Outputs(2, units) for units in (["mm", "mm"], ["deg", "deg"], ["rad", "rad"], ["mm", "m"], None)]
    assert [each.si for each in shown] == [1e-3, np.pi / 180.0, 1, 1, 1]
    assert [each.unit for each in shown] == ["mm", "deg", "rad", None, None]


@pytest.mark.parametrize(
    ("units", "message"),
    [
        (None, "tell no units: positions are taken to be in m"),
        (
            "pixels",
            r"in 'pixels', which is no known length or angle \(km, .*deg\): stiffness .* no limits of motion apply",
        ),
        (["mm", "m"], "in different units, mm, m"),
        ("mm", None),
        ("rad", None),
        ("deg", None),
    ],
)
def test_66_units_are_told_once_where_a_robot_cannot_know_them(units, message):
    recorded = Demonstrations(tunnel().times, tunnel().positions, units=units)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        as_demonstrations(recorded, None, None)
    assert len(caught) == (message is not None)
    assert all(re.search(message, str(w.message)) and w.filename == __file__ for w in caught)
    X, y, groups = tunnel().stack()
    as_demonstrations(X, y, groups)  # arrays are in m and s, and nothing is told


@pytest.mark.parametrize("name", SETS)
def test_66_70_all_recorded_sets_load_and_are_derived_without_a_word(name, recordings):
    recorded = load_demonstrations(recordings / f"{name}.npz")
    assert len(recorded[1:].resample(20)) == len(recorded.align(n=20)) - 1


# 69: columns that are no movement


def test_69_a_column_without_a_name_is_no_output(tmp_path):
    path = csv_of(tmp_path, as_table(tunnel()), index=True)
    with pytest.raises(DataFormatError, match=r"column 1 has no name.*index=False.*outputs= which of \[x, y\]"):
        load_demonstrations(path)
    assert load_demonstrations(path, outputs=["x", "y"]).positions[0].shape == (101, 2)
    path.write_text("demo,time,x,\na,0,1.5,\na,1,2.5,\n")
    with pytest.raises(DataFormatError, match="column 4 has no name"):
        load_demonstrations(path)
    several = as_table(tunnel()).assign(more=0).set_index("more", append=True)
    path = csv_of(tmp_path, several, index=True, index_label=["", ""])
    assert load_demonstrations(path, outputs="x").names == ("x",)


COUNTS = {
    "frame_index": lambda k, n: np.arange(n),
    "index": lambda k, n: n * k + np.arange(n),
    "Unnamed: 0": lambda k, n: n * k + np.arange(n),
    "seq": lambda k, n: 17 + np.arange(n),
    "task_index": lambda k, n: np.full(n, k // 2),
    "episode_id": lambda k, n: np.full(n, 3),
}


@pytest.mark.parametrize("name", COUNTS)
def test_69_counts_and_labels_are_outputs_only_if_they_are_named(name, tmp_path):
    path = csv_of(tmp_path, as_table(tunnel(), **{name: COUNTS[name]}))
    what = "numbers demonstrations" if name.endswith(("k_index", "_id")) else "counts rows"
    with pytest.raises(DataFormatError, match=rf"column '{name}': it {what}.*outputs=\['x', 'y'\]"):
        load_demonstrations(path)
    assert load_demonstrations(path, outputs=["x", "y"]).positions[3].tolist() == tunnel().positions[3].tolist()
    assert load_demonstrations(path, outputs=[name, "x"]).names == (name, "x")


def test_69_a_count_of_all_rows_is_one_where_rows_are_mixed(tmp_path):
    mixed = as_table(tunnel()).sort_values(["time", "demo"], ignore_index=True).reset_index(names="row")
    with pytest.raises(DataFormatError, match="column 'row': it counts rows"):
        load_demonstrations(csv_of(tmp_path, mixed))


MOVEMENTS = {
    "still": lambda k, n: np.full(n, 3),
    "steps": lambda k, n: np.arange(n) // 2,
    "fast": lambda k, n: 2 * np.arange(n),
    "half": lambda k, n: 0.5 + np.arange(n),
    "falling": lambda k, n: -np.arange(n),
    "gap": lambda k, n: np.arange(n) + (np.arange(n) > 50),
}


@pytest.mark.parametrize("name", MOVEMENTS)
def test_69_other_whole_numbers_are_outputs(name, tmp_path):
    path = csv_of(tmp_path, as_table(tunnel(), **{name: MOVEMENTS[name]}))
    assert load_demonstrations(path).names == (name, "x", "y")


def test_69_the_command_line_tells_the_column(tmp_path, capsys):
    path = csv_of(tmp_path, as_table(tunnel(), frame_index=COUNTS["frame_index"]))
    assert main(["fit", "--data", str(path), *FIT, "--output", str(tmp_path / "out")]) == 1
    assert "column 'frame_index': it counts rows" in capsys.readouterr().err


# 70: rotations


def poses(flip, order="xyzw", extra=1, decimals=9):
    """Positions, quaternions (xyzw or wxyz) and further outputs; ``flip`` tells the sign at each sample."""
    random = np.random.default_rng(0)
    recorded = tunnel()
    positions = []
    for k, (time, place) in enumerate(recorded):
        turns = np.stack([0.5 * time, 0.1 * time + 0.2 * random.normal(), np.sin(time)], axis=1)
        quaternion = Rotation.from_rotvec(turns).as_quat(scalar_first=order == "wxyz") * flip(k, len(time))[:, None]
        gripper = 0.04 * (time[:, None] > 1.0) + np.zeros(extra)
        positions.append(np.column_stack([place, 0.3 + 0.1 * time, np.round(quaternion, decimals), gripper]))
    names = ["x", "y", "z", *(f"q{letter}" for letter in order), *(f"gripper{i}" for i in range(extra))]
    return recorded.times, positions, names


FLIPS = {
    "none": lambda k, n: np.ones(n),
    "one recording": lambda k, n: np.full(n, -1.0 if k == 2 else 1.0),
    "within": lambda k, n: np.where((np.arange(n) > 40) & (k == 1), -1.0, 1.0),
}


@pytest.mark.parametrize("flip", FLIPS.values(), ids=list(FLIPS))
@pytest.mark.parametrize(("order", "extra", "decimals"), [("xyzw", 1, 9), ("wxyz", 0, 3), ("wxyz", 3, 4)])
def test_70_unit_quaternions_are_told_and_no_controller_learns_them(flip, order, extra, decimals):
    times, positions, names = poses(flip, order, extra, decimals)
    text = (
        f"Outputs {', '.join(f'q{letter}' for letter in order)} have the squared sum 1, as unit quaternions.*leave them"
    )
    with pytest.warns(UserWarning, match=text) as caught:
        recorded = Demonstrations(times, positions, names=names, units="m")
    assert len(caught) == 1
    assert caught[0].filename == __file__
    for derived in (
        recorded,
        recorded.align(),
        recorded.resample(30).from_start(),
        recorded[1:],
        pickle.loads(pickle.dumps(recorded)),
    ):
        with pytest.raises(ValueError, match=rf"controller cannot be learned of these outputs\. {text}"):
            controller().fit(derived)
    places = Demonstrations(times, [position[:, :3] for position in positions], names=names[:3], units="m")
    assert as_demonstrations(places, None, None) is places


def wrapped(center, unit="rad", speed=2.0):
    """An angle and a constant around ``center``, as an encoder tells it: in -180 to 180 degrees."""
    turn = 2.0 * np.pi if unit == "rad" else 360.0
    angles = [center + speed * np.sin(2.0 * time) + 0.1 * k for k, time in enumerate(tunnel().times)]
    scaled = [np.remainder(angle + np.pi, 2.0 * np.pi) - np.pi for angle in angles]
    return tunnel().times, [
        np.column_stack([a * turn / (2.0 * np.pi), p[:, 0]]) for a, p in zip(scaled, tunnel().positions, strict=True)
    ]


@pytest.mark.parametrize("told", [True, False], ids=["unit", "no unit"])
@pytest.mark.parametrize("unit", ["rad", "deg"])
def test_70_angles_that_jump_by_a_turn_are_told_and_no_controller_learns_them(unit, told):
    times, positions = wrapped(3.0, unit)
    turn = "6.283" if unit == "rad" else "360"
    text = re.escape(f"Output j1 jumps by a turn, {turn} {unit}, ") + ".*" + re.escape("Say angles=['j1'], and that")
    with pytest.warns(UserWarning, match=text):
        recorded = Demonstrations(times, positions, names=["j1", "j2"], units=unit if told else None)
    for derived in (recorded, recorded.align(), recorded.resample(40)):
        with pytest.raises(ValueError, match=text):
            controller().fit(derived)
    sound = Demonstrations(times, positions, names=["j1", "j2"], units=unit, angles="j1")
    assert np.abs(controller().fit(sound).schedule(50.0).velocity[:, 0]).max() < 5.0 * (1.0 if unit == "rad" else 57.3)


SOUND = {
    "joints": (lambda: wrapped(0.0, speed=2.5), "rad"),
    "degrees": (lambda: wrapped(0.0, "deg", 2.5), "deg"),
    "millimetres": (lambda: wrapped(3.0, "deg"), "mm"),
    "noise": (lambda: (np.arange(30.0), 3.0 * np.random.default_rng(0).normal(size=(6, 30, 5))), None),
    "noise of degrees": (lambda: (np.arange(30.0), 170.0 * np.random.default_rng(0).normal(size=(6, 30, 5))), None),
    "near norm 1": (
        lambda: (np.arange(30.0), [1.0, 0, 0, 0] + 1e-3 * np.random.default_rng(0).normal(size=(6, 30, 4))),
        "m",
    ),
    "constant": (lambda: (np.arange(30.0), np.tile([0.5, 0.5, 0.5, 0.5], (6, 30, 1))), "m"),
    "gripper": (lambda: (np.arange(30.0), np.repeat(np.tile([0.0, 1.0], (6, 15))[..., None], 4, axis=2)), "m"),
    "huge": (lambda: (np.arange(3.0), np.array([[[-1.7e308] * 4, [0.0] * 4, [1.7e308] * 4]])), None),
}


@pytest.mark.parametrize("case", SOUND)
def test_70_what_is_no_rotation_is_not_told(case):
    make, units = SOUND[case]
    with np.errstate(all="raise"):
        Demonstrations(*make(), units=units)
    if case == "millimetres":
        with pytest.warns(UserWarning, match="y0 jumps by a turn"):
            Demonstrations(*make())


def test_70_the_command_line_tells_of_rotations(tmp_path, capsys):
    times, positions, names = poses(FLIPS["one recording"])
    with pytest.warns(UserWarning, match="unit quaternions"):
        save_demonstrations(Demonstrations(times, positions, names=names), tmp_path / "poses.csv")
    output = ["--output", str(tmp_path / "out")]
    assert main(["fit", "--data", str(tmp_path / "poses.csv"), *FIT, *output]) == 0
    assert capsys.readouterr().err.count("as unit quaternions do") == 1
    assert main(["experiment", "--data", str(tmp_path / "poses.csv"), *output]) == 1
    assert "controller cannot be learned of these outputs" in capsys.readouterr().err


# 71: which loader, which suffix


def test_71_each_loader_names_the_others(tmp_path):
    torch_pbd.save(model(), tmp_path / "skill.safetensors")
    files = {torch_pbd.load: ["skill.safetensors"], Schedule.load: [], load_demonstrations: []}
    for suffix in ("npz", "json", "csv"):
        schedule().save(tmp_path / f"schedule.{suffix}")
        files[Schedule.load].append(f"schedule.{suffix}")
    for suffix in ("npz", "csv"):
        save_demonstrations(tunnel(), tmp_path / f"demonstrations.{suffix}")
        files[load_demonstrations].append(f"demonstrations.{suffix}")
    (tmp_path / "pickled.pkl").write_bytes(pickle.dumps(model()))
    for load in files:
        for name in [name for names in [*files.values(), ["pickled.pkl"]] for name in names]:
            if name in files[load]:
                load(tmp_path / name)
                continue
            with pytest.raises(
                (ValueError, ModelFileError), match=rf"{name}.*Models are read by torch_pbd\.load, sched"
            ):
                load(tmp_path / name)


@pytest.mark.parametrize(
    "suffix", [".pkl", ".PICKLE", ".joblib", ".pt", ".pth", ".npz", ".json", ".csv", ".yaml", ".h5"]
)
def test_71_a_model_is_not_saved_as_another_format(suffix, tmp_path):
    with pytest.raises(ValueError, match=r"suffix of another format: take \.safetensors"):
        torch_pbd.save(model(), tmp_path / f"m{suffix}")
    assert not list(tmp_path.iterdir())
    for name in ("m.safetensors", "m", "m.model", "release.v2"):
        torch_pbd.save(model(), tmp_path / name)
        (tmp_path / name).rename(tmp_path / f"old{suffix}")  # as it was once called
        assert torch_pbd.load(tmp_path / f"old{suffix}").n_outputs_ == 2


def test_71_titles_of_schedules_need_no_quotes_and_old_ones_are_read(tmp_path):
    schedule().save(tmp_path / "schedule.csv")
    text = (tmp_path / "schedule.csv").read_text()
    table = pd.read_csv(io.StringIO(text), comment="#")
    np.testing.assert_array_equal(table["stiffness[x][y]"], schedule().stiffness[:, 0, 1])
    title = next(line for line in text.splitlines() if line.startswith("time"))
    assert '"' not in title
    old = re.sub(r"(\w+\[\w+)\]\[(\w+\])", r'"\1,\2"', title)
    assert old.count('"') == 2 * 9
    (tmp_path / "schedule.csv").write_text(text.replace(title, old))
    assert Schedule.load(tmp_path / "schedule.csv") == schedule()


# 83: timing that was taken out


def test_83_demonstrations_remember_how_they_were_aligned(tmp_path):
    raw = make_tunnel_demonstrations(4, 2.0, 20.0, random_state=0, variant="unequal")
    by_phase, warped = raw.align(), raw.align("dtw", n=30)
    assert (raw.alignment, by_phase.alignment, warped.alignment) == (None, "phase", "dtw")
    assert (by_phase.align("dtw").alignment, warped.align("phase").alignment) == ("dtw", "dtw")
    for recorded in (raw, by_phase, warped):
        save_demonstrations(recorded, tmp_path / "set.npz")
        copies = [*recorded.split(1), recorded[1:3], recorded.resample(9), recorded.from_start()]
        copies += [pickle.loads(pickle.dumps(recorded)), load_demonstrations(tmp_path / "set.npz")]
        assert {copy.alignment for copy in copies} == {recorded.alignment}
        with pytest.raises(AttributeError):
            recorded.alignment = None
    np.savez(tmp_path / "set.npz", t=np.arange(2.0), x=np.zeros((1, 2, 1)), meta=np.array('{"alignment": "by hand"}'))
    with pytest.raises(DataFormatError, match="alignment is 'by hand', must be one of 'phase', 'dtw'"):
        load_demonstrations(tmp_path / "set.npz")


def test_83_a_controller_tells_of_timing_that_comes_back():
    raw = make_tunnel_demonstrations(4, 2.0, 20.0, random_state=0, variant="unequal")
    with pytest.warns(UserWarning, match=r"dynamic time warping.*3\.7 nats a step.*align\('phase'\)") as caught:
        controller(duration=2.0).fit(raw.align("dtw", n=30))
    assert [w.filename for w in caught] == [__file__]
    as_demonstrations(raw.align("phase"), None, None)
    assert "3.7 nats" in Demonstrations.align.__doc__


def test_83_so_does_the_command_line(tmp_path, capsys):
    save_demonstrations(make_tunnel_demonstrations(4, 2.0, 20.0, random_state=0), tmp_path / "set.npz")
    run = ["fit", *FIT, "--data", str(tmp_path / "set.npz"), "--align", "dtw", "--output", str(tmp_path / "out")]
    assert main(run) == 0
    assert capsys.readouterr().err.count("dynamic time warping") == 1

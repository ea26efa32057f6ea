"""Recordings by one door: files as people have them, tables, what is made of demonstrations, the command line."""

import dataclasses
import inspect
import subprocess
import sys
import warnings
from datetime import UTC, datetime, timedelta
from decimal import Decimal

import numpy as np
import pandas as pd
import polars as pl
import pyarrow as pa
import pytest

from torch_pbd.cli.main import main
from torch_pbd.data import Demonstrations, load_demonstrations, make_tunnel_demonstrations, save_demonstrations
from torch_pbd.data.wanted import Wanted
from torch_pbd.exceptions import DataFormatError, MissingDataWarning

X = np.array([[1.0, 2.0], [3.0, 4.0], [5.0, 7.0]])
PLAIN = Demonstrations([[0.0, 0.5, 1.0]], [X], names=["x", "y"])


def load_text(folder, text, name="set.csv", **options):
    (folder / name).write_text(text)
    return load_demonstrations(folder / name, **options)


def lines(*stamps, rows=X, sep=","):
    return "".join(sep.join([str(s), *map(str, row)]) + "\n" for s, row in zip(stamps, rows, strict=True))


@pytest.mark.parametrize(
    ("text", "options"),
    [
        ("time,x,y\n" + lines(0, 0.5, 1), {}),  # no column of demonstrations: there is one
        ("# my robot\n# 2 Hz\ntime,x,y\n" + lines(0, 0.5, 1), {}),
        ("# time,x,y\n" + lines(0, 0.5, 1), {}),  # as numpy.savetxt writes headers
        ("stamp;x;y\n" + lines(0, 500, 1000, sep=";"), {"time": "stamp", "time_unit": "ms"}),
        ("x,y\n1,2\n3,4\n5,7\n", {"rate": 2.0}),
        ("time,x,y\n7,1,2\n7,3,4\n1,5,7\n", {"rate": 2.0}),  # its own times, which are none, are no output
        (
            "time,x,y\n" + lines("2026-11-29T12:00:00.25Z", "2026-11-29 12:00:00.75+00:00", "2026-11-29T12:00:01.250"),
            {},
        ),
        ("time,x,y\n" + lines("23:59:59.5", "23:59:60", "23:59:60.5"), {}),
        ("time,x,y\n" + lines("0:00:00", "0:01:00", "0:02:00"), {"time_unit": "min"}),
        # Clocks are set back between the second and the third.
        ("time,x,y\n" + lines("2026-10-25T02:59:59+02:00", "2026-10-25 02:59:59.5+0200", "2026-10-25T02:00+01"), {}),
        ("time,x,y\n" + lines("2026-01-01 05:29:59+05:30", "2025-12-31 20:29:59.5-03:30", "2026-01-01T00:00Z"), {}),
        ("time,frame_id,x,y\n0,world,1,2\n0.5,world,3,4\n1,world,5,7\n", {"outputs": ["x", "y"]}),
        ("time,x,y\n" + lines(*(1_700_000_000_000_000_001 + 500_000_000 * k for k in range(3))), {"time_unit": "ns"}),
    ],
    ids=[
        "one",
        "comments",
        "savetxt",
        "ms",
        "rate",
        "rate-time",
        "iso",
        "clock",
        "minutes",
        "zones",
        "half-hours",
        "text",
        "ns",
    ],
)
def test_tables_as_people_have_them(tmp_path, text, options):
    loaded = load_text(tmp_path, text, **options)
    scale = {"ms": 1e3, "ns": 1e9, "min": 2.0}.get(options.get("time_unit"), 1.0)
    np.testing.assert_array_equal(loaded.times[0], PLAIN.times[0] * scale)
    np.testing.assert_array_equal(loaded.positions[0], X)
    assert loaded.names == ("x", "y")
    assert loaded.time_unit == options.get("time_unit", "s")


@pytest.mark.parametrize("stamps", [("00:01", "00:02", "00:03"), ("0:00.5", "0:01.0", "0:01.5")])
def test_clock_text_of_two_parts_is_hours_or_minutes(tmp_path, stamps):
    with pytest.raises(DataFormatError, match=rf"column 'time': '{stamps[0]}' is hh:mm or mm:ss.*write 00: before"):
        load_text(tmp_path, "time,x,y\n" + lines(*stamps))
    loaded = load_text(tmp_path, "time,x,y\n" + lines(*(f"00:{stamp}" for stamp in stamps)))
    assert loaded.times[0][-1] == {"00:03": 2.0, "0:01.5": 1.0}[stamps[-1]]


@pytest.mark.parametrize("kind", ["dates", "ns", "float"])
def test_times_of_several_files_count_from_the_first_of_all(tmp_path, kind):
    for k in (0, 1):  # the second is a minute earlier
        minute, seconds = 1 - k, range(3)
        stamps = {
            "dates": [f"2026-01-01T10:0{minute}:0{i}" for i in seconds],
            "ns": [(1_700_000_000 + 60 * minute + i) * 10**9 + 123 for i in seconds],
            "float": [60.0 * minute + i for i in seconds],
        }[kind]
        (tmp_path / f"{k}.csv").write_text("time,x,y\n" + lines(*stamps))
    unit = {"time_unit": "ns"} if kind == "ns" else {}
    loaded = load_demonstrations(tmp_path / "*.csv", **unit)
    second = 1e9 if kind == "ns" else 1.0
    assert [[*(time / second)] for time in loaded.times] == [[60.0, 61.0, 62.0], [0.0, 1.0, 2.0]]
    assert load_demonstrations(tmp_path / "*.csv", from_start=True, **unit).is_aligned
    bad = stamps[:1] + stamps[:1] + stamps[2:]
    (tmp_path / "1.csv").write_text("time,x,y\n" + lines(*bad))
    with pytest.raises(DataFormatError, match=r"1\.csv: times\[0\] must increase strictly"):
        load_demonstrations(tmp_path / "*.csv", **unit)


def test_a_file_of_several_without_samples_is_named(tmp_path):
    for k, n in enumerate((3, 0)):
        np.savez(tmp_path / f"{k}.npz", t_0=np.arange(n), x_0=np.ones((n, 2)))
    with pytest.raises(DataFormatError, match=r"1\.npz: times\[0\] has 0 samples"):
        load_demonstrations(tmp_path / "*.npz")


@pytest.mark.parametrize("cell", ["NA", "None", "null", "", "NaN"])
def test_words_for_missing_cells_are_dropped_on_request(tmp_path, cell):
    text = "time,x,y\n" + lines(0, 0.5, 1).replace("3.0", cell)
    with pytest.raises(DataFormatError, match=r"line 3, column 'x'.*missing='drop'"):
        load_text(tmp_path, text)
    with pytest.warns(MissingDataWarning, match="1 of 3 in demonstration 0"):
        assert load_text(tmp_path, text, missing="drop").n_steps == (2,)


@pytest.mark.parametrize("blank", ["", "NaN", "NaT"])
def test_a_time_that_is_missing_changes_no_other(tmp_path, blank):
    dates = "time,x\n" + "".join(
        f"{stamp},{i}.5\n" for i, stamp in enumerate(["10:00:00", blank, "10:00:01", "10:00:02"])
    )
    for text in (dates, dates.replace("10:", "2024-01-01 10:")):
        with pytest.warns(MissingDataWarning, match="1 of 4"):
            assert load_text(tmp_path, text, missing="drop").times[0].tolist() == [0.0, 1.0, 2.0]
    stamps = "time,x\n" + "".join(f"{1_700_000_000_000_000_000 + 2**30 * i},{i}.5\n" for i in range(3))
    (tmp_path / "whole.csv").write_text(stamps)
    (tmp_path / "set.csv").write_text(f"{stamps}{blank},3.5\n")
    with pytest.warns(MissingDataWarning, match="1 of 4"):
        first, second = load_demonstrations(tmp_path / "*.csv", missing="drop", time_unit="ns").times
    np.testing.assert_array_equal(first, second)


@pytest.mark.parametrize(
    "stamps", [("58.5", "59.5", "00:01:00.5"), ("00:00:58", "59", "60"), ("2024-01-01 10:00:00", "10:00:01", "11")]
)
def test_times_of_several_kinds_in_a_column_are_refused(tmp_path, stamps):
    with pytest.raises(DataFormatError, match=r"line \d, column 'time': '.*' is a .*, must be a .* as those above"):
        load_text(tmp_path, "time,x,y\n" + lines(*stamps))


def test_a_column_that_numbers_the_demonstrations_is_found_out(tmp_path):
    trials, stamps = np.repeat([0, 1, 2], 20), np.arange(60) * 0.1
    text = "trial,time,x\n" + "".join(f"{k},{t},{np.sin(t)}\n" for k, t in zip(trials, stamps, strict=True))
    with pytest.raises(DataFormatError, match=r"column 'trial': it numbers demonstrations.*demo='trial'"):
        load_text(tmp_path, text)
    assert load_text(tmp_path, text, demo="trial").n_steps == (20, 20, 20)
    counted = "time,x\n" + "".join(f"{t},{i}\n" for i, t in enumerate(stamps))
    with pytest.raises(DataFormatError, match=r"it counts rows, and is no movement.*say outputs=\['x'\]"):
        load_text(tmp_path, counted)
    assert load_text(tmp_path, counted, outputs=["x"]).names == ("x",)
    gripper = "time,x,gripper\n" + "".join(f"{t},{np.sin(t)},{int(t > 3)}\n" for t in stamps)
    assert load_text(tmp_path, gripper).names == ("x", "gripper")
    again = text.replace("trial,", "trial,", 1).splitlines()
    back = "\n".join([again[0], *(f"{line.split(',')[0]},{i % 20},{i}" for i, line in enumerate(again[1:]))])
    with pytest.raises(DataFormatError, match="tells the demonstrations apart"):
        load_text(tmp_path, back)
    both = text.replace("trial,time,x", "trial,time,x,seq").replace("\n", ",SEQ\n").replace("seq,SEQ", "seq")
    for i in range(60):
        both = both.replace("SEQ", str(i), 1)
    with pytest.raises(DataFormatError, match=r"outputs=\['x'\], and demo='trial'"):  # neither of two is proposed
        load_text(tmp_path, both)


def test_labels_of_demonstrations_may_be_of_any_length(tmp_path):
    recorded = make_tunnel_demonstrations(3, random_state=0)
    save_demonstrations(recorded, tmp_path / "set.csv")
    assert load_demonstrations(tmp_path / "set.csv", units="m") == recorded
    text = (tmp_path / "set.csv").read_text()
    for number, n in ((0, 40), (2, 8), (2, 7)):
        assert load_text(tmp_path, text.replace(f"\n{number},", "\n" + "a" * n + ","), units="m") == recorded


def test_folders_lists_and_patterns_are_one_recording_a_file(tmp_path):
    for k in range(12):
        load_text(tmp_path, "time,x,y\n" + lines(0, 0.5, 1, rows=X + k), f"trial_{k}.csv")
    wanted = Demonstrations([PLAIN.times[0]] * 12, [X + k for k in range(12)], names=["x", "y"])
    assert load_demonstrations(tmp_path) == wanted  # trial_10 after trial_9
    assert load_demonstrations(str(tmp_path / "trial_*.csv")) == wanted
    picked = load_demonstrations([tmp_path / "trial_3.csv", str(tmp_path / "trial_1.csv")])
    assert picked == wanted[[3, 1]]
    with pytest.raises(FileNotFoundError, match=r"run_\*\.csv matches no file"):
        load_demonstrations(tmp_path / "run_*.csv")
    np.save(tmp_path / "more.npy", X)
    with pytest.raises(FileNotFoundError, match=r"several formats, \.csv, \.npy: name those to read"):
        load_demonstrations(tmp_path)
    (tmp_path / "empty").mkdir()
    with pytest.raises(FileNotFoundError, match=r"no file of \.npz"):
        load_demonstrations(tmp_path / "empty")
    load_text(tmp_path, "time,x,z\n" + lines(0, 0.5, 1), "trial_99.csv")
    with pytest.raises(ValueError, match=r"parts\[12\] has names \('x', 'z'\), must be as parts\[0\]"):
        load_demonstrations(tmp_path / "trial_*.csv")


@pytest.mark.parametrize("library", [pd.DataFrame, pl.DataFrame, pa.table])
def test_frames_of_other_libraries_are_taken(library):
    recorded = make_tunnel_demonstrations(3, rate=5.0, random_state=0, variant="unequal")
    table = recorded.to_frame(library.__module__.partition(".")[0])
    assert type(table) is (pa.Table if library is pa.table else library)
    assert Demonstrations.from_frame(table, units="m") == recorded
    mixed = {"k": list("aababb"), "t": np.array([0, 1, 0, 2, 1, 2]), "x": np.arange(6.0), "y": np.arange(6.0) ** 2}
    made = Demonstrations.from_frame(library(mixed), demo="k", time="t", outputs=["y", "x"], time_unit="ms")
    expected = [np.array([[0, 0], [1, 1], [9, 3]]), np.array([[4, 2], [16, 4], [25, 5]])]
    assert made == Demonstrations([[0, 1, 2]] * 2, expected, names=["y", "x"], time_unit="ms")


def test_labels_may_be_of_several_kinds():
    table = pd.DataFrame({"demo": ["a", 1, "a", 1], "time": [0.0, 0.0, 1.0, 1.0], "x": [0.5, 1.0, 2.0, 4.0]})
    assert [position.ravel().tolist() for _, position in Demonstrations.from_frame(table)] == [[0.5, 2.0], [1.0, 4.0]]
    table["demo"] = [["a"], ["b"]] * 2
    with pytest.raises(ValueError, match="column 'demo' holds lists or alike, must be texts or numbers"):
        Demonstrations.from_frame(table)


@pytest.mark.parametrize("blank", [None, pd.NA, np.nan])
def test_objects_that_are_numbers_are_numbers_and_may_be_missing(blank):
    columns = {"time": [0, 1.0, 2.0, blank], "x": [True, blank, False, True], "y": [Decimal("1.5"), 2, 3, 4]}
    table = pd.DataFrame({name: pd.Series(values, dtype=object) for name, values in columns.items()})
    with pytest.raises(ValueError, match="missing='drop' leaves such samples out"):
        Demonstrations.from_frame(table)
    with pytest.warns(MissingDataWarning, match="2 of 4"):
        kept = Demonstrations.from_frame(table, missing="drop")
    assert kept == Demonstrations([0.0, 2.0], [[[1.0, 1.5], [0.0, 3.0]]], names=["x", "y"])


def test_frames_have_the_guards_of_files():
    dates = pd.date_range("2026-01-01", periods=3, freq="20ms")
    table = pd.DataFrame({"when": dates, "x": X[:, 0], "label": list("abc")}).reset_index()
    with pytest.raises(ValueError, match=r"column 'label' holds object|column 'label' holds str"):
        Demonstrations.from_frame(table, time="when", outputs=["x", "label"])
    made = Demonstrations.from_frame(table, time="when", outputs="x")
    np.testing.assert_array_equal(made.times[0], [0.0, 0.02, 0.04])
    assert made.time_unit == "s"
    milliseconds = Demonstrations.from_frame(table, time="when", outputs="x", time_unit="ms")
    assert milliseconds.times[0].tolist() == [0.0, 20.0, 40.0]
    with pytest.raises(ValueError, match=r"no column 'time' among \[index, when, x, label\].*rate="):
        Demonstrations.from_frame(table)
    counted = pd.DataFrame({"time": np.arange(9.0), "x": np.arange(9.0) ** 2, "row": np.arange(9)})
    with pytest.raises(ValueError, match="column 'row': it counts rows"):
        Demonstrations.from_frame(counted)
    with pytest.raises(TypeError, match="frames have no option 'unit'; did you mean 'units'"):
        Demonstrations.from_frame(table, unit="m")


def test_columns_and_times_that_are_no_names_and_numbers_are_told():
    table = pd.DataFrame({"time": [0.0, 1.0], "x": [1.0, 3.0]})
    for names in ([("a", "time"), ("a", "x")], [0, 1]):
        with pytest.raises(ValueError, match=r"table\.columns is \[.*\], must be texts: join levels"):
            Demonstrations.from_frame(table.set_axis(pd.Index(names), axis=1))
    clock = pl.DataFrame({"time": [0, 10**9], "x": [1.0, 3.0]}).with_columns(pl.col("time").cast(pl.Time))
    with pytest.raises(ValueError, match=r"time is datetime\.time\(0, 0\), must be a datetime64 or a number"):
        Demonstrations.from_frame(clock)
    dates = pd.DataFrame({"time": pd.to_datetime(["2026-01-01", None, "2026-01-02"]), "x": [1.0, 2.0, 4.0]})
    with pytest.warns(MissingDataWarning, match="1 of 3"):
        assert Demonstrations.from_frame(dates, missing="drop", time_unit="h").times[0].tolist() == [0.0, 24.0]


def test_frames_of_polars_have_types_of_their_own():
    stamps = [datetime(2026, 1, 1, tzinfo=UTC) + timedelta(milliseconds=20 * i) for i in range(3)]
    table = pl.DataFrame({"demo": ["a"] * 3 + ["b"] * 3, "time": stamps * 2, "x": [1, None, 3, 4, 5, 6]})
    table = table.cast({"demo": pl.Categorical})
    with pytest.warns(MissingDataWarning, match="1 of 3 in demonstration 0"):
        made = Demonstrations.from_frame(table, missing="drop", units="mm", in_units=["m", "ms"], from_start=True)
    assert made == Demonstrations(
        [[0, 20 * 2], [0, 20, 40]], [[0.001, 0.003], [0.004, 0.005, 0.006]], names=["x"], units="m", time_unit="ms"
    )
    pairs = pl.DataFrame({"time": [0.0, 1.0], "pos": pl.Series([[1, 2], [3, 5]], dtype=pl.Array(pl.Float64, 2))})
    assert Demonstrations.from_frame(pairs) == Demonstrations([0, 1], [[[1, 2], [3, 5]]], names=["pos_x", "pos_y"])
    with pytest.raises(ValueError, match=r"table is .*, must be a dataframe .*with its rows: collect\(\) lazy ones"):
        Demonstrations.from_frame(table.lazy())
    with pytest.raises(ValueError, match="column 'demo' is blank in row 3: it tells the demonstrations apart"):
        Demonstrations.from_frame(table.with_columns(demo=pl.Series([*"aaa", None, *"bb"])), outputs="x")


def test_labels_that_differ_are_not_concatenated_and_outputs_are_selected():
    recorded = make_tunnel_demonstrations(3, rate=5.0, random_state=0)
    assert Demonstrations.concatenate([recorded[:1], recorded[1:]]) == recorded
    assert recorded.select("y").positions[2].tolist() == recorded.positions[2][:, 1:].tolist()
    assert recorded.select(["y", "x"]).select(["x", "y"]) == recorded
    with pytest.raises(ValueError, match=r"outputs is \['z'\], must be different ones of \[x, y\]"):
        recorded.select("z")
    with pytest.raises(ValueError, match=r"parts\[1\] has units \('mm', 'mm'\), must be as parts\[0\], \('m', 'm'\)"):
        Demonstrations.concatenate([recorded, recorded.in_units("mm")])
    with pytest.raises(ValueError, match="parts is empty"):
        Demonstrations.concatenate([])


def test_units_are_converted_by_their_kind():
    mocap = Demonstrations([[0, 10, 30]], [[[1, 90], [2, 180], [1500, 0]]], units=["mm", "deg"], time_unit="ms")
    metres = mocap.in_units("m", "s")
    assert metres.units == ("m", "deg")
    assert metres.time_unit == "s"
    assert metres.times[0].tolist() == [0.0, 0.01, 0.03]
    assert metres.positions[0].tolist() == [[0.001, 90], [0.002, 180], [1.5, 0]]
    np.testing.assert_allclose(mocap.in_units("rad").positions[0][:, 1], [np.pi / 2, np.pi, 0], rtol=1e-15)
    assert metres.in_units("mm", "ms") == mocap
    assert mocap.in_units(["m", "s"]) == metres
    assert mocap.in_units(["m", "rad"], "s") == metres.in_units("rad")
    with pytest.raises(ValueError, match=r"unit is 'm', must be of the kind of one of the outputs.*give units="):
        PLAIN.in_units("m")
    with pytest.raises(ValueError, match="time_unit is 's', must be one of h, min"):
        PLAIN.align().in_units(time_unit="s")


def test_files_are_converted_as_they_are_loaded(tmp_path, capsys):
    load = {"units": ["mm", "deg"], "time_unit": "ms", "in_units": ["m", "rad", "s"]}
    loaded = load_text(tmp_path, "time,x,angle\n0,1,90\n10,2,180\n30,1500,0\n", **load)
    mocap = Demonstrations(
        [[0, 10, 30]], [[[1, 90], [2, 180], [1500, 0]]], names=["x", "angle"], units=["mm", "deg"], time_unit="ms"
    )
    assert loaded == mocap.in_units("m", "s").in_units("rad")
    # Of several files each has units of its own.
    save_demonstrations(mocap, tmp_path / "a.npz")
    save_demonstrations(mocap.in_units("cm", "s"), tmp_path / "b.npz")
    both = load_demonstrations([tmp_path / "a.npz", tmp_path / "b.npz"], in_units=["m", "s"])
    assert both[:1] == both[1:] == mocap.in_units("m", "s")
    (tmp_path / "run.yaml").write_text(f"data: {tmp_path}/[ab].npz\nloader: {{in_units: [m, s]}}\n")
    shown = []
    for arguments in (["--config", f"{tmp_path}/run.yaml"], [f"{tmp_path}/[ab].npz", "--loader.in_units", "[m, s]"]):
        assert main(["inspect", *arguments, "--output", str(tmp_path / "out")]) == 0
        shown.append(capsys.readouterr().out)
    assert "start [s]  lasts [s]" in shown[0]
    assert shown[0] == shown[1]
    with pytest.raises(ValueError, match=r"unit is 'm', must be of the kind of one of the outputs.*give units="):
        load_demonstrations(tmp_path / "set.csv", time_unit="ms", in_units="m")


def movements(noise=0.0):
    """Three movements of 1 s, with 1 s of rest before, between and after them; at 100 Hz."""
    time = np.arange(701) / 100
    s = np.clip((time[:, None] - [1, 3, 5]), 0, 1)
    path = (s**3 * (10 - 15 * s + 6 * s**2)) @ [[0.3, 0.1], [-0.2, 0.2], [0.1, -0.3]]
    return time, path + noise * np.random.default_rng(0).normal(size=path.shape)


@pytest.mark.parametrize("noise", [0.0, 5e-4])
def test_long_recordings_are_cut_at_pauses_and_times(noise, tmp_path):
    time, path = movements(noise)
    long = Demonstrations([time], [path], names=["x", "y"])
    cut = long.cut()
    assert len(cut) == 3
    for k, (own, _) in enumerate(cut):
        # All but the slow beginning and end, within 2 % of the extent: a minimum-jerk path takes 0.1 to 0.2 s for it.
        assert 1 + 2 * k <= own[0] + 0.05 <= 1.3 + 2 * k
        assert 1.7 + 2 * k <= own[-1] <= 2.05 + 2 * k
    by_hand = long.cut([(1.0, 2.0), (3.0, 4.0)])
    assert [(t[0], t[-1], len(t)) for t in by_hand.times] == [(1.0, 2.0, 101), (3.0, 4.0, 101)]
    np.testing.assert_array_equal(by_hand.positions[1], path[300:401])
    save_demonstrations(long, tmp_path / "long.npz")
    started = load_demonstrations(tmp_path / "long.npz", cut="pauses", from_start=True)
    assert started == cut.from_start()
    trimmed = long.trim()
    assert 0.95 <= trimmed.times[0][0] <= 1.3
    assert 5.7 <= trimmed.times[0][-1] <= 6.05
    with pytest.raises(ValueError, match=r"at\[0\] holds 0 samples between 8 and 9"):
        long.cut([(8, 9)])
    with pytest.raises(ValueError, match="there are 3 recordings, must be one to be cut"):
        cut.cut()
    with pytest.raises(ValueError, match="nothing moves"):
        Demonstrations([time], [np.where(time > 6.99, 1.0, 0.0)]).cut()


FIT = ["--model", "GMMBaseline", "--model.n_components", "2", "--align", "phase"]


def test_loader_options_are_on_the_command_line_and_in_yaml(tmp_path, capsys):
    recorded = make_tunnel_demonstrations(3, rate=5.0, random_state=0).to_frame()
    recorded.columns = ["trial", "stamp", "px", "py"]
    table = recorded.assign(stamp=(recorded["stamp"] * 1e9).astype("int64") + 10**18, note="hello")
    table.to_csv(tmp_path / "ros.csv", index=False)
    output = ["--output", str(tmp_path / "out")]
    options = ["--loader.demo", "trial", "--loader.time=stamp", "--loader.outputs", "[px,", "py]"]
    arguments = ["fit", "--data", str(tmp_path / "ros.csv"), *FIT, *output]
    assert main([*arguments, *options, "--loader.time_unit", "ns"]) == 0
    assert "3 demonstrations of 51 samples, 2 outputs (px, py)" in capsys.readouterr().out
    (tmp_path / "run.yaml").write_text(
        f"data: {tmp_path}/r*.csv\nloader: {{demo: trial, time: stamp, outputs: [px, py], time_unit: ns}}\n"
    )
    assert main(["fit", "--config", str(tmp_path / "run.yaml"), *FIT, *output]) == 0
    capsys.readouterr()
    assert main(arguments) == 1
    told = capsys.readouterr().err
    assert "no column 'time' among [trial, stamp, px, py, note]: say time='stamp', if that is it" in told
    assert "Here time= is written --loader.time." in told
    assert main([*arguments, *options, "--loader.outputs", "[pz]"]) == 1
    assert "name the one meant by outputs=. Here outputs= is written --loader.outputs." in capsys.readouterr().err
    assert main([*arguments, "--loader.outpust", "px"]) == 2
    assert "no option 'outpust'; did you mean 'outputs'?" in capsys.readouterr().err
    assert main(["fit", "--data", str(tmp_path / "gone_*.csv"), *FIT, *output]) == 2
    assert "matches no file" in capsys.readouterr().err


def test_the_options_of_the_door_are_those_of_all_formats():
    door = inspect.signature(load_demonstrations).parameters.values()
    assert {p.name: p.default for p in door if p.kind is p.KEYWORD_ONLY} == {
        field.name: field.default for field in dataclasses.fields(Wanted) if field.name != "notes"
    }


def test_marks_are_given_on_the_command_line_as_they_are(tmp_path, capsys):
    (tmp_path / "set.csv").write_text("time|x\n0|1,0\n1|2,5\n2|4,0\n")
    options = ["--loader.decimal", ",", "--loader.delimiter", "|", "--output", str(tmp_path / "out")]
    assert main(["inspect", str(tmp_path / "set.csv"), *options]) == 0
    assert "x none 1.00 4.00 3.00" in " ".join(capsys.readouterr().out.split())


def test_nothing_is_said_of_good_files(tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert load_text(tmp_path, "time,x,y\n" + lines(0, 0.5, 1)) == PLAIN


def test_no_library_of_a_format_is_loaded_until_its_format_is_read(tmp_path):
    load_text(tmp_path, "time,x,y\n" + lines(0, 0.5, 1))
    program = (
        "import sys, torch_pbd\n"
        f"torch_pbd.load_demonstrations({str(tmp_path / 'set.csv')!r})\n"
        "print(*{'h5py', 'pyarrow', 'zarr', 'rosbags', 'narwhals', 'pandas', 'scipy.io', 'torch'} & set(sys.modules))"
    )
    shown = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert shown.stdout.strip() == ""

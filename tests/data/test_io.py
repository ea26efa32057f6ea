"""Files: round trips to the bit, and what is said about files that are not what they seem."""

import json
import re

import numpy as np
import pytest

from torch_pbd.data import (
    Demonstrations,
    load_demonstrations,
    make_tunnel_demonstrations,
    save_demonstrations,
)
from torch_pbd.exceptions import DataFormatError

EXTREMES = [5e-324, 1 / 3, -0.0, 1.7976931348623157e308, np.pi, -1e-17]


def sets():
    rng = np.random.default_rng(0)
    lengths = range(2, 14)  # more than ten: x_10 must not come before x_2
    times = [1.7e9 + np.cumsum(rng.uniform(0.001, 0.1, size=n)) for n in lengths]
    ragged = Demonstrations(times, [rng.normal(size=(n, 3)) for n in lengths], names=["x", "y, z", "ü"])
    return {
        "aligned": make_tunnel_demonstrations(3, rate=5.0, random_state=0),
        "ragged": ragged,
        "extremes": Demonstrations([np.sort(EXTREMES)], [EXTREMES], units=["m/s"], frame="base", time_unit="1"),
    }


@pytest.mark.parametrize("suffix", [".npz", ".csv", ".CSV"])
@pytest.mark.parametrize("kind", sets())
def test_round_trip_is_exact(tmp_path, suffix, kind):
    demonstrations = sets()[kind]
    path = tmp_path / f"set{suffix}"
    save_demonstrations(demonstrations, path)
    labels = {
        "units": demonstrations.units,
        "frame": demonstrations.frame,
        "time_unit": demonstrations.time_unit,
    }
    loaded = load_demonstrations(path, **({} if suffix == ".npz" else labels))
    assert loaded == demonstrations
    for before, after in zip(demonstrations.positions, loaded.positions, strict=True):
        assert before.tobytes() == after.tobytes()  # -0.0 too


def test_every_recording_loads_as_its_meta_says(recordings):
    files = sorted(recordings.glob("*.npz"))
    assert len(files) >= 17
    for file in files:
        demonstrations = load_demonstrations(file)
        with np.load(file) as archive:
            meta = json.loads(str(archive["meta"]))
            last = archive["x"][-1] if meta["aligned"] else archive[f"x_{meta['K'] - 1}"]
        assert len(demonstrations) == meta["K"]
        assert demonstrations.is_aligned == meta["aligned"]
        assert list(demonstrations.names) == meta["dims"]
        lengths = demonstrations.n_steps
        assert meta["T"] == (lengths[0] if meta["aligned"] else [min(lengths), max(lengths)])
        np.testing.assert_array_equal(demonstrations[-1].position, last)
        assert len(demonstrations.units) == demonstrations.n_outputs == meta["d"]
        aligned = demonstrations.align(n=20)
        assert aligned.to_array().shape == (meta["K"], 20, meta["d"])


@pytest.mark.parametrize(("name", "unit", "time_unit"), [("kuka_cube_pick", "m", "s"), ("adroit_door_palm", "m", "s")])
def test_units_of_recordings_come_without_remarks(recordings, name, unit, time_unit):
    demonstrations = load_demonstrations(recordings / f"{name}.npz")
    assert set(demonstrations.units) == {unit}
    assert demonstrations.time_unit == time_unit


@pytest.mark.parametrize("suffix", [".npz", ".csv"])
def test_a_failed_save_leaves_the_old_file_and_nothing_else(tmp_path, suffix):
    path = tmp_path / f"set{suffix}"
    path.write_text("precious")
    with pytest.raises(AttributeError):
        save_demonstrations("not demonstrations", path)
    assert path.read_text() == "precious"
    assert list(tmp_path.iterdir()) == [path]


def test_paths_and_options_are_checked(tmp_path):
    with pytest.raises(ValueError, match=r"suffix '\.doc'; known formats of demonstrations: \.npz, .*\.csv"):
        load_demonstrations(tmp_path / "set.doc")
    with pytest.raises(FileNotFoundError, match=r"set\.npz"):
        load_demonstrations(tmp_path / "set.npz")
    with pytest.raises(ValueError, match=r"source is '', must be a path"):
        load_demonstrations("")
    (tmp_path / "set.csv").write_text("time,x\n0,1\n1,2\n")
    with pytest.raises(ValueError, match=r"source is .*must be of different files: name each once"):
        load_demonstrations([tmp_path / "set.csv", str(tmp_path / "*.csv")])
    with pytest.raises(FileNotFoundError, match=r"the folder .*missing does not exist"):
        save_demonstrations(sets()["ragged"], tmp_path / "missing" / "set.csv")
    with pytest.raises(TypeError, match=r"have no option 'sep'; they have: outputs, demo, time, .*delimiter"):
        load_demonstrations(tmp_path / "set.csv", sep=";")
    with pytest.raises(ValueError, match="an output named 'time'"):
        save_demonstrations(Demonstrations([0, 1], [[1, 2]], names=["time"]), tmp_path / "set.csv")
    for name in ("", "x ", "__index_level_0__"):
        with pytest.raises(ValueError, match=f"an output named '{name}' cannot be read back from the header"):
            save_demonstrations(Demonstrations([0, 1], [[1, 2]], names=[name]), tmp_path / "set.csv")


def test_names_that_are_numbers_are_names_beside_others_that_are_none(tmp_path):
    numbered = Demonstrations([0, 1], [[1, 2]], names=["1"])
    save_demonstrations(numbered, tmp_path / "set.csv")
    assert load_demonstrations(tmp_path / "set.csv") == numbered
    assert load_text(tmp_path, "sep=;\ntime;1\n0;1\n1;2\n", outputs=["1"]) == numbered
    for line in ('sep="', "sep=\r"):  # no mark
        assert load_text(tmp_path, f"{line}\ntime;1\n0;1\n1;2\n") == numbered
    assert load_text(tmp_path, "sep=;\ntime,1\n0,1\n1,2\n", delimiter=",") == numbered


def test_large_files_are_refused_before_they_are_read(tmp_path):
    for suffix in (".npz", ".csv"):
        path = tmp_path / f"set{suffix}"
        save_demonstrations(sets()["aligned"], path)
        with pytest.raises(DataFormatError, match="max_bytes=10"):
            load_demonstrations(path, max_bytes=10)
    still = Demonstrations(np.arange(10_000), np.zeros((1, 10_000, 9)))  # packs to a hundredth
    save_demonstrations(still, tmp_path / "set.npz")
    with pytest.raises(DataFormatError, match="unpacks to"):
        load_demonstrations(tmp_path / "set.npz", max_bytes=500_000)


T, X = np.arange(3.0), np.zeros((2, 3, 1))


def test_npz_without_meta_loads(tmp_path):
    np.savez(tmp_path / "set.npz", t=T, x=X, dx=X, label=np.array("ignored"))
    assert load_demonstrations(tmp_path / "set.npz") == Demonstrations(T, X)


@pytest.mark.parametrize("units", ["m", ["m"], {"x": "m"}])
def test_units_may_be_one_a_list_or_by_name(tmp_path, units):
    np.savez(tmp_path / "set.npz", t=T, x=X, meta=np.array(json.dumps({"dims": ["x"], "units": units})))
    assert load_demonstrations(tmp_path / "set.npz").units == ("m",)


@pytest.mark.parametrize(
    ("arrays", "words"),
    [
        ({"a": X}, "no column 'time' among [a_0]"),
        ({"t": T}, "has no array 'x'; it has: [t]"),
        ({"t": T, "x": X[0]}, "x has shape (3, 1), must have shape (K, T, d)"),
        ({"t_0": T, "x_0": X[0], "t_2": T, "x_2": X[0]}, "has no array 't_1'"),
        ({"t_0": T, "x_0": X[0], "t_1": T}, "has no array 'x_1'"),
        ({"t": T, "x": X.astype(object)}, "array 'x' is not an array of numbers"),
        ({"t": T[::-1], "x": X}, "times[0] must increase strictly"),
        ({"t": T, "x": X * np.nan}, "positions[0][0, 0] is nan"),
        ({"t": T, "x": X, "meta": np.array("{")}, "meta must be a 0-d string with a JSON object"),
        (
            {"t": T, "x": X, "meta": np.array("[1]")},
            "meta must be a 0-d string with a JSON object: it is a list",
        ),
        ({"t": T, "x": X, "meta": np.array(["{}", "{}"])}, "meta must be a 0-d string with a JSON object"),
        ({"t": T, "x": X, "meta": np.array('{"K": 3}')}, "meta says K = 3, but the arrays have 2"),
        ({"t": T, "x": X, "meta": np.array('{"dims": ["x", "y"]}')}, "names has 2 entries"),
        ({"t": T, "x": X, "meta": np.array('{"dims": ["x"], "units": {}}')}, "no entry for output 'x'"),
    ],
)
def test_npz_that_is_not_in_the_format_is_refused(tmp_path, arrays, words):
    path = tmp_path / "set.npz"
    np.savez(path, **arrays)
    with pytest.raises(DataFormatError, match=re.escape(str(path)) + ".*" + re.escape(words)):
        load_demonstrations(path)


def test_damaged_archives_are_refused(tmp_path, rng):
    path = tmp_path / "set.npz"
    save_demonstrations(Demonstrations(T, rng.normal(size=(50, 3, 9))), path)
    whole = path.read_bytes()
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 0xFF
    for content in (b"", b"demo,time,x\n", whole[: len(whole) // 2], bytes(flipped)):
        path.write_bytes(content)
        with pytest.raises(DataFormatError, match=r"set\.npz"):
            load_demonstrations(path)


CSV = "demo,time,x,y\na,0.0,1,2\na,0.5,3,4\nb,0.0,5,6\nb,0.7,7,8\n"


def load_text(tmp_path, text, **options):
    path = tmp_path / "set.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return load_demonstrations(path, **options)


@pytest.mark.parametrize(
    ("text", "options"),
    [
        (CSV.replace(",", ";"), {}),
        (CSV.replace(",", "\t"), {}),
        (CSV.replace(",", "|"), {"delimiter": "|"}),
        (CSV.replace(",", ";").replace(".", ","), {"decimal": ","}),
        (CSV.replace("\n", "\r\n"), {}),
        ("\ufeff" + CSV + "\n\n", {}),
        (CSV.replace(",", " , "), {}),
        (CSV.replace("demo,time", "trial,seconds"), {"demo": "trial", "time": "seconds"}),
        ("demo,time,x,y\nb,0,5,6\na,0,1,2\nb,.7,7,8\na,.5,3,4\n", {"demo": "demo"}),
    ],
    ids=["semicolon", "tab", "given", "decimal", "windows", "bom", "spaces", "renamed", "mixed"],
)
def test_dialects_of_csv(tmp_path, text, options):
    expected = Demonstrations([[0, 0.5], [0, 0.7]], [[[1, 2], [3, 4]], [[5, 6], [7, 8]]], names=["x", "y"])
    loaded = load_text(tmp_path, text, **options)
    assert loaded == (expected[::-1] if text.startswith("demo,time,x,y\nb") else expected)


def test_columns_of_csv_are_chosen_and_ordered(tmp_path):
    swapped = load_text(tmp_path, CSV, outputs=["y", "x"])
    assert swapped.names == ("y", "x")
    np.testing.assert_array_equal(swapped[0].position, [[2, 1], [4, 3]])
    assert load_text(tmp_path, CSV, outputs=["y"]).n_outputs == 1
    alone = load_text(tmp_path, "time,x\n0,1\n1,2\n", demo=None)
    assert alone == Demonstrations([0, 1], [[1, 2]], names=["x"])


@pytest.mark.parametrize(
    ("text", "options", "words"),
    [
        ("", {}, "line 1: no column 'time'"),
        (CSV, {"demo": "trial"}, "line 1: no column 'trial'"),
        ("demo,t,x\n", {}, "line 1: no column 'time' among [demo, t, x]"),
        ("demo,time\n", {}, "line 1: no column of outputs"),
        (CSV, {"outputs": ["z"]}, "line 1: no column 'z'"),
        ("demo,time,x,x\n", {}, "line 1: there are two columns 'x'"),
        ("demo,time,x\n", {}, "is empty"),
        ("0,0,1,2\n0,1,1.5,2.5\n", {}, "line 1: it must name the columns, and has numbers: [0, 0, 1, 2]"),
        ("0,10:00:07,1,2\n0,10:00:08,1.5,2.5\n", {}, "line 1: it must name the columns, and has numbers: [0, 10"),
        (
            "demo|time|x\n",
            {},
            "line 1: no columns but one, 'demo|time|x', by [',', ';', '\\t'] and the decimal mark '.'",
        ),
        (
            "nan,0.1,0.2\n1,0.2,0.3\n2,0.4,0.5\n",
            {"rate": 10},
            "line 1: it must name the columns, and has numbers: [nan",
        ),
        ("0,5;1,5\n1;2\n2;3\n", {"rate": 10, "decimal": ","}, "line 1: it must name the columns, and has numbers"),
        ("time,x\n2024-01-01 00:00:01,1\nabc,2\n", {}, "'abc' is no date or time, must be a date"),
        ("sep=;\ndemo;time;x\n0;0;1\n0;1;a\n", {}, "line 4, column 'x': 'a' is not a finite number"),
        (CSV.replace("5,6", ",6"), {}, "line 4, column 'x': the cell is blank"),
        (CSV.replace("b,0.0", ",0.0"), {}, "line 4, column 'demo': the cell is blank"),
        (CSV.replace("3,4", "3,nan"), {}, "line 3, column 'y': 'nan' is not a finite number"),
        (CSV.replace("3,4", "3,1e999"), {}, "line 3, column 'y': '1e999' is not a finite number"),
        (CSV.replace("3,4", "3,1_0"), {}, "line 3, column 'y': '1_0' is not a finite number"),
        (
            CSV.replace("0.5,", '"0,5",'),
            {},
            "line 3, column 'time': '0,5' is not a finite number (decimal mark '.')",
        ),
        (CSV.replace(",", ";"), {"decimal": ","}, "line 2, column 'time': '0.0' is not a finite number"),
        (CSV.replace("3,4", "3,4,5"), {}, "line 3: 5 cells under 4 column names"),
        (CSV.replace("0.7", "0.0"), {}, "times[1] must increase strictly, but sample 1 is at 0.0 after 0.0"),
        (CSV + "c,0,1,1\n", {}, "times[2] has 1 samples"),
        (CSV.encode("utf-16"), {}, "is not text in UTF-8"),
        (CSV + "c,0,1," + "1" * 200_000, {}, "line 6: field larger than field limit"),
    ],
)
def test_csv_that_cannot_be_read_is_refused_with_its_place(tmp_path, text, options, words):
    with pytest.raises(DataFormatError, match=r"set\.csv.*" + re.escape(words)):
        load_text(tmp_path, text, **options)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"demo": ""}, "no column '' among [demo, time, x]"),
        ({"demo": 5}, "demo is 5, must be text or None"),
        ({"time": 5}, "time is 5, must be text or None"),
        ({"rate": 0}, "rate is 0 Hz, must be a finite number above 0"),
        ({"rotation": ("qw", "qx", "qy", "qz")}, "must be four different ones of [x], in the order w x y z"),
        ({"outputs": 3}, "outputs is 3, must be strings"),
        ({"outputs": ["x", 3]}, "outputs[1] is 3, must be text"),
        ({"delimiter": 5}, "delimiter is 5, must be one character"),
        ({"max_bytes": "1GB"}, "max_bytes is '1GB', must be an integer"),
        ({"max_bytes": None}, "max_bytes is None, must be an integer"),
    ],
    ids=repr,
)
def test_options_of_other_kinds_are_refused_by_name(tmp_path, options, message):
    path = tmp_path / "d.csv"
    path.write_text("demo,time,x\n0,0,1\n0,1,2\n")
    with pytest.raises(ValueError, match=re.escape(message)):
        load_demonstrations(path, **options)


def test_a_column_without_a_name_may_tell_the_demonstrations_apart(tmp_path):
    path = tmp_path / "d.csv"
    path.write_text(",time,x\n0,0,1\n0,1,2\n1,0,1\n1,1,3\n")
    assert len(load_demonstrations(path, demo="")) == 2


@pytest.mark.parametrize("options", [{"decimal": "x"}, {"delimiter": ",", "decimal": ","}, {"delimiter": ", "}])
def test_marks_of_csv_are_checked(tmp_path, options):
    with pytest.raises(ValueError, match=r"decimal|delimiter"):
        load_text(tmp_path, CSV, **options)

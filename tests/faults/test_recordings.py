"""Recordings with holes, clocks that go back and torn files: refused with their place, or repaired on request.

Numbers in the names are those of the list of faults that the project keeps. More of the same container and files is in
tests/data.
"""

import re
import warnings

import numpy as np
import pytest

from torch_pbd import CholeskyCovRegressor, DMPController
from torch_pbd.data import Demonstrations, io, load_demonstrations, make_tunnel_demonstrations
from torch_pbd.exceptions import DataFormatError, MissingDataWarning
from torch_pbd.files import memory

TIME = np.arange(6.0)
POSITIONS = np.random.default_rng(0).normal(size=(3, 6, 2))


def as_container(times, positions, folder, **options):
    return Demonstrations(times, positions, **options)


def as_npz(times, positions, folder, **options):
    if np.ndim(times[0]) == 0:
        arrays = {"t": times, "x": positions}
    else:
        pairs = enumerate(zip(times, positions, strict=True))
        arrays = {key: value for k, (t, x) in pairs for key, value in ((f"t_{k}", t), (f"x_{k}", x))}
    np.savez(folder / "set.npz", **arrays)
    return load_demonstrations(folder / "set.npz", **options)


def as_csv(times, positions, folder, **options):
    times = [times] * len(positions) if np.ndim(times[0]) == 0 else times
    rows = [
        [k, t, *x]
        for k in range(len(positions))
        for t, x in zip(times[k], np.reshape(positions[k], (len(times[k]), -1)), strict=True)
    ]
    header = ",".join(["demo", "time", *(f"y{i}" for i in range(len(rows[0]) - 2))])
    lines = [",".join(map(str, row)) for row in rows]
    return from_text("\n".join([header, *lines]), folder, **options)


def from_text(text, folder, **options):
    (folder / "set.csv").write_bytes(text if isinstance(text, bytes) else text.encode())
    return load_demonstrations(folder / "set.csv", **options)


DOORS = [as_container, as_npz, as_csv]
each_door = pytest.mark.parametrize("door", DOORS, ids=["container", "npz", "csv"])


def with_entry(array, index, value):
    changed = np.array(array, dtype=float)
    changed[index] = value
    return changed


@pytest.mark.parametrize("times", [TIME, [TIME[:5], TIME, TIME]], ids=["shared", "own"])
def test_7_unequal_lengths_are_told_and_never_cut(times):
    lengths = [POSITIONS[0][:5], POSITIONS[1], POSITIONS[2]]
    if np.ndim(times[0]) == 0:
        with pytest.raises(ValueError, match=re.escape("lengths [5, 6, 6]: give each demonstration its own times")):
            Demonstrations(times, lengths)
    else:
        assert Demonstrations(times, lengths).n_steps == (5, 6, 6)
    with pytest.raises(ValueError, match=r"times\[0\] has 6 samples but positions\[0\] has 5"):
        Demonstrations([TIME, TIME, TIME], lengths)


def test_7_unequal_lengths_are_no_array_until_they_are_aligned():
    recorded = Demonstrations([TIME[:5], TIME], [POSITIONS[0][:5], POSITIONS[1]])
    with pytest.raises(ValueError, match=r"lengths \[5, 6\].*use \.align\(\)"):
        recorded.to_array()
    assert recorded.align(n=6).to_array().shape == (2, 6, 2)


@each_door
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_8_what_is_not_finite_is_told_with_its_place(door, value, tmp_path):
    with pytest.raises(ValueError) as caught:
        door(TIME, with_entry(POSITIONS, (1, 4, 1), value), tmp_path)
    place = "line 12, column 'y1'" if door is as_csv else f"positions[1][4, 1] is {value}, must be finite"
    assert place in str(caught.value)
    assert ("missing='drop'" in str(caught.value)) == (np.isnan(value) or door is as_csv)
    with pytest.raises(ValueError) as caught:
        door([TIME, TIME, with_entry(TIME, 3, value)], POSITIONS, tmp_path)
    place = "line 17, column 'time'" if door is as_csv else f"times[2][3] is {value}, must be finite"
    assert place in str(caught.value)


@each_door
def test_9_missing_samples_are_dropped_and_counted(door, tmp_path):
    holed = with_entry(with_entry(POSITIONS, (1, [2, 3], 0), np.nan), (2, 5), np.nan)
    with pytest.warns(MissingDataWarning) as caught:
        kept = door([TIME, TIME, with_entry(TIME, 0, np.nan)], holed, tmp_path, missing="drop")
    assert [str(w.message) for w in caught] == [
        "Dropped 4 of 18 samples that have missing values: 2 of 6 in demonstration 1, 2 of 6 in demonstration 2. At "
        "most 2 of them follow each other; what interpolates later draws straight lines there."
    ]
    assert {w.filename for w in caught} == {__file__}
    numbers = [np.arange(6), [0, 1, 4, 5], [1, 2, 3, 4]]
    assert kept == Demonstrations([TIME[n] for n in numbers], [POSITIONS[k][n] for k, n in enumerate(numbers)])
    assert not kept.is_aligned


@each_door
def test_9_nothing_missing_is_nothing_told(door, tmp_path):
    assert door(TIME, POSITIONS, tmp_path, missing="drop") == Demonstrations(TIME, POSITIONS)


@each_door
def test_9_infinity_is_not_missing(door, tmp_path):
    holed = with_entry(with_entry(POSITIONS, (1, 2, 0), np.nan), (1, 4, 1), np.inf)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MissingDataWarning)
        with pytest.raises(ValueError, match=r"positions\[1\]\[4, 1\] is inf|line 12, column 'y1'"):
            door(TIME, holed, tmp_path, missing="drop")
        with pytest.raises(ValueError, match=r"times\[0\]\[5\] is inf|line 7, column 'time'"):
            door([with_entry(TIME, 5, np.inf)] * 3, POSITIONS, tmp_path, missing="drop")


@each_door
def test_9_too_few_samples_left_are_an_error(door, tmp_path):
    with pytest.raises(
        ValueError, match=r"positions\[1\] has 1 of 6 samples left without missing .* at least 2: leave"
    ):
        door(TIME, with_entry(POSITIONS, (1, slice(1, None), 0), np.nan), tmp_path, missing="drop")
    with pytest.raises(ValueError, match=r"positions\[0\] has 0 of 6 samples left"):
        door(TIME, with_entry(POSITIONS, 0, np.nan), tmp_path, missing="drop")


@each_door
def test_9_places_are_those_before_the_drop(door, tmp_path):
    holed = with_entry(POSITIONS, (0, [0, 1], 0), np.nan)
    backwards = [with_entry(TIME, 4, 2.5), TIME, TIME]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MissingDataWarning)
        with pytest.raises(ValueError, match=r"sample 4 is at 2\.5 after 3\.0"):
            door(backwards, holed, tmp_path, missing="drop")


def test_9_a_time_after_a_missing_one_is_held_to_the_last_known(tmp_path):
    message = r"times\[0\] must increase strictly, but sample 2 is at 0\.5 after 1\.0"
    with pytest.warns(MissingDataWarning), pytest.raises(DataFormatError, match=message):
        from_text("demo,time,x\na,1,1\na,nan,2\na,0.5,3\na,2,4\n", tmp_path, missing="drop")


def test_9_masked_samples_are_missing_ones():
    masked = np.ma.masked_where(np.arange(36).reshape(3, 6, 2) == 20, POSITIONS)
    with pytest.raises(ValueError, match=r"positions\[1\] has masked entries: leave them out"):
        Demonstrations(TIME, masked)
    with pytest.warns(MissingDataWarning, match="1 of 6 in demonstration 1"):
        kept = Demonstrations(TIME, masked, missing="drop")
    np.testing.assert_array_equal(kept.positions[1], POSITIONS[1][[0, 1, 2, 3, 5]])


def test_9_samples_of_objects_that_are_none_are_missing_ones():
    holed = with_entry(POSITIONS, (1, 3, 1), np.nan).astype(object)
    holed[1, 3, 1] = None
    with pytest.warns(MissingDataWarning, match="1 of 6 in demonstration 1"):
        kept = Demonstrations(TIME, holed, missing="drop")
    np.testing.assert_array_equal(kept.positions[1], POSITIONS[1][[0, 1, 2, 4, 5]])


def test_9_one_line_a_demonstration_gets_no_longer_with_many():
    holed = with_entry(np.zeros((40, 6, 1)), (slice(None), 3), np.nan)
    with pytest.warns(MissingDataWarning, match=r"Dropped 40 of 240 .* demonstration 11, \.\.\. 40 in all"):
        Demonstrations(TIME, holed, missing="drop")


@pytest.mark.parametrize("missing", ["fill", None, True])
def test_9_the_choice_is_one_of_two(missing, tmp_path):
    with pytest.raises(ValueError, match=r"missing is .*, must be one of 'raise', 'drop'"):
        Demonstrations(TIME, POSITIONS, missing=missing)


@pytest.mark.parametrize("cell", ["", " ", "nan", "NaN", "-nan"])
def test_9_blank_cells_of_csv_are_missing_and_other_text_is_not(cell, tmp_path):
    text = "demo,time,x\na,0,1\na,1,CELL\na,2,3\nb,0,1\nb,1,2\n"
    with pytest.raises(DataFormatError, match=r"line 3, column 'x': .*missing='drop' does"):
        from_text(text.replace("CELL", cell), tmp_path)
    with pytest.warns(MissingDataWarning, match="1 of 3 in demonstration 0"):
        kept = from_text(text.replace("CELL", cell), tmp_path, missing="drop")
    assert kept == Demonstrations([[0, 2], [0, 1]], [[1, 3], [1, 2]], names=["x"])
    with pytest.raises(DataFormatError, match=r"line 3, column 'x': 'n/a' is not a finite number"):
        from_text(text.replace("CELL", "n/a"), tmp_path, missing="drop")


def test_9_a_movement_with_holes_is_learned(rng):
    """A tenth of the samples lost, never two in a row: the covariance is nearly that of all of them."""
    whole = make_tunnel_demonstrations(5, rate=10.0, random_state=0)
    positions = whole.to_array().copy()
    lost = 2 * rng.permuted(np.tile(np.arange(1, 49), (5, 1)), axis=1)[:, :10]
    positions[np.arange(5)[:, np.newaxis], lost] = np.nan
    with pytest.warns(MissingDataWarning, match="Dropped 50 of 505"):
        holed = Demonstrations(whole.times[0], positions, missing="drop")
    X = np.linspace(0.05, 0.95, 19)[:, np.newaxis]
    full, some = (CholeskyCovRegressor().fit(*d.align(n=51).stack()[:2]) for d in (whole, holed))
    # Straight lines over 0.2 s of a movement of 10 s: a hundredth of the spread.
    scale = np.sqrt(np.trace(full.predict_cov(X), axis1=1, axis2=2)).mean()
    np.testing.assert_allclose(some.predict(X), full.predict(X), atol=0.05 * scale)
    np.testing.assert_allclose(some.predict_cov(X), full.predict_cov(X), rtol=0.1, atol=0.05 * scale**2)


@each_door
@pytest.mark.parametrize(
    ("times", "index", "words"),
    [
        ([0, 1, 2, 2, 4, 5], 3, "2.0 after 2.0"),
        ([0, 1, 2, 1.5, 1, 5], 3, "1.5 after 2.0"),
        ([5, 4, 3, 2, 1, 0], 1, "4.0 after 5.0"),
        ([0, 1, 2, 3, 4, -1e-300], 5, "-1e-300 after 4.0"),
    ],
    ids=["repeated", "non-monotone", "backwards", "last"],
)
def test_10_times_that_do_not_increase_are_told_at_the_first(door, times, index, words, tmp_path):
    times = np.array(times, dtype=float)
    with pytest.raises(ValueError) as caught:
        door([TIME, times, TIME], POSITIONS, tmp_path)
    assert f"times[1] must increase strictly, but sample {index} is at {words}. Sort the samples" in str(caught.value)


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_11_jittered_times_are_taken_as_they_are(degree, rng):
    """Sampling 20 % early or late: a controller's mean acceleration is that of the polynomial, not of even steps."""
    from torch_pbd.control.primitive.smoothing import smooth

    even = np.arange(50) * 0.04
    times = [even + np.r_[0.0, rng.uniform(-0.2, 0.2, size=48) * 0.04, 0.0] for _ in range(3)]
    polynomial = np.polynomial.Polynomial(np.arange(1.0, degree + 2.0))
    jittered = Demonstrations(times, [polynomial(time) for time in times])
    assert not jittered.is_aligned
    moved = smooth(jittered.times, jittered.positions, None, 30, even[-1])
    for k in range(3):
        np.testing.assert_allclose(moved.position[k, :, 0], polynomial(moved.time), rtol=1e-6)
        np.testing.assert_allclose(moved.velocity[k, :, 0], polynomial.deriv()(moved.time), rtol=1e-6)
        np.testing.assert_allclose(moved.acceleration[k, :, 0], polynomial.deriv(2)(moved.time), rtol=1e-6, atol=1e-6)
    straight = Demonstrations(times, [3.0 * time - 1.0 for time in times]).resample(20)
    assert straight.is_aligned
    np.testing.assert_allclose(
        straight.to_array(), np.tile(3.0 * straight.times[0] - 1.0, (3, 1))[..., np.newaxis], atol=1e-12
    )


@each_door
@pytest.mark.parametrize("n", [0, 1])
def test_12_too_few_samples_are_told(door, n, tmp_path):
    if n == 0 and door is as_csv:
        pytest.skip("a demonstration without lines is none")
    with pytest.raises(ValueError, match=f"times\\[1\\] has {n} samples: a demonstration needs at least 2"):
        door([TIME, TIME[:n]], [POSITIONS[0], POSITIONS[1][:n]], tmp_path)


@pytest.mark.parametrize(("cutoff", "least"), [("auto", 5), (None, 3)])
def test_12_a_movement_has_an_acceleration_from_three_samples_and_is_smoothed_from_five(cutoff, least):
    short = Demonstrations(TIME[: least - 1], POSITIONS[:, : least - 1], units="m")
    with pytest.raises(ValueError, match=f"demonstration 0 has {least - 1} samples, needs at least {least}"):
        DMPController(cutoff=cutoff).fit(short)


@pytest.mark.parametrize(
    ("times", "positions", "message"),
    [
        ([], [], "positions is empty, must have at least one demonstration"),
        (np.empty((0,)), np.empty((0, 0, 2)), "positions is empty"),
        (TIME, np.empty((2, 6, 0)), r"positions\[0\] has shape \(6, 0\)"),
        (np.empty(0), np.empty((2, 0, 2)), "times is empty"),
    ],
)
def test_13_nothing_is_refused(times, positions, message):
    with pytest.raises(ValueError, match=message):
        Demonstrations(times, positions)


CSV = "demo,time,x,y\na,0.0,1,2\na,0.5,3,4\nb,0.0,5,6\nb,0.5,7,8\n"


@pytest.mark.parametrize(
    ("text", "options", "message"),
    [
        (CSV.partition("\n")[2], {}, "line 1: no column 'time' among [a, 0.0, 1, 2]"),  # no header
        ("", {}, "line 1: no column 'time'"),
        ("\n\n" + CSV, {}, "line 1: no column 'time'"),
        (CSV, {"outputs": ["z"]}, "line 1: no column 'z' among [demo, time, x, y]"),
        (CSV, {"time": "t"}, "line 1: no column 't'"),
        (CSV.replace("0.5", "0,5"), {"decimal": ","}, "line 1: no column"),  # one mark for two things
        (
            CSV.replace(",", ";").replace(".", ","),
            {},
            "line 2, column 'time': '0,0' is not a finite number (decimal mar",
        ),
        (CSV.replace("3,4", '"3,4'), {}, "line 3"),  # a quote that never ends
        (CSV.replace("3,4", '"3",4x'), {}, "line 3, column 'y': '4x' is not a finite number"),
        (CSV.replace("3,4", "3"), {}, "line 3: 3 cells under 4 column names"),
        (CSV.replace("3,4", "3,4,"), {}, "line 3: 5 cells under 4 column names"),
        (CSV.replace("3,4", "3,"), {}, "line 3, column 'y': the cell is blank"),
        (CSV.replace("3,4", "3,inf"), {"missing": "drop"}, "line 3, column 'y': 'inf' is not a finite number"),
        (CSV.replace("a,0.5", ",0.5"), {"missing": "drop"}, "line 3, column 'demo': the cell is blank"),
        (CSV.replace("3,4", "0x3,4"), {}, "line 3, column 'x': '0x3' is not a finite number"),
        (CSV.replace("3,4", "\u0663,4"), {}, None),  # a digit all the same
        (CSV.replace("3,4", "3\0,4"), {}, "line 3, column 'x'"),
        (CSV.replace("x", "\u00e4").encode("latin-1"), {}, "is not text in UTF-8"),
        (b"\x89PNG\r\n\x1a\n" + bytes(range(256)), {}, ""),
    ],
    ids=lambda value: repr(value)[-24:],
)
def test_51_a_table_that_is_none_is_refused_with_line_and_column(text, options, message, tmp_path):
    if message is None:
        assert from_text(text, tmp_path, **options)[0].position[1, 0] == 3.0
        return
    with pytest.raises(DataFormatError) as caught:
        from_text(text, tmp_path, **options)
    assert str(caught.value).startswith(str(tmp_path / "set.csv"))
    assert message in str(caught.value)


def test_51_quoted_cells_and_semicolons_are_read(tmp_path):
    expected = from_text(CSV, tmp_path)
    assert from_text(re.sub(r"[^,\n]+", r'"\g<0>"', CSV), tmp_path) == expected
    assert from_text(CSV.replace(",", ";"), tmp_path) == expected
    assert from_text(CSV.replace(",", ";").replace(".", ","), tmp_path, decimal=",") == expected


@pytest.mark.parametrize("suffix", [".csv", ".npz"])
def test_51_a_file_too_large_is_refused_before_it_is_read(suffix, tmp_path, monkeypatch):
    path = tmp_path / f"huge{suffix}"
    with path.open("wb") as file:
        file.truncate(40 * 10**9)  # a thousand million lines; no block of it is on the disk
    with pytest.raises(DataFormatError, match=r"has 40000000000 bytes, more than max_bytes=536870912: raise it"):
        load_demonstrations(path)
    with pytest.raises(ValueError, match=r"huge.*: reading it needs about 373 GiB of memory, but .* Split the file"):
        load_demonstrations(path, max_bytes=10**12)


def test_51_memory_is_counted_for_files_below_the_limit_too(tmp_path, monkeypatch):
    from_text(CSV, tmp_path)
    monkeypatch.setattr(memory, "available_bytes", lambda: 100)
    with pytest.raises(ValueError, match=r"set\.csv: reading it needs about"):
        load_demonstrations(tmp_path / "set.csv")
    assert io.MAX_BYTES == 512 * 2**20

"""The container: what it holds, what it refuses, and that it never changes."""

import copy
import doctest
import pickle
import re

import numpy as np
import pytest

from torch_pbd.data import Demonstrations, demonstrations
from torch_pbd.data.wanted import Wanted


@pytest.fixture
def ragged(rng):
    """Three demonstrations of 5, 8 and 6 samples, 2 outputs, over different times."""
    times = [np.cumsum(rng.uniform(0.5, 1.5, size=n)) for n in (5, 8, 6)]
    return Demonstrations(times, [rng.normal(size=(n, 2)) for n in (5, 8, 6)], names=["x", "y"], units="m")


@pytest.fixture
def aligned(rng):
    return Demonstrations(np.linspace(0, 2, 7), rng.normal(size=(4, 7, 3)))


def test_keeps_what_it_was_given(rng):
    positions = rng.normal(size=(4, 7, 3))
    time = np.linspace(0, 2, 7)
    demonstrations = Demonstrations(time, positions, units=["m", "m", "rad"], frame="base")
    assert (len(demonstrations), demonstrations.n_outputs, demonstrations.is_aligned) == (4, 3, True)
    assert demonstrations.names == ("y0", "y1", "y2")
    assert (demonstrations.units, demonstrations.frame) == (("m", "m", "rad"), "base")
    assert demonstrations == Demonstrations([time] * 4, list(positions), units=["m", "m", "rad"], frame="base")
    np.testing.assert_array_equal(demonstrations.to_array(), positions)
    for k, (recorded_time, position) in enumerate(demonstrations):
        np.testing.assert_array_equal(recorded_time, time)
        np.testing.assert_array_equal(position, positions[k])


def test_one_output_may_be_one_dimensional():
    demonstrations = Demonstrations([0, 1, 2], [[1, 2, 3], [4, 5, 6]], names="z")
    assert demonstrations.to_array().shape == (2, 3, 1)
    assert demonstrations.positions[0].dtype == np.float64


def test_is_not_changed_through_the_callers_arrays_or_its_own(rng):
    time, positions = np.arange(5.0), rng.normal(size=(2, 5, 1))
    demonstrations = Demonstrations(time, positions)
    before = copy.deepcopy(demonstrations)
    time[0], positions[:] = -1.0, 0.0
    for array in demonstrations.stack():
        array[:] = 7
    demonstrations.to_array()[:] = 7.0
    assert demonstrations == before
    with pytest.raises(AttributeError):
        demonstrations.times = ()
    for held in (demonstrations, before, pickle.loads(pickle.dumps(demonstrations))):
        with pytest.raises(ValueError, match="read-only"):
            held[0].position[0] = 1.0
        with pytest.raises(ValueError, match="WRITEABLE"):
            held[0].position.setflags(write=True)


def _flagged(array):
    array.setflags(write=False)
    return array


@pytest.mark.parametrize("read_only", [_flagged, lambda array: np.asarray(array.data.toreadonly())])
def test_read_only_arrays_of_the_caller_are_copied(read_only):
    time, position = np.arange(5.0), np.ones((5, 1))
    demonstrations = Demonstrations([read_only(time)], [read_only(position)])
    for array in (time, position):
        array.setflags(write=True)
        array[:] = 7.0
    assert demonstrations == Demonstrations(np.arange(5.0), np.ones((1, 5, 1)))


def test_what_is_held_already_is_not_copied(ragged):
    assert all(a is b for a, b in zip(ragged[1:].positions, ragged.positions[1:], strict=True))
    wanted = Wanted(rate=1.0)
    read = wanted.read_each(wanted.choose({"x": ["x"]}), [{"x": np.arange(3.0)}])["positions"]
    assert Demonstrations([[0.0, 1.0, 2.0]], read).positions[0] is read[0]


@pytest.mark.parametrize("duplicate", [copy.copy, copy.deepcopy, lambda d: pickle.loads(pickle.dumps(d))])
def test_copies_are_equal(ragged, duplicate):
    assert duplicate(ragged) == ragged


def test_equality_sees_every_part(ragged):
    values = {"times": ragged.times, "positions": ragged.positions}
    labels = {"names": ragged.names, "units": ragged.units, "frame": None, "time_unit": "s"}
    assert Demonstrations(**values, **labels) == ragged
    changes = {"names": ["a", "b"], "units": None, "frame": "base", "time_unit": "1"}
    for label, value in changes.items():
        assert Demonstrations(**values, **{**labels, label: value}) != ragged
    assert ragged[:2] != ragged
    assert ragged != "text"


def test_indexing_keeps_labels_and_order(ragged):
    np.testing.assert_array_equal(ragged[-1].time, ragged.times[2])
    for index in ([2, 0], np.array([2, 0]), slice(None, None, -2)):
        assert ragged[index].n_steps == (6, 5)
        assert ragged[index].units == ("m", "m")
    assert ragged[[True, False, True]] == ragged[[0, 2]]
    with pytest.raises(IndexError):
        ragged[3]


def test_split_is_a_partition(ragged):
    train, test = ragged.split(1)
    assert (train, test) == (ragged[[0, 2]], ragged[[1]])
    assert ragged.split([-1, 0]) == (ragged[[1]], ragged[[0, 2]])
    for k, words in [
        (3, "numbered 0 to 2"),
        ([0, 1, 2], "leaves out all 3"),
        ([], r"k is \[\], must be"),
        (0.5, r"k is 0\.5, must be"),
    ]:
        with pytest.raises(ValueError, match=words):
            ragged.split(k)


def test_stack_has_a_row_for_each_sample(ragged):
    X, y, groups = ragged.stack()
    assert (X.shape, y.shape, groups.shape) == ((19, 1), (19, 2), (19,))
    for k, (time, position) in enumerate(ragged):
        np.testing.assert_array_equal(X[groups == k, 0], time)
        np.testing.assert_array_equal(y[groups == k], position)


def test_stacked_phase_is_affine_in_time(ragged):
    X, _, groups = ragged.stack("phase")
    for k, time in enumerate(ragged.times):
        np.testing.assert_allclose(X[groups == k, 0], (time - time[0]) / np.ptp(time), rtol=1e-12, atol=0)


@pytest.mark.parametrize("start", [0.0, 0.1, 1.7e9])
def test_phases_repeat_to_the_bit_where_only_offset_and_duration_differ(start):
    # 1.7e9 is a time stamp of 2023 in s, which float64 resolves to 2.4e-7 s only
    times = [start + k / 3 + np.arange(50) * 0.01 * (1 + k / 7) for k in range(6)]
    X, _, _ = Demonstrations(times, np.zeros((6, 50, 1))).stack("phase")
    assert len(np.unique(X)) == 50


def test_phases_of_different_rhythm_stay_different():
    grids = [np.linspace(0, 1, 20), np.linspace(0, 1, 20) ** 1.001]
    X, _, _ = Demonstrations(grids, np.zeros((2, 20, 1))).stack("phase")
    assert len(np.unique(X)) == 38


def test_resample_is_exact_on_lines_and_keeps_ends(ragged):
    slopes = np.array([2.0, -3.0])
    lines = Demonstrations(ragged.times, [1 + time[:, None] * slopes for time in ragged.times])
    resampled = lines.resample(31)
    for (time, position), (old_time, old_position) in zip(resampled, lines, strict=True):
        np.testing.assert_array_equal(time[[0, -1]], old_time[[0, -1]])
        np.testing.assert_array_equal(position[[0, -1]], old_position[[0, -1]])
        np.testing.assert_allclose(np.diff(time), np.ptp(time) / 30, rtol=1e-9)
        np.testing.assert_allclose(position, 1 + time[:, None] * slopes, rtol=1e-9, atol=1e-12)
    assert not resampled.is_aligned


def test_resample_aligns_what_covers_the_same_time(rng):
    times = [np.r_[0, np.sort(rng.uniform(0.1, 0.9, size=n)), 1] for n in (3, 9)]
    recorded = Demonstrations(times, [time**2 for time in times])
    assert not recorded.is_aligned
    assert recorded.resample(5).is_aligned


def test_to_array_of_what_is_not_aligned_says_what_to_do(ragged):
    with pytest.raises(ValueError, match=re.escape("lengths [5, 8, 6]") + r".*\.align\(\).*\.resample\(n\)"):
        ragged.to_array()


@pytest.mark.parametrize("n", [1, 0, -3, 2.0, True, "5"])
def test_number_of_points_is_checked(ragged, n):
    for method in (ragged.resample, lambda n: ragged.align(n=n)):
        with pytest.raises(ValueError, match=r"n is .*at least 2"):
            method(n)


def test_repr_is_short(ragged, aligned):
    assert repr(ragged) == ("Demonstrations(n_demos=3, n_steps=5..8, outputs=('x', 'y'), time_unit='s', aligned=False)")
    assert "n_steps=7, " in repr(aligned)


TIME, TWO = np.arange(3.0), np.zeros((2, 3, 1))


def _changed(array, index, value):
    array = np.array(array)
    array[index] = value
    return array


@pytest.mark.parametrize(
    ("times", "positions", "words"),
    [
        ([], [], "positions is empty"),
        (TIME, 3.0, "positions is 3.0, must be a list of one array"),
        ([TIME], TWO, "times has 1 arrays but positions has 2 demonstrations"),
        ([TIME, np.arange(4.0)], TWO, "times[1] has 4 samples but positions[1] has 3"),
        (
            np.arange(9.0),
            [np.zeros((5, 1)), np.zeros((9, 1))],
            "times has 9 samples but positions[0] has 5, of lengths [5, 9]: give each",
        ),
        (TIME, np.zeros((3, 2)), "One demonstration alone is written [positions]"),
        (
            [TIME, TIME],
            [np.zeros((3, 2)), np.zeros((3, 1))],
            "positions[1] has 1 outputs but positions[0] has 2",
        ),
        (TIME, _changed(TWO, (1, 2, 0), np.nan), "positions[1][2, 0] is nan, must be finite"),
        (TIME, _changed(TWO, (0, 1, 0), -np.inf), "positions[0][1, 0] is -inf"),
        ([TIME, _changed(TIME, 1, np.nan)], TWO, "times[1][1] is nan"),
        (
            [TIME, [0.0, 2.0, 2.0]],
            TWO,
            "times[1] must increase strictly, but sample 2 is at 2.0 after 2.0. Sort",
        ),
        ([[0.0, 2.0, 1.0], TIME], TWO, "times[0] must increase strictly, but sample 2 is at 1.0 after 2.0"),
        ([[0.0]], [[[1.0]]], "times[0] has 1 samples: a demonstration needs at least 2"),
        ([np.zeros((3, 1)), TIME], TWO, "times[0] has shape (3, 1)"),
        (TIME, TWO + 1j, "positions[0] is complex128"),
        (TIME, np.full((2, 3, 1), "1", dtype=object), "positions[0] holds text"),
        (TIME, TWO.astype(str), "positions[0] holds text"),
        (TIME.astype("datetime64[s]"), TWO, "times[0] holds dates or durations (datetime64[s])"),
        (TIME, [[[1.0], [2.0, 3.0], [4.0]]], "positions[0] is ragged"),
        (TIME, [np.zeros((3, 2, 2))], "positions[0] has shape (3, 2, 2)"),
        (TIME, np.zeros((2, 3, 0)), "positions[0] has shape (3, 0)"),
        ([TIME], [np.ma.masked_equal([[1.0], [-1.0], [2.0]], -1.0)], "positions[0] has masked entries"),
    ],
)
def test_what_is_not_a_set_of_recordings_is_refused(times, positions, words):
    with pytest.raises(ValueError, match=re.escape(words)):
        Demonstrations(times, positions)


def test_times_further_apart_than_a_number_are_refused():
    with pytest.raises(ValueError, match=r"times goes from -1e\+308 to 1e\+308, further than float64 can tell"):
        Demonstrations([-1e308, 0.0, 1e308], [[0.0, 1.0, 2.0]])
    longest = Demonstrations([-8e307, 0.0, 8e307], [[0.0, 1.0, 2.0]])
    np.testing.assert_array_equal(longest.stack("phase")[0][:, 0], [0.0, 0.5, 1.0])


@pytest.mark.parametrize("step", [0.01, 100.0])
def test_unix_time_in_float32_is_refused(step):
    time = (1.7e9 + step * np.arange(4)).astype(np.float32)  # 128 s apart at best
    with pytest.raises(ValueError, match=r"float32, which resolves 128 at 1\.7e"):
        Demonstrations([time], np.zeros((1, 4, 1)))


def test_float32_times_that_resolve_half_their_steps_are_refused():
    time = (100.0 + 1.5e-5 * np.arange(20)).astype(np.float32)
    with pytest.raises(ValueError, match=r"float32, which resolves 7\.63e-06 at 100, where the mean step is 1\.49e-05"):
        Demonstrations(time, np.zeros((1, 20, 1)))


def test_float32_times_that_resolve_their_steps_are_accepted():
    Demonstrations(np.arange(10_000, dtype=np.float32) / 1000, np.zeros((1, 10_000, 1), np.float32))


@pytest.mark.parametrize(
    ("labels", "words"),
    [
        ({"names": ["x"]}, "names has 1 entries [x] but the demonstrations have 2 outputs"),
        ({"names": ["x", "x"]}, "names must differ"),
        ({"names": ["x", 1]}, "names[1] is 1, must be text"),
        ({"units": ["m", "m", "m"]}, "units has 3 entries"),
    ],
)
def test_labels_are_one_for_each_output(labels, words):
    with pytest.raises(ValueError, match=re.escape(words)):
        Demonstrations(TIME, np.zeros((2, 3, 2)), **labels)


@pytest.mark.parametrize(
    ("labels", "words"),
    [
        ({"frame": 3}, "frame is 3, must be text or None"),
        ({"time_unit": 5}, "time_unit is 5, must be the unit of the times"),
        ({"time_unit": None}, "time_unit is None, must be the unit of the times"),
        ({"time_unit": ""}, "time_unit is '', must be the unit of the times"),
        ({"names": ["x", "a\nb"]}, r"names[1] is 'a\nb', must be text without control characters"),
        ({"names": ["\ud800", "y"]}, r"names[0] is '\ud800', must be text without control characters"),
    ],
)
def test_labels_that_no_file_could_give_back_are_refused(labels, words):
    make = getattr(Demonstrations.__init__, "__wrapped__", Demonstrations.__init__)  # beartype would refuse first
    with pytest.raises(ValueError, match=re.escape(words)):
        make(Demonstrations.__new__(Demonstrations), [0.0, 1.0], [[[0.0, 1.0], [2.0, 3.0]]], **labels)


@pytest.mark.parametrize("d", [1, 2, 9])
def test_cross_validation_by_demonstration_sees_the_groups(d, rng):
    from sklearn.model_selection import LeaveOneGroupOut

    demonstrations = Demonstrations(TIME, rng.normal(size=(5, 3, d)))
    X, y, groups = demonstrations.stack()
    for k, (train, test) in enumerate(LeaveOneGroupOut().split(X, y, groups)):
        parts = demonstrations.split(k)
        np.testing.assert_array_equal(y[train], parts[0].stack()[1])
        np.testing.assert_array_equal(y[test], parts[1].stack()[1])


def test_example_of_the_docstring():
    assert doctest.testmod(demonstrations) == (0, 5)

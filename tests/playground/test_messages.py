"""What a page may say, and what is refused in words before anything is done with it."""

import json

import numpy as np
import pytest

from torch_pbd.playground import messages

from .strokes import make_strokes


@pytest.mark.parametrize("text", [None, "", "{", "[1]", "3", '{"type": 3}', "[" * 100_000, '{"a": NaN}'])
def test_what_is_no_message_is_refused(text):
    with pytest.raises(ValueError, match="message"):
        messages.parse(text)


@pytest.mark.parametrize(
    "strokes",
    [
        None,
        [],
        make_strokes(1),
        make_strokes(2) * 30,
        [[[0.0, 0.0, 0.0]] * 3] * 2,
        [[[0.01 * i, 0.0] for i in range(9)]] * 2,
        [[[0.01 * i, 0.0, "x"] for i in range(9)]] * 2,
        [[[0.01 * i, 0.0, float("nan")] for i in range(9)]] * 2,
        [[[0.01 * i, 0.0, 1e9] for i in range(9)]] * 2,
        [[[0.0, 0.0, 0.01 * i] for i in range(9)]] * 2,
        [[[0.01 * i, 0.0, 0.0] for i in range(5000)]] * 2,
    ],
)
def test_strokes_that_cannot_be_learned_from_are_refused(strokes):
    with pytest.raises((ValueError, TypeError), match=r"strokes|stroke"):
        messages.as_strokes(strokes)


def test_events_of_a_pointer_that_share_a_time_or_go_back_are_one():
    rows = make_strokes(2)
    rows[0].insert(10, [rows[0][9][0], 0.5, 0.5])
    rows[0].insert(20, [rows[0][3][0], 0.5, 0.5])
    first, _ = messages.as_strokes(rows)
    assert len(first) == len(rows[0]) - 2
    assert first[0, 0] == 0.0
    assert (np.diff(first[:, 0]) > 0).all()


@pytest.mark.parametrize(
    "settings",
    [
        None,
        {"n_jobs": 3},
        {"models": []},
        {"models": ["os.system"]},
        {"models": ["DMPController"]},
        {"models": "GMMBaseline"},
        {"mass": 0},
        {"mass": "1"},
        {"stiffness_min": 500, "stiffness_max": 100},
        {"speed": 1e9},
        {"smooth": "yes"},
    ],
)
def test_settings_beyond_the_sliders_are_refused(settings):
    with pytest.raises(ValueError, match=r"settings|models|mass|stiffness|speed|smooth"):
        messages.as_settings(settings)


@pytest.mark.parametrize("points", [None, 3, [[0.1, 0.2]], [[0.1, 0.2, float("inf")]], [[0.0, 0.0, 0.0]] * 13])
def test_via_points_that_are_none_are_refused(points):
    with pytest.raises(ValueError, match="points"):
        messages.as_points(points)


@pytest.mark.parametrize(
    "message",
    [{}, {"name": "/etc/passwd", "content": ""}, {"name": "a.pkl", "content": ""}, {"name": "a.csv", "content": "*"},
     {"name": "a.csv"}, {"name": 3, "content": ""}],
)  # fmt: skip
def test_files_of_other_kinds_are_refused(message):
    with pytest.raises(ValueError, match="file"):
        messages.as_file(message)


def test_forty_strokes_of_a_minute_are_one_message():
    stroke = [[round(i / 60, 4), 0.123456, 0.654321] for i in range(1000)]
    assert len(json.dumps({"type": "learn", "strokes": [stroke] * 40})) < messages.MOST_BYTES

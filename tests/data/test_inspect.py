"""What is said of recordings before anything is fitted: each planted mistake by its name, and nothing of good ones."""

import re

import numpy as np
import pandas as pd
import pytest

from torch_pbd.cli.main import main
from torch_pbd.data import Demonstrations, inspect_demonstrations, make_tunnel_demonstrations, save_demonstrations

RATE, N = 50.0, 151


def reach(k):
    """A reach of 3 s from rest to rest, in m."""
    s = np.linspace(0, 1, N)[:, None]
    return (s**3 * (10 - 15 * s + 6 * s**2)) * [0.4, 0.2 + 0.01 * k]


def recorded(times=None, positions=None, **labels):
    times = [np.arange(N) / RATE] * 3 if times is None else times
    labels = {"names": ["x", "y"], "units": "m"} | labels
    return Demonstrations(times, [reach(k) for k in range(3)] if positions is None else positions, **labels)


def turning(sign=1.0):
    angle = np.linspace(0, 1, N)
    return sign * np.column_stack([np.cos(angle / 2), np.sin(angle / 2), 0 * angle, 0 * angle])


def with_quaternions(signs, flip=None, names=("q0", "q1", "q2", "q3")):
    poses = [np.column_stack([reach(k), turning(sign)]) for k, sign in enumerate(signs)]
    if flip:
        poses[1][flip:, 2:] *= -1
    with pytest.warns(UserWarning, match="squared sum 1"):
        return recorded(positions=poses, names=["x", "y", *names], units=["m"] * 2 + ["1"] * 4)


def with_gap():
    kept = np.r_[:60, 85:N]
    times = [np.arange(N) / RATE, (np.arange(N) / RATE)[kept], np.arange(N) / RATE]
    return recorded(times, [reach(0), reach(1)[kept], reach(2)])


def with_rest():
    times = [np.arange(N + 50) / RATE] * 3
    return recorded(times, [np.vstack([np.repeat(reach(k)[:1], 50, axis=0), reach(k)]) for k in range(3)])


NS = 1_700_000_000 * 10**9 + 1 + np.arange(N) * 20_000_000
MM = [1e3 * reach(k) for k in range(3)]

CASES = {
    "unix": (lambda: recorded([np.arange(N) / RATE + 1.7e9 + 60 * k for k in range(3)]), "since 1970.*from_start=True"),
    "apart": (lambda: recorded([np.arange(N) / RATE + 60.0 * k for k in range(3)]), "do not overlap.*from_start=True"),
    "ns": (lambda: recorded([NS] * 3), "look like ns.*time_unit='ns'"),
    "ms": (lambda: recorded([np.arange(N) * 20.0] * 3), "look like ms.*time_unit='ms'"),
    "long": (lambda: recorded([np.arange(N * 30) / 5.0], [np.tile(reach(0), (30, 1))]), "longer than ten minutes"),
    "gap": (with_gap, r"Recording 1 has a gap of 0\.52 s at 1\.18, 26 times"),
    "still": (with_rest, r"Nothing moves at the start of recordings \[0, 1, 2\], for up to 1\.\d+ s: say trim='still'"),
    "order": (lambda: with_quaternions([1, 1, 1]), "q0, q1, q2, q3 have .* of which only you know the names"),
    "sign": (lambda: with_quaternions([1, -1, 1]), r"is -q where it was q, in recordings \[1\]"),
    "flip": (lambda: with_quaternions([1, 1, 1], flip=75), r"is -q where it was q, in recordings \[1\]"),
    "cut": (lambda: recorded([np.arange(50) / RATE] * 3, [y[50:100] / 1e3 for y in MM]), r"start.*2\] are moving"),
    "units": (lambda: recorded(units=None), "no units: give units="),
    "mm": (lambda: recorded(positions=MM, units=None), "Output x covers 400: as metres that is far"),
    "m?": (lambda: recorded(positions=MM), "Output x covers 400 m: another unit"),
    "constant": (lambda: recorded(positions=[y * [1e-3, 0] for y in MM]), r"y never changes.*outputs=\['x'\]"),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_each_mistake_is_named_with_its_remedy(case):
    make, words = CASES[case]
    described = make().describe()
    assert any(re.search(words, sentence) for sentence in described.mistakes), described
    assert max(map(len, str(described).partition("\n1. ")[0].splitlines())) <= 80


@pytest.mark.parametrize("made", [recorded, lambda: make_tunnel_demonstrations(5, random_state=0)])
def test_little_is_said_of_good_recordings(made):
    told = [m for m in made().describe().mistakes if "moving" not in m]  # the tunnel's hand moves at once
    assert told == []


def test_the_table_says_what_is_there():
    described = with_gap().describe()
    assert described.recordings[1] == {
        "#": 1, "samples": N - 25, "start [s]": 0.0, "lasts [s]": 3.0, "rate [Hz]": pytest.approx(RATE),
        "gap [s]": pytest.approx(0.52), "rest before": 0.0, "rest after": 0.0,
    }  # fmt: skip
    assert described.outputs[0] == {"output": "x", "unit": "m", "least": 0.0, "largest": 0.4, "extent": 0.4}
    assert str(described).count("\n") < 20
    many = Demonstrations(np.arange(9.0), np.random.default_rng(0).normal(size=(50, 9, 2)))
    assert "... 50 recordings in all" in str(many.describe())


def ros_csv(path):
    """Everything at once: the index of pandas, unix times, an order of quaternions, a counter."""
    rows = [
        pd.DataFrame({"stamp": 1.7e9 + 60 * k + np.arange(N) / RATE, "trial": k, "seq": np.arange(N)}).assign(
            x=reach(k)[:, 0], y=reach(k)[:, 1], **{f"q{i}": q for i, q in enumerate(turning().T)}
        )
        for k in range(3)
    ]
    pd.concat(rows, ignore_index=True).to_csv(path)


def test_inspect_goes_on_where_loading_would_stop(tmp_path, capsys):
    ros_csv(tmp_path / "ros.csv")
    demonstrations, described = inspect_demonstrations(tmp_path / "ros.csv", demo="trial")
    assert demonstrations.names == ("x", "y", "q0", "q1", "q2", "q3")
    told = "\n".join(described.mistakes)
    for words in [
        "column 1 has no name",
        "say time='stamp'",
        "column 'seq': it counts",
        "only you know the names",
        "1970",
        "units=",
    ]:
        assert words in told
    assert (
        main(["inspect", str(tmp_path / "ros.csv"), "--loader.demo", "trial", "--output", str(tmp_path / "out")]) == 0
    )
    shown = capsys.readouterr()
    assert "1970" in shown.out
    assert max(map(len, shown.out.split("1. ")[0].splitlines()[2:])) <= 80
    assert (tmp_path / "out" / "figures" / "recordings.png").stat().st_size > 10_000


def test_several_files_may_be_named_as_the_shell_gives_them(tmp_path, capsys):
    for k in range(2):
        save_demonstrations(recorded()[[k]], tmp_path / f"a_{k}.csv")
    files = [str(tmp_path / f"a_{k}.csv") for k in range(2)]
    assert main(["inspect", *files, "--loader.units", "m", "--output", str(tmp_path / "out")]) == 0
    assert (
        "a_0.csv to a_1.csv, 2 files: 2 demonstrations of 151 samples, 2 outputs (x, y), aligned\n"
        in capsys.readouterr().out
    )
    assert main(["inspect", "--output", str(tmp_path / "out")]) == 2
    assert "data is missing" in capsys.readouterr().err

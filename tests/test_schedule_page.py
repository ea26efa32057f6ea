"""The page of the schedule's file format: its readers read what is saved, to the bit, and it says every byte."""

import io
import json
import re
import struct
import subprocess
import zipfile
from pathlib import Path

import numpy as np
import pytest
from cpp.bridge import ROOT, compiled, needs_compiler

from torch_pbd import rotations
from torch_pbd.control import RealTimeAdmittance, Schedule
from torch_pbd.control.schedule import contents

PAGE = (ROOT / "docs" / "schedule.md").read_text(encoding="utf-8")
GOLDEN = ROOT / "tests" / "golden" / "v1"


def blocks(language):
    return re.findall(rf"```{language}\n(.*?)```", PAGE, re.DOTALL)


@pytest.fixture
def page(tmp_path, monkeypatch):
    """Names of the page, after its blocks ran."""
    monkeypatch.chdir(tmp_path)
    names = {"__name__": "page"}
    for block in blocks("python"):
        exec(compile(block, "schedule.md", "exec"), names)
    return names


def pose(rng):
    n, d = 5, 6
    gains = np.eye(d) + 0.1 * rng.uniform(size=(n, d, d))
    gains = gains @ gains.swapaxes(1, 2)
    return Schedule(
        np.cumsum(rng.uniform(0.1, 1.0, size=n)), rng.normal(size=(n, 3)), rng.normal(size=(n, d)),
        300.0 * gains, 30.0 * gains, 1e-4 * gains, rng.uniform(size=n),
        acceleration=rng.normal(size=(n, d)), orientation=rotations.exp(rng.normal(size=(n, 3))), mass=2.0 * gains,
        names=["x, across", 'y "up"', "z", "rx", "ry", "rz"], units="mm", frame="café",
        stiffness_limits=([1.0] * d, [1e4] * d), provenance={"z": [1, {"b": 1e-5, "a": None}], "é": -0.0},
    )  # fmt: skip


SIMPLE = Schedule(
    [0.0, 1.0], [[0.1]] * 2, [[0.0]] * 2, [[[9.0]]] * 2, [[[6.0]]] * 2, [[[1.0]]] * 2, [0.0, 1.0], mass=2.0
)


@pytest.fixture(params=["pose", "simple", "version 1"])
def saved(request, rng, tmp_path):
    """A schedule and its files, without their suffix."""
    if request.param == "version 1":
        return Schedule.load(GOLDEN / "schedule.npz"), GOLDEN / "schedule"
    schedule = pose(rng) if request.param == "pose" else SIMPLE
    for suffix in (".csv", ".json", ".npz"):
        schedule.save(tmp_path / f"schedule{suffix}")
    return schedule, tmp_path / "schedule"


def arrays_of(schedule):
    arrays = {name: getattr(schedule, name) for name in contents.SHAPES}
    return {name: array for name, array in arrays.items() if isinstance(array, np.ndarray)}


def assert_labels(labels, schedule):
    assert labels["names"] == (None if schedule.names is None else list(schedule.names))
    assert (labels["units"], labels["frame"]) == (schedule.units, schedule.frame)
    assert labels["provenance"] == schedule.provenance
    assert labels["mass"] == (None if isinstance(schedule.mass, np.ndarray) else schedule.mass)


def test_csv_is_read_by_the_reader_of_the_page(page, saved):
    schedule, path = saved
    labels, columns = page["read_schedule"](path.with_suffix(".csv"))
    assert_labels(labels, schedule)
    names, between = schedule.names or [str(i) for i in range(schedule.n_outputs)], "]["
    if labels["version"] == 1:
        between = ","
    told = []
    for name, array in arrays_of(schedule).items():
        letters = "wxyz" if name == "orientation" else names
        if array.ndim == 1:
            told.append((name, array))
        elif array.ndim == 2:
            told += [(f"{name}[{letter}]", column) for letter, column in zip(letters, array.T, strict=False)]
        else:
            upper = zip(*np.triu_indices(schedule.n_outputs), strict=True)
            told += [(f"{name}[{names[i]}{between}{names[j]}]", array[:, i, j]) for i, j in upper]
    assert list(columns) == [title for title, _ in told]
    for title, column in told:
        np.testing.assert_array_equal(columns[title], column, err_msg=title)


def test_csv_is_written_as_the_page_says(saved):
    schedule, path = saved
    content = path.with_suffix(".csv").read_bytes()
    assert content.endswith(b"\n")
    assert b"\r" not in content
    lines = content.decode().split("\n")
    keys = re.findall(r"^\| `(\w+)` \| (?:`|text|d |least|virtual|an object|checksum)", PAGE, re.MULTILINE)
    assert [line[2 : line.index(":")] for line in lines[:10]] == keys
    assert all(line.isascii() for line in lines[:10])
    assert lines[11] == ",".join(repr(float(cell)) for cell in lines[11].split(","))
    assert len(lines) == 10 + 1 + len(schedule) + 1


def test_json_and_the_checksum_are_those_of_the_page(page, saved):
    schedule, path = saved
    labels = json.loads(path.with_suffix(".json").read_text())
    arrays = labels.pop("arrays")
    assert_labels(labels, schedule)
    assert page["checksum"](labels, arrays) == labels["sha256"]
    for name, array in arrays_of(schedule).items():
        np.testing.assert_array_equal(arrays[name], array)
    assert page["read_schedule"](path.with_suffix(".csv"))[0]["sha256"] == labels["sha256"]


def member(content):
    """Array of a member of an archive by what the page says, without NumPy's reader."""
    assert content[:8] == bytes.fromhex("93 4e 55 4d 50 59 01 00")
    (length,) = struct.unpack("<H", content[8:10])
    assert (10 + length) % 64 == 0
    text = content[10 : 10 + length].decode("ascii")
    assert text.endswith("\n")
    described = eval(text, {})
    values = content[10 + length :]
    if described["descr"].startswith("<U"):
        assert described["shape"] == ()
        letters = values.decode("utf-32-le")
        assert len(letters) == int(described["descr"][2:])
        assert values[::4] == letters.encode("ascii")
        return letters
    assert described["descr"] == "<f8"
    order = "F" if described["fortran_order"] else "C"
    return np.reshape(struct.unpack(f"<{len(values) // 8}d", values), described["shape"], order=order)


def test_npz_is_what_the_page_says(saved):
    schedule, path = saved
    with zipfile.ZipFile(io.BytesIO(path.with_suffix(".npz").read_bytes())) as archive:
        assert all(info.compress_type == zipfile.ZIP_STORED for info in archive.infolist())
        members = {Path(name).stem: member(archive.read(name)) for name in archive.namelist()}
    assert_labels(json.loads(members.pop("header")), schedule)
    assert set(members) == set(arrays_of(schedule))
    for name, array in arrays_of(schedule).items():
        np.testing.assert_array_equal(members[name], array)


def test_the_page_names_every_array_and_label():
    for name in (*contents.SHAPES, *contents.LABELS):
        assert f"\n| `{name}` |" in PAGE
    order = [PAGE.index(f"| `{name}` |") for name in contents.SHAPES if name != "mass"]
    assert order == sorted(order)


@pytest.mark.slow
@needs_compiler
def test_the_program_of_the_page_does_what_python_does(page, tmp_path):
    (tmp_path / "page.cpp").write_text(blocks("cpp")[0], encoding="utf-8")
    program = compiled(tmp_path / "page.cpp", "-O2")
    ran = subprocess.run([program], capture_output=True, text=True, check=True, cwd=tmp_path)
    controller = RealTimeAdmittance(page["schedule"])
    controller.start(0.0, [0.0, 0.01])
    for tick in range(1, 4001):
        controller.tick(1e-3 * tick, [0.0, 5.0])
    assert ran.stdout == "{:.4f} {:.4f}\n".format(*controller.position)

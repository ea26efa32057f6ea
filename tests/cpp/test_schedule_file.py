"""Schedules that Python saves, as C++ reads them."""

import numpy as np
import pytest
from control.test_schedule_poses import spd
from cpp.bridge import ROOT, needs_compiler, read_array

from torch_pbd import rotations
from torch_pbd.control.schedule import Schedule, contents

pytestmark = needs_compiler


def made(rng, *, is_pose, **labels):
    n, p = 7, 3 if is_pose else 2
    d = p + 3 * is_pose
    parts = {
        "position": rng.normal(size=(n, p)),
        "velocity": rng.normal(size=(n, d)),
        "stiffness": spd(rng, n, np.full(d, 10.0)),
        "damping": spd(rng, n, np.full(d, 3.0)),
        "covariance": spd(rng, n, np.full(d, 1e-3)),
        "type1": rng.uniform(size=n),
    }
    if is_pose:
        turns = rotations.exp(np.outer(np.linspace(0.0, 5.0, n), [0.9, 1.2, -0.5]))
        labels |= {"orientation": turns, "mass": spd(rng, n, np.full(d, 2.0)), "acceleration": rng.normal(size=(n, d))}
    return Schedule(0.1 + np.cumsum(rng.uniform(0.1, 1.0, size=n)), **parts, **labels)


def assert_read_as(path, schedule):
    for name in contents.SHAPES:
        told, read = getattr(schedule, name), read_array(path, name)
        if isinstance(told, np.ndarray):
            np.testing.assert_array_equal(read, told.ravel(), err_msg=name)
        else:
            assert read is None


@pytest.mark.parametrize("is_pose", [False, True])
def test_every_number_is_the_same_to_the_bit(is_pose, rng, tmp_path):
    names = ["x, across", '"y"', "z]", "rx", "r\u00e9", "\U0001f600"][: 6 if is_pose else 2]
    # Keys that come in another order than that of the checksum: of their letters and not of their escapes.
    nested = {"b": [1e-05, {}], "a": '} " {'}
    provenance = {"z": nested, "\u00e9": None, "e": [], "\u65e5": True, "\\": -0.0, "\n": 1, "e ": 2, "e\\u0041": 3}
    schedule = made(rng, is_pose=is_pose, names=names, provenance=provenance, units="mm")
    path = tmp_path / "schedule.csv"
    schedule.save(path)
    assert_read_as(path, schedule)
    text = path.read_text(encoding="utf-8")
    path.write_bytes(("\ufeff" + text.replace("\n", "\r\n")).encode())  # as a spreadsheet writes it
    assert_read_as(path, schedule)


def test_files_of_the_first_format_are_read_once_they_are_saved_anew(tmp_path):
    old, path = ROOT / "tests" / "golden" / "v1" / "schedule.csv", tmp_path / "schedule.csv"
    with pytest.raises(ValueError, match="it has version 1, must have 2: save it anew"):
        read_array(old, "time")
    Schedule.load(old).save(path)
    assert_read_as(path, Schedule.load(old))


def refusal(path, content):
    """Why a file of this content is not read; None if it is."""
    path.write_bytes(content)
    try:
        read_array(path, "time")
    except ValueError as error:
        return str(error).removeprefix(f"{path} cannot be read as a schedule: ")
    return None


def test_a_torn_or_flipped_file_is_refused(rng, tmp_path):
    schedule, path = made(rng, is_pose=False), tmp_path / "schedule.csv"
    schedule.save(path)
    whole = path.read_bytes()
    lines = whole.splitlines(keepends=True)
    for n in range(len(lines)):
        assert refusal(path, b"".join(lines[:n])), n
    for place in rng.choice(len(whole), size=300, replace=False):
        flipped = bytearray(whole)
        flipped[place] ^= 1 << rng.integers(8)
        if refusal(path, bytes(flipped)) is None:
            assert_read_as(path, schedule)  # 1e-05 as 1E-05


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("torch_pbd.schedule", "other", "it is no schedule"),
        ("version: 2", "version: 3", "it has version 3, must have 2"),
        ("# units", "# frame", "has a label that was there before"),
        ("position[0],position[1]", "position[1],position[0]", "columns of velocity are not those of position"),
        ("stiffness[0][1]", "stiffness[1][0]", "its columns of stiffness are not 3 in the order of the outputs"),
        ("type1", "type2", "its columns of type1 are not 1"),
        ("time,", "time,more,", "has not as many cells as the 16 columns"),
        ("\n0.5,", "\n-0.5,", "time of row 1 must be later than the one before"),
        ("\n0.5,", "\n0.5,1.0,", "line 12 has not as many cells as the 15 columns"),
        ("\n0.5,", "\nnan,", "line 12: 'nan' is not a finite number"),
        ("\n0.5,", "\n1e999,", "line 12: '1e999' is not a finite number"),
        ("\n0.5,", "\n,", "line 12: '' is not a finite number"),
        ("\n0.5,", "\n1_0,", "line 12: '1_0' is not a finite number"),
        ("100.0", "-100.0", "stiffness of row 0 must be positive semidefinite"),
        ("100.0", "0.0", "damping of row 0 must be above zero where the stiffness is singular"),
    ],
)
def test_an_edited_file_is_read_without_its_checksum_where_a_robot_can_follow_it(old, new, message, tmp_path):
    gains = np.stack([np.diag([100.0, 0.5])] * 2)
    still = np.zeros((2, 2))
    path = tmp_path / "schedule.csv"
    Schedule([0.0, 0.5], still, still, gains, np.diag([0.0, 3.0]) + 0 * gains, gains, [0.0, 1.0]).save(path)
    text = "".join(line for line in path.read_text().splitlines(keepends=True) if not line.startswith("# sha256"))
    assert refusal(path, text.replace("100.0", "123.0").encode()) is None
    assert read_array(path, "stiffness")[0] == 123.0
    assert old in text
    assert message in (refusal(path, text.replace(old, new, 1).encode()) or "")


def test_a_quaternion_that_is_none_is_refused(rng, tmp_path):
    path = tmp_path / "schedule.csv"
    made(rng, is_pose=True).save(path)
    lines = [line for line in path.read_text().splitlines() if not line.startswith("# sha256")]
    place = lines[9].split(",").index("orientation[w]")
    cells = lines[10].split(",")
    cells[place] = "2.0"
    wrong = "\n".join([*lines[:10], ",".join(cells), *lines[11:]])
    assert "orientation of row 0 must be of norm 1" in refusal(path, wrong.encode())
    text = "\n".join(lines).replace("orientation[w],orientation[x]", "orientation[x],orientation[w]")
    assert "its columns of orientation are not 4" in refusal(path, text.encode())

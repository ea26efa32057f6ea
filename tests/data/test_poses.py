"""Rotations and angles among the outputs: the chart and its invariances, what keeps it, what is refused."""

import copy
import pickle
import re
import warnings

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from torch_pbd import Demonstrations, load_demonstrations
from torch_pbd.cli.main import main
from torch_pbd.data import (
    inspect_demonstrations,
    make_pose_demonstrations,
    pose_covariance,
    pose_mean,
    save_demonstrations,
)
from torch_pbd.exceptions import MissingDataWarning

WXYZ = ("qw", "qx", "qy", "qz")
NAMES = ("x", "qx", "qy", "grip", "qz", "qw")  # in no order at all
UNITS = ("m", "1", "1", "mm", "1", "1")


def columns(place, quaternion):
    """Positions x and grip, and quaternions w x y z, as `NAMES` have them."""
    w, x, y, z = quaternion.T
    return np.column_stack([place[:, 0], x, y, place[:, 1], z, w])


@pytest.fixture
def recorded(rng):
    """Times, places (T, 2) and rotations of four recordings of different lengths."""
    times, places, turns = [], [], []
    for n in (40, 55, 47, 61):
        time = np.linspace(0.0, 2.0, n) ** 1.1
        times.append(time)
        places.append(np.column_stack([np.sin(time), 20.0 * time]) + 0.01 * rng.normal(size=2))
        own = Rotation.from_rotvec(0.2 * rng.normal(size=3))
        turns.append(own * Rotation.from_rotvec(np.outer(time, [0.4, -0.5, 0.3])))
    return times, places, turns


def made(recorded, *, signs=None, order=None, before=None, behind=None):
    times, places, turns = recorded
    order = range(len(times)) if order is None else order
    identity = Rotation.identity()
    turned = [(before or identity) * turn * (behind or identity) for turn in turns]
    quaternions = [turn.as_quat(scalar_first=True) for turn in turned]
    if signs is not None:
        quaternions = [q * signs.choice([-1.0, 1.0], size=(len(q), 1)) for q in quaternions]
    positions = [columns(*pair) for pair in zip(places, quaternions, strict=True)]
    each = [times[k] for k in order], [positions[k] for k in order]
    return Demonstrations(*each, names=NAMES, units=UNITS, frame="base", rotation=WXYZ)


@pytest.fixture
def posed(recorded):
    return made(recorded)


def test_four_columns_become_three_in_the_last_places(recorded, posed):
    _, places, turns = recorded
    assert posed.names == ("x", "grip", "rx", "ry", "rz")
    assert posed.units == ("m", "mm", "rad", "rad", "rad")
    reference = Rotation.from_quat(posed.rotation_reference, scalar_first=True)
    for k, (_, position) in enumerate(posed):
        np.testing.assert_array_equal(position[:, :2], places[k])
        expected = (reference.inv() * turns[k]).as_rotvec()
        np.testing.assert_allclose(position[:, 2:], expected, rtol=0, atol=1e-14)


def test_the_reference_is_the_frechet_mean_on_common_phases(recorded, posed):
    # Of which the mean of the logarithms is zero. A phase is interpolated along the chord here, and by scipy along the
    # arc: they differ in the third power of steps of 0.02 rad.
    phases = np.linspace(0.0, 1.0, 201)
    reference = Rotation.from_quat(posed.rotation_reference, scalar_first=True)
    mean = np.zeros(3)
    for time, turn in zip(recorded[0], recorded[2], strict=True):
        unit = (time - time[0]) / np.ptp(time)
        mean += (reference.inv() * Slerp(unit, turn)(phases)).as_rotvec().mean(axis=0) / 4
    np.testing.assert_allclose(mean, 0.0, atol=1e-6)


def test_signs_world_and_order_change_nothing_and_the_tool_turns_the_chart(recorded, posed, rng):
    turn = Rotation.random(random_state=1)
    for other in (
        made(recorded, signs=rng),
        made(recorded, before=turn),
        made(recorded, order=[2, 0, 3, 1])[[1, 3, 0, 2]],
    ):
        for mine, theirs in zip(posed.positions, other.positions, strict=True):
            np.testing.assert_allclose(theirs, mine, rtol=0, atol=4e-14)
    for mine, theirs in zip(posed.positions, made(recorded, behind=turn).positions, strict=True):
        np.testing.assert_allclose(theirs[:, 2:], turn.inv().apply(mine[:, 2:].copy()), rtol=0, atol=4e-14)


def test_poses_come_back_with_signs_that_go_on(recorded, rng):
    places, quaternions = made(recorded, signs=rng).to_poses()
    for k, quaternion in enumerate(quaternions):
        np.testing.assert_array_equal(places[k], recorded[1][k])
        apart = (Rotation.from_quat(quaternion, scalar_first=True).inv() * recorded[2][k]).magnitude()
        assert apart.max() < 1e-14
        assert ((quaternion[1:] * quaternion[:-1]).sum(axis=1) > 0.9).all()
        assert quaternion[0] @ quaternions[0][0] > 0.9
    with pytest.raises(ValueError, match=r"have no rotation: name its columns by rotation=, w x y z"):
        Demonstrations([0.0, 1.0], [[0.0, 1.0]]).to_poses()


KEEP = {
    "copy": copy.deepcopy,
    "pickle": lambda d: pickle.loads(pickle.dumps(d)),
    "index": lambda d: d[[0, 2]],
    "resample": lambda d: d.resample(30),
    "phase": lambda d: d.align(n=30),
    "dtw": lambda d: d.align("dtw", n=30),
    "trim": lambda d: d.trim(),
    "cut": lambda d: d[:1].cut([(0.0, 0.7), (0.8, 2.0)]),
    "split": lambda d: d.split(1)[0],
    "from_start": lambda d: d.from_start(),
    "in_units": lambda d: d.in_units("mm", "ms"),
    "select": lambda d: d.select(["rz", "x", "ry", "rx"]),
    "together": lambda d: Demonstrations.concatenate([d[:1], d[1:]]),
    "again": lambda d: Demonstrations(
        d.times, d.positions, names=d.names, units=d.units, frame=d.frame, rotation_reference=d.rotation_reference
    ),
}


@pytest.mark.parametrize("edit", KEEP.values(), ids=KEEP)
def test_every_method_keeps_the_chart(posed, edit):
    edited = edit(posed)
    np.testing.assert_array_equal(edited.rotation_reference, posed.rotation_reference)
    assert edited.names[-3:] == ("rx", "ry", "rz")
    assert edited.units[-3:] == ("rad", "rad", "rad")
    with pytest.raises(ValueError, match="read-only"):
        edited.rotation_reference[0] = 2.0
    for quaternion in edited.to_poses()[1]:
        np.testing.assert_allclose(np.linalg.norm(quaternion, axis=1), 1.0, rtol=0, atol=1e-14)


def test_equality_sees_the_reference(posed):
    labels = {"names": posed.names, "units": posed.units, "frame": posed.frame}
    assert Demonstrations(posed.times, posed.positions, **labels) != posed
    assert KEEP["again"](posed) == posed
    other = Rotation.from_euler("z", 1.0).as_quat(scalar_first=True)
    assert Demonstrations(posed.times, posed.positions, **labels, rotation_reference=other) != posed


def test_a_rotation_is_selected_whole_or_not_at_all(posed):
    plain = posed.select("grip")
    assert plain.rotation_reference is None
    with pytest.raises(ValueError, match=r"with all of rx, ry, rz or none, which are one rotation"):
        posed.select(["x", "rx", "rz"])


def test_joined_sets_share_one_chart(recorded, posed):
    parts = [made([entry[k : k + 2] for entry in recorded]) for k in (0, 2)]
    assert not np.allclose(parts[0].rotation_reference, parts[1].rotation_reference, atol=1e-3)
    joined = Demonstrations.concatenate(parts)
    for mine, theirs in zip(posed.positions, joined.positions, strict=True):
        np.testing.assert_allclose(theirs, mine, rtol=0, atol=1e-13)
    bare = Demonstrations(posed.times, posed.positions, names=posed.names, units=posed.units, frame="base")
    with pytest.raises(ValueError, match="have no rotation"):
        Demonstrations.concatenate([posed, bare])


def test_units_are_those_of_the_other_columns(recorded):
    times, places, turns = recorded
    positions = [columns(p, turn.as_quat(scalar_first=True)) for p, turn in zip(places, turns, strict=True)]
    for units, expected in [("m", ("m", "m")), (UNITS, ("m", "mm")), (["m", "deg"], ("m", "deg")), (None, None)]:
        own = Demonstrations(times, positions, names=NAMES, units=units, rotation=WXYZ).units
        assert own == (expected and (*expected, "rad", "rad", "rad"))
    with pytest.raises(ValueError, match=r"unit is 'deg', must be of the kind of one of the outputs"):
        made(recorded).in_units("deg")
    alone = Demonstrations(
        times, [turn.as_quat(scalar_first=True) for turn in turns], names=WXYZ, units="m", rotation=WXYZ
    )
    assert (alone.names, alone.units) == (("rx", "ry", "rz"), ("rad", "rad", "rad"))


def test_dtw_does_not_see_how_axes_are_turned(recorded, rng):
    turn = Rotation.random(random_state=2)
    times, _, turns = recorded
    places = [np.column_stack([np.sin(3 * t), t**2, 0.1 * t]) + 0.02 * rng.normal(size=3) for t in times]
    aligned = []
    for axes in (Rotation.identity(), turn):
        quaternions = [(own * axes).as_quat(scalar_first=True) for own in turns]
        positions = [np.column_stack([axes.apply(p), q]) for p, q in zip(places, quaternions, strict=True)]
        for units in ("m", None):
            pose = Demonstrations(times, positions, names=("x", "y", "z", *WXYZ), units=units, rotation=WXYZ)
            together = pose.align("dtw", n=60).to_array()
            # Positions were turned by the axes, and coordinates in the chart of the tool against them.
            place, angle = np.split(together.reshape(-1, 6), 2, axis=1)
            aligned.append(np.hstack([axes.inv().apply(place), axes.apply(angle)]))
    for other in aligned[1:]:
        np.testing.assert_allclose(other, aligned[0], rtol=0, atol=1e-9)


def turning(most, n=51):
    """Two recordings that turn from -most to most degrees about an axis."""
    angles = np.radians(np.linspace(-most, most, n))
    quaternion = Rotation.from_rotvec(np.outer(angles, [0.6, 0.0, 0.8])).as_quat(scalar_first=True)
    return np.linspace(0.0, 1.0, n), [np.column_stack([np.zeros(n), quaternion])] * 2


def test_rotations_far_from_the_mean_are_told_and_refused():
    given = {"names": ("x", *WXYZ), "rotation": WXYZ}
    Demonstrations(*turning(119.0), **given)
    with pytest.warns(
        UserWarning, match=r"Recording 0 is 121\.0 degrees from the mean rotation at 0, and 150 are refused"
    ):
        Demonstrations(*turning(121.0), **given)
    with pytest.raises(
        ValueError, match=r"recording 0 is 151\.0 degrees .*screws.*from the mean rotation of each time"
    ):
        Demonstrations(*turning(151.0), **given)


@pytest.mark.parametrize("decimals", [3, 6])
def test_quaternions_of_files_are_rounded(recorded, posed, decimals):
    times, places, turns = recorded
    rounded = [np.round(turn.as_quat(scalar_first=True), decimals) for turn in turns]
    positions = [columns(*pair) for pair in zip(places, rounded, strict=True)]
    own = Demonstrations(times, positions, names=NAMES, rotation=WXYZ)
    for mine, theirs in zip(posed.positions, own.positions, strict=True):
        np.testing.assert_allclose(theirs, mine, rtol=0, atol=3.0 * 10.0**-decimals)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            {"rotation": WXYZ[:3]},
            "rotation is ('qw', 'qx', 'qy'), must be four different ones of [x, qx, qy, grip, qz, qw]",
        ),
        ({"rotation": ("qw", "qx", "qy", "x")}, "the norm of qw, qx, qy, x in positions[0][0] is"),
        ({"rotation": ("qw", "qw", "qy", "qz")}, "must be four different ones of"),
        ({"rotation": ("w", "x", "y", "z")}, "in the order w x y z, wherever these stand"),
        (
            {"rotation_reference": [1, 0, 0, 0]},
            "rotation_reference is [1, 0, 0, 0], must be None where rotation= names",
        ),
        ({"names": ("x", "qx", "qy", "rx", "qz", "qw")}, "names must differ from each other; got [x, rx, rx, ry, rz]"),
    ],
)
def test_what_names_no_rotation_is_refused(recorded, change, words):
    times, places, turns = recorded
    positions = [columns(p, turn.as_quat(scalar_first=True)) for p, turn in zip(places, turns, strict=True)]
    with pytest.raises(ValueError, match=re.escape(words)):
        Demonstrations(times, positions, **({"names": NAMES, "rotation": WXYZ} | change))


@pytest.mark.parametrize(
    ("reference", "units", "words"),
    [
        ([1.0, 0.1, 0.0, 0.0], None, "must be a unit quaternion w x y z"),
        ([1.0, 0.0, 0.0], None, "rotation_reference has shape (3,), must have shape (4,)"),
        ([1.0, 0.0, 0.0, 0.0], "m", "must be given for outputs that end with three of a rotation in rad"),
    ],
)
def test_a_reference_that_fits_no_outputs_is_refused(reference, units, words):
    with pytest.raises(ValueError, match=re.escape(words)):
        Demonstrations([0.0, 1.0], np.zeros((1, 2, 4)), units=units, rotation_reference=reference)


def test_lost_quaternions_are_dropped_or_refused(recorded):
    times, places, turns = recorded
    positions = [columns(p, turn.as_quat(scalar_first=True)) for p, turn in zip(places, turns, strict=True)]
    positions[1][5, [1, 2, 4, 5]] = 0.0
    with pytest.raises(ValueError, match=r"in positions\[1\]\[5\] is 0\.0, must be 1.*missing='drop' leaves"):
        Demonstrations(times, positions, names=NAMES, rotation=WXYZ)
    positions[2][7, 5] = np.nan
    with pytest.warns(MissingDataWarning) as told:
        kept = Demonstrations(times, positions, names=NAMES, rotation=WXYZ, missing="drop")
    assert [str(one.message)[:12] for one in told] == ["Dropped 1 of"] * 2
    assert kept.n_steps == (40, 54, 46, 61)
    np.testing.assert_array_equal(kept.times[1], np.delete(times[1], 5))


def test_suspects_name_their_remedies(recorded, rng):
    times, places, turns = recorded
    positions = [columns(p, turn.as_quat(scalar_first=True)) for p, turn in zip(places, turns, strict=True)]
    with pytest.warns(UserWarning, match="unit quaternions") as told:
        Demonstrations(times, [p[:, [1, 2, 4, 5]] for p in positions], names=["qx", "qy", "qz", "qw"])
    assert "w x y z, rotation=('qw', 'qx', 'qy', 'qz'), or leave them out" in str(told[0].message)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert not made(recorded).suspects
    angle = 2.0 + np.linspace(0.0, 2.0, 60)
    with pytest.warns(UserWarning, match=r"Say angles=\['j'\], and that its unit is 'rad'"):
        Demonstrations(np.arange(60.0), [np.arctan2(np.sin(angle), np.cos(angle))], names="j", units="rad")


@pytest.mark.parametrize("unit", ["rad", "deg"])
def test_angles_go_on_over_a_turn_and_between_recordings(unit):
    # Joint 7 passes half a turn in each recording, and one of them begins behind it.
    turn = 2.0 * np.pi if unit == "rad" else 360.0
    time = np.linspace(0.0, 1.0, 60)
    truth = np.array([2.9, 3.0, 3.3, 2.95])[:, None] / (2.0 * np.pi) * turn + 0.2 * turn * time
    wrapped = (truth + 0.5 * turn) % turn - 0.5 * turn
    both = np.stack([np.broadcast_to(time, truth.shape), wrapped], axis=2)
    own = Demonstrations(time, both, names=["x", "j"], units=["m", unit], angles="j")
    assert not own.suspects
    np.testing.assert_allclose(own.to_array()[:, :, 1], truth, rtol=0, atol=1e-12 * turn)
    np.testing.assert_array_equal(own.to_array()[:, :, 0], both[:, :, 0])
    # What is no jump stays as it is, beyond a turn too, and in any order.
    again = Demonstrations(
        time, own.to_array()[::-1] + np.array([0, turn]), names=["x", "j"], units=["m", unit], angles=["j"]
    )
    np.testing.assert_allclose(again.to_array()[::-1, :, 1], truth + turn, rtol=0, atol=1e-12 * turn)
    for wrong, words in [("y", "angles is 'y', must be among"), ("x", "must be in rad or deg, and is in m")]:
        with pytest.raises(ValueError, match=re.escape(words)):
            Demonstrations(time, both, names=["x", "j"], units=["m", unit], angles=wrong)


def test_stillness_does_not_hang_on_axes_that_tremble(rng):
    time = np.linspace(0.0, 4.0, 401)
    angle = np.interp(time, [1.0, 3.0], [0.0, 1.0])
    turns = [Rotation.from_rotvec(np.outer(angle, [1, 0, 0]) + 1e-3 * rng.uniform(size=(401, 3))) for _ in range(2)]
    trembling = Demonstrations(time, [turn.as_quat(scalar_first=True) for turn in turns], names=WXYZ, rotation=WXYZ)
    trimmed = trembling.trim("still")
    assert trimmed.times[0][0] == pytest.approx(1.0, abs=0.1)
    assert trimmed.times[0][-1] == pytest.approx(3.0, abs=0.1)
    assert all(row["rest before"] > 0.9 for row in trembling.describe().recordings)


def test_archives_give_a_chart_back_to_the_bit(posed, tmp_path):
    save_demonstrations(posed, tmp_path / "pose.npz")
    assert load_demonstrations(tmp_path / "pose.npz") == posed
    assert load_demonstrations(tmp_path / "pose.npz", outputs=["rx", "ry", "rz", "x"]) == posed.select(
        ["x", "rx", "ry", "rz"]
    )
    assert load_demonstrations(tmp_path / "pose.npz", outputs="x") == posed.select("x")
    with pytest.raises(ValueError, match="which are one rotation"):
        load_demonstrations(tmp_path / "pose.npz", outputs=["x", "rx"])


def test_tables_hold_quaternions(posed, tmp_path):
    table = posed.to_frame()
    assert [*table] == ["demo", "time", "x", "grip", *WXYZ]
    save_demonstrations(posed, tmp_path / "pose.csv")
    labels = {"units": ["m", "mm"], "frame": "base", "rotation": WXYZ}
    each = [load_demonstrations(tmp_path / "pose.csv", outputs=["x", "grip"], **labels)]
    each += [load_demonstrations(tmp_path / "pose.csv", **labels), Demonstrations.from_frame(table, **labels)]
    for k in range(4):  # a file each: their charts become one
        save_demonstrations(posed[[k]], tmp_path / f"run_{k}.csv")
    each.append(load_demonstrations(str(tmp_path / "run_*.csv"), **labels))
    for read in each:
        assert (read.names, read.units) == (posed.names, posed.units)
        for mine, theirs in zip(posed.positions, read.positions, strict=True):
            np.testing.assert_allclose(theirs, mine, rtol=0, atol=1e-12)


def test_angles_of_several_files_go_on_between_them(tmp_path):
    time = np.linspace(0.0, 1.0, 30)
    for k, first in enumerate([3.0, -3.1, 3.05]):
        save_demonstrations(Demonstrations(time, [first + 0.1 * time], names="j", units="rad"), tmp_path / f"{k}.csv")
    read = load_demonstrations(tmp_path, units="rad", angles="j")
    np.testing.assert_allclose(read.to_array()[:, 0, 0], [3.0, 2.0 * np.pi - 3.1, 3.05], rtol=1e-12)


def test_inspection_shows_the_chart_and_takes_the_options(recorded, posed, tmp_path, capsys):
    told = str(posed.describe())
    numbers = ", ".join(f"{q:.4f}" for q in posed.rotation_reference)
    assert f"Rotations are rx, ry, rz around the quaternion w x y z of {numbers}; the furthest is" in told
    save_demonstrations(posed, tmp_path / "pose.csv")
    read, description = inspect_demonstrations(tmp_path / "pose.csv", rotation=WXYZ)
    assert (read.names, description.rotation) == (posed.names, posed.describe().rotation)
    assert main(["inspect", str(tmp_path / "pose.csv"), "--loader.rotation", "[qw, qx, qy, qz]"]) == 0
    assert "Rotations are rx, ry, rz around" in capsys.readouterr().out
    (tmp_path / "inspect.yaml").write_text(
        f"data: {tmp_path / 'pose.csv'}\nloader:\n  rotation: [qw, qx, qy, qz]\n  units: m\n"
    )
    assert main(["inspect", "--config", str(tmp_path / "inspect.yaml")]) == 0
    assert "Rotations are rx, ry, rz around" in capsys.readouterr().out


def test_a_controller_and_regressors_see_ordinary_outputs(posed):
    X, y, groups = posed.align(n=20).stack("phase")
    assert (X.shape, y.shape, len(np.unique(groups))) == ((80, 1), (80, 5), 4)


def test_made_poses_follow_their_law():
    # 500 demonstrations: variances within 4 sqrt(2 / 500) = 25 %, and the mean within 4 sd / sqrt(500).
    pose = make_pose_demonstrations(500, duration=1.0, rate=20.0, timing=0.0, random_state=0)
    places, quaternions = map(np.array, pose.to_poses())
    phase = np.linspace(0.0, 1.0, 21)
    mean, turn = pose_mean(phase)
    covariance = pose_covariance(phase)
    desired = Rotation.from_quat(turn, scalar_first=True)
    for i in range(21):
        recorded = Rotation.from_quat(quaternions[:, i], scalar_first=True)
        deviation = np.hstack([places[:, i] - mean[i], (recorded * desired[i].inv()).as_rotvec()])
        root = np.linalg.inv(np.linalg.cholesky(covariance[i]))
        white = deviation @ root.T
        np.testing.assert_allclose(white.mean(axis=0), 0.0, atol=4.0 / np.sqrt(500))
        np.testing.assert_allclose(white.T @ white / 500, np.eye(6), atol=0.25)


def test_the_peg_is_precise_across_and_free_along_and_about_its_axis():
    axis = Rotation.from_quat(pose_mean([1.0])[1][0], scalar_first=True).as_matrix()[:, 2]
    at_hole = pose_covariance([1.0])[0]
    for block, unit, across, along in [(slice(3), 1e-3, 0.73, 8.0), (slice(3, 6), np.pi / 180, 0.71, 20.0)]:
        values, axes = np.linalg.eigh(at_hole[block, block])
        np.testing.assert_allclose(np.sqrt(values) / unit, [across, across, along], rtol=0.01)
        assert abs(axes[:, 2] @ axis) == pytest.approx(1.0, abs=1e-12)
    assert not at_hole[:3, 3:].any()
    assert np.degrees(np.arccos(-axis[2])) == pytest.approx(20.0, abs=0.1)  # leans so far
    varied = make_pose_demonstrations(random_state=0)
    assert (varied.names, varied.units) == (("x", "y", "z", "rx", "ry", "rz"), ("m",) * 3 + ("rad",) * 3)
    assert len(set(varied.n_steps)) > 1
    assert not varied.describe().mistakes
    assert varied == make_pose_demonstrations(random_state=0)

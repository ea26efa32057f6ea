"""Schedules of poses and for robots with an inertia: rows, limits, frames, files of both formats."""

import copy
import pickle
from dataclasses import astuple, replace

import numpy as np
import pytest
import torch
from scipy.linalg import eigh
from scipy.spatial.transform import Rotation

from torch_pbd import rotations
from torch_pbd.control import Schedule, damping_from_stiffness

SUFFIXES = (".npz", ".json", ".csv")
LIMITS = ([50.0] * 3 + [1.0] * 3, [1000.0] * 3 + [30.0] * 3)


def spd(rng, n, scales):
    """Matrices (n, d, d) of any axes, of the units of these scales squared."""
    d = len(scales)
    axes = np.linalg.qr(rng.normal(size=(n, d, d)))[0]
    return np.outer(scales, scales) * (axes * rng.uniform(0.5, 4.0, size=(n, 1, d)) @ axes.swapaxes(1, 2))


@pytest.fixture
def pose(rng):
    """A pose that turns and moves, with gains, a mass and an acceleration of its own in every row."""
    n, time = 9, np.linspace(0.3, 2.3, 9)
    units, masses = np.repeat([10.0, 1.0], 3), np.repeat([2.0, 0.3], 3)
    turn = rotations.multiply(
        rotations.exp(np.array([0.4, -1.0, 2.0])), rotations.exp(np.outer(time, [0.9, 1.2, -0.5]))
    )
    velocity = np.concatenate([rng.normal(size=(n, 3)), 0.3 * rng.normal(size=(n, 3))], axis=1)
    return Schedule(
        time,
        rng.normal(size=(n, 3)),
        velocity,
        spd(rng, n, units),
        spd(rng, n, 0.3 * units),
        spd(rng, n, 1e-2 / units),
        rng.uniform(size=n),
        acceleration=rng.normal(size=(n, 6)),
        orientation=turn,
        mass=spd(rng, n, masses),
        names=["x", "y", "z", "rx", "ry", "rz"],
    )


def test_has_the_shapes_of_a_pose(pose):
    assert (pose.n_outputs, pose.position.shape, pose.blocks) == (6, (9, 3), (slice(0, 3), slice(3, 6)))
    assert "N/m and " in repr(pose)
    assert "Nm/rad" in repr(pose)
    assert pickle.loads(pickle.dumps(pose)) == pose == copy.deepcopy(pose)
    for name in ("acceleration", "orientation", "mass"):
        assert replace(pose, mass=None, acceleration=None) != pose
        assert not getattr(pose, name).flags.writeable


def test_refuses_what_is_no_pose(pose):
    with pytest.raises(ValueError, match=r"velocity has shape \(9, 3\), must have shape \(9, 6\)"):
        replace(pose, velocity=pose.velocity[:, :3])
    with pytest.raises(ValueError, match=r"squared norm of orientation.*must be 1"):
        replace(pose, orientation=1.01 * pose.orientation)
    with pytest.raises(ValueError, match="the smallest eigenvalue of mass"):
        replace(pose, mass=pose.mass * np.outer([1, 1, 1, 1, 1, 0], [1, 1, 1, 1, 1, 0]))
    with pytest.raises(ValueError, match="acceleration has shape"):
        replace(pose, acceleration=pose.acceleration[:, :3])


def test_orientations_are_made_unit_and_continuous(pose, rng):
    rough = np.round(pose.orientation, 7) * rng.choice([-1.0, 1.0], size=(9, 1))
    found = replace(pose, orientation=rough).orientation
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0, rtol=1e-15)
    assert (np.sum(found[1:] * found[:-1], axis=1) > 0.0).all()
    np.testing.assert_array_equal(replace(pose, orientation=found).orientation, found)


def test_limits_bound_the_stiffness_as_matrices_whatever_the_units(pose, rng):
    # K_min + E^1/2 U E^1/2 with 0 <= U <= 1 is within K_min and K_max, though its diagonal blocks alone do not tell.
    low, high = map(np.array, LIMITS)
    root = np.sqrt(np.diag(high - low))
    axes = np.linalg.qr(rng.normal(size=(9, 6, 6)))[0]
    share = axes * np.concatenate([np.zeros((9, 1)), np.ones((9, 1)), rng.uniform(size=(9, 4))], axis=1)[:, None]
    stiffness = np.diag(low) + root @ (share @ axes.swapaxes(1, 2)) @ root
    assert replace(pose, stiffness=stiffness, stiffness_limits=LIMITS).stiffness_limits == tuple(map(tuple, LIMITS))
    for scale in (1.0, 1e-3):  # N/m, N/mm: lengths in another unit
        unit = np.repeat([scale, 1.0], 3)
        within = stiffness * np.outer(unit, unit) ** 0.5
        limits = [(limit * unit).tolist() for limit in (low, high)]
        replace(pose, stiffness=within, stiffness_limits=limits)
        beyond = within + 1e-6 * np.diag(limits[1])
        with pytest.raises(ValueError, match=r"share of stiffness beyond stiffness_limits.*must be none"):
            replace(pose, stiffness=beyond, stiffness_limits=limits)
    with pytest.raises(ValueError, match=r"stiffness_limits\[1\]\[2\] is 10"):
        replace(pose, stiffness_limits=(LIMITS[0], [1000.0, 1000.0, 10.0, 30.0, 30.0, 30.0]))


def test_rows_between_turn_with_their_velocity(pose):
    h, times = 1e-6, np.linspace(0.35, 2.25, 30)
    grid = np.stack([times - h, times, times + h], axis=1)
    fine = pose.resample(times=grid.ravel())
    before, after = fine.orientation[::3], fine.orientation[2::3]
    turning = rotations.log(rotations.multiply(after, rotations.conjugate(before))) / (2.0 * h)
    np.testing.assert_allclose(turning, fine.velocity[1::3, 3:], atol=1e-7)
    np.testing.assert_allclose(
        (fine.position[2::3] - fine.position[::3]) / (2.0 * h), fine.velocity[1::3, :3], atol=1e-7
    )
    own = pose.resample(times=pose.time)
    np.testing.assert_allclose(own.orientation, pose.orientation, atol=1e-14)
    np.testing.assert_allclose(own.velocity, pose.velocity, atol=1e-13)
    np.testing.assert_array_equal(own.mass, pose.mass)


def test_a_steady_turn_is_kept_exactly(pose):
    axis = np.array([0.6, 0.0, 0.8])
    turn = rotations.exp(np.outer(pose.time, 1.3 * axis))
    velocity = np.concatenate([pose.velocity[:, :3], np.tile(1.3 * axis, (9, 1))], axis=1)
    fine = replace(pose, orientation=turn, velocity=velocity).resample(100.0)
    np.testing.assert_allclose(fine.orientation, rotations.exp(np.outer(fine.time, 1.3 * axis)), atol=1e-14)
    np.testing.assert_allclose(fine.velocity[:, 3:], 1.3 * axis * np.ones((len(fine), 1)), atol=1e-13)


@pytest.mark.parametrize("ratio", [0.3, 1.0])
def test_with_inertia_gives_every_mode_its_ratio(pose, ratio):
    damped = pose.with_inertia(lambda time: pose.mass, damping_ratio=ratio)
    assert damped == pose.with_inertia(pose.mass, ratio)
    for stiffness, damping, mass in zip(damped.stiffness, damped.damping, damped.mass, strict=True):
        squared, modes = eigh(stiffness, mass)  # modes' M modes = 1, modes' K modes = w^2
        expected = np.diag(2.0 * ratio * np.sqrt(squared))
        np.testing.assert_allclose(modes.T @ damping @ modes, expected, atol=1e-9 * expected.max())
    by_root = damping_from_stiffness(torch.tensor(pose.stiffness), torch.tensor(pose.mass), ratio)
    np.testing.assert_allclose(damped.damping, by_root.numpy(), atol=1e-12 * damped.damping.max())


def test_with_inertia_takes_a_number_a_matrix_and_a_function(pose):
    by_number, by_matrix = pose.with_inertia(2.0), pose.with_inertia(2.0 * np.eye(6))
    np.testing.assert_allclose(by_number.damping, by_matrix.damping, atol=1e-12 * by_number.damping.max())
    assert (by_number.mass, by_matrix.mass.shape) == (2.0, (9, 6, 6))
    heavier = pose.with_inertia(lambda time: (1.0 + time)[:, None, None] * np.eye(6))
    np.testing.assert_array_equal(heavier.mass[:, 0, 0], 1.0 + pose.time)
    for mass, message in [
        (-1.0, "mass is -1"),
        (np.zeros((6, 6)), "smallest eigenvalue of mass"),
        (np.eye(3), "shape"),
    ]:
        with pytest.raises(ValueError, match=message):
            pose.with_inertia(mass)


def test_transform_moves_the_world_and_not_the_energy(pose, rng):
    world, shift = Rotation.from_rotvec([0.3, -0.7, 1.1]), np.array([1.0, 2.0, 3.0])
    moved = pose.transform(world.as_matrix(), shift, frame="table")
    turn = np.kron(np.eye(2), world.as_matrix())
    deviation = rng.normal(size=6)
    np.testing.assert_allclose(moved.position, world.apply(np.array(pose.position)) + shift, atol=1e-14)
    np.testing.assert_allclose(
        rotations.matrix(moved.orientation), world.as_matrix() @ rotations.matrix(pose.orientation), atol=1e-14
    )
    for name in ("stiffness", "damping", "covariance", "mass"):
        energy = np.einsum("i,nij,j->n", turn @ deviation, getattr(moved, name), turn @ deviation)
        np.testing.assert_allclose(energy, np.einsum("i,nij,j->n", deviation, getattr(pose, name), deviation))
    np.testing.assert_allclose(moved.acceleration, pose.acceleration @ turn.T, atol=1e-14)
    back = moved.transform(world.inv().as_quat(scalar_first=True), -world.inv().apply(shift), frame=None)
    np.testing.assert_allclose(back.stiffness, pose.stiffness, atol=1e-10)
    np.testing.assert_allclose(back.velocity, pose.velocity, atol=1e-14)
    with pytest.raises(ValueError, match="must be a rotation matrix"):
        pose.transform(np.diag([1.0, 1.0, -1.0]))
    with pytest.raises(ValueError, match="joint angles have no frame"):
        replace(pose, units="rad").transform(np.eye(3))


def test_retime_scales_the_acceleration_twice(pose):
    fast = pose.retime(2.0)
    np.testing.assert_allclose(fast.acceleration, 4.0 * pose.acceleration)
    np.testing.assert_array_equal(fast.mass, pose.mass)


def test_the_diagonal_loses_as_much_in_every_unit(pose):
    diagonal, loss = pose.diagonal()
    unit = np.repeat([1e-3, 1.0], 3)  # lengths in mm
    in_mm = replace(pose, stiffness=pose.stiffness * np.outer(unit, unit), damping=pose.damping * np.outer(unit, unit))
    assert astuple(in_mm.diagonal()[1]) == pytest.approx(astuple(loss), rel=1e-9)
    np.testing.assert_array_equal(diagonal.mass, pose.mass)


def test_the_diagonal_loses_a_coupled_rotation_whatever_the_positions_are(pose):
    stiffness = np.zeros((len(pose), 6, 6))
    stiffness[:, :3, :3] = 500.0 * np.eye(3)
    stiffness[:, 3:, 3:] = 50.0 * np.eye(3) + 20.0
    loss = replace(pose, stiffness=stiffness, stiffness_limits=None).diagonal()[1]
    # I - K / 70 is -20 / 70 off the diagonal, whose norm is that of (1, 1, 1), twice as large.
    assert loss.displacement == pytest.approx(40.0 / 70.0, rel=1e-12)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_files_hold_poses_to_the_last_bit(tmp_path, pose, suffix):
    path = tmp_path / f"pose{suffix}"
    for schedule in (pose, replace(pose, mass=1.5, stiffness_limits=None), replace(pose, acceleration=None)):
        schedule.save(path)
        assert Schedule.load(path) == schedule
    limited = replace(pose, stiffness=np.tile(np.diag(LIMITS[1]), (9, 1, 1)), stiffness_limits=LIMITS, names=None)
    limited.save(path)
    assert Schedule.load(path) == limited


def test_csv_names_the_columns_of_a_pose(tmp_path, pose):
    pose.save(tmp_path / "pose.csv")
    titles = next(line for line in (tmp_path / "pose.csv").read_text().splitlines() if not line.startswith("#"))
    for title in ("position[z]", "velocity[rz]", "acceleration[rx]", "orientation[w]", "mass[x][rz]"):
        assert title in titles.split(",")
    assert "position[rx]" not in titles


# Written by version 0.1.0 of the format's first version.
FORMAT_1 = """\
# format: "torch_pbd.schedule"
# version: 1
# names: ["x", "y"]
# units: "m"
# frame: "base"
# stiffness_limits: [50.0, 1000.0]
# covariance_of: "position"
# mass: 1.5
# provenance: {"seed": 1}
# sha256: "e4fbf91afbf213c7783cf79f3249b66e3b47a77a641234d493ea340072cec9db"
time,position[x],position[y],velocity[x],velocity[y],stiffness[x][x],stiffness[x][y],stiffness[y][y],\
damping[x][x],damping[x][y],damping[y][y],covariance[x][x],covariance[x][y],covariance[y][y],type1
0.0,0.0,0.0,0.0,0.0,100.0,0.0,900.0,20.0,0.0,60.0,0.0001,0.0,0.0001,0.0
0.5,0.1,0.2,0.2,0.1,200.0,0.0,300.0,28.284271247461902,0.0,34.64101615137755,0.0001,0.0,0.0001,0.25
1.0,0.2,0.1,0.0,0.0,150.0,0.0,250.0,24.49489742783178,0.0,31.622776601683793,0.0001,0.0,0.0001,1.0
"""


def test_files_of_the_first_format_load_with_their_checksum(tmp_path):
    (tmp_path / "one.csv").write_text(FORMAT_1)
    schedule = Schedule.load(tmp_path / "one.csv")
    assert (schedule.mass, schedule.acceleration, schedule.orientation) == (1.5, None, None)
    assert schedule.stiffness[1, 1, 1] == 300.0
    (tmp_path / "torn.csv").write_text(FORMAT_1.replace("300.0", "301.0"))
    with pytest.raises(ValueError, match="does not match its checksum"):
        Schedule.load(tmp_path / "torn.csv")

"""Figures of poses: what is drawn is where the tool is, and how far it spreads."""

import matplotlib.pyplot as plt
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from torch_pbd.control import Schedule
from torch_pbd.data import make_pose_demonstrations, pose_covariance, pose_mean
from torch_pbd.plotting import plot_covariance_ellipsoids, plot_frames


@pytest.fixture
def space():
    figure = plt.figure()
    yield figure.add_subplot(projection="3d")
    plt.close("all")


@pytest.fixture(scope="module")
def planned():
    """A schedule of the law of the made task, whose stiffness falls as deviations rise."""
    phase = np.linspace(0.0, 1.0, 41)
    covariance = pose_covariance(phase)
    stiffness = np.zeros_like(covariance)
    for block, most in ((slice(3), 1000.0), (slice(3, 6), 60.0)):
        stiffness[:, block, block] = most * np.eye(3) - 100.0 * covariance[:, block, block]
    position, orientation = pose_mean(phase)
    rows = (4.0 * phase, position, np.zeros((41, 6)), stiffness, np.tile(np.eye(6), (41, 1, 1)), covariance)
    limits = (np.repeat([10.0, 1.0], 3), np.repeat([1000.0, 60.0], 3))
    names = ("x", "y", "z", "rx", "ry", "rz")
    return Schedule(*rows, np.zeros(41), orientation=orientation, names=names, stiffness_limits=limits)


def test_every_point_of_an_ellipsoid_is_n_std_from_its_centre(space, rng):
    roots = rng.normal(size=(4, 3, 3))
    covariance, centres = roots @ roots.transpose(0, 2, 1), rng.normal(size=(4, 3))
    drawn = plot_covariance_ellipsoids(centres, covariance, space)
    curves = np.array(drawn._segments3d).reshape(4, -1, 3)
    for points, centre, matrix in zip(curves, centres, covariance, strict=True):
        away = points - centre
        distance = np.sqrt(np.einsum("ni,ij,nj->n", away, np.linalg.inv(matrix), away))
        np.testing.assert_allclose(distance, 2.0, rtol=1e-7)  # the inverse loses digits


def test_frames_are_the_columns_of_the_rotation_and_their_tips_spread_as_it_does(space):
    turn = Rotation.from_rotvec([0.4, -0.7, 1.1])
    places, quaternion = np.array([[1.0, 2.0, 3.0]]), turn.as_quat(scalar_first=True)[np.newaxis]
    spread = 1e-6 * np.diag([1.0, 4.0, 9.0])  # so small that tips move along planes
    lines = plot_frames(places, quaternion, space, length=0.5, covariance=spread[np.newaxis])
    for axis, drawn in enumerate(lines):
        start, tip = np.array(drawn._segments3d)[0]
        np.testing.assert_array_equal(start, places[0])
        np.testing.assert_allclose(tip - start, 0.5 * turn.as_matrix()[:, axis], atol=1e-15)
        ellipse = np.array(space.collections[2 * axis + 1]._segments3d)[0]
        np.testing.assert_allclose(np.linalg.norm(ellipse - places, axis=1), 0.5, rtol=1e-12)
        # The farthest a tip goes under rotation vectors e of two standard deviations: the largest of |e x a|.
        moves = np.cross(np.eye(3), turn.as_matrix()[:, axis])
        most = 2.0 * np.sqrt(np.linalg.eigvalsh(moves.T @ spread @ moves)[-1])
        # The circle has 49 points, none of which is further than half of their distance from the widest.
        assert np.linalg.norm(ellipse - tip, axis=1).max() == pytest.approx(0.5 * most, rel=3e-3)


def test_recorded_poses_are_drawn_in_space_and_their_rotations_in_degrees(space):
    poses = make_pose_demonstrations(3, duration=1.0, rate=20.0, random_state=0)
    path, *turns = poses.plot()
    assert [path.get_xlabel(), path.get_zlabel()] == ["x [m]", "z [m]"]
    assert [ax.get_ylabel() for ax in turns] == ["rx [deg]", "ry [deg]", "rz [deg]"]
    assert turns[-1].get_xlabel() == "time [s]"
    np.testing.assert_allclose(np.stack(path.lines[0].get_data_3d(), axis=1), poses.positions[0][:, :3])
    np.testing.assert_allclose(turns[1].lines[2].get_ydata(), np.degrees(poses.positions[2][:, 4]))
    assert len(poses.plot(["x", "rz"]).lines) == 3 * 3  # named outputs are ordinary ones, with both ends marked


def test_a_schedule_of_poses_is_drawn_block_by_block(planned, space):
    path, moved, turned, force, torque = planned.plot()
    assert [ax.get_ylabel() for ax in (moved, turned)] == ["1 sd [mm]", "1 sd [deg]"]
    assert [ax.get_ylabel() for ax in (force, torque)] == ["stiffness [N/m]", "stiffness [Nm/rad]"]
    np.testing.assert_allclose(np.stack(path.lines[0].get_data_3d(), axis=1), planned.position)
    for spread, gains, block, scale in ((moved, force, slice(3), 1e3), (turned, torque, slice(3, 6), 180.0 / np.pi)):
        variances = np.linalg.eigvalsh(planned.covariance[:, block, block])
        stiffness = np.linalg.eigvalsh(planned.stiffness[:, block, block])
        for axis in range(3):  # the most precise axis is the stiffest
            np.testing.assert_allclose(spread.lines[axis].get_ydata() ** 2, scale**2 * variances[:, axis], rtol=1e-9)
            np.testing.assert_allclose(gains.lines[axis].get_ydata(), stiffness[:, 2 - axis], rtol=1e-9)
    assert [line.get_ydata()[0] for line in torque.lines[3:]] == [1.0, 60.0]
    assert [line.get_ydata()[0] for line in force.lines[3:]] == [10.0, 1000.0]


@pytest.mark.parametrize("n_positions", [1, 2, 4])
def test_poses_that_are_not_in_space_are_drawn_over_time(planned, space, n_positions):
    """A tool in a plane; a gripper as a fourth position."""
    some = [*[0, 1, 2, 2][:n_positions], 3, 4, 5]
    gains = [matrices[:, some][:, :, some] for matrices in (planned.stiffness, planned.damping, planned.covariance)]
    for gain in gains:  # positions and rotations are coupled by three positions only
        gain[:, -3:, :-3] = gain[:, :-3, -3:] = 0.0
        gain[:, 3:-3, :3] = gain[:, :3, 3:-3] = 0.0
    rows = planned.time, planned.position[:, some[:-3]], planned.velocity[:, some], *gains, planned.type1
    axes = Schedule(*rows, orientation=planned.orientation).plot()
    dashes = {(line.get_label(), line.get_linestyle()) for ax in axes[-4:] for line in ax.lines}
    assert len(dashes) == max(n_positions, 3)
    assert [ax.get_ylabel() for ax in axes[-4:]] == ["1 sd [mm]", "1 sd [deg]", "stiffness [N/m]", "stiffness [Nm/rad]"]
    for ax, values in zip(axes[-2:], (gains[0][:, :-3, :-3], gains[0][:, -3:, -3:]), strict=True):
        drawn = np.stack([line.get_ydata() for line in ax.lines], axis=1)
        np.testing.assert_allclose(drawn, np.linalg.eigvalsh(values)[:, ::-1])

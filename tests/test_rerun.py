"""Files for Rerun, read back by its own library."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from torch_pbd import DMPController, GMMBaseline
from torch_pbd.data import make_pose_demonstrations, make_tunnel_demonstrations
from torch_pbd.plotting import MovementDisplay, to_rerun

chunks = pytest.importorskip("rerun.chunk")


def read_back(path):
    """Columns by entity and component: lists of rows."""
    found = {}
    for chunk in chunks.RrdReader(path).stream():
        batch = chunk.to_record_batch()
        for name, column in zip(batch.schema.names, batch.columns, strict=True):
            if name != "rerun.controls.RowId":
                found.setdefault(chunk.entity_path, {})[name] = column.to_pylist()
    return found


def test_curves_paths_and_ellipsoids_of_a_plane(tmp_path):
    tunnel = make_tunnel_demonstrations(n_demos=3, rate=20.0, random_state=0)
    display = MovementDisplay.from_estimator(GMMBaseline(n_components=2).fit(*tunnel.stack()), tunnel)
    controller = DMPController(GMMBaseline(n_components=2)).fit(tunnel)
    schedule, rollout = controller.schedule(20.0), controller.simulate(rate=20.0)
    path = tmp_path / "tunnel.rrd"
    to_rerun(path, demonstrations=tunnel, display=display, schedule=schedule, rollout=rollout)
    found = read_back(path)
    curve = found["/outputs/x/demonstration\\ 1"]
    np.testing.assert_array_equal(np.ravel(curve["Scalars:scalars"]), tunnel.positions[1][:, 0])
    seconds = [duration.total_seconds() for duration in curve["time"]]
    np.testing.assert_allclose(seconds, tunnel.times[1], atol=1e-6)
    strip = np.array(found["/space/schedule"]["LineStrips3D:strips"][0][0])
    np.testing.assert_allclose(strip, np.pad(schedule.position, ((0, 0), (0, 1))), atol=1e-6)  # of float32
    shown = {name: np.array(rows[0]) for name, rows in found["/space/GMMBaseline/covariance"].items() if ":" in name}
    # Ellipsoids R diag(h^2) R' are four times the covariances, at 21 places along the mean.
    turned = Rotation.from_quat(shown["Ellipsoids3D:quaternions"]).as_matrix()
    shapes = turned * shown["Ellipsoids3D:half_sizes"][:, None] ** 2 @ turned.swapaxes(1, 2)
    mean, covariance = display.laws["GMMBaseline"]
    np.testing.assert_allclose(shapes[:, :2, :2], 4.0 * covariance[::10], rtol=1e-3, atol=1e-7)
    np.testing.assert_allclose(shown["Ellipsoids3D:centers"][:, :2], mean[::10], atol=1e-6)
    stiffest = np.ravel(found["/stiffness/positions/axis\\ 1"]["Scalars:scalars"])
    np.testing.assert_allclose(stiffest, np.linalg.eigvalsh(schedule.stiffness)[:, -1])
    assert {"/force/x", "/outputs/y/run", "/outputs/y/GMMBaseline\\ \\+2\\ sd"} <= set(found)


def test_tools_are_frames_that_move(tmp_path):
    poses = make_pose_demonstrations(n_demos=8, rate=20.0, random_state=0)
    schedule = DMPController(GMMBaseline(n_components=1)).fit(poses).schedule(20.0)
    to_rerun(tmp_path / "poses.rrd", schedule=schedule)
    tool = read_back(tmp_path / "poses.rrd")["/space/schedule/tool"]
    turned = Rotation.from_quat(np.squeeze(tool["Transform3D:quaternion"], axis=1))  # x y z w
    expected = Rotation.from_quat(np.array(schedule.orientation), scalar_first=True)
    assert (turned * expected.inv()).magnitude().max() < 1e-6


def test_recordings_in_other_units_have_their_own_space_and_time_in_seconds(tmp_path):
    tunnel = make_tunnel_demonstrations(n_demos=2, rate=20.0, random_state=0).in_units("mm", "ms")
    to_rerun(tmp_path / "mm.rrd", demonstrations=tunnel)
    found = read_back(tmp_path / "mm.rrd")
    assert "/space\\ in\\ mm/demonstrations/0" in found or "/space in mm/demonstrations/0" in found
    last = found["/outputs/x/demonstration\\ 0"]["time"][-1].total_seconds()
    assert last == pytest.approx(tunnel.times[0][-1] / 1e3, abs=1e-6)


def test_refuses_nothing_and_other_files(tmp_path):
    with pytest.raises(ValueError, match="there is nothing to write"):
        to_rerun(tmp_path / "empty.rrd")
    with pytest.raises(ValueError, match=r"path is .*must be a file that ends with \.rrd"):
        to_rerun(tmp_path / "tunnel.mp4", demonstrations=make_tunnel_demonstrations(n_demos=1))

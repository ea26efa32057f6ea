"""Poses in space: frames of a tool, the spread of its position and axes, and the robot arm."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LightSource
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection
from numpy.typing import ArrayLike

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.plotting import style
from torch_pbd.plotting.parts import draw_blocks, plot_demonstrations
from torch_pbd.rotations import matrix

_TURN = np.linspace(0.0, 2.0 * np.pi, 21)
_ARC = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 12)  # an even number skips the equator, which has two rings
_SQUARE = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
_LENGTH = 0.1  # length of a frame's axes as a share of the longest side of the path


def plot_frames(
    position: ArrayLike,
    orientation: ArrayLike,
    ax: Axes,
    *,
    length: float,
    covariance: ArrayLike | None = None,
    label: str | None = "tool",
) -> list[Line3DCollection]:
    """Draw the axes of a tool in space, with the two standard deviation regions of their tips.

    Parameters
    ----------
    position : array_like of shape (n, 3)
    orientation : array_like of shape (n, 4)
        Unit quaternions w x y z.
    ax : matplotlib.axes.Axes
        Axes with projection "3d".
    length : float
        Length of the tool axes in the unit of the position.
    covariance : array_like of shape (n, 3, 3), default=None
        Covariance of rotation vectors in world axes, in rad^2.
    label : str or None, default="tool"
        Label in the legend, before x, y and z.

    Returns
    -------
    list of three Line3DCollection, for the axes x, y and z
    """
    style.check_axes("ax", [ax])
    places = checks.array(position, "position", ("n", 3))
    turns = matrix(checks.array(orientation, "orientation", (len(places), 4)))
    drawn = []
    for axis, color in enumerate(style.SERIES[:3]):
        tips = turns[:, :, axis]
        lines = np.stack([places, places + length * tips], axis=1)
        name = None if label is None else f"{label}: {'xyz'[axis]}"
        drawn.append(_lines(ax, lines, color, 1.4, name))
        if covariance is not None:
            spread = checks.array(covariance, "covariance", (len(places), 3, 3))
            # A small rotation e moves the tip a by e x a, and the tip stays on its sphere.
            arm = -np.cross(np.eye(3), tips[:, np.newaxis, :]).swapaxes(1, 2)
            moved = tips[:, np.newaxis, :] + 2.0 * style.unit_ellipses(arm @ spread @ arm.swapaxes(1, 2))[:, 0]
            on_sphere = moved / np.linalg.norm(moved, axis=-1, keepdims=True)
            _lines(ax, places[:, np.newaxis, :] + length * on_sphere, color, 0.8, None)
    return drawn


def plot_covariance_ellipsoids(
    mean: ArrayLike, covariance: ArrayLike, ax: Axes, *, label: str | None = None
) -> Line3DCollection:
    """Draw two standard deviations of covariances (n, 3, 3) around means (n, 3) as ellipses in the three main planes.

    ``ax`` must have projection "3d".
    """
    return _lines(ax, np.concatenate(style.ellipses(mean, covariance, ax, 2.0, 3)), style.MODEL, 0.7, label)


def draw_poses(
    what: Any, draw: Callable[[Any, Axes, list[Axes]], None], n_bands: int, make: Any = style.shown_figure
) -> list[Axes]:
    """Axes of a new figure of demonstrations or of a schedule, the 3D axes first."""
    figure, space, bands = style.panels(n_bands, 3, make)
    draw(what, space[0], bands)
    style.legend_below(figure, [*space, *bands])
    return [*space, *bands]


def draw_recorded_poses(demonstrations: Any, ax: Axes, bands: Sequence[Axes]) -> None:
    """Draw demonstrated poses: paths in space with frames at a few phases, and rotations over time."""
    places, turns = demonstrations.to_poses()
    length = _LENGTH * float(np.ptp(np.concatenate(places), axis=0).max())
    plot_demonstrations(demonstrations, [0, 1, 2], ax)
    for k, (path, turn) in enumerate(zip(places, turns, strict=True)):
        some = np.linspace(0, len(path) - 1, 4).round().astype(int)
        plot_frames(path[some], turn[some], ax, length=length, label=None if k else "tool")
        style.mark_ends(ax, path, label=k == 0)
    for i, (band, name) in enumerate(zip(bands, demonstrations.names[-3:], strict=True)):
        for time, position in demonstrations:
            band.plot(time, style.ROTATION.scale * position[:, i - 3], color=style.DATA, lw=1.0, alpha=0.8)
        band.set_ylabel(f"{name} [deg]")
        band.margins(x=0.0)
    bands[-1].set_xlabel(style.time_label(demonstrations.time_unit))
    _label(ax, bands, demonstrations.names[:3], None if demonstrations.units is None else demonstrations.units[0])


def draw_pose_schedule(schedule: Any, ax: Axes, bands: Sequence[Axes]) -> None:
    """Draw a schedule of poses: its path with ellipsoids and frames; over time, deviations and stiffness."""
    length = _LENGTH * float(np.ptp(schedule.position, axis=0).max())
    # Frames are at equal distances, not times, since a tool is slow at its ends.
    way = np.append(0.0, np.linalg.norm(np.diff(schedule.position, axis=0), axis=1)).cumsum()
    some = np.searchsorted(way, np.linspace(0.0, way[-1], 7)).clip(max=len(schedule) - 1)
    path, spread = schedule.position[some], schedule.covariance[some]
    ax.plot(*schedule.position.T, color=style.MODEL, lw=1.8, label="planned path", zorder=3)
    plot_covariance_ellipsoids(path, spread[:, :3, :3], ax, label="position: 2 sd")
    plot_frames(path, schedule.orientation[some], ax, length=length, covariance=spread[:, 3:, 3:], label="tool, 2 sd")
    style.mark_ends(ax, schedule.position)
    _label(ax, bands, (schedule.names or style.POSE_NAMES)[:3], schedule.units)
    draw_blocks(schedule, bands)
    bands[2].set_xlabel("")


def _label(ax: Any, bands: Sequence[Axes], names: Sequence[str], unit: str | None) -> None:
    """Label 3D axes with one scale, and let the bands beside them share the time axis."""
    ax.set(**{f"{axis}label": f"{name} [{unit or 'unit'}]" for axis, name in zip("xyz", names, strict=True)})
    style.equal_scales(ax)
    ax.view_init(elev=22.0, azim=-35.0)
    for band in bands[:-1]:
        band.sharex(bands[-1])
        band.tick_params(labelbottom=False)


def _lines(ax: Any, curves: Floats, color: str, width: float, label: str | None) -> Line3DCollection:
    collection = Line3DCollection(list(curves), colors=color, linewidths=width, label=label, zorder=4)
    ax.add_collection3d(collection, autolim=True)
    return collection


def plot_arm(model: Any, joints: ArrayLike, ax: Axes) -> Poly3DCollection:
    """Draw the capsules, cylinders and boxes of a model at joint angles; meshes are left out.

    Parameters
    ----------
    model : mujoco.MjModel
        Model of the arm, such as `torch_pbd.robots.panda`, which has no meshes.
    joints : array_like of shape (n,)
        Joint angles ``qpos`` in rad.
    ax : matplotlib.axes.Axes
        Axes with projection "3d", in m.

    Returns
    -------
    Poly3DCollection
    """
    import mujoco

    style.check_axes("ax", [ax])
    data = mujoco.MjData(model)
    data.qpos[:] = checks.array(joints, "joints", (model.nq,))
    mujoco.mj_kinematics(model, data)
    kinds, faces, colors = mujoco.mjtGeom, [], []
    for geom in range(model.ngeom):
        kind, size = int(model.geom_type[geom]), model.geom_size[geom]
        if kind == kinds.mjGEOM_BOX:
            shape = size * np.array([np.insert(_SQUARE[::s], i, s, axis=1) for i in range(3) for s in (-1, 1)])
        elif kind == kinds.mjGEOM_CAPSULE:
            shape = _turned(size[0] * np.cos(_ARC), size[0] * np.sin(_ARC) + size[1] * np.sign(_ARC))
        elif kind == kinds.mjGEOM_CYLINDER:
            shape = _turned(size[0] * np.array([0, 1, 1, 0]), size[1] * np.array([-1, -1, 1, 1]))
        else:
            continue
        faces.append(shape @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom])
        colors.append(np.tile(model.geom_rgba[geom], (len(shape), 1)))
    light = LightSource(azdeg=250.0, altdeg=50.0)
    look: dict[str, Any] = {"facecolors": np.concatenate(colors), "shade": True, "lightsource": light}
    drawn = Poly3DCollection(np.concatenate(faces), zorder=2, **look)
    ax.add_collection3d(drawn, autolim=True)  # type: ignore[attr-defined]
    return drawn


def _turned(width: Floats, height: Floats) -> Floats:
    """Quadrilaterals (n, 4, 3) of the surface of revolution of a profile around z."""
    width = np.maximum(width, 1e-3 * width.max())[:, np.newaxis]  # to have a normal, a face must have four corners
    rings = np.stack(np.broadcast_arrays(width * np.cos(_TURN), width * np.sin(_TURN), height[:, np.newaxis]), axis=-1)
    corners = rings[:-1, :-1], rings[:-1, 1:], rings[1:, 1:], rings[1:, :-1]
    return np.stack(corners, axis=-2).reshape(-1, 4, 3)

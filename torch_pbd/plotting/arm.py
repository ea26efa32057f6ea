"""An arm in space, drawn from the shapes of its MuJoCo model: no graphics card is needed."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LightSource
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from numpy.typing import ArrayLike

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.plotting.style import check_axes

_TURN = np.linspace(0.0, 2.0 * np.pi, 21)
_ARC = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 12)  # none on the equator: it has two rings
_LIGHT = LightSource(azdeg=250.0, altdeg=50.0)


def plot_arm(model: Any, joints: ArrayLike, ax: Axes, *, alpha: float = 1.0) -> Poly3DCollection:
    """Draw the capsules, cylinders and boxes of a model at joint angles; meshes are left out.

    Parameters
    ----------
    model : mujoco.MjModel
        Such as `torch_pbd.robots.panda`, which has no meshes.
    joints : array_like of shape (n,)
        Its ``qpos``, in rad.
    ax : matplotlib.axes.Axes
        Of projection "3d", in m.
    alpha : float, default=1.0
        Opacity.

    Returns
    -------
    Poly3DCollection
    """
    import mujoco

    check_axes("ax", [ax])
    data = mujoco.MjData(model)
    data.qpos[:] = checks.array(joints, "joints", (model.nq,))
    mujoco.mj_kinematics(model, data)
    kinds = mujoco.mjtGeom
    shapes = {int(kinds.mjGEOM_BOX): _box, int(kinds.mjGEOM_CAPSULE): _capsule, int(kinds.mjGEOM_CYLINDER): _cylinder}
    faces, colors = [], []
    for geom in [geom for geom in range(model.ngeom) if int(model.geom_type[geom]) in shapes]:
        shape = shapes[int(model.geom_type[geom])](model.geom_size[geom])
        faces.append(shape @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom])
        colors.append(np.tile(model.geom_rgba[geom], (len(shape), 1)))
    drawn = Poly3DCollection(
        np.concatenate(faces), facecolors=np.concatenate(colors), shade=True, lightsource=_LIGHT, alpha=alpha, zorder=2
    )
    ax.add_collection3d(drawn, autolim=True)  # type: ignore[attr-defined]
    return drawn


def _capsule(size: Floats) -> Floats:
    return _turned(size[0] * np.cos(_ARC), size[0] * np.sin(_ARC) + size[1] * np.sign(_ARC))


def _cylinder(size: Floats) -> Floats:
    return _turned(size[0] * np.array([0.0, 1.0, 1.0, 0.0]), size[1] * np.array([-1.0, -1.0, 1.0, 1.0]))


def _turned(width: Floats, height: Floats) -> Floats:
    """Quadrilaterals (n, 4, 3) of a profile that is turned around z."""
    width = np.maximum(width, 1e-3 * width.max())[:, np.newaxis]  # to have a normal, a face must have four corners
    rings = np.stack(np.broadcast_arrays(width * np.cos(_TURN), width * np.sin(_TURN), height[:, np.newaxis]), axis=-1)
    corners = rings[:-1, :-1], rings[:-1, 1:], rings[1:, 1:], rings[1:, :-1]
    return np.stack(corners, axis=-2).reshape(-1, 4, 3)


def _box(size: Floats) -> Floats:
    square = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    sides = [np.insert(square[::step], axis, step, axis=1) for axis in range(3) for step in (-1, 1)]
    return size * np.array(sides)

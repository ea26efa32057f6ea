"""Shapes as they are drawn: corners lie on the surfaces that the model has."""

import matplotlib.pyplot as plt
import numpy as np
import pytest

from torch_pbd.plotting import plot_arm
from torch_pbd.robots import HOME, panda

mujoco = pytest.importorskip("mujoco")


@pytest.fixture
def space():
    yield plt.figure().add_subplot(projection="3d")
    plt.close("all")


def corners(geom, joint, space):
    """Corners (n, 3) of one shape on a body that is turned by an angle about y, 0.5 m above the base."""
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody><body pos="0 0 0.5"><joint axis="0 1 0"/><geom {geom}/></body></worldbody></mujoco>'
    )
    drawn = plot_arm(model, [joint], space)
    turn = np.array([[np.cos(joint), 0.0, np.sin(joint)], [0.0, 1.0, 0.0], [-np.sin(joint), 0.0, np.cos(joint)]])
    return (np.reshape(drawn._faces, (-1, 3)) - [0.0, 0.0, 0.5]) @ turn  # in the body


@pytest.mark.parametrize("joint", [0.0, 0.7])
def test_corners_lie_on_the_surfaces(joint, space):
    capsule = corners('type="capsule" fromto="0.1 0 0 0.4 0 0" size="0.05"', joint, space)
    nearest = np.clip(capsule[:, 0], 0.1, 0.4)[:, None] * [1.0, 0.0, 0.0]
    np.testing.assert_allclose(np.linalg.norm(capsule - nearest, axis=1), 0.05, rtol=1e-5)
    np.testing.assert_allclose([capsule[:, 0].min(), capsule[:, 0].max()], [0.05, 0.45], rtol=1e-6)
    cylinder = corners('type="cylinder" size="0.1 0.2"', joint, space)
    np.testing.assert_allclose(np.abs(cylinder[:, 2]), 0.2, rtol=1e-12)
    assert np.linalg.norm(cylinder[:, :2], axis=1).max() == pytest.approx(0.1)
    box = corners('type="box" size="0.1 0.2 0.3"', joint, space)
    assert len(box) == 24
    np.testing.assert_allclose(np.abs(box), np.tile([0.1, 0.2, 0.3], (24, 1)), rtol=1e-12)


def test_the_panda_is_drawn_whole(space):
    drawn = plot_arm(panda(), HOME, space)
    low, high = np.reshape(drawn._faces, (-1, 3)).min(axis=0), np.reshape(drawn._faces, (-1, 3)).max(axis=0)
    assert low[2] == pytest.approx(0.0, abs=1e-12)
    assert 0.7 < high[2] < 0.8
    assert 0.3 < high[0] < 0.4
    assert np.isfinite(drawn.get_facecolor()).all()
    with pytest.raises(ValueError, match=r"joints has shape \(6,\)"):
        plot_arm(panda(), HOME[:6], space)

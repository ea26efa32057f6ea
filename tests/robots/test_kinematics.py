"""Where the tool is, against Denavit-Hartenberg matrices written here; its inertia, against MuJoCo's accelerations."""

import numpy as np
import pytest

from torch_pbd import rotations
from torch_pbd.robots import HOME, inverse_kinematics, kinematics, operational_inertia, panda, panda_mjcf
from torch_pbd.robots.kinematics import arm, pose_error

mujoco = pytest.importorskip("mujoco")

# a, alpha, d of the manufacturer's table, with the flange.
TABLE = [
    (0.0, 0.0, 0.333),
    (0.0, -np.pi / 2, 0.0),
    (0.0, np.pi / 2, 0.316),
    (0.0825, np.pi / 2, 0.0),
    (-0.0825, -np.pi / 2, 0.384),
    (0.0, np.pi / 2, 0.0),
    (0.088, np.pi / 2, 0.0),
    (0.0, 0.0, 0.107),
]


@pytest.fixture(scope="module")
def model():
    return panda()


@pytest.fixture
def angles(model, rng):
    low, high = arm(model, "tool").limits
    return rng.uniform(low, high, size=(20, 7))


def flange(joints):
    pose = np.eye(4)
    for (a, alpha, d), theta in zip(TABLE, [*joints, 0.0], strict=True):
        (c, s), (ca, sa) = (np.cos(theta), np.sin(theta)), (np.cos(alpha), np.sin(alpha))
        pose = pose @ [[c, -s, 0, a], [s * ca, c * ca, -sa, -d * sa], [s * sa, c * sa, ca, d * ca], [0, 0, 0, 1]]
    return pose


def test_the_flange_is_where_denavit_and_hartenberg_have_it(angles):
    chain = arm(panda(), "hand")  # which begins at the flange, turned by an eighth
    c = np.sqrt(0.5)
    eighth = np.array([[c, c, 0.0], [-c, c, 0.0], [0.0, 0.0, 1.0]])
    for joints in angles:
        state, expected = chain.at(joints), flange(joints)
        expected[:3, :3] = expected[:3, :3] @ eighth
        np.testing.assert_allclose(state.position, expected[:3, 3], rtol=0, atol=1e-14)
        np.testing.assert_allclose(rotations.matrix(state.orientation), expected[:3, :3], rtol=0, atol=1e-14)


def test_at_home_the_hand_points_down(model):
    state = arm(model, "tool").at(np.array(HOME))
    np.testing.assert_allclose(rotations.matrix(state.orientation), np.diag([1.0, -1.0, -1.0]), rtol=0, atol=1e-14)


def test_the_jacobian_is_in_world_axes_translation_first(model, angles):
    chain, step = arm(model, "tool"), 1e-6
    for joints in angles[:3]:
        state = chain.at(joints)
        for j, column in enumerate(state.jacobian.T):
            ahead, behind = (chain.at(joints + sign * step * np.eye(7)[j]) for sign in (1.0, -1.0))
            change = pose_error(behind, ahead.position, ahead.orientation) / (2.0 * step)
            np.testing.assert_allclose(column, change, rtol=0, atol=1e-8)


def test_a_wrench_accelerates_the_tool_by_its_inertia(model, angles, rng):
    """Not by our Jacobian: MuJoCo applies the wrench at a body's centre, and the tool's acceleration is differenced."""
    data, step = mujoco.MjData(model), 1e-5
    for joints in angles[:5]:
        wrench = rng.normal(size=6)
        data.qpos[:], data.qvel[:] = joints, 0.0
        mujoco.mj_forward(model, data)
        hand = model.body("hand").id
        lever = data.site("tool").xpos - data.xipos[hand]
        data.xfrc_applied[hand] = np.concatenate([wrench[:3], wrench[3:] + np.cross(lever, wrench[:3])])
        data.qfrc_applied[:] = data.qfrc_bias  # gravity
        mujoco.mj_forward(model, data)
        chain = arm(model, "tool")
        ahead, behind = (chain.at(joints + 0.5 * sign * step * data.qacc) for sign in (1.0, -1.0))
        acceleration = pose_error(behind, ahead.position, ahead.orientation) / step
        expected = np.linalg.solve(operational_inertia(model, joints, "tool"), wrench)
        np.testing.assert_allclose(acceleration, expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max())


def test_inertia_is_symmetric_batched_and_turns_with_the_base(model, angles):
    inertia = operational_inertia(model, angles.reshape(4, 5, 7), "tool")
    assert inertia.shape == (4, 5, 6, 6)
    np.testing.assert_array_equal(inertia, inertia.swapaxes(-1, -2))
    np.testing.assert_array_equal(inertia[1, 2], operational_inertia(model, angles[7], "tool"))
    turned = angles[0] + [0.7, 0, 0, 0, 0, 0, 0]
    turn = np.kron(np.eye(2), rotations.matrix(rotations.exp(np.array([0.0, 0.0, 0.7]))))
    np.testing.assert_allclose(
        operational_inertia(model, turned, "tool"), turn @ inertia[0, 0] @ turn.T, rtol=0, atol=1e-10
    )


def test_mujoco_and_pinocchio_agree(model, angles, tmp_path):
    pin = pytest.importorskip("pinocchio")
    (tmp_path / "panda.xml").write_text(panda_mjcf())
    other = pin.buildModelFromMJCF(str(tmp_path / "panda.xml"))
    mine, theirs = arm(model, "tool"), arm(other, "tool")
    np.testing.assert_array_equal(mine.limits, theirs.limits)
    for joints in angles:
        for ours, own in zip(mine.at(joints), theirs.at(joints), strict=True):
            sign = np.sign(ours @ own) if ours.shape == (4,) else 1.0  # of quaternions
            np.testing.assert_allclose(sign * ours, own, rtol=0, atol=1e-13)
    inertia = operational_inertia(other, angles, "tool")
    np.testing.assert_allclose(inertia, operational_inertia(model, angles, "tool"), rtol=1e-9, atol=1e-12)


def test_joints_beside_the_tool_are_locked(model):
    """A finger on a slide adds its mass, and no freedom."""
    part = '<inertial pos="0 0 0" mass="{}" diaginertia="1e-3 1e-3 1e-3"/>'
    body = '<body name="finger" pos="0 0 0.05">{}' + part.format(0.1) + "</body>"
    text = panda_mjcf().replace('<site name="tool"', "{}" + '<site name="tool"')
    fixed, sliding = (
        mujoco.MjModel.from_xml_string(text.format(body.format(joint)))
        for joint in ("", '<joint type="slide" axis="0 1 0"/>')
    )
    assert (fixed.nv, sliding.nv) == (7, 8)
    inertia = [operational_inertia(each, HOME, "tool") for each in (fixed, sliding)]
    np.testing.assert_allclose(*inertia, rtol=1e-12, atol=1e-14)
    assert inertia[0][0, 0] > operational_inertia(model, HOME, "tool")[0, 0]


def test_inertia_of_a_stretched_arm_is_refused(model):
    stretched = np.zeros(7)  # axes 1, 3, 5 in one line
    with pytest.raises(ValueError, match="keep the arm away from its singularities"):
        operational_inertia(model, stretched, "tool")


@pytest.mark.parametrize(
    ("tool", "joints", "message"),
    [
        ("gripper", HOME, "a site \\(tool\\) or a body"),
        ("tool", HOME[:6], "shape"),
        ("world", HOME, "hinges"),
        ("tool", np.degrees(HOME), r"joints\[0, 1\] is -45.0, must be within the limits of its joint: give rad"),
    ],
)
def test_what_is_no_arm_is_refused(model, tool, joints, message):
    with pytest.raises(ValueError, match=message):
        operational_inertia(model, joints, tool)


def test_a_text_is_no_model():
    with pytest.raises(ValueError, match=r"mujoco\.MjModel or a pinocchio\.Model"):
        operational_inertia("panda.xml", HOME, "tool")


def path(model, n=60):
    start = arm(model, "tool").at(np.array(HOME))
    s = np.linspace(0.0, 1.0, n)
    position = start.position + np.outer(np.sin(2.0 * np.pi * s), [0.1, 0.15, 0.0]) + np.outer(s, [0.1, 0.0, -0.1])
    return position, rotations.multiply(rotations.exp(np.outer(s, [0.0, 0.3, 1.2])), start.orientation)


def test_inverse_kinematics_meets_the_path_whichever_way_it_is_gone(model):
    position, orientation = path(model)
    there = inverse_kinematics(model, position, orientation, "tool", start=HOME)
    chain = arm(model, "tool")
    for joints, place, turn in zip(there, position, orientation, strict=True):
        assert np.abs(pose_error(chain.at(joints), place, turn)).max() < 1e-9
    back = inverse_kinematics(model, position[::-1], -orientation[::-1], "tool", start=there[-1], posture=HOME)
    np.testing.assert_allclose(back[::-1], there, rtol=0, atol=1e-5)  # what a step of 1e-7 leaves
    # Nearest to the posture: no motion within the arm goes nearer.
    for joints in there[::10]:
        free = np.linalg.svd(chain.at(joints).jacobian)[2][-1]
        assert abs(free @ (HOME - joints)) < 1e-5


def test_a_posture_that_is_not_found_is_not_called_out_of_reach(model, monkeypatch):
    monkeypatch.setattr(kinematics, "_SETTLED", 0.0)  # no step is that short
    position, orientation = path(model, 2)
    with pytest.raises(ValueError, match=r"row 0 of the path, at .* is reached, but .* give another posture"):
        inverse_kinematics(model, position, orientation, "tool", start=HOME)


def test_what_is_out_of_reach_is_told_with_its_row(model):
    position, orientation = path(model)
    far = position + np.outer(np.linspace(0.0, 1.0, len(position)), [0.0, 0.0, 2.0])
    with pytest.raises(ValueError, match=r"row \d+ of the path, at .* out of reach: move it nearer"):
        inverse_kinematics(model, far, orientation, "tool", start=HOME)
    state = arm(model, "tool").at(np.array(HOME))
    down = rotations.multiply(rotations.exp(np.array([[0.0, 0.0, -2.9]])), state.orientation)
    with pytest.raises(ValueError, match="within the limits of its joint"):
        inverse_kinematics(model, state.position[None], down, "tool", start=HOME)


def test_robosuites_panda_has_the_same_joints(angles, model):
    """Read from its own wheel; its inertia is another, as its figures are older: reported, not compared."""
    import importlib.util
    from pathlib import Path

    spec = importlib.util.find_spec("robosuite")
    if spec is None:
        pytest.skip("robosuite is not installed")
    file = Path(spec.origin).parent / "models/assets/robots/panda/robot.xml"
    other = mujoco.MjModel.from_xml_path(str(file))
    mine, theirs = arm(model, "link7"), arm(other, "link7")
    for joints in angles:
        ours, own = mine.at(joints), theirs.at(joints)
        np.testing.assert_allclose(ours.position, own.position, rtol=0, atol=1e-6)
        np.testing.assert_allclose(ours.jacobian, own.jacobian, rtol=0, atol=1e-6)
        turned = rotations.log(rotations.multiply(ours.orientation, rotations.conjugate(own.orientation)))
        assert np.linalg.norm(turned) < 1e-6

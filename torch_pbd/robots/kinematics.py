"""Pose, Jacobian and inertia of the tool of an arm at given joint angles, by MuJoCo or Pinocchio."""

from typing import Any, NamedTuple, final

import numpy as np
from numpy.typing import ArrayLike

from torch_pbd import checks, rotations
from torch_pbd.checks import Floats
from torch_pbd.exceptions import InvalidParameterError
from torch_pbd.registry import optional

# Newton's steps per row converge quadratically, so that the remaining error is rounding.
_MAX_STEPS, _REACHED, _SETTLED = 200, 1e-9, 1e-7
# Longest step in rad, within which an arm is nearly linear; ratio of singular values below which a direction is lost.
_LONGEST_STEP, _SINGULAR = 0.3, 1e-4
_OVERSHOT = 0.1  # allowed excess of joint limits in rad (or m): recorded angles overshoot, degrees exceed it by far


class ToolState(NamedTuple):
    """Tool of an arm at joint angles, in world axes, translation before rotation."""

    position: Floats  # (3,), m
    orientation: Floats  # (4,), w x y z
    jacobian: Floats  # (6, n), from joint velocities to the twist
    mass_matrix: Floats  # (n, n), of the joints


@final
class MujocoArm:
    """Joints from base to tool of a ``mujoco.MjModel``; all others are locked."""

    def __init__(self, model: Any, tool: str) -> None:
        self._library = mujoco = optional("mujoco", "robot", "an arm in MuJoCo")
        self._model, self._data = model, mujoco.MjData(model)
        self._site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, tool)
        named = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, tool)
        self._body = model.site_bodyid[self._site] if self._site >= 0 else named
        if self._body < 0:
            sites = ", ".join(model.site(i).name for i in range(model.nsite))
            bodies = ", ".join(model.body(i).name for i in range(model.nbody))
            raise checks.refusal(tool, "tool", f"a site ({sites}) or a body ({bodies})")
        chain = [self._body]
        while chain[-1] > 0:
            chain.append(model.body_parentid[chain[-1]])
        carrying = np.flatnonzero(np.isin(model.jnt_bodyid, chain))  # parents have lower numbers than their children
        turning = np.isin(model.jnt_type[carrying], [mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE])
        if not carrying.size or not turning.all():
            raise checks.refusal(tool, "tool", "carried by hinges and slides alone", "fix the base of the arm")
        self._angles, self._rates = model.jnt_qposadr[carrying], model.jnt_dofadr[carrying]
        bounds = np.where(model.jnt_limited[carrying][:, np.newaxis], model.jnt_range[carrying], [-np.inf, np.inf])
        self.limits: Floats = bounds.T  # (2, n), lowest and highest angles

    def at(self, joints: Floats) -> ToolState:
        """State of the tool at joint angles (n,)."""
        self._data.qpos[self._angles] = joints
        self._library.mj_fwdPosition(self._model, self._data)
        return self.measure(self._data)

    def bias(self, data: Any) -> Floats:
        """Acceleration (6,) of the tool in a simulation at constant joint speeds."""
        rate = np.empty((6, self._model.nv))
        self._library.mj_jacDot(self._model, data, rate[:3], rate[3:], self._frame(data).xpos, self._body)
        return np.asarray(rate @ data.qvel)

    def measure(self, data: Any) -> ToolState:
        """State of the tool in a simulation whose positions are up to date."""
        mujoco, model, frame = self._library, self._model, self._frame(data)
        jacobian, mass = np.empty((6, model.nv)), np.empty((model.nv, model.nv))
        mujoco.mj_jac(model, data, jacobian[:3], jacobian[3:], frame.xpos, self._body)
        # The order of arguments is that of the version: until 3, inertia lay in data.qM.
        mujoco.mj_fullM(model, *((mass, data.qM) if hasattr(data, "qM") else (data, mass)))
        turn = rotations.from_matrix(frame.xmat.reshape(3, 3))
        return ToolState(frame.xpos.copy(), turn, jacobian[:, self._rates], mass[np.ix_(self._rates, self._rates)])

    def _frame(self, data: Any) -> Any:
        """Site or body of the tool in a simulation, with ``xpos`` and ``xmat``."""
        return data.site(self._site) if self._site >= 0 else data.body(self._body)


@final
class PinocchioArm:
    """Joints from base to tool of a ``pinocchio.Model``; all others are locked."""

    def __init__(self, model: Any, tool: str) -> None:
        self._library = pin = optional("pinocchio", "robot", "an arm in Pinocchio")
        self._model, self._data, self._neutral = model, model.createData(), pin.neutral(model)
        if not model.existFrame(tool):
            frames = ", ".join(frame.name for frame in model.frames)
            raise checks.refusal(tool, "tool", f"a frame of the model, one of {frames}")
        self._frame = model.getFrameId(tool)
        supports = model.supports[model.frames[self._frame].parentJoint]
        carrying = [model.joints[i] for i in list(supports) if i > 0]
        if not carrying or any(part.nq != 1 for part in carrying):
            raise checks.refusal(tool, "tool", "carried by joints with one angle each", "fix the base of the arm")
        self._angles, self._rates = [part.idx_q for part in carrying], [part.idx_v for part in carrying]
        self.limits: Floats = np.stack([model.lowerPositionLimit, model.upperPositionLimit])[:, self._angles]

    def at(self, joints: Floats) -> ToolState:
        """State of the tool at joint angles (n,)."""
        pin, model, data = self._library, self._model, self._data
        every = self._neutral.copy()
        every[self._angles] = joints
        axes = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        jacobian = pin.computeFrameJacobian(model, data, every, self._frame, axes)[:, self._rates]
        upper = np.triu(pin.crba(model, data, every))  # the lower half is not always filled
        mass = (upper + np.triu(upper, 1).T)[np.ix_(self._rates, self._rates)]
        pin.forwardKinematics(model, data, every)
        pose = pin.updateFramePlacement(model, data, self._frame)
        return ToolState(pose.translation.copy(), rotations.from_matrix(pose.rotation), jacobian, mass)


Arm = MujocoArm | PinocchioArm


def arm(model: Any, tool: str) -> Arm:
    """Arm of a ``mujoco.MjModel`` or ``pinocchio.Model``; ``tool`` is the name of a site, body or frame."""
    kinds: dict[str, Any] = {"mujoco": MujocoArm, "pinocchio": PinocchioArm}
    library = type(model).__module__.partition(".")[0]
    if library not in kinds:
        raise checks.refusal(model, "model", "a mujoco.MjModel or a pinocchio.Model", "load one, or take panda()")
    return kinds[library](model, checks.text(tool, "tool"))


def operational_inertia(model: Any, joints: ArrayLike, tool: str) -> Floats:
    """Operational-space inertia at the tool of an arm, ``Lambda = (J M^-1 J')^-1``, in world axes.

    A torque-controlled arm moves with it, not with 1 kg: pass it to `torch_pbd.control.Schedule.with_inertia`.

    Parameters
    ----------
    model : mujoco.MjModel or pinocchio.Model
        Arm with six joints or more before the tool; others, such as those of fingers, are locked.
    joints : array_like of shape (..., n)
        Joint angles in rad, from the base to the tool.
    tool : str
        Name of a site or body (MuJoCo), or of a frame (Pinocchio).

    Returns
    -------
    ndarray of shape (..., 6, 6)
        Symmetric matrices in kg, kg m and kg m^2, translation before rotation.

    Raises
    ------
    ValueError
        If the model has no such tool, joints exceed their limits by more than 0.1 rad, or the arm is singular.

    References
    ----------
    O. Khatib, "A unified approach for motion and force control of robot manipulators", IEEE Journal of Robotics and
    Automation 3(1), 1987, eq. (12).
    """
    chain = arm(model, tool)
    low, high = chain.limits
    angles = checks.real_floats(joints, "joints")
    rows = checks.array(angles.reshape(-1, angles.shape[-1] if angles.ndim else 1), "joints", ("rows", len(low)))
    possible = (rows >= low - _OVERSHOT) & (rows <= high + _OVERSHOT)
    checks.require(possible, rows, "joints", "within the limits of its joint", "give rad, and the model of this arm")
    states = map(chain.at, rows)
    mobility = np.stack([state.jacobian @ np.linalg.solve(state.mass_matrix, state.jacobian.T) for state in states])
    mobility = 0.5 * (mobility + mobility.mT)
    checks.semidefinite(mobility, "J M^-1 J'", definite=True, remedy="keep the arm away from its singularities")
    inertia = np.linalg.inv(mobility)
    return (0.5 * (inertia + inertia.mT)).reshape(*angles.shape[:-1], 6, 6)


def inverse_kinematics(
    model: Any,
    position: ArrayLike,
    orientation: ArrayLike,
    tool: str,
    *,
    start: ArrayLike,
    posture: ArrayLike | None = None,
) -> Floats:
    """Joint angles along a path of the tool, nearest to a posture among all solutions.

    Angles depend on the pose alone and not on the path to it.

    Parameters
    ----------
    model : mujoco.MjModel or pinocchio.Model
    position : array_like of shape (T, 3)
        Positions of the tool in m, such as ``schedule.position``.
    orientation : array_like of shape (T, 4)
        Unit quaternions w x y z, such as ``schedule.orientation``.
    tool : str
        Name of a site or body (MuJoCo), or of a frame (Pinocchio).
    start : array_like of shape (n,)
        Joint angles in rad from which the first row is searched.
    posture : array_like of shape (n,), default=None
        Joint angles to stay near; None is ``start``.

    Returns
    -------
    ndarray of shape (T, n)
        Joint angles in rad, which reach the poses to 1e-9 m and rad by Newton's steps of minimum norm.

    Raises
    ------
    ValueError
        If a pose is unreachable within the joint limits.
    """
    chain = arm(model, tool)
    n = chain.limits.shape[1]
    path = checks.array(position, "position", ("rows", 3))
    turns = checks.array(orientation, "orientation", (len(path), 4))
    last = joints = checks.array(start, "start", (n,))
    near = joints if posture is None else checks.array(posture, "posture", (n,))
    found = np.empty((len(path), n))
    for row, (place, turn) in enumerate(zip(path, turns, strict=True)):
        guess = 2.0 * joints - last if row > 1 else joints  # on along the path
        last, joints = joints, _reach(chain, guess, place, turn, near, row)
        found[row] = joints
    low, high = chain.limits
    possible, remedy = (found >= low) & (found <= high), "move the path, or change start and posture"
    checks.require(possible, found, "joints", "within the limits of its joint", remedy)
    return found


def pose_error(state: ToolState, position: Floats, orientation: Floats) -> Floats:
    """Translation and rotation vector (6,) from the tool to a pose, in world axes."""
    return np.concatenate([position - state.position, rotations.between(state.orientation, orientation)])


def _reach(chain: Arm, joints: Floats, position: Floats, orientation: Floats, near: Floats, row: int) -> Floats:
    for _ in range(_MAX_STEPS):
        state = chain.at(joints)
        error, jacobian = pose_error(state, position, orientation), state.jacobian
        inverse, rest = np.linalg.pinv(jacobian, rcond=_SINGULAR), near - joints
        step = inverse @ error + rest - inverse @ (jacobian @ rest)
        longest = float(np.abs(step).max())
        if float(np.abs(error).max()) < _REACHED and longest < _SETTLED:
            return joints
        joints = joints + step * (_LONGEST_STEP / max(_LONGEST_STEP, longest))
    where = f"row {row} of the path, at {position.round(4).tolist()} m,"
    if float(np.abs(error).max()) < _REACHED:
        raise InvalidParameterError(f"{where} is reached, but not nearest to posture: give another posture, or start.")
    distance, angle = np.linalg.norm(error[:3]), np.linalg.norm(error[3:])
    raise InvalidParameterError(
        f"{where} is {1e3 * distance:.3g} mm and {angle:.3g} rad out of reach: move it nearer to the base with "
        "schedule.transform, or start from other joint angles."
    )

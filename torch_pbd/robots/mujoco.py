"""Franka Panda in MuJoCo, and schedules on a simulated arm: torque control with its own inertia, and pushes.

``panda.xml`` cites the sources of its values.
"""

import math
from pathlib import Path
from typing import Any, final

import numpy as np
from numpy.typing import ArrayLike

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.control.schedule import Schedule
from torch_pbd.control.schedule.rows import UNEVEN, even_step
from torch_pbd.exceptions import InvalidParameterError
from torch_pbd.registry import optional
from torch_pbd.robots.kinematics import MujocoArm, pose_error
from torch_pbd.robots.session import RobotRun, RobotStoppedError, accelerations, check_start, poses, warn_of_mass

HOME = (0.0, -math.pi / 4, 0.0, -3 * math.pi / 4, 0.0, math.pi / 2, math.pi / 4)
"""Joint angles of the Panda in rad, far from limits and singularities: the hand points down, 0.31 m before the base."""

_POSTURE_RATE = 5.0  # rate in 1/s of the critically damped null-space motion, slower than that of the tool


def panda_mjcf() -> str:
    """MJCF text of the Franka Emika Panda with closed hand, to be edited for another tool.

    Joints ``joint1`` to ``joint7`` have torque motors, 0.1 kg m^2 of inertia each and no friction; bodies do not
    collide. The site ``tool`` is the tip of the hand, 0.1034 m beyond the flange, at which the body ``hand`` begins.

    References
    ----------
    C. Gaz et al., IEEE Robotics and Automation Letters 4(4), 2019, for the inertia; Franka Control Interface,
    "Robot and interface specifications", for all other figures.
    """
    return Path(__file__).with_name("panda.xml").read_text(encoding="utf-8")


def panda() -> Any:
    """Franka Emika Panda of `panda_mjcf` as a ``mujoco.MjModel``; needs the extra ``robot``.

    Examples
    --------
    >>> from torch_pbd.robots import HOME, operational_inertia, panda
    >>> operational_inertia(panda(), HOME, "tool").diagonal()[:3].round(1)  # kg; a schedule without mass assumes 1
    array([12.5,  5.1,  6.5])
    """
    return optional("mujoco", "robot", "a model for MuJoCo").MjModel.from_xml_string(panda_mjcf())


def run(
    model: Any,
    schedule: Schedule,
    joints: ArrayLike,
    *,
    tool: str = "tool",
    wrench: ArrayLike | None = None,
) -> RobotRun:
    """Follow a schedule of poses by torques, ``J' (Lambda a_d - K e - D e') + h + N' M (...)``.

    The arm keeps its inertia Lambda(q), with gravity and Coriolis forces h compensated: under a force f at the tool it
    moves as ``Lambda (v' - a_d) + D (v - v_d) + K e = f``, which is the plant of a schedule made ``with_inertia`` of
    that arm. Redundant joints follow ``joints`` in the null space ``N'``, without effect on the tool.

    Parameters
    ----------
    model : mujoco.MjModel
        Arm with one torque motor per joint, in their order, such as `torch_pbd.robots.panda`.
    schedule : Schedule
        Schedule of poses, whose rows are the ticks of the controller: a whole number of the model's time steps apart,
        at 1 kHz for stiff gains (``schedule.resample(1000.0)``).
    joints : array_like of shape (T, n)
        Joint angles in rad along the schedule, from `torch_pbd.robots.inverse_kinematics`: the arm starts at the first,
        at the schedule's velocity.
    tool : str, default="tool"
        Name of a site or body of the model.
    wrench : array_like of shape (T, 6), default=None
        External force and torque at the tool in N and Nm, in world axes; None is zero.

    Returns
    -------
    RobotRun
        States at the start of each tick, with the wrench and torques during it.

    Warns
    -----
    UserWarning
        If the schedule was not made ``with_inertia`` of an arm.

    Raises
    ------
    ValueError
        If the schedule has no orientations, is uneven, or does not begin at the arm's pose.
    RobotStoppedError
        If a joint reaches its limit.

    References
    ----------
    O. Khatib, IEEE Journal of Robotics and Automation 3(1), 1987, eq. (27) and (50); C. Ott, "Cartesian impedance
    control of redundant and flexible-joint robots", Springer 2008, section 3.2, for the inertia that is kept.
    """
    simulation = _Simulation(model, tool, schedule, joints)
    pushes = np.zeros((len(schedule), 6)) if wrench is None else checks.array(wrench, "wrench", (len(schedule), 6))
    ticks = [simulation.tick(row, push) for row, push in enumerate(pushes)]
    measured = {name: np.stack([tick[name] for tick in ticks]) for name in ticks[0]}
    return RobotRun(schedule.time, wrench=pushes, **measured)


@final
class _Simulation:
    """MuJoCo simulation of an arm whose controller follows a schedule."""

    def __init__(self, model: Any, tool: str, schedule: Schedule, joints: ArrayLike) -> None:
        self._mujoco = mujoco = optional("mujoco", "robot", "an arm in MuJoCo")
        checks.instance(model, "model", mujoco.MjModel)
        self._schedule, self._poses, self._acceleration = schedule, poses(schedule), accelerations(schedule)
        warn_of_mass(schedule)
        step = even_step(schedule.time)
        self._n_steps = round(step / model.opt.timestep)
        if not self._n_steps or abs(self._n_steps * model.opt.timestep - step) > UNEVEN * step:
            raise InvalidParameterError(
                f"schedule has steps of {step:g} s, must have a multiple of the model's {model.opt.timestep:g} s: "
                "resample it."
            )
        self._chain = chain = MujocoArm(model, checks.text(tool, "tool"))
        n_joints = chain.limits.shape[1]
        if model.nu != n_joints or model.nv != model.nu:
            raise InvalidParameterError(
                f"model has {model.nu} motors and {model.nv} degrees of freedom for the {n_joints} joints before "
                f"{tool!r}, must have one motor for each and no others: lock fingers and leave out objects."
            )
        self._joints = checks.array(joints, "joints", (len(schedule), n_joints))
        self._speed = np.gradient(self._joints, schedule.time, axis=0)
        self._rise = np.gradient(self._speed, schedule.time, axis=0)
        start = chain.at(self._joints[0])
        check_start(schedule, start.position, start.orientation)
        self._model, self._data = model, mujoco.MjData(model)
        self._data.qpos[:], self._data.qvel[:] = self._joints[0], np.linalg.pinv(start.jacobian) @ schedule.velocity[0]

    def tick(self, row: int, push: Floats) -> dict[str, Any]:
        """State and commands at the start of a tick, which is then simulated."""
        data, planned = self._data, self._schedule
        self._mujoco.mj_forward(self._model, data)  # for the positions and velocities after the last step
        state = self._chain.measure(data)
        if np.any(data.qpos <= self._chain.limits[0]) or np.any(data.qpos >= self._chain.limits[1]):
            raise RobotStoppedError(f"a joint reached its limit, at {data.qpos.round(3).tolist()} rad")
        twist = state.jacobian @ data.qvel
        error = -pose_error(state, *(part[row] for part in self._poses))
        inverse = np.linalg.solve(state.mass_matrix, state.jacobian.T)
        mass = np.linalg.inv(state.jacobian @ inverse)
        # Khatib (27), with the inertia kept: forces of the arm's own motion are cancelled, and its inertia is not.
        wrench = mass @ (self._acceleration[row] - self._chain.bias(data))
        wrench -= planned.stiffness[row] @ error + planned.damping[row] @ (twist - planned.velocity[row])
        away, slower = self._joints[row] - data.qpos, self._speed[row] - data.qvel
        drift = _POSTURE_RATE**2 * away + 2.0 * _POSTURE_RATE * slower + self._rise[row]
        # N' M drift, N = I - M^-1 J' Lambda J (50): an acceleration of the joints that the tool does not feel.
        free = state.mass_matrix @ (drift - inverse @ (mass @ (state.jacobian @ drift)))
        torque = state.jacobian.T @ wrench + data.qfrc_bias + free
        data.ctrl[:], data.qfrc_applied[:] = torque, state.jacobian.T @ push
        measured = {"position": state.position, "orientation": state.orientation, "twist": twist, "deviation": error}
        measured |= {"joints": data.qpos.copy(), "torque": torque, "mass": mass}
        self._mujoco.mj_step(self._model, data, nstep=self._n_steps)
        less = np.abs(data.actuator_force - torque) > 1e-9 * np.abs(torque).max()
        return measured | {"saturated": bool(np.any(less))}

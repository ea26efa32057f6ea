"""Schedules as ROS 2 messages, written with rosbags, without a ROS installation."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import numpy as np

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.control.schedule import Schedule
from torch_pbd.registry import optional
from torch_pbd.robots.session import poses

Gains = Literal["matrix", "diagonal"]

_TOPICS = {
    "target_pose": "geometry_msgs/msg/PoseStamped",
    "target_twist": "geometry_msgs/msg/TwistStamped",
    "target_stiffness": "std_msgs/msg/Float64MultiArray",
    "target_damping": "std_msgs/msg/Float64MultiArray",
}


def to_messages(schedule: Schedule, *, gains: Gains = "matrix") -> Iterator[tuple[str, int, Any]]:
    """Topic, time in ns and message for each row of a schedule of poses, as published by a node.

    Poses and gains use the topics of crisp_controllers, which takes ``gains="diagonal"``: six numbers, like the
    parameters of ros2_control's admittance controller and FZI's cartesian controllers. None of them compensates
    friction: 1.5 N hold the tool 30 mm away at 50 N/m, so learn with a ``stiffness_min`` of a few hundred N/m.

    Parameters
    ----------
    schedule : Schedule
        Schedule of poses in m; the messages have its ``frame``, by default ``base``.
    gains : {"matrix", "diagonal"}, default="matrix"
        Gains as 36 numbers, row by row, or as the diagonals alone.

    Yields
    ------
    topic : str
        ``target_pose``, ``target_twist`` (world axes), ``target_stiffness`` or ``target_damping``.
    time : int
        Time of the schedule in ns, also in the header.
    message : object
        Message of rosbags with the fields of ROS.

    Warns
    -----
    UserWarning
        If gains with off-diagonal entries are reduced to diagonals.
    """
    types = _store().types
    position, orientation = poses(schedule)
    if checks.choice(gains, "gains", Gains) == "diagonal":
        whole, (schedule, loss) = schedule, schedule.diagonal()
        if (schedule.stiffness != whole.stiffness).any():
            checks.warn(f"{loss}.")
    names = ("Point", "Quaternion", "Vector3", "Pose", "Twist")
    point, quaternion, vector, pose_of, twist_of = (types[f"geometry_msgs/msg/{name}"] for name in names)
    for row, time in enumerate(schedule.time):
        stamp = round(1e9 * time)
        when = types["builtin_interfaces/msg/Time"](*divmod(stamp, 10**9))
        header = types["std_msgs/msg/Header"](when, schedule.frame or "base")
        turn = quaternion(*np.roll(orientation[row], -1).tolist())  # x y z w
        pose = pose_of(point(*position[row].tolist()), turn)
        twist = twist_of(*(vector(*part) for part in schedule.velocity[row].reshape(2, 3).tolist()))
        yield "target_pose", stamp, types[_TOPICS["target_pose"]](header, pose)
        yield "target_twist", stamp, types[_TOPICS["target_twist"]](header, twist)
        yield "target_stiffness", stamp, _array(types, schedule.stiffness[row], gains)
        yield "target_damping", stamp, _array(types, schedule.damping[row], gains)


def to_bag(schedule: Schedule, path: str | os.PathLike[str], *, gains: Gains = "matrix") -> None:
    """Write the messages of `to_messages` to a rosbag2, a new folder for ``ros2 bag play``.

    Parameters
    ----------
    schedule : Schedule
    path : path
        Folder to create.
    gains : {"matrix", "diagonal"}, default="matrix"

    Raises
    ------
    FileExistsError
        If the path exists.
    """
    if Path(path).exists():
        raise FileExistsError(f"{path} exists: give a new folder, or remove it.")
    store = _store()
    with optional("rosbags.rosbag2", "robot", "a bag of messages").Writer(Path(path), version=9) as writer:
        topics = {name: writer.add_connection(f"/{name}", kind, typestore=store) for name, kind in _TOPICS.items()}
        for name, stamp, message in to_messages(schedule, gains=gains):
            writer.write(topics[name], stamp, store.serialize_cdr(message, _TOPICS[name]))


def _store() -> Any:
    typesys = optional("rosbags.typesys", "robot", "a message of ROS")
    return typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)


def _array(types: Any, matrix: Floats, gains: Gains) -> Any:
    values = np.diagonal(matrix) if gains == "diagonal" else matrix
    dimension, layout = types["std_msgs/msg/MultiArrayDimension"], types["std_msgs/msg/MultiArrayLayout"]
    # The stride of an axis is the number of entries from it on.
    axes = [dimension(name, 6, 6 ** (values.ndim - i)) for i, name in enumerate(("rows", "columns")[: values.ndim])]
    return types["std_msgs/msg/Float64MultiArray"](layout(axes, 0), values.flatten())

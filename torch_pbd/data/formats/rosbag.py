"""Recordings of ROS: rosbag2 (SQLite or MCAP) and ROS 1 bags; one topic, a sample a message."""

from array import array
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from itertools import chain
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torch_pbd import checks
from torch_pbd.data.recordings import MIN_SAMPLES, preview
from torch_pbd.data.wanted import Arguments, Wanted
from torch_pbd.registry import optional

# Fields that are outputs by message type, the first by default: where they lie in it, the names of their components,
# the prefix of their columns, and the unit that ROS prescribes (REP 103).
_FIELDS = {
    "Point": {"position": ("", "xyz", "", "m")},
    "Pose": {"position": ("position.", "xyz", "", "m"), "orientation": ("orientation.", "xyzw", "q", "1")},
    "Transform": {"position": ("translation.", "xyz", "", "m"), "orientation": ("rotation.", "xyzw", "q", "1")},
    "Wrench": {"force": ("force.", "xyz", "force_", "N"), "torque": ("torque.", "xyz", "torque_", "N m")},
    "Twist": {"linear": ("linear.", "xyz", "linear_", "m/s"), "angular": ("angular.", "xyz", "angular_", "rad/s")},
}
# Where the part that has the fields lies in a message.
_PARTS = {f"geometry_msgs/msg/{kind}": (kind, "") for kind in _FIELDS}
_PARTS |= {f"geometry_msgs/msg/{kind}Stamped": (kind, f"{kind.lower()}.") for kind in _FIELDS}
_PARTS |= dict.fromkeys(
    ["geometry_msgs/msg/PoseWithCovarianceStamped", "nav_msgs/msg/Odometry"], ("Pose", "pose.pose.")
)
_JOINTS, _TRANSFORMS = "sensor_msgs/msg/JointState", ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
Stretches = dict[int, tuple["array[int]", "array[float]"]]
_KINDS = (*_PARTS, _JOINTS, *_TRANSFORMS)
# Message types of topics that may label the demonstrations.
_MARKS = {f"std_msgs/msg/{sign}Int{bits}" for sign in ("", "U") for bits in (8, 16, 32, 64)}
_MARKS |= {"std_msgs/msg/Bool", "std_msgs/msg/String"}
# Prefix and unit of the columns of each field of joints.
_JOINT_FIELDS = {"position": ("", "rad"), "velocity": ("velocity.", "rad/s"), "effort": ("effort.", "N m")}


def read(path: Path, wanted: Wanted, topic: str | None = None, child: str | None = None) -> Arguments:
    """Read the format of `torch_pbd.data.load_demonstrations`, which describes the options."""
    checks.text(topic, "topic", optional=True)
    highlevel = optional("rosbags.highlevel", "ros", f"{path.name}, as all of ROS,")
    stores = optional("rosbags.typesys", "ros", path.name)
    # SQLite bags of older versions do not hold the definitions of their messages: standard ones did not change.
    types = stores.get_typestore(stores.Stores.ROS2_HUMBLE)
    with highlevel.AnyReader([path], default_typestore=types) as reader:
        name = _topic(reader.topics, topic, wanted.demo)
        kind, n_messages = reader.topics[name].msgtype, reader.topics[name].msgcount
        # A sample is 8 bytes for each of its stamp and, with room for joints, 31 outputs.
        wanted.require(256.0 * n_messages, f"topic {name!r}")
        marks: list[Any] = []
        messages = _messages(reader, name, wanted.demo, marks)
        if kind in _TRANSFORMS:
            messages, kind = _of_child(messages, child), "geometry_msgs/msg/TransformStamped"
        first = next(messages, None)
        if first is None:
            raise ValueError("the topic has no messages.")
        columns = _columns(kind, first[2])
        signals = {field: tuple(own) for field, own in columns.items()} | {"time": ("time",)}
        chosen = replace(wanted, demo=None).choose(signals, time="time", outputs=next(iter(signals)))
        getters = [columns[field][name] for (field, _), name in zip(chosen.outputs, chosen.names, strict=True)]
        # Stamps and outputs of each stretch. Arrays of numbers take 8 bytes for each, where lists of tuples take 60.
        stretches: Stretches = defaultdict(lambda: (array("q"), array("d")))
        for number, stamp, message in chain([first], messages):
            stamps, outputs = stretches[number]
            stamps.append(stamp)
            outputs.extend([get(message) for get, _ in getters])
    return wanted.read_each(
        chosen._replace(outputs=[("y", i) for i in range(len(getters))]),
        _recordings(stretches, marks, wanted.demo),
        units=[unit for _, unit in getters],
        frame=getattr(getattr(first[2], "header", None), "frame_id", "") or None,
    )


def _topic(topics: dict[str, Any], topic: str | None, demo: str | None) -> str:
    """Topic wanted, or the only one with a movement; checks the one that tells the demonstrations apart, too."""
    kinds = {name: info.msgtype for name, info in topics.items()}
    moving = [topic] if topic else [name for name, kind in kinds.items() if kind in _KINDS and topics[name].msgcount]
    wrong = ""
    if len(moving) != 1:
        several = "several topics of movements: say which by"
        wrong = f"it has {several if moving else 'no topic of poses, joints or forces to take by'} topic="
    elif kinds.get(moving[0]) not in _KINDS:
        known = ", ".join(sorted(kind.split("/")[-1] for kind in _KINDS))
        is_of = f"topic {topic!r} is of {kinds.get(moving[0])}, must be of one of {known}"
        wrong = is_of if topic in kinds else f"it has no topic {topic!r}"
    elif demo is not None and kinds.get(demo) not in _MARKS:
        what = f"topic {demo!r}, by which demo= tells the demonstrations apart, is of {kinds.get(demo, 'no kind')}"
        wrong = f"{what}, must be of Bool, String or a whole number of std_msgs"
    if wrong:
        listed = ", ".join(f"{name} ({info.msgtype}, {info.msgcount} messages)" for name, info in topics.items())
        raise ValueError(f"{wrong}; it has: {listed or 'none'}.")
    return moving[0]


def _messages(reader: Any, topic: str, demo: str | None, marks: list[Any]) -> Iterator[tuple[int, int, Any]]:
    """Messages, each with the number of the stretch over which topic ``demo`` has one of ``marks``, and a stamp in ns.

    All in the order in which they were recorded: stamps in headers, where they have some, may be of another clock.
    """
    connections = [c for name in dict.fromkeys((topic, demo)) if name for c in reader.topics[name].connections]
    deserialize = reader.typestore.deserialize_cdr if reader.is2 else reader.typestore.deserialize_ros1
    for connection, stamp, raw in reader.messages(connections):
        message = deserialize(raw, connection.msgtype)
        if connection.topic == topic:
            yield len(marks) - 1, _stamp(message, stamp), message
        elif not marks or message.data != marks[-1]:
            marks.append(message.data)


def _recordings(found: Stretches, marks: list[Any], demo: str | None) -> list[dict[str, NDArray[Any]]]:
    """Signals of each stretch that is a demonstration, in order of their stamps: drivers send some twice or late."""
    if demo is not None:
        marked = {k: own for k, own in found.items() if k >= 0 and not _is_between(marks[k], marks)}
        found = {k: own for k, own in marked.items() if len(own[0]) >= MIN_SAMPLES}
        if not found:
            raise ValueError(f"demo={demo!r} marks no demonstration: its values are {preview(marks)}.")
        if lost := len(marked) - len(found):
            checks.warn(f"Left out, with less than two messages: {lost} of {len(marked)} demonstrations by {demo!r}.")
    recordings, n_late, n_repeated = [], 0, 0
    for stamps, outputs in found.values():
        own = {"time": np.frombuffer(stamps, "M8[ns]"), "y": np.frombuffer(outputs).reshape(len(stamps), -1)}
        if not (np.diff(own["time"]) > np.timedelta64(0)).all():
            order = np.argsort(own["time"], kind="stable")
            repeated = np.r_[False, np.diff(own["time"][order]) == np.timedelta64(0)]
            n_late, n_repeated = n_late + int((np.diff(order) < 0).sum()), n_repeated + int(repeated.sum())
            own = {name: values[order[~repeated]] for name, values in own.items()}
        recordings.append(own)
    if n_late or n_repeated:
        n_all = sum(len(stamps) for stamps, _ in found.values())
        late = f"{n_late} of {n_all} messages came after later ones, and are put in order"
        checks.warn(f"{late}; {n_repeated} repeat the stamp of another one, of which the first is kept.")
    return recordings


def _is_between(value: Any, values: list[Any]) -> bool:
    """Whether a value of the topic that tells demonstrations apart stands for none; a count from 0 does not go back."""
    return not value.strip() if isinstance(value, str) else value is False or (value == 0 and 0 in values[1:])


def _of_child(messages: Iterator[tuple[int, int, Any]], child: str | None) -> Iterator[tuple[int, int, Any]]:
    """Transforms of one frame; of the only one, where none is named."""
    seen: set[str] = set()
    for number, stamp, message in messages:
        for transform in message.transforms:
            seen.add(transform.child_frame_id)
            if child is None and len(seen) > 1:
                raise ValueError(f"its transforms are of frames {', '.join(sorted(seen))}: name one by child=.")
            if child in (None, transform.child_frame_id):
                yield number, _stamp(transform, stamp), transform
    if child is not None and child not in seen:
        raise ValueError(f"it has no transforms of {child!r}, but of {', '.join(sorted(seen))}.")


def _stamp(message: Any, received: int) -> int:
    """Stamp of a message's header in ns; the time at which it was received, where it has none."""
    header = getattr(message, "header", None)
    return received if header is None else header.stamp.sec * 10**9 + header.stamp.nanosec


def _columns(kind: str, message: Any) -> dict[str, dict[str, tuple[Callable[[Any], float], str]]]:
    """Columns of each field of a message by name: a getter and a unit."""
    if kind != _JOINTS:
        part, place = _PARTS[kind]
        return {
            field: {prefix + letter: (attrgetter(place + own + letter), unit) for letter in letters}
            for field, (own, letters, prefix, unit) in _FIELDS[part].items()
        }
    names = [str(name) for name in message.name]
    given = [field for field in _JOINT_FIELDS if len(getattr(message, field)) == len(names) > 0]

    def joint(field: str, i: int, message: Any) -> float:
        if message.name[i] != names[i]:  # the order of joints may change
            raise ValueError(f"a message has joints {', '.join(message.name)}, others {', '.join(names)}.")
        return float(getattr(message, field)[i])

    return {
        field: {prefix + name: (partial(joint, field, i), unit) for i, name in enumerate(names)}
        for field, (prefix, unit) in _JOINT_FIELDS.items()
        if field in (given or ["position"])
    }

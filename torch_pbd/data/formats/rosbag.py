"""Recordings of ROS: rosbag2 (SQLite or MCAP) and ROS 1 bags; one topic, a sample a message."""

from array import array
from collections.abc import Callable, Iterator
from itertools import chain
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torch_pbd import checks
from torch_pbd.data.wanted import Arguments, Wanted
from torch_pbd.extras import optional

_XYZ, _XYZW = ("x", "y", "z"), ("x", "y", "z", "w")


class _Field(NamedTuple):
    """A field that is an output: the components of a message's part, their names and unit."""

    path: str
    components: tuple[str, ...]
    unit: str


_POSITION, _ROTATION = "position", "orientation"
# Fields by message type, the first the outputs by default; the units are those that ROS prescribes (REP 103).
_FIELDS: dict[str, dict[str, _Field]] = {
    "Point": {_POSITION: _Field("", _XYZ, "m")},
    "Pose": {_POSITION: _Field("position", _XYZ, "m"), _ROTATION: _Field("orientation", _XYZW, "1")},
    "Transform": {_POSITION: _Field("translation", _XYZ, "m"), _ROTATION: _Field("rotation", _XYZW, "1")},
    "Wrench": {"force": _Field("force", _XYZ, "N"), "torque": _Field("torque", _XYZ, "N m")},
    "Twist": {"linear": _Field("linear", _XYZ, "m/s"), "angular": _Field("angular", _XYZ, "rad/s")},
}
# Where the part that has the fields lies in a message.
_PARTS = {
    "geometry_msgs/msg/PointStamped": ("Point", "point"),
    "geometry_msgs/msg/PoseStamped": ("Pose", "pose"),
    "geometry_msgs/msg/PoseWithCovarianceStamped": ("Pose", "pose.pose"),
    "nav_msgs/msg/Odometry": ("Pose", "pose.pose"),
    "geometry_msgs/msg/TransformStamped": ("Transform", "transform"),
    "geometry_msgs/msg/WrenchStamped": ("Wrench", "wrench"),
    "geometry_msgs/msg/TwistStamped": ("Twist", "twist"),
    "geometry_msgs/msg/Pose": ("Pose", ""),
    "geometry_msgs/msg/Point": ("Point", ""),
    "geometry_msgs/msg/Wrench": ("Wrench", ""),
    "geometry_msgs/msg/Twist": ("Twist", ""),
}
_JOINTS, _TRANSFORMS = "sensor_msgs/msg/JointState", ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
_KINDS = (*_PARTS, _JOINTS, *_TRANSFORMS)
_JOINT_UNITS = {"position": "rad", "velocity": "rad/s", "effort": "N m"}


def read(path: Path, wanted: Wanted, topic: str | None = None, child: str | None = None) -> Arguments:
    """Read the format of `torch_pbd.data.load_demonstrations`, which describes the options."""
    checks.text(topic, "topic", optional=True)
    checks.text(child, "child", optional=True)
    highlevel = optional("rosbags.highlevel", "ros", f"{path.name}, as all of ROS,")
    stores = optional("rosbags.typesys", "ros", path.name)
    # SQLite bags of older versions do not hold the definitions of their messages: standard ones did not change.
    types = stores.get_typestore(stores.Stores.ROS2_HUMBLE)
    with highlevel.AnyReader([path], default_typestore=types) as reader:
        name = _topic(reader.topics, topic)
        info = reader.topics[name]
        # A sample is 8 bytes for each of its stamp and, with room for joints, 31 outputs.
        wanted.require(256.0 * info.msgcount, f"topic {name!r}")
        typestore, is_2, kind = reader.typestore, reader.is2, info.msgtype
        deserialize = typestore.deserialize_cdr if is_2 else typestore.deserialize_ros1
        messages = ((stamp, deserialize(raw, kind)) for _, stamp, raw in reader.messages(info.connections))
        return _read_messages(kind, messages, wanted, child)


def _topic(topics: dict[str, Any], topic: str | None) -> str:
    """Topic wanted, or the only one with a movement."""
    listed = ", ".join(f"{name} ({info.msgtype}, {info.msgcount} messages)" for name, info in topics.items())
    if topic is not None:
        if topic not in topics:
            raise ValueError(f"it has no topic {topic!r}; it has: {listed or 'none'}.")
        found = [topic]
    else:
        found = [n for n, info in topics.items() if info.msgtype in _KINDS and info.msgcount]
    if len(found) != 1:
        what = (
            "several topics of movements: say which by" if found else "no topic of poses, joints or forces to take by"
        )
        raise ValueError(f"it has {what} topic=; it has: {listed or 'none'}.")
    info = topics[found[0]]
    if info.msgtype not in _KINDS:
        known = ", ".join(sorted(kind.split("/")[-1] for kind in _KINDS))
        raise ValueError(f"topic {found[0]!r} is of {info.msgtype}, must be of one of {known}; it has: {listed}.")
    return found[0]


def _read_messages(kind: str, messages: Iterator[tuple[int, Any]], wanted: Wanted, child: str | None) -> Arguments:
    if kind in _TRANSFORMS:
        messages = _of_child(messages, child)
        kind = "geometry_msgs/msg/TransformStamped"
    first = next(messages, None)
    if first is None:
        raise ValueError("the topic has no messages.")
    signals, units, get = _joints(first[1]) if kind == _JOINTS else _parts(*_PARTS[kind])
    chosen = wanted.choose({**signals, "time": ("time",)}, time="time", outputs=next(iter(signals)))
    row, has_header = get(chosen.outputs), hasattr(first[1], "header")
    # Arrays of numbers take 8 bytes for each, where lists of tuples take 60.
    stamps, rows = array("q"), array("d")
    for stamp, message in chain([first], messages):
        if has_header:
            time = message.header.stamp
            stamp = time.sec * 10**9 + time.nanosec
        stamps.append(stamp)
        rows.extend(row(message))
    positions = np.array(rows).reshape(len(stamps), len(chosen.names))
    times, positions = _in_order(np.array(stamps).view("M8[ns]"), positions)
    frame = getattr(getattr(first[1], "header", None), "frame_id", "") or None
    labels = {"units": [units[signal] for signal, _ in chosen.outputs], "frame": frame}
    return wanted.arguments([times], [positions], chosen.names, **labels)


def _of_child(messages: Iterator[tuple[int, Any]], child: str | None) -> Iterator[tuple[int, Any]]:
    """Transforms of one frame; of the only one, where none is named."""
    seen: set[str] = set()
    for stamp, message in messages:
        for transform in message.transforms:
            seen.add(transform.child_frame_id)
            if child is None and len(seen) > 1:
                raise ValueError(
                    f"its transforms are of several frames, {', '.join(sorted(seen))}: say which by child=."
                )
            if child in (None, transform.child_frame_id):
                yield stamp, transform
    if child is not None and child not in seen:
        raise ValueError(f"it has no transforms of {child!r}, but of {', '.join(sorted(seen))}.")


Getter = Callable[[list[tuple[str, int]]], Callable[[Any], Any]]


def _parts(kind: str, part: str) -> tuple[dict[str, tuple[str, ...]], dict[str, str], Getter]:
    fields = _FIELDS[kind]
    signals = {name: tuple(_column(name, letter) for letter in field.components) for name, field in fields.items()}

    def get(places: list[tuple[str, int]]) -> Callable[[Any], Any]:
        paths = [".".join(filter(None, (part, fields[s].path, fields[s].components[i]))) for s, i in places]
        get_all = attrgetter(*paths)
        return get_all if len(paths) > 1 else lambda message: (get_all(message),)

    return signals, {name: field.unit for name, field in fields.items()}, get


def _joints(message: Any) -> tuple[dict[str, tuple[str, ...]], dict[str, str], Getter]:
    names = [str(name) for name in message.name]
    given = [field for field in _JOINT_UNITS if len(getattr(message, field)) == len(names) > 0]
    signals = {field: tuple(n if field == _POSITION else f"{field}.{n}" for n in names) for field in given}

    def get(places: list[tuple[str, int]]) -> Callable[[Any], Any]:
        def row(message: Any) -> list[float]:
            if [*message.name] != names:  # the order of joints may change
                raise ValueError(f"a message has joints {', '.join(message.name)}, others {', '.join(names)}.")
            return [getattr(message, field)[i] for field, i in places]

        return row

    return signals or {_POSITION: ()}, _JOINT_UNITS, get


def _column(field: str, letter: str) -> str:
    """Name of an output: x of positions, q of rotations, else with the field."""
    return {_POSITION: letter, _ROTATION: f"q{letter}"}.get(field, f"{field}_{letter}")


def _in_order(times: NDArray[Any], positions: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Samples by their stamps: drivers send some twice, and late ones; what is left out is told."""
    order = np.argsort(times, kind="stable")
    times, positions = times[order], positions[order]
    late, repeated = int((np.diff(order) < 0).sum()), np.diff(times) == np.timedelta64(0)
    if late or repeated.any():
        checks.warn(
            f"{late} of {len(times)} messages came after later ones, and are put in order; {repeated.sum()} repeat the "
            "stamp of another one, of which the first is kept."
        )
    kept = np.r_[True, ~repeated]
    return times[kept], positions[kept]

"""Recordings of ROS: rosbag2 (SQLite or MCAP) and ROS 1 bags; one topic, a sample a message."""

from array import array
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import chain
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torch_pbd import checks
from torch_pbd.data.recordings import MIN_SAMPLES, preview
from torch_pbd.data.wanted import Arguments, Wanted, rows_of
from torch_pbd.registry import optional

_POSITION, _ROTATION = "position", "orientation"
# Fields that are outputs by message type, the first by default: where they lie in it, the names of their components,
# and the unit that ROS prescribes (REP 103).
_FIELDS = {
    "Point": {_POSITION: ("", "xyz", "m")},
    "Pose": {_POSITION: ("position.", "xyz", "m"), _ROTATION: ("orientation.", "xyzw", "1")},
    "Transform": {_POSITION: ("translation.", "xyz", "m"), _ROTATION: ("rotation.", "xyzw", "1")},
    "Wrench": {"force": ("force.", "xyz", "N"), "torque": ("torque.", "xyz", "N m")},
    "Twist": {"linear": ("linear.", "xyz", "m/s"), "angular": ("angular.", "xyz", "rad/s")},
}
# Where the part that has the fields lies in a message.
_PARTS = {
    "geometry_msgs/msg/PointStamped": ("Point", "point."),
    "geometry_msgs/msg/PoseStamped": ("Pose", "pose."),
    "geometry_msgs/msg/PoseWithCovarianceStamped": ("Pose", "pose.pose."),
    "nav_msgs/msg/Odometry": ("Pose", "pose.pose."),
    "geometry_msgs/msg/TransformStamped": ("Transform", "transform."),
    "geometry_msgs/msg/WrenchStamped": ("Wrench", "wrench."),
    "geometry_msgs/msg/TwistStamped": ("Twist", "twist."),
    **{f"geometry_msgs/msg/{kind}": (kind, "") for kind in ("Pose", "Point", "Wrench", "Twist")},
}
_JOINTS, _TRANSFORMS = "sensor_msgs/msg/JointState", ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
_KINDS = (*_PARTS, _JOINTS, *_TRANSFORMS)
# Of these, a topic may tell the demonstrations apart.
_MARKS = {f"std_msgs/msg/{sign}Int{bits}" for sign in ("", "U") for bits in (8, 16, 32, 64)}
_MARKS |= {"std_msgs/msg/Bool", "std_msgs/msg/String"}
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
        values: list[Any] = []
        return _read_messages(info.msgtype, _stretches(reader, name, wanted.demo, values), values, wanted, child)


def _stretches(reader: Any, topic: str, demo: str | None, values: list[Any]) -> Iterator[tuple[int, int, Any]]:
    """Messages, each with its stamp and the number of the stretch over which topic ``demo`` has one of ``values``.

    All in the order in which they were recorded: stamps in headers may be of another clock.
    """
    connections = reader.topics[topic].connections
    if demo is not None:
        if demo not in reader.topics or reader.topics[demo].msgtype not in _MARKS:
            what = f"is of {reader.topics[demo].msgtype}" if demo in reader.topics else "is not there"
            raise ValueError(
                f"topic {demo!r}, by which demo= tells the demonstrations apart, {what}, must be of Bool, String or a "
                f"whole number of std_msgs; it has: {_listed(reader.topics)}."
            )
        connections = [*connections, *reader.topics[demo].connections]
    deserialize = reader.typestore.deserialize_cdr if reader.is2 else reader.typestore.deserialize_ros1
    for connection, stamp, raw in reader.messages(connections):
        message = deserialize(raw, connection.msgtype)
        if connection.topic == topic:
            yield len(values) - 1, stamp, message
        elif not values or message.data != values[-1]:
            values.append(message.data)


def _is_between(value: Any, values: list[Any]) -> bool:
    """Whether a value of the topic that tells demonstrations apart stands for none; a count from 0 does not go back."""
    return not value.strip() if isinstance(value, str) else value is False or (value == 0 and 0 in values[1:])


def _listed(topics: dict[str, Any]) -> str:
    listed = ", ".join(f"{name} ({info.msgtype}, {info.msgcount} messages)" for name, info in topics.items())
    return listed or "none"


def _topic(topics: dict[str, Any], topic: str | None) -> str:
    """Topic wanted, or the only one with a movement."""
    moving = [name for name, info in topics.items() if info.msgtype in _KINDS and info.msgcount]
    if topic is None:
        if len(moving) != 1:
            several = "several topics of movements: say which by"
            what = several if moving else "no topic of poses, joints or forces to take by"
            raise ValueError(f"it has {what} topic=; it has: {_listed(topics)}.")
        return moving[0]
    if topic not in topics:
        raise ValueError(f"it has no topic {topic!r}; it has: {_listed(topics)}.")
    if topics[topic].msgtype not in _KINDS:
        known = ", ".join(sorted(kind.split("/")[-1] for kind in _KINDS))
        kind = topics[topic].msgtype
        raise ValueError(f"topic {topic!r} is of {kind}, must be of one of {known}; it has: {_listed(topics)}.")
    return topic


def _read_messages(
    kind: str, messages: Iterator[tuple[int, int, Any]], values: list[Any], wanted: Wanted, child: str | None
) -> Arguments:
    if kind in _TRANSFORMS:
        messages = _of_child(messages, child)
        kind = "geometry_msgs/msg/TransformStamped"
    first = next(messages, None)
    if first is None:
        raise ValueError("the topic has no messages.")
    signals, units, get = _joints(first[2]) if kind == _JOINTS else _parts(*_PARTS[kind])
    chosen = replace(wanted, demo=None).choose({**signals, "time": ("time",)}, time="time", outputs=next(iter(signals)))
    row, has_header = get(chosen.outputs), hasattr(first[2], "header")
    # Arrays of numbers take 8 bytes for each, where lists of tuples take 60.
    numbers, stamps, coordinates = array("q"), array("q"), array("d")
    for number, stamp, message in chain([first], messages):
        if has_header:
            time = message.header.stamp
            stamp = time.sec * 10**9 + time.nanosec
        numbers.append(number)
        stamps.append(stamp)
        coordinates.extend(row(message))
    positions, times = np.frombuffer(coordinates).reshape(len(stamps), -1), np.frombuffer(stamps, "M8[ns]")
    own = np.frombuffer(numbers, np.int64)
    found = dict(zip(np.unique(own), rows_of(own), strict=True))
    if wanted.demo is not None:
        marked = {k: rows for k, rows in found.items() if k >= 0 and not _is_between(values[k], values)}
        found = {k: rows for k, rows in marked.items() if len(times[rows]) >= MIN_SAMPLES}
        if not found:
            raise ValueError(f"demo={wanted.demo!r} marks no demonstration: its values are {preview(values)}.")
        if lost := len(marked) - len(found):
            checks.warn(
                f"Left out, with less than two messages: {lost} of {len(marked)} demonstrations by {wanted.demo!r}."
            )
    recordings = _in_order([(times[rows], positions[rows]) for rows in found.values()])
    frame = getattr(getattr(first[2], "header", None), "frame_id", "") or None
    labels = {"units": [units[signal] for signal, _ in chosen.outputs], "frame": frame}
    return wanted.arguments([t for t, _ in recordings], [y for _, y in recordings], chosen.names, **labels)


def _of_child(messages: Iterator[tuple[int, int, Any]], child: str | None) -> Iterator[tuple[int, int, Any]]:
    """Transforms of one frame; of the only one, where none is named."""
    seen: set[str] = set()
    for number, stamp, message in messages:
        for transform in message.transforms:
            seen.add(transform.child_frame_id)
            if child is None and len(seen) > 1:
                raise ValueError(
                    f"its transforms are of several frames, {', '.join(sorted(seen))}: say which by child=."
                )
            if child in (None, transform.child_frame_id):
                yield number, stamp, transform
    if child is not None and child not in seen:
        raise ValueError(f"it has no transforms of {child!r}, but of {', '.join(sorted(seen))}.")


Getter = Callable[[list[tuple[str, int]]], Callable[[Any], Any]]


def _parts(kind: str, part: str) -> tuple[dict[str, tuple[str, ...]], dict[str, str], Getter]:
    fields = _FIELDS[kind]

    def column(field: str, letter: str) -> str:
        return {_POSITION: letter, _ROTATION: f"q{letter}"}.get(field, f"{field}_{letter}")

    def get(places: list[tuple[str, int]]) -> Callable[[Any], Any]:
        get_all = attrgetter(*(part + fields[field][0] + fields[field][1][i] for field, i in places))
        return get_all if len(places) > 1 else lambda message: (get_all(message),)

    signals = {name: tuple(column(name, letter) for letter in letters) for name, (_, letters, _) in fields.items()}
    return signals, {name: unit for name, (_, _, unit) in fields.items()}, get


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


def _in_order(recordings: list[tuple[NDArray[Any], NDArray[Any]]]) -> list[tuple[NDArray[Any], NDArray[Any]]]:
    """Samples by their stamps: drivers send some twice, and late ones; what is left out is told."""
    n_late = n_repeated = 0
    sorted_ = []
    for times, positions in recordings:
        if not (np.diff(times) > np.timedelta64(0)).all():
            order = np.argsort(times, kind="stable")
            repeated = np.r_[False, np.diff(times[order]) == np.timedelta64(0)]
            n_late, n_repeated = n_late + int((np.diff(order) < 0).sum()), n_repeated + int(repeated.sum())
            times, positions = times[order[~repeated]], positions[order[~repeated]]
        sorted_.append((times, positions))
    if n_late or n_repeated:
        checks.warn(
            f"{n_late} of {sum(len(times) for times, _ in recordings)} messages came after later ones, and are put in "
            f"order; {n_repeated} repeat the stamp of another one, of which the first is kept."
        )
    return sorted_

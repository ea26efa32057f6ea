"""A bag that is written is read by rosbags, and as demonstrations."""

import numpy as np
import pytest
from arm_tasks import made_schedule

from torch_pbd.robots.ros import to_bag, to_messages

highlevel = pytest.importorskip("rosbags.highlevel")


@pytest.fixture(scope="module")
def schedule():
    return made_schedule(duration=1.0, rate=50.0)


def test_a_bag_holds_the_schedule(schedule, tmp_path):
    to_bag(schedule, tmp_path / "bag")
    with highlevel.AnyReader([tmp_path / "bag"]) as reader:
        found = {topic: [] for topic in reader.topics}
        for connection, stamp, raw in reader.messages():
            found[connection.topic].append((stamp, reader.deserialize(raw, connection.msgtype)))
    assert {topic: len(messages) for topic, messages in found.items()} == dict.fromkeys(
        ("/target_pose", "/target_twist", "/target_stiffness", "/target_damping"), len(schedule)
    )
    for row, (stamp, message) in enumerate(found["/target_pose"]):
        place, turn, when = message.pose.position, message.pose.orientation, message.header.stamp
        np.testing.assert_array_equal([place.x, place.y, place.z], schedule.position[row])
        np.testing.assert_array_equal([turn.w, turn.x, turn.y, turn.z], schedule.orientation[row])
        assert 1e-9 * stamp == pytest.approx(schedule.time[row], abs=1e-9)
        assert when.sec * 10**9 + when.nanosec == stamp
        assert message.header.frame_id == "base"
    twist = found["/target_twist"][20][1].twist
    np.testing.assert_array_equal(
        [getattr(part, axis) for part in (twist.linear, twist.angular) for axis in "xyz"], schedule.velocity[20]
    )
    for name in ("stiffness", "damping"):
        message = found[f"/target_{name}"][20][1]
        assert [(part.label, part.size, part.stride) for part in message.layout.dim] == [
            ("rows", 6, 36),
            ("columns", 6, 6),
        ]
        np.testing.assert_array_equal(message.data.reshape(6, 6), getattr(schedule, name)[20])


def test_six_numbers_are_told_with_their_loss(schedule):
    with pytest.warns(UserWarning, match="displacements under a force or a torque are off by up to"):
        messages = list(to_messages(schedule, gains="diagonal"))
    topic, _, message = messages[4 * 30 + 2]
    assert topic == "target_stiffness"
    assert [(part.label, part.size, part.stride) for part in message.layout.dim] == [("rows", 6, 6)]
    np.testing.assert_array_equal(message.data, np.diagonal(schedule.stiffness[30]))


def test_a_bag_is_a_recording(schedule, tmp_path):
    from torch_pbd.data import load_demonstrations

    to_bag(schedule, tmp_path / "bag")
    recording = load_demonstrations(tmp_path / "bag", topic="/target_pose")
    np.testing.assert_allclose(recording.positions[0], schedule.position, rtol=1e-12, atol=0)


def test_what_is_there_is_not_written_over(schedule, tmp_path):
    with pytest.raises(FileExistsError, match="give a new folder"):
        to_bag(schedule, tmp_path)

"""Files of other makers: each layout written by its own library, read back equal, and its traps."""

import json
import os
import pickle
import sys
from pathlib import Path
from typing import NamedTuple

import h5py
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import scipy.io
import zarr
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from torch_pbd.data import Demonstrations, load_demonstrations
from torch_pbd.exceptions import DataFormatError

RATE = 20.0
LENGTHS = [5, 7, 4, 6, 5, 5, 6, 4, 7, 5, 6, 5]  # twelve: the last three come after the tenth
RANDOM = np.random.default_rng(0)
PATHS = [np.cumsum(RANDOM.normal(size=(n, 3)), axis=0) for n in LENGTHS]
# x y z w, within a turn that three numbers hold.
TURNS = [np.array([0.0, 0.0, 0.0, 4.0]) + 0.5 * RANDOM.normal(size=(n, 4)) for n in LENGTHS]
TURNS = [q / np.linalg.norm(q, axis=1, keepdims=True) for q in TURNS]
TIMES = [np.arange(n) / RATE for n in LENGTHS]


def wanted(names=("x", "y", "z"), **labels):
    return Demonstrations(TIMES, PATHS, names=names, **labels)


# Tables


def test_parquet_is_a_long_table(tmp_path):
    recorded = wanted()
    pq.write_table(recorded.to_frame("pyarrow"), tmp_path / "set.parquet", row_group_size=7)
    assert load_demonstrations(tmp_path / "set.parquet") == recorded
    table = recorded.to_frame().rename(columns={"demo": "trial"})
    table.index = RANDOM.permutation(len(table))  # as of a selection of rows; an index of all is not in the file
    table.to_parquet(tmp_path / "indexed.parquet")
    with pytest.raises(DataFormatError, match=r"column 6 has no name.*outputs= which of \[trial, x, y, z\]"):
        load_demonstrations(tmp_path / "indexed.parquet")
    assert load_demonstrations(tmp_path / "indexed.parquet", demo="trial", outputs=["x", "y", "z"]) == recorded
    with pytest.raises(DataFormatError, match="max_bytes=1000"):
        load_demonstrations(tmp_path / "set.parquet", max_bytes=1000)
    for kind in (pa.list_(pa.float64()), pa.list_(pa.float32(), 3)):
        lists = pa.table({"time": TIMES[0], "pos": pa.array(np.float32(PATHS[0]).tolist(), kind)})
        pq.write_table(lists, tmp_path / "lists.parquet")
        made = load_demonstrations(tmp_path / "lists.parquet")
        assert made == Demonstrations(TIMES[0], [np.float32(PATHS[0])], names=["pos_x", "pos_y", "pos_z"])


def write_lerobot(folder, version):
    """As LeRobot's recorder does: chunks of files, stamps in float32, fixed-size lists, names of motors."""
    frames = [
        {
            "action": list(path + 1),
            "observation.state": list(path),
            "timestamp": t,
            "frame_index": i,
            "episode_index": k,
            "index": sum(LENGTHS[:k]) + i,
            "task_index": 0,
        }
        for k in range(12)
        for i, (t, path) in enumerate(zip(TIMES[k].astype(np.float32), PATHS[k], strict=True))
    ]
    vector = pa.list_(pa.float64(), 3)
    types = {"action": vector, "observation.state": vector, "timestamp": pa.float32()}
    schema = pa.schema([(name, types.get(name, pa.int64())) for name in frames[0]])
    names = ["x", "y", "z"] if version == "v3.0" else {"motors": ["x", "y", "z"]}
    features = {n: {"dtype": "float32", "shape": [3], "names": names} for n in ("action", "observation.state")}
    features |= {n: {"dtype": "int64", "shape": [1], "names": None} for n in list(frames[0])[3:]}
    features["timestamp"] = {"dtype": "float32", "shape": [1], "names": None}
    features["observation.images.top"] = {"dtype": "video", "shape": [480, 640, 3], "names": ["h", "w", "c"]}
    meta = folder / "meta"
    (folder / "data" / "chunk-000").mkdir(parents=True)
    meta.mkdir()
    info = {"codebase_version": version, "fps": 20, "features": features, "total_episodes": 12}
    (meta / "info.json").write_text(json.dumps(info))
    if version == "v3.0":
        for i, episodes in enumerate(np.split(np.arange(12), [5, 11])):
            rows = [frame for frame in frames if frame["episode_index"] in episodes]
            pq.write_table(pa.Table.from_pylist(rows, schema), folder / f"data/chunk-000/file-{i:03d}.parquet")
        (meta / "episodes" / "chunk-000").mkdir(parents=True)
        episodes = pa.table({"episode_index": range(12), "length": LENGTHS})
        pq.write_table(episodes, meta / "episodes/chunk-000/file-000.parquet")
    else:
        for k in range(12):
            rows = [frame for frame in frames if frame["episode_index"] == k]
            pq.write_table(pa.Table.from_pylist(rows, schema), folder / f"data/chunk-000/episode_{k:06d}.parquet")
        lines = [json.dumps({"episode_index": k, "tasks": ["pick"], "length": n}) for k, n in enumerate(LENGTHS)]
        (meta / "episodes.jsonl").write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize("version", ["v3.0", "v2.1"])
def test_lerobot_folders(tmp_path, version):
    write_lerobot(tmp_path, version)
    with pytest.raises(
        DataFormatError, match=r"does not tell the units of \[observation\.state\.x.*units=.*-100 to 100"
    ):
        load_demonstrations(tmp_path)
    state = load_demonstrations(tmp_path, units="deg")
    assert state.names == ("observation.state.x", "observation.state.y", "observation.state.z")
    assert state.n_steps == tuple(LENGTHS)
    for k in range(12):
        np.testing.assert_array_equal(state[k].position, PATHS[k])
        np.testing.assert_array_equal(state[k].time, TIMES[k].astype(np.float32))
    even = load_demonstrations(tmp_path, outputs=["action"], rate=RATE, units="percent")
    np.testing.assert_array_equal(even[11].position, PATHS[11] + 1)
    np.testing.assert_array_equal(even[11].time, TIMES[11])
    assert load_demonstrations(tmp_path, units="deg", outputs="action.y")[3].position[:, 0].tolist() == (
        (PATHS[3] + 1)[:, 1].tolist()
    )
    last = sorted((tmp_path / "data").rglob("*.parquet"))[-1]
    last.unlink()
    with pytest.raises(DataFormatError, match="episode 11 has 0 samples in data/, but 5 by meta/episodes: files are"):
        load_demonstrations(tmp_path, units="deg")


# Arrays


def write_robomimic(path, **skip):
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        data.attrs["total"] = sum(LENGTHS)
        data.attrs["env_args"] = json.dumps({"env_name": "Lift", "env_kwargs": {"control_freq": 20}})
        for k, (position, turn) in enumerate(zip(PATHS, TURNS, strict=True)):
            demo = data.create_group(f"demo_{k}")
            demo.attrs["num_samples"] = len(position)
            demo["actions"] = np.tanh(position)
            demo["obs/robot0_eef_pos"] = position
            demo["obs/robot0_eef_quat"] = turn
            demo["obs/agentview_image"] = np.zeros((len(position), 4, 4, 3), dtype=np.uint8)
        file["mask/train"] = np.array([f"demo_{k}".encode() for k in (10, 2, 9)])


def test_robomimic_files(tmp_path):
    path = tmp_path / "lift.hdf5"
    write_robomimic(path)
    with pytest.raises(DataFormatError, match=r"no times: give rate=.*robosuite records 20"):
        load_demonstrations(path)
    names = [f"robot0_eef_pos_{letter}" for letter in "xyz"]
    assert load_demonstrations(path, rate=20) == wanted(names, units="m")  # demo_10 after demo_9
    assert load_demonstrations(path, rate=20, mask="train") == wanted(names, units="m")[[2, 9, 10]]
    actions = load_demonstrations(path, rate=20, outputs="actions")
    np.testing.assert_array_equal(actions[11].position, np.tanh(PATHS[11]))
    real = load_demonstrations(path, rate=20, outputs=["robot0_eef_quat_w"])  # x y z w: the real part is the last
    np.testing.assert_array_equal(real[4].position[:, 0], TURNS[4][:, 3])
    quaternion = [f"robot0_eef_quat_{letter}" for letter in "wxyz"]
    pose = load_demonstrations(path, rate=20, outputs="robot0_eef_pos", rotation=quaternion)
    assert pose.units == ("m", "m", "m", "rad", "rad", "rad")
    np.testing.assert_allclose(pose.to_poses()[1][4], np.roll(TURNS[4], 1, axis=1), atol=1e-14)
    with pytest.raises(DataFormatError, match=r"no column 'robot0_eef_vel' among \[actions_0"):
        load_demonstrations(path, rate=20, outputs="robot0_eef_vel")
    with pytest.raises(DataFormatError, match=r"mask is 'test', must be one of \[train\]"):
        load_demonstrations(path, rate=20, mask="test")
    with h5py.File(path, "a") as file:
        file["data/demo_3"].attrs["num_samples"] = 99
    with pytest.raises(DataFormatError, match="data/demo_3 says num_samples = 99, but robot0_eef_pos has 6"):
        load_demonstrations(path, rate=20)


@pytest.mark.parametrize("kind", ["folder", "zip"])
@pytest.mark.parametrize("version", [2, 3])
def test_replay_buffers_in_zarr(tmp_path, kind, version):
    path = tmp_path / ("replay_buffer.zarr" if kind == "folder" else "replay_buffer.zarr.zip")
    store = zarr.storage.LocalStore(path) if kind == "folder" else zarr.storage.ZipStore(path, mode="w")
    group = zarr.open_group(store, mode="w", zarr_format=version)
    group.create_array("data/robot0_eef_pos", data=np.vstack(PATHS), chunks=(8, 3))
    group.create_array("data/gripper_width", data=np.vstack(PATHS)[:, :1])
    group.create_array("data/camera0_rgb", data=np.zeros((sum(LENGTHS), 2, 2, 3), dtype=np.uint8))
    group.create_array("meta/episode_ends", data=np.cumsum(LENGTHS))
    store.close()
    names = [f"robot0_eef_pos_{letter}" for letter in "xyz"]
    loaded = load_demonstrations(path, rate=RATE, outputs="robot0_eef_pos")
    assert loaded == wanted(names)
    with pytest.raises(DataFormatError, match="no times: give rate="):
        load_demonstrations(path)


def test_zarr_that_is_no_replay_buffer_is_refused(tmp_path):
    group = zarr.open_group(tmp_path / "a.zarr", mode="w", zarr_format=2)
    group.create_array("data/x", data=np.arange(6.0))
    with pytest.raises(DataFormatError, match=r"no data and meta/episode_ends.*\[data\]"):
        load_demonstrations(tmp_path / "a.zarr", rate=1)
    group.create_array("meta/episode_ends", data=np.array([3, 7]))
    with pytest.raises(DataFormatError, match=r"episode_ends is \[3, 7\], must rise to 6"):
        load_demonstrations(tmp_path / "a.zarr", rate=1)


class Canary(NamedTuple):
    path: Path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


def test_nothing_in_zarr_is_executed(tmp_path):
    group = zarr.open_group(tmp_path / "a.zarr", mode="w", zarr_format=2)
    group.create_array("data/x", data=np.arange(6.0), compressors=None)
    group.create_array("meta/episode_ends", data=np.array([6]))
    file = tmp_path / "a.zarr/data/x/.zarray"
    content = json.loads(file.read_text())
    file.write_text(json.dumps(content | {"filters": [{"id": "pickle", "protocol": 5}]}))
    (tmp_path / "a.zarr/data/x/0").write_bytes(pickle.dumps(Canary(tmp_path / "executed")))
    with pytest.raises(DataFormatError, match=r"pickle"):
        load_demonstrations(tmp_path / "a.zarr", rate=1)
    assert not (tmp_path / "executed").exists()


def cells(values):
    """MATLAB's 1 x K cell array."""
    array = np.empty((1, len(values)), dtype=object)
    array[0, :] = values
    return array


def test_mat_files_of_lasa_the_letters_and_ds_opt(tmp_path):
    names = ["pos_x", "pos_y", "pos_z"]
    demos = [
        {"pos": p.T, "t": t[None], "vel": np.ones((3, len(t))), "dt": 0.05} for t, p in zip(TIMES, PATHS, strict=True)
    ]
    scipy.io.savemat(tmp_path / "lasa.mat", {"demos": cells(demos), "dt": 0.05, "name": "Angle"})
    assert load_demonstrations(tmp_path / "lasa.mat") == wanted(names)
    scipy.io.savemat(tmp_path / "letters.mat", {"demos": cells([{"pos": p.T} for p in PATHS])})
    with pytest.raises(DataFormatError, match="no times: give rate="):
        load_demonstrations(tmp_path / "letters.mat")
    assert load_demonstrations(tmp_path / "letters.mat", rate=RATE) == wanted(names)
    even = [np.linspace(0.0, 1.0, 4 * n) for n in LENGTHS]  # more samples than rows
    kuka = [
        np.vstack([np.sin(6.0 * t + np.arange(3)[:, None]), 6.0 * np.cos(6.0 * t + np.arange(3)[:, None])])
        for t in even
    ]
    scipy.io.savemat(tmp_path / "kuka.mat", {"data": cells(kuka), "dt": 0.01})
    loaded = load_demonstrations(tmp_path / "kuka.mat")
    assert loaded.names == tuple(names)
    np.testing.assert_array_equal(loaded[10].position, kuka[10][:3].T)
    np.testing.assert_array_equal(loaded[10].time, np.arange(4 * LENGTHS[10]) * 0.01)
    assert load_demonstrations(tmp_path / "kuka.mat", outputs="vel").names == ("vel_0", "vel_1", "vel_2")
    with pytest.raises(DataFormatError, match=r"no variable 'runs', but \[data, dt\]: say by variable="):
        load_demonstrations(tmp_path / "kuka.mat", variable="runs")
    one = {"runs": cells([p.T for p in PATHS])}
    scipy.io.savemat(tmp_path / "own.mat", one)
    with pytest.raises(DataFormatError, match="no variables demos or data"):
        load_demonstrations(tmp_path / "own.mat")


@pytest.mark.parametrize("variable", ["joints", "demos", "data"])
@pytest.mark.parametrize("n", [4, 6, 7])
def test_no_row_of_a_mat_file_is_taken_for_a_velocity(tmp_path, rng, variable, n):
    joints = [rng.normal(size=(n, 50)).cumsum(1) for _ in range(3)]
    joints[1] = joints[1].T  # (T, d)
    scipy.io.savemat(tmp_path / "joints.mat", {variable: cells(joints), "dt": 0.01})
    loaded = load_demonstrations(tmp_path / "joints.mat", variable=variable, units="rad")
    assert loaded.names == tuple(f"pos_{i}" for i in range(n))
    for read, joint in zip(loaded.positions, [joints[0], joints[1].T, joints[2]], strict=True):
        np.testing.assert_array_equal(read, joint.T)


def test_velocities_stay_outputs_in_variables_of_other_names(tmp_path):
    t = np.linspace(0.0, 1.0, 50)
    scipy.io.savemat(tmp_path / "runs.mat", {"runs": np.stack([np.sin(t), np.cos(t)]), "dt": 0.02})
    assert load_demonstrations(tmp_path / "runs.mat", variable="runs").n_outputs == 2


def test_arrays_of_other_widths_or_none_are_told(tmp_path):
    scipy.io.savemat(tmp_path / "set.mat", {"demos": cells([np.ones((3, 9)), np.ones((2, 9))]), "dt": 0.1})
    with pytest.raises(DataFormatError, match=r"set\.mat: array 'pos' of demonstration 1 has 2 columns, must have 3"):
        load_demonstrations(tmp_path / "set.mat")
    structs = [{"pos": np.ones((3, 9)), "t": np.arange(9.0)}, {"pos": np.ones((3, 9))}]
    scipy.io.savemat(tmp_path / "set.mat", {"demos": cells(structs)})
    with pytest.raises(DataFormatError, match="array 't' of demonstration 1 has 0 columns, must have 1"):
        load_demonstrations(tmp_path / "set.mat")


def test_mat_files_of_version_7_3(tmp_path):
    path = tmp_path / "lasa.mat"
    with h5py.File(path, "w", userblock_size=512) as file:
        references = np.empty((len(PATHS), 1), dtype=h5py.ref_dtype)
        for k, (time, position) in enumerate(zip(TIMES, PATHS, strict=True)):
            struct = file.create_group(f"#refs#/{k}")
            struct["pos"], struct["t"] = position, time[:, None]  # (d, T) and (1, T) in MATLAB's order of columns
            references[k, 0] = struct.ref
        demos = file.create_dataset("demos", data=references, dtype=h5py.ref_dtype)
        demos.attrs["MATLAB_class"] = np.bytes_("cell")
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM")
    assert load_demonstrations(path) == wanted(["pos_x", "pos_y", "pos_z"])


def test_arrays_of_laboratories(tmp_path):
    names = ["y0", "y1", "y2"]
    with_time = [np.column_stack([p, t]) for t, p in zip(TIMES, PATHS, strict=True)]  # time in the last column
    np.savez(tmp_path / "runs.npz", **{f"demo_{k}": a for k, a in enumerate(with_time)})
    assert load_demonstrations(tmp_path / "runs.npz", time="y3") == wanted(names)
    even = Demonstrations(TIMES[0], np.stack([PATHS[0], PATHS[4]]), names=names)
    np.save(tmp_path / "cube.npy", even.to_array())
    assert load_demonstrations(tmp_path / "cube.npy", rate=RATE) == even
    np.savez(tmp_path / "cube.npz", time=TIMES[0], pos=even.to_array(), load=np.ones((2, 5)), note=np.array("hi"))
    assert load_demonstrations(tmp_path / "cube.npz", outputs="pos").positions[1].tolist() == PATHS[4].tolist()
    np.savez(tmp_path / "one.npz", t=TIMES[0], ee=PATHS[0], grip=np.ones(5))
    one = load_demonstrations(tmp_path / "one.npz")
    assert one.names == ("ee_0", "ee_1", "ee_2", "grip")
    for names in ("time x y", "t x y", "t px py"):
        np.savez(tmp_path / "columns.npz", **dict(zip(names.split(), np.c_[TIMES[0], PATHS[0][:, :2]].T, strict=True)))
        columns = load_demonstrations(tmp_path / "columns.npz")
        assert columns == Demonstrations(TIMES[0], [PATHS[0][:, :2]], names=names.split()[1:])
    np.savez(tmp_path / "uneven.npz", t_0=[0, 1], x_0=np.ones((2, 2)), t_1=[0, 1], x_1=np.ones((2, 1)))
    with pytest.raises(DataFormatError, match=r"uneven\.npz: array 'x' of demonstration 1 has 1 columns, must have 2"):
        load_demonstrations(tmp_path / "uneven.npz")
    np.savez(tmp_path / "odd.npz", a=np.ones((4, 3)), b=np.ones((5, 2)))
    with pytest.raises(DataFormatError, match=r"fit no layout.*a \(4, 3\), b \(5, 2\)"):
        load_demonstrations(tmp_path / "odd.npz", rate=1)


def test_arrays_of_one_width_are_recordings_by_number_and_signals_by_name(tmp_path):
    first, other = PATHS[0], PATHS[0] + 1.0
    np.savez(tmp_path / "signals.npz", position=first, force=other)
    with pytest.raises(
        DataFormatError, match=r"recordings or signals of one: \[force \(5, 3\), position \(5, 3\)\]: call"
    ):
        load_demonstrations(tmp_path / "signals.npz", rate=RATE)
    one = load_demonstrations(tmp_path / "signals.npz", rate=RATE, outputs="position")
    assert one == Demonstrations([np.arange(5) / RATE], [first], names=[f"position_{i}" for i in range(3)])
    for name, options in (("time", {}), ("stamp", {"time": "stamp"})):
        np.savez(tmp_path / "runs.npz", demo_0=first, demo_1=other, **{name: TIMES[0]})
        assert load_demonstrations(tmp_path / "runs.npz", **options) == Demonstrations(TIMES[0], [first, other])
    arms = {"arm0_pos": first, "arm1_pos": other}
    np.savez(tmp_path / "arms.npz", **arms, time=TIMES[0])
    both = load_demonstrations(tmp_path / "arms.npz", outputs=[*arms])
    names = [f"{name}_{i}" for name in arms for i in range(3)]
    assert both == Demonstrations(TIMES[0], [np.c_[first, other]], names=names)
    np.savez(tmp_path / "uneven.npz", alice=first, bob=other[:-1])
    assert load_demonstrations(tmp_path / "uneven.npz", rate=RATE).n_steps == (5, 4)


# ROS


STORES = {1: get_typestore(Stores.ROS1_NOETIC), 2: get_typestore(Stores.ROS2_HUMBLE)}
# ROS 1 has it in a package of its own, which the store lacks.
STORES[1].register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf/msg/tfMessage"))
START = 1_700_000_000_123_456_789
NS = [START + round(t * 1e9) for t in TIMES[0]]


def messages(version, kind, stamps=NS, position=PATHS[0], turns=TURNS[0]):
    """Messages as drivers send them, by their topic's kind."""
    types = STORES[version].types

    def make(name, *values):
        return types[f"{name.split('/')[0]}/msg/{name.split('/')[1]}"](*values)

    for i, stamp in enumerate(stamps):
        time = make("builtin_interfaces/Time", stamp // 10**9, stamp % 10**9)
        header = make("std_msgs/Header", *((i,) if version == 1 else ()), time, "base_link")
        x, y, z = map(float, position[i])
        if kind == "PoseStamped":
            turn = make("geometry_msgs/Quaternion", *map(float, turns[i]))
            pose = make("geometry_msgs/Pose", make("geometry_msgs/Point", x, y, z), turn)
            yield make("geometry_msgs/PoseStamped", header, pose)
        elif kind == "WrenchStamped":
            force = make("geometry_msgs/Vector3", x, y, z)
            yield make("geometry_msgs/WrenchStamped", header, make("geometry_msgs/Wrench", force, force))
        elif kind == "JointState":
            none = np.zeros(0)
            yield make("sensor_msgs/JointState", header, ["j1", "j2", "j3"], np.array([x, y, z]), none, none)
        elif kind == "TFMessage":
            turn = make("geometry_msgs/Quaternion", 0.0, 0.0, 0.0, 1.0)
            moved, still = (make("geometry_msgs/Vector3", *v) for v in ((x, y, z), (0.0, 0.0, 0.0)))
            pairs = [("tool0", moved), ("camera", still)]
            made = [make("geometry_msgs/Transform", vector, turn) for _, vector in pairs]
            yield make(
                "tf/tfMessage" if version == 1 else "tf2_msgs/TFMessage",
                [
                    make("geometry_msgs/TransformStamped", header, child, transform)
                    for (child, _), transform in zip(pairs, made, strict=True)
                ],
            )
        else:
            yield make("std_msgs/String", "hello")


PACKAGES = {"JointState": "sensor_msgs", "TFMessage": "tf2_msgs", "String": "std_msgs"}


def write_bag(path, store, kinds, marks=(None, {}), **changes):
    version = 1 if store == "ros1" else 2
    storage = {"sqlite3": rosbag2.StoragePlugin.SQLITE3, "mcap": rosbag2.StoragePlugin.MCAP}
    writer = rosbag1.Writer(path) if version == 1 else rosbag2.Writer(path, version=9, storage_plugin=storage[store])
    with writer:
        for kind in kinds:
            name = f"{PACKAGES.get(kind, 'geometry_msgs')}/msg/{kind}"
            name = "tf/msg/tfMessage" if (kind, version) == ("TFMessage", 1) else name
            connection = writer.add_connection(f"/{kind.lower()}", name, typestore=STORES[version])
            serialize = STORES[version].serialize_ros1 if version == 1 else STORES[version].serialize_cdr
            for i, message in enumerate(messages(version, kind, **changes)):
                writer.write(connection, START + 10**9 + 2 * i, bytes(serialize(message, name)))  # a second later
        if marks[0]:
            name = f"std_msgs/msg/{marks[0]}"
            connection = writer.add_connection("/is", name, typestore=STORES[version])
            for i, value in marks[1].items():
                mark = STORES[version].types[name](value)
                writer.write(connection, START + 10**9 + 2 * i - 1, bytes(serialize(mark, name)))


BAGS = ["ros1", "sqlite3", "mcap"]
UNITS = {"PoseStamped": "m", "WrenchStamped": "N", "JointState": "rad", "TFMessage": "m"}
OUTPUTS = {"WrenchStamped": ("force_x", "force_y", "force_z"), "JointState": ("j1", "j2", "j3")}


def bag_path(tmp_path, store):
    return tmp_path / ("run.bag" if store == "ros1" else "run")


@pytest.mark.parametrize("store", BAGS)
@pytest.mark.parametrize("kind", UNITS)
def test_bags_of_ros(tmp_path, store, kind):
    path = bag_path(tmp_path, store)
    write_bag(path, store, [kind, "String"])
    options = {"child": "tool0"} if kind == "TFMessage" else {}
    loaded = load_demonstrations(path, **options)
    assert loaded.names == OUTPUTS.get(kind, ("x", "y", "z"))
    assert loaded.units == (UNITS[kind],) * 3
    assert (loaded.time_unit, loaded.frame) == ("s", "base_link")
    np.testing.assert_array_equal(loaded[0].position, PATHS[0])
    np.testing.assert_allclose(loaded[0].time, TIMES[0], atol=1e-15)
    if store == "mcap":
        assert load_demonstrations(next(path.glob("*.mcap")), **options) == loaded
    if kind == "TFMessage":
        with pytest.raises(DataFormatError, match=r"of frames camera, tool0: name one by child="):
            load_demonstrations(path)
        with pytest.raises(DataFormatError, match=r"no transforms of 'tool1', but of camera, tool0"):
            load_demonstrations(path, child="tool1")
    if kind == "PoseStamped":  # x y z w: the real part is the last
        turn = load_demonstrations(path, outputs=["qw", "x"])
        np.testing.assert_array_equal(turn[0].position[:, 0], TURNS[0][:, 3])
        pose = load_demonstrations(path, rotation=["qw", "qx", "qy", "qz"])
        assert (pose.names, pose.units) == (("x", "y", "z", "rx", "ry", "rz"), ("m",) * 3 + ("rad",) * 3)
        np.testing.assert_allclose(pose.to_poses()[1][0], np.roll(TURNS[0], 1, axis=1), atol=1e-14)
        assert turn.units == ("1", "m")


def test_topics_are_chosen_by_name(tmp_path):
    write_bag(tmp_path / "two", "mcap", ["PoseStamped", "WrenchStamped"])
    with pytest.raises(DataFormatError, match=r"several topics of movements: say which by topic=.*/posestamped \(geom"):
        load_demonstrations(tmp_path / "two")
    assert load_demonstrations(tmp_path / "two", topic="/wrenchstamped").names == OUTPUTS["WrenchStamped"]
    with pytest.raises(DataFormatError, match=r"no topic '/pose'; it has: /posestamped"):
        load_demonstrations(tmp_path / "two", topic="/pose")
    write_bag(tmp_path / "none", "sqlite3", ["String"])
    with pytest.raises(DataFormatError, match=r"no topic of poses.*/string \(std_msgs/msg/String, 5 messages\)"):
        load_demonstrations(tmp_path / "none")
    assert len(load_demonstrations(str(tmp_path / "tw*"), topic="/posestamped")) == 1


def test_stamps_that_repeat_or_come_late_are_put_right_and_told(tmp_path):
    stamps = [NS[0], NS[1], NS[1], NS[3], NS[2]]
    write_bag(tmp_path / "run", "mcap", ["PoseStamped"], stamps=stamps)
    with pytest.warns(UserWarning, match=r"1 of 5 messages came after later ones.*1 repeat the stamp"):
        loaded = load_demonstrations(tmp_path / "run")
    np.testing.assert_array_equal(loaded[0].position, PATHS[0][[0, 1, 4, 3]])


def write_marked(path, store, kind, marks, n=20):
    """A bag of ``n`` poses at 10 Hz; before pose i a second topic says marks[i]."""
    stamps, places = [START + i * 10**8 for i in range(n)], np.column_stack([np.arange(n) ** 2, np.zeros((n, 2))])
    write_bag(path, store, ["PoseStamped"], (kind, marks), stamps=stamps, position=places, turns=np.eye(4)[[3] * n])


@pytest.mark.parametrize("store", BAGS)
@pytest.mark.parametrize(
    ("kind", "marks", "spans"),
    [
        ("Bool", {0: False, 3: True, 7: False, 9: False, 12: True, 15: False}, [(3, 7), (12, 15)]),
        ("UInt8", {2: 0, 3: 1, 7: 0, 12: 1}, [(3, 7), (12, 20)]),  # a flag: it comes back to zero
        ("Int32", {2: 0, 7: 1, 9: 1, 12: 2}, [(2, 7), (7, 12), (12, 20)]),  # a count: it does not
        ("String", {1: "a", 5: "", 8: "a", 12: "b"}, [(1, 5), (8, 12), (12, 20)]),
    ],
)
def test_a_second_topic_cuts_a_bag_into_demonstrations(tmp_path, store, kind, marks, spans):
    path = bag_path(tmp_path, store)
    write_marked(path, store, kind, marks)
    cut = load_demonstrations(path, demo="/is", outputs="x")
    assert [[*y[:, 0]] for y in cut.positions] == [[i**2 for i in range(*span)] for span in spans]
    for time, (first, last) in zip(cut.times, spans, strict=True):
        np.testing.assert_allclose(time, np.arange(first - spans[0][0], last - spans[0][0]) / 10, atol=1e-12)


def test_what_a_topic_cannot_cut_is_told(tmp_path):
    write_marked(tmp_path / "run", "mcap", "Bool", {0: False, 3: True, 4: False, 9: True})
    with pytest.raises(DataFormatError, match=r"topic '/cut', by which demo= .* it has: /is \(std_msgs.*, /pose"):
        load_demonstrations(tmp_path / "run", demo="/cut")
    with pytest.raises(DataFormatError, match=r"'/posestamped'.* is of geometry_msgs/msg/PoseStamped, must be of Bool"):
        load_demonstrations(tmp_path / "run", demo="/posestamped")
    with pytest.warns(UserWarning, match=r"less than two messages.*: 1 of 2 demonstrations by '/is'"):
        assert load_demonstrations(tmp_path / "run", demo="/is", outputs="x").n_steps == (11,)
    write_marked(tmp_path / "off", "mcap", "Bool", {0: False})
    with pytest.raises(DataFormatError, match=r"demo='/is' marks no demonstration: its values are \[False\]"):
        load_demonstrations(tmp_path / "off", demo="/is")


# Extras


@pytest.mark.parametrize(
    ("name", "module", "command"),
    [
        ("a.parquet", "pyarrow", r"pip install 'torch_pbd\[parquet\]'"),
        ("a.hdf5", "h5py", r"pip install 'torch_pbd\[hdf5\]'"),
        ("a.zip", "zarr", r"pip install 'torch_pbd\[zarr\]'"),
        ("a.mcap", "rosbags", r"pip install 'torch_pbd\[ros\]'"),
    ],
)
def test_a_missing_extra_is_told_with_its_command(tmp_path, monkeypatch, name, module, command):
    (tmp_path / name).write_bytes(b"\x00" * 100)
    for loaded in [n for n in sys.modules if n.split(".")[0] == module]:
        monkeypatch.delitem(sys.modules, loaded)
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ModuleNotFoundError, match=f"{module}, which is not installed: {command}"):
        load_demonstrations(tmp_path / name)


def test_a_table_of_a_frame_is_what_its_files_are(tmp_path):
    recorded = wanted()
    recorded.to_frame().to_csv(tmp_path / "set.csv", index=False)
    assert load_demonstrations(tmp_path / "set.csv") == Demonstrations.from_frame(pd.read_csv(tmp_path / "set.csv"))

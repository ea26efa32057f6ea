"""From a file of any kind to a schedule in two lines, in m and s: as from the demonstrations that were written."""

import functools
import json

import h5py
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import scipy.io
import test_formats
from test_formats import cells, write_bag

from torch_pbd import DMPController, GMMBaseline
from torch_pbd.data import Demonstrations, load_demonstrations, make_tunnel_demonstrations

RATE = 25.0


@functools.cache
def recorded():
    return make_tunnel_demonstrations(4, duration=4.0, rate=RATE, random_state=0)


def schedule(demonstrations):
    return DMPController(covariance=GMMBaseline(n_components=2)).fit(demonstrations).schedule(100.0)


@functools.cache
def truth():
    return schedule(recorded())


def ros_csv(folder):
    parts = [
        pd.DataFrame({"stamp": time + 1.7e9 + 60 * k, "run": k, "px": y[:, 0], "py": y[:, 1]})
        for k, (time, y) in enumerate(recorded())
    ]
    pd.concat(parts).to_csv(folder / "ros.csv")  # with its index
    names = {"demo": "run", "time": "stamp", "outputs": ["px", "py"]}
    return load_demonstrations(folder / "ros.csv", **names, units="m", from_start=True)


def mocap_csv(folder):
    lines = ["Trial;Time;X;Y"]
    for k, (time, y) in enumerate(recorded()):
        lines += [
            f"{k};{t * 1e3:.4f};{a:.6f};{b:.6f}".replace(".", ",") for t, (a, b) in zip(time, y * 1e3, strict=True)
        ]
    (folder / "mocap.csv").write_text("\n".join(lines))
    return load_demonstrations(folder / "mocap.csv", demo="Trial", time="Time", decimal=",", units="mm", time_unit="ms")


def frame(folder):
    return Demonstrations.from_frame(recorded().to_frame(), units="m")


def lerobot(folder):
    rows = [
        {"observation.state": list(y), "timestamp": np.float32(t), "frame_index": i, "episode_index": k, "index": 0}
        for k, own in enumerate(recorded())
        for i, (t, y) in enumerate(zip(*own, strict=True))
    ]
    types = {"observation.state": pa.list_(pa.float32(), 2), "timestamp": pa.float32()}
    schema = pa.schema([(name, types.get(name, pa.int64())) for name in rows[0]])
    (folder / "data" / "chunk-000").mkdir(parents=True)
    (folder / "meta").mkdir()
    pq.write_table(pa.Table.from_pylist(rows, schema), folder / "data/chunk-000/file-000.parquet")
    features = {name: {"dtype": "float32", "shape": [1 + (name[0] == "o")], "names": None} for name in rows[0]}
    info = {"codebase_version": "v3.0", "fps": RATE, "features": features}
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    return load_demonstrations(folder, units="m", rate=RATE)


def robomimic(folder):
    with h5py.File(folder / "demo.hdf5", "w") as file:
        for k, position in enumerate(recorded().positions):
            file[f"data/demo_{k}/obs/robot0_eef_pos"] = position
    return load_demonstrations(folder / "demo.hdf5", rate=RATE)


def bag(folder):
    for k, (time, position) in enumerate(recorded()):
        stamps = [test_formats.START + round(60e9 * k + t * 1e9) for t in time]
        poses = {"position": np.column_stack([position, 0 * time]), "turns": np.eye(4)[[3] * len(time)]}
        write_bag(folder / f"run_{k}", "mcap", ["PoseStamped"], stamps=stamps, **poses)
    return load_demonstrations(folder / "run_*", outputs=["x", "y"])


def mat(folder):
    scipy.io.savemat(folder / "set.mat", {"demos": cells([{"pos": y.T, "t": t[None]} for t, y in recorded()])})
    return load_demonstrations(folder / "set.mat", units="m")


@pytest.mark.parametrize(
    "kind", [ros_csv, mocap_csv, frame, lerobot, robomimic, bag, mat], ids=lambda kind: kind.__name__
)
def test_two_lines_from_a_file_to_a_schedule_in_metres_and_seconds(kind, tmp_path):
    made = schedule(kind(tmp_path))
    # Text has nine digits, LeRobot's numbers are float32, stamps of 1970 resolve 2.4e-7 s.
    np.testing.assert_allclose(made.time, truth().time, atol=1e-6)
    np.testing.assert_allclose(made.position, truth().position, atol=1e-5)
    np.testing.assert_allclose(made.stiffness, truth().stiffness, rtol=0.02, atol=2.0)

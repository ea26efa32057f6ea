"""Time and memory of reading a million rows of CSV, Parquet, and MCAP by ``load_demonstrations``.

``python scripts/benchmarks/reading.py`` makes each file once, in ``--folder``, and reads it in a process of its own.
Memory is the most that the process held above what it held with everything imported and a small file of the kind read,
over the bytes of the numbers that come back, in float64. The files have times, x, y, z, and but for MCAP, which has
one recording of poses, a column that tells ten recordings apart.
"""

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from torch_pbd.data import Demonstrations, load_demonstrations, save_demonstrations

BARS = {"csv": 3.0, "parquet": 1.0, "mcap": 10.0}  # s of a machine that does nothing else
MOST_MEMORY = 4.0  # times the numbers
N_RECORDINGS = 10


def run() -> int:
    """Print a table; the exit code is the number of kinds that take more memory than the bar."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", type=int, default=1_000_000)
    parser.add_argument("--kinds", nargs="+", choices=BARS, default=list(BARS))
    parser.add_argument("--folder", type=Path, help="where the files are left for another run; None leaves none")
    options = parser.parse_args()
    failed = 0
    print("kind       MB  wall [s]  CPU [s]  bar [s]  memory / numbers  bar")
    with tempfile.TemporaryDirectory() as temporary:
        folder = (options.folder or Path(temporary)).absolute()  # the process that reads has another directory
        folder.mkdir(exist_ok=True, parents=True)
        for kind in options.kinds:
            files = [folder / f"{n}.{kind}" for n in (1000, options.rows)]
            for file in files:
                if not file.exists():
                    write(file, int(file.stem))
            command = [sys.executable, "-c", f"import reading; reading.measure({list(map(str, files))!r})"]
            found = json.loads(subprocess.check_output(command, cwd=Path(__file__).parent))
            failed += found["memory"] > MOST_MEMORY
            print(
                f"{kind:<7} {files[1].stat().st_size / 1e6:5.0f} {found['wall']:9.2f} {found['cpu']:8.2f} "
                f"{BARS[kind]:8.0f} {found['memory']:17.2f} {MOST_MEMORY:4.0f}",
                flush=True,
            )
    return failed


def write(file: Path, n_rows: int) -> None:
    """A file of its kind with random walks in m."""
    positions = np.cumsum(np.random.default_rng(0).normal(scale=1e-3, size=(n_rows, 3)), axis=0)
    if file.suffix == ".mcap":
        _write_mcap(file, positions)
        return
    each = positions.reshape(N_RECORDINGS, -1, 3)
    made = Demonstrations(np.arange(each.shape[1]) / 1000, each, names=["x", "y", "z"])
    if file.suffix == ".csv":
        save_demonstrations(made, file)
    else:
        import pyarrow.parquet

        pyarrow.parquet.write_table(made.to_frame("pyarrow"), file)


def _write_mcap(file: Path, positions: np.ndarray) -> None:
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    names = ("geometry_msgs/PoseStamped", "geometry_msgs/Pose", "geometry_msgs/Point", "geometry_msgs/Quaternion")
    stamped, pose, point, quaternion = (store.types[name.replace("/", "/msg/")] for name in names)
    header, stamp = store.types["std_msgs/msg/Header"], store.types["builtin_interfaces/msg/Time"]
    turn = quaternion(0.0, 0.0, 0.0, 1.0)
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / "bag"
        with Writer(bag, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            kind = stamped.__msgtype__
            topic = writer.add_connection("/pose", kind, typestore=store)
            for i, position in enumerate(positions.tolist()):
                now = i * 10**6
                message = stamped(header(stamp(now // 10**9, now % 10**9), "base"), pose(point(*position), turn))
                writer.write(topic, now, store.serialize_cdr(message, kind))
        next(bag.glob("*.mcap")).rename(file)


def measure(files: list[str]) -> None:
    """Print what reading the second file takes, in JSON; the first one is small."""
    small, large = map(Path, files)
    load_demonstrations(small)
    Path("/proc/self/clear_refs").write_text("5")  # the most held from now on
    before, start, used = _status("VmRSS"), time.perf_counter(), _cpu()
    loaded = load_demonstrations(large)
    wall, cpu, most = time.perf_counter() - start, _cpu() - used, _status("VmHWM")
    numbers = sum(array.nbytes for array in (*loaded.times, *loaded.positions))
    print(json.dumps({"wall": wall, "cpu": cpu, "memory": (most - before) / numbers}))


def _status(name: str) -> int:
    """Bytes of a line of the process's status, as Linux tells it."""
    lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
    return 1024 * next(int(line.split()[1]) for line in lines if line.startswith(name))


def _cpu() -> float:
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


if __name__ == "__main__":
    sys.exit(run())

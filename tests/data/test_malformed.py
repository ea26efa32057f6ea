"""Files that are cut, flipped, emptied or swapped, of every kind: our error or sound numbers, and no more memory."""

import faulthandler
import json
import resource
import shutil
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import scipy.io
import zarr
from test_formats import PATHS, TIMES, cells, wanted, write_bag, write_lerobot, write_robomimic

from torch_pbd.data import load_demonstrations, save_demonstrations
from torch_pbd.exceptions import DataFormatError

OPTIONS = {
    "lerobot": {"units": "deg"},
    "a.hdf5": {"rate": 20.0},
    "a.npy": {"rate": 20.0},
    "a.zarr": {"rate": 20.0},
    "a.zip": {"rate": 20.0},
}
KINDS = [
    *("a.csv", "a.npz", "a.npy", "a.parquet", "a.mat", "a.bag", "a.hdf5", "a.zip"),
    *("a.zarr", "lerobot", "mcap", "sqlite3"),
]
SPARE = 400 * 2**20  # bytes of addresses; libraries map their buffers and threads


def write(folder, name):
    """A sound recording of a kind, of about ten kilobytes."""
    path = folder / name
    if name in ("a.csv", "a.npz"):
        save_demonstrations(wanted(), path)
    elif name == "a.npy":
        np.save(path, np.stack([PATHS[0], PATHS[4]]))
    elif name == "a.parquet":
        pq.write_table(wanted().to_frame("pyarrow"), path)
    elif name == "a.mat":
        demos = [{"pos": p.T, "t": t[None]} for t, p in zip(TIMES, PATHS, strict=True)]
        scipy.io.savemat(path, {"demos": cells(demos), "dt": 0.05}, do_compression=True)
    elif name == "a.hdf5":
        write_robomimic(path)
    elif name in ("a.zarr", "a.zip"):
        store = zarr.storage.LocalStore(path) if name == "a.zarr" else zarr.storage.ZipStore(path, mode="w")
        group = zarr.open_group(store, mode="w", zarr_format=2)
        group.create_array("data/x", data=np.vstack(PATHS))
        group.create_array("meta/episode_ends", data=np.cumsum([len(p) for p in PATHS]))
        store.close()
    elif name == "lerobot":
        path.mkdir()
        write_lerobot(path, "v3.0")
    else:
        write_bag(path, "ros1" if name == "a.bag" else name, ["PoseStamped"])
    return path


def malform(path, random):
    """One file of the recording, damaged; how."""
    files = sorted(file for file in path.rglob("*") if file.is_file()) if path.is_dir() else [path]
    file = files[random.integers(len(files))]
    content = bytearray(file.read_bytes())
    how = str(random.choice(["cut", "flip", "flip", "numbers", "zeros", "empty", "noise", "swap", "double"]))
    place = int(random.integers(max(len(content), 1)))
    if how == "cut":
        content = content[:place]
    elif how == "flip" and content:
        for at in random.integers(len(content), size=random.integers(1, 4)):
            content[at] ^= 1 << random.integers(8)
    elif how == "numbers":  # as of a size that is declared
        content[place : place + 8] = random.choice(
            [b"\xff" * 8, b"\xff" * 7 + b"\x7f", b"\x00\x00\x00\x00\x7f\x00\x00\x00"]
        )
    elif how == "zeros":
        content[place : place + 200] = bytes(200)
    elif how == "noise":
        content = bytearray(random.bytes(len(content)))
    elif how == "swap":
        content = bytearray(files[random.integers(len(files))].read_bytes()[::-1])
    elif how == "double":
        content = content + content
    file.write_bytes(b"" if how == "empty" else bytes(content))
    return f"{how} {file.relative_to(path.parent)}"


def attempt(folder, first, last):
    """Damage and read recordings, with little memory; prints what is neither sound nor our error."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        folder.mkdir(exist_ok=True)
        for name in KINDS:
            load_demonstrations(write(folder, name), **OPTIONS.get(name, {}))  # imports what is needed
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + SPARE, resource.RLIM_INFINITY))
        refused = 0
        for number in range(first, last):
            name, random = KINDS[number % len(KINDS)], np.random.default_rng(number)
            copy = folder / "copy" / name
            shutil.rmtree(folder / "copy", ignore_errors=True)
            (shutil.copytree if (folder / name).is_dir() else _copy_file)(folder / name, copy)
            how = malform(copy, random)
            print("trying", number, name, how, flush=True)  # the last line is the culprit of a crash
            faulthandler.dump_traceback_later(60, exit=True)  # a reader that never ends
            try:
                loaded = load_demonstrations(copy, **OPTIONS.get(name, {}))
                assert all(np.isfinite(position).all() for position in loaded.positions)
            except (DataFormatError, FileNotFoundError):  # the file by which a folder is known may be gone
                refused += 1
            except Exception as error:
                print("WRONG", number, name, how, repr(error), flush=True)
    print("refused", refused, "of", last - first)


def _copy_file(source, target):
    target.parent.mkdir(parents=True)
    shutil.copy(source, target)


@pytest.mark.parametrize(
    ("first", "last"), [(0, 48), pytest.param(48, 548, marks=pytest.mark.slow)], ids=["some", "many"]
)
def test_malformed_recordings_are_refused_or_sound(tmp_path, first, last):
    program = f"import pathlib, test_malformed as t; t.attempt(pathlib.Path({str(tmp_path)!r}), {first}, {last})"
    command = [sys.executable, "-X", "faulthandler", "-c", program]
    done = subprocess.run(command, capture_output=True, text=True, cwd=Path(__file__).parent, timeout=900, check=False)
    assert done.returncode == 0, f"{done.stdout[-300:]}\n{done.stderr[-3000:]}"
    assert not [line for line in done.stdout.splitlines() if line.startswith("WRONG")]
    refused = int(done.stdout.splitlines()[-1].split()[1])
    assert refused > 0.3 * (last - first)


def test_huge_declared_sizes_take_no_memory(tmp_path):
    path = write(tmp_path, "a.zarr")
    file = path / "data/x/.zarray"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"shape": [10**12, 3]}))
    with pytest.raises(DataFormatError, match=r"data/x unpacks to 24000000000000 bytes, more than max_bytes"):
        load_demonstrations(path, rate=20)
    import h5py

    with h5py.File(tmp_path / "b.hdf5", "w") as h5:
        h5.create_dataset("data/demo_0/obs/robot0_eef_pos", shape=(10**12, 3), chunks=(100, 3), dtype="f8")
    with pytest.raises(DataFormatError, match="was never written"):
        load_demonstrations(tmp_path / "b.hdf5", rate=20)
    wide = pa.table({"demo": pa.array([0]), "time": [0.0], "x": [1.0]})
    pq.write_table(wide, tmp_path / "c.parquet")
    with pytest.raises(DataFormatError, match=r"times\[0\] has 1 samples"):
        load_demonstrations(tmp_path / "c.parquet")


@pytest.mark.parametrize(
    "rows", [[[1.0, 2.0], [3.0], [4.0, 5.0, 6.0]], [[1.0], None, [2.0]], [[1.0]] * 2**14 + [[1.0, 2.0]]]
)
def test_lists_of_parquet_that_differ_in_length_are_no_matrix(rows, tmp_path):
    pq.write_table(pa.table({"time": np.arange(len(rows)), "state": rows}), tmp_path / "lists.parquet")
    with pytest.raises(DataFormatError, match="differ in length"):
        load_demonstrations(tmp_path / "lists.parquet")

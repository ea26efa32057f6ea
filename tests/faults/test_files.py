"""Files that the disk, the network or somebody has damaged, and disks that are full.

Numbers in the names are those of the list of faults that the project keeps. Files that were forged by somebody who
knows the format are in `test_forged_models.py`; that old files load is in `tests/test_golden.py`.
"""

import errno
import io
import os
import pickle
import tracemalloc
import zipfile
from pathlib import Path

import joblib
import numpy as np
import pytest
import torch
from file_kinds import CHECKED, KINDS, MODELS, called, load_all

from torch_pbd.exceptions import DataFormatError, ModelFileError

each_kind = pytest.mark.parametrize("kind", KINDS, ids=called)
each_checked_kind = pytest.mark.parametrize("kind", CHECKED, ids=called)
OLD = b"the old file, which must stay"


class Full(io.BufferedWriter):
    """A file on a disk that is full."""

    failing = ""

    def write(self, content):
        if self.failing == "write":
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return super().write(content)

    def flush(self):
        if self.failing == "flush":
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        super().flush()


def fill_disk(monkeypatch, failing):
    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    if failing in ("fsync", "replace"):
        monkeypatch.setattr(os, failing, full)
    else:
        monkeypatch.setattr(Full, "failing", failing)
        as_ever = Path.open
        drafts = {"xb": lambda path: Full(io.FileIO(path, "x"))}
        monkeypatch.setattr(
            Path, "open", lambda path, mode="r", **how: drafts.get(mode, lambda _: as_ever(path, mode, **how))(path)
        )


@pytest.mark.parametrize("failing", ["write", "flush", "fsync", "replace"])
@each_kind
def test_39_a_full_disk_leaves_the_old_file_and_nothing_else(kind, failing, tmp_path, monkeypatch):
    path = kind.file(tmp_path, OLD)
    kind.write(path)
    kind.file(tmp_path, OLD)
    with monkeypatch.context() as patch:
        fill_disk(patch, failing)
        with pytest.raises(OSError, match=rf"No space left on device: '{path}'") as raised:
            kind.write(path)
    assert raised.value.errno == errno.ENOSPC
    assert path.read_bytes() == OLD
    assert list(tmp_path.iterdir()) == [path]


@each_kind
def test_39_a_limit_of_the_system_leaves_the_old_file_and_is_an_error_with_the_path(kind, tmp_path):
    path = kind.file(tmp_path, OLD)
    load_all()
    resource = pytest.importorskip("resource")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, before[1]))
    try:
        with pytest.raises(OSError, match=rf"\[Errno 27\] File too large: '{path}'"):
            kind.write(path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert path.read_bytes() == OLD
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("share", [0.0, 0.3, 0.9, 0.999])
@each_checked_kind
def test_40_a_torn_file_is_one_error_that_names_it(kind, share, tmp_path):
    path = kind.file(tmp_path, kind.content[: int(share * len(kind.content))])
    with pytest.raises(kind.error, match=str(path)):
        kind.read(path)


@each_kind
def test_40_an_empty_file_and_one_of_another_kind_are_one_error(kind, tmp_path):
    for content in (b"", b"\0", b"text\n", bytes(range(256)) * 10, *(other.content for other in KINDS)):
        if content != kind.content:
            with pytest.raises(kind.error, match=f"{kind.name}"):
                read_as_it_is(kind, tmp_path, content)


def read_as_it_is(kind, tmp_path, content):
    """Read the content; of models, a file of another class is sound, and of the class that it says."""
    path = kind.file(tmp_path, content)
    held = kind.read(path)
    if kind.name in MODELS and type(held).__name__ != kind.name:
        raise ModelFileError(f"{path} holds another class than {kind.name}")


def damaged(content, others, rng):
    """The content torn, flipped or spliced somewhere."""
    place, end = np.sort(rng.integers(len(content), size=2))
    length = int(rng.integers(1, 64))
    how = rng.integers(8)
    if how == 0:
        return content[:place]
    if how == 1:
        flipped = bytearray(content)
        for where in rng.integers(len(content), size=rng.integers(1, 4)):
            flipped[where] ^= 1 << rng.integers(8)
        return bytes(flipped)
    if how == 2:
        return content[:place] + others[rng.integers(len(others))][place:]
    if how == 3:
        return content[:place] + content[end:]
    if how == 4:
        return content[:place] + bytes(length) + content[place + length :]
    if how == 5:
        return content[:place] + rng.bytes(length) + content[place:]
    if how == 6:
        return content[:end] + content[place:]
    return content + others[rng.integers(len(others))][:end]


@each_checked_kind
def test_41_no_damaged_file_of_300_loads_as_something_else(kind, tmp_path):
    rng = np.random.default_rng(len(called(kind)))
    content, others = kind.content, [other.content for other in KINDS]
    n_refused = 0
    for _ in range(300):
        changed = damaged(content, others, rng)
        if changed == content:
            continue
        try:
            held = kind.read(kind.file(tmp_path, changed))
        except kind.error:
            n_refused += 1
        else:
            # Spaces, dates and spellings of numbers are free where people may read and write.
            assert kind.name not in MODELS, "a model file that is another loaded"
            assert kind.says_the_same(held)
    assert n_refused > (290 if kind.name in MODELS else 200)


@pytest.mark.parametrize("name", MODELS)
def test_41_a_flipped_bit_of_a_weight_does_not_match_the_checksum(name, tmp_path):
    kind = next(kind for kind in KINDS if kind.name == name)
    content = bytearray(kind.content)
    content[-5] ^= 1
    with pytest.raises(ModelFileError, match=rf"{name}\.safetensors is damaged: it does not match its checksum"):
        kind.read(kind.file(tmp_path, bytes(content)))


class Canary:
    """Makes a folder when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


def archive(members):
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as file:
        for name, content in members.items():
            file.writestr(name, content)
    return stream.getvalue()


def disguises(canary, sound):
    """Files that execute something where they are believed."""
    stream = io.BytesIO()
    np.save(stream, np.array([Canary(canary)], dtype=object), allow_pickle=True)
    pickled = stream.getvalue()
    joblib.dump({"model": Canary(canary)}, stream := io.BytesIO())
    joblibbed = stream.getvalue()
    torch.save({"model": Canary(canary)}, stream := io.BytesIO())
    with zipfile.ZipFile(io.BytesIO(sound)) as file:
        members = {info.filename: file.read(info) for info in file.infolist()}
    names = [f"{name}.npy" for name in ("t", "x", "t_0", "x_0", "meta", "header", "time", "type1", "position")]
    return {
        "pickle": pickle.dumps(Canary(canary)),
        "npy": pickled,
        "joblib": joblibbed,
        "torch": stream.getvalue(),
        "objects": archive({**members, **dict.fromkeys(names, pickled)}),
        "bare": archive(dict.fromkeys(names, pickle.dumps(Canary(canary)))),
        "paths": archive(dict.fromkeys(("../../x.npy", "../canary/x.npy", str(canary), "/x.npy"), pickled)),
    }


@pytest.mark.parametrize("disguise", ["pickle", "npy", "joblib", "torch", "objects", "bare", "paths"])
@each_kind
def test_42_nothing_in_a_file_is_executed_or_unpacked(kind, disguise, tmp_path):
    canary, folder = tmp_path / "canary", tmp_path / "deep" / "folder"
    folder.mkdir(parents=True)
    sound = next(other for other in KINDS if other.suffix == ".npz" and kind.name in (other.name, *MODELS)).content
    path = kind.file(folder, disguises(canary, sound)[disguise])
    before = set(tmp_path.rglob("*"))
    with pytest.raises(kind.error, match=str(path)):
        kind.read(path)
    assert set(tmp_path.rglob("*")) == before
    pickle.loads(pickle.dumps(Canary(canary)))
    assert canary.exists()  # it would have been


@pytest.mark.parametrize("name", ["schedule", "demonstrations"])
def test_42_foreign_paths_beside_sound_members_are_never_written(name, tmp_path):
    kind = next(kind for kind in KINDS if (kind.name, kind.suffix) == (name, ".npz"))
    with zipfile.ZipFile(io.BytesIO(kind.content)) as file:
        members = {info.filename: file.read(info) for info in file.infolist()}
    folder = tmp_path / "deep" / "folder"
    folder.mkdir(parents=True)
    path = kind.file(folder, archive({**members, "../../x.npy": b"x", "/tmp/x.npy": b"x"}))
    if name == "schedule":
        with pytest.raises(ModelFileError, match=r"\.\./x is not an array"):
            kind.read(path)
    else:
        assert kind.says_the_same(kind.read(path))  # arrays of other names are ignored
    assert {entry for entry in tmp_path.rglob("*") if entry.is_file()} == {path}


def npy(shape, descr="<f8", content=b""):
    header = f"{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header.encode() + content


@pytest.mark.parametrize(
    "array",
    [
        npy("(1000000000000,)"),
        npy("(1000000, 1000000)"),
        npy("(0, 1000000000000)", content=bytes(8)),
        npy("(-1, -8)", content=bytes(64)),
        npy("()", descr="<U999999999"),
        npy("(1,)", descr="|O", content=bytes(8)),
        npy("(1,)", descr="|V1000000000", content=bytes(8)),
        npy("(" * 40 + ")" * 40),
        npy("(__import__('os').mkdir('canary'),)"),
    ],
    ids=range(9),
)
@pytest.mark.parametrize("name", ["schedule", "demonstrations"])
def test_43_arrays_that_lie_about_their_size_are_refused_before_they_are_allocated(name, array, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    kind = next(kind for kind in KINDS if (kind.name, kind.suffix) == (name, ".npz"))
    with zipfile.ZipFile(io.BytesIO(kind.content)) as file:
        members = {info.filename: file.read(info) for info in file.infolist()}
    for member in ("t.npy", "type1.npy", "t_0.npy", "header.npy", "meta.npy"):
        if member in members:
            path = kind.file(tmp_path, archive({**members, member: array}))
            assert_refused_cheaply(kind, path)
    assert list(tmp_path.iterdir()) == [path]


def assert_refused_cheaply(kind, path, most=2**22):
    load_all()
    tracemalloc.start()
    try:
        with pytest.raises(kind.error, match=str(path)):
            kind.read(path)
        assert tracemalloc.get_traced_memory()[1] < most
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("name", ["schedule", "demonstrations"])
def test_43_an_archive_that_unpacks_to_more_than_the_memory_is_not_unpacked(name, tmp_path, monkeypatch):
    kind = next(kind for kind in KINDS if (kind.name, kind.suffix) == (name, ".npz"))
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("x.npy", npy(f"({2**22},)") + bytes(2**25))
    path = kind.file(tmp_path, stream.getvalue())
    monkeypatch.setattr("torch_pbd.files.memory.available_bytes", lambda: 2**24)
    assert_refused_cheaply(kind, path)


@pytest.mark.parametrize("name", ["schedule", "demonstrations"])
def test_43_two_members_of_one_name_are_refused(name, tmp_path):
    kind = next(kind for kind in KINDS if (kind.name, kind.suffix) == (name, ".npz"))
    stream = io.BytesIO(kind.content)
    with pytest.warns(UserWarning, match="Duplicate"), zipfile.ZipFile(stream, "a") as file:
        file.writestr(file.namelist()[0], npy("(1,)", content=bytes(8)))
    with pytest.raises(kind.error, match="two of its members have the same name"):
        kind.read(kind.file(tmp_path, stream.getvalue()))


HOSTILE = {
    "deep": b"[" * 100_000,
    "deeper": b'{"a":' * 100_000,
    "digits": b'{"version": ' + b"1" * 5000 + b"}",
    "lists": b"[" + b"[]," * 300_000 + b"[]]",
    "nan": b'{"format": NaN}',
    "spaces": b"# a: " + b" " * 200_000 + b"x\n" + b"# a",
    "header": b"demo,time," + b",".join(b"%d" % i for i in range(10_000)) + b",\n",
    "twins": b"demo,time," + b"x," * 50_000 + b"\n",
    "wide": b"x" * 300_000 + b"\n",
    "rows": b"demo,time,x\n" + b"".join(b"0,%d,1\n" % i for i in range(100_000)),
}


@pytest.mark.parametrize("hostile", HOSTILE)
@each_kind
def test_43_text_that_is_costly_to_parse_is_refused(kind, hostile, tmp_path, monkeypatch):
    monkeypatch.setattr("torch_pbd.files.memory.available_bytes", lambda: 2**23)
    assert_refused_cheaply(kind, kind.file(tmp_path, HOSTILE[hostile]), most=2**23)


def test_43_a_schedule_of_thousands_of_outputs_in_name_only_is_refused(tmp_path):
    kind = next(kind for kind in KINDS if (kind.name, kind.suffix) == ("schedule", ".csv"))
    head, _, _ = kind.content.partition(b"\ntime,")
    path = kind.file(tmp_path, head.replace(b'["x", "y"]', b"null") + b"\ntime" + b",velocity[0]" * 1500 + b"\n")
    with pytest.raises(ModelFileError, match="of which 1500 are velocities, must name 3378752"):
        kind.read(path)


def test_43_entries_of_one_name_are_refused(tmp_path):
    kind = next(kind for kind in KINDS if (kind.name, kind.suffix) == ("schedule", ".json"))
    path = kind.file(tmp_path, b'{"version": 1, ' + kind.content[1:])
    with pytest.raises(ModelFileError, match="two entries of one name, among version, format"):
        kind.read(path)


def test_43_a_description_of_demonstrations_that_is_no_text_is_refused(tmp_path):
    path = tmp_path / "demonstrations.npz"
    arrays = {"t": np.arange(3.0), "x": np.zeros((2, 3, 1))}
    for meta in ('{"frame": {"a": 1}}', '{"time_unit": ["s"]}', '{"t_unit": 1}', "[" * 100_000, '{"K": NaN}'):
        np.savez(path, **arrays, meta=np.array(meta))
        with pytest.raises(DataFormatError, match=r"demonstrations\.npz.*meta"):
            KINDS[-2].read(path)

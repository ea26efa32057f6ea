import json
import struct
import tracemalloc

import numpy as np
import pytest
from safetensors.numpy import save as to_bytes

from torch_pbd.exceptions import ModelFileError
from torch_pbd.persistence import MAX_HEADER_BYTES, checksum, read_archive, write_archive

ARRAYS = {
    "weight": np.arange(12.0).reshape(3, 4),
    "scalar": np.array(0.5),
    "state": np.arange(5, dtype=np.uint8),
    "generator": np.array([0, 2**32 - 1], dtype=np.uint32),
    "known": np.array([True, False]),
    "none": np.zeros((0, 3), dtype=np.float32),
}
HEADER = {"format_version": 1, "names": ["é", "b"], "loss": [1e-5, float("inf")], 3: {"deep": None}}


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "file.safetensors"
    write_archive(path, HEADER, ARRAYS)
    return path


def forged(path, text, arrays=ARRAYS, key="torch_pbd"):
    path.write_bytes(to_bytes(dict(arrays), metadata={key: text}))
    return path


def signed(header, arrays=ARRAYS):
    return json.dumps({**header, "sha256": checksum(header, arrays)})


def test_header_and_arrays_come_back(path):
    header, arrays = read_archive(path)
    assert header == {"format_version": 1, "names": ["é", "b"], "loss": [1e-5, float("inf")], "3": {"deep": None}}
    assert arrays.keys() == ARRAYS.keys()
    for name, array in ARRAYS.items():
        assert (arrays[name].dtype, arrays[name].shape) == (array.dtype, array.shape)
        np.testing.assert_array_equal(arrays[name], array)


def test_arrays_are_written_in_any_order_of_memory(tmp_path):
    for array in (np.asfortranarray(ARRAYS["weight"]), ARRAYS["weight"][::-1], np.broadcast_to(1.5, (2, 3))):
        write_archive(tmp_path / "file", {"format_version": 1}, {"weight": array})
        np.testing.assert_array_equal(read_archive(tmp_path / "file")[1]["weight"], array)


def test_a_header_that_would_not_be_read_again_is_not_written(tmp_path):
    with pytest.raises(ValueError, match="keep long lists as arrays"):
        write_archive(tmp_path / "file", {"text": "x" * MAX_HEADER_BYTES}, {})
    assert list(tmp_path.iterdir()) == []


def test_another_kind_is_told(path):
    with pytest.raises(
        ModelFileError, match=r"is not a model of torch_pbd, or is damaged \(it is not marked 'torch_pbd'\)"
    ):
        read_archive(forged(path, signed({"format_version": 1}), key="other"))
    with pytest.raises(FileNotFoundError, match="no model file at"):
        read_archive(path.parent)


@pytest.mark.parametrize("version", [True, 1.0, "1", None, [1], 2, 10**400])
def test_a_version_that_only_looks_like_ours_is_refused(version, path):
    with pytest.raises(ModelFileError, match=r"has format version .{1,40}; this"):
        read_archive(forged(path, signed({"format_version": version})))


@pytest.mark.parametrize("step", [9, pytest.param(1, marks=pytest.mark.slow)])
def test_every_single_bit_counts(step, path):
    """Every ninth, which is one of nearly every byte, and each of a byte's eight in turn; all of them, slowly."""
    whole = path.read_bytes()
    for place in range(0, 8 * len(whole), step):
        content = bytearray(whole)
        content[place // 8] ^= 1 << place % 8
        path.write_bytes(content)
        with pytest.raises(ModelFileError):
            read_archive(path)


def test_every_length_counts(path):
    whole = path.read_bytes()
    for length in range(len(whole)):
        path.write_bytes(whole[:length])
        with pytest.raises(ModelFileError):
            read_archive(path)
    path.write_bytes(whole + b"\0")
    with pytest.raises(ModelFileError):
        read_archive(path)


@pytest.mark.parametrize(
    "text",
    [
        "[" * 100_000,
        '{"a":' * 100_000,
        "1" * 5000,
        "[]",
        "null",
        "{}",
        '{"format_version": 1}',
        signed({"format_version": 1}).replace(", ", ","),
        signed({"format_version": 1}).replace('{"', '{"format_version": 7, "'),
        signed({"a": 1e-5, "format_version": 1}).replace("1e-05", "1E-05"),
        "x" * (MAX_HEADER_BYTES + 1),
    ],
    ids=lambda text: text[:20],
)
def test_a_header_in_other_words_is_refused(text, path):
    with pytest.raises(ModelFileError):
        read_archive(forged(path, text))


def outer(entries, data=b"", length=None):
    text = json.dumps(entries).encode() if isinstance(entries, dict) else entries
    return struct.pack("<Q", len(text) if length is None else length) + text + data


@pytest.mark.parametrize(
    "content",
    [
        outer({"w": {"dtype": "F64", "shape": [10**12], "data_offsets": [0, 8 * 10**12]}}),
        outer({"w": {"dtype": "F64", "shape": [2**61], "data_offsets": [0, 0]}}),
        outer({"w": {"dtype": "F64", "shape": [2**32, 2**32], "data_offsets": [0, 0]}}),
        outer({"w": {"dtype": "F64", "shape": [-1], "data_offsets": [0, 8]}}, bytes(8)),
        outer({"w": {"dtype": "BF16", "shape": [4], "data_offsets": [0, 8]}}, bytes(8)),
        outer({"w": {"dtype": "O", "shape": [1], "data_offsets": [0, 8]}}, bytes(8)),
        outer({"w": {"dtype": "BOOL", "shape": [1], "data_offsets": [0, 1]}}, b"\2"),
        outer({"__metadata__": {"torch_pbd": 1}}),
        outer({}),
        outer(b"[" * 100_000),
        outer(b"[]"),
        outer(b"", length=2**63),
        outer(b"{}", length=2**40),
        outer({}, length=0),
        b"",
        b"\0" * 7,
    ],
    ids=range(16),
)
def test_lies_about_sizes_and_types_are_refused_before_anything_is_allocated(content, path):
    path.write_bytes(content)
    tracemalloc.start()
    try:
        with pytest.raises(ModelFileError):
            read_archive(path)
        assert tracemalloc.get_traced_memory()[1] < 2**22
    finally:
        tracemalloc.stop()


def test_a_header_of_safetensors_that_is_longer_than_any_of_ours_is_not_parsed(path):
    path.write_bytes(outer(b"{}".ljust(4 * MAX_HEADER_BYTES + 8)))
    with pytest.raises(ModelFileError, match="it declares a header of 16777224 bytes"):
        read_archive(path)


def test_a_file_larger_than_the_memory_is_not_read(path, monkeypatch):
    monkeypatch.setattr("torch_pbd.files.memory.available_bytes", lambda: 1000)
    with pytest.raises(ModelFileError, match="GiB of memory"):
        read_archive(path)

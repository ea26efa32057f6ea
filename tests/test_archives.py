import io
import zipfile

import numpy as np
import pytest

from torch_pbd.files import read_array, read_members


def npy(array, version=None):
    stream = io.BytesIO()
    np.lib.format.write_array(stream, np.asanyarray(array), version=version, allow_pickle=False)
    return stream.getvalue()


@pytest.mark.parametrize(
    "array",
    [
        np.arange(12.0).reshape(3, 4),
        np.asfortranarray(np.arange(24.0).reshape(2, 3, 4)),
        np.arange(3, dtype=">f8"),
        np.arange(3, dtype=np.float32),
        np.array([True, False]),
        np.array("text, ü"),
        np.array(["a", "bc"]),
        np.array(1.5),
        np.zeros((0, 3)),
        np.arange(4, dtype=np.uint8),
    ],
    ids=repr,
)
@pytest.mark.parametrize("version", [(1, 0), (2, 0), (3, 0)])
def test_arrays_are_what_numpy_wrote(array, version):
    found = read_array("x", npy(array, version))
    assert (found.dtype, found.shape) == (array.dtype, array.shape)
    np.testing.assert_array_equal(found, array)
    assert not found.flags.writeable


def test_headers_of_other_writers_are_read():
    start = b"{'descr': '<f8', 'fortran_order': False, 'shape': (2,)}\n"
    content = b"\x93NUMPY\x01\x00" + len(start).to_bytes(2, "little") + start + np.arange(2.0).tobytes()
    np.testing.assert_array_equal(read_array("x", content), [0.0, 1.0])


@pytest.mark.parametrize("array", [np.zeros(2, complex), np.zeros(2, "M8[s]"), np.zeros(2, "S3"), np.zeros(2, "f8,f8")])
def test_types_that_are_no_numbers_and_no_text_are_refused(array):
    with pytest.raises(ValueError, match="x is not an array of numbers or text"):
        read_array("x", npy(array))


@pytest.mark.parametrize("change", [slice(0, -1), slice(0, 40), slice(1, None)])
def test_an_array_that_is_not_whole_is_refused(change):
    with pytest.raises(ValueError, match=r"^x (is not an array|declares shape \(4,\), 32 bytes, but has 31)"):
        read_array("x", npy(np.zeros(4))[change])


def test_members_come_by_name_and_limits_are_told():
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("a.npy", bytes(1000))
        file.writestr("b", b"b")
    assert read_members(stream.getvalue(), 1001, remedy="") == {"a": bytes(1000), "b": b"b"}
    with pytest.raises(ValueError, match=r"unpacks to more than 1000 bytes, to 1001\. Raise it"):
        read_members(stream.getvalue(), 1000, remedy="Raise it.")
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_BZIP2) as file:
        file.writestr("a.npy", bytes(1000))
    with pytest.raises(ValueError, match="packed in a way that NumPy does not write"):
        read_members(stream.getvalue(), 10**4, remedy="")


def test_a_list_of_members_beyond_the_memory_is_not_read(monkeypatch):
    monkeypatch.setattr("torch_pbd.files.memory.available_bytes", lambda: 10**6)
    with pytest.raises(ValueError, match="its list of members needs about"):
        read_members(b"PK\x01\x02" * 1000, 10**4, remedy="")

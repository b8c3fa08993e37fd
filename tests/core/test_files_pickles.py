"""Pickles of plain data: what NumPy wrote is read back, and one that would run code is refused."""

from __future__ import annotations

import copyreg
import os
import pickle
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtof_kin.core.errors import FileFormatError
from rtof_kin.core.files.pickles import read_object_npz, read_pickle

DATA = {
    "S1": {"Walking 1": np.arange(24, dtype=np.float32).reshape(4, 2, 3), "Sitting": np.ones((1, 2, 3))},
    "S11": {"Directions": [np.arange(4, dtype=">f8").reshape(2, 2)] * 2},
    "metadata": {"num_joints": np.int64(17), "layout": "h36m", "pairs": [[1, 2], (3, 4)], "x": None},
    "orders": [np.asfortranarray(np.eye(3)[:, :2]), np.arange(10)[::-2], np.array([True]), np.array(3.5)],
}
NDARRAY, ENCODE = b"cnumpy\nndarray\n", b"c_codecs\nencode\n"
EMPTY = b"cnumpy.core.multiarray\n_reconstruct\n" + NDARRAY + b"K\x00\x85C\x01b\x87R"
EIGHT = b"C\x08" + bytes(8)


def text(value: str) -> bytes:
    return b"\x8c" + bytes([len(value.encode())]) + value.encode()


def dtype(code: str, state: bytes = b"K\x03" + text("<") + b"NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\0") -> bytes:
    return b"cnumpy\ndtype\n" + text(code) + b"\x89\x88\x87R(" + state + b"tb"


def filled(shape: bytes, kind: bytes, data: bytes) -> bytes:
    return EMPTY + b"(K\x01" + shape + kind + b"\x89" + data + b"tb"


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "data.npz"


def read(path: Path, program: bytes) -> Any:
    path.write_bytes(program)
    return read_pickle(path)


def npz(path: Path, packing: int = zipfile.ZIP_DEFLATED, **members: bytes) -> Path:
    with zipfile.ZipFile(path, "w", packing) as archive:
        for name, data in members.items():
            archive.writestr(f"{name}.npy", data)
    return path


def assert_same(a: Any, b: Any) -> None:
    if isinstance(b, np.ndarray):
        assert (type(a), a.dtype, a.shape) == (np.ndarray, b.dtype.newbyteorder("="), b.shape)
        np.testing.assert_array_equal(a, b)
    elif isinstance(b, dict):
        assert list(a) == list(b)
        for key in b:
            assert_same(a[key], b[key])
    elif isinstance(b, list | tuple):
        assert type(a) is type(b)
        for x, y in zip(a, b, strict=True):
            assert_same(x, y)
    else:
        assert a == b


@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
@pytest.mark.parametrize("module", [b"numpy._core.multiarray", b"numpy.core.multiarray"])
def test_protocols_2_to_5_and_older_numpy_are_read(path: Path, protocol: int, module: bytes) -> None:
    data = pickle.dumps(DATA, protocol)
    if protocol < 4:  # its strings have no length to correct
        data = data.replace(b"numpy._core.multiarray", module)
    assert_same(read(path, data), DATA)


def test_byte_strings_of_python_2_are_read_as_text(path: Path) -> None:
    content = b"\x80\x02}(U\x04name" + filled(b"K\x02\x85", dtype("f4"), b"U\x08" + bytes(7) + b"\x40") + b"u."
    assert_same(read(path, content), {"name": np.array([0, 2], dtype=np.float32)})


class Harm:
    """Pickled as a call of the function given."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self.call = (function, arguments)

    def __reduce__(self) -> Any:
        return self.call


@pytest.mark.parametrize("protocol", [0, 2, 4, 5])
@pytest.mark.parametrize(
    "place", [lambda harm: harm, lambda harm: {harm: (1, [harm])}, lambda harm: np.array([1, harm], dtype=object)]
)
def test_a_command_is_refused_and_not_run(path: Path, place: Callable[[Any], Any], protocol: int) -> None:
    mark = path.parent / "it ran"
    with pytest.raises(FileFormatError, match=r"data\.npz: its pickle: not opened.*it wants to run"):
        read(path, pickle.dumps(place(Harm(os.system, f"touch '{mark}'")), protocol))
    assert not mark.exists()
    pickle.loads(path.read_bytes())
    assert mark.exists()  # an ordinary reader would have run it


@pytest.mark.parametrize(
    "content, name",
    [
        (Harm(eval, "1/0"), r"builtins\.eval"),
        (Harm(getattr, "", "join"), r"builtins\.getattr"),
        (Harm(np.load, "/etc/passwd", None, True), r"numpy.*\.load"),
        (Harm(np.fromfile, "/etc/passwd"), r"numpy.*\.fromfile"),
        (Harm(pickle.loads, b"."), r"_pickle\.loads"),
        (Harm(bytearray, 10**9), r"builtins\.bytearray"),
        (np.ma.masked_array([1.0], [True]), r"numpy\.ma"),
        (np.datetime64("2020-01-01"), "M8"),
        (np.array(["a"]), "U1"),
    ],
)
def test_only_plain_data_and_numeric_arrays_are_made(path: Path, content: Any, name: str) -> None:
    with pytest.raises(FileFormatError, match=rf"its pickle: not opened.*{name}"):
        read(path, pickle.dumps({"S1": [content]}, 4))


REPEATED = (
    b"\x8e" + struct.pack("<Q", 80_000) + bytes(80_000) + b"q\x05" + filled(b"M\x10\x27\x85", dtype("f8"), b"h\x05")
)


@pytest.mark.parametrize(
    "content, message",
    [
        (b"cos\nsystem\n", r"os\.system"),
        (text("numpy") + text("dtype.type") + b"\x93", r"numpy\.dtype\.type"),
        (b"(inumpy.core.multiarray\nfromstring\n", "fromstring"),
        (b"\x82\x4d", "KeyError"),  # of the extension registry
        (b"K\x01Q", "persistent"),
        (text("print") + b")R", "not callable"),
        (NDARRAY + b")\x81", "KeyError"),
        (NDARRAY + b"}" + text("a") + b"Nsb", "something else"),
        (b"]}" + text("a") + b"Nsb", "something else"),
        (EMPTY + b"}b", "damaged"),
        (filled(b"K\x01\x85", dtype("V8"), EIGHT), "of type '<V8'"),
        (filled(b"K\x02\x85", dtype("O8"), EIGHT), "with 8 bytes"),
        (filled(b"K\x08\x85", dtype("O8"), EIGHT), "not bytes"),
        (filled(b"K\x01\x85", dtype("f8", b"K\x03" + text("<") + b"})}NNN"), EIGHT), "something else"),
        (filled(b"K\x03\x85", dtype("f4"), EIGHT), r"shape \(3,\) and type float32 with 8 bytes"),
        (filled(b"J\xff\xff\xff\xff\x85", dtype("f4"), EIGHT), r"shape \(-1,\)"),
        (filled(text("ab"), dtype("f4"), EIGHT), "damaged"),
        (filled(b"K\0\x85", dtype("f4"), b"]"), "not bytes"),
        (REPEATED + filled(b"M\x10\x27\x85", dtype("f8"), b"h\x05"), "with 80000 bytes"),
        (b"\x8e" + struct.pack("<Q", 2**62) + b"abc", "damaged"),
        (b"h\x07", "damaged"),
        (b"(((", "damaged"),
        (b"\xff", "damaged"),
        (b"N." + b"more", "after the end"),
    ],
)
def test_a_pickle_that_does_anything_else_is_refused(path: Path, content: bytes, message: str) -> None:
    copyreg.add_extension("os", "system", 77)
    try:
        pickle.loads(b"\x80\x02\x82\x4d.")  # now in a cache that does not ask find_class
        with pytest.raises(FileFormatError, match=rf"data\.npz: its pickle: .*{message}"):
            read(path, b"\x80\x04" + content + b".")
    finally:
        copyreg.remove_extension("os", "system", 77)


def test_objects_in_an_archive_are_read_and_others_refused(path: Path) -> None:
    np.savez_compressed(path, positions=DATA | {"no frames": np.zeros((0, 17, 2))}, other=np.array([1, None]))  # type: ignore[arg-type]
    assert_same(read_object_npz(path, ("positions",)), [DATA | {"no frames": np.zeros((0, 17, 2))}])
    with pytest.raises(FileFormatError, match="no member 'c'; there is positions, other"):
        read_object_npz(path, ("positions", "c"))
    with pytest.raises(FileFormatError, match="would fill more than 0 MiB"):
        read_object_npz(path, ("positions",), limit=100)
    with pytest.raises(FileFormatError, match=r"data\.npz: other: .*not an array of one object"):
        read_object_npz(path, ("other",))
    with pytest.raises(FileFormatError, match=r"data\.npz: a: .*damaged"):
        read_object_npz(npz(path, a=b"hello"), ("a",))
    path.write_bytes(path.read_bytes()[:50])
    with pytest.raises(FileFormatError, match=r"data\.npz: damaged"):
        read_object_npz(path, ("a",))

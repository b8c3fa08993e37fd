"""Object arrays of .npz files: what NumPy wrote is read back, and a pickle that would run code is refused."""

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
from rtof_kin.datasets.object_npz import read_object_npz

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


def holding(content: bytes) -> bytes:
    """The program of an array of one object, given the operations that make the object."""
    return b"\x80\x04" + filled(b")", dtype("O8"), b"](" + content + b"e") + b"."


def npy(program: bytes, shape: str = "()", descr: str = "'|O'") -> bytes:
    header = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header.encode() + program


def pickled_array(content: Any, protocol: int = 4) -> bytes:
    box = np.empty((), dtype=object)
    box[()] = content
    return npy(pickle.dumps(box, protocol))


def write(path: Path, packing: int = zipfile.ZIP_DEFLATED, **members: bytes) -> Path:
    with zipfile.ZipFile(path, "w", packing) as archive:
        for name, data in members.items():
            archive.writestr(f"{name}.npy", data)
    return path


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "data.npz"


def read(path: Path, data: bytes) -> Any:
    return read_object_npz(write(path, a=data), ["a"])["a"]


def assert_same(a: Any, b: Any) -> None:
    if isinstance(b, np.ndarray):
        assert (a.dtype, a.shape) == (b.dtype.newbyteorder("="), b.shape)
        assert not a.flags.writeable
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


def test_a_dictionary_saved_by_numpy_is_read_back(path: Path) -> None:
    contents: dict[str, Any] = {"positions": DATA | {"no frames": np.zeros((0, 17, 2))}, "plain": np.eye(3)}
    np.savez_compressed(path, **contents)
    assert_same(read_object_npz(path, ["positions", "plain"]), contents)


@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
@pytest.mark.parametrize("module", [b"numpy._core.multiarray", b"numpy.core.multiarray"])
def test_protocols_2_to_5_and_older_numpy_are_read(path: Path, protocol: int, module: bytes) -> None:
    data = pickled_array(DATA, protocol)
    if protocol < 4:  # its strings have no length to correct
        data = data.replace(b"numpy._core.multiarray", module)
    assert_same(read(path, data), DATA)


def test_byte_strings_of_python_2_are_read_as_text(path: Path) -> None:
    content = b"}(U\x04name" + filled(b"K\x02\x85", dtype("f4"), b"U\x08" + bytes(7) + b"\x40") + b"u"
    assert_same(read(path, npy(holding(content))), {"name": np.array([0, 2], dtype=np.float32)})


def test_an_object_that_is_shared_many_times_is_converted_once(path: Path) -> None:
    lists: list[Any] = ["text"]
    for _ in range(15):
        lists = [lists] * 10  # 10^15 leaves
    assert len(read(path, pickled_array(lists))) == 10


class Harm:
    """Pickled as a call of the function given."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self.call = (function, arguments)

    def __reduce__(self) -> Any:
        return self.call


@pytest.mark.parametrize("protocol", [0, 2, 4, 5])
@pytest.mark.parametrize(
    "place",
    [
        lambda harm: harm,
        lambda harm: {"S1": {"Walking": harm}},
        lambda harm: {harm: 1},
        lambda harm: {**DATA, "S99": (1, [harm])},
        lambda harm: np.array([1, harm], dtype=object),
    ],
)
def test_a_command_is_refused_and_not_run(path: Path, place: Callable[[Any], Any], protocol: int) -> None:
    mark = path.parent / "it ran"
    with pytest.raises(FileFormatError, match=r"data\.npz: a: not opened: it wants to run"):
        read(path, pickled_array(place(Harm(os.system, f"touch '{mark}'")), protocol))
    assert not mark.exists()
    np.load(path, allow_pickle=True)["a"]
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
        (np.dtype, "numpy dtype"),
        (np.ndarray, "numpy ndarray"),
        ({1, 2}, "set among"),
        (np.datetime64("2020-01-01"), "M8"),
        (np.array(["a"]), "U1"),
    ],
)
def test_only_plain_data_and_numeric_arrays_are_made(path: Path, content: Any, name: str) -> None:
    with pytest.raises(FileFormatError, match=rf"a: not opened: .*{name}"):
        read(path, pickled_array({"S1": [content]}))


@pytest.mark.parametrize(
    "content, message",
    [
        (b"cos\nsystem\n", r"os\.system"),
        (text("numpy") + text("dtype.type") + b"\x93", r"numpy\.dtype\.type"),
        (b"(inumpy.core.multiarray\nfromstring\n", "fromstring"),
        (b"\x82\x4d", "number 77 of the extension registry"),
        (b"K\x01Q", "persistent"),
        (text("print") + b")R", "not callable"),
        (NDARRAY + b")R", "calls ndarray"),
        (NDARRAY + b")\x81", "damaged"),
        (NDARRAY + b"}" + text("a") + b"Nsb", "damaged"),
        (ENCODE + text("a") + text("rot13") + b"\x86R", "calls encode"),
        (EMPTY + b"}b", "state of an array"),
        (EMPTY, "damaged"),
        (filled(b"K\x01\x85", dtype("V8"), EIGHT), "of type '<V8'"),
        (filled(b"K\x02\x85", dtype("O8"), EIGHT), "of type '<O8'"),
        (filled(b"K\x01\x85", dtype("f8", b"K\x03" + text("<") + b"})}NNN"), EIGHT), "array of records"),
        (filled(b"K\x03\x85", dtype("f4"), EIGHT), r"shape \(3,\) and type float32 with 8 bytes"),
        (filled(b"J\xff\xff\xff\xff\x85", dtype("f4"), EIGHT), r"shape \(-1,\)"),
        (filled(text("ab"), dtype("f4"), EIGHT), "tuple of at most 8 integers"),
        (filled(b"K\x02\x85", dtype("f4"), b"]"), "not bytes"),
        (b"}(K\x01K\x02u", "key that is not text"),
        (b"]\x94h\x00a", "contains itself"),
        (b"]" * 30 + b"a" * 29, "nested more than 20 deep"),
        (b"K\x01r\xff\xff\xff\x7f", "more than 2000000 operations"),
        (
            b"X\x40\x42\x0f\x00" + b"a" * 10**6 + b"q\x05" + (ENCODE + b"h\x05" + text("latin1") + b"\x86R") * 9,
            "repeats more text",
        ),
        (b"\x8e" + struct.pack("<Q", 2**62) + b"abc", "damaged"),
        (b"h\x07", "damaged"),
        (b"(((", "damaged"),
        (b"\xff", "damaged"),
    ],
)
def test_a_pickle_that_does_anything_else_is_refused(path: Path, content: bytes, message: str) -> None:
    copyreg.add_extension("os", "system", 77)
    try:
        pickle.loads(b"\x80\x02\x82\x4d.")  # now in a cache that does not ask find_class
        with pytest.raises(FileFormatError, match=rf"data\.npz: a: .*{message}"):
            read(path, npy(holding(content)))
    finally:
        copyreg.remove_extension("os", "system", 77)


@pytest.mark.parametrize(
    "data, message",
    [
        (npy(pickle.dumps(np.array([1, None]), 4), "(2,)"), r"array of objects of shape \(2,\)"),
        (npy(b"", "()", "'<U4'"), "array of <U4"),
        (npy(b"\0" * 8, "(2,)", "'<f8'"), "with 8 bytes"),
        (npy(pickle.dumps(DATA, 4)), "not that of an array"),
        (pickled_array(1) + b"more", "after the end"),
        (pickled_array(DATA)[:-40], "damaged"),
        (npy(b""), "damaged"),
        (b"hello", "damaged"),
    ],
)
def test_a_truncated_or_foreign_member_is_refused(path: Path, data: bytes, message: str) -> None:
    with pytest.raises(FileFormatError, match=rf"data\.npz: a: .*{message}"):
        read(path, data)


def test_a_missing_packed_or_oversized_member_is_refused(path: Path) -> None:
    write(path, a=pickled_array(DATA), bad=pickled_array(Harm(os.system, "true")))
    assert_same(read_object_npz(path, ["a"])["a"], DATA)  # others are not read
    write(path, a=pickled_array(np.random.default_rng(0).normal(size=1000)))
    with pytest.raises(FileFormatError, match="no member 'c'; there is a"):
        read_object_npz(path, ["a", "c"])
    with pytest.raises(FileFormatError, match="would fill more than 0 MiB"):
        read_object_npz(path, ["a"], limit=8000)
    write(path, zipfile.ZIP_LZMA, a=pickled_array(1))
    with pytest.raises(FileFormatError, match="compressed in a way"):
        read_object_npz(path, ["a"])


@pytest.mark.parametrize(
    "damage", [lambda data: data[: len(data) // 2], lambda data: b"", lambda data: data.replace(b"Walking", b"Talking")]
)
def test_a_damaged_archive_is_refused(path: Path, damage: Callable[[bytes], bytes]) -> None:
    write(path, zipfile.ZIP_STORED, a=pickled_array(DATA))
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(FileFormatError, match=r"data\.npz: damaged"):
        read_object_npz(path, ["a"])

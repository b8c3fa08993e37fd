"""Object arrays of .npz files: what NumPy wrote comes back, and what would run code never does."""

from __future__ import annotations

import copyreg
import operator
import os
import pickle
import re
import struct
import time
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as st_numpy

from rtof_kin.core.errors import FileFormatError
from rtof_kin.datasets import pickled
from rtof_kin.datasets.object_npz import read_object_npz

HEADER = b"\x93NUMPY\x01\x00"


def npy(program: bytes, shape: str = "()", descr: str = "'|O'") -> bytes:
    """An .npy file with a header and whatever shall follow it."""
    header = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}"
    return HEADER + struct.pack("<H", len(header)) + header.encode() + program


def write(path: Path, packing: int = zipfile.ZIP_DEFLATED, **members: bytes) -> Path:
    with zipfile.ZipFile(path, "w", packing) as archive:
        for name, data in members.items():
            archive.writestr(f"{name}.npy", data)
    return path


def boxed(content: Any) -> np.ndarray:
    """The array of shape () that NumPy makes of an object to save."""
    box = np.empty((), dtype=object)
    box[()] = content
    return box


def pickled_array(content: Any, protocol: int = 4) -> bytes:
    return npy(pickle.dumps(boxed(content), protocol))


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "data.npz"


def read(path: Path, **members: bytes) -> Any:
    return read_object_npz(write(path, **members), list(members))


def assert_same(a: Any, b: Any) -> None:
    """Equal in type, shape and value, through all levels."""
    if isinstance(b, np.ndarray):
        assert isinstance(a, np.ndarray)
        assert (a.dtype, a.shape) == (b.dtype, b.shape)
        np.testing.assert_array_equal(a, b)
        return
    assert type(a) is type(b)
    if isinstance(b, dict):
        assert list(a) == list(b)
        for key in b:
            assert_same(a[key], b[key])
    elif isinstance(b, list | tuple):
        assert len(a) == len(b)
        for x, y in zip(a, b, strict=True):
            assert_same(x, y)
    else:
        assert a == b


DATA = {
    "S1": {"Walking 1": np.arange(24, dtype=np.float32).reshape(4, 2, 3), "Sitting": np.ones((1, 2, 3))},
    "S11": {"Directions": [np.arange(4, dtype=np.float32).reshape(2, 2)] * 2},
    "metadata": {"num_joints": 17, "layout": "h36m", "pairs": [[1, 2], (3, 4)], "ok": True, "x": None},
}


# --- what is written comes back ------------------------------------------------------------------


def test_a_dictionary_saved_by_numpy_comes_back(path: Path) -> None:
    contents: dict[str, Any] = {"positions": DATA, "plain": np.eye(3)}
    np.savez_compressed(path, **contents)
    found = read_object_npz(path, ["positions", "plain"])
    assert_same(found["positions"], DATA)
    assert_same(found["plain"], np.eye(3))


@pytest.mark.parametrize("protocol", [2, 3, 4])
def test_every_protocol_that_numpy_ever_saved_with_is_read(path: Path, protocol: int) -> None:
    assert_same(read(path, a=pickled_array(DATA, protocol))["a"], DATA)


@pytest.mark.parametrize("protocol", [2, 3])
def test_pickles_of_numpy_before_2_are_read(path: Path, protocol: int) -> None:
    program = pickle.dumps(boxed(DATA), protocol)
    assert b"numpy._core.multiarray" in program
    old = program.replace(b"numpy._core.multiarray", b"numpy.core.multiarray")
    assert_same(read(path, a=npy(old))["a"], DATA)


def python_2(value: Any) -> bytes:
    """The operations by which Python 2 pickled a value at protocol 2: its strings are bytes."""
    if isinstance(value, dict):
        return b"}(" + b"".join(python_2(x) for item in value.items() for x in item) + b"u"
    if isinstance(value, list):
        return b"](" + b"".join(map(python_2, value)) + b"e"
    if isinstance(value, str):
        return b"U" + bytes([len(value)]) + value.encode("latin1")
    if isinstance(value, int):
        return b"J" + struct.pack("<i", value)
    shape = b"(" + b"".join(python_2(n) for n in value.shape) + b"t"
    data = value.tobytes()
    dtype = (
        b"cnumpy\ndtype\n" + python_2(value.dtype.str[1:]) + b"K\x00K\x01\x87R"
        b"(K\x03U\x01<NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb"
    )
    return (
        b"cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85U\x01b\x87R"
        b"(K\x01" + shape + dtype + b"\x89T" + struct.pack("<i", len(data)) + data + b"tb"
    )


def python_2_program(value: Any) -> bytes:
    return (
        b"\x80\x02cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85U\x01b\x87R"
        b"(K\x01)cnumpy\ndtype\nU\x02O8K\x00K\x01\x87R(K\x03U\x01|NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xff"
        b"K?tb\x89](" + python_2(value) + b"etb."
    )


def test_pickles_of_python_2_are_read_as_the_unpickler_would(path: Path) -> None:
    data = {"S1": {"Walking": np.array([[1.5, -2.0, 1e30]], dtype=np.float32)}, "n": 17, "l": [1, "h36m"]}
    program = python_2_program(data)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # numpy.core has another name today
        assert_same(pickle.loads(program, encoding="latin1")[()], data)
    assert_same(read(path, a=npy(program))["a"], data)


@pytest.mark.parametrize("protocol", [2, 4])
@pytest.mark.parametrize("array", [
    np.arange(6, dtype=">f8").reshape(2, 3), np.asfortranarray(np.arange(6.0).reshape(2, 3)),
    np.arange(24.0).reshape(2, 3, 4).transpose(2, 0, 1), np.arange(10)[::-2], np.array(3.5),
    np.array([True, False]), np.arange(4, dtype=np.uint8), np.arange(4, dtype=np.float16),
    np.array([np.nan, np.inf, -0.0]),
])  # fmt: skip
def test_arrays_of_any_number_and_order_come_back(path: Path, array: Any, protocol: int) -> None:
    assert_same(read(path, a=pickled_array([array], protocol))["a"], [array])


def test_an_array_of_no_frames_comes_back(path: Path) -> None:
    assert_same(read(path, a=pickled_array([np.zeros((0, 17, 2))]))["a"], [np.zeros((0, 17, 2))])


@pytest.mark.parametrize("protocol", [2, 4])
def test_numpy_scalars_become_numbers(path: Path, protocol: int) -> None:
    scalars = [np.int64(17), np.float32(0.5), np.bool_(True)]
    assert_same(read(path, a=pickled_array(scalars, protocol))["a"], [17, 0.5, True])


LEAVES = (
    st.none() | st.booleans() | st.integers(-(2**40), 2**40) | st.floats(allow_nan=False)
    | st.text(max_size=8)
    | st_numpy.arrays(st.sampled_from(["<f4", "<f8", ">i4", "|u1", "|b1"]), st_numpy.array_shapes())
)  # fmt: skip
TREES = st.recursive(
    LEAVES,
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.tuples(inner, inner)
        | st.dictionaries(st.text(max_size=8), inner, max_size=4)
    ),
    max_leaves=12,
)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(tree=TREES, protocol=st.sampled_from([2, 3, 4]))
def test_any_tree_of_data_comes_back(path: Path, tree: Any, protocol: int) -> None:
    assert_same(read(path, a=pickled_array(tree, protocol))["a"], tree)


def test_the_arrays_read_cannot_be_written_to(path: Path) -> None:
    found = read(path, a=pickled_array(DATA), b=npy(b"\0" * 8, "(1,)", "'<f8'"))
    for array in (found["a"]["S1"]["Sitting"], found["b"]):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1


def test_members_nobody_asked_for_are_not_looked_at(path: Path) -> None:
    write(path, good=pickled_array(DATA), bad=pickled_array(Harm(os.system, "true")))
    assert_same(read_object_npz(path, ["good"])["good"], DATA)


def test_a_hundred_megabytes_are_read_in_a_second_or_two(path: Path) -> None:
    noise = np.random.default_rng(0).normal(size=(2000, 32, 3)).astype(np.float32)
    data = {f"S{i}": {f"action {k}": noise + k for k in range(20)} for i in range(7)}
    program = pickled_array(data)
    assert len(program) > 100e6
    write(path, zipfile.ZIP_STORED, a=program)
    start = time.perf_counter()
    assert_same(read_object_npz(path, ["a"])["a"]["S6"], data["S6"])
    assert time.perf_counter() - start < 5


# --- attacks -------------------------------------------------------------------------------------


class Harm:
    """Pickled as a call of whatever it is given."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self.call = (function, arguments)

    def __reduce__(self) -> Any:
        return self.call


class Stateful:
    """Pickled as an instance with a state."""

    def __setstate__(self, state: Any) -> None:
        raise AssertionError("its state was set")

    def __getstate__(self) -> Any:
        return {"a": 1}


class Subclass(np.ndarray):
    """An array with a method of its own that unpickling calls."""

    def __setstate__(self, state: Any) -> None:  # type: ignore[override]
        raise AssertionError("its state was set")


def placements(harm: Any) -> dict[str, Any]:
    """Where in the data the harm can stand."""
    nested = np.empty(2, dtype=object)
    nested[:] = [1, harm]
    return {
        "alone": harm,
        "an action": {"S1": {"Walking": harm}},
        "a list": {"S1": [np.zeros(3), harm]},
        "a tuple": (1, (2, harm)),
        "a key": {harm: 1},
        "metadata": {"num_joints": 17, "keypoints_symmetry": [[harm], []]},
        "an array of objects": {"S1": nested},
        "after good data": {**DATA, "S99": harm},
    }


@pytest.mark.parametrize("protocol", [0, 1, 2, 3, 4, 5])
@pytest.mark.parametrize("place", list(placements(None)))
def test_a_command_is_never_run_wherever_it_stands(path: Path, place: str, protocol: int) -> None:
    mark = path.parent / "it ran"
    program = pickled_array(placements(Harm(os.system, f"touch '{mark}'"))[place], protocol)
    with pytest.raises(FileFormatError, match=r"data\.npz: a: not opened: ") as caught:
        read(path, a=program)
    assert not mark.exists()
    if 2 <= protocol <= 4:
        assert "it wants to run posix.system" in str(caught.value)
        assert "do not trust this file" in str(caught.value)


def test_the_attack_would_have_worked(path: Path) -> None:
    """So that the test before this one is known to hold something off."""
    mark = path.parent / "it ran"
    write(path, a=pickled_array({"S1": Harm(os.system, f"touch '{mark}'")}))
    np.load(path, allow_pickle=True)["a"]
    assert mark.exists()


@pytest.mark.parametrize("harm, name", [
    (Harm(eval, "1/0"), r"builtins\.eval"),
    (Harm(exec, "raise SystemExit"), r"builtins\.exec"),
    (Harm(getattr, "", "join"), r"builtins\.getattr"),
    (Harm(__import__, "os"), r"builtins\.__import__"),
    (Harm(open, "/etc/passwd"), "_?io.open"),
    (Harm(np.load, "/etc/passwd", None, True), r"numpy.*\.load"),
    (Harm(np.fromfile, "/etc/passwd"), r"numpy.*\.fromfile"),
    (Harm(np.memmap, "/etc/passwd"), r"numpy\.memmap"),
    (Harm(np.testing.rundocs, "x.py"), r"numpy\.testing.*\.rundocs"),
    (Harm(np.vectorize, eval), r"numpy.*vectorize"),
    (Harm(operator.attrgetter, "system"), r"operator\.attrgetter"),
    (Harm(pickle.loads, b"."), r"_pickle\.loads"),
    (Harm(bytearray, 10**9), r"builtins\.bytearray"),
    (Stateful(), r"copyreg\.|Stateful"),
    (np.ones(3).view(Subclass), "Subclass"),
    (np.ma.masked_array([1.0], [True]), r"numpy\.ma"),
    (np.random.default_rng(0), r"numpy\.random"),
    (np.dtype, "numpy dtype"),
    (np.ndarray, "numpy ndarray"),
    ({1, 2}, r"EMPTY_SET|builtins\.set"),
    (complex(1, 2), r"builtins\.complex"),
    (np.datetime64("2020-01-01"), "M8"),
])  # fmt: skip
def test_nothing_but_arrays_is_made(path: Path, harm: Any, name: str) -> None:
    for content in (harm, {"S1": [harm]}):
        with pytest.raises(FileFormatError, match=rf"a: not opened: .*{name}"):
            read(path, a=pickled_array(content))


def text(value: str) -> bytes:
    return b"\x8c" + bytes([len(value.encode())]) + value.encode()


@pytest.mark.parametrize("module, name", [
    ("os", "system"), ("nt", "system"), ("subprocess", "Popen"), ("builtins", "eval"),
    ("__builtin__", "eval"), ("numpy", "load"), ("numpy", "save"), ("numpy", "ndarray.tofile"),
    ("numpy", "dtype.type"), ("numpy", "core.multiarray._reconstruct.__globals__"),
    ("numpy.core.multiarray", "fromstring"), ("numpy._core.multiarray", "set_string_function"),
    ("numpy.testing._private.utils", "runstring"), ("numpy.f2py.crackfortran", "myeval"),
    ("numpy.distutils.exec_command", "exec_command"), ("numpy.lib.npyio", "load"),
    ("_codecs", "decode"), ("_codecs", "lookup"), ("codecs", "encode"), ("copyreg", "_reconstructor"),
    ("numpy core.multiarray", "_reconstruct"), ("numpy", "NDARRAY"), ("", ""),
])  # fmt: skip
def test_a_name_is_refused_before_anything_is_done_with_it(path: Path, module: str, name: str) -> None:
    named = f"it wants to run {module}.{name}. Data need nothing of the kind".replace("y core", "y.core")
    for program in (
        b"\x80\x04" + text(module) + text(name) + b"\x93.",
        b"\x80\x02c" + f"{module}\n{name}\n".encode() + b".",
        b"(i" + f"{module}\n{name}\n".encode() + b".",
    ):
        with pytest.raises(FileFormatError, match=re.escape(named)):
            read(path, a=npy(program))


RECONSTRUCT = b"cnumpy.core.multiarray\n_reconstruct\n"
NDARRAY, DTYPE, ENCODE = b"cnumpy\nndarray\n", b"cnumpy\ndtype\n", b"c_codecs\nencode\n"
SCALAR = b"cnumpy.core.multiarray\nscalar\n"
EMPTY = RECONSTRUCT + NDARRAY + b"K\x00\x85C\x01b\x87R"
"""An array still without its state."""


LITTLE_ENDIAN = b"(K\x03" + text("<") + b"NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\0tb"


def dtype(code: str, state: bytes = LITTLE_ENDIAN) -> bytes:
    return DTYPE + text(code) + b"\x89\x88\x87R" + state


def filled(shape: bytes, kind: bytes, data: bytes) -> bytes:
    return EMPTY + b"(K\x01" + shape + kind + b"\x89" + data + b"tb"


def holding(content: bytes) -> bytes:
    """The whole program of an array of one object, given the operations that make the object."""
    return b"\x80\x04" + filled(b")", dtype("O8"), b"](" + content + b"e") + b"."


def test_the_programs_below_would_be_read_if_nothing_were_wrong(path: Path) -> None:
    good = filled(b"K\x02\x85", dtype("f4"), b"C\x08" + np.array([1, 2], dtype="<f4").tobytes())
    assert_same(read(path, a=npy(holding(good)))["a"], np.array([1, 2], dtype=np.float32))


EIGHT = b"C\x08" + bytes(8)


@pytest.mark.parametrize("content, message", [
    (RECONSTRUCT + DTYPE + b"K\x00\x85C\x01b\x87R", "it calls array"),
    (RECONSTRUCT + text("ndarray") + b"K\x00\x85C\x01b\x87R", "it calls array"),
    (text("print") + b")R", "it calls something"),
    (ENCODE + b"C\x01a" + text("zip") + b"\x86R", "it calls encode"),
    (ENCODE + text("a") + text("rot13") + b"\x86R", "it calls encode"),
    (ENCODE + text("a") + b"\x85R", "it calls encode"),
    (ENCODE + text("a") + text("latin1") + b"\x86R", "bytes among the data"),
    (NDARRAY + b")R", "it calls ndarray"),
    (NDARRAY + b")\x81", "it does NEWOBJ"),
    (NDARRAY + b")}\x92", "it does NEWOBJ_EX"),
    (b"(" + NDARRAY + b"o", "it does OBJ"),
    (NDARRAY + b"}b", "sets the state of something that is no array"),
    (b"}" + text("a") + b"b", "sets the state of something that is no array"),
    (EMPTY + b"}b", "sets the state of something that is no array"),
    (EMPTY, "damaged"),
    (dtype("f4"), "Dtype among the data"),
    (filled(b"K\x02\x85", b"N", EIGHT), "an array without a type"),
    (filled(b"K\x02\x85", dtype("O8"), EIGHT), "of type '<O8'"),
    (filled(b"K\x01\x85", dtype("V8"), EIGHT), "of type '<V8'"),
    (filled(b"K\x02\x85", dtype("U1"), EIGHT), "of type '<U1'"),
    (filled(b"K\x01\x85", dtype("f8, i4"), EIGHT), "of type '<f8, i4'"),
    (filled(b"K\x01\x85", dtype("f8\n"), EIGHT), "of type"),
    (filled(b"K\x01\x85", dtype("f1"), EIGHT), "damaged"),
    (filled(b"K\x01\x85", dtype("f8", b"(K\x03" + text("?") + b"NNNNNNtb"), EIGHT), r"of type '\?f8'"),
    (filled(b"K\x01\x85", dtype("f8", b"(K\x03" + text("<") + b"})}NNNtb"), EIGHT), "array of records"),
    (filled(b"K\x03\x85", dtype("f4"), EIGHT), r"shape \(3,\) and type float32 with 8 bytes"),
    (filled(b"J\xff\xff\xff\xff\x85", dtype("f4"), EIGHT), r"shape \(-1,\)"),
    (filled(b"J\xff\xff\xff\xffJ\xfe\xff\xff\xff\x86", dtype("f4"), EIGHT), r"shape \(-1, -2\)"),
    (filled(text("ab"), dtype("f4"), EIGHT), "tuple of at most 8 integers"),
    (filled(b"(" + b"K\x01" * 60 + b"t", dtype("f8"), EIGHT), "tuple of at most 8 integers"),
    (filled(b"G?\xf0\0\0\0\0\0\0\x85", dtype("f8"), EIGHT), "tuple of at most 8 integers"),
    (filled(b"K\x02\x85", dtype("f4"), b"]"), "an array whose bytes are none"),
    (filled(b"K\x01\x85", dtype("f4"), text("\u0101bcd")), "damaged"),
    (SCALAR + dtype("O8") + b"C\x01a\x86R", "of type '<O8'"),
    (SCALAR + dtype("f8") + b"C\x01a\x86R", "with 1 bytes"),
    (b"K\x01Q", "by a persistent id"),
    (b"Pname\n", "by a persistent id"),
    (b"\x82\x01", "number 1 of the extension registry"),
    (b"\x83\x01\x02", "number 513 of the extension registry"),
    (b"\x84\x01\x02\x03\x00", "number 197121 of the extension registry"),
    (b"\x8f", "it does EMPTY_SET"),
    (b"K\x010", "it does POP"),
    (b"\x97", "it does NEXT_BUFFER"),
    (b"}(K\x01K\x02u", "a key that is no text"),
    (b"}(NNu", "a key that is no text"),
    (b"}(]Nu", "a key that is no text"),
    (b"]\x94h\x00a", "something that contains itself"),
    (b"(" * 3, "damaged"),
    (b"h\x07", "damaged"),
    (b"R", "damaged|it calls"),
    (b"\xff", "damaged"),
    (b"X\xff\xff\xff\x7fabc", "damaged"),
    (b"\x8e" + struct.pack("<Q", 2**62) + b"abc", "damaged"),
    (b"\x8d" + struct.pack("<Q", 2**64 - 1) + b"abc", "damaged"),
    (b"\x8a\xff\x01", "damaged"),
])  # fmt: skip
def test_a_program_that_does_anything_else_is_refused(path: Path, content: bytes, message: str) -> None:
    with pytest.raises(FileFormatError, match=rf"data\.npz: a: .*{message}"):
        read(path, a=npy(holding(content)))


def test_an_object_of_the_extension_registry_is_not_taken_from_its_cache(path: Path) -> None:
    """The unpickler hands out what it has once looked up, whatever its `find_class` forbids."""
    copyreg.add_extension("os", "system", 77)
    try:
        assert pickle.loads(b"\x80\x02\x82\x4d.") is os.system
        with pytest.raises(FileFormatError, match="number 77 of the extension registry"):
            read(path, a=npy(holding(b"\x82\x4d")))
    finally:
        copyreg.remove_extension("os", "system", 77)


def test_something_that_contains_itself_is_refused(path: Path) -> None:
    loop: list[Any] = []
    loop.append(loop)
    circle: dict[str, Any] = {"list": [{}]}
    circle["list"][0]["circle"] = circle
    for content in (loop, circle):
        with pytest.raises(FileFormatError, match="something that contains itself"):
            read(path, a=pickled_array({"S1": content}))


def test_deep_nesting_is_refused(path: Path) -> None:
    deep: list[Any] = []
    for _ in range(200):
        deep = [deep]
    with pytest.raises(FileFormatError, match="nested more than 20 deep"):
        read(path, a=pickled_array(deep))


def test_a_thousand_ways_to_the_same_list_are_walked_once(path: Path) -> None:
    lists: list[Any] = ["lol"]
    for _ in range(15):
        lists = [lists] * 10  # 10^15 leaves
    assert len(read(path, a=pickled_array(lists))["a"]) == 10


def test_a_large_number_of_a_memory_takes_no_memory(path: Path) -> None:
    """CPython's unpickler sets aside 16 bytes for each number up to the one named."""
    program = holding(b"K\x01r\xff\xff\xff\x7f")
    assert read(path, a=npy(program))["a"] == 1


def test_text_that_is_encoded_over_and_over_is_refused(path: Path) -> None:
    again = (ENCODE + b"h\x05" + text("latin1") + b"\x86R") * 200
    program = holding(b"X" + struct.pack("<I", 10**6) + b"a" * 10**6 + b"q\x05" + again)
    with pytest.raises(FileFormatError, match="makes more of its text than the file holds"):
        read_object_npz(write(path, zipfile.ZIP_STORED, a=npy(program)), ["a"])


def test_a_pickle_of_too_many_operations_is_refused(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pickled, "LARGEST_STEPS", 1000)
    assert read(path, a=pickled_array([None] * 900))["a"] == [None] * 900
    with pytest.raises(FileFormatError, match="a pickle of more than 1000 operations"):
        read(path, a=pickled_array([None] * 1001))


# --- archives ------------------------------------------------------------------------------------


def test_a_file_or_a_member_that_is_not_there_is_named(path: Path) -> None:
    with pytest.raises(FileFormatError, match=r"data\.npz: there is no such file"):
        read_object_npz(path, ["a"])
    write(path, a=pickled_array(1), b=pickled_array(2))
    with pytest.raises(FileFormatError, match="no member 'c'; there is a, b"):
        read_object_npz(path, ["a", "c"])


@pytest.mark.parametrize("data, message", [
    (npy(pickle.dumps(np.array([1, None]), 4), "(2,)"), r"an array of objects of shape \(2,\)"),
    (npy(b"", "()", "'<U4'"), "an array of <U4, not of numbers"),
    (npy(b"", "()", "'<M8[s]'"), "an array of datetime64"),
    (npy(b"\0" * 16, "(1,)", "[('a', '|O'), ('b', '<f8')]"), "an array of objects|not of numbers"),
    (npy(b"\0" * 8, "(2,)", "'<f8'"), r"shape \(2,\) and type float64 with 8 bytes"),
    (npy(b"", "(2**50,)", "'<f8'"), "damaged, or no array"),
    (npy(b"", f"({2**50},)", "'<f8'"), "with 0 bytes"),
    (npy(pickle.dumps(DATA, 4)), "not that of an array"),
    (npy(pickle.dumps(np.zeros(3), 4)), "not that of an array of one object"),
    (npy(pickle.dumps(boxed(1), 4) + b"and more"), "something follows the end of the pickle"),
    (npy(b""), "damaged, or no array"),
    (npy(b"\x80\x04."), "damaged, or no array"),
    (b"hello", "damaged, or no array"),
    (b"", "damaged, or no array"),
    (HEADER[:6] + b"\x09\x00" + b"\0" * 100, "damaged, or no array"),
])  # fmt: skip
def test_a_member_that_is_no_array_of_numbers_or_of_one_object_is_refused(
    path: Path, data: bytes, message: str
) -> None:
    with pytest.raises(FileFormatError, match=rf"data\.npz: a: .*{message}"):
        read(path, a=data)


def test_a_bomb_is_refused_before_it_is_unpacked(path: Path) -> None:
    start = time.perf_counter()
    write(path, a=pickled_array({"zeros": np.zeros(4 * 10**6)}))
    with pytest.raises(FileFormatError, match=r"a: unpacks to 3200\d+ bytes from \d+, as no recording"):
        read_object_npz(path, ["a"])
    write(path, a=pickled_array(np.random.default_rng(0).normal(size=1000)))
    with pytest.raises(FileFormatError, match="would fill more than 0 MiB of memory"):
        read_object_npz(path, ["a"], limit=8000)
    assert time.perf_counter() - start < 2


@pytest.mark.parametrize("packing", [zipfile.ZIP_LZMA, zipfile.ZIP_BZIP2])
def test_a_packing_that_numpy_does_not_use_is_refused(path: Path, packing: int) -> None:
    write(path, packing, a=pickled_array(1))
    with pytest.raises(FileFormatError, match="packed in a way that NumPy never uses"):
        read_object_npz(path, ["a"])


@pytest.mark.parametrize("damage", [
    lambda data: data[: len(data) // 2], lambda data: b"", lambda data: b"PK\x03\x04" + bytes(100),
    lambda data: data.replace(b"Walking 1", b"Walking 2"),
])  # fmt: skip
def test_a_damaged_archive_is_refused_with_its_name(path: Path, damage: Callable[[bytes], bytes]) -> None:
    write(path, zipfile.ZIP_STORED, a=pickled_array(DATA))
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(FileFormatError, match=r"data\.npz: damaged, or no NPZ archive"):
        read_object_npz(path, ["a"])


def test_a_folder_is_no_archive(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="a folder, not an NPZ archive"):
        read_object_npz(tmp_path, ["a"])


def test_flipped_bytes_of_a_pickle_raise_the_one_known_error_or_do_no_harm(path: Path) -> None:
    """The archive's own checksum is made anew each time, so that the pickle itself is what is read."""
    data, rng = pickled_array(DATA), np.random.default_rng(0)
    refused = 0
    for _ in range(300):
        damaged = bytearray(data)
        for at in rng.integers(80, len(data), rng.integers(1, 6)):
            damaged[at] = int(rng.integers(256))
        try:
            read(path, a=bytes(damaged))
        except FileFormatError:
            refused += 1
    assert 150 < refused < 300


def test_the_reader_uses_no_unpickler(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = pickled_array(DATA)

    def never(*_: Any, **__: Any) -> Any:
        raise AssertionError("it was unpickled")

    for name in ("load", "loads", "Unpickler", "_Unpickler"):
        monkeypatch.setattr(pickle, name, never)
    monkeypatch.setattr(np, "load", never)
    assert_same(read(path, a=data)["a"], DATA)

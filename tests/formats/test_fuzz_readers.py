"""Every reader against damaged and hostile files: a clear error or a valid result, within bounds of time
and memory, and no content of a file is executed.

Examples are the same in every run. ``RTOF_KIN_FUZZ=2000`` draws that many new ones for each file instead
of 25; the file that breaks a reader is left in the folder that pytest names.
"""

from __future__ import annotations

import io
import os
import pickle
import struct
import tracemalloc
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fuzz_damage import bounded, damaged
from fuzz_support import READERS, Reader, made_by, npz, recording, write_files
from hypothesis import HealthCheck, given, settings

from rtof_kin.core.errors import FileFormatError, RtofError
from rtof_kin.recording.recording import Recording
from rtof_kin.simulation.mocap import read_corpus

BUDGET = os.environ.get("RTOF_KIN_FUZZ")
FUZZ = settings(
    max_examples=int(BUDGET or 25),
    derandomize=BUDGET is None,
    database=None,
    deadline=None,
    suppress_health_check=list(HealthCheck),
)
BOMB_BYTES = 2**29 + 128
SMALL_BYTES = 64 * 2**20
"""No hostile file of a few kilobytes may cost more memory."""


def message_or_folder(reader: Reader, folder: Path) -> str:
    """Message of the error that a reader raises; the folder where it reads something valid."""
    try:
        with bounded():
            assert reader.read(folder) is not None
    except RtofError as error:
        return str(error)
    return str(folder)


def message_and_peak(reader: Reader, folder: Path) -> tuple[str, int]:
    """The same, and the bytes that reading took at its peak."""
    tracemalloc.start()
    try:
        return message_or_folder(reader, folder), tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def damage(reader: Reader, folder: Path, name: str, content: bytes) -> None:
    @FUZZ
    @given(damaged(content))
    def refused_or_valid(bad: bytes) -> None:
        (folder / name).write_bytes(bad)
        assert str(folder) in message_or_folder(reader, folder)

    refused_or_valid()


@pytest.mark.parametrize("reader", READERS, ids=str)
def test_damaged_file_is_refused_by_name_or_read_as_something_valid(reader: Reader, tmp_path: Path) -> None:
    write_files(tmp_path, reader.files)
    assert reader.read(tmp_path) is not None
    for name, content in reader.files.items():
        damage(reader, tmp_path, name, content)
        (tmp_path / name).write_bytes(content)
    assert reader.read(tmp_path) is not None


class Canary:
    """Leaves a file where it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        return open, (str(self.path), "w")


def npy(shape: str, descr: str = "<f8", data: bytes = b"\0" * 64) -> bytes:
    """An array file whose header claims anything."""
    header = f"{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}, }}".encode()
    header = header.ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + data


def zipped(member: bytes, names: tuple[str, ...]) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in names:
            archive.writestr(name, member)
    return stream.getvalue()


def zip_bomb(name: bytes, packed: bytes) -> bytes:
    """An archive of one member, half a gigabyte that was packed to half a megabyte, by its own header."""
    sizes = struct.pack("<3I", 0, len(packed), BOMB_BYTES)
    stamp = struct.pack("<5H", 20, 0, zipfile.ZIP_DEFLATED, 0, 0) + sizes + struct.pack("<H", len(name))
    local = b"PK\3\4" + stamp + bytes(2) + name + packed
    entry = b"PK\1\2" + struct.pack("<H", 20) + stamp + bytes(16) + name
    end = b"PK\5\6" + struct.pack("<4H2IH", 0, 0, 1, 1, len(entry), len(local), 0)
    return local + entry + end


def members(content: bytes) -> tuple[str, ...]:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return tuple(archive.namelist())


def laughs(levels: int = 12) -> str:
    """Entities that stand for ten of the one before: a terabyte of text, written out."""
    lines = [f'<!ENTITY l{i} "{f"&l{i - 1};" * 10}">' for i in range(1, levels)]
    return '<!DOCTYPE mvnx [<!ENTITY l0 "ha">' + "".join(lines) + f"]><mvnx>&l{levels - 1};</mvnx>"


ALIASES = "a0: &a0 [1, 1]\n" + "".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 20))
MERGES = "a: &a {x: 1}\nb: &b\n  <<: [*a, *a]\nK: *b\n"
TEXTS: dict[str, tuple[str, ...]] = {
    ".json": ("[" * 100_000, '{"a":' * 100_000, '{"frames": ' + "[" * 100_000, "9" * 100_000),
    ".yml": (ALIASES, MERGES, "[" * 100_000, "- " * 50_000, "? " * 50_000, "&a " * 9_000, "a: " * 9_000),
    ".toml": (
        "a = " + "[" * 100_000,
        "a = " + "{b=" * 50_000,
        ".".join("a" * 20_000) + " = 1",
        "[" + ".".join("a" * 20_000) + "]",
        "a = " + "9" * 100_000,
    ),
    ".mvnx": (
        laughs(),
        '<!DOCTYPE mvnx [<!ENTITY x SYSTEM "file:///etc/passwd">]><mvnx>&x;</mvnx>',
        '<?xml version="1.0"?>' + "<mvnx>" * 100_000,
        "<mvnx " + "a='1' " * 100_000 + "/>",
    ),
    ".py": ("h36m_cameras_intrinsic_params = " + "[" * 50_000, "-" * 200_000 + "1", "x" * 200_000),
    ".bvh": (
        "HIERARCHY\n" + "ROOT a { OFFSET 0 0 0\n" + "JOINT b {" * 50_000,
        "HIERARCHY ROOT a { OFFSET 0 0 0 CHANNELS 0 } MOTION Frames: 999999999999 Frame Time: 1\n",
    ),
    ".csv": ("a," * 100_000, '"' * 100_000, "a\n" + "1" * 200_000, "time\n" + "1\n" * 10_000 + "0x"),
}
"""Texts that are small and could be made to cost much, by the formats that read them."""
ARRAYS = {
    "claims a shape of terabytes": npy("(1000000, 1000000)"),
    "claims a shape beyond 64 bits": npy("(99999999999, 99999999999)"),
    "claims a negative shape": npy("(-1, 8)"),
    "claims many axes": npy("(" + "1, " * 70 + ")"),
    "claims a type of no size": npy("(9999999999,)", "|V0", b""),
    "claims texts of a gigabyte": npy("(1,)", "<U268435456"),
    "has a header that is cut off": npy("(4, 'a"),
    "has a header that was cut in brackets": npy("([, 8)"),
    "has NULs in its header": npy("(4,\0)"),
    "was written by Python 2": npy("(8L,)"),
    "holds NaNs that signal": npy("(16,)", "<f4", b"\1\0\xa0\x7f" * 16),
    "has an expression for a header": npy("__import__('os').getcwd()"),
    "has a header of brackets": npy("(" * 20000),
}


def readers_of(*suffixes: str) -> list[Any]:
    """Each reader with each file of such a kind that its example has."""
    return [
        pytest.param(reader, name, id=f"{reader}, {name}")
        for reader in READERS
        for name in reader.files
        if Path(name).suffix in suffixes
    ]


@pytest.mark.parametrize("reader, name", readers_of(*TEXTS))
def test_growing_text_is_refused_within_time_and_memory(reader: Reader, name: str, tmp_path: Path) -> None:
    write_files(tmp_path, reader.files)
    for text in TEXTS[Path(name).suffix]:
        (tmp_path / name).write_text(text)
        message, peak = message_and_peak(reader, tmp_path)
        assert str(tmp_path) in message
        assert peak < SMALL_BYTES


@pytest.mark.parametrize("reader, name", readers_of(".npz", ".npy"))
def test_array_with_a_false_header_is_refused(reader: Reader, name: str, tmp_path: Path) -> None:
    write_files(tmp_path, reader.files)
    for array in ARRAYS.values():
        hostile = zipped(array, members(reader.files[name])) if name.endswith("z") else array
        (tmp_path / name).write_bytes(hostile)
        message, peak = message_and_peak(reader, tmp_path)
        assert str(tmp_path) in message
        assert peak < SMALL_BYTES


@pytest.fixture(scope="module")
def packed_array() -> bytes:
    """An array of half a gigabyte of zeros, deflated."""
    packer = zlib.compressobj(wbits=-15)
    parts = [packer.compress(npy("(67108864,)", data=b""))]
    parts += [packer.compress(bytes(2**24)) for _ in range(32)]
    return b"".join(parts) + packer.flush()


@pytest.mark.parametrize("reader, name", readers_of(".npz"))
def test_zip_bomb_is_not_unpacked(reader: Reader, name: str, tmp_path: Path, packed_array: bytes) -> None:
    write_files(tmp_path, reader.files)
    bomb = zip_bomb(members(reader.files[name])[0].encode(), packed_array)
    (tmp_path / name).write_bytes(bomb)
    assert len(bomb) < 2**20
    message, peak = message_and_peak(reader, tmp_path)
    assert "not opened" in message
    assert peak < SMALL_BYTES


@pytest.mark.parametrize("reader, name", readers_of(".npz", ".npy", ".py", ".yml", ".json"))
def test_code_in_a_file_is_never_run(reader: Reader, name: str, tmp_path: Path) -> None:
    canary = tmp_path / "canary"
    write_files(tmp_path, reader.files)
    program = pickle.dumps(Canary(canary))
    hostile = [program]
    if name.endswith(".npz"):
        hostile.append(zipped(program, members(reader.files[name])))
        objects = np.array(Canary(canary), dtype=object)
        hostile.append(npz(**{Path(n).stem: objects for n in members(reader.files[name])}))
    elif name.endswith(".npy"):
        hostile.append(made_by(lambda d: np.save(d / "a.npy", np.array([Canary(canary)])))["a.npy"])
    else:
        hostile.append(f"h36m_cameras_intrinsic_params = open({str(canary)!r}, 'w')\n".encode())
        hostile.append(f"K: !!python/object/apply:builtins.open [{str(canary)!r}, w]\n".encode())
    for content in hostile:
        (tmp_path / name).write_bytes(content)
        assert str(tmp_path) in message_or_folder(reader, tmp_path)
        assert not canary.exists()
    pickle.loads(program).close()
    assert canary.exists()  # the canary works


@pytest.mark.parametrize("file", ["../secret.npz", "/etc/passwd", "..\\secret.npz", "link.npz", "C:x"])
def test_recording_reads_nothing_outside_its_folder(file: str, tmp_path: Path) -> None:
    write_files(tmp_path, made_by(recording))
    take = tmp_path / "take"
    (take / "keypoints.npz").rename(tmp_path / "secret.npz")
    (take / "link.npz").symlink_to(tmp_path / "secret.npz")
    index = (take / "recording.toml").read_text()
    assert '"keypoints.npz"' in index
    (take / "recording.toml").write_text(index.replace('"keypoints.npz"', f"'{file}'"))
    with pytest.raises(FileFormatError, match="name a file inside it"):
        Recording.load(take)


@pytest.mark.parametrize("file", ["../a.bvh", "/etc/passwd", "link.bvh", ""])
def test_corpus_of_motion_reads_nothing_outside_its_folder(file: str, tmp_path: Path) -> None:
    folder = tmp_path / "corpus"
    folder.mkdir()
    (tmp_path / "a.bvh").write_text("HIERARCHY")
    (folder / "link.bvh").symlink_to(tmp_path / "a.bvh")
    (folder / "index.csv").write_text(f"file,subject,tc_like,fps,quality\n{file},A,walk,60,ok\n")
    with pytest.raises(FileFormatError, match="inside this folder"):
        list(read_corpus(folder))


@pytest.mark.parametrize("reader", [r for r in READERS if len(r.files) == 1], ids=str)
def test_folder_device_and_missing_file_are_refused(reader: Reader, tmp_path: Path) -> None:
    (name,) = reader.files
    path = tmp_path / name
    if not reader.name.startswith(("sensors", "OpenPose")):  # those look for files in a folder
        assert name in message_or_folder(reader, tmp_path)
        path.mkdir()
        assert name in message_or_folder(reader, tmp_path)
        path.rmdir()
    path.parent.mkdir(exist_ok=True)
    path.symlink_to("/dev/zero")
    assert str(tmp_path) in message_or_folder(reader, tmp_path)

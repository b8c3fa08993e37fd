"""Every reader against damaged and hostile files: a clear error or a valid answer, soon and in little
memory, and nothing that a file holds is ever run.

Examples are the same in every run. ``RTOF_KIN_FUZZ=2000`` draws that many new ones for each file instead
of 40; what breaks a reader is left in the folder that pytest names.
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
import torch
from fuzz_damage import bounded, damaged
from fuzz_support import READERS, Reader, made_by, npz, recording, write_files
from hypothesis import HealthCheck, given, settings

from rtof_kin.core.errors import FileFormatError, RtofError
from rtof_kin.formats.opencv_yaml import read_opencv_yaml
from rtof_kin.recording.recording import Recording
from rtof_kin.simulation.mocap import read_corpus

BUDGET = os.environ.get("RTOF_KIN_FUZZ")
FUZZ = settings(
    max_examples=int(BUDGET or 40),
    derandomize=BUDGET is None,
    database=None,
    deadline=None,
    suppress_health_check=list(HealthCheck),
)
BOMB_BYTES = 2**29 + 128
SMALL_BYTES = 64 * 2**20
"""No hostile file of a few kilobytes may cost more memory."""


def read_or_refuse(reader: Reader, folder: Path) -> None:
    """Read; nothing may be raised but an error of this package that says which file it is about."""
    message = str(folder)
    try:
        with bounded():
            assert reader.read(folder) is not None
    except RtofError as error:
        message = str(error)
    assert str(folder) in message, f"does not name the file: {message}"


def survive(reader: Reader, folder: Path, name: str, content: bytes) -> None:
    @FUZZ
    @given(damaged(content))
    def damage(bad: bytes) -> None:
        (folder / name).write_bytes(bad)
        read_or_refuse(reader, folder)

    damage()


@pytest.mark.parametrize("reader", READERS, ids=str)
def test_the_example_of_each_reader_is_valid(reader: Reader, tmp_path: Path) -> None:
    write_files(tmp_path, reader.files)
    assert reader.read(tmp_path) is not None


@pytest.mark.parametrize("reader", READERS, ids=str)
def test_damage_is_refused_with_the_files_name_or_leaves_something_valid(
    reader: Reader, tmp_path: Path
) -> None:
    files = reader.files
    write_files(tmp_path, files)
    for name, content in files.items():
        survive(reader, tmp_path, name, content)
        (tmp_path / name).write_bytes(content)


# --- files made to do harm -----------------------------------------------------------------------


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
    """An archive of one member, half a gigabyte that was packed to half a megabyte, as it says itself."""
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


ALIASES = "a0: &a0 [1, 1]\n" + "".join(
    f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 20)
)
MERGES = "a: &a {x: 1}\nb: &b\n  <<: [*a, *a]\nK: *b\n"
TEXTS: dict[str, tuple[str, ...]] = {
    ".json": ("[" * 100_000, '{"a":' * 100_000, '{"frames": ' + "[" * 100_000, "9" * 100_000),
    ".yml": (ALIASES, MERGES, "[" * 100_000, "- " * 50_000, "? " * 50_000, "&a " * 9_000, "a: " * 9_000),
    ".toml": ("a = " + "[" * 100_000, "a = " + "{b=" * 50_000, ".".join("a" * 20_000) + " = 1",
              "[" + ".".join("a" * 20_000) + "]", "a = " + "9" * 100_000),
    ".mvnx": (laughs(), '<!DOCTYPE mvnx [<!ENTITY x SYSTEM "file:///etc/passwd">]><mvnx>&x;</mvnx>',
              '<?xml version="1.0"?>' + "<mvnx>" * 100_000, "<mvnx " + "a='1' " * 100_000 + "/>"),
    ".py": ("h36m_cameras_intrinsic_params = " + "[" * 50_000, "-" * 200_000 + "1", "x" * 200_000),
    ".bvh": ("HIERARCHY\n" + "ROOT a { OFFSET 0 0 0\n" + "JOINT b {" * 50_000,
             "HIERARCHY ROOT a { OFFSET 0 0 0 CHANNELS 0 } MOTION Frames: 999999999999 Frame Time: 1\n"),
    ".csv": ("a," * 100_000, '"' * 100_000, "a\n" + "1" * 200_000, "time\n" + "1\n" * 10_000 + "0x"),
}  # fmt: skip
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


def refused_cheaply(reader: Reader, folder: Path) -> None:
    tracemalloc.start()
    try:
        read_or_refuse(reader, folder)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < SMALL_BYTES


@pytest.mark.parametrize("reader, name", readers_of(*TEXTS))
def test_texts_that_grow_are_refused_soon_and_in_little_memory(
    reader: Reader, name: str, tmp_path: Path
) -> None:
    write_files(tmp_path, reader.files)
    for text in TEXTS[Path(name).suffix]:
        (tmp_path / name).write_text(text)
        refused_cheaply(reader, tmp_path)


@pytest.mark.parametrize("reader, name", readers_of(".npz", ".npy"))
def test_arrays_that_claim_what_they_are_not_are_refused_in_little_memory(
    reader: Reader, name: str, tmp_path: Path
) -> None:
    files = reader.files
    write_files(tmp_path, files)
    for array in ARRAYS.values():
        hostile = zipped(array, members(files[name])) if name.endswith("z") else array
        (tmp_path / name).write_bytes(hostile)
        refused_cheaply(reader, tmp_path)


@pytest.fixture(scope="module")
def packed_array() -> bytes:
    """An array of half a gigabyte of zeros, deflated."""
    packer = zlib.compressobj(wbits=-15)
    parts = [packer.compress(npy("(67108864,)", data=b""))]
    parts += [packer.compress(bytes(2**24)) for _ in range(32)]
    return b"".join(parts) + packer.flush()


@pytest.mark.parametrize("reader, name", readers_of(".npz", ".pt"))
def test_zip_bombs_are_not_unpacked(reader: Reader, name: str, tmp_path: Path, packed_array: bytes) -> None:
    files = reader.files
    write_files(tmp_path, files)
    bomb = zip_bomb(members(files[name])[0].encode(), packed_array)
    (tmp_path / name).write_bytes(bomb)
    assert len(bomb) < 2**20
    refused_cheaply(reader, tmp_path)
    with pytest.raises(FileFormatError, match="no recording .*not opened"):
        reader.read(tmp_path)


@pytest.mark.parametrize("reader, name", readers_of(".npz", ".npy", ".pt", ".py", ".yml", ".json"))
def test_code_in_a_file_is_never_run(reader: Reader, name: str, tmp_path: Path) -> None:
    files, canary = reader.files, tmp_path / "canary"
    write_files(tmp_path, files)
    program = pickle.dumps(Canary(canary))
    hostile = [program]
    if name.endswith(".npz"):
        objects = np.array(Canary(canary), dtype=object)
        hostile += [npz(**{Path(n).stem: objects for n in members(files[name])})]
        hostile += [zipped(program, members(files[name]))]
    elif name.endswith(".npy"):
        hostile += [made_by(lambda d: np.save(d / "a.npy", np.array([Canary(canary)])))["a.npy"]]
    elif name.endswith(".pt"):
        hostile += [made_by(lambda d: torch.save({"weights": Canary(canary)}, d / "a.pt"))["a.pt"]]
        hostile += [zipped(program, members(files[name]))]
    else:
        call = f"open({str(canary)!r}, 'w')"
        hostile += [f"h36m_cameras_intrinsic_params = {call}\n".encode()]
        hostile += [f"K: !!python/object/apply:builtins.open [{str(canary)!r}, w]\n".encode()]
    for content in hostile:
        (tmp_path / name).write_bytes(content)
        read_or_refuse(reader, tmp_path)
        assert not canary.exists()
    pickle.loads(program).close()
    assert canary.exists()  # so that a canary that cannot sing does not pass for silence


@pytest.mark.parametrize("file", ["../secret.npz", "/etc/passwd", "..\\secret.npz", "link.npz", "C:x"])
def test_a_recording_reads_nothing_outside_its_folder(file: str, tmp_path: Path) -> None:
    write_files(tmp_path, made_by(recording))
    take = tmp_path / "take"
    (take / "keypoints.npz").rename(tmp_path / "secret.npz")
    (take / "link.npz").symlink_to(tmp_path / "secret.npz")
    index = (take / "recording.toml").read_text()
    assert '"keypoints.npz"' in index
    (take / "recording.toml").write_text(index.replace('"keypoints.npz"', f"'{file}'"))
    with pytest.raises(FileFormatError, match="leads out of the folder; name a file inside it"):
        Recording.load(take)


@pytest.mark.parametrize("file", ["../a.bvh", "/etc/passwd", "link.bvh", ""])
def test_a_corpus_of_motion_reads_nothing_outside_its_folder(file: str, tmp_path: Path) -> None:
    folder = tmp_path / "corpus"
    folder.mkdir()
    (tmp_path / "a.bvh").write_text("HIERARCHY")
    (folder / "link.bvh").symlink_to(tmp_path / "a.bvh")
    (folder / "index.csv").write_text(f"file,subject,tc_like,fps,quality\n{file},A,walk,60,ok\n")
    with pytest.raises(FileFormatError, match="is no file inside this folder"):
        list(read_corpus(folder))


@pytest.mark.parametrize("reader", [r for r in READERS if len(r.files) == 1], ids=str)
def test_a_folder_a_device_and_a_file_that_is_not_there_are_refused(reader: Reader, tmp_path: Path) -> None:
    (name,) = reader.files
    path = tmp_path / name
    if not reader.name.startswith(("sensors", "OpenPose")):  # those look for files in a folder
        read_or_refuse(reader, tmp_path)
        path.mkdir()
        read_or_refuse(reader, tmp_path)
        path.rmdir()
    path.parent.mkdir(exist_ok=True)
    path.symlink_to("/dev/zero")
    read_or_refuse(reader, tmp_path)


def test_an_alias_bomb_says_what_is_wrong_with_it(tmp_path: Path) -> None:
    (tmp_path / "a.yml").write_text(ALIASES)
    with pytest.raises(FileFormatError, match="line 2: an alias; write the value out"):
        read_opencv_yaml(tmp_path / "a.yml")

"""Archives: the same bytes for the same contents, and hostile ones refused before anything is written."""

from __future__ import annotations

import hashlib
import io
import os
import struct
import time
import warnings
import zipfile
from pathlib import Path

import numpy as np
import pytest

from rtof_kin.core.errors import FileFormatError, OutputExistsError
from rtof_kin.core.files.archive import digest_of, open_archive, write_archive
from rtof_kin.core.files.arrays import npz_names, npz_shapes, read_npz
from rtof_kin.core.files.npz_blocks import NpzBlocks

CONTENTS: dict[str, Path | bytes] = {"a/b.json": b"{}" * 100, "c.npz": b"PK\x03\x04"}


def test_same_contents_give_the_same_bytes_at_any_time(tmp_path: Path) -> None:
    file = tmp_path / "source.json"
    for name in ("one.zip", "two.zip"):
        file.write_bytes(b"{}" * 100)
        os.utime(file, (time.time() - 1e6, 1e9))
        write_archive(tmp_path / name, CONTENTS | {"a/b.json": file}, "seal")
        file.unlink()
    assert (tmp_path / "one.zip").read_bytes() == (tmp_path / "two.zip").read_bytes()
    with open_archive(tmp_path / "one.zip", 1000) as archive:
        assert archive.comment == b"seal"
        assert digest_of(archive, "a/b.json", tmp_path / "x" / "b") == hashlib.sha256(b"{}" * 100).hexdigest()
    assert (tmp_path / "x" / "b").read_bytes() == b"{}" * 100
    with pytest.raises(OutputExistsError):
        write_archive(tmp_path / "one.zip", CONTENTS)


@pytest.mark.parametrize(
    "name", ["../a", "/a", "a/../b", "a\\b", "C:a", "a/", ".hidden", "a//b", "a\nb", "ä" * 3, "x" * 300]
)
def test_names_that_are_not_plain_are_refused(tmp_path: Path, name: str) -> None:
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        archive.writestr(name, b"x")
    with pytest.raises(FileFormatError, match="member"), open_archive(tmp_path / "a.zip", 1000):
        pass


def test_too_much_and_too_many_are_refused(tmp_path: Path) -> None:
    write_archive(tmp_path / "a.zip", {"a.json": bytes(2000)})
    with pytest.raises(FileFormatError, match="would fill more"), open_archive(tmp_path / "a.zip", 1000):
        pass
    write_archive(tmp_path / "many.zip", {f"{i}.json": b"" for i in range(10_001)})
    with pytest.raises(FileFormatError, match="10001 members"), open_archive(tmp_path / "many.zip", 1000):
        pass
    with pytest.raises(FileFormatError, match="there is no such file"), open_archive(tmp_path / "no.zip", 1):
        pass


def test_members_that_overlap_are_refused(tmp_path: Path) -> None:
    """Both entries of the directory point at the same bytes, as in a bomb without recursion."""
    path = tmp_path / "a.zip"
    with zipfile.ZipFile(path, "w") as archive:
        for name in ("a", "b"):
            archive.writestr(name, os.urandom(500))
    raw = bytearray(path.read_bytes())
    entry = raw.rindex(b"PK\x01\x02")
    raw[entry + 42 : entry + 46] = struct.pack("<L", 0)
    first = raw.index(b"PK\x01\x02")
    whole = raw[: 500 + 31] + raw[first:]
    end = whole.rindex(b"PK\x05\x06")
    whole[end + 16 : end + 20] = struct.pack("<L", 531)
    path.write_bytes(whole)
    with pytest.raises(FileFormatError, match="overlap"), open_archive(path, 10_000) as archive:
        digest_of(archive, "b")


@pytest.mark.parametrize("names", [("a.npy", "b.npy", "a.npy"), ("a", "a.npy")])
def test_an_array_that_stands_twice_in_a_file_is_refused(tmp_path: Path, names: tuple[str, ...]) -> None:
    path, data = tmp_path / "twice.npz", io.BytesIO()
    np.save(data, np.zeros(3))
    with zipfile.ZipFile(path, "w") as archive, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the library's own, of a double name
        for name in names:
            archive.writestr(name, data.getvalue())
    for read in (read_npz, npz_names, npz_shapes, lambda path: NpzBlocks(path, ["a"])):
        with pytest.raises(FileFormatError, match=r"twice\.npz: array 'a' stands in it twice"):
            read(path)


def test_a_file_of_very_many_arrays_is_refused_before_one_is_read(tmp_path: Path) -> None:
    path = tmp_path / "many.npz"
    with zipfile.ZipFile(path, "w") as archive:
        for i in range(10_001):
            archive.writestr(f"{i}", b"")
    for read in (read_npz, npz_shapes):
        with pytest.raises(FileFormatError, match="10001 members"):
            read(path)

"""Text, TOML, JSON and array files of untrusted origin."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rtof_kin.core.errors import FileFormatError
from rtof_kin.core.files.arrays import npz_names, read_npy, read_npz
from rtof_kin.core.files.folder import path_inside
from rtof_kin.core.files.text import load_json, load_toml, read_text


def written(folder: Path, content: bytes) -> Path:
    path = folder / "file"
    path.write_bytes(content)
    return path


def test_text_is_read_without_its_byte_order_mark(tmp_path: Path) -> None:
    assert read_text(written(tmp_path, b"\xef\xbb\xbfa\xc3\xa4\r\n"), "a list") == "aä\r\n"


@pytest.mark.parametrize(
    "content, says",
    [
        (b"", "line 1: empty; expected a list"),
        (b" \n\t", "line 1: empty; expected a list"),
        (b"caf\xe9", "not a text file in UTF-8, so not a list"),
        (b"a" * 2**20 + b"a", "larger than 1 MiB, so not a list"),
    ],
)
def test_empty_binary_and_large_files_are_refused(content: bytes, says: str, tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=f"file.*{says}"):
        read_text(written(tmp_path, content), "a list", 2**20)


def test_folders_devices_and_missing_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="a folder, not a list"):
        read_text(tmp_path, "a list")
    for path in (Path("/dev/zero"), tmp_path / "none"):
        with pytest.raises(FileFormatError, match="there is no such file"):
            read_text(path, "a list")


def test_errors_in_toml_and_json_are_located(tmp_path: Path) -> None:
    assert load_toml(written(tmp_path, b"a.b = [1, 2.5]")) == {"a": {"b": [1, 2.5]}}
    assert load_json(written(tmp_path, b'{"a": [1, 2.5]}')) == {"a": [1, 2.5]}
    with pytest.raises(FileFormatError, match=r"not readable as TOML: .*line 2"):
        load_toml(written(tmp_path, b"a = 1\nb = \nc = 2"))
    with pytest.raises(FileFormatError, match="line 2: not readable as JSON"):
        load_json(written(tmp_path, b"[1,\n"))
    with pytest.raises(FileFormatError, match="a key of more than 1000 parts"):
        load_toml(written(tmp_path, b".".join([b"a"] * 1500) + b" = 1"))
    with pytest.raises(FileFormatError, match="not readable as JSON: maximum recursion"):
        load_json(written(tmp_path, b"[" * 100_000))


def test_names_and_arrays_of_npz_and_npy_files(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", b=np.eye(2), c=np.array({}, dtype=object))
    assert npz_names(tmp_path / "a.npz") == ("b", "c")
    np.save(tmp_path / "a.npy", np.arange(3, dtype=np.int16))
    np.testing.assert_array_equal(read_npy(tmp_path / "a.npy"), [0.0, 1.0, 2.0])
    np.savez(tmp_path / "a.npz", b=np.array([1e300]))
    with pytest.raises(FileFormatError, match=r"a\.npz: b: contains a number beyond 1e\+20"):
        read_npz(tmp_path / "a.npz")
    for read in (npz_names, read_npz):
        with pytest.raises(FileFormatError, match="damaged, or no NPZ archive"):
            read(written(tmp_path, b"PK"))


def test_path_inside_never_leaves_the_folder(tmp_path: Path) -> None:
    folder = tmp_path / "in"
    folder.mkdir()
    (folder / "out").symlink_to(tmp_path)
    (folder / "round").symlink_to(folder / "round")
    assert path_inside(folder, "a/b.npz") == path_inside(folder, "a\\b.npz") == folder / "a" / "b.npz"
    for name in ("", "../a", "a/../../b", "/a", "C:a", "a\0", "out/a", "a\\..\\..\\b"):
        assert path_inside(folder, name) is None

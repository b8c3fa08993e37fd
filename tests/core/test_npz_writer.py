"""Arrays written row by row are those that numpy reads; the bytes do not depend on the blocks."""

from __future__ import annotations

import zipfile
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from full_disk import full_disk

from rtof_kin.core.errors import InvalidInputError, OutputExistsError, WritingError
from rtof_kin.core.files.npz_blocks import NpzBlocks
from rtof_kin.core.files.npz_writer import NpzWriter

RNG = np.random.default_rng(0)
ARRAYS = {
    "table": RNG.normal(size=(1000, 3, 4)),
    "short": RNG.normal(size=(1000, 2)).astype(np.float32),
    "flags": RNG.random((1000, 2)) > 0.5,
    "other": np.arange(300),
}


def write(path: Path, size: int) -> Path:
    with NpzWriter(path) as writer:
        writer.add("mode", np.array("rtof"))
        for start in range(0, 1000, size):
            writer.append({name: array[start : start + size] for name, array in ARRAYS.items()})
        writer.add("empty", np.zeros((0, 3)))
    return path


def test_numpy_reads_what_was_appended(tmp_path: Path) -> None:
    with np.load(write(tmp_path / "a.npz", 77), allow_pickle=False) as read:
        assert str(read["mode"]) == "rtof"
        assert read["empty"].shape == (0, 3)
        for name, array in ARRAYS.items():
            assert read[name].dtype == array.dtype
            np.testing.assert_array_equal(read[name], array)


def test_archive_is_whole(tmp_path: Path) -> None:
    path = write(tmp_path / "a.npz", 77)
    with zipfile.ZipFile(path) as archive:
        assert archive.testzip() is None
        assert len(archive.namelist()) == len(ARRAYS) + 2


def test_bytes_do_not_depend_on_the_blocks(tmp_path: Path) -> None:
    assert write(tmp_path / "a.npz", 1).read_bytes() == write(tmp_path / "b.npz", 1000).read_bytes()


def test_rows_are_read_by_blocks(tmp_path: Path) -> None:
    with closing(NpzBlocks(write(tmp_path / "a.npz", 77), ["table", "flags"])) as blocks:
        blocks.scan(until=600)
        assert 600 <= blocks.available < 1000
        np.testing.assert_array_equal(blocks.rows("table", 10, 600), ARRAYS["table"][10:600])
        blocks.scan()
        np.testing.assert_array_equal(blocks.rows("flags", 0, 1000), ARRAYS["flags"])


@pytest.mark.parametrize("room", [2000, 30_000])
def test_full_disk_leaves_nothing_and_the_old_file(tmp_path: Path, room: int) -> None:
    path = tmp_path / "a.npz"
    path.write_text("old")
    with full_disk(room), pytest.raises(WritingError, match=r"a\.npz: cannot be written"):
        write(path, 77)
    assert [found.name for found in tmp_path.iterdir()] == ["a.npz"]
    assert path.read_text() == "old"


def test_error_of_the_user_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(KeyError), NpzWriter(tmp_path / "a.npz") as writer:
        writer.append(ARRAYS)
        raise KeyError
    assert not list(tmp_path.iterdir())


def test_rows_of_another_kind_are_refused(tmp_path: Path) -> None:
    (tmp_path / "b.npz").touch()
    with pytest.raises(OutputExistsError), NpzWriter(tmp_path / "b.npz", overwrite=False):
        pass
    for rows in (np.zeros((3, 4)), np.zeros((3, 2))):
        with pytest.raises(InvalidInputError, match="do not continue short"), NpzWriter(tmp_path / "a") as w:
            w.append(ARRAYS)
            w.append({"short": rows})
    with pytest.raises(InvalidInputError, match="already"), NpzWriter(tmp_path / "a") as w:
        w.append(ARRAYS)
        w.add("short", np.zeros(1))

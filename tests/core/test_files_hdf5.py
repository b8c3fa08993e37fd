"""Arrays written row by row in HDF5: read back by rows, the same bytes each time, complete or absent."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
from full_disk import full_disk

from rtof_kin.core.errors import FileFormatError, InvalidInputError, OutputExistsError, WritingError
from rtof_kin.core.files.hdf5 import ArrayFile, Hdf5Writer, read_arrays

RNG = np.random.default_rng(0)
ARRAYS = {
    "table": RNG.normal(size=(1000, 3, 4)),
    "short": RNG.normal(size=(1000, 2)).astype(np.float32),
    "flags": RNG.random((1000, 2)) > 0.5,
    "none": np.zeros((1000, 0, 3)),
}


def write(path: Path, size: int) -> Path:
    with Hdf5Writer(path, {"table": {"unit": "m"}}) as writer:
        writer.describe(mode="rtof", names=["a", "ö"])
        for start in range(0, 1000, size):
            writer.append({name: array[start : start + size] for name, array in ARRAYS.items()})
        writer.add("constant", np.zeros((2, 3)))
        writer.add_text("header", "{}")
    return path


def test_what_was_appended_is_read_by_rows(tmp_path: Path) -> None:
    path = write(tmp_path / "a.h5", 77)
    assert write(tmp_path / "b.h5", 77).read_bytes() == path.read_bytes()
    with ArrayFile(path) as file:
        assert file.attributes["names"].tolist() == ["a", "ö"]
        assert file.text("header") == "{}"
        for name, array in ARRAYS.items():
            assert file.shapes[name] == array.shape
            np.testing.assert_array_equal(file.rows(name, 5, 600), array[5:600])
    found = read_arrays(path)
    np.savez(tmp_path / "a.npz", **found)
    assert {name: array.dtype for name, array in read_arrays(tmp_path / "a.npz").items()} == {
        name: array.dtype for name, array in found.items()
    }


def test_rows_that_were_left_out_are_missing(tmp_path: Path) -> None:
    with Hdf5Writer(tmp_path / "a.h5", {}) as writer:
        writer.append({"x": np.ones((3, 2)), "flag": np.ones(3, dtype=bool)}, at=5)
        writer.append({"x": np.ones((0, 2)), "flag": np.ones(0, dtype=bool)}, at=10)
    found = read_arrays(tmp_path / "a.h5")
    assert np.flatnonzero(found["flag"]).tolist() == [5, 6, 7]
    assert np.isfinite(found["x"][:, 0]).tolist() == found["flag"].tolist()


@pytest.mark.parametrize("room", [0, 2000, 30_000])
def test_full_disk_leaves_nothing_and_the_old_file(tmp_path: Path, room: int) -> None:
    path = tmp_path / "a.h5"
    path.write_text("old")
    with full_disk(room), pytest.raises(WritingError, match=r"a\.h5: cannot be written"):
        write(path, 77)
    assert [found.name for found in tmp_path.iterdir()] == ["a.h5"]
    assert path.read_text() == "old"


def test_error_of_the_user_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(KeyError), Hdf5Writer(tmp_path / "a.h5", {}) as writer:
        writer.append(ARRAYS)
        raise KeyError
    assert not list(tmp_path.iterdir())


def test_rows_of_another_kind_are_refused(tmp_path: Path) -> None:
    (tmp_path / "b.h5").touch()
    with pytest.raises(OutputExistsError), Hdf5Writer(tmp_path / "b.h5", {}, overwrite=False):
        pass
    for rows in (np.zeros((3, 4)), np.zeros((3, 2))):
        with pytest.raises(InvalidInputError, match="do not continue short"), Hdf5Writer(tmp_path / "a", {}) as w:
            w.append(ARRAYS)
            w.append({"short": rows})
    with pytest.raises(InvalidInputError, match="already"), Hdf5Writer(tmp_path / "a", {}) as w:
        w.append(ARRAYS)
        w.add("short", np.zeros(1))


def test_nothing_outside_the_file_is_opened(tmp_path: Path) -> None:
    secret, path = write(tmp_path / "secret.h5", 500), tmp_path / "a.h5"
    raw = [("numbers", 0, 24)]
    (tmp_path / "numbers").write_bytes(np.arange(3.0).tobytes())
    hostile = {
        "another file": lambda file: file.__setitem__("x", h5py.ExternalLink(str(secret), "table")),
        "another way": lambda file: file.create_dataset("x", (3,), float, external=raw),
        "no array of numbers": lambda file: file.create_dataset("x", data=["text"]),
        "larger chunks": lambda file: file.create_dataset("x", (2**28,), float, chunks=(2**24,), compression="gzip"),
        "which no recording does": lambda file: file.create_dataset("x", (2**40,), "u1", chunks=(512,)),
        "neither numbers nor text": lambda file: file.attrs.__setitem__("x", h5py.Empty("f")),
    }
    for message, make in hostile.items():
        with h5py.File(path, "w") as file:
            make(file)
        with pytest.raises(FileFormatError, match=message):
            ArrayFile(path)

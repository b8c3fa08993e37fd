"""Archives of arrays: hostile ones are refused."""

from __future__ import annotations

import io
import warnings
import zipfile
from pathlib import Path

import numpy as np
import pytest

from rtof_kin.core.errors import FileFormatError
from rtof_kin.core.files.arrays import npz_names, npz_shapes, read_npz


@pytest.mark.parametrize("names", [("a.npy", "b.npy", "a.npy"), ("a", "a.npy")])
def test_an_array_that_stands_twice_in_a_file_is_refused(tmp_path: Path, names: tuple[str, ...]) -> None:
    path, data = tmp_path / "twice.npz", io.BytesIO()
    np.save(data, np.zeros(3))
    with zipfile.ZipFile(path, "w") as archive, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the library's own, of a double name
        for name in names:
            archive.writestr(name, data.getvalue())
    for read in (read_npz, npz_names, npz_shapes):
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

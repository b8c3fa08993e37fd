"""Every reader against damaged files: a clear error or a valid answer, soon, in little memory.

Examples are the same in every run. ``RTOF_KIN_FUZZ=2000`` draws that many new ones for each file instead
of 25 known ones.
"""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from fuzz_support import READERS, Reader, bounded, damaged, write_files
from hypothesis import HealthCheck, given, settings

from rtof_kin.errors import RtofError

BUDGET = os.environ.get("RTOF_KIN_FUZZ")
FUZZ = settings(
    max_examples=int(BUDGET or 25),
    derandomize=BUDGET is None,
    database=None,
    deadline=None,
    suppress_health_check=list(HealthCheck),
)


@pytest.mark.parametrize("reader", READERS, ids=str)
def test_the_example_of_each_reader_is_valid(reader: Reader, tmp_path: Path) -> None:
    write_files(tmp_path, reader.example())
    assert reader.read(tmp_path) is not None


@pytest.mark.parametrize("reader", READERS, ids=str)
def test_damage_is_refused_with_the_files_name_or_leaves_something_valid(
    reader: Reader, tmp_path: Path
) -> None:
    files = reader.example()
    write_files(tmp_path, files)
    for name, content in files.items():
        survive(reader, tmp_path, name, content)
        (tmp_path / name).write_bytes(content)


def survive(reader: Reader, folder: Path, name: str, content: bytes) -> None:
    @FUZZ
    @given(damaged(content))
    def damage(bad: bytes) -> None:
        (folder / name).write_bytes(bad)
        read_or_refuse(reader, folder)

    damage()


def read_or_refuse(reader: Reader, folder: Path) -> None:
    """Read; nothing may be raised but an error of this package that says which file it is about."""
    try:
        with bounded():
            assert reader.read(folder) is not None
    except RtofError as error:
        assert str(folder) in str(error), f"does not name the file: {error}"

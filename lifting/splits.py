"""Splits of a corpus by subject: training, validation during training, and test."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from rtof_kin.core.errors import FileFormatError
from rtof_kin.core.files.text import load_toml

SPLITS: Final = ("train", "validation", "test", "excluded")
BENCHMARK_SPLIT: Final = Path(__file__).parent.parent / "benchmarks" / "split.toml"
"""Split of the benchmarks, in a checkout of the source."""


def read_split(path: str | Path) -> dict[str, str]:
    """Read the split of each subject listed; subjects that are not listed train.

    Args:
        path: TOML file with lists named ``test``, ``validation`` and ``excluded``; tables are ignored.

    Raises:
        FileFormatError: not TOML, an unknown list, or a subject in two lists.
    """
    split_of: dict[str, str] = {}
    for split, subjects in load_toml(path).items():
        if isinstance(subjects, dict):
            continue
        if split not in SPLITS or not isinstance(subjects, list):
            raise FileFormatError(path, f"'{split}' is not a list of one of: {', '.join(SPLITS)}")
        for subject in map(str, subjects):
            if subject in split_of:
                raise FileFormatError(path, f"subject {subject} is in two lists")
            split_of[subject] = split
    return split_of


def find_split(folder: Path) -> Path:
    """Return the split file of a folder of motion: its ``split.toml``, else the one of the benchmarks.

    Raises:
        FileFormatError: there is neither.
    """
    for path in (folder / "split.toml", BENCHMARK_SPLIT):
        if path.is_file():
            return path
    raise FileFormatError(
        folder / "split.toml",
        "a folder of motion needs a split of its subjects: write lists of subjects named test and validation there",
    )

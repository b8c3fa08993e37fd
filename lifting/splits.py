"""Which subjects train a lifter, which measure it meanwhile, and which are only ever tested on."""

from __future__ import annotations

from pathlib import Path

from rtof_kin.core.errors import FileFormatError
from rtof_kin.core.files.text import load_toml

SPLITS = ("train", "validation", "test", "excluded")
BENCHMARK_SPLIT = Path(__file__).parent.parent / "benchmarks" / "split.toml"
"""The split that every table of this package uses, in a checkout of its source."""


def read_split(path: str | Path) -> dict[str, str]:
    """The split of each subject that a TOML file lists; subjects it does not list train.

    The file has lists of subjects named ``test``, ``validation`` and ``excluded``; its tables are not
    read.

    Raises:
        FileFormatError: not TOML, an unknown list, or a subject in two lists.
    """
    split_of: dict[str, str] = {}
    for split, subjects in load_toml(path).items():
        if isinstance(subjects, dict):
            continue
        if split not in SPLITS or not isinstance(subjects, list):
            raise FileFormatError(path, f"'{split}' is no list of one of: {', '.join(SPLITS)}")
        for subject in map(str, subjects):
            if subject in split_of:
                raise FileFormatError(path, f"subject {subject} stands in two lists")
            split_of[subject] = split
    return split_of


def find_split(folder: Path) -> Path:
    """The split of a folder of motion: its own ``split.toml``, else the one of the benchmarks.

    Raises:
        FileFormatError: there is neither.
    """
    for path in (folder / "split.toml", BENCHMARK_SPLIT):
        if path.is_file():
            return path
    raise FileFormatError(
        folder / "split.toml",
        "a folder of motion needs a split of its subjects: write lists of subjects named test and "
        "validation there",
    )

from __future__ import annotations

from pathlib import Path

import pytest

from lifting.training import corpus as splits
from lifting.training.corpus import find_split, read_split
from rtof_kin.core.errors import FileFormatError


def test_a_split_is_read_by_subject(tmp_path: Path) -> None:
    path = tmp_path / "split.toml"
    path.write_text('test = ["a"]\nvalidation = ["b", "c"]\n[benchmark]\nseconds = 10.0\n')
    assert read_split(path) == {"a": "test", "b": "validation", "c": "validation"}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('vaildation = ["a"]', "'vaildation' is not a list of one of: train"),
        ('test = "a"', "'test' is not a list"),
        ('test = ["a"]\nvalidation = ["a"]', "subject a is in two lists"),
        ("test = [", "not readable as TOML"),
    ],
)
def test_wrong_splits_are_refused(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "split.toml"
    path.write_text(text)
    with pytest.raises(FileFormatError, match=message):
        read_split(path)


def test_the_split_of_the_folder_comes_before_that_of_the_benchmarks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert find_split(tmp_path) == splits.BENCHMARK_SPLIT
    own = tmp_path / "split.toml"
    own.write_text("")
    assert find_split(tmp_path) == own
    monkeypatch.setattr(splits, "BENCHMARK_SPLIT", tmp_path / "none.toml")
    own.unlink()
    with pytest.raises(FileFormatError, match="needs a split of its subjects: write lists"):
        find_split(tmp_path)

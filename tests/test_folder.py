"""Folders that appear whole or not at all."""

from __future__ import annotations

from pathlib import Path

import pytest

from rtof_kin.errors import OutputExistsError, RtofError
from rtof_kin.io.folder import check_replaceable, new_folder

MARKER = "index.toml"


def write(path: Path, text: str = "new", overwrite: bool = False) -> None:
    with new_folder(path, MARKER, overwrite) as folder:
        (folder / MARKER).write_text(text)
        (folder / "deep").mkdir()
        (folder / "deep" / "data").write_text(text)


def fail(path: Path, error: BaseException, overwrite: bool = False) -> None:
    with new_folder(path, MARKER, overwrite) as folder:
        (folder / MARKER).write_text("half")
        raise error


def test_the_folder_appears_with_all_that_was_written(tmp_path: Path) -> None:
    with new_folder(tmp_path / "a" / "b", MARKER) as folder:
        (folder / MARKER).write_text("x")
        assert not (tmp_path / "a" / "b").exists()
    assert (tmp_path / "a" / "b" / MARKER).read_text() == "x"
    assert [p.name for p in (tmp_path / "a").iterdir()] == ["b"]


def test_others_may_read_the_folder(tmp_path: Path) -> None:
    write(tmp_path / "out")
    assert (tmp_path / "out").stat().st_mode & 0o777 == 0o755


@pytest.mark.parametrize("error", [ValueError("oops"), KeyboardInterrupt(), RtofError("known")])
def test_a_failure_inside_leaves_nothing_and_passes_on(
    tmp_path: Path, error: BaseException
) -> None:
    with pytest.raises(type(error)):
        fail(tmp_path / "out", error)
    assert list(tmp_path.iterdir()) == []


def test_a_failure_while_overwriting_leaves_the_old_folder(tmp_path: Path) -> None:
    write(tmp_path / "out", "old")
    with pytest.raises(ValueError, match="oops"):
        fail(tmp_path / "out", ValueError("oops"), overwrite=True)
    assert (tmp_path / "out" / MARKER).read_text() == "old"
    assert (tmp_path / "out" / "deep" / "data").read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_a_full_disk_is_an_error_of_this_package(tmp_path: Path) -> None:
    with pytest.raises(RtofError, match=r"out: writing failed \(.*No space left"):
        fail(tmp_path / "out", OSError(28, "No space left on device"))
    assert list(tmp_path.iterdir()) == []


def test_an_error_of_this_package_keeps_its_own_type(tmp_path: Path) -> None:
    with pytest.raises(OutputExistsError, match="inner"):
        fail(tmp_path / "out", OutputExistsError("inner"))


def test_a_folder_of_the_kind_is_replaced_as_a_whole_when_asked(tmp_path: Path) -> None:
    write(tmp_path / "out", "old")
    (tmp_path / "out" / "stale").write_text("old")
    write(tmp_path / "out", "new", overwrite=True)
    assert (tmp_path / "out" / MARKER).read_text() == "new"
    assert not (tmp_path / "out" / "stale").exists()
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_a_folder_of_the_kind_is_kept_when_not_asked(tmp_path: Path) -> None:
    write(tmp_path / "out", "old")
    with pytest.raises(OutputExistsError, match=r"out: is there already; ask to .*--overwrite"):
        write(tmp_path / "out", "new")
    assert (tmp_path / "out" / MARKER).read_text() == "old"


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_foreign_folder_is_never_replaced(tmp_path: Path, overwrite: bool) -> None:
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "cat.jpg").write_text("cat")
    with pytest.raises(OutputExistsError, match=r"no index\.toml\) and is never replaced"):
        write(tmp_path / "photos", overwrite=overwrite)
    assert (tmp_path / "photos" / "cat.jpg").read_text() == "cat"
    assert [p.name for p in tmp_path.iterdir()] == ["photos"]


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_file_is_never_replaced(tmp_path: Path, overwrite: bool) -> None:
    (tmp_path / "out").write_text("precious")
    with pytest.raises(OutputExistsError, match="out: is a file; name a folder"):
        write(tmp_path / "out", overwrite=overwrite)
    assert (tmp_path / "out").read_text() == "precious"


def test_an_empty_folder_may_be_filled(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    write(tmp_path / "out")
    assert (tmp_path / "out" / MARKER).read_text() == "new"


def test_a_place_that_cannot_be_written_to_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(RtofError, match=r"out: cannot be written .*choose another folder"):
        write(tmp_path / "file" / "out")


def test_a_link_is_not_followed_into_somebody_elses_folder(tmp_path: Path) -> None:
    write(tmp_path / "theirs", "theirs")
    (tmp_path / "out").symlink_to(tmp_path / "theirs")
    with pytest.raises(RtofError):
        write(tmp_path / "out", "mine", overwrite=True)
    assert (tmp_path / "theirs" / MARKER).read_text() == "theirs"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["out", "theirs"]


def test_long_work_can_ask_before_it_begins(tmp_path: Path) -> None:
    check_replaceable(tmp_path / "new", MARKER)
    check_replaceable(str(tmp_path / "new"), MARKER)
    write(tmp_path / "out")
    check_replaceable(tmp_path / "out", MARKER, overwrite=True)
    with pytest.raises(OutputExistsError):
        check_replaceable(tmp_path / "out", MARKER)

"""Folders and files that appear whole or not at all, and never replace what the user made."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from rtof_kin.core.errors import OutputExistsError, RtofError, WritingError
from rtof_kin.core.files import folder as folder_module
from rtof_kin.core.files.folder import check_replaceable, new_file, new_folder
from rtof_kin.core.files.manifest import MANIFEST

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
def test_a_failure_inside_leaves_nothing_and_passes_on(tmp_path: Path, error: BaseException) -> None:
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
    with pytest.raises(RtofError, match=r"out: cannot be written \(.*No space left"):
        fail(tmp_path / "out", OSError(28, "No space left on device"))
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_names_the_folder_and_not_the_temporary_one(tmp_path: Path) -> None:
    with (
        pytest.raises(WritingError, match=r"out: cannot be written \(.*No space left") as told,
        new_folder(tmp_path / "out", MARKER) as folder,
        new_file(folder / "data"),
    ):
        raise OSError(28, "No space left on device")
    assert ".rtof_kin-" not in str(told.value)


def test_an_error_of_this_package_keeps_its_own_type(tmp_path: Path) -> None:
    with pytest.raises(OutputExistsError, match="inner"):
        fail(tmp_path / "out", OutputExistsError("inner"))


def test_a_folder_of_the_kind_is_replaced_as_a_whole_when_asked(tmp_path: Path) -> None:
    with new_folder(tmp_path / "out", MARKER) as folder:
        for name in (MARKER, "stale"):
            (folder / name).write_text("old")
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
    with pytest.raises(OutputExistsError, match=r"photos: holds .* never replaced: cat\.jpg; move it"):
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
    with pytest.raises(RtofError, match="out: is a link"):
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


# --- what the user made --------------------------------------------------------------------------


def edit(out: Path) -> None:
    (out / "deep" / "data").write_text("corrected by hand")


def add(out: Path) -> None:
    (out / "notes.txt").write_text("mine")


def add_folder(out: Path) -> None:
    (out / "clinical").mkdir()


def add_deep(out: Path) -> None:
    (out / "deep" / "mine").write_text("mine")


def add_link(out: Path) -> None:
    (out / "video").symlink_to(out.parent)


def replace_by_link(out: Path) -> None:
    (out / "deep").rename(out.parent / "elsewhere")
    (out / "deep").symlink_to(out.parent / "elsewhere")


def forget(out: Path) -> None:
    (out / MANIFEST).unlink()


def damage(out: Path) -> None:
    (out / MANIFEST).write_text("{")


def tree(folder: Path) -> dict[str, str]:
    files = [path for path in folder.rglob("*") if path.is_file()]
    return {str(path.relative_to(folder)): path.read_text() for path in files}


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (edit, r"deep/data \(changed\)"), (add, "notes.txt"), (add_folder, "clinical/"),
        (add_deep, "deep/mine"), (add_link, "video/"), (replace_by_link, "deep/"),
        (forget, "deep/, index.toml"), (damage, rf"{MANIFEST}, deep/, index.toml"),
    ],
)  # fmt: skip
def test_what_the_user_made_in_a_folder_is_named_and_kept(
    tmp_path: Path, change: Callable[[Path], None], named: str
) -> None:
    write(tmp_path / "out", "old")
    change(tmp_path / "out")
    before = tree(tmp_path)
    with pytest.raises(OutputExistsError, match=f"out: holds .*: {named}; move it"):
        write(tmp_path / "out", overwrite=True)
    assert tree(tmp_path) == before


def test_a_folder_of_another_kind_is_not_replaced(tmp_path: Path) -> None:
    write(tmp_path / "out", "old")
    with (
        pytest.raises(OutputExistsError, match=r"another command \(index.toml\)"),
        new_folder(tmp_path / "out", "deep", overwrite=True),
    ):
        pass
    assert (tmp_path / "out" / MARKER).read_text() == "old"


def test_a_file_deleted_by_the_user_is_no_reason_to_refuse(tmp_path: Path) -> None:
    write(tmp_path / "out", "old")
    (tmp_path / "out" / "deep" / "data").unlink()
    write(tmp_path / "out", overwrite=True)
    assert (tmp_path / "out" / "deep" / "data").read_text() == "new"


# --- what happens meanwhile ----------------------------------------------------------------------


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_folder_that_appeared_meanwhile_is_kept(tmp_path: Path, overwrite: bool) -> None:
    with (
        pytest.raises(OutputExistsError, match="out: holds .*: notes.txt"),
        new_folder(tmp_path / "out", MARKER, overwrite) as folder,
    ):
        (folder / MARKER).write_text("new")
        (tmp_path / "out").mkdir()
        add(tmp_path / "out")
    assert tree(tmp_path) == {"out/notes.txt": "mine"}


def test_of_two_runs_into_one_folder_the_second_is_refused(tmp_path: Path) -> None:
    with (
        pytest.raises(OutputExistsError, match="out: is there already"),
        new_folder(tmp_path / "out", MARKER) as folder,
    ):
        (folder / MARKER).write_text("second")
        write(tmp_path / "out", "first")
    assert (tmp_path / "out" / MARKER).read_text() == "first"
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


@pytest.fixture(params=["exchange", "no exchange"])
def exchange(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """A file system that exchanges folders in one step, and one that cannot."""
    if request.param == "no exchange":

        def unknown(*_: object) -> None:
            raise OSError(22, "Invalid argument")

        monkeypatch.setattr(folder_module, "_exchange_at_once", unknown)
    return str(request.param)


def test_runs_that_overwrite_at_once_leave_the_whole_output_of_one(tmp_path: Path) -> None:
    write(tmp_path / "out", "0")
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(lambda text: write(tmp_path / "out", text, overwrite=True), "123456789abc"))
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
    found = tree(tmp_path / "out")
    assert found[MARKER] == found["deep/data"] != "0"


def test_a_replaced_folder_leaves_nothing_behind(tmp_path: Path, exchange: str) -> None:
    write(tmp_path / "out", "old")
    write(tmp_path / "out", "new", overwrite=True)
    assert tree(tmp_path / "out").keys() == {MANIFEST, MARKER, "deep/data"}
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_what_is_added_at_the_last_moment_is_kept_beside(
    tmp_path: Path, exchange: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    write(tmp_path / "out", "old")
    exchanged = folder_module._exchange

    def late(new: Path, path: Path) -> None:
        add(path)
        exchanged(new, path)

    monkeypatch.setattr(folder_module, "_exchange", late)
    write(tmp_path / "out", overwrite=True)
    assert (tmp_path / "out" / MARKER).read_text() == "new"
    (kept,) = (path for path in tmp_path.iterdir() if path.name.startswith("out.kept-"))
    assert (kept / "notes.txt").read_text() == "mine"
    assert str(kept) in caplog.text


def test_without_an_exchange_the_old_folder_comes_back_where_the_new_one_cannot_go(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(tmp_path / "out", "old")
    (tmp_path / "new").mkdir()
    rename, calls = os.rename, []

    def fails_once(source: Path, target: Path) -> None:
        calls.append(target)
        if len(calls) == 2:
            raise OSError(5, "Input/output error")
        rename(source, target)

    def unknown(*_: object) -> None:
        raise OSError(22, "Invalid argument")

    monkeypatch.setattr(folder_module, "_exchange_at_once", unknown)
    monkeypatch.setattr(folder_module.os, "rename", fails_once)
    with pytest.raises(OSError, match="Input/output error"):
        folder_module._exchange(tmp_path / "new", tmp_path / "out")
    assert (tmp_path / "out" / MARKER).read_text() == "old"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["new", "out"]


@pytest.mark.parametrize("step", ["write_manifest", "_put_folder", "_remove_replaced"])
def test_an_interrupted_export_is_whole_or_absent(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    write(tmp_path / "out", "old")

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(folder_module, step, interrupt)
    with pytest.raises(KeyboardInterrupt):
        write(tmp_path / "out", overwrite=True)
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
    found = tree(tmp_path / "out")
    assert found[MARKER] == found["deep/data"] == ("new" if step == "_remove_replaced" else "old")


KILLED = """
import os, signal, sys
from rtof_kin.core.files.folder import new_file, new_folder
with new_folder(sys.argv[1] + "/out", "index.toml") as folder, new_file(sys.argv[1] + "/page") as file:
    (folder / "index.toml").write_text("half")
    file.write_text("half")
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_the_next_run_removes_what_a_killed_one_left_and_nothing_of_a_living_one(tmp_path: Path) -> None:
    subprocess.run([sys.executable, "-c", KILLED, str(tmp_path)], check=False)
    assert len(list(tmp_path.iterdir())) == 2
    (mine := tmp_path / ".rtof_kin-notes").mkdir()
    with new_file(tmp_path / "living") as file:
        file.write_text("whole")
        write(tmp_path / "next")
        assert sorted(path.name for path in tmp_path.iterdir()) == sorted(
            [mine.name, file.parent.name, "next"]
        )
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([mine.name, "living", "next"])


# --- files ---------------------------------------------------------------------------------------


def test_a_file_appears_whole_and_readable(tmp_path: Path) -> None:
    with new_file(tmp_path / "page") as file:
        file.write_text("new")
        assert not (tmp_path / "page").exists()
    assert (tmp_path / "page").read_text() == "new"
    assert (tmp_path / "page").stat().st_mode & 0o777 == 0o666 & ~_umask()
    assert [path.name for path in tmp_path.iterdir()] == ["page"]


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


@pytest.mark.parametrize("error", [ValueError("oops"), KeyboardInterrupt(), OSError(28, "No space left")])
def test_a_file_that_fails_half_way_leaves_the_old_one(tmp_path: Path, error: BaseException) -> None:
    (tmp_path / "page").write_text("old")
    with (
        pytest.raises(RtofError if isinstance(error, OSError) else type(error)),
        new_file(tmp_path / "page", overwrite=True) as file,
    ):
        file.write_text("half")
        raise error
    assert tree(tmp_path) == {"page": "old"}


@pytest.mark.parametrize("links", [True, False])
def test_a_file_that_appeared_meanwhile_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, links: bool
) -> None:
    def unknown(*_: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    if not links:
        monkeypatch.setattr(os, "link", unknown)
    with new_file(tmp_path / "other") as file:
        file.write_text("whole")
    with (
        pytest.raises(OutputExistsError, match="page: is there already"),
        new_file(tmp_path / "page") as file,
    ):
        file.write_text("mine")
        (tmp_path / "page").write_text("theirs")
    assert tree(tmp_path) == {"page": "theirs", "other": "whole"}


def test_a_replaced_file_keeps_who_may_read_it_and_a_link_keeps_leading_there(tmp_path: Path) -> None:
    (tmp_path / "page").write_text("old")
    (tmp_path / "page").chmod(0o600)
    (tmp_path / "link").symlink_to("page")
    with pytest.raises(OutputExistsError), new_file(tmp_path / "link"):
        pass
    with new_file(tmp_path / "link", overwrite=True) as file:
        file.write_text("new")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "page").read_text() == "new"
    assert (tmp_path / "page").stat().st_mode & 0o777 == 0o600


def test_a_device_is_never_replaced_by_a_file() -> None:
    with pytest.raises(OutputExistsError, match="null: is a device"), new_file("/dev/null", True):
        pass

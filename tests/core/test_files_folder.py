"""Atomic output: complete or absent, and files of the user are never replaced."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable
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


def failing(error: BaseException) -> Callable[..., None]:
    """A function that raises an error."""

    def raise_(*_: object) -> None:
        raise error

    return raise_


not_supported = failing(OSError(22, "Invalid argument"))


@pytest.fixture(params=["exchange", "no exchange"])
def exchange(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """File systems with and without an atomic exchange of folders."""
    if request.param == "no exchange":
        monkeypatch.setattr(folder_module, "_exchange_at_once", not_supported)
    return str(request.param)


def test_folder_appears_complete_and_of_this_user_alone(tmp_path: Path) -> None:
    with new_folder(tmp_path / "a" / "b", MARKER) as folder:
        (folder / MARKER).write_text("x")
        assert not (tmp_path / "a" / "b").exists()
    assert (tmp_path / "a" / "b" / MARKER).read_text() == "x"
    modes = {path.name: path.stat().st_mode & 0o777 for path in tmp_path.rglob("*")}
    assert modes == {"a": 0o700, "b": 0o700, MARKER: 0o600, MANIFEST: 0o600}
    assert [p.name for p in (tmp_path / "a").iterdir()] == ["b"]
    (tmp_path / "empty").mkdir()
    write(tmp_path / "empty")
    assert (tmp_path / "empty" / MARKER).read_text() == "new"


@pytest.mark.parametrize(
    "error", [ValueError("oops"), KeyboardInterrupt(), RtofError("known"), OutputExistsError("inner")]
)
def test_failure_leaves_nothing_or_the_old_folder(tmp_path: Path, error: BaseException) -> None:
    with pytest.raises(type(error)):
        fail(tmp_path / "out", error)
    assert list(tmp_path.iterdir()) == []
    write(tmp_path / "out", "old")
    before = tree(tmp_path)
    with pytest.raises(type(error)):
        fail(tmp_path / "out", error, overwrite=True)
    assert tree(tmp_path) == before
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_full_disk_is_an_error_that_names_the_final_folder(tmp_path: Path) -> None:
    with (
        pytest.raises(WritingError, match=r"out: cannot be written \(.*No space left") as caught,
        new_folder(tmp_path / "out", MARKER) as folder,
        new_file(folder / "data"),
    ):
        raise OSError(28, "No space left on device")
    assert ".rtof_kin-" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def test_folder_of_the_kind_is_replaced_as_a_whole_on_request(tmp_path: Path, exchange: str) -> None:
    with new_folder(tmp_path / "out", MARKER) as folder:
        for name in (MARKER, "stale", "deleted"):
            (folder / name).write_text("old")
    (tmp_path / "out" / "deleted").unlink()  # by the user
    with pytest.raises(OutputExistsError, match=r"out: is there already; ask to .*--overwrite"):
        write(tmp_path / "out", "new")
    assert (tmp_path / "out" / MARKER).read_text() == "old"
    write(tmp_path / "out", "new", overwrite=True)
    assert tree(tmp_path / "out").keys() == {MANIFEST, MARKER, "deep/data"}
    assert (tmp_path / "out" / MARKER).read_text() == "new"
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


@pytest.mark.parametrize("overwrite", [False, True])
def test_foreign_folders_files_and_links_are_never_replaced(tmp_path: Path, overwrite: bool) -> None:
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "cat.jpg").write_text("cat")
    (tmp_path / "file").write_text("precious")
    write(tmp_path / "theirs", "theirs")
    (tmp_path / "link").symlink_to(tmp_path / "theirs")
    before = tree(tmp_path)
    for name, message in (
        ("photos", r"photos: contains .* never replaced: cat\.jpg; move it"),
        ("file", "file: is a file; name a folder"),
        ("link", "link: is a link"),
        ("file/out", r"out: cannot be written .*choose another folder"),
    ):
        with pytest.raises(RtofError, match=message):
            write(tmp_path / name, overwrite=overwrite)
    assert tree(tmp_path) == before


def tree(folder: Path) -> dict[str, str]:
    files = [path for path in folder.rglob("*") if path.is_file()]
    return {str(path.relative_to(folder)): path.read_text() for path in files}


def replace_by_link(out: Path) -> None:
    (out / "deep").rename(out.parent / "elsewhere")
    (out / "deep").symlink_to(out.parent / "elsewhere")


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda out: (out / "deep" / "data").write_text("corrected by hand"), r"deep/data \(changed\)"),
        (lambda out: (out / "notes.txt").write_text("mine"), "notes.txt"),
        (lambda out: (out / "clinical").mkdir(), "clinical/"),
        (lambda out: (out / "deep" / "mine").write_text("mine"), "deep/mine"),
        (lambda out: (out / "video").symlink_to(out.parent), "video/"),
        (replace_by_link, "deep/"),
        (lambda out: (out / MANIFEST).unlink(), "deep/, index.toml"),
        (lambda out: (out / MANIFEST).write_text("{"), rf"{MANIFEST}, deep/, index.toml"),
    ],
)
def test_files_of_the_user_in_a_folder_are_named_and_kept(
    tmp_path: Path, change: Callable[[Path], object], named: str
) -> None:
    write(tmp_path / "out", "old")
    change(tmp_path / "out")
    before = tree(tmp_path)
    with pytest.raises(OutputExistsError, match=f"out: contains .*: {named}; move it"):
        write(tmp_path / "out", overwrite=True)
    assert tree(tmp_path) == before


def test_folder_of_an_earlier_version_of_this_kind_is_replaced(tmp_path: Path) -> None:
    with new_folder(tmp_path / "out", "motion.npz") as folder:
        (folder / "motion.npz").touch()
    with new_folder(tmp_path / "out", "motion.h5", overwrite=True) as folder:
        (folder / "motion.h5").touch()
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"motion.h5", MANIFEST}


def test_folder_of_another_kind_is_not_replaced(tmp_path: Path) -> None:
    check_replaceable(str(tmp_path / "out"), MARKER)
    write(tmp_path / "out", "old")
    check_replaceable(tmp_path / "out", MARKER, overwrite=True)
    with (
        pytest.raises(OutputExistsError, match=r"another command \(index.toml\)"),
        new_folder(tmp_path / "out", "deep", overwrite=True),
    ):
        pass
    assert (tmp_path / "out" / MARKER).read_text() == "old"


@pytest.mark.parametrize("overwrite", [False, True])
def test_folder_that_appeared_meanwhile_is_kept(tmp_path: Path, overwrite: bool) -> None:
    with (
        pytest.raises(OutputExistsError, match="out: contains .*: notes.txt"),
        new_folder(tmp_path / "out", MARKER, overwrite) as folder,
    ):
        (folder / MARKER).write_text("new")
        (tmp_path / "out").mkdir()
        (tmp_path / "out" / "notes.txt").write_text("mine")
    assert tree(tmp_path) == {"out/notes.txt": "mine"}
    with (
        pytest.raises(OutputExistsError, match="second: is there already"),
        new_folder(tmp_path / "second", MARKER) as folder,
    ):
        (folder / MARKER).write_text("second")
        write(tmp_path / "second", "first")  # of another run
    assert (tmp_path / "second" / MARKER).read_text() == "first"


def test_files_added_at_the_last_moment_are_kept_beside(
    tmp_path: Path, exchange: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    write(tmp_path / "out", "old")
    exchanged = folder_module._exchange

    def late(new: Path, path: Path) -> None:
        (path / "notes.txt").write_text("mine")
        exchanged(new, path)

    monkeypatch.setattr(folder_module, "_exchange", late)
    write(tmp_path / "out", overwrite=True)
    assert (tmp_path / "out" / MARKER).read_text() == "new"
    (kept,) = (path for path in tmp_path.iterdir() if path.name.startswith("out.kept-"))
    assert (kept / "notes.txt").read_text() == "mine"
    assert str(kept) in caplog.text


def test_failed_renaming_restores_the_old_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(tmp_path / "out", "old")
    (tmp_path / "new").mkdir()
    rename, calls = os.rename, []

    def fails_once(source: Path, target: Path) -> None:
        calls.append(target)
        if len(calls) == 2:
            raise OSError(5, "Input/output error")
        rename(source, target)

    monkeypatch.setattr(folder_module, "_exchange_at_once", not_supported)
    monkeypatch.setattr(folder_module.os, "rename", fails_once)
    with pytest.raises(OSError, match="Input/output error"):
        folder_module._exchange(tmp_path / "new", tmp_path / "out")
    assert (tmp_path / "out" / MARKER).read_text() == "old"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["new", "out"]


@pytest.mark.parametrize("step", ["write_manifest", "_put_folder", "_remove_replaced"])
def test_interrupted_export_is_complete_or_absent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str) -> None:
    write(tmp_path / "out", "old")
    monkeypatch.setattr(folder_module, step, failing(KeyboardInterrupt()))
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


def test_next_run_removes_leftovers_of_killed_runs_only(tmp_path: Path) -> None:
    subprocess.run([sys.executable, "-c", KILLED, str(tmp_path)], check=False)
    assert len(list(tmp_path.iterdir())) == 2
    (mine := tmp_path / ".rtof_kin-notes").mkdir()
    with new_file(tmp_path / "living") as file:
        file.write_text("whole")
        write(tmp_path / "next")
        assert sorted(path.name for path in tmp_path.iterdir()) == sorted([mine.name, file.parent.name, "next"])
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([mine.name, "living", "next"])


def test_leftovers_of_other_systems_are_removed_when_nobody_wrote_for_a_day(tmp_path: Path) -> None:
    for name in ("clinic.pc-0123456789ab", "deadbeef-0123456789ab"):
        (tmp_path / f".rtof_kin-{name}").mkdir()
        (tmp_path / f".rtof_kin-{name}" / "half").write_text("half")
    write(tmp_path / "first")
    assert len(list(tmp_path.iterdir())) == 3
    day = time.time() - 25 * 3600
    for path in (".rtof_kin-clinic.pc-0123456789ab", ".rtof_kin-clinic.pc-0123456789ab/half"):
        os.utime(tmp_path / path, (day, day))
    os.utime(tmp_path / ".rtof_kin-deadbeef-0123456789ab", (day, day))  # a file in it is new
    write(tmp_path / "second")
    left = {"first", "second", ".rtof_kin-deadbeef-0123456789ab"}
    assert {path.name for path in tmp_path.iterdir()} == left


def test_file_appears_complete_and_of_this_user_alone(tmp_path: Path) -> None:
    with new_file(tmp_path / "page") as file:
        file.write_text("new")
        assert not (tmp_path / "page").exists()
    assert (tmp_path / "page").read_text() == "new"
    assert (tmp_path / "page").stat().st_mode & 0o777 == 0o600
    assert [path.name for path in tmp_path.iterdir()] == ["page"]


@pytest.mark.parametrize("links", [True, False])
def test_file_that_appeared_meanwhile_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, links: bool) -> None:
    if not links:
        monkeypatch.setattr(os, "link", failing(PermissionError(1, "Operation not permitted")))
    with new_file(tmp_path / "other") as file:
        file.write_text("whole")
    with pytest.raises(OutputExistsError, match="page: is there already"), new_file(tmp_path / "page") as file:
        file.write_text("mine")
        (tmp_path / "page").write_text("theirs")
    assert tree(tmp_path) == {"page": "theirs", "other": "whole"}


def test_replaced_file_keeps_permissions_and_links_and_a_device_is_refused(tmp_path: Path) -> None:
    with pytest.raises(OutputExistsError, match="null: is a device"), new_file("/dev/null", True):
        pass
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

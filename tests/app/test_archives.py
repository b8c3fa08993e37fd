"""A person as an archive: whole again elsewhere, and nothing that could do harm."""

from __future__ import annotations

import stat
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

from rtof_kin.app import people as archives
from rtof_kin.app.people import read_archive, write_archive
from rtof_kin.app.store import FILES, NOTES, State, Store
from rtof_kin.core.errors import InvalidInputError, OutputExistsError

DAY = "2026-01-31"


@pytest.fixture
def store(tmp_path: Path) -> Store:
    store = Store(tmp_path / "workspace")
    store.add_person("P07", 1.73)
    store.add_visit("P07", DAY)
    store.add_visit("P07", "2026-02-01")
    take = store.add_take("P07", DAY, "walk")
    (take / FILES / "clip 1.mp4").write_bytes(b"film")
    (take / "motion").mkdir()
    (take / "motion/.rtof_kin.json").write_text("{}")
    (take / ".hidden").write_text("secret")
    (take / "link").symlink_to("/etc/passwd")
    store.change(take, state=State.RUNNING)
    (store.root / "P07" / DAY / NOTES).write_text("a limp")
    made = store.root / "P07/comparisons/2026-01-31_10-00-00"
    made.mkdir(parents=True)
    (made / "follow.html").write_text("page")
    return store


@pytest.fixture
def other(tmp_path: Path) -> Store:
    return Store(tmp_path / "other")


def contents(root: Path) -> dict[str, bytes]:
    files = (path for path in root.rglob("*") if path.is_file() and not path.is_symlink())
    return {path.relative_to(root).as_posix(): path.read_bytes() for path in files}


def test_a_person_is_whole_again_elsewhere_but_for_what_is_said(store: Store, other: Store, tmp_path: Path) -> None:
    left_out = write_archive(store, "P07", True, tmp_path / "P07.zip")
    assert left_out == [f"P07/{DAY}/walk/.hidden", f"P07/{DAY}/walk/link"]
    assert read_archive(other, tmp_path / "P07.zip") == "P07"
    (store.root / left_out[0]).unlink()
    take = other.path("P07", DAY, "walk")
    assert other.take(take).state is State.DRAFT  # nothing runs here
    store.change(store.path("P07", DAY, "walk"), state=State.DRAFT)
    assert contents(other.root / "P07") == contents(store.root / "P07")
    assert other.names("P07") == ["2026-02-01", DAY]
    assert not [path for path in other.root.rglob("*") if stat.S_IMODE(path.stat().st_mode) & 0o077]
    with pytest.raises(OutputExistsError, match="P07: is there already"):
        read_archive(other, tmp_path / "P07.zip")
    assert not [path.name for path in other.root.iterdir() if path.name.startswith(".rtof")]


def test_videos_are_left_out_by_choice(store: Store, other: Store, tmp_path: Path) -> None:
    assert f"P07/{DAY}/walk/files/clip 1.mp4" in write_archive(store, "P07", False, tmp_path / "P07.zip")
    read_archive(other, tmp_path / "P07.zip")
    assert not other.files(other.path("P07", DAY, "walk"))


def member(name: str, data: bytes = b"x", mode: int = 0) -> Callable[[zipfile.ZipFile], None]:
    info = zipfile.ZipInfo(name)
    info.external_attr, info.compress_type = mode << 16, zipfile.ZIP_DEFLATED
    return lambda archive: archive.writestr(info, data)


def twice(archive: zipfile.ZipFile) -> None:
    archive.writestr("P07/subject.toml", "a")
    archive.writestr("P07/SUBJECT.toml", "b")


HOSTILE = {
    "../out.txt": "no archive of a person",
    "/etc/passwd": "no archive of a person",
    "P08/subject.toml": "no archive of a person",
    "P07/../out.txt": "could do harm",
    "P07/2026-01-31/walk/../../../../out": "could do harm",
    "P07/.ssh/authorized_keys": "could do harm",
    "P07/a b/walk/take.json": "could do harm",
    "P07/2026-01-31/-rf/take.json": "could do harm",
    "P07/2026-01-31/walk/files/con.txt": "could do harm",
    "P07/2026-01-31/walk/files/a\\b": "could do harm",
    "P07/2026-01-31/walk//x": "could do harm",
    "P07/2026-01-31/walk/Review.html": "could do harm",  # its script would reach the application
}


@pytest.mark.parametrize(
    ("add", "said"),
    [
        *((member(name), said) for name, said in HOSTILE.items()),
        (member("P07/link", b"/etc/passwd", stat.S_IFLNK | 0o777), "could do harm"),
        (member("P07/device", b"", stat.S_IFCHR | 0o666), "could do harm"),
        (member("P07/zeros.csv", bytes(2**20)), "too much for its size"),
        (twice, "is there twice"),
    ],
    ids=[f"file {number}" for number in range(len(HOSTILE))] + ["a link", "a device", "zeros", "twice"],
)
def test_hostile_archives_leave_nothing(
    add: Callable[[zipfile.ZipFile], None], said: str, other: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(archives, "_SMALL", 2**10)
    with zipfile.ZipFile(tmp_path / "P07.zip", "w") as archive:
        archive.comment = b"rtof-kin person 1"
        archive.writestr("P07/notes.txt", "a")
        add(archive)
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(InvalidInputError, match=said):
        read_archive(other, tmp_path / "P07.zip")
    assert sorted(tmp_path.rglob("*")) == before


def test_damaged_and_other_files_are_no_archives(store: Store, other: Store, tmp_path: Path) -> None:
    path = tmp_path / "P07.zip"
    write_archive(store, "P07", True, path)
    whole = path.read_bytes()
    at = whole.index(b"a limp") if b"a limp" in whole else whole.index(b"notes.txt") + len("notes.txt") + 2
    for damaged in (b"", b"PK", whole[:200], whole[:at] + bytes([whole[at] ^ 255]) + whole[at + 1 :]):
        path.write_bytes(damaged)
        with pytest.raises(InvalidInputError, match=r"no archive of a person|could do harm"):
            read_archive(other, path)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("P07/notes.txt", "a")  # of another program
    with pytest.raises(InvalidInputError, match="no archive of a person"):
        read_archive(other, path)
    assert not other.names()

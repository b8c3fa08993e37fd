"""People, visits and recordings in folders, and their trash."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import pytest

from rtof_kin.app.store import FILES, SUBJECT, State, Store
from rtof_kin.core.errors import InvalidInputError, OutputExistsError, RtofError
from rtof_kin.recording.subject import read_subject
from rtof_kin.setup.sources import SourceKind, recognise_source

HOSTILE = [
    "",
    ".",
    "..",
    "../out",
    "a/b",
    "a\\b",
    "/etc",
    ".hidden",
    "-rf",
    "a\n",
    "x" * 65,
    "CON",
    "nul",
    "a b",
    "a:b",
]
FILE = [
    "",
    "..",
    ".part",
    "a/b.csv",
    "a\\b.csv",
    "a\nb.csv",
    "a\x00.csv",
    "c:x",
    "x.",
    " x",
    "-o",
    "é" * 101,
    "con.txt",
]


@pytest.fixture
def store(tmp_path: Path) -> Store:
    store = Store(tmp_path / "workspace")
    store.add_person("P07", 1.73)
    store.add_visit("P07", "2026-01-31")
    store.add_take("P07", "2026-01-31", "walk")
    return store


def test_workspace_is_of_this_user_alone_also_where_it_was_not(tmp_path: Path) -> None:
    (tmp_path / "open").mkdir(mode=0o755)
    root = Store(tmp_path / "open").root
    assert stat.S_IMODE(root.stat().st_mode) == 0o700
    with pytest.raises(RtofError, match="cannot be a workspace"):
        Store("/dev/null/workspace")


def test_person_is_known_by_the_height_in_a_file_that_run_takes(store: Store) -> None:
    found = read_subject(store.root / "P07" / SUBJECT)
    assert (found.subject, found.height_m and found.height_m.value) == ("P07", 1.73)
    for height in (None, 0.0, 173.0):
        with pytest.raises(InvalidInputError, match="centimetres"):
            store.add_person("P08", height)
    assert store.names() == ["P07"]


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_names_are_refused_at_every_level(store: Store, name: str) -> None:
    for names in ((name,), ("P07", name), ("P07", "2026-01-31", name)):
        with pytest.raises(InvalidInputError):
            store.path(*names)
        with pytest.raises(InvalidInputError):
            store.delete(*names)
    for add in (lambda: store.add_person(name, 1.7), lambda: store.add_take("P07", "2026-01-31", name)):
        with pytest.raises(InvalidInputError, match="letters, digits"):
            add()
    with pytest.raises(InvalidInputError, match="no day"):
        store.add_visit("P07", name)


@pytest.mark.parametrize("name", FILE)
def test_hostile_names_of_files_are_refused(store: Store, name: str) -> None:
    with pytest.raises(InvalidInputError, match="rename it"):
        store.new_file(store.path("P07", "2026-01-31", "walk"), name)


def test_files_are_taken_by_their_names_once(store: Store) -> None:
    folder = store.path("P07", "2026-01-31", "walk")
    path = store.new_file(folder, "IMG 0042 (1).MOV")
    path.write_bytes(b"\0\0\0\x14ftypqt  ")
    (folder / FILES / ".part").touch()
    assert store.files(folder) == [path]
    assert recognise_source(path) is SourceKind.VIDEO
    assert store.sources(folder).video == path
    with pytest.raises(OutputExistsError, match="remove it first"):
        store.new_file(folder, path.name)


@pytest.mark.parametrize(
    ("name", "inside"),
    [
        ("walk_000000000012_keypoints.json", "walk_keypoints"),
        ("cam01.0012.json", "cam01_keypoints"),
        ("cam01_000012.json", "cam01_keypoints"),
        ("walk_000000000012.json", "walk_keypoints"),
        ("walk_2026.json", FILES),
        ("walk_20260131.json", FILES),
        ("camera.json", FILES),
    ],
)
def test_frames_of_a_detector_are_of_one_folder(store: Store, name: str, inside: str) -> None:
    path = store.new_file(store.path("P07", "2026-01-31", "walk"), name)
    assert (path.parent.name, path.name) == (inside, name)


@pytest.mark.skipif(os.name == "nt", reason="no links")
def test_links_are_not_followed(store: Store, tmp_path: Path) -> None:
    (tmp_path / "else").mkdir()
    (store.root / "P09").symlink_to(tmp_path / "else")
    assert store.names() == ["P07"]
    with pytest.raises(InvalidInputError, match="is a link"):
        store.path("P09")
    with pytest.raises(InvalidInputError, match="is a link"):
        store.delete("P09", "2026-01-31")


def test_state_is_kept_and_found_again_from_the_files_where_it_is_lost(store: Store) -> None:
    folder = store.path("P07", "2026-01-31", "walk")
    assert store.take(folder).state is State.DRAFT
    store.change(folder, state=State.FAILED, said="no person", size_px=(1920, 1080), seconds={"lift": 2.5})
    found = Store(store.root).take(folder)
    assert (found.state, found.said, found.size_px) == (State.FAILED, "no person", (1920, 1080))
    for damage in ("", "{", '{"state": "flying"}', "[]"):
        (folder / "take.json").write_text(damage)
        assert store.take(folder).state is State.DRAFT
    (folder / "take.json").unlink()
    (folder / "report.html").touch()
    assert store.take(folder).state is State.ATTENTION  # a report without the rest


def test_what_is_deleted_can_be_taken_back(store: Store) -> None:
    walk, visit = ("P07", "2026-01-31", "walk"), ("P07", "2026-01-31")
    store.new_file(store.path(*walk), "a.csv").write_text("x")
    first = store.delete(*walk)
    assert store.names(*visit) == []
    second = store.delete(*visit)
    assert set(store.trash().values()) == {walk, visit}
    with pytest.raises(InvalidInputError, match="There is no visit 2026-01-31"):
        store.restore(first)
    store.restore(second)
    store.add_take(*walk)
    with pytest.raises(OutputExistsError, match="is there already"):
        store.restore(first)
    third = store.delete(*walk)
    store.restore(first)
    assert [path.name for path in store.files(store.path(*walk))] == ["a.csv"]
    assert list(store.trash()) == [third]
    with pytest.raises(InvalidInputError, match="no longer"):
        store.restore("../..")


def test_trash_whose_note_was_changed_leads_nowhere_else(store: Store) -> None:
    key = store.delete("P07", "2026-01-31", "walk")
    (store.root / ".trash" / key / "origin.txt").write_text("../../out")
    with pytest.raises(InvalidInputError):
        store.restore(key)

"""Labels of a session: saved with the recording, refused where they are wrong."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import planted
import pytest

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.errors import FileFormatError, InvalidInputError, UnknownNameError
from rtof_kin.recording.recording import Recording
from rtof_kin.recording.session import Session

LABELS = Session("P07 <x>", "Dr. Ü", "2026-01-31", "gait lab", "walk")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    recording = planted.recording(planted.moving(SkeletonModel.default(), 12))
    replace(recording, session=LABELS).save(tmp_path / "out")
    return tmp_path / "out"


def test_labels_are_saved_with_a_recording(folder: Path) -> None:
    assert Recording.load(folder).session == LABELS


def test_a_recording_without_labels_has_none(folder: Path) -> None:
    text = (folder / "recording.toml").read_text()
    start, stop = text.index("[session]"), text.index("[subject]")
    (folder / "recording.toml").write_text(text[:start] + text[stop:])
    assert Recording.load(folder).session == Session()


@pytest.mark.parametrize(
    ("old", "new", "error", "message"),
    [
        ('date = "2026-01-31"', "date = 2026-01-31", FileFormatError, "date: .* is not text"),
        ('date = "2026-01-31"', 'date = "31.1."', FileFormatError, r"'31.1.'"),
        ("operator", "opperator", UnknownNameError, "Did you mean 'operator'"),
    ],
)
def test_wrong_labels_are_refused(folder: Path, old: str, new: str, error: type[Exception], message: str) -> None:
    path = folder / "recording.toml"
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(error, match=message):
        Recording.load(folder)


def test_updated_labels_take_precedence() -> None:
    assert LABELS.updated(Session(subject="P08")) == replace(LABELS, subject="P08")
    assert Session().updated(LABELS) == LABELS
    assert Session(subject="P08").plain() == {"subject": "P08"}


def test_a_label_that_is_not_text_is_refused() -> None:
    with pytest.raises(InvalidInputError, match="session place"):
        Session.of({"place": 3})

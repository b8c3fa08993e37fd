"""The manifest of an output folder: what it was made from."""

from __future__ import annotations

from pathlib import Path

import pytest

from rtof_kin.core.files.folder import new_folder
from rtof_kin.core.files.manifest import MANIFEST, fingerprint, made_from


def test_a_folder_knows_what_it_was_made_from_while_it_is_complete(tmp_path: Path) -> None:
    with new_folder(tmp_path / "out", "a.txt", inputs={"step": "1234"}) as folder:
        (folder / "a.txt").write_text("a")
        (folder / "b.txt").write_text("b")
    assert made_from(tmp_path / "out") == {"step": "1234"}
    (tmp_path / "out" / "a.txt").write_text("changed by the user, who knows better")
    assert made_from(tmp_path / "out") == {"step": "1234"}
    (tmp_path / "out" / "b.txt").unlink()
    assert made_from(tmp_path / "out") == {}
    assert made_from(tmp_path / "none") == {}


@pytest.mark.parametrize("text", ["", "[]", '{"kind": "a", "sha256": {}}', '{"sha256": [1], "inputs": 3}'])
def test_a_damaged_manifest_says_nothing_of_its_inputs(tmp_path: Path, text: str) -> None:
    (tmp_path / MANIFEST).write_text(text)
    assert made_from(tmp_path) == {}


def test_a_fingerprint_changes_with_contents_names_and_values_only(tmp_path: Path) -> None:
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "a.txt").write_text("a")
    before = fingerprint(tmp_path / "one", 1.72, ("person", None))
    assert fingerprint(tmp_path / "two", 1.72, ("person", None)) == before  # another place
    assert fingerprint(tmp_path / "one", 1.73, ("person", None)) != before
    (tmp_path / "one" / MANIFEST).write_text("{}")
    assert fingerprint(tmp_path / "one", 1.72, ("person", None)) == before
    (tmp_path / "one" / "a.txt").rename(tmp_path / "one" / "b.txt")
    assert fingerprint(tmp_path / "one", 1.72, ("person", None)) != before
    (tmp_path / "two" / "a.txt").write_text("b")
    assert fingerprint(tmp_path / "two", 1.72, ("person", None)) != before

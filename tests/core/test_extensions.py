"""Lists that other packages add to, by their entry points or in a script."""

from __future__ import annotations

from pathlib import Path

import pytest

from rtof_kin.core.errors import ExtensionError, InvalidInputError, UnknownNameError
from rtof_kin.core.packages import Extensions
from rtof_kin.formats.sensors import files
from rtof_kin.vision import layouts
from rtof_kin.vision.landmark_regression import LandmarkRegression
from rtof_kin.vision.layouts import Layout, add_layout, detector_table


def installed(folder: Path, monkeypatch: pytest.MonkeyPatch, **values: str) -> Extensions[str]:
    """A list of texts, to which an installed package adds these: name of the entry point -> its object."""
    info = folder / "added-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: added\nVersion: 1.0\n", encoding="utf-8")
    points = "\n".join(f"{name} = {value}" for name, value in values.items())
    (info / "entry_points.txt").write_text(f"[a.group]\n{points}\n", encoding="utf-8")
    (folder / "added_values.py").write_text("FIRST, SECOND, NUMBER = 'first', 'second', 3\n", encoding="utf-8")
    monkeypatch.syspath_prepend(folder)
    return Extensions("a.group", str, lambda text: text)


def test_installed_and_added_are_known_in_alphabetical_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    known = installed(tmp_path, monkeypatch, b="added_values:SECOND", a="added_values:FIRST")
    known.add("other")
    assert known.all() == ("first", "other", "second")


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("added_values:NUMBER", "'added_values:NUMBER' of added is a int, not a str"),
        ("added_values:MISSING", "of added cannot be loaded: .*MISSING.*; repair or uninstall"),
        ("no_such_module:X", "of added cannot be loaded: No module named 'no_such_module'"),
    ],
)
def test_what_cannot_be_used_names_the_package(
    value: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(ExtensionError, match=message):
        installed(tmp_path, monkeypatch, a=value).all()


def test_names_of_built_in_formats_are_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(files.ADDED, "_added", {})
    with pytest.raises(InvalidInputError, match="'plain CSV' is the name of one that is built in"):
        files.add_format(files.FORMATS[-1])


def test_a_layout_is_known_everywhere_once_added(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(layouts.ADDED, "_added", {})
    add_layout(Layout.of("own", "Own", ["l_hip", "nose"]))
    assert detector_table().layout("own").points == ("LeftHip", "Nose")
    assert LandmarkRegression.default().table is detector_table()
    add_layout(Layout.of("own", "Own", ["nose"]))  # instead of the one before
    assert len(LandmarkRegression.default().table.layout("own")) == 1
    assert "own" in detector_table().layouts


def test_wrong_layouts_are_named_and_not_added(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(layouts.ADDED, "_added", {})
    for error, message, wrong in (
        (InvalidInputError, "'coco17' is a shipped one", Layout.of("coco17", "", ["nose"])),
        (InvalidInputError, "the point 'LeftHip' stands there twice", Layout.of("own", "", ["l_hip", "LHip"])),
        (UnknownNameError, "LeftAntenna", Layout.of("own", "", ["l_antenna"])),
    ):
        with pytest.raises(error, match=message):
            add_layout(wrong)
    assert "own" not in detector_table().layouts

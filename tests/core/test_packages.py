"""Optional packages: one sentence where they are missing."""

from __future__ import annotations

import logging
import sys
import tomllib
from importlib import import_module
from pathlib import Path

import pytest

from rtof_kin.core.errors import ExtensionError, InvalidInputError, MissingPackageError, UnknownNameError
from rtof_kin.core.packages import Extensions, can_draw, install, optional
from rtof_kin.formats.sensors import files
from rtof_kin.vision import layouts
from rtof_kin.vision.landmark_regression import LandmarkRegression
from rtof_kin.vision.layouts import Layout, add_layout, detector_table

ROOT = Path(__file__).parents[2]


def test_a_missing_package_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    said = 'reading a video needs av, which is not installed: pip install "rtof-kin[video]"'
    with pytest.raises(MissingPackageError) as caught:
        optional("av", "video", "reading a video")
    assert str(caught.value) == said
    with pytest.raises(MissingPackageError, match="no_such, which is not installed: conda install x"):
        optional("no_such.part", "", remedy="conda install x")


def test_a_broken_package_is_told_from_a_missing_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "half.py").write_text("import no_such_part", encoding="utf-8")
    (tmp_path / "without_library.py").write_text("raise OSError('libx.so: not found')", encoding="utf-8")
    with pytest.raises(MissingPackageError, match=r"half, which cannot be loaded \(No module named 'no_such"):
        optional("half", "live")
    with pytest.raises(MissingPackageError, match=r"cannot be loaded \(libx.so: not found\)"):
        optional("without_library", "live")


def test_every_extra_that_is_named_exists() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    texts = [
        path.read_text(encoding="utf-8")
        for folder in ("rtof_kin", "lifting")
        for path in sorted((ROOT / folder).rglob("*.py"))
    ]
    called = {extra for extra in project["optional-dependencies"] if any(f'"{extra}"' in t for t in texts)}
    assert called >= {"train", "figures", "video", "view", "live", "cluster", "parquet", "onnx", "mediapipe"}
    assert install("train") == 'pip install "rtof-kin[train]"'


def test_without_torch_training_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in sys.modules if name.partition(".")[0] == "lifting"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(MissingPackageError, match=r"training a lifter needs torch.*\"rtof-kin\[train\]\""):
        import_module("lifting.training.train")


def test_without_matplotlib_figures_are_left_out(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with caplog.at_level(logging.WARNING):
        assert not can_draw()
    assert "figures are left out: a figure needs matplotlib" in caplog.text


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


def test_names_of_built_in_formats_are_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(files.ADDED, "_added", {})
    with pytest.raises(InvalidInputError, match="'plain CSV' is the name of one that is built in"):
        files.add_format(next(form for form in files.FORMATS if form.title == "plain CSV"))

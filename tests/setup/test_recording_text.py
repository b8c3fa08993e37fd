"""The commented text of a recording."""

from __future__ import annotations

import tomllib
from typing import Any

from rtof_kin.setup.recording_text import Field, Origin, Tables, recording_text

TABLES = {
    "schema_version": Field(1),
    "name": Field('a "b" \\ ü\n# no comment'),
    "subject": {"height_m": Field(1.72, Origin.GIVEN, summary="1.72 m tall")},
    "camera": {
        "focal_px": Field(1480.25, Origin.ASSUMED, "a view of " + "many " * 40 + "degrees", "the focal length"),
        "K": Field([[1e-9, 0.1 + 0.2, 0.0], [1.0, -0.0, 3.0]], Origin.FILE, "calib.toml"),
        "uncertainty": {"focal": Field(0.15)},
    },
    "imus": {"names": Field(["00B4", "x.y"]), "sensors": {"x.y": {"joint": Field("Hips", Origin.FOUND)}}},
}


def plain(tables: Tables) -> dict[str, Any]:
    return {name: one.value if isinstance(one, Field) else plain(one) for name, one in tables.items()}


def test_the_values_are_read_back_exactly() -> None:
    text = recording_text(TABLES, "Recording")
    assert tomllib.loads(text) == plain(TABLES)


def test_a_comment_cannot_smuggle_a_value_in() -> None:
    tables = {"name": Field("a", Origin.FILE, "walk\nheight_m = 3.0\r\nx = 1 #.mp4")}
    assert tomllib.loads(recording_text(tables, "from walk.mp4")) == {"name": "a"}

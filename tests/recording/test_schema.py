"""The tables of ``recording.toml``: what is refused, and the schema and documentation made of them."""

from __future__ import annotations

import copy
import datetime
import json
import math
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from schema_recordings import RECORDINGS

from docs.recording_fields import inlined_schema, schema_text
from rtof_kin.core.errors import RtofError
from rtof_kin.recording.index import INDEX, SCHEMA_VERSION, SKELETONS
from rtof_kin.recording.recording import Recording
from rtof_kin.recording.tables import SCHEMA, RecordingTable

DELETED = object()
VALUES = (DELETED, "text", True, 3, 1.5, -1, math.nan, datetime.date(2026, 1, 31), [], ["a"], [1.0], {}, [{}])
NODE = inlined_schema(RecordingTable)


def validator_class() -> Any:
    """That of the schema's draft; loading it takes a second, which not every process of the tests needs."""
    from jsonschema import Draft202012Validator

    return Draft202012Validator


def index_of(name: str) -> dict[str, Any]:
    return tomllib.loads(RECORDINGS[name])


def tables(index: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """All tables of an index."""
    yield index
    for value in index.values():
        for inner in value if isinstance(value, list) else [value]:
            if isinstance(inner, dict):
                yield from tables(inner)


def changed(name: str) -> Iterator[dict[str, Any]]:
    """The recording with one field left out or added, or of another value or kind."""
    whole = index_of(name)
    for table in tables(whole):
        for field in (*list(table), "mispelt"):
            kept = table.get(field, DELETED)
            for value in VALUES:
                table.pop(field, None)
                if value is not DELETED:
                    table[field] = value
                yield copy.deepcopy(whole)
            table.pop(field, None)
            if kept is not DELETED:
                table[field] = kept


def refusal(index: dict[str, Any]) -> str:
    """The message about an index; empty where there is none."""
    try:
        RecordingTable.of(index, Path(INDEX))
    except RtofError as error:
        return str(error)
    return ""


@pytest.mark.parametrize("name", RECORDINGS)
def test_editors_refuse_nothing_that_is_read_and_wrong_fields_raise_one_error(name: str) -> None:
    validator = validator_class()(NODE)
    RecordingTable.of(index_of(name), Path(INDEX))
    for index in changed(name):
        if refused := refusal(index):
            assert INDEX in refused
        elif index["schema_version"] is not True:  # equals 1
            assert [error.message for error in validator.iter_errors(index)] == []


def fields_of(node: dict[str, Any], where: str = "") -> Iterator[tuple[str, dict[str, Any]]]:
    """All fields of the schema, with their tables."""
    inner = dict(node.get("properties", {}))
    if isinstance(node.get("additionalProperties"), dict):
        inner["*"] = node["additionalProperties"]
    for field, one in inner.items():
        yield f"{where}.{field}", one
        yield from fields_of(one.get("items") or one, f"{where}.{field}")


def test_the_shipped_schema_is_that_of_the_tables_and_says_what_every_field_is() -> None:
    assert SCHEMA.read_text(encoding="utf-8") == schema_text(), "run python -m docs.recording_fields"
    validator_class().check_schema(json.loads(schema_text()))
    fields = dict(fields_of(NODE))
    assert [name for name, one in fields.items() if not (name.endswith("*") or one.get("description"))] == []
    assert fields[".schema_version"]["const"] == SCHEMA_VERSION
    assert tuple(fields[".skeleton.table"]["enum"]) == SKELETONS


def without(*path: str) -> Callable[[dict[str, Any]], None]:
    """A change that leaves a field out."""

    def change(index: dict[str, Any]) -> None:
        *tables, field = path
        for table in tables:
            index = index[table]
        del index[field]

    return change


def with_(value: Any, *path: str) -> Callable[[dict[str, Any]], None]:
    """A change that gives a field a value."""

    def change(index: dict[str, Any]) -> None:
        *tables, field = path
        for table in tables:
            index = index[table]
        index[field] = value

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (with_(5, "camera"), r"recording\.toml: camera: not a table; write its fields under \[camera\]"),
        (with_([1], "camera"), r"camera: not a table; write its fields under \[camera\]"),
        (with_({}, "views"), r"views: not tables in a row; begin each with \[\[views\]\]"),
        (with_([{"camera": {}}], "views"), r"\[views\.1\] keypoints: missing; add it: As those of the first camera"),
        (without("camera"), r"camera: is missing; a camera and its keypoints go together"),
        (with_({}, "subjekt"), r"unknown field in .*recording\.toml 'subjekt'\. Did you mean 'subject'\?"),
        (with_("b", "notes", "name"), r"\[notes\] 'name'\. Known: acknowledgement, text"),
        (with_(math.nan, "scene", "floor_height_m"), r"\[scene\] floor_height_m: nan is not a finite number"),
        (with_(19.5, "camera", "width_px"), r"\[camera\] width_px: 19.5 is not a positive whole number"),
        (with_([1], "camera", "assumed"), r"\[camera\] assumed: \[1\] is not a list of names"),
        (with_([[1]], "camera", "K"), r"\[camera\] K: expected 3 x 3 numbers, got shape \(1, 1\)"),
        (without("camera", "target_m"), r"\[camera\] target_m: missing; add it: A point in world on the optical axis"),
        (with_("a.toml", "camera", "file"), r"\[camera\] width_px: stands beside file, which has it too"),
        (with_("z", "camera", "up"), r"\[camera\] up: belongs to a calibration file"),
        (with_({"file": "a.NPZ", "held": "portrait"}, "camera", "motion"), r"motion\] held: belongs to the log"),
        (with_({"file": "a", "held": "up"}, "camera", "motion"), r"held: 'up' is not one of portrait, "),
        (with_("auto", "keypoints", "layot"), r"Did you mean 'layout'"),
        (with_(["a"], "keypoints", "landmarks"), r"\[keypoints\] layout: stands beside landmarks"),
        (with_({"joint": 1}, "imus", "sensors", "a"), r"\[imus\.sensors\.a\] joint: 1 is not text; put it"),
        (without("imus", "sensors", "strap", "R_world_inertial"), r"R_world_inertial: missing; give one of"),
        (with_([1, 0, 0, 0], "imus", "sensors", "strap", "quat_wxyz_world_inertial"), r"stands beside R_world_inert"),
        (with_("g", "imus", "acceleration_unit"), r"acceleration_unit: is for the files of sensors' makers"),
        (with_(0.1, "imus", "clock_drift"), r"clock_drift: 0.1 s/s is no clock's"),
        (without("imus", "file"), r"\[imus\] names: is for a file of samples, but there is none"),
        (with_(datetime.date(2026, 1, 31), "session", "date"), r"\[session\] date: .* is not text; put it in quotes"),
    ],
)
def test_what_is_wrong_is_named_with_file_field_and_remedy(
    change: Callable[[dict[str, Any]], None], message: str
) -> None:
    index = index_of("everything")
    change(index)
    with pytest.raises(RtofError, match=message):
        RecordingTable.of(index, Path(INDEX))


def test_a_misspelt_field_is_named_with_its_line_before_any_other_file_is_read(tmp_path: Path) -> None:
    (tmp_path / INDEX).write_text(
        '# focal_px\nname = "a"\nschema_version = 1\n[subject]\nmass_kg = 70\nheigth_m = 1.7\n'
    )
    with pytest.raises(RtofError, match=r"recording\.toml, line 6, \[subject\] 'heigth_m'\. Did you mean 'height_m'\?"):
        Recording.load(tmp_path)

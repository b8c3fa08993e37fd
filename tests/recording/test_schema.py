"""The schema of ``recording.toml`` and the readers agree on every field, in both directions."""

from __future__ import annotations

import copy
import datetime
import json
import math
import pickle
import re
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from schema_recordings import RECORDINGS, write_files

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.errors import RtofError
from rtof_kin.core.files.section import Section
from rtof_kin.data.imu_stream import CHOICES
from rtof_kin.formats.world_axes import UP
from rtof_kin.inertial.orientation import HELD
from rtof_kin.recording import index as index_module
from rtof_kin.recording.files import RECOGNISE, naming
from rtof_kin.recording.index import INDEX, SCHEMA_VERSION, SKELETONS, read_index
from rtof_kin.recording.recording import Recording
from rtof_kin.recording.schema import SCHEMA, check_index, schema, shape_of
from rtof_kin.recording.sources import InMemory
from rtof_kin.recording.streams import ALL
from rtof_kin.vision.layouts import detector_table

DEMO = Path(__file__).parents[2] / "models/demo"
DELETED = object()
VALUES = (DELETED, "text", True, 3, 1.5, -1, math.nan, datetime.date(2026, 1, 31), [], ["a"], [1.0], {})
KINDS = (DELETED, "text", True, 1.5, [])
CONTENTS = (
    "no human height",
    "is no person's",
    "the skeleton stands",
    "leads out of the folder",
    "there is no file",
    "has times of its own",
    "has no times",
    r"\[imus\] '(names|map|gravity|\w+_\w+)'",
    "it has no table",
    "unknown (joint|segment|sensor|camera)",
    "is not a day",
    "shift them to one clock",
    "is it in mm",
    "no such person",
    "on their clock",
    "points; name each one",
    "sensors are named",
    "list the sensors in the file's order",
    "stabilised already",
    "name one of a, b",
    "longer than 1 m",
    r"strap\] (joint|lever_arm_m): missing",
    r"joint_offsets_m\] \w+: missing",
)
"""What readers find that the text alone does not tell."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recording")
    write_files(folder)
    return folder


def index_of(name: str) -> dict[str, Any]:
    return tomllib.loads(RECORDINGS[name])


def fault(check: Callable[[], object]) -> str | None:
    try:
        check()
    except RtofError as error:
        return str(error)
    return None


def refused_by_schema(folder: Path, index: dict[str, Any]) -> str | None:
    return fault(lambda: check_index(Section(folder / INDEX, index)))


def refused_by_readers(folder: Path, index: dict[str, Any]) -> str | None:
    def read() -> None:
        with naming(folder / INDEX), np.errstate(all="ignore"):
            fields, streams = read_index(Section(folder / INDEX, index), InMemory())
            Recording(**fields, **streams.parts(lambda stream: stream.part(ALL)))

    return fault(read)


@pytest.fixture(autouse=True)
def _readers_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(index_module, "check_index", lambda _: None)
    for name in ("with_height", "with_bone_lengths", "with_mass", "with_offsets", "with_posture"):
        monkeypatch.setattr(SkeletonModel, name, remembering(getattr(SkeletonModel, name)))


def remembering(method: Callable[..., SkeletonModel]) -> Callable[..., SkeletonModel]:
    """The method, which makes equal bodies of the same one once: they take most of the time."""
    made: dict[tuple[SkeletonModel, bytes], SkeletonModel] = {}

    def call(skeleton: SkeletonModel, *args: object) -> SkeletonModel:
        key = skeleton, pickle.dumps(args)
        if key not in made:
            made[key] = method(skeleton, *args)
        return made[key]

    return call


# --- agreement -----------------------------------------------------------------------------------


def tables(index: dict[str, Any], node: dict[str, Any], where: str = "") -> Iterator[tuple[str, dict[str, Any], Any]]:
    """Name, contents and schema of all tables."""
    yield where, index, node
    for field, value in index.items():
        inner = node.get("properties", {}).get(field, node["additionalProperties"])
        if isinstance(value, dict):
            yield from tables(value, inner, f"{where}.{field}")
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            yield from tables(value[0], inner["items"], f"{where}.{field}")


def fields_of(node: dict[str, Any], where: str = "") -> Iterator[tuple[str, dict[str, Any]]]:
    """All fields of the schema, with their tables."""
    inner = dict(node.get("properties", {}))
    if isinstance(node.get("additionalProperties"), dict):
        inner["*"] = node["additionalProperties"]
    for field, one in inner.items():
        yield f"{where}.{field}", one
        yield from fields_of(one.get("items") or one, f"{where}.{field}")


def changed(name: str, tried: set[str]) -> Iterator[tuple[str, dict[str, Any]]]:
    """The recording with one field left out or added, or, unless it was tried, of another value or kind.

    Of fields that are alike in the schema, the first one is given all values, the others one of each kind.
    """
    whole = index_of(name)
    for where, table, node in tables(whole, schema()):
        for field in list(table) if "properties" in node else list(table)[:1]:
            kept = table[field]
            own = dict(node.get("properties", {}).get(field, {}), description="")
            known = {f"{where}.{field}", kind := json.dumps(own)} & tried
            for value in (DELETED,) if f"{where}.{field}" in known else KINDS if known else VALUES:
                if value is DELETED:
                    del table[field]
                else:
                    table[field] = value
                yield f"{name}{where}.{field} = {value}", copy.deepcopy(whole)
                table[field] = kept
            tried |= {f"{where}.{field}", kind}
        for field in (*node.get("properties", {}), "mispelt"):
            if field not in table:
                table[field] = usual(node.get("properties", {}).get(field, {}))
                yield f"{name}{where}.{field} added", copy.deepcopy(whole)
                del table[field]


def usual(node: dict[str, Any]) -> Any:
    """A value of the kind that the schema says."""
    if "enum" in node:
        return node["enum"][0]
    if shape := shape_of(node) if "prefixItems" in node else ():
        return (
            (np.eye(3) if shape == (3, 3) else np.eye(*shape, 1)[:, 0]).tolist() if len(shape) > 1 else [1.0] * shape[0]
        )
    kinds = {"number": 1.0, "integer": 1, "boolean": True, "object": {}, "array": [], "string": "imus.npz"}
    return kinds[node.get("type", "string")]


def test_schema_and_readers_accept_and_refuse_the_same(folder: Path) -> None:
    disagreements, tried = [], set[str]()
    for name in RECORDINGS:
        assert refused_by_schema(folder, index_of(name)) is None
        assert refused_by_readers(folder, index_of(name)) is None
        for what, index in changed(name, tried):
            by_schema, by_readers = refused_by_schema(folder, index), refused_by_readers(folder, index)
            if by_schema and not by_readers:
                disagreements.append(f"{what}: schema alone: {by_schema}")
            if by_readers and not by_schema and not any(re.search(text, by_readers) for text in CONTENTS):
                disagreements.append(f"{what}: readers alone: {by_readers}")
    assert not disagreements, "\n".join(disagreements)


# --- one contract --------------------------------------------------------------------------------


def test_the_recordings_here_have_every_field_of_the_schema() -> None:
    used = {
        re.sub(r"(sensors|bone_lengths_m|joint_offsets_m|map|quat_wxyz)\.\w+", r"\1.*", f"{where}.{field}")
        for name in RECORDINGS
        for where, table, _ in tables(index_of(name), schema())
        for field in table
    }
    views = {f".{name}" for name in ("camera", "keypoints")}
    expected = {name for name, _ in fields_of(schema())}
    missing = {name for name in expected - used if name.removeprefix(".views") not in used}
    assert missing == set()
    assert used <= expected
    assert views <= used


def test_choices_are_those_of_the_code() -> None:
    field = dict(fields_of(schema()))
    assert field[".schema_version"]["const"] == SCHEMA_VERSION
    layouts = ["joints", RECOGNISE, *detector_table().layouts]
    assert sorted(field[".keypoints.layout"]["enum"]) == sorted(set(layouts))
    assert all(name in field[".keypoints.layout"]["errorMessage"] for name in layouts)
    choices = {
        ".skeleton.table": SKELETONS,
        ".camera.up": UP,
        ".camera.motion.held": HELD,
        **{f".imus.{name}": values for name, values in CHOICES.items()},
    }
    for name, values in choices.items():
        assert tuple(field[name]["enum"]) == tuple(values), name


def test_schema_is_valid_and_says_what_every_field_is() -> None:
    from jsonschema import Draft202012Validator

    Draft202012Validator.check_schema(json.loads(SCHEMA.read_text(encoding="utf-8")))
    assert [name for name, one in fields_of(schema()) if not (name.endswith("*") or one.get("description"))] == []


def test_demo_and_saved_recordings_hold_to_the_schema(tmp_path: Path) -> None:
    Recording.load(DEMO).save(tmp_path / "saved")
    for folder in (DEMO, tmp_path / "saved"):
        check_index(Section.of_file(folder / INDEX))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"camera": 5}, r"recording\.toml: camera: not a table; write its fields under \[camera\]"),
        ({"views": {}}, r"views: not tables in a row; begin each with \[\[views\]\]"),
        ({"camera": None}, r"camera: is missing; a camera and its keypoints go together"),
        ({"imus": {"sensors": {"a": {"joint": 1}}}}, r"\[imus\.sensors\.a\] joint: 1 is not text; put it"),
        ({"subjekt": {}}, r"unknown field in .*recording\.toml 'subjekt'\. Did you mean 'subject'\?"),
        ({"session": {"date": datetime.date(2026, 1, 31)}}, r"\[session\] date: .* is not text; put it in quotes"),
        ({"notes": {"text": "a", "name": "b"}}, r"\[notes\] 'name'\. Known: acknowledgement, text"),
        ({"scene": {"floor_height_m": math.nan}}, r"\[scene\] floor_height_m: nan is not a finite number"),
        ({"views": [{"camera": {}}]}, r"\[views\.1\.camera\] width_px: missing; add e\.g\. width_px = 1\.0"),
    ],
)
def test_what_is_wrong_is_told_with_file_field_and_remedy(change: dict[str, Any], message: str) -> None:
    index = {name: value for name, value in {**index_of("everything"), **change}.items() if value is not None}
    with pytest.raises(RtofError, match=message):
        check_index(Section(Path("recording.toml"), index))


def test_a_misspelt_field_is_told_with_its_line(tmp_path: Path) -> None:
    path = tmp_path / INDEX
    path.write_text('# focal_px\nname = "a"\nschema_version = 1\n[subject]\nmass_kg = 70\nheigth_m = 1.7\n')
    message = r"recording\.toml, line 6, \[subject\] 'heigth_m'\. Did you mean 'height_m'\?"
    with pytest.raises(RtofError, match=message):
        check_index(Section.of_file(path))


def test_check_needs_no_other_file_and_opening_raises_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(index_module, "check_index", check_index)
    (tmp_path / INDEX).write_text(RECORDINGS["everything"].replace("K = [[1250,", "K = [[true,"))
    with pytest.raises(RtofError, match=r"\[views\.1\.camera\] K: not 3 x 3 numbers in brackets"):
        Recording.load(tmp_path)

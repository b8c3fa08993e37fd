"""Writes the JSON Schema of ``recording.toml`` and the tables of docs/recording.md from `rtof_kin.recording.tables`.

`python -m docs.recording_fields` writes the schema, and the tables between the two marks of the page.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue
from pydantic_core import core_schema

from rtof_kin.core.files.input_table import InputTable
from rtof_kin.recording.tables import SCHEMA, RecordingTable

PAGE = Path(__file__).with_name("recording.md")
BEGIN, END = "<!-- fields: made by python -m docs.recording_fields -->", "<!-- end of fields -->"


class _Schema(GenerateJsonSchema):
    """A schema with descriptions, without titles, and without null, which TOML does not have."""

    def model_schema(self, schema: core_schema.ModelSchema) -> JsonSchemaValue:
        node = super().model_schema(schema)
        for name, text in schema["cls"].descriptions().items():
            node["properties"][name]["description"] = text
        return node

    def nullable_schema(self, schema: core_schema.NullableSchema) -> JsonSchemaValue:
        return self.generate_inner(schema["schema"])

    def default_schema(self, schema: core_schema.WithDefaultSchema) -> JsonSchemaValue:
        node = super().default_schema(schema)
        if not isinstance(node.get("default"), bool | int | float) and node.get("default") in (None, "", [], {}):
            node.pop("default", None)
        return node

    def field_title_should_be_set(self, schema: Any) -> bool:
        return False


def json_schema(model: type[InputTable]) -> dict[str, Any]:
    """Return the JSON Schema (2020-12) of a table, which does not have its rules."""
    content = model.model_json_schema(schema_generator=_Schema)
    for node in (content, *content.get("$defs", {}).values()):
        node.pop("title", None)
        if "description" in node:
            node["description"] = " ".join(node["description"].split())
        for one in node["properties"].values():
            if isinstance(one.get("default"), dict):  # of a table: those of its fields
                del one["default"]
    return content


@cache
def inlined_schema(model: type[InputTable]) -> dict[str, Any]:
    """Return the JSON Schema of a table, with what it refers to in place of its references."""
    content = json_schema(model)
    definitions = content.pop("$defs", {})

    def resolved(node: Any) -> Any:
        if isinstance(node, list):
            return [resolved(one) for one in node]
        if not isinstance(node, dict):
            return node
        if "$ref" in node:
            node = definitions[node["$ref"].rsplit("/", 1)[1]] | {k: node[k] for k in node if k != "$ref"}
        return {key: resolved(value) for key, value in node.items()}

    found: dict[str, Any] = resolved(content)
    return found


def shape_of(node: dict[str, Any]) -> tuple[int, ...]:
    """Return the shape of an array of numbers in a schema."""
    return () if node.get("type") != "array" else (node["minItems"], *shape_of(node["items"]))


def kind(node: dict[str, Any]) -> str:
    """What a field may be, in words."""
    if "const" in node:
        return f"`{node['const']}`"
    if "anyOf" in node:
        return ", ".join(map(kind, node["anyOf"]))
    if "pattern" in node:
        ending = node["pattern"].strip("\\$")
        return f"a file `*{ending}`"
    if "enum" in node:
        return ", ".join(f'`"{one}"`' for one in node["enum"])
    if node["type"] == "array":
        rows = {"string": "names", "object": "tables"}
        return rows.get(node["items"]["type"]) or " x ".join(map(str, shape_of(node))) + " numbers"
    if node["type"] == "object":
        inner = node.get("additionalProperties")
        return f"by name: {kind(inner)}" if inner and "properties" not in inner else "table"
    bound = {"exclusiveMinimum": "> {}", "minimum": ">= {}"}
    low = [text.format(node[key]) for key, text in bound.items() if node.get(key) in (0, 1)]
    names = {"string": "text", "boolean": "`true`, `false`", "integer": "whole number"}
    return " ".join([names.get(node["type"], "number"), *low])


def rows(node: dict[str, Any]) -> Iterator[str]:
    for field, one in node["properties"].items():
        meaning = one["description"]
        if field in node.get("required", ()):
            meaning = f"**Required.** {meaning}"
        if "default" in one:
            meaning += f" Default: `{str(one['default']).lower()}`."
        yield f"| `{field}` | {kind(one)} | {meaning} |"


def tables(node: dict[str, Any], name: str = "") -> Iterator[str]:
    """One Markdown table for each table of a recording, the top level first."""
    title = f"`[{name}]`: {node['description']}" if name else "At the top, before any table:"
    yield "\n".join([title, "", "| field | value | |", "|---|---|---|", *rows(node)])
    for field, one in node["properties"].items():
        inner = f"{name}.{field}" if name else field
        if field == "views":
            yield f"`[[views]]`: {one['description']} `[views.camera]` and `[views.keypoints]` are as above."
        elif "properties" in one:
            yield from tables(one, inner)
        elif "properties" in (by_name := one.get("additionalProperties") or {}):
            yield from tables({**by_name, "description": one["description"]}, f"{inner}.NAME")


def page() -> str:
    """The page with today's tables."""
    before, rest = PAGE.read_text(encoding="utf-8").split(BEGIN)
    after = rest.split(END)[1]
    return "\n\n".join([before + BEGIN, *tables(inlined_schema(RecordingTable)), END + after])


def schema_text() -> str:
    """The text of today's schema."""
    head = {"$schema": "https://json-schema.org/draft/2020-12/schema", "$id": "urn:rtof_kin:recording:1"}
    return json.dumps(head | {"title": "recording.toml"} | json_schema(RecordingTable), indent=2) + "\n"


if __name__ == "__main__":
    SCHEMA.write_text(schema_text(), encoding="utf-8")
    PAGE.write_text(page(), encoding="utf-8")

"""The schema of ``recording.toml``, ``recording.schema.json`` beside this file, and the check against it.

The check runs whenever a recording is opened, before any other file is read. What depends on the contents of
those, on the names of a skeleton or on physics is checked by the readers.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Mapping
from functools import cache
from pathlib import Path
from typing import Any, Final, Protocol, cast

from rtof_kin.core.errors import RtofError, UnknownNameError, did_you_mean
from rtof_kin.core.files.section import Section
from rtof_kin.vision.layouts import detector_table

SCHEMA: Final = Path(__file__).with_name("recording.schema.json")
"""The file, JSON Schema 2020-12. ``errorMessage``, for people, is also known to editors."""
Node = Mapping[str, Any]
"""A part of the schema."""
_LONGEST: Final = 40
"""Most characters of a wrong value in a message."""


class _Violation(Protocol):
    """What is used of `jsonschema.ValidationError`."""

    validator: str
    """Keyword of the schema that is violated."""
    validator_value: Any
    schema: Node
    """Innermost part of the schema with that keyword."""
    instance: Any
    absolute_path: Iterable[Any]
    message: str


@cache
def schema() -> Node:
    """Return the schema, with what it refers to in place of its references."""
    content: Node = json.loads(SCHEMA.read_text(encoding="utf-8"))
    definitions = content["$defs"]

    def resolved(node: Any) -> Any:
        if isinstance(node, list):
            return [resolved(one) for one in node]
        if not isinstance(node, dict):
            return node
        if "$ref" in node:
            node = definitions[node["$ref"].rsplit("/", 1)[1]] | {k: node[k] for k in node if k != "$ref"}
        return {key: resolved(value) for key, value in node.items()}

    return cast(Node, resolved({key: content[key] for key in content if key != "$defs"}))


def check_index(index: Section) -> None:
    """Check the text of a recording against the schema.

    Args:
        index: top level of ``recording.toml``.

    Raises:
        FileFormatError, UnknownNameError: the message names file, field and remedy.
    """
    errors = [error for error in _validator().iter_errors(index.data) if not _names_added_layout(error)]
    if errors:
        raise _explained(index, min(errors, key=_rank))


def _names_added_layout(error: Any) -> bool:
    """Whether it is about a layout that was added to the shipped ones (`vision.layouts.add_layout`)."""
    at_layout = [*error.absolute_path][-1:] == ["layout"] and error.validator == "enum"
    return at_layout and error.instance in [*detector_table().layouts]


@cache
def _validator() -> Any:
    from jsonschema import Draft202012Validator, validators  # type: ignore[import-untyped]  # late: 0.1 s

    def is_number(_: object, value: object) -> bool:
        finite = not isinstance(value, float) or math.isfinite(value)
        return isinstance(value, int | float) and not isinstance(value, bool) and finite

    types = Draft202012Validator.TYPE_CHECKER.redefine("number", is_number)
    return validators.extend(Draft202012Validator, type_checker=types)(schema())


def _rank(error: _Violation) -> int:
    """Return the order in which errors are told: a misspelt field is also a missing one."""
    if error.validator == "required" and "errorMessage" not in error.schema:
        return 0
    return 1 if error.validator == "additionalProperties" else 2


def _explained(index: Section, error: _Violation) -> RtofError:
    """Return the error to raise: what `Section` says of the field, or else the schema."""
    table, node, field = _place(index, list(error.absolute_path), error.validator)
    told = str(error.schema.get("errorMessage", ""))
    if error.validator == "required":
        field = next(name for name in error.validator_value if name not in table.data)
    if error.validator == "not" or (error.validator == "required" and told):
        return table.error(field, told)
    for name in node.get("properties", ()):
        if name != field:
            table.has(name)  # known
    try:
        if error.validator == "additionalProperties":
            table.close()
        else:
            _read(table, field, _field(node, field))
    except RtofError as found:
        return found
    value = repr(error.instance)[:_LONGEST]
    if error.validator != "enum" or told:
        return table.error(field, f"{value} {told or 'is not allowed: ' + error.message[:200]}")
    known = error.validator_value
    if "title" in error.schema:
        return UnknownNameError(error.schema["title"], [str(error.instance)], known, table.path, table.where(field))
    hint = did_you_mean([str(error.instance)], map(str, known))
    return table.error(field, f"{value} is not one of {', '.join(known)}{'.' if hint else ''}{hint}")


def _place(index: Section, steps: list[Any], keyword: str) -> tuple[Section, Node, str]:
    """Return the innermost table on a path, its schema, and the field in it that an error is about.

    Args:
        keyword: that failed; of some the field is not on the path.
    """
    table, node = index, schema()
    of_table = keyword in ("required", "additionalProperties")
    while steps:
        value, inner = table.data[steps[0]], _field(node, steps[0])
        row = inner.get("type") == "array" and len(steps) > 1 and isinstance(value[steps[1]], dict)
        if not (row or isinstance(value, dict)) or len(steps) <= row + (not of_table):
            return table, node, steps[0]
        if row:
            table, node = table.tables(steps[0])[steps[1]], inner["items"]
        else:
            table, node = table.table(steps[0]), inner
        del steps[: row + 1]
    return table, node, ""


def _field(node: Node, field: str) -> Node:
    """Return the schema of a field of a table."""
    own = node.get("properties", {})
    return cast(Node, own[field] if field in own else node["additionalProperties"])


def _read(table: Section, field: str, node: Node) -> None:
    """Read a field as its schema says, so that `Section` raises what is wrong."""
    plain: dict[str, Callable[[str], Any]] = {
        "number": table.number,
        "integer": table.integer,
        "boolean": table.flag,
        "object": table.table,
    }
    if node.get("type") != "array":
        plain.get(node.get("type", "string"), table.text)(field)
    elif "prefixItems" in node:
        table.array(field, shape_of(node))
    elif node["items"]["type"] == "object":
        table.tables(field)
    else:
        table.optional_names(field)


def shape_of(node: Node) -> tuple[int, ...]:
    """Return the shape of an array of numbers."""
    return () if node.get("type") != "array" else (node["minItems"], *shape_of(node["prefixItems"][0]))

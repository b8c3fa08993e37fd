"""The commented ``recording.toml`` of `make_recording`: every value says where it is from."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any, Final

import tomlkit
from tomlkit.items import Table

_WIDTH: Final = 100  # Longest line with its comment; a longer comment stands above the line
_LEGEND: Final = (
    "Where each value is from:",
    "  given    you said so",
    "  file     from a file of yours",
    "  found    estimated from this recording",
    "  assumed  nobody measured it: correct it if you know better",
    "Correct what is wrong; the commands that follow read this file.",
)


class Origin(Enum):
    """Where a value of a recording is from."""

    GIVEN = "given"
    FILE = "file"
    FOUND = "found"
    ASSUMED = "assumed"


@dataclass(frozen=True)
class Field:
    """A value of ``recording.toml`` with its origin."""

    value: Any  #: Text, number, or lists of them
    origin: Origin | None = None  #: None for what needs no explanation
    note: str = ""  #: What follows the origin in the comment
    summary: str = ""  #: Sentence for the summary of the command; '' leaves the field out there

    @property
    def comment(self) -> str:
        """Text of the comment; '' where there is none."""
        return self.note if self.origin is None else f"{self.origin.value}: {self.note}".rstrip(": ")


Tables = Mapping[str, "Field | Tables"]


def recording_text(tables: Tables, title: str) -> str:
    """Return the TOML text of tables of fields. `title`: first line of the file's comment."""
    document = tomlkit.document()
    for line in (title, "", *_LEGEND):
        document.add(tomlkit.comment(line) if line else tomlkit.nl())
    document.add(tomlkit.nl())
    _fill(document, tables)
    return tomlkit.dumps(document)


def _fill(table: Table | tomlkit.TOMLDocument, fields: Tables) -> None:
    for name, field in fields.items():
        if not isinstance(field, Field):
            inner = tomlkit.table(is_super_table=not any(isinstance(one, Field) for one in field.values()))
            _fill(inner, field)
            table.add(name, inner)
            continue
        item = tomlkit.item(field.value)
        comment = " ".join(field.comment.split())
        if len(f"{name} = {item.as_string()}  # {comment}") <= _WIDTH:
            if comment:
                item.comment(comment).trivia.comment_ws = "  "
        else:
            for line in textwrap.wrap(comment, _WIDTH - 2):
                table.add(tomlkit.comment(line))
        table.add(name, item)


def summaries(tables: Tables) -> Iterator[tuple[Origin, str]]:
    """Yield origin and sentence of every field that the summary names."""
    for field in tables.values():
        if not isinstance(field, Field):
            yield from summaries(field)
        elif field.summary and field.origin is not None:
            yield field.origin, field.summary

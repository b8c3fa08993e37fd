"""Who was recorded, by whom, when and where: labels that reports print and nothing computes with."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from datetime import date
from typing import Any, Self

from rtof_kin.core.errors import InvalidInputError, ShapeError
from rtof_kin.core.files.section import Section


@dataclass(frozen=True)
class Session:
    """The labels of one session; '' where something is not known."""

    subject: str = ""
    """Name or code of who was recorded."""
    operator: str = ""
    """Who recorded."""
    date: str = ""
    """Day of the recording, as 2026-01-31."""
    place: str = ""
    """Where it was recorded."""
    protocol: str = ""
    """What the subject was asked to do."""

    def __post_init__(self) -> None:
        if not self.date:
            return
        try:
            date.fromisoformat(self.date)
        except ValueError as error:
            raise ShapeError(
                f"session date: {self.date!r} is no day; write year, month and day, as 2026-01-31"
            ) from error

    @classmethod
    def of(cls, labels: Mapping[str, Any]) -> Self:
        """The labels of plain data; what is not there is not known.

        Raises:
            ShapeError: a label is no text, or the date no day.
        """
        known = {field.name: labels.get(field.name, "") for field in fields(cls)}
        for name, text in known.items():
            if not isinstance(text, str):
                raise ShapeError(f"session {name}: {str(text)[:40]!r} is no text")
        return cls(**known)

    def plain(self) -> dict[str, str]:
        """What is known, by field."""
        return {name: text for name, text in asdict(self).items() if text}

    def updated(self, other: Session) -> Session:
        """These labels, with what another one knows in their place."""
        return Session.of(self.plain() | other.plain())


def read_session(section: Section) -> Session:
    """The labels of a table ``[session]``; all of its fields may be left out.

    Raises:
        FileFormatError: a field is no text, or the date no day.
        UnknownNameError: a field is none of these.
    """
    labels = {field.name: section.text(field.name, "") for field in fields(Session)}
    section.close()
    try:
        return Session(**labels)
    except InvalidInputError as error:
        raise section.error("date", str(error)) from error

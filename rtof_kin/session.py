"""Who was recorded, by whom, when and where: labels that reports print and nothing computes with."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from datetime import date
from typing import Self

from rtof_kin.errors import ShapeError
from rtof_kin.io.section import Section


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

    def plain(self) -> dict[str, str]:
        """What is known, by field."""
        return {name: text for name, text in asdict(self).items() if text}

    def updated(self, other: Self) -> Session:
        """These labels, with what another one knows in their place."""
        return Session(**(self.plain() | other.plain()))


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
    except ShapeError as error:
        raise section.error("date", str(error)) from error

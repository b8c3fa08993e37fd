"""Labels of a session."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from datetime import date
from typing import Any, Self

from rtof_kin.core.errors import InvalidInputError


@dataclass(frozen=True)
class Session:
    """Labels of one session; '' where unknown."""

    subject: str = ""  #: Name or code of the person recorded
    operator: str = ""  #: Person who made the recording
    date: str = ""  #: Day of the recording, as 2026-01-31
    place: str = ""  #: Place of the recording
    protocol: str = ""  #: Task of the subject

    def __post_init__(self) -> None:
        if not self.date:
            return
        try:
            date.fromisoformat(self.date)
        except ValueError as error:
            raise InvalidInputError(
                f"session date: {self.date!r} is not a day; write year, month and day, as 2026-01-31"
            ) from error

    @classmethod
    def of(cls, labels: Mapping[str, Any]) -> Self:
        """Make the labels from plain data by field; missing ones are unknown. `InvalidInputError`: no text, or the date
        no day.
        """
        known = {field.name: labels.get(field.name, "") for field in fields(cls)}
        for name, text in known.items():
            if not isinstance(text, str):
                raise InvalidInputError(f"session {name}: {str(text)[:40]!r} is not text")
        return cls(**known)

    def plain(self) -> dict[str, str]:
        """Return the known labels by field."""
        return {name: text for name, text in asdict(self).items() if text}

    def updated(self, other: Session) -> Session:
        """Return these labels, replaced by those of another session where it has them."""
        return Session.of(self.plain() | other.plain())

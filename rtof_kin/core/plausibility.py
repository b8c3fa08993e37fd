"""Results of plausibility checks of the user's data: a value against its limit, with advice.

Validation of arrays, which raises errors, is in `checks`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, Self


class Verdict(Enum):
    """Outcome of a check."""

    PASSED = "holds"
    FAILED = "does not hold"
    NOT_POSSIBLE = "cannot be checked"


@dataclass(frozen=True)
class Check:
    """One value against its limit."""

    name: str
    """Checked quantity."""
    subject: str
    """Take, sensor, camera or bone that is checked."""
    value: float
    """NaN if it cannot be computed; such a check neither passes nor fails."""
    limit: float
    """Largest value that passes."""
    unit: str
    """Unit of value and limit."""
    advice: str = ""
    """Possible meaning of a failure; of a NaN value, the reason."""
    likely: Mapping[str, Any] = field(default_factory=dict)
    """Change of the declaration with which the check would pass. It is only reported."""
    cause: str = ""
    """Most likely cause of a failure as a headline, e.g. 'the focal length is too short'; may be empty."""

    @classmethod
    def unknown(cls, name: str, subject: str, unit: str, why: str) -> Self:
        """Return a check that the data do not allow; `why` is its advice."""
        return cls(name, subject, math.nan, math.nan, unit, why)

    @property
    def verdict(self) -> Verdict:
        """Outcome by value and limit."""
        if math.isnan(self.value):
            return Verdict.NOT_POSSIBLE
        return Verdict.PASSED if self.value <= self.limit else Verdict.FAILED

    @property
    def passed(self) -> bool:
        """True if the value is finite and within its limit."""
        return self.verdict is Verdict.PASSED

    @property
    def failed(self) -> bool:
        """True if the value exceeds its limit."""
        return self.verdict is Verdict.FAILED

    @property
    def message(self) -> str:
        """One line: subject, name, value, limit and, unless passed, the advice."""
        text = f"{self.subject}: {self.name} is {self.value:.3g} {self.unit} (limit {self.limit:g})"
        text = f"{self.cause}: {text}" if self.failed and self.cause else text
        return text if self.passed else f"{text}. {self.advice}"

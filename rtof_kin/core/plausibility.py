"""Figures against their limits: what a check of somebody's data found."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, Self


class Verdict(Enum):
    """What a check found."""

    PASSED = "holds"
    FAILED = "does not hold"
    NOT_POSSIBLE = "cannot be told"


@dataclass(frozen=True)
class Check:
    """One figure against its limit."""

    name: str
    """What is checked."""
    subject: str
    """What it is about: the take, a sensor, a camera, a bone."""
    value: float
    """NaN where nothing is known; such a check is neither passed nor failed."""
    limit: float
    """Largest value that passes."""
    unit: str
    """Of value and limit."""
    advice: str = ""
    """What a failure may mean; of an unknown value, why it cannot be told."""
    likely: Mapping[str, Any] = field(default_factory=dict)
    """The change of the declaration that would make it hold. It is only reported."""
    cause: str = ""
    """The most likely cause of a failure, as a headline: 'the focal length is too short'. Empty where the
    figure does not tell one."""

    @classmethod
    def unknown(cls, name: str, subject: str, unit: str, why: str) -> Self:
        """A check that the data do not allow."""
        return cls(name, subject, float("nan"), float("nan"), unit, why)

    @property
    def verdict(self) -> Verdict:
        """By value and limit."""
        if math.isnan(self.value):
            return Verdict.NOT_POSSIBLE
        return Verdict.PASSED if self.value <= self.limit else Verdict.FAILED

    @property
    def passed(self) -> bool:
        """Whether the figure is known and within its limit."""
        return self.verdict is Verdict.PASSED

    @property
    def failed(self) -> bool:
        """Whether the figure is known and beyond its limit."""
        return self.verdict is Verdict.FAILED

    @property
    def message(self) -> str:
        """One line: what, where, the figure, its limit, and what a failure may mean."""
        text = f"{self.subject}: {self.name} is {self.value:.3g} {self.unit}"
        text += f" (limit {self.limit:g})"
        text = f"{self.cause}: {text}" if self.failed and self.cause else text
        return text if self.passed else f"{text}. {self.advice}"

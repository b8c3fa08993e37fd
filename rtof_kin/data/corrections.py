"""What a person corrects by hand in a recording: what is left out, exchanged sides, foot contacts, events, repetitions.

The files stay as they were recorded. Each correction says who made it, when and why.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Final, Literal, get_args

import numpy as np

from rtof_kin.core.array_types import Array, Mask
from rtof_kin.core.choices import Repeated

CorrectionKind = Literal[
    "leave_out", "exchange_sides", "foot_contact", "foot_strike", "foot_off", "stride", "no_event", "repetition"
]
EVENTS: Final = ("foot_strike", "foot_off")
_OF_FOOT: Final = (*EVENTS, "foot_contact", "stride", "no_event")
_NEAR: Final = 0.2  # [s] events within which of the ends of a stride are those that it replaces


@dataclass(frozen=True)
class Correction:
    """One correction by hand."""

    kind: CorrectionKind
    what: str = ""
    """leave_out: all, image, sensors or a sensor's name. Of feet: left or right. repetition: squat or sit_to_stand."""
    start_s: float = -np.inf  #: Where it begins, or the instant of an event, s on the recording's clock
    stop_s: float = np.inf  #: Where it ends, s
    who: str = ""
    when: str = ""  #: Day and time, as 2026-01-31T10:15
    why: str = ""
    applied: bool = False  #: Whether the samples of the recording's files have it already

    @property
    def problem(self) -> str:
        """What is wrong with it; '' where nothing is."""
        if self.kind == "leave_out" and not self.what:
            return 'says not what is left out; write what = "all", "image", "sensors" or a sensor\'s name'
        if self.kind in _OF_FOOT and self.what not in ("left", "right"):
            return f'{self.what!r} is no foot; write what = "left" or "right"'
        if self.kind == "repetition" and self.what not in get_args(Repeated):
            return f"{self.what!r} is not repeated; write one of {', '.join(get_args(Repeated))}"
        if self.kind in EVENTS and not np.isfinite(self.start_s):
            return "has no instant; write start_s"
        if self.kind in ("stride", "foot_contact", "repetition") and not np.isfinite([self.start_s, self.stop_s]).all():
            return "has no start and stop; write start_s and stop_s"
        return "" if self.start_s < self.stop_s else f"stops at {self.stop_s:g} s, not after {self.start_s:g} s"

    @property
    def span(self) -> tuple[float, float]:
        """(start_s, stop_s)."""
        return self.start_s, self.stop_s

    def __str__(self) -> str:
        what = " ".join(filter(None, (self.kind.replace("_", " "), self.what)))
        if self.kind in EVENTS:
            where = f" at {self.start_s:.2f} s"
        else:
            begins = f" from {self.start_s:.2f} s" if np.isfinite(self.start_s) else ""
            where = begins + (f" to {self.stop_s:.2f} s" if np.isfinite(self.stop_s) else "")
        by = f", by {self.who}" if self.who else ""
        return f"{what}{where}{by}{f', {self.when}' if self.when else ''}{f': {self.why}' if self.why else ''}"

    def plain(self) -> dict[str, str | float | bool]:
        """Return what it says by field, as a file has it."""
        usual = Correction(self.kind)
        known = {name: value for name, value in asdict(self).items() if value != getattr(usual, name)}
        return {"kind": self.kind} | {key: float(v) if key.endswith("_s") else v for key, v in known.items()}

    def within(self, times: Array) -> Mask:
        """Return which of the times (T,), s, it holds for."""
        return (times >= self.start_s) & (times <= self.stop_s)


def corrected_events(corrections: Iterable[Correction], side: str, strikes: Array, offs: Array) -> tuple[Array, Array]:
    """Return the heel strikes and toe offs of a foot, s, with those that were set by hand."""
    for one in corrections:
        if one.what != side:
            continue
        if one.kind == "no_event":
            strikes, offs = strikes[~one.within(strikes)], offs[~one.within(offs)]
        elif one.kind == "stride":
            start, stop = one.span
            own = (strikes > start - _NEAR) & (strikes < stop + _NEAR)
            strikes = np.sort([*strikes[~own], start, stop])
        elif one.kind == "foot_strike":
            strikes = np.sort([*strikes, one.start_s])
        elif one.kind == "foot_off":
            offs = np.sort([*offs, one.start_s])
    return strikes, offs

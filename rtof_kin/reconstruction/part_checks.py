"""Checks and warnings of the parts of a long recording, joined to those of the whole."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Final

from scipy.stats import binom

from rtof_kin.core.checks import Check

_FALSE_ALARMS: Final = 0.05
"""Share of correct recordings in which a check fails, at most (benchmarks/results/planted.md)."""
_CHANCE: Final = 0.95
_NUMBER: Final = re.compile(r"\d+(\.\d+)?")


@dataclass(frozen=True)
class PartFindings:
    """What was found in one part."""

    start: float
    """Time of its first frame, s."""
    checks: tuple[Check, ...]
    warnings: tuple[str, ...]


def joined_checks(parts: Sequence[PartFindings]) -> tuple[Check, ...]:
    """Return one check in place of those of the parts: it fails where at least half of the parts in which
    it was possible fail, and two at least. It is the one of median value among those that agree with that.
    """
    return parts[0].checks if len(parts) == 1 else tuple(_joined(own) for own in _alike(parts))


def joined_warnings(parts: Sequence[PartFindings]) -> tuple[str, ...]:
    """Return the warnings of all parts once each, with those about checks that fail in some parts only:
    in two neighbouring ones, or in more than one false alarm in twenty explains.
    """
    if len(parts) == 1:
        return parts[0].warnings
    times: dict[str, list[float]] = {}
    for part in parts:
        for sentence in part.warnings:
            times.setdefault(sentence, []).append(part.start)
    out = []
    for text, at in times.items():
        where = f" (in {len(at)} of {len(parts)} parts, first from {at[0]:.0f} s)"
        out.append(text if len(at) in (1, len(parts)) else text + where)
    for own in _alike(parts):
        wrong = [(start, check) for start, check in own if check.failed]
        runs = (len(list(run)) for fails, run in groupby(own, lambda one: one[1].failed) if fails)
        possible = sum(check.passed or check.failed for _, check in own)
        explained = len(wrong) <= binom.ppf(_CHANCE, possible, _FALSE_ALARMS)
        if _joined(own).failed or (explained and max(runs, default=0) < 2):
            continue
        start, check = wrong[0]
        out.append(f"in {len(wrong)} of {len(parts)} parts, first from {start:.0f} s: {check.message}")
    return tuple(out)


_Own = list[tuple[float, Check]]
"""Start of a part, s, and its check."""


def _alike(parts: Sequence[PartFindings]) -> Iterator[_Own]:
    """Yield each check of all parts; numbers in its name do not count."""
    found: dict[tuple[str, str], _Own] = {}
    for part in parts:
        for check in part.checks:
            key = _NUMBER.sub("#", check.name), check.subject
            found.setdefault(key, []).append((part.start, check))
    yield from found.values()


def _joined(own: _Own) -> Check:
    known = sorted((check for _, check in own if check.passed or check.failed), key=lambda c: c.value)
    if not known:
        return own[0][1]
    wrong = [check for check in known if check.failed]
    right = [check for check in known if check.passed]
    if len(wrong) >= max(2, len(right)):
        typical = wrong[len(wrong) // 2]
        return replace(typical, advice=f"{typical.advice} (in {len(wrong)} of {len(own)} parts)".strip())
    if right:
        return right[len(right) // 2]
    (lone,) = wrong
    why = f"possible in 1 of {len(own)} parts only, where it fails: too little to tell"
    return Check.unknown(lone.name, lone.subject, lone.unit, why)

"""What visits are measured over: gait cycles, repetitions, or whole recordings."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from rtof_kin.clinical.repetitions import KINDS
from rtof_kin.clinical.visit_measures import Movement
from rtof_kin.clinical.visits import Trial, Visit
from rtof_kin.core.checks import indices_of
from rtof_kin.core.errors import InvalidInputError

LEAST_REPEATS: Final = 2
"""Fewest repetitions in each trial by which trials are measured by default."""


def movement(visits: Sequence[Visit], by: Movement | None, kind: str) -> tuple[Movement, str, str, dict[str, str]]:
    """Return what is measured over, the kind of the repetitions, why, and trials left out -> why.

    Args:
        by: what was asked for; None to choose. kind: of the repetitions; '' to choose.

    Raises:
        InvalidInputError: a visit does not have what was asked for. UnknownNameError: no such kind.
    """
    every = [one for visit in visits for one in visit.trials]
    walking = [[one for one in visit.trials if not _not_gait(one)] for visit in visits]
    if by == "cycle" or (by is None and all(walking)):
        if absent := [v.name for v, own in zip(visits, walking, strict=True) if not own]:
            raise InvalidInputError(f"follow: no gait in {', '.join(absent)}; measure by repetition or range (--by)")
        out = {
            f"{visit.name}, {one.name}": f"left out, not gait: {_not_gait(one)}"
            for visit in visits
            for one in visit.trials
            if _not_gait(one)
        }
        return "cycle", "", "" if by else "all visits are walking", out
    if kind:
        indices_of("kind of repetitions", [kind], KINDS)
    least = {k: min(len(one.repetitions.get(k, ())) for one in every) for k in ([kind] if kind else KINDS)}
    best = max(least, key=lambda k: least[k])
    if by == "repetition" and not least[best]:
        raise InvalidInputError(f"follow: not all trials have a {best}; measure by another (--by)")
    if by == "repetition" or (by is None and least[best] >= LEAST_REPEATS):
        why = "" if by else f"all trials have {LEAST_REPEATS} repetitions or more"
        return "repetition", best, why, {}
    why = "" if by else "neither gait nor repetitions are in all trials"
    return "range", "", why, _other_movements(visits, walking)


def _not_gait(trial: Trial) -> str:
    """Sentence on why a trial is not measured by its gait; '' if it is."""
    gait = trial.analysis.gait
    return gait.why_not or gait.verdict.too_few


def _other_movements(visits: Sequence[Visit], walking: Sequence[Sequence[Trial]]) -> dict[str, str]:
    """Visits that are not walking where others are; nothing of them is left out."""
    if not any(walking):
        return {}
    return {
        visit.name: f"another movement: not gait, as others are ({_not_gait(visit.trials[0])})"
        for visit, own in zip(visits, walking, strict=True)
        if not own
    }

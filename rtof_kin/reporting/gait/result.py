"""Scores of one motion with everything that a reader of them needs."""

from __future__ import annotations

from dataclasses import dataclass

from rtof_kin.clinical.angle_table import SIDES
from rtof_kin.clinical.gait_deviation_index import DeviationIndex, deviation_index, gait_features
from rtof_kin.clinical.gait_scores import GaitScores, gait_scores, people_scores
from rtof_kin.clinical.gait_variables import GaitCycles
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.gait_reference import GaitReference


@dataclass(frozen=True)
class ScoredGait:
    """Scores of a motion against a reference."""

    name: str
    """Of the motion, for all output."""
    cycles: GaitCycles
    reference: GaitReference
    scores: GaitScores | None
    """None if the motion has no strides that count."""
    index: dict[str, DeviationIndex]
    """Gait Deviation Index by side; empty if it is not computed."""
    why_no_index: str
    """One sentence; '' if there is an index."""
    people: tuple[Array, Array] | None
    """Scores of the reference's own people, see `people_scores`."""

    @property
    def missing(self) -> dict[str, str]:
        """Variables without which there is no profile score of a side, and what they need."""
        own = self.scores.missing if self.scores is not None else {}
        return {f"{side} {name}": needs for side, names in own.items() for name, needs in names.items()}


def score_gait(name: str, cycles: GaitCycles, reference: GaitReference) -> ScoredGait:
    """Return the scores of a motion."""
    people = people_scores(reference)
    if cycles.why_not:
        return ScoredGait(name, cycles, reference, None, {}, cycles.why_not, people)
    scores = gait_scores(cycles, reference)
    try:
        features = gait_features(reference)
    except InvalidInputError as error:
        return ScoredGait(name, cycles, reference, scores, {}, f"{error}.", people)
    index = {side: deviation_index(scores.curves[side], features) for side in SIDES}
    known = {side: found for side, found in index.items() if found.value == found.value}
    why = "" if known else "It needs all nine variables of a side."
    return ScoredGait(name, cycles, reference, scores, known, why, people)

"""Everything that is read from a motion for the clinic, in one result."""

from __future__ import annotations

from dataclasses import dataclass

from rtof_kin.body.skeleton import MotionSequence
from rtof_kin.clinical.angle_table import AngleTable, angle_table
from rtof_kin.clinical.angles import ClinicalAngles, clinical_angles
from rtof_kin.clinical.gait import CycleCurves, GaitAnalysis, analyse_gait, cycle_curves
from rtof_kin.clinical.gait_events import gait_events
from rtof_kin.clinical.range_of_motion import RangeOfMotion, ranges_of_motion
from rtof_kin.clinical.repetitions import KINDS, Kind, RepetitionAnalysis, find_repetitions
from rtof_kin.clinical.torques import JointTorques, joint_torques, single_support
from rtof_kin.core.errors import ShapeError, UnknownNameError


@dataclass(frozen=True)
class MotionAnalysis:
    """Angles of a motion and what is read from them."""

    table: AngleTable
    """Names, axes, signs and ranges of the angles."""
    angles: ClinicalAngles
    ranges: tuple[RangeOfMotion, ...]
    """In the order of the angles."""
    gait: GaitAnalysis
    """Without strides where nobody walks."""
    curves: tuple[CycleCurves, ...]
    """Angles over the gait cycle."""
    repetitions: RepetitionAnalysis | None
    """None where none were asked for."""
    torques: JointTorques | None
    """None without a weight."""

    @property
    def notes(self) -> dict[str, tuple[str, ...]]:
        """Part of the analysis -> what it could not tell, and why."""
        without = ("not computed: no weight is given, and torques are proportional to it",)
        out = {"angles": self.angles.notes, "gait": self.gait.notes}
        if self.repetitions is not None:
            out["repetitions"] = self.repetitions.notes
        return out | {"torques": without if self.torques is None else self.torques.notes}


def analyse_motion(
    motion: MotionSequence,
    *,
    weight_kg: float | None = None,
    height: float | None = None,
    sex: str | None = None,
    repetitions: Kind | None = None,
) -> MotionAnalysis:
    """Angles, ranges, gait, and where asked repetitions and torques.

    Args:
        motion: as reconstructed. weight_kg: body mass, kg; no torques without. height: m, to check the
            skeleton's size. sex: 'male', 'female' or None for the mean. repetitions: what to count.

    Raises:
        ShapeError: a height or a sex without a weight; a weight or a height that is no person's.
        UnknownNameError: a kind of repetition that does not exist.
    """
    if weight_kg is None and (height is not None or sex is not None):
        raise ShapeError("height and sex are for joint torques, which need a weight: give it in kg")
    if repetitions is not None and repetitions not in KINDS:
        raise UnknownNameError("kind of repetition", [repetitions], list(KINDS))
    skeleton, poses = motion.skeleton, motion.poses
    angles = clinical_angles(motion)
    gait = analyse_gait(gait_events(poses, skeleton), angles)
    torques = None
    if weight_kg is not None:
        support = single_support(gait) if gait.strides else None
        torques = joint_torques(motion, weight_kg, height, sex, support)
    return MotionAnalysis(
        table=angle_table(skeleton.table),
        angles=angles,
        ranges=ranges_of_motion(angles),
        gait=gait,
        curves=cycle_curves(angles, gait),
        repetitions=repetitions and find_repetitions(poses, skeleton, angles, repetitions),
        torques=torques,
    )

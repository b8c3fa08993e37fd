"""The complete clinical analysis of a motion in one result."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rtof_kin.body.motion_file import MotionReader, motion_path
from rtof_kin.body.motion_source import MotionSource
from rtof_kin.body.skeleton import Motion
from rtof_kin.clinical.angle_table import AngleTable, angle_table
from rtof_kin.clinical.angles import ClinicalAngles, angles_and_paths, relative_to_standing
from rtof_kin.clinical.gait import CycleCurves, GaitAnalysis, analyse_gait, cycle_curves
from rtof_kin.clinical.gait_events import gait_events
from rtof_kin.clinical.ground_reaction import GroundReaction, foot_contacts, ground_reaction
from rtof_kin.clinical.paths import BodyPaths
from rtof_kin.clinical.range_of_motion import RangeOfMotion, ranges_of_motion
from rtof_kin.clinical.repetitions import KINDS, RepetitionAnalysis, find_repetitions
from rtof_kin.clinical.torques import NO_WEIGHT, JointTorques, joint_torques
from rtof_kin.clinical.travel import Travel, travel
from rtof_kin.core.choices import Repeated
from rtof_kin.core.environment import return_free_memory
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.core.packages import optional


@dataclass(frozen=True)
class MotionAnalysis:
    """Clinical angles of a motion, and the analyses made from them."""

    table: AngleTable
    angles: ClinicalAngles
    ranges: tuple[RangeOfMotion, ...]
    gait: GaitAnalysis
    """Has no strides if none were detected; `GaitAnalysis.is_gait` says whether they are those of walking."""
    travel: Travel  #: Way and turning of the pelvis
    curves: tuple[CycleCurves, ...]
    repetitions: RepetitionAnalysis | None  #: None if not requested
    torques: JointTorques | None  #: None without a body mass
    ground_reaction: GroundReaction | None  #: None without a body mass
    paths: BodyPaths  #: Of pelvis and feet, and what was observed of the motion

    @property
    def notes(self) -> dict[str, tuple[str, ...]]:
        """Part of the analysis -> what could not be determined, and why."""
        out = {"angles": self.angles.notes, "gait": self.gait.notes, "travel": self.travel.notes}
        if self.repetitions is not None:
            out["repetitions"] = self.repetitions.notes
        if self.ground_reaction is not None:
            out["ground reaction"] = self.ground_reaction.notes
        return out | {"torques": (NO_WEIGHT,) if self.torques is None else self.torques.notes}

    def to_frame(self) -> Any:
        """Return a tidy ``pandas.DataFrame`` (extra ``connect``), a row for each time and angle: time, s; side (right,
        left or ''), joint, angle; degrees and their sigma, NaN where unknown; reliable.
        """
        pandas, found = optional("pandas", "connect", "to_frame"), self.angles
        names = [
            (one.side, one.name.removeprefix(f"{one.side}_"), row.name.removeprefix(f"{one.name}_"))
            for one in self.table.joints
            for row in one.angles
        ]
        sigma = np.full(found.values.shape, np.nan) if found.sigma is None else found.sigma
        words = (pandas.Categorical(np.repeat(column, len(found))) for column in zip(*names, strict=True))
        numbers: dict[str, Any] = {"degrees": np.degrees(found.values), "sigma": np.degrees(sigma)}
        numbers["reliable"] = found.is_trusted(slice(None))
        columns = {"time": np.tile(found.times, len(names))} | dict(zip(("side", "joint", "angle"), words, strict=True))
        return pandas.DataFrame(columns | {name: values.T.ravel() for name, values in numbers.items()})


def analyse(
    motion: str | Path | Motion | MotionSource,
    *,
    weight_kg: float | None = None,
    height: float | None = None,
    sex: str | None = None,
    repetitions: Repeated | None = None,
    from_standing: bool = False,
) -> MotionAnalysis:
    """Compute angles, ranges of motion and gait; repetitions and torques on request.

    >>> from rtof_kin import analyse
    >>> found = analyse("out/motion")
    >>> found.ranges[0].name, found.gait.is_gait
    ('pelvis_rotation', False)

    Args:
        motion: output folder of a reconstruction, its motion file, or a motion.
        weight_kg: body mass, kg; no torques without it. height: m, to check the size of the skeleton.
        sex: 'male', 'female' or None for the mean.
        repetitions: which are counted; default: those that were marked by hand.
        from_standing: whether angles are relative to the person's quiet standing (`relative_to_standing`).

    Raises:
        InvalidInputError: height or sex without body mass, implausible values, or no quiet standing.
        UnknownNameError: an unknown kind of repetition.
    """
    if weight_kg is None and (height is not None or sex is not None):
        raise InvalidInputError("height and sex are used for joint torques, which need a weight in kg")
    if isinstance(motion, str | Path):
        with MotionReader(motion_path(motion)) as reader:
            body: dict[str, Any] = {"weight_kg": weight_kg, "height": height, "sex": sex}
            return analyse(reader, **body, repetitions=repetitions, from_standing=from_standing)
    source = MotionSource.of(motion)
    (angles,), paths = angles_and_paths(source, angle_table(source.skeleton.table), standing=from_standing)
    if from_standing:
        angles = relative_to_standing(angles, paths)
    if repetitions is None:
        repetitions = next((kind for kind in KINDS for one in source.corrections if one.what == kind), None)
    counted = find_repetitions(paths, angles, repetitions) if repetitions is not None else None
    gait = analyse_gait(gait_events(paths), angles)
    torques, reaction = None, None
    if weight_kg is not None:
        contacts = foot_contacts(paths, gait)
        torques = joint_torques(source, weight_kg, height, sex, contacts.support if gait.strides else None)
        reaction = ground_reaction(torques, contacts, paths)
        return_free_memory()
    heading = angles.names.index("pelvis_rotation")
    heading_sigma = None if angles.sigma is None else angles.sigma[:, heading].astype(float)
    found = MotionAnalysis(
        paths.table,
        angles,
        ranges_of_motion(angles),
        gait,
        travel(paths, gait.verdict, heading_sigma),
        cycle_curves(angles, gait),
        counted,
        torques,
        reaction,
        paths,
    )
    return_free_memory()  # that an hour needed on the way
    return found

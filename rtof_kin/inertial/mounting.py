"""What is wrong with a sensor setup: sensors swapped, turned, on another segment, a pose faced elsewhere.

A calibration and some movement are compared with each way in which people get it wrong
(`rtof_kin.inertial.setup_diagnosis`), by the evidence of `rtof_kin.inertial.likelihood`. A fault is named when it
explains the movement much better than the calibration as declared; nothing is repaired unless
`Fault.corrected` is asked to.

Not everything can be told. A world turned about the vertical looks like another room where no camera saw
it. Of lone sensors, with none on the next segment, left and right look like each other's mirror images.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.imu_calibration import ImuCalibration
from rtof_kin.data.poses import PoseSequence
from rtof_kin.inertial.likelihood import Evidence
from rtof_kin.inertial.poses import pose_rotations, turned_to
from rtof_kin.inertial.segment_motion import SegmentMotion, even_times, seen_bones, segment_motions
from rtof_kin.inertial.setup_diagnosis import Fault, FaultKind, Setup

Array = NDArray[np.float64]
LEAST_RATIO = 10.0
"""Nats by which a fault must explain the movement better than the calibration as declared."""
LONE_FACTOR = 2.5
"""So many times as much is asked where no sensor that is concerned has one on a neighbouring segment, and
what lies between has to be guessed. (Both from motion of training subjects with good setups.)"""
LONGEST = 20.0
"""Longer movements weigh no more than so many seconds: somebody's habits are no fault, however long."""
SAME_RATIO = 3.0
"""Nats within which another fault is named beside the likeliest one."""
MOST_ALTERNATIVES = 3


def diagnose_setup(
    bone_imus: BoneImuSequence,
    skeleton: SkeletonModel,
    *,
    pose: str | ArrayLike = "T",
    visual: PoseSequence | None = None,
    calibration: ImuCalibration | None = None,
    kinds: Collection[FaultKind] = tuple(FaultKind),
    least_ratio: float = LEAST_RATIO,
    most: int = 3,
) -> tuple[Fault, ...]:
    """What is likely wrong with calibrated sensors, the likeliest first; empty where all is well.

    Args:
        bone_imus: ``calibration.apply(imus)``, at least some seconds of movement, best of all joints.
        skeleton: who carries them.
        pose: in which they were calibrated, as for `calibrate_by_pose`: a sensor that sat on another
            segment was aligned with what that one was thought to do. The T-pose where they were
            calibrated otherwise.
        visual: the same movement as a camera saw it (a lifter's poses will do): directions of the bones.
        calibration: what the samples were read with, to look for samples under each other's names too.
        kinds: of what is looked for.
        least_ratio: nats from which on a fault is named; `LONE_FACTOR` times as many for lone sensors.
        most: so many faults at most, each looked for after the ones before it are repaired.
    """
    times = even_times(bone_imus)
    R_pose = pose_rotations(pose, skeleton)
    motions = segment_motions(bone_imus)
    seen = None if visual is None else seen_bones(visual, skeleton, times)
    scores = _Scores(Evidence(skeleton, seen=seen), min(1.0, LONGEST / (times[-1] - times[0])))
    found: list[Fault] = []
    while len(found) < most:
        levers = {motion.joint: motion.p_bone_sensor for motion in motions}
        setup = Setup(skeleton, levers, turned_to(R_pose, 0.0), calibration)
        faults = [f for f in setup.possible_faults(bool(scores.evidence.seen)) if f.kind in kinds]
        fault = _likeliest(scores, motions, setup, faults, least_ratio)
        if fault is None:
            break
        found.append(fault)
        motions = fault.read(motions)
        calibration = None if calibration is None else fault.corrected(calibration)
    return tuple(found)


def _likeliest(
    scores: _Scores,
    motions: Sequence[SegmentMotion],
    setup: Setup,
    faults: Sequence[Fault],
    least_ratio: float,
) -> Fault | None:
    """The fault that explains the motions best, and what does nearly as well; None where none does."""
    base = scores.total(motions)
    ratios = np.array([scores.total(fault.read(motions)) - base for fault in faults])
    asked = [least_ratio * (LONE_FACTOR if setup.is_lone(fault) else 1.0) for fault in faults]
    enough = np.flatnonzero(ratios >= asked)
    if not len(enough):
        return None
    best = int(enough[np.argmax(ratios[enough])])
    close = [i for i in np.argsort(-ratios) if ratios[i] > ratios[best] - SAME_RATIO and i != best]
    return replace(
        faults[best],
        log_likelihood_ratio=float(ratios[best]),
        alternatives=tuple(faults[i].what for i in close[:MOST_ALTERNATIVES]),
    )


class _Scores:
    """Totals of motions; what two motions say of each other is computed once."""

    def __init__(self, evidence: Evidence, weight: float) -> None:
        self.evidence, self.weight = evidence, weight
        self._known: dict[tuple[SegmentMotion, ...], float] = {}

    def total(self, motions: Sequence[SegmentMotion]) -> float:
        """Nats."""
        by_joint = {motion.joint: motion for motion in motions}
        out = sum(self._of(motion) for motion in motions)
        out += sum(self._of(by_joint[a], by_joint[b]) for a, b in self.evidence.tree(sorted(by_joint)))
        return out * self.weight

    def _of(self, *motions: SegmentMotion) -> float:
        if motions not in self._known:
            of = self.evidence.single if len(motions) == 1 else self.evidence.pair
            self._known[motions] = of(*motions)
        return self._known[motions]

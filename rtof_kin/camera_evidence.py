"""Checks of a recording's camera, body and keypoints against the reconstructed motion."""

from __future__ import annotations

from rtof_kin.plausibility import Check
from rtof_kin.recording import Recording
from rtof_kin.skeleton import SkeletonModel
from rtof_kin.stages import Begun
from rtof_kin.types import PoseSequence


def check_camera_evidence(
    recording: Recording, begun: Begun, poses: PoseSequence, skeleton: SkeletonModel
) -> tuple[Check, ...]:
    """Checks of what the recording declares about camera, picture and body.

    Args:
        recording: as declared, before calibration and outlier rejection.
        begun: the prepared streams and the poses of each stage before the solver.
        poses: the final poses. skeleton: the subject's.

    Returns:
        Every check that the recording allows; failed ones name their likely `cause`.
    """
    return ()

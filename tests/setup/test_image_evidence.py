"""Sensors agree best with their own segments, whatever their mounting and heading."""

from __future__ import annotations

import numpy as np
from assignment_support import places, turned, walk, walking_log, walking_poses

from rtof_kin.calibration.motion_score import image_scores
from rtof_kin.calibration.sensor_motion import sensor_motions

SEGMENTS = tuple(places().values())


def test_a_limb_agrees_best_with_its_own_segment() -> None:
    scores = image_scores(sensor_motions(walking_log()), walking_poses(), walk().skeleton, SEGMENTS)
    limbs = [s for s, joint in enumerate(SEGMENTS) if "Left" in joint or "Right" in joint]
    assert [int(scores[s].argmax()) for s in limbs] == limbs


def test_scores_are_the_same_for_any_mounting_and_heading() -> None:
    scores = [
        image_scores(sensor_motions(log), walking_poses(), walk().skeleton, SEGMENTS)
        for log in (walking_log(), turned(walking_log(), 4))
    ]
    np.testing.assert_allclose(scores[0], scores[1], atol=3.0)
    assert np.ptp(scores[0]) > 50

"""Features of motion do not depend on mounting and heading, and find common joints."""

from __future__ import annotations

import numpy as np
from assignment_support import places, turned, walking_log

from rtof_kin.calibration.motion_score import MotionScore, pair_features, single_features
from rtof_kin.calibration.sensor_motion import sensor_motions

GAIN = 6
"""Index of how much a common joint explains, among the features of pairs."""


def test_features_are_the_same_for_any_mounting_and_heading() -> None:
    logs = walking_log(), turned(walking_log(), 6)
    single, pair = ([features(sensor_motions(log)) for log in logs] for features in (single_features, pair_features))
    np.testing.assert_allclose(single[0], single[1], atol=1e-6)
    off = np.abs(pair[0] - pair[1])[~np.eye(13, dtype=bool)]
    assert np.quantile(off, 0.95) < 0.2  # headings are tried on a grid


def test_neighbouring_segments_have_the_most_of_a_common_joint() -> None:
    joints = list(places().values())
    gain = pair_features(sensor_motions(walking_log()))[..., GAIN]
    np.fill_diagonal(gain, 0)
    for side in ("Left", "Right"):
        leg, arm = joints.index(f"{side}Leg"), joints.index(f"{side}ForeArm")
        assert joints[int(gain[leg].argmin())] in (f"{side}UpLeg", f"{side}Foot")
        assert joints[int(gain[arm].argmin())] == f"{side}Arm"


def test_scores_of_fewer_segments_are_those_of_all() -> None:
    motions, score = sensor_motions(walking_log(("Pelvis", "L_Foot", "R_Foot"))), MotionScore.load()
    single, pair = score.tables(motions, score.segments)
    keep = [2, 0]
    some = score.tables(motions, [score.segments[k] for k in keep])
    np.testing.assert_array_equal(some[0], single[:, keep])
    np.testing.assert_array_equal(some[1], pair[:, :, keep][..., keep])
    np.testing.assert_allclose(pair, pair.transpose(1, 0, 3, 2), atol=1e-12)

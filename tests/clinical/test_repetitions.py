"""Repetitions of planted squats and rises from a seat."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import planted
import pytest
from clinical_support import limb, posture, walk
from numpy.typing import NDArray

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.clinical.angles import clinical_angles
from rtof_kin.clinical.paths import body_paths
from rtof_kin.clinical.repetitions import RepetitionAnalysis, find_repetitions
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import UnknownNameError
from rtof_kin.data.poses import PoseSequence, Provenance

Array = NDArray[np.float64]
BODY = SkeletonModel.default()
LEG = 0.792
"""Thigh and shank of the shipped skeleton, m."""


def knees(*phases: tuple[float, float]) -> PoseSequence:
    """Knees that bend to angles in degrees, each within so many seconds, above fixed ankles."""
    bend = [np.zeros(1)]
    for angle, seconds in phases:
        share = (1 - np.cos(np.linspace(0, np.pi, round(60 * seconds) + 1)[1:])) / 2
        bend.append(bend[-1][-1] + share * (angle - bend[-1][-1]))
    half = np.radians(np.concatenate(bend)) / 2
    turns: dict[str, Array] = {}
    for side in ("right", "left"):
        turns |= limb(side, ("thigh",), so3.about_axis("y", -half))
        turns |= limb(side, ("shank",), so3.about_axis("y", half))
    poses = posture(BODY, len(half), **turns)
    rise = -poses.p_world_joint[:, BODY.index("RightFoot")[0], 2] + 0.09
    return poses.with_poses(slice(None), poses.p_world_joint + rise[:, None, None] * [0, 0, 1])


_half = np.radians(55) * (1 - np.cos(np.linspace(0, np.pi, 1001))) / 2
_way = (1 - np.cos(_half)) / (1 - np.cos(_half[-1]))
MOVING = float(np.mean((_way > 0.05) & (_way < 0.95)))
"""Share of the time of a descent in which the pelvis is between 5 and 95 % of it."""
AT_THE_BOTTOM = float(np.mean(_way >= 0.95))


def found(poses: PoseSequence, kind: Any = "squat", skeleton: SkeletonModel = BODY) -> RepetitionAnalysis:
    return find_repetitions(body_paths(poses, skeleton), clinical_angles(poses, skeleton), kind)


SQUAT = ((110.0, 1.5), (110.0, 0.5), (0.0, 1.0), (0.0, 1.0))


def test_squats_are_counted_with_their_depth_and_tempo() -> None:
    analysis = found(knees((0, 1), *SQUAT, *SQUAT, *SQUAT))
    assert len(analysis.repetitions) == 3
    assert analysis.notes == ()
    for squat in analysis.repetitions:
        assert squat.depth == pytest.approx(LEG * (1 - np.cos(np.radians(55))), abs=0.01)
        assert squat.depth_share == pytest.approx(1 - np.cos(np.radians(55)), abs=0.01)
        assert np.degrees(squat.knee_flexion["right"]) == pytest.approx(110, abs=1)
        assert squat.descent_time == pytest.approx(1.5 * MOVING, abs=0.06)
        assert squat.ascent_time == pytest.approx(1.0 * MOVING, abs=0.06)
        assert squat.bottom_time == pytest.approx(0.5 + 2.5 * AT_THE_BOTTOM, abs=0.06)
    starts = [squat.descent[0] for squat in analysis.repetitions if squat.descent]
    assert np.diff(starts) == pytest.approx([4.0, 4.0], abs=0.05)
    assert analysis.total_time == pytest.approx(8.5 + 2.5 * (MOVING + AT_THE_BOTTOM), abs=0.06)


def test_rises_count_without_a_recorded_descent() -> None:
    sit = ((95.0, 1.2), (95.0, 1.0), (0.0, 1.0), (0.0, 0.8))
    poses = knees((95, 1), (95, 1), (0, 1.0), (0, 0.8), *sit, *sit)[60:]
    analysis = found(poses, "sit_to_stand")
    assert len(analysis.repetitions) == 3
    assert analysis.repetitions[0].descent is None
    assert np.isnan(analysis.repetitions[0].descent_time)
    assert analysis.repetitions[1].descent_time == pytest.approx(1.2 * MOVING, abs=0.06)
    assert analysis.total_time == pytest.approx(9.0, abs=0.4)
    squats = found(poses, "squat")
    assert len(squats.repetitions) == 2
    assert any("1 movement(s) cut by a gap or an end" in note for note in squats.notes)


def test_walking_and_standing_are_no_squats() -> None:
    motion = walk()
    for poses, skeleton in ((motion.poses, motion.skeleton), (planted.standing(BODY, 120).poses, BODY)):
        analysis = found(poses, "squat", skeleton)
        assert analysis.repetitions == ()
        assert "15 %" in analysis.notes[0]
        assert np.isnan(analysis.total_time)


def test_noise_and_sway_add_no_repetitions() -> None:
    poses = knees((0, 1), *SQUAT, *SQUAT)
    noise = planted.smooth_noise(1, (len(poses), 1, 3), 10, 0.01)
    rough = np.random.default_rng(0).normal(0, 0.004, poses.p_world_joint.shape)
    noisy = poses.with_poses(slice(None), poses.p_world_joint + noise + rough)
    assert len(found(noisy).repetitions) == 2


def test_a_repetition_cut_by_a_gap_is_not_counted() -> None:
    poses = knees((0, 1), *SQUAT, *SQUAT)
    p = np.array(poses.p_world_joint)
    p[130:140] = np.nan
    analysis = found(replace(poses, p_world_joint=p, valid=None))
    assert len(analysis.repetitions) == 1
    assert any("cut by a gap" in note for note in analysis.notes)


def test_squats_are_counted_with_one_leg_unobserved() -> None:
    poses = knees((0, 1), *SQUAT)
    provenance = np.full(poses.valid.shape, Provenance.CAMERA, dtype=np.uint8)
    provenance[:, BODY.index("LeftLeg", "LeftFoot")] = Provenance.PRIOR
    observed = ~np.isin(BODY.names, ("LeftLeg", "LeftFoot"))
    analysis = found(replace(poses, provenance=provenance, orientation_observed=observed))
    assert len(analysis.repetitions) == 1
    assert any("one ankle was never observed" in note for note in analysis.notes)
    assert np.isnan(analysis.repetitions[0].knee_flexion["left"])
    assert np.degrees(analysis.repetitions[0].knee_flexion["right"]) == pytest.approx(110, abs=1)


def test_unknown_kinds_of_repetition_are_rejected() -> None:
    with pytest.raises(UnknownNameError, match="Did you mean 'squat'"):
        found(knees((0, 1)), "squats")

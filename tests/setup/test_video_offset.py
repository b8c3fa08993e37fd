"""The clock of a second video, planted; a person who does another thing, and one who repeats himself."""

from __future__ import annotations

from dataclasses import replace

import planted
import pytest

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.calibration.clocks import find_video_offset
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.poses import PoseSequence

BODY = SkeletonModel.default()
MOTION = planted.moving(BODY, 600)


def lifted(seed: int) -> PoseSequence:
    """The motion with the errors of a lifter."""
    p = planted.lifted(MOTION, radians=0.1, seed=seed)
    return replace(MOTION.poses, p_world_joint=p)


def elsewhere(poses: PoseSequence, heading: float, later: float) -> PoseSequence:
    """The poses in a world of another heading, on a clock that is `later`."""
    R = so3.about_axis("z", heading)
    p = poses.p_world_joint @ R.T + [3.0, 1.0, 0.0]
    return replace(poses, times=poses.times + later, p_world_joint=p, R_world_bone=R @ poses.R_world_bone)


@pytest.mark.parametrize("heading", [0.0, 2.0, -1.5])
@pytest.mark.parametrize("later", [0.0, 0.517, -600.0])
def test_the_offset_is_found_whatever_the_heading(heading: float, later: float) -> None:
    second = elsewhere(lifted(9)[120:420], heading, later)
    found = find_video_offset(lifted(5), second)
    assert found.offset == pytest.approx(-later, abs=0.012)
    assert found.doubt == ""


def test_other_rates_are_compared_too() -> None:
    second = elsewhere(lifted(9), 1.0, 2.0)
    slow = replace(
        second,
        times=second.times[::3],
        p_world_joint=second.p_world_joint[::3],
        R_world_bone=second.R_world_bone[::3],
        provenance=second.provenance[::3],
        valid=second.valid[::3],
        orientation_observed=second.orientation_observed[::3],
        direction_observed=second.direction_observed[::3],
        sigma_rad=second.sigma_rad[::3],
    )
    assert find_video_offset(lifted(5), slow).offset == pytest.approx(-2.0, abs=0.012)


def test_another_motion_is_doubted() -> None:
    other = planted.moving(BODY, 600, seed=50).poses
    assert "differently" in find_video_offset(lifted(5), other).doubt


def test_a_motion_that_repeats_itself_is_doubted_unless_the_time_is_known() -> None:
    walk = planted.walking(BODY, 12.0, stride_s=1.2)[0].poses
    found = find_video_offset(walk, walk[240:480])
    assert "repeats itself" in found.doubt
    near = find_video_offset(walk, walk[240:480], around=0.0)
    assert abs(near.offset) < 1.3


def test_too_short_videos_are_refused() -> None:
    with pytest.raises(InvalidInputError, match="shorter than 1 s"):
        find_video_offset(MOTION.poses, MOTION.poses[:45])
    with pytest.raises(InvalidInputError, match="in common"):
        find_video_offset(MOTION.poses, elsewhere(MOTION.poses, 0.0, 50.0), around=0.0)

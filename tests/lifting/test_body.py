"""The body of a lifter: sides, limbs, bones, and segments that may carry sensors."""

from __future__ import annotations

import lifting_support as support
import pytest

from lifting.body import Body
from rtof_kin.body.skeleton_table import SkeletonTable


@pytest.mark.parametrize(
    ("table", "arms", "legs"),
    [
        (
            support.TABLE,
            "RightArm RightForeArm RightHand LeftArm LeftForeArm LeftHand",
            "RightUpLeg RightLeg RightFoot LeftUpLeg LeftLeg LeftFoot",
        ),
        (support.TABLE_17, "LShoulder LElbow LWrist RShoulder RElbow RWrist", "RHip RKnee RFoot LHip LKnee LFoot"),
    ],
)
def test_limbs_are_found_in_both_skeletons(table: SkeletonTable, arms: str, legs: str) -> None:
    body = Body(table.names, table.parents, ())
    assert [body.names[j] for limb in body.arms for j in limb] == arms.split()
    assert [body.names[j] for limb in body.legs for j in limb] == legs.split()
    assert body.feet == [leg[2] for leg in body.legs]
    assert body.hips == [leg[0] for leg in body.legs]

"""The body of a lifter: sides, limbs, bones, and segments that may carry sensors."""

from __future__ import annotations

import lifting_support as support
import pytest

from lifting.body import Body, bone_groups
from lifting.windows import sizes
from rtof_kin.body.skeleton_table import SkeletonTable


@pytest.fixture(scope="module")
def body() -> Body:
    return support.tiny_corpus().body()


@pytest.fixture(scope="module")
def body_17() -> Body:
    return support.tiny_corpus(table=support.TABLE_17).body()


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


def test_every_joint_of_the_17_has_its_counterpart(body_17: Body) -> None:
    order = body_17.mirrored
    assert [order[j] for j in order] == list(range(17))
    for name, j in zip(body_17.names, order, strict=True):
        swapped = {"L": "R", "R": "L"}.get(name[0], name[0]) + name[1:]
        assert body_17.names[j] == swapped
    assert len(bone_groups(body_17.names)) == 10  # 4 in the middle, 6 of two sides


def test_sizes_of_input_and_output(body: Body, body_17: Body) -> None:
    assert sizes(body) == (3 * 21 + 2 * 2 + 7 * 13, 2 + 2 + 3 * 13 + 1, 3 * 21 + 2 * 21 + 7 * 21)
    assert sizes(body_17)[0::2] == (3 * 17 + 2 * 2, 3 * 17 + 2 * 17)

"""Limbs with and without sensors."""

from __future__ import annotations

import pytest

from rtof_kin.body.limbs import LIMBS, bare, both_bones_sensed
from rtof_kin.body.skeleton import SkeletonModel

ARM = {"LeftArm", "LeftForeArm", "LeftHand"}


def test_limbs_are_chains_of_the_skeleton() -> None:
    skeleton = SkeletonModel.default()
    for limb in LIMBS:
        joints = [skeleton.names.index(name) for name in limb]
        assert [skeleton.parents[j] for j in joints[1:]] == joints[:-1]


def test_limb_with_any_sensor_is_not_bare() -> None:
    everything = {name for limb in LIMBS for name in limb}
    assert bare(()) == bare(("Hips", "Head")) == everything
    assert all(bare((name,)) == everything - ARM for name in ARM)


@pytest.mark.parametrize(
    ("sensors", "both"),
    [
        ((), False),
        (("LeftArm", "RightForeArm"), False),
        (("LeftForeArm", "LeftHand"), False),
        (("RightUpLeg", "Hips", "RightLeg"), True),
    ],
)
def test_both_bones_must_be_of_one_limb(sensors: tuple[str, ...], both: bool) -> None:
    assert both_bones_sensed(sensors) is both

"""What a calibration is: verdicts, its table, what it changes in a recording, its file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import calibration_support as cs
import numpy as np
import planted
import pytest

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.calibration.result import (
    Quantity,
    SelfCalibration,
    Verdict,
    bone_groups,
    read_self_calibration_toml,
    write_self_calibration_toml,
)
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import FileFormatError, InvalidInputError, OutputExistsError, UnknownNameError
from rtof_kin.recording.recording import Recording

KNOWN = 0.9


def quantity(kind: str, item: str, *value: float, known: float = KNOWN) -> Quantity:
    ones = np.ones(len(value))
    return Quantity(kind, item, np.array(value), 0.1 * ones, 0.5 * ones, known)


def recording() -> Recording:
    return planted.recording(cs.motion(20))


def applied(*quantities: Quantity, middle: float = 0.0) -> Recording:
    return SelfCalibration(quantities, middle=middle).apply(recording())


@pytest.mark.parametrize("known, verdict", [(0.9, Verdict.OBSERVED), (0.5, Verdict.WEAKLY), (0.05, Verdict.PRIOR)])
def test_verdict_depends_on_the_known_share(known: float, verdict: Verdict) -> None:
    assert quantity("delay", "video", 0.01, known=known).verdict is verdict


def test_unobserved_quantities_are_not_applied() -> None:
    before = recording()
    doubted = replace(quantity("delay", "video", -0.112), doubt="the search ends at its border")
    np.testing.assert_array_equal(applied(doubted).keypoints.times, before.keypoints.times)
    np.testing.assert_array_equal(applied(doubted).imus.times, before.imus.times)
    after = applied(
        quantity("delay", "video", 0.01, known=0.0),
        quantity("image bias", "Head", 3.0, 4.0, known=0.0),
        quantity("mounting", "LeftArm", 0.1, 0.0, 0.0, known=0.0),
    )
    np.testing.assert_array_equal(after.keypoints.times, before.keypoints.times)
    np.testing.assert_array_equal(after.keypoints.uv_px, before.keypoints.uv_px)
    np.testing.assert_array_equal(after.calibration.R_sensor_bone, before.calibration.R_sensor_bone)


def test_a_delay_of_usual_detectors_shifts_the_times_of_keypoints_alone() -> None:
    before, after = recording(), applied(quantity("delay", "video", 0.04))
    np.testing.assert_allclose(after.keypoints.times, before.keypoints.times - 0.04)
    np.testing.assert_array_equal(after.imus.times, before.imus.times)


def test_another_delay_shifts_the_sensors_to_where_a_usual_detector_would_be() -> None:
    before, after = (
        recording(),
        applied(replace(quantity("delay", "video", -0.172, 0.01), sigma=np.array([0.01, 0.001])), middle=0.1),
    )
    np.testing.assert_allclose(after.keypoints.times, before.keypoints.times - 0.028)
    sensed = before.imus.times  # what the video shows at t is sensed at t + 0.172 - 0.01 (t - 0.1)
    np.testing.assert_allclose(after.imus.times, 0.1 + (sensed - 0.1 - 0.172) / 0.99 - 0.028, atol=1e-9)


def test_a_delay_is_added_to_that_of_the_clocks_unless_it_is_in_doubt() -> None:
    clocks = SelfCalibration((quantity("delay", "video", -0.2, 0.01),), middle=1.0)
    small = quantity("delay", "video", 0.004)
    both = SelfCalibration((small,), middle=2.0).after(clocks)
    np.testing.assert_allclose(both["delay", "video"].value, [-0.186, 0.01])
    doubted = SelfCalibration((replace(small, doubt="why"),), middle=1.0).after(clocks)
    np.testing.assert_allclose(doubted["delay", "video"].value, [-0.2, 0.01])
    assert not doubted["delay", "video"].doubt


def test_biases_mountings_headings_and_bones_are_corrected() -> None:
    turn, one = np.array([0.1, -0.05, 0.02]), recording()
    after = applied(
        quantity("image bias", "Head", 3.0, -4.0),
        quantity("mounting", "LeftArm", *turn),
        quantity("heading", "RightLeg", 0.2),
        quantity("bones", "thighs", 0.1),
    )
    moved, head = one.video.uv_px - after.video.uv_px, one.video.names.index("Head")
    np.testing.assert_allclose(moved[:, head], np.tile([3.0, -4.0], (20, 1)))
    assert not np.delete(moved, head, axis=1).any()
    R, R_after, joints = one.bone_imus().R_world_bone, after.bone_imus().R_world_bone, one.bone_imus().joints
    arm, leg = joints.index("LeftArm"), joints.index("RightLeg")
    np.testing.assert_allclose(R_after[:, arm], R[:, arm] @ so3.exp(turn), atol=1e-9)
    np.testing.assert_allclose(R_after[:, leg], so3.about_axis("z", 0.2) @ R[:, leg], atol=1e-9)
    ratios = {name: after.skeleton.bone_lengths[name] / one.skeleton.bone_lengths[name] for name in ("LeftLeg", "Neck")}
    assert ratios == {"LeftLeg": pytest.approx(1.1), "Neck": pytest.approx(1.0)}


def test_only_the_body_applies_to_another_recording() -> None:
    found = SelfCalibration(
        (quantity("bones", "thighs", 0.1), quantity("delay", "video", 0.1), quantity("ankle height", "feet", 0.02))
    )
    kept = found.for_another_recording()
    assert [q.kind for q in kept.quantities] == ["bones", "ankle height"]
    assert kept.ankle_height == 0.02
    after = kept.apply(recording())
    np.testing.assert_array_equal(after.keypoints.times, recording().keypoints.times)


def test_later_calibration_takes_precedence() -> None:
    before = SelfCalibration((quantity("bones", "thighs", 0.1), quantity("delay", "video", 0.1)))
    later = SelfCalibration((quantity("delay", "video", 0.2),), middle=3.0)
    both = before.followed_by(later)
    assert [(q.kind, q.value[0]) for q in both.quantities] == [("bones", 0.1), ("delay", 0.2)]
    assert both.middle == 3.0


def test_table_has_display_units() -> None:
    table = SelfCalibration((quantity("delay", "video", 0.05), quantity("mounting", "LeftArm", 0.1, 0.1, 0.1))).table()
    assert table[0] == ("delay", "video", "50 ms", "100", "500", "observed")
    assert table[1] == ("mounting", "LeftArm", "5.73 deg", "5.73", "28.6", "observed")


def test_groups_of_bones_hold_every_joint_but_the_root_once() -> None:
    names = ("trunk", "head", "shoulders", "upper arms", "forearms", "pelvis", "thighs", "shanks")
    joints = [j for _, own in bone_groups(cs.BODY, names) for j in own]
    assert sorted(joints) == list(range(1, len(cs.BODY.names)))
    with pytest.raises(UnknownNameError, match="unknown group of bones 'tail'"):
        bone_groups(cs.BODY, ("tail",))


@pytest.mark.parametrize(
    "wrong, message",
    [
        ({"kind": "colour"}, "unknown kind of quantity 'colour'"),
        ({"value": np.array([np.nan])}, "value must be finite"),
        ({"sigma": np.array([0.0])}, "must be positive"),
        ({"sigma": np.ones(2)}, "as many as values"),
        ({"known": 1.5}, "known is 1.5"),
    ],
)
def test_invalid_quantities_are_refused(wrong: dict[str, Any], message: str) -> None:
    with pytest.raises((InvalidInputError, UnknownNameError), match=message):
        replace(quantity("delay", "video", 0.1), **wrong)


WHOLE = SelfCalibration(
    (
        quantity("image bias", "Head", 1 / 3, 2.0),
        quantity("image bias", "Neck", 1.0, 0.1),
        quantity("mounting", "LeftArm", 0.1, 0.2, 0.3, known=0.4),
    ),
    1.25,
    False,
)


def test_file_round_trip(tmp_path: Path) -> None:
    path = tmp_path / "calibration.toml"
    write_self_calibration_toml(path, WHOLE)
    back = read_self_calibration_toml(path)
    assert (back.middle, back.converged) == (1.25, False)
    assert len(back.quantities) == 3
    for ours, theirs in zip(back.quantities, WHOLE.quantities, strict=True):
        assert (ours.kind, ours.item, ours.known) == (theirs.kind, theirs.item, theirs.known)
        assert ours.doubt == theirs.doubt
        for name in ("value", "sigma", "sigma_prior"):
            np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name))


def test_file_is_not_overwritten_by_default(tmp_path: Path) -> None:
    path = tmp_path / "calibration.toml"
    write_self_calibration_toml(path, WHOLE)
    with pytest.raises(OutputExistsError, match="is there already"):
        write_self_calibration_toml(path, WHOLE)
    write_self_calibration_toml(path, WHOLE, overwrite=True)


def test_other_toml_files_are_refused(tmp_path: Path) -> None:
    recording().save(tmp_path / "take")
    with pytest.raises(FileFormatError, match="no calibration that `rtof-kin reconstruct --calibrate-only` wrote"):
        read_self_calibration_toml(tmp_path / "take" / "recording.toml")


@pytest.mark.parametrize(
    "old, new, message",
    [
        ("schema_version = 1", "schema_version = 9", "9 is not 1"),
        ("known = 0.4", "known = 4.0", "no share of 1"),
        ("known = 0.4", "knwon = 0.4", "'knwon'. Did you mean 'known'"),
        ("[quantities.mounting.LeftArm]", "[quantities.mouning.LeftArm]", "unknown kind"),
        ("known = 0.4", 'known = "much"', "not a finite number"),
        ("0.3,\n]", "0.3,\n  0.4,\n]", "as many as values, 3 at most"),
        ("middle_s = 1.25", "middle_s = 1.25\nwhat = 1", "unknown field"),
    ],
)
def test_invalid_files_are_refused(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = tmp_path / "calibration.toml"
    write_self_calibration_toml(path, WHOLE)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    with pytest.raises((FileFormatError, UnknownNameError), match=message):
        read_self_calibration_toml(path)


def test_further_views_keep_the_clock_of_the_first_camera() -> None:
    one = recording()
    after = SelfCalibration((quantity("delay", "video", 0.05),)).apply(replace(one, views=(one.video,)))
    np.testing.assert_allclose(after.views[0].times, after.video.times, atol=1e-12)


def test_files_of_earlier_versions_with_the_errors_of_the_detector_are_read(tmp_path: Path) -> None:
    path = tmp_path / "calibration.toml"
    write_self_calibration_toml(path, WHOLE)
    path.write_text(path.read_text() + "\n[detector.Head]\nsigma_px = 5.1\nmemory_s = 0.4\n")
    assert len(read_self_calibration_toml(path).quantities) == 3


def test_a_mounting_is_as_uncertain_as_about_axes_across_its_bone() -> None:
    body = SkeletonModel.default()
    found = Quantity("mounting", "LeftLeg", np.zeros(3), np.radians([3.0, 4.0, 20.0]), np.radians([20.0] * 3), 0.95)
    unseen = replace(found, item="RightLeg", known=0.1)
    variances = SelfCalibration((found, unseen)).mounting_variances(body)
    assert variances == {"LeftLeg": pytest.approx(np.radians(np.sqrt(12.5)) ** 2)}

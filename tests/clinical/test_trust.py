"""Which values of an angle ranges, peaks and gait go by."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from clinical_support import LEG, posture
from numpy.typing import NDArray

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.clinical.angle_confidence import trusted_bands, trusted_turns, untrusted_note
from rtof_kin.clinical.angle_table import angle_table
from rtof_kin.clinical.angles import ClinicalAngles, clinical_angles
from rtof_kin.clinical.range_of_motion import ranges_of_motion
from rtof_kin.core import rotations as so3

Array = NDArray[np.float64]
BODY = SkeletonModel.default()
TIMES = np.arange(60) / 60
HIP = next(joint for joint in angle_table(BODY.table).joints if joint.name == "left_hip")


def angles_of_a_bending_hip(sigma_deg: Array) -> ClinicalAngles:
    """The left thigh lifted by up to 60 degrees within a second."""
    lifted = so3.about_axis("y", -np.radians(60) * np.sin(np.pi * TIMES) ** 2)
    leg = {f"left_{segment}": lifted for segment in LEG}
    poses = replace(posture(BODY, len(TIMES), **leg), times=TIMES)
    found = clinical_angles(poses, BODY)
    sigma = np.tile(np.radians(sigma_deg)[:, None], (1, len(found.rows)))
    trusted = trusted_bands(sigma, found.values.shape)
    return replace(found, sigma=sigma, trusted=trusted)


def test_an_uncertain_sample_makes_no_extreme() -> None:
    sigma = np.where(np.abs(TIMES - 0.5) < 0.1, 20.0, 5.0)
    found = angles_of_a_bending_hip(sigma)
    rows = {row.name: row for row in ranges_of_motion(found)}
    everything = {row.name: row for row in ranges_of_motion(replace(found, trusted=None))}
    hip, whole = rows["left_hip_flexion"], everything["left_hip_flexion"]
    assert np.degrees(whole.range) == pytest.approx(60, abs=1)
    assert np.degrees(hip.range) < 56
    assert abs(hip.time_high - 0.5) >= 0.1 - 1e-9
    assert hip.trusted_share == pytest.approx(1 - 0.2, abs=0.03)
    assert (hip.known_share, whole.trusted_share) == (1, 1)


def test_without_standard_deviations_every_value_is_trusted() -> None:
    assert trusted_bands(None, (4, 2)).all()
    assert trusted_bands(np.full((4, 2), np.nan), (4, 2)).all()


@pytest.mark.parametrize("speed_deg_s, allowed", [(900.0, True), (1700.0, False)])
def test_a_joint_that_turns_faster_than_people_can_is_not_trusted_around_then(
    speed_deg_s: float, allowed: bool
) -> None:
    angle = np.radians(speed_deg_s) * np.clip(TIMES - 0.5, 0.0, 0.1)
    trusted = trusted_turns(HIP, TIMES, so3.about_axis("z", angle))
    assert trusted.all() == allowed
    if not allowed:
        assert trusted[TIMES < 0.35].all()
        assert not trusted[(TIMES > 0.45) & (TIMES < 0.65)].any()


def test_a_gap_is_no_turn() -> None:
    R = so3.about_axis("z", np.where(TIMES > 0.5, 3.0, 0.0))
    R[30:32] = np.nan
    assert trusted_turns(HIP, TIMES, R).all()


def test_the_note_names_the_angle_the_share_and_the_time() -> None:
    found = angles_of_a_bending_hip(np.where(np.abs(TIMES - 0.5) < 0.1, 20.0, 5.0))
    assert found.trusted is not None
    note = untrusted_note(TIMES, found.rows, found.known, found.trusted)
    assert "0.40 to 0.60 s" in note
    assert "% of it" in note
    assert untrusted_note(TIMES, found.rows, found.known, found.known) == ""

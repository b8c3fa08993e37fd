"""What a reconstruction leaves unexplained: planted errors are found where they are, and only there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import planted
import pytest

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.calibration.result import Quantity, SelfCalibration
from rtof_kin.core import rotations as so3
from rtof_kin.core.plausibility import Check
from rtof_kin.data.stream_faults import FaultKind, StreamFault
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.reconstruction.result import Reconstruction
from rtof_kin.reconstruction.settings import ReconstructionSettings
from rtof_kin.report.audit import audit
from rtof_kin.report.audit_results import Finding, Grade, SectionVerdict, section_verdict
from rtof_kin.report.headline import headline
from rtof_kin.report.residuals import acceleration_residuals, orientation_residuals, reprojection_errors
from rtof_kin.solve.solution import SolverStatus

BODY = SkeletonModel.default()
T = 24


@pytest.fixture(scope="module")
def good() -> Reconstruction:
    """A motion that is the truth itself, with exact keypoints and sensors."""
    truth = planted.moving(BODY, T)
    recording = replace(planted.recording(truth), joint_offsets=BODY.joint_offsets)
    settings = ReconstructionSettings(frames=16)
    result = reconstruct(recording, lifter=planted.PlantedLifter(truth), settings=settings, calibrate=False)
    motion = replace(result.motion, poses=replace(
        result.motion.poses, p_world_joint=truth.poses.p_world_joint,
        R_world_bone=truth.poses.R_world_bone,
    ))  # fmt: skip
    return replace(result, motion=motion)


def of(result: Reconstruction, section: str, subject: str, name: str = "") -> Finding:
    """The one finding about something."""
    (found,) = [f for f in audit(result) if (f.section, f.subject) == (section, subject) and name in f.name]
    return found


def test_the_truth_leaves_nothing_unexplained(good: Reconstruction) -> None:
    errors, height = reprojection_errors(good)
    assert np.nanmax(errors) < 1e-6
    assert 200 < height < 900
    swing, twist = orientation_residuals(good)
    assert np.nanmax(swing) < 1e-6
    assert np.nanmax(twist) < 1e-6
    a = acceleration_residuals(good)
    assert np.isnan(a[[0, -1]]).all()
    assert np.nanmax(a) < 0.7  # sampled acceleration against a second difference
    graded = {f.grade for f in audit(good) if f.section in ("streams", "image", "sensors")}
    assert graded == {Grade.PASS}


def test_a_landmark_that_is_off_fails_and_the_others_do_not(good: Reconstruction) -> None:
    keypoints = good.keypoints
    assert keypoints is not None
    uv = keypoints.uv_px.copy()
    uv[:, keypoints.names.index("LeftHand")] += [90.0, 0.0]
    off = replace(good, keypoints=replace(keypoints, uv_px=uv))
    assert of(off, "image", "LeftHand").value == pytest.approx(90.0, abs=1e-6)
    assert of(off, "image", "LeftHand").grade is Grade.FAIL
    assert of(off, "image", "RightHand").grade is Grade.PASS
    assert of(off, "image", "all landmarks").value < 1e-6


@pytest.mark.parametrize(("axis", "name"), [("x", "across the bone"), ("z", "about the bone")])
def test_a_turned_sensor_shows_across_or_about_its_bone(good: Reconstruction, axis: str, name: str) -> None:
    imus = good.bone_imus
    assert imus is not None
    R = imus.R_world_bone.copy()
    s = imus.joints.index("LeftLeg")  # its bone hangs along -z
    R[:, s] = R[:, s] @ so3.about_axis(axis, np.radians(30.0))
    off = replace(good, bone_imus=replace(imus, R_world_bone=R))
    assert of(off, "sensors", "LeftLeg", name).value == pytest.approx(30.0, abs=1.5)
    assert of(off, "sensors", "LeftLeg", name).grade is not Grade.PASS
    other = "about the bone" if axis == "x" else "across the bone"
    assert of(off, "sensors", "LeftLeg", other).value < 3.0
    assert of(off, "sensors", "RightLeg", name).value < 1e-6


def test_a_wrong_acceleration_is_found_at_its_sensor(good: Reconstruction) -> None:
    imus = good.bone_imus
    assert imus is not None
    a = imus.a_world.copy()
    a[:, 0] += [0.0, 0.0, 9.81]
    off = replace(good, bone_imus=replace(imus, a_world=a))
    found = of(off, "sensors", imus.joints[0], "acceleration")
    assert (found.value, found.grade) == (pytest.approx(9.81, abs=0.5), Grade.FAIL)


def test_a_leg_that_was_never_seen_is_named(good: Reconstruction) -> None:
    keypoints = good.keypoints
    assert keypoints is not None
    uv = keypoints.uv_px.copy()
    leg = [keypoints.names.index(name) for name in ("LeftUpLeg", "LeftLeg", "LeftFoot")]
    uv[:, leg] = np.nan
    off = replace(good, keypoints=replace(keypoints, uv_px=uv))
    assert of(off, "streams", "LeftLeg", "unseen").grade is Grade.FAIL
    assert of(off, "image", "LeftLeg").text == (
        "LeftLeg: reprojection error, median: never seen together with a valid position"
    )


def test_faults_warnings_and_calibration_speak_for_themselves(good: Reconstruction) -> None:
    fault = StreamFault(FaultKind.STUCK, "LeftLeg", 0.1, 0.3)
    off = replace(good, faults=(fault,), warnings=("who sits is not known",))
    assert of(off, "streams", "LeftLeg", "fault").text == (
        "LeftLeg: fault, duration 0.2 s at 0.1 s: the sensor repeated one sample; it was left out"
    )
    texts = [f.text for f in audit(off)]
    assert "motion: who sits is not known" in texts
    assert any(text.startswith("recording: nothing was estimated: delay, mounting") for text in texts)


def test_checks_of_what_was_declared_are_findings_and_none_is_no_pass(good: Reconstruction) -> None:
    (nothing,) = [f for f in audit(replace(good, checks=())) if f.section == "inputs"]
    assert nothing.grade is Grade.UNTOLD
    cause = "the focal length is too short"
    wrong = Check("height", "camera", 0.3, 0.1, "m", "measure again", cause=cause)
    unknown = Check.unknown("clock", "sensors", "s", "nobody moves")
    right = Check("size", "body", 0.01, 0.1, "m")
    checked = replace(good, checks=(wrong, unknown, right))
    found = [f for f in audit(checked) if f.section == "inputs"]
    assert [f.grade for f in found] == [Grade.FAIL, Grade.UNTOLD, Grade.PASS]
    assert "nobody moves" in found[1].text
    assert headline(audit(checked)).text.startswith("the focal length is too short: measure again")


def test_a_calibration_that_hardly_observed_anything_does_not_pass(good: Reconstruction) -> None:
    def verdict(*known: float) -> SectionVerdict:
        numbers = np.array([0.01]), np.array([0.05]), np.array([0.05])
        quantities = tuple(
            Quantity("mounting", f"segment {i}", *numbers, share) for i, share in enumerate(known)
        )
        calibrated = replace(good, calibration=SelfCalibration(quantities))
        return section_verdict("calibration", audit(calibrated))

    weak = verdict(0.95, *[0.6] * 29, 0.1)
    assert weak.grade is Grade.WEAK
    counts = "31 quantities: 1 observed, 29 weakly observed, 1 taken from the prior"
    assert weak.reasons == (counts,)
    assert verdict(0.95, 0.95).grade is Grade.PASS


def test_fragments_at_a_looser_tolerance_are_counted_beside_the_pass(good: Reconstruction) -> None:
    assert good.solution is not None
    one = good.solution.fragments[0]
    fragments = (replace(one, status=SolverStatus.ACCEPTABLE), *[one] * 9)
    loose = replace(good, solution=replace(good.solution, fragments=fragments))
    verdict = section_verdict("solver", audit(loose))
    assert verdict.grade is Grade.PASS
    assert "9 of 10 fragments converged, 1 at a looser tolerance" in verdict.reasons[0]


def test_a_motion_that_is_hardly_known_does_not_pass(good: Reconstruction) -> None:
    told = good.motion.confidence
    assert told is not None
    subject, name = "joints relative to the root", "expected"
    size = of(good, "confidence", subject, name).value
    assert np.isfinite(size)
    factor = 150.0 / size  # to 150 mm
    wide = replace(told, relative_covariance=told.relative_covariance * factor**2)
    wider = replace(good, motion=replace(good.motion, confidence=wide))
    found = of(wider, "confidence", subject, name)
    assert found.value == pytest.approx(150)
    assert found.grade is Grade.FAIL
    nothing = replace(good, motion=replace(good.motion, confidence=None))
    assert section_verdict("confidence", audit(nothing)).grade is Grade.UNTOLD


def test_a_height_that_does_not_fit_is_told_with_both_numbers(good: Reconstruction) -> None:
    tall = replace(good, recording=replace(good.recording, height=BODY.height + 0.07))
    found = of(tall, "body", "skeleton")
    assert found.value == pytest.approx(7.0, abs=1e-6)
    assert found.grade is Grade.WARN
    assert f"the skeleton stands {BODY.height:.2f} m tall" in found.text
    assert "no height was given" in of(good, "body", "skeleton").text


@pytest.mark.parametrize(
    ("change", "section", "why"),
    [
        (lambda r: replace(r, keypoints=None), "image", "camera: no keypoints were used"),
        (lambda r: replace(r, bone_imus=None), "sensors", "IMUs: no sensor was used"),
        (
            lambda r: replace(r, solution=None, mode="sf2"), "solver",
            "fragments: mode sf2 optimises nothing",
        ),
    ],
)  # fmt: skip
def test_what_there_is_not_is_not_told(
    good: Reconstruction, change: Callable[[Any], Any], section: str, why: str
) -> None:
    own = [finding for finding in audit(change(good)) if finding.section == section]
    assert [finding.text for finding in own] == [why]
    assert own[0].grade is Grade.UNTOLD

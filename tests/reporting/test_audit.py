"""Audit: planted errors are found where they are, and only there."""

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
from rtof_kin.core.checks import Check
from rtof_kin.data.imu_stream import FaultKind, StreamFault
from rtof_kin.reconstruction import certificate
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.reconstruction.result import Reconstruction
from rtof_kin.reconstruction.settings import ReconstructionSettings
from rtof_kin.reporting.audit import audit
from rtof_kin.reporting.audit_results import AuditResult, Grade, SectionVerdict, headline, section_verdict
from rtof_kin.reporting.statistics import (
    ReconstructionStatistics,
    acceleration_residuals,
    orientation_residuals,
    reprojection_errors,
)
from rtof_kin.solve.solution import SolverStatus

BODY = SkeletonModel.default()
T = 24


@pytest.fixture(scope="module")
def good() -> Reconstruction:
    """The true motion with exact keypoints and sensors."""
    truth = planted.moving(BODY, T)
    recording = replace(planted.recording(truth), joint_offsets=BODY.joint_offsets)
    settings = ReconstructionSettings(frames=16)
    result = reconstruct(recording, lifter=planted.PlantedLifter(truth), settings=settings, calibrate=False)
    motion = replace(
        result.motion,
        poses=replace(
            result.motion.poses, p_world_joint=truth.poses.p_world_joint, R_world_bone=truth.poses.R_world_bone
        ),
    )
    return replace(result, motion=motion)


def of(result: Reconstruction, section: str, subject: str, name: str = "") -> AuditResult:
    """The only result on a subject."""
    (found,) = [f for f in audit(result) if (f.section, f.subject) == (section, subject) and name in f.name]
    return found


def with_keypoints(result: Reconstruction, names: tuple[str, ...], uv_px: Any) -> Reconstruction:
    keypoints = result.keypoints
    assert keypoints is not None
    uv = keypoints.uv_px.copy()
    uv[:, [keypoints.names.index(name) for name in names]] += uv_px
    return replace(result, keypoints=replace(keypoints, uv_px=uv))


def test_the_true_motion_has_no_residuals(good: Reconstruction) -> None:
    assert np.nanmax(reprojection_errors(good)) < 1e-6
    assert 200 < ReconstructionStatistics(good)["body height px"].median_of_all < 900
    for residual in orientation_residuals(good):
        assert np.nanmax(residual) < 1e-6
    a = acceleration_residuals(good)
    assert np.isnan(a[[0, -1]]).all()
    assert np.nanmax(a) < 0.7  # sampled acceleration against a second difference
    graded = {f.grade for f in audit(good) if f.section in ("streams", "image", "sensors")}
    assert graded == {Grade.PASS}


def test_a_displaced_landmark_fails_alone(good: Reconstruction) -> None:
    off = with_keypoints(good, ("LeftHand",), [90.0, 0.0])
    assert of(off, "image", "LeftHand").value == pytest.approx(90.0, abs=1e-6)
    assert of(off, "image", "LeftHand").grade is Grade.FAIL
    assert of(off, "image", "RightHand").grade is Grade.PASS
    assert of(off, "image", "all landmarks").value < 1e-6


def test_an_unobserved_leg_is_named(good: Reconstruction) -> None:
    off = with_keypoints(good, ("LeftUpLeg", "LeftLeg", "LeftFoot"), np.nan)
    assert of(off, "streams", "LeftLeg", "unseen").grade is Grade.FAIL
    assert "never observed" in of(off, "image", "LeftLeg").text


def test_an_ear_that_a_side_view_hides_is_no_failure(good: Reconstruction) -> None:
    assert good.keypoints is not None
    names = tuple("LeftEar" if name == "LeftHand" else name for name in good.keypoints.names)
    side = replace(good, keypoints=replace(good.keypoints, names=names))
    assert of(with_keypoints(side, ("LeftEar",), np.nan), "streams", "LeftEar", "unseen").grade is Grade.WARN
    seen = good.keypoints.uv_px.copy()
    seen[: int(0.8 * len(seen)), names.index("LeftEar")] = np.nan
    most = replace(side, keypoints=replace(good.keypoints, names=names, uv_px=seen))
    assert of(most, "streams", "LeftEar", "unseen").grade is Grade.PASS


@pytest.mark.parametrize(("axis", "name"), [("x", "across the bone"), ("z", "about the bone")])
def test_a_rotated_sensor_has_a_residual_across_or_about_its_bone(good: Reconstruction, axis: str, name: str) -> None:
    imus = good.bone_imus
    assert imus is not None
    R = imus.R_world_bone.copy()
    s = imus.joints.index("LeftLeg")  # its bone is along -z
    R[:, s] = R[:, s] @ so3.about_axis(axis, np.radians(30.0))
    off = replace(good, bone_imus=replace(imus, R_world_bone=R))
    assert of(off, "sensors", "LeftLeg", name).value == pytest.approx(30.0, abs=1.5)
    assert of(off, "sensors", "LeftLeg", name).grade is not Grade.PASS
    other = "about the bone" if axis == "x" else "across the bone"
    assert of(off, "sensors", "LeftLeg", other).value < 3.0
    assert of(off, "sensors", "RightLeg", name).value < 1e-6


def test_a_wrong_acceleration_fails_at_its_sensor(good: Reconstruction) -> None:
    imus = good.bone_imus
    assert imus is not None
    a = imus.a_world.copy()
    a[:, 0] += [0.0, 0.0, -2 * 9.81]  # of the opposite sign
    found = of(replace(good, bone_imus=replace(imus, a_world=a)), "sensors", imus.joints[0], "acceleration")
    assert (found.value, found.grade) == (pytest.approx(2 * 9.81, abs=0.5), Grade.FAIL)


def test_faults_and_warnings_are_results(good: Reconstruction) -> None:
    fault = StreamFault(FaultKind.STUCK, "LeftLeg", 0.1, 0.3)
    off = replace(good, faults=(fault,), warnings=("the posture is unknown",))
    found = of(off, "streams", "LeftLeg", "fault")
    assert found.text.startswith("LeftLeg, 0.1 to 0.3 s: the sensor repeated")
    assert found.note == FaultKind.STUCK.value
    texts = [f.text for f in audit(off)]
    assert "motion: the posture is unknown" in texts
    assert any(text.startswith("recording: nothing was estimated") for text in texts)


def test_checks_of_declared_inputs_are_results(good: Reconstruction) -> None:
    (nothing,) = [f for f in audit(replace(good, checks=())) if f.section == "inputs"]
    assert nothing.grade is Grade.NOT_CHECKED
    cause = "the focal length is too short"
    wrong = Check("height", "camera", 0.3, 0.1, "m", "measure again", cause=cause)
    unknown = Check.unknown("clock", "sensors", "s", "nobody moves")
    right = Check("size", "body", 0.01, 0.1, "m")
    checked = replace(good, checks=(wrong, unknown, right))
    found = [f for f in audit(checked) if f.section == "inputs"]
    assert [f.grade for f in found] == [Grade.FAIL, Grade.NOT_CHECKED, Grade.PASS]
    assert "nobody moves" in found[1].text
    assert headline(audit(checked)).text.startswith("the focal length is too short: measure again")


def test_a_weakly_observed_calibration_does_not_pass(good: Reconstruction) -> None:
    def verdict(*known: float) -> SectionVerdict:
        numbers = np.array([0.01]), np.array([0.05]), np.array([0.05])
        quantities = tuple(Quantity("mounting", f"segment {i}", *numbers, share) for i, share in enumerate(known))
        calibrated = replace(good, calibration=SelfCalibration(quantities))
        return section_verdict("calibration", audit(calibrated))

    weak = verdict(0.95, *[0.6] * 29, 0.1)
    assert weak.grade is Grade.WEAK
    assert weak.reasons[0].startswith("31 quantities: 1 observed, 29 ")
    assert verdict(0.95, 0.95).grade is Grade.PASS


def test_fragments_at_a_looser_tolerance_are_counted(good: Reconstruction) -> None:
    assert good.solution is not None
    one = good.solution.fragments[0]
    fragments = (replace(one, status=SolverStatus.ACCEPTABLE), *[one] * 9)
    loose = replace(good, solution=replace(good.solution, fragments=fragments))
    verdict = section_verdict("solver", audit(loose))
    assert verdict.grade is Grade.PASS
    assert "9 of 10 fragments converged" in verdict.reasons[0]


def test_an_uncertain_motion_does_not_pass(good: Reconstruction) -> None:
    confidence = good.motion.confidence
    assert confidence is not None
    subject, name = "joints relative to the root", "expected"
    factor = 150.0 / of(good, "confidence", subject, name).value  # to 150 mm
    wide = replace(confidence, relative_covariance=confidence.relative_covariance * factor**2)
    found = of(replace(good, motion=replace(good.motion, confidence=wide)), "confidence", subject, name)
    assert found.value == pytest.approx(150)
    assert found.grade is Grade.FAIL
    nothing = replace(good, motion=replace(good.motion, confidence=None))
    assert section_verdict("confidence", audit(nothing)).grade is Grade.NOT_CHECKED


def test_a_wrong_height_and_violated_limits_are_results(good: Reconstruction) -> None:
    tall = replace(good, recording=replace(good.recording, height=BODY.height + 0.07))
    found = of(tall, "body", "skeleton")
    assert (found.value, found.grade) == (pytest.approx(7.0, abs=1e-6), Grade.WARN)
    assert f"{BODY.height:.2f} m tall" in found.text
    assert "no height was given" in of(good, "body", "skeleton").text
    q = np.array(good.motion.q)
    knee = BODY.dof_names.index("LeftLeg_y")
    q[3, 7 + knee] = BODY.limits[knee, 1] + np.radians(35.0)
    bent = replace(good, motion=replace(good.motion, q=q, report=BODY.check(q)))
    found = of(bent, "body", "left knee flexion/extension (LeftLeg_y)")
    assert (found.value, found.grade) == (pytest.approx(35.0), Grade.FAIL)


def with_sensors(found: Reconstruction, count: int) -> Reconstruction:
    """The reconstruction of a recording with fewer sensors."""
    imus = found.recording.imus
    assert imus is not None
    fewer = replace(found.recording, imus=imus.select(imus.names[:count]) if count else None)
    return replace(found, recording=fewer)


@pytest.mark.parametrize(
    ("change", "proof"),
    [
        (lambda r: r, "no sensor was left out"),
        (lambda r: with_sensors(r, 1), "one sensor leaves no other"),
        (lambda r: with_sensors(r, 0), "a camera alone proves no angle"),
        (lambda r: replace(r, mode="rto"), "mode rto is not tested by sensors"),
        (lambda r: replace(r, mode="imu", keypoints=None), "without a camera no error is stated"),
    ],
)
def test_without_a_reference_it_says_what_would_prove_the_angles(
    good: Reconstruction, change: Callable[[Any], Any], proof: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    (short,) = [result for result in audit(replace(good, stage_metrics={})) if result.section == "certificate"]
    assert "too short" in short.note
    monkeypatch.setattr(certificate, "LEAST_SECONDS", 0.1)
    results = audit(replace(change(good), stage_metrics={}))
    (own,) = [result for result in results if result.section == "certificate"]
    assert own.grade is Grade.NOT_CHECKED
    assert own.note.startswith(proof)
    assert not [result for result in audit(good) if result.section == "certificate"]  # it has the truth


@pytest.mark.parametrize(
    ("change", "section"),
    [
        (lambda r: replace(r, keypoints=None), "image"),
        (lambda r: replace(r, bone_imus=None), "sensors"),
        (lambda r: replace(r, solution=None, mode="sf2"), "solver"),
    ],
)
def test_missing_inputs_are_not_checked(good: Reconstruction, change: Callable[[Any], Any], section: str) -> None:
    (own,) = [result for result in audit(change(good)) if result.section == section]
    assert own.grade is Grade.NOT_CHECKED

"""The five lines of a report's summary, against sentences written by hand."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from clinical_support import limb, posture, squatting, stepping, walk, walking
from numpy.typing import NDArray
from report_support import certain_to

from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.clinical.analysis import MotionAnalysis, analyse
from rtof_kin.clinical.angle_table import angle_table
from rtof_kin.clinical.comparison import compare_sides, compared
from rtof_kin.clinical.range_of_motion import ranges_of_motion
from rtof_kin.core import rotations as so3
from rtof_kin.data.confidence import BAND_95
from rtof_kin.data.poses import Provenance
from rtof_kin.recording.labels import Session
from rtof_kin.reporting.angle_names import plain_words
from rtof_kin.reporting.audit_results import AuditResult, Grade, Headline
from rtof_kin.reporting.summary_file import Summary
from rtof_kin.reporting.summary_lines import (
    EVENT_SIGMA,
    Finding,
    anatomical_limits,
    compared_sides,
    findings,
    summary_lines,
)

BODY = SkeletonModel.default()
LABELS = ("Who", "What", "How good", "Careful", "Findings")
FINE = Headline(Grade.PASS, "checked, no problem found in image", ())
TIMES = np.arange(240) / 60
SENSORS = ("RightUpLeg", "LeftUpLeg", "RightLeg")
GOLDEN = Path(__file__).parents[1] / "fixtures" / "summary_lines.json"


def summary(
    mode: str = "rtof",
    camera: bool = True,
    results: Any = None,
    cameras: int | None = None,
    sensors: tuple[str, ...] = SENSORS,
    **subject: Any,
) -> Summary:
    inputs = {
        "subject": subject,
        "camera": {"width_px": 1920} if camera else None,
        "sensors": [{"name": name, "segment": name} for name in sensors],
    } | ({} if cameras is None else {"cameras": cameras})
    return Summary("walk", mode, "", Session(), inputs, results)


def knees(right_deg: float, left_deg: float) -> Motion:
    """Both knees bend from zero by so many degrees, under a person who stands."""
    wave = 0.5 * (1 - np.cos(np.pi * TIMES))
    turns: dict[str, NDArray[np.float64]] = {}
    for side, most in (("right", right_deg), ("left", left_deg)):
        turns |= limb(side, ("shank", "foot"), so3.about_axis("y", np.radians(most) * wave))
    return BODY.motion(posture(BODY, len(TIMES), **turns))


def certain(motion: Motion, degrees: float) -> Motion:
    return replace(motion, confidence=certain_to(degrees, motion))


def found_in(analysis: MotionAnalysis) -> tuple[Finding, ...]:
    return findings(analysis, BODY.table, compared_sides(analysis))


def turning() -> Motion:
    """Steps in place, once around."""
    still = np.tile([0.0, -0.78], (240, 1))
    return stepping(TIMES, {"right": still, "left": still}, heading=np.pi * (1 - np.cos(np.pi * TIMES / 4)))


def partly_seen() -> Motion:
    """Walking with unobserved feet and hands, and a bridged quarter."""
    motion = walk()
    observed = np.ones(len(motion.skeleton.names), dtype=bool)
    observed[motion.skeleton.index("RightFoot", "LeftFoot", "RightHand", "LeftHand")] = False
    provenance = np.full(motion.poses.valid.shape, Provenance.CAMERA, dtype=np.uint8)
    provenance[: len(motion.times) // 4] = Provenance.BRIDGED
    return replace(motion, poses=replace(motion.poses, orientation_observed=observed, provenance=provenance))


MOTIONS: dict[str, Callable[[], Motion]] = {
    "walking": lambda: walking(6.0, speed=1.1),
    "treadmill": lambda: walking(6.0, treadmill=True),
    "two strides": lambda: walking(2.4),
    "backward": lambda: walking(6.0, speed=-1.0),
    "squats": lambda: squatting(4),
    "bends": lambda: knees(40, 40),
    "turning": turning,
    "partly seen": partly_seen,
    "certain": lambda: certain(knees(60, 60), 2.0),
    "asymmetric": lambda: certain(knees(90, 60), 2.0),
    "uncertain": lambda: certain(knees(90, 60), 20.0),
    "small difference": lambda: certain(knees(64, 60), 0.2),
    "within bands": lambda: certain(knees(66, 60), 2.0),
}
ROOM = "position in the room not verified: \u00b1 0.4 m, nothing in the recording verifies it"
WARNED = (
    "left hip internal/external rotation (LeftUpLeg_z): beyond its anatomical limit, largest 37 deg; more warns in body"
)
ERROR = AuditResult("truth", "mean error of knee and elbow flexion", "motion", 2.44, "deg")
CASES: dict[str, tuple[str, Headline, dict[str, Any]]] = {
    **{name: (name, FINE, {}) for name in MOTIONS},
    "all known": ("squats", FINE, {"height_m": 1.8, "mass_kg": 72.5, "sex": "female"}),
    "weight known": ("squats", FINE, {"mass_kg": 70.0}),
    **{
        f"{mode} of {n}": ("squats", FINE, {"mode": mode, "cameras": n})
        for mode in ("rtof", "rto", "imu")
        for n in (1, 2)
    },
    "no camera": ("squats", FINE, {"mode": "imu", "camera": False}),
    "other sensors": ("squats", FINE, {"sensors": ("Hips", "Head", "LeftShoulder", "LeftFoot", "RightFoot")}),
    "with truth": ("certain", FINE, {"results": (ERROR,)}),
    "warned": ("bends", Headline(Grade.WARN, WARNED, ()), {}),
    "unseen ear": ("bends", Headline(Grade.FAIL, "LeftEar: share of frames unseen 30 %", ()), {}),
    "unaudited": ("bends", Headline(Grade.NOT_CHECKED, "written without an audit: reconstruct again", ()), {}),
    "room": ("bends", Headline(Grade.WARN, f"Hips: share of frames unseen 30 %; {ROOM}", (), Grade.WEAK, ROOM), {}),
}


@cache
def analysed(name: str) -> MotionAnalysis:
    return analyse(MOTIONS[name]())


def lines(name: str) -> list[list[str]]:
    """Label, text and grade of each line of a case."""
    motion, overall, fields = CASES[name]
    found = summary_lines(analysed(motion), summary(**fields), overall, Session(subject="P07"))
    return [[line.label, line.text, line.grade.value if line.grade else ""] for line in found]


@pytest.mark.parametrize("name", CASES)
def test_the_lines_are_those_of_the_golden_file(name: str) -> None:
    """Made by ``PYTHONPATH=.:tests/support python tests/reporting/test_summary_lines.py``; read what changes."""
    assert lines(name) == json.loads(GOLDEN.read_text("utf-8"))[name]


def test_angles_that_turned_on_beyond_their_interval_have_no_finding() -> None:
    analysis = analyse(certain(knees(60, 60), 2.0))
    values = np.array(analysis.angles.values)
    values[120:, analysis.angles.names.index("left_knee_flexion")] -= 2 * np.pi
    turned = replace(analysis.angles, values=values)
    turned_on = replace(analysis, angles=turned, ranges=ranges_of_motion(turned))
    assert found_in(turned_on) == ()
    assert "whole turns" in next(r.why_not_comparable for r in turned_on.ranges if r.name == "left_knee_flexion")


def test_the_report_has_the_differences_of_the_sides_that_the_command_prints() -> None:
    motion = certain(knees(90, 60), 2.0)
    printed, _ = compare_sides(compared("a motion", motion))
    (changed,) = printed.changed
    assert (changed.name, changed.largest.measure) == ("knee_flexion", "range")
    found = compared_sides(analyse(motion))
    assert found is not None
    assert found.by == printed.by
    assert [
        [(one.name, one.verdict, one.changes[0].difference) for one in which.angles] for which in (found, printed)
    ] == [[(one.name, one.verdict, one.changes[0].difference) for one in printed.angles]] * 2


def test_an_end_beyond_an_anatomical_limit_is_a_finding() -> None:
    limit = np.degrees(anatomical_limits(BODY.table)["right_knee_flexion"][1])
    motion = certain(knees(limit + 12, limit + 12), 2.0)
    (knee,) = found_in(analyse(motion))
    assert knee.subject == "right_knee"[6:]
    assert f"highest angle {limit + 12:.0f} ± 4°, beyond the anatomical limit of {limit:.0f}°" in knee.text
    assert knee.size == pytest.approx(6, rel=0.02)
    assert found_in(analyse(certain(knees(limit + 3, limit + 3), 2.0))) == ()


def test_limits_have_the_signs_of_the_clinical_angles() -> None:
    limits = anatomical_limits(BODY.table)
    for side in ("right", "left"):
        low, high = np.degrees(limits[f"{side}_knee_flexion"])
        assert -20 < low < 0 < 120 < high
        low, high = np.degrees(limits[f"{side}_hip_flexion"])
        assert -70 < low < 0 < 110 < high
    assert limits["right_hip_adduction"] == pytest.approx(limits["left_hip_adduction"])


def test_unobserved_and_unreliable_angles_have_no_finding() -> None:
    motion = certain(knees(90, 60), 2.0)
    assert found_in(analyse(motion))
    provenance = np.full(motion.poses.valid.shape, Provenance.CAMERA, dtype=np.uint8)
    observed = np.array(motion.poses.orientation_observed)
    for part in ("LeftLeg", "LeftFoot"):
        provenance[:40, BODY.index(part)[0]] = Provenance.PRIOR
        observed[:40, BODY.index(part)[0]] = False
    unseen = replace(motion.poses, provenance=provenance, orientation_observed=observed)
    assert found_in(analyse(replace(motion, poses=unseen))) == ()
    assert found_in(analyse(certain(knees(90, 60), 20.0))) == ()


def test_asymmetric_stance_of_gait_is_a_finding_only_if_it_is_gait() -> None:
    analysis = analyse(certain(walking(10.0), 2.0))
    assert found_in(analysis) == ()

    def limping(analysis: MotionAnalysis) -> MotionAnalysis:
        gait = analysis.gait
        sides = {side: dict(measures) for side, measures in gait.summary.items()}
        sides["right"]["stance_share"] = (0.60, 0.01, 4)
        sides["left"]["stance_share"] = (0.70, 0.02, 4)
        return replace(analysis, gait=replace(gait, summary=sides))

    (stance,) = found_in(limping(analysis))
    right, left = (np.hypot(sd / 2, EVENT_SIGMA) for sd in (0.01, 0.02))
    bands = [f"{100 * BAND_95 * sigma:.0f}" for sigma in (right, left)]
    assert stance.text == f"stance: 60 ± {bands[0]} % of the stride right, 70 ± {bands[1]} % left"
    assert stance.size == pytest.approx(0.10 / np.hypot(right, left))
    feet = dict(analysis.gait.events.feet)
    feet["left"] = replace(feet["left"], by_ankle=True)  # events of another kind are not compared
    unlike = replace(limping(analysis).gait, events=replace(analysis.gait.events, feet=feet))
    assert found_in(replace(analysis, gait=unlike)) == ()
    gait = limping(analysis).gait
    other = replace(gait, verdict=replace(gait.verdict, why_not="It is a dance."))
    assert found_in(replace(analysis, gait=other)) == ()


@pytest.mark.parametrize(
    ("technical", "plain"),
    [
        (
            "LeftFoot: share of frames unseen 30 % (above 10 %) at 2.1 s: occluded",
            "left foot: share of frames unseen 30 % at 2.1 s: occluded",
        ),
        ("no sensor measured Head, LeftArm (Neck)", "no sensor measured head, left upper arm (neck)"),
        ("It is at z = -0.41 m, by the body's size", "It is 0.41 m below height 0, by the body's size"),
        ("joints 30 %: interpolated, or from the prior", "joints 30 %: assumed, not measured"),
        (
            "joints relative to the root: error expected by the stated standard deviations, RMS 70 mm",
            "posture: expected error 70 mm",
        ),
        ("knee 12 deg/s and 3 deg; more fails in body, image", "knee 12°/s and 3°"),
        (
            "all landmarks: reprojection error, median 7 px",
            "all points of the body: distance of the body model from the image, median 7 px",
        ),
    ],
)
def test_sentences_of_the_audit_are_said_in_plain_words(technical: str, plain: str) -> None:
    assert plain_words(technical, angle_table(BODY.table)) == plain


if __name__ == "__main__":
    GOLDEN.write_text(json.dumps({name: lines(name) for name in CASES}, indent=1, ensure_ascii=False) + "\n", "utf-8")


def test_bands_rest_on_the_sensors_that_the_mode_uses() -> None:
    found = summary()
    assert [summary(mode).sensors for mode in ("rtof", "rto")] == [3, 0]
    unplaced = [*found.inputs["sensors"], {"name": "spare", "segment": None}]
    assert replace(found, inputs={**found.inputs, "sensors": unplaced}).sensors == 3
    assert replace(found, inputs={}).sensors == 0

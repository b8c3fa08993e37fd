"""The page of a report: its data, its text, and how it fares in a browser where there is one."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import planted
import pytest
from clinical_support import walk
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from report_support import BROWSER, Page, certain_to, drawn_data, folder_of, rendered

from rtof_kin.body.skeleton import MotionSequence, SkeletonModel
from rtof_kin.clinical.analysis import analyse_motion
from rtof_kin.core.errors import FileFormatError, ShapeError
from rtof_kin.data.poses import Provenance
from rtof_kin.recording.session import Session
from rtof_kin.report.audit_results import Finding
from rtof_kin.report.isb import isb_items
from rtof_kin.report.plot_data import MISSING, packed, player_data, side_and_name, unpacked
from rtof_kin.report.writing import report

TODAY = date(2026, 2, 3)
INPUTS = {
    "software": "rtof_kin 9.9",
    "session": {"subject": "P07", "operator": "<img src=x onerror=alert(1)>", "date": "2026-01-31"},
    "subject": {"height_m": 1.7, "mass_kg": None, "sex": None, "bones": "measured"},
    "camera": {"width_px": 1920, "height_px": 1080, "rate_hz": 60.0, "landmarks": ["Head"]},
    "sensors": [{"name": "S1", "segment": "LeftLeg", "lever_arm_m": [0.0, 0.02, -0.2], "rate_hz": 100.0,
                 "known_share": 1.0, "largest_specific_force_m_s2": 31.0}],
    "calibration": {"converged": True, "columns": ["quantity", "of"], "rows": [["delay", "</script>"]]},
}  # fmt: skip


@pytest.fixture(scope="module")
def html(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The page of real walking, with markup where only text belongs, and bands."""
    motion = replace(walk(), confidence=certain_to(2.0, walk()))
    findings = [Finding("image", "error", "<b>Head</b>", 7.0, "px", 2.0, 5.0, "a source", "look & see")]
    folder = folder_of(
        motion, tmp_path_factory.mktemp("page") / "out", inputs=INPUTS,
        recording="walk </script><script>",
        acknowledgement="Data by <nobody>", audit=[finding.plain() for finding in findings],
    )  # fmt: skip
    return report(folder, made=TODAY)


@pytest.fixture(scope="module")
def page(html: str) -> Page:
    return Page(html)


def test_a_motion_of_one_frame_a_second_has_a_page_without_gait(tmp_path: Path) -> None:
    html = report(folder_of(walk()[::40], tmp_path / "out"), weight_kg=70.0, made=TODAY)
    assert "1 Hz is too low a rate for gait events" in html
    assert drawn_data(html)["angles"]["groups"]


# --- text ----------------------------------------------------------------------------------------


def test_every_tag_closes_and_nothing_from_a_file_becomes_markup(html: str, page: Page) -> None:
    assert page.wrong == []
    assert html.count("<script") == 2
    assert "<img" not in html
    assert "<b>Head" not in html
    assert "Data by &lt;nobody&gt;" in html


def test_the_page_needs_nothing_beside_itself(html: str, page: Page) -> None:
    assert not [a for a in page.attributes if a[1] in ("src", "href", "srcset", "action")]
    assert not re.search(r"url\(|@import|fetch\(|XMLHttpRequest|import\(", html)
    metas = [value for tag, name, value in page.attributes if (tag, name) == ("meta", "content")]
    (policy,) = [value for value in metas if "src" in value]
    assert policy.startswith("default-src 'none'; script-src 'sha256-")
    assert "unsafe" not in policy


def test_who_what_and_when_stand_at_the_top(page: Page) -> None:
    top = " ".join(page.text[""].split())
    for text in ("P07", "2026-01-31", "1.7 m, weight not given", "LeftLeg", "2026-02-03, rtof_kin 9.9"):
        assert text in top


def test_options_stand_over_what_the_recording_says(tmp_path: Path) -> None:
    folder = folder_of(walk(), tmp_path / "out", inputs=INPUTS)
    top = Page(report(folder, Session(subject="P08"), made=TODAY)).text[""]
    assert "P08: motion report" in top
    assert "2026-01-31" in top


def test_the_first_line_under_the_title_is_the_headline_of_the_audit(html: str, page: Page) -> None:
    line = re.search(r'<h1>.*?</h1>\s*<p class="headline">(.*?)</p>', html)
    assert line
    assert "fail" in line[1]
    assert "&lt;b&gt;Head&lt;/b&gt;: error 7 px (above 5 px): look &amp; see" in line[1]
    assert "gait: " in page.text[""]


def test_what_was_chosen_stands_at_the_top(tmp_path: Path) -> None:
    settings = {"space": "cartesian", "backend": "ipopt", "energy": "as printed", "frames": 20,
                "lifter": "causal", "lift_with_sensors": False, "calibrate": "no", "threads": 1,
                "guard_streams": False}  # fmt: skip
    folder = folder_of(walk(), tmp_path / "out", settings=settings)
    top = " ".join(Page(report(folder, made=TODAY)).text[""].split())
    assert "cartesian space, ipopt, energy: as printed; 20 frames a fragment" in top
    assert "causal, from the image alone" in top
    assert "taken as they are" in top


def test_every_section_has_a_verdict_with_its_reason(page: Page) -> None:
    text = " ".join(page.text["verdicts"].split())
    assert "Agreement with the image fail <b>Head</b>: error 7 px (above 5 px): look & see" in text
    assert "Agreement with the sensors not checked nothing was checked" in text
    assert "Joint torques not checked torques: not computed: no weight is given" in text


def test_the_audit_shows_limits_and_where_they_come_from(page: Page) -> None:
    text = page.text["audit"]
    for part in ("7 px", "2 px", "5 px", "a source"):
        assert part in text


def test_ranges_stand_left_against_right(page: Page) -> None:
    analysis = analyse_motion(walk())
    found = {r.name: np.degrees(r.range) for r in analysis.ranges}
    text = page.text["ranges"]
    for side in ("right", "left"):
        assert f"{found[f'{side}_knee_flexion']:.0f}" in text
    difference = round(found["right_knee_flexion"], 1) - round(found["left_knee_flexion"], 1)
    assert f"{round(difference):+d}" in text


def test_isb_items_are_filled_in_where_they_are_known_and_blank_where_not(page: Page) -> None:
    text = page.text["isb"]
    assert "S1 on LeftLeg at (0, 20, -200) mm in its frame" in text
    assert "100 Hz" in text
    assert "10.1016/j.jbiomech.2024.112225" in text
    unknown = [item for item in isb_items(INPUTS, "rtof", True, "none") if item.known is None]
    assert text.count("to be filled in") >= len(unknown) > 5
    assert "manufacturer" in " ".join(item.name for item in unknown)


def test_a_weight_brings_torques(tmp_path: Path) -> None:
    folder = folder_of(walk(), tmp_path / "out")
    text = Page(report(folder, weight_kg=70.0, made=TODAY)).text
    assert "right knee flexion RightLeg_y" in " ".join(text["torques"].split())
    assert "no weight" not in text["verdicts"]
    with pytest.raises(ShapeError, match="mass: 7000 kg is no person's"):
        report(folder, weight_kg=7000.0)


def test_a_recording_of_two_seconds_says_that_it_has_no_gait(tmp_path: Path) -> None:
    folder = folder_of(walk()[:60], tmp_path / "out")
    text = Page(report(folder, made=TODAY)).text
    assert "No gait cycle was found" in text["gait"]
    assert re.search(r"Gait\s+not checked\s+strides: ", text["verdicts"])


def test_gaps_and_a_leg_that_nobody_saw_are_open_and_said(tmp_path: Path) -> None:
    motion = walk()
    poses = motion.poses
    valid, R = poses.valid.copy(), poses.R_world_bone.copy()
    valid[50:70] = False
    R[:, motion.skeleton.index("LeftLeg")] = np.nan
    observed = poses.orientation_observed.copy()
    observed[50:70] = False
    poses = replace(poses, valid=valid, R_world_bone=R, orientation_observed=observed)
    gappy = replace(motion, poses=poses)
    html = report(folder_of(gappy, tmp_path / "out"), made=TODAY)
    text, data = Page(html).text, drawn_data(html)
    assert "left_knee_flexion" in text["verdicts"]
    assert f"{motion.times[50]:.2f} to {motion.times[69]:.2f} s" in text["isb"]
    knee = next(group for group in data["angles"]["groups"] if group["name"] == "knee flexion")
    assert [series["side"] for series in knee["series"]] == ["right"]
    assert np.isnan(unpacked(knee["series"][0]["y"], 10)[50:70]).all()


def test_a_folder_without_an_audit_says_so(tmp_path: Path) -> None:
    folder = folder_of(walk(), tmp_path / "out", audit=None)
    top = " ".join(Page(report(folder, made=TODAY)).text[""].split())
    assert "not checked an earlier version of rtof_kin wrote the folder, without an audit" in top


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"recording": 7}, "recording: no text"),
        ({"settings": {"space": 7}}, "settings, space"),
        ({"inputs": []}, "inputs: no table; reconstruct again"),
        ({"inputs": {"sensors": {}, "subject": "me"}}, "inputs, subject: no table"),
        ({"inputs": {"sensors": "none"}}, "inputs, sensors: no list"),
        ({"inputs": {"sensors": [{"rate_hz": "fast"}]}}, "inputs, sensors, rate_hz: 'fast' is not what"),
        ({"inputs": {"session": {"subject": ["a"]}}}, "inputs, session, subject: \"['a']\" is not what"),
        ({"inputs": {"session": {"date": "soon"}}}, "session date: 'soon'"),
        ({"inputs": {"sensors": [{"lever_arm_m": "far"}]}}, "inputs, sensors, lever_arm_m: 'far'"),
        ({"inputs": {"sensors": [{"lever_arm_m": ["far"]}]}}, "inputs, sensors, lever_arm_m: "),
        ({"inputs": {"calibration": {"rows": 3}}}, "inputs, calibration, rows: no list"),
        ({"inputs": {"calibration": {"rows": [3]}}}, "inputs, calibration, rows: no list"),
        ({"inputs": {"floor_height_m": "low"}}, "inputs, floor_height_m"),
        ({"audit": [{"section": "image"}]}, "finding: name is 'None', no text; reconstruct again"),
        ({"audit": {}}, "audit: no list"),
    ],
)
def test_a_summary_that_is_none_is_refused(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    folder = folder_of(walk(), tmp_path / "out", **change)
    with pytest.raises(FileFormatError, match=re.escape(message)):
        report(folder)


def test_a_folder_of_something_else_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="there is no such file"):
        report(tmp_path)
    (tmp_path / "summary.json").write_text("[1]")
    with pytest.raises(FileFormatError, match="not the summary of a reconstruction"):
        report(tmp_path)


# --- what is drawn -------------------------------------------------------------------------------


@given(arrays.arrays(np.float64, st.integers(0, 20), elements=st.floats(-3000, 3000) | st.just(np.nan)))
def test_packed_numbers_come_back_to_a_tenth(values: np.ndarray[Any, Any]) -> None:
    np.testing.assert_allclose(unpacked(packed(values, 10), 10), values, atol=0.0501)


def test_what_cannot_be_packed_is_missing() -> None:
    assert unpacked(packed(np.array([np.inf, -np.inf, 4000.0, 3276.7]), 10), 10).tolist()[3] == 3276.7
    assert np.isnan(unpacked(packed(np.array([np.inf, -np.inf, 4000.0]), 10), 10)).all()
    assert np.iinfo(np.int16).min == MISSING


def test_curves_and_bands_are_those_of_the_analysis(html: str) -> None:
    data = drawn_data(html)
    analysis = analyse_motion(replace(walk(), confidence=certain_to(2.0, walk())))
    knee = next(group for group in data["angles"]["groups"] if group["name"] == "knee flexion")
    right = next(series for series in knee["series"] if series["side"] == "right")
    values = np.degrees(analysis.angles["right_knee_flexion"])
    np.testing.assert_allclose(unpacked(right["y"], 10), values, atol=0.0501)
    sigma = analysis.angles.sigma
    assert sigma is not None
    a = analysis.angles.names.index("right_knee_flexion")
    np.testing.assert_allclose(unpacked(right["half"], 10), 1.96 * np.degrees(sigma[:, a]), atol=0.0501)
    np.testing.assert_allclose(data["angles"]["times"], analysis.angles.times, atol=1e-4)


def test_gait_cycles_are_drawn_right_against_left(html: str) -> None:
    data = drawn_data(html)["cycles"]
    curves = {(c.name, c.side): c for c in analyse_motion(walk()).curves}
    knee = next(group for group in data["groups"] if group["name"] == "knee flexion")
    assert [series["side"] for series in knee["series"]] == ["right", "left"]
    right = knee["series"][0]
    own = curves[("right_knee_flexion", "right")]
    assert right["n"] == len(own.curves)
    np.testing.assert_allclose(unpacked(right["y"], 10), np.degrees(own.mean), atol=0.0501)
    assert set(data["stance"]) == {"right", "left"}


def test_the_skeleton_is_where_the_joints_are(html: str) -> None:
    player, motion = drawn_data(html)["player"], walk()
    p = unpacked(player["p"], 1000, (len(player["times"]), len(player["joints"]), 3))
    given_ = motion.poses.p_world_joint
    np.testing.assert_allclose(p - p[:, :1], given_ - given_[:, :1], atol=1.01e-3)
    assert player["parents"] == list(motion.skeleton.parents)
    assert 0 <= p[..., 2].min() < 0.2  # it stands on the floor


def test_the_player_knows_when_nobody_saw_a_bone() -> None:
    motion = walk()
    leg, observed = motion.skeleton.index("LeftLeg", "LeftFoot"), motion.poses.orientation_observed.copy()
    provenance = motion.poses.provenance.copy()
    observed[:, motion.skeleton.index("LeftUpLeg", "LeftLeg")] = False
    provenance[...] = Provenance.CAMERA
    provenance[40:60, leg] = Provenance.PRIOR
    poses = replace(motion.poses, provenance=provenance, orientation_observed=observed)
    unseen = player_data(replace(motion, poses=poses), slice(None), 0.0)["unseen"]
    assert {j: spans for j, spans in enumerate(unseen) if spans} == {j: [(40, 60)] for j in leg}
    halved = player_data(replace(motion, poses=poses), slice(None, None, 2), 0.0)["unseen"]
    assert halved[leg[0]] == [(20, 30)]


def test_long_recordings_are_drawn_at_fewer_frames_and_stay_small(tmp_path: Path) -> None:
    motion = planted.moving(SkeletonModel.default(), 3600)
    html = report(folder_of(motion, tmp_path / "out"), made=TODAY)
    data = drawn_data(html)
    assert len(data["player"]["times"]) == 1800
    assert "Drawn at 30 frames a second" in Page(html).text["angles"]
    assert len(html) < 600_000


def test_sides_are_told_from_names() -> None:
    assert side_and_name("right_knee_flexion") == ("right", "knee_flexion")
    assert side_and_name("pelvis_tilt") == ("", "pelvis_tilt")


# --- in a browser --------------------------------------------------------------------------------


@pytest.mark.skipif(BROWSER is None, reason="no headless browser here")
@pytest.mark.parametrize("case", ["walk", "single frame", "nothing known"])
def test_a_browser_draws_everything_without_an_error(case: str, html: str, tmp_path: Path) -> None:
    if case != "walk":
        motion: MotionSequence = walk()[:1] if case == "single frame" else walk()[:20]
        if case == "nothing known":
            poses = motion.poses
            motion = replace(motion, q=np.full_like(motion.q, np.nan), poses=replace(
                poses, p_world_joint=np.full_like(poses.p_world_joint, np.nan),
                R_world_bone=np.full_like(poses.R_world_bone, np.nan), provenance=None, valid=None,
            ))  # fmt: skip
        html = report(folder_of(motion, tmp_path / "out"), made=TODAY)
    path = tmp_path / "page #1.html"
    path.write_text(html, encoding="utf-8")
    dom = rendered(path, tmp_path / "profile")
    assert 'data-state="ready"' in dom
    data = drawn_data(html)
    charts = len(data["angles"]["groups"]) + len(data["cycles"]["groups"])
    assert dom.count("<svg") == charts
    if case == "walk":
        assert charts > 20
        assert dom.count('class="curve right"') >= 20
        assert 'class="band left"' in dom
        assert 'class="toe right"' in dom


def test_strict_json_is_in_the_page(html: str) -> None:
    text = json.dumps(drawn_data(html), allow_nan=False)
    assert "NaN" not in text

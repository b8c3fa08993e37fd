"""The report page: text, plot data, and rendering in a browser where there is one."""

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
from report_support import BROWSER, Page, certain_to, folder_of, plotted_data, rendered, unpacked

from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.clinical.analysis import analyse
from rtof_kin.core.errors import FileFormatError, InvalidInputError
from rtof_kin.data.poses import Provenance
from rtof_kin.recording.session import Session
from rtof_kin.reporting.audit_results import AuditResult
from rtof_kin.reporting.page import report
from rtof_kin.reporting.plot_data import packed, player_data
from rtof_kin.reporting.provenance import isb_items

TODAY = date(2026, 2, 3)
INPUTS = {
    "software": "rtof_kin 9.9",
    "session": {"subject": "P07", "operator": "<img src=x onerror=alert(1)>", "date": "2026-01-31"},
    "subject": {"height_m": 1.7, "mass_kg": None, "sex": None, "bones": "measured"},
    "camera": {"width_px": 1920, "height_px": 1080, "rate_hz": 60.0, "landmarks": ["Head"]},
    "sensors": [
        {
            "name": "S1",
            "segment": "LeftLeg",
            "lever_arm_m": [0.0, 0.02, -0.2],
            "rate_hz": 100.0,
            "known_share": 1.0,
            "largest_specific_force_m_s2": 31.0,
        }
    ],
    "calibration": {"converged": True, "columns": ["quantity", "of"], "rows": [["delay", "</script>"]]},
}


@pytest.fixture(scope="module")
def html(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The page of real walking with bands, and with markup in its texts."""
    motion = replace(walk(), confidence=certain_to(2.0, walk()))
    result = AuditResult("image", "error", "<b>Head</b>", 7.0, "px", 2.0, 5.0, "a source", "look & see")
    folder = folder_of(
        motion,
        tmp_path_factory.mktemp("page") / "out",
        inputs=INPUTS,
        recording="walk </script><script>",
        acknowledgement="Data by <nobody>",
        audit=[result.plain()],
    )
    return report(folder, made=TODAY)


@pytest.fixture(scope="module")
def page(html: str) -> Page:
    return Page(html)


def text_of(folder: Path, section: str = "", **options: Any) -> str:
    """Text of a section of a report, without line breaks."""
    return " ".join(Page(report(folder, made=TODAY, **options)).text[section].split())


def knee_of(groups: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Curves of knee flexion."""
    found: list[dict[str, Any]] = next(group for group in groups if group["name"] == "knee flexion")["series"]
    return found


def test_tags_are_closed_and_texts_escaped(html: str, page: Page) -> None:
    assert page.wrong == []
    assert html.count("<script") == 2
    assert "<img" not in html
    assert "<b>Head" not in html
    assert "Data by &lt;nobody&gt;" in html
    assert "NaN" not in json.dumps(plotted_data(html), allow_nan=False)


def test_the_page_needs_no_network(html: str, page: Page) -> None:
    links = [a for a in page.attributes if a[1] in ("src", "href", "srcset", "action")]
    assert {(tag, name) for tag, name, _ in links} == {("a", "href")}
    ids = {value for _, name, value in page.attributes if name == "id"}
    assert {value for *_, value in links} <= {f"#{name}" for name in ids}
    assert not re.search(r"url\(|@import|fetch\(|XMLHttpRequest|import\(", html)
    metas = [value for tag, name, value in page.attributes if (tag, name) == ("meta", "content")]
    (policy,) = [value for value in metas if "src" in value]
    assert policy.startswith("default-src 'none'; script-src 'sha256-")
    assert "unsafe" not in policy


def test_the_header_names_the_session_and_says_how_good(html: str, page: Page) -> None:
    top = " ".join(page.text[""].split())
    for text in ("P07: motion report", "recorded 2026-01-31", "report made 2026-02-03 by rtof_kin 9.9"):
        assert text in top
    assert "&lt;b&gt;head&lt;/b&gt;: error 7 px: look &amp; see" in html.lower()
    recording = " ".join(page.text["recording"].split())
    for text in ("P07", "2026-01-31", "1.7 m, weight not given", "LeftLeg", "2026-02-03, rtof_kin 9.9"):
        assert text in recording


def test_a_camera_that_is_not_calibrated_has_a_table(page: Page, tmp_path: Path) -> None:
    assert "not calibrated" not in page.text["calibration"]
    estimate = {"columns": ["quantity", "value"], "rows": [["focal length", "900 px"]]}
    text = text_of(folder_of(walk(), tmp_path / "out", inputs={"camera_estimate": estimate}), "calibration")
    assert "The camera is not calibrated" in text
    assert "focal length 900 px" in text


def test_notes_of_the_recording_are_shown_line_by_line(html: str, tmp_path: Path) -> None:
    assert "How the recording was made" not in html
    inputs = INPUTS | {"notes": "doubtful: <b>its heading\nassumed: the floor is flat"}
    folder = folder_of(walk(), tmp_path / "out", inputs=inputs)
    written = report(folder, made=TODAY)
    assert "<li>doubtful: &lt;b&gt;its heading</li><li>assumed: the floor is flat</li>" in written
    assert Page(written).wrong == []


def test_the_header_has_options_and_settings(tmp_path: Path) -> None:
    settings = {
        "space": "cartesian",
        "backend": "ipopt",
        "energy": "as printed",
        "frames": 20,
        "lifter": "perfect",
        "lift_with_sensors": False,
        "calibrate": "no",
        "threads": 1,
        "guards": "",
    }
    folder = folder_of(walk(), tmp_path / "out", inputs=INPUTS, settings=settings, audit=None)
    options = {"session": Session(subject="P08")}
    assert "P08: motion report" in text_of(folder, **options)
    assert "without an audit" in text_of(folder, **options)
    recording = text_of(folder, "recording", **options)
    for text in (
        "2026-01-31",
        "perfect, from the image alone",
        "Outlier rejection off",
        "cartesian space, ipopt, energy: as printed; 20 frames a fragment",
    ):
        assert text in recording


def test_sections_have_verdicts_reasons_and_limits(page: Page) -> None:
    text = " ".join(page.text["verdicts"].split())
    assert text.startswith("Quality Angles do not use Use with care: some figures are less reliable.")
    assert "Agreement with the image problem <b>Head</b>: error 7 px: look & see" in text
    assert "Agreement with the sensors: Nothing was checked" in text
    assert "Joint torques: Torques: not computed" in text
    assert "fail" not in text
    assert "7 px fail 2 px 5 px" in " ".join(page.text["audit"].split())
    assert all(part in page.text["audit"] for part in ("7 px", "2 px", "5 px", "a source"))


def test_ranges_compare_left_and_right(page: Page) -> None:
    found = {r.name: np.degrees(r.range) for r in analyse(walk()).ranges}
    right, left = (found[f"{side}_knee_flexion"] for side in ("right", "left"))
    for text in (f"{right:.0f}", f"{left:.0f}", f"{round(right - left):+d}"):
        assert text in page.text["ranges"]


def test_isb_items_are_filled_in_or_left_blank(page: Page) -> None:
    text = page.text["isb"]
    for part in ("S1 on LeftLeg at (0, 20, -200) mm in its frame", "100 Hz", "10.1016/j.jbiomech.2024.112225"):
        assert part in text
    topics = isb_items(INPUTS, "rtof", True, "none")
    unknown = [name for items in topics.values() for name, known in items.items() if known is None]
    assert text.count("to be filled in") >= len(unknown) > 5
    assert "manufacturer" in " ".join(unknown)


def test_torques_need_a_plausible_weight(tmp_path: Path) -> None:
    folder = folder_of(walk(), tmp_path / "out")
    torques = text_of(folder, "torques", weight_kg=70.0)
    assert "Peak torques, right and left" in torques
    assert "knee flexion/extension" in torques
    assert "RightLeg_y" not in torques
    assert "no weight" not in text_of(folder, "verdicts", weight_kg=70.0)
    with pytest.raises(InvalidInputError, match="7000 kg"):
        report(folder, weight_kg=7000.0)


def test_short_recordings_have_no_gait(tmp_path: Path) -> None:
    folder = folder_of(walk()[:60], tmp_path / "out")
    assert "No complete stride was found" in text_of(folder, "gait")
    assert "Gait: Strides: " in text_of(folder, "verdicts")


def test_gaps_are_left_open_and_described(tmp_path: Path) -> None:
    motion = walk()
    poses = motion.poses
    valid, R = poses.valid.copy(), poses.R_world_bone.copy()
    valid[50:70] = False
    R[:, motion.skeleton.index("LeftLeg")] = np.nan
    observed = poses.orientation_observed.copy()
    observed[50:70] = False
    poses = replace(poses, valid=valid, R_world_bone=R, orientation_observed=observed)
    html = report(folder_of(replace(motion, poses=poses), tmp_path / "out"), made=TODAY)
    text = Page(html).text
    assert "left_knee_flexion" in text["verdicts"]
    assert f"{motion.times[50]:.2f} to {motion.times[69]:.2f} s" in text["isb"]
    (knee,) = knee_of(plotted_data(html)["angles"]["groups"])
    assert knee["side"] == "right"
    assert np.isnan(unpacked(knee["y"], 10)[50:70]).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"recording": 7}, "recording"),
        ({"settings": {"space": 7}}, "settings, space"),
        ({"inputs": []}, "inputs: no table; reconstruct again"),
        ({"inputs": {"sensors": {}, "subject": "me"}}, "inputs, subject: no table"),
        ({"inputs": {"sensors": "none"}}, "inputs, sensors: no list"),
        ({"inputs": {"sensors": [{"rate_hz": "fast"}]}}, "inputs, sensors, rate_hz: 'fast'"),
        ({"inputs": {"session": {"subject": ["a"]}}}, "inputs, session, subject: \"['a']\""),
        ({"inputs": {"session": {"date": "soon"}}}, "session date: 'soon'"),
        ({"inputs": {"sensors": [{"lever_arm_m": "far"}]}}, "inputs, sensors, lever_arm_m: 'far'"),
        ({"inputs": {"sensors": [{"lever_arm_m": ["far"]}]}}, "inputs, sensors, lever_arm_m: "),
        ({"inputs": {"calibration": {"rows": 3}}}, "inputs, calibration, rows: no list"),
        ({"inputs": {"calibration": {"rows": [3]}}}, "inputs, calibration, rows: no list"),
        ({"inputs": {"floor_height_m": "low"}}, "inputs, floor_height_m"),
        ({"audit": [{"section": "image"}]}, "name is 'None', no text; reconstruct again"),
        ({"audit": {}}, "audit: no list"),
    ],
)
def test_invalid_summaries_are_rejected(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    folder = folder_of(walk(), tmp_path / "out", **change)
    with pytest.raises(FileFormatError, match=re.escape(message)):
        report(folder)


def test_other_folders_are_rejected(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=r"summary\.json"):
        report(tmp_path)
    (tmp_path / "summary.json").write_text("[1]")
    with pytest.raises(FileFormatError, match="not the summary"):
        report(tmp_path)


@given(arrays.arrays(np.float64, st.integers(0, 20), elements=st.floats(-3000, 3000) | st.just(np.nan)))
def test_packed_numbers_have_one_decimal(values: np.ndarray[Any, Any]) -> None:
    np.testing.assert_allclose(unpacked(packed(values, 10), 10), values, atol=0.0501)
    overflow = unpacked(packed(np.array([np.inf, -np.inf, 4000.0, 3276.7]), 10), 10)
    np.testing.assert_array_equal(overflow, [np.nan, np.nan, np.nan, 3276.7])


def test_plotted_curves_and_bands_are_those_of_the_analysis(html: str) -> None:
    data = plotted_data(html)
    analysis = analyse(replace(walk(), confidence=certain_to(2.0, walk())))
    right = next(s for s in knee_of(data["angles"]["groups"]) if s["side"] == "right")
    a = analysis.angles.names.index("right_knee_flexion")
    assert analysis.angles.sigma is not None
    values, half = np.degrees(analysis.angles.values[:, a]), 1.96 * np.degrees(analysis.angles.sigma[:, a])
    np.testing.assert_allclose(unpacked(right["y"], 10), values, atol=0.0501)
    np.testing.assert_allclose(unpacked(right["half"], 10), half, atol=0.0501)
    np.testing.assert_allclose(data["angles"]["times"], analysis.angles.times, atol=1e-4)
    cycles = knee_of(data["cycles"]["groups"])
    assert [series["side"] for series in cycles] == ["right", "left"]
    own = next(c for c in analysis.curves if c.name == "right_knee_flexion")
    assert cycles[0]["n"] == len(own.curves)
    np.testing.assert_allclose(unpacked(cycles[0]["y"], 10), np.degrees(own.mean), atol=0.0501)
    assert set(data["cycles"]["stance"]) == {"right", "left"}


def test_plotted_skeleton_has_the_joint_positions(html: str) -> None:
    player, motion = plotted_data(html)["player"], walk()
    p = unpacked(player["p"], 1000, (len(player["times"]), len(player["joints"]), 3))
    given_ = motion.poses.p_world_joint
    np.testing.assert_allclose(p - p[:, :1], given_ - given_[:, :1], atol=1.01e-3)
    assert player["parents"] == list(motion.skeleton.parents)
    assert 0 <= p[..., 2].min() < 0.2  # on the floor


def test_player_marks_unobserved_bones() -> None:
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


def test_long_recordings_are_plotted_at_fewer_frames(tmp_path: Path) -> None:
    motion = planted.moving(SkeletonModel.default(), 3600)
    html = report(folder_of(motion, tmp_path / "out"), made=TODAY)
    assert len(plotted_data(html)["player"]["times"]) == 1800
    assert "30 frames per second" in Page(html).text["angles"]
    assert len(html) < 600_000


@pytest.mark.skipif(BROWSER is None, reason="no headless browser here")
@pytest.mark.parametrize("case", ["walk", "single frame", "nothing known"])
def test_a_browser_renders_all_plots(case: str, html: str, tmp_path: Path) -> None:
    if case != "walk":
        motion: Motion = walk()[:1] if case == "single frame" else walk()[:20]
        if case == "nothing known":
            poses = motion.poses
            motion = replace(
                motion,
                q=np.full_like(motion.q, np.nan),
                poses=replace(
                    poses,
                    p_world_joint=np.full_like(poses.p_world_joint, np.nan),
                    R_world_bone=np.full_like(poses.R_world_bone, np.nan),
                    provenance=None,
                    valid=None,
                ),
            )
        html = report(folder_of(motion, tmp_path / "out"), made=TODAY)
    path = tmp_path / "page #1.html"
    path.write_text(html, encoding="utf-8")
    dom = rendered(path, tmp_path / "profile")
    assert 'data-state="ready"' in dom
    data = plotted_data(html)
    groups = data["angles"]["groups"] + data["cycles"]["groups"]
    charts = sum(1 + group["opposite"] for group in groups)  # one for each sign
    assert dom.count("<svg") == charts
    if case == "walk":
        assert charts > 20
        assert dom.count('class="curve right"') >= 20
        assert 'class="band left"' in dom
        assert 'class="toe right"' in dom

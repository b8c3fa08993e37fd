"""The report page: text, plot data, and rendering in a browser where there is one."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from clinical_support import walk
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from report_support import BROWSER, Page, certain_to, folder_of, plotted_data, rendered, unpacked

from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.clinical.analysis import analyse
from rtof_kin.clinical.angle_table import angle_table
from rtof_kin.clinical.range_of_motion import UncertainEnd
from rtof_kin.core.errors import FileFormatError, InvalidInputError
from rtof_kin.data.poses import Provenance
from rtof_kin.recording.labels import Session
from rtof_kin.reporting import document, plot_data
from rtof_kin.reporting.analysis import curve_bands, gait_table
from rtof_kin.reporting.angle_names import angle_name, side_and_name
from rtof_kin.reporting.audit_results import ROOM_BAND, AuditResult
from rtof_kin.reporting.document import Document, Section
from rtof_kin.reporting.html import asset, css_string
from rtof_kin.reporting.page import range_tables, report, way_line
from rtof_kin.reporting.plot_data import (
    angle_curves,
    cycle_curves_data,
    envelope_frames,
    packed,
    player_data,
    shown_frames,
    widest_bands,
)

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


def test_options_settings_notes_and_an_estimated_camera_are_shown(html: str, tmp_path: Path) -> None:
    assert "How the recording was made" not in html
    assert "The camera is not calibrated" not in html
    settings = {
        "space": "cartesian",
        "energy": "as printed",
        "frames": 20,
        "lifter": "perfect",
        "lift_with_sensors": False,
        "calibrate": "no",
        "threads": 1,
        "guards": "",
    }
    estimate = {"columns": ["quantity", "value"], "rows": [["focal length", "900 px"]]}
    inputs = INPUTS | {"notes": "doubtful: <b>its heading\nassumed: the floor is flat", "camera_estimate": estimate}
    folder = folder_of(walk(), tmp_path / "out", inputs=inputs, settings=settings, audit=None)
    written = report(folder, session=Session(subject="P08"), made=TODAY)
    found = Page(written)
    assert found.wrong == []
    text = {section: " ".join(own.split()) for section, own in found.text.items()}
    for section, words in (
        ("", "P08: motion report"),
        ("", "without an audit"),
        ("recording", "2026-01-31"),
        ("recording", "perfect, from the image alone"),
        ("recording", "Outlier rejection off"),
        ("recording", "cartesian space, energy: as printed; 20 frames a fragment"),
        ("calibration", "The camera is not calibrated"),
        ("calibration", "focal length 900 px"),
    ):
        assert words in text[section]
    assert "<li>doubtful: &lt;b&gt;its heading</li><li>assumed: the floor is flat</li>" in written


def test_a_plausible_motion_is_not_called_good_and_the_page_says_what_would_prove_it(tmp_path: Path) -> None:
    fine = AuditResult("image", "error", "Head", 1.0, "px", 2.0, 5.0)
    lone = AuditResult.not_checked("certificate", "motion", "one sensor leaves nothing to predict it from: add one")
    band = AuditResult("room", ROOM_BAND, "position", 0.3, "m", 0.5)
    folder = folder_of(walk(), tmp_path / "out", audit=[one.plain() for one in (fine, lone, band)])
    folder_page = report(folder, made=TODAY)
    assert folder_page.count('<span class="grade plausible">plausible</span>') == 2  # summary, quality
    text = {name: " ".join(own.split()) for name, own in Page(folder_page).text.items()}
    assert "Careful Not proven: one sensor leaves nothing to predict it from: add one." in text[""]
    assert "Plausible: nothing contradicts the angles, and nothing proves them." in text["verdicts"]
    assert "Left-out sensors" in text["verdicts"]


def test_sections_have_verdicts_reasons_and_limits(page: Page) -> None:
    text = " ".join(page.text["verdicts"].split())
    assert text.startswith("Quality Angles do not use Use with care: some figures are less reliable.")
    assert "Agreement with the image problem <b>Head</b>: error 7 px: look & see" in text
    assert "Agreement with the sensors: Nothing was checked" in text
    assert "Joint torques: Torques: not computed" in text
    assert "Left-out sensors" not in text  # nobody asked for them
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
    assert text.count("to be filled in") > 5
    assert re.search("manufacturer[^:]*magnetometer *to be filled in", text)
    assert re.search("number and placement *S1 on", text)


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
        ({"inputs": []}, "inputs: no table; reconstruct again"),
        ({"inputs": {"sensors": {}}}, "inputs, sensors: no list"),
        ({"inputs": {"subject": "me"}}, "inputs, subject: no table"),
        ({"inputs": {"sensors": [{"rate_hz": "fast"}]}}, "inputs, sensors, rate_hz: 'fast'"),
        ({"inputs": {"session": {"subject": ["a"]}}}, "session subject: \"['a']\" is not text"),
        ({"inputs": {"session": {"date": "soon"}}}, "session date: 'soon'"),
        ({"inputs": {"sensors": [{"lever_arm_m": ["far"]}]}}, "inputs, sensors, lever_arm_m: "),
        ({"inputs": {"calibration": {"rows": [3]}}}, "inputs, calibration, rows: no list"),
        ({"inputs": {"floor_height_m": "low"}}, "inputs, floor_height_m"),
        ({"audit": [{"section": "image"}]}, "name is 'None', no text; reconstruct again"),
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


def html_of(*parts: Any) -> str:
    """A page of these parts alone, without its style."""
    return document.page(Document("x", "x", "x", sections=[Section("x", "x", parts)])).partition("</style>")[2]


ROWS = {row.name: row for row in angle_table(SkeletonModel.default().table).rows}


@pytest.mark.parametrize(
    ("name", "clinical", "opensim", "opposite", "shown"),
    [
        ("left_knee_flexion", "knee flexion", "knee_angle_r, _l", False, "isb xzy opensim"),
        ("spine_flexion", "spine flexion", "lumbar_extension", True, "isb xzy opensim"),
        ("pelvis_tilt", "pelvis tilt", "", False, "isb xzy"),
        ("pelvis_opensim_tilt", "pelvis tilt", "pelvis_tilt", False, "opensim"),
        ("right_shoulder_elevation", "shoulder elevation", "", False, "isb opensim"),
        ("right_shoulder_xzy_abduction", "shoulder abduction", "", False, "xzy"),
    ],
)
def test_an_angle_has_a_name_in_each_convention(
    name: str, clinical: str, opensim: str, opposite: bool, shown: str
) -> None:
    found = angle_name(ROWS[name])
    assert (found.clinical, found.opensim, found.opposite, found.shown) == (clinical, opensim, opposite, shown)
    assert found.opensim_title == (opensim or f"{clinical} (no OpenSim coordinate)")


def test_every_convention_shows_each_name_once() -> None:
    for convention in ("isb", "xzy", "opensim"):
        names = {side_and_name(name)[1]: angle_name(row) for name, row in ROWS.items()}
        titles = [own.clinical for own in names.values() if convention in own.shown.split()]
        assert len(titles) == len(set(titles)) > 15


@given(
    arrays.arrays(np.float64, st.integers(1, 60), elements=st.floats(-300, 300) | st.just(np.nan)), st.integers(1, 9)
)
def test_the_envelope_of_a_curve_has_its_extremes_in_order(values: np.ndarray, step: int) -> None:
    half = np.where(np.isfinite(values), np.abs(values), np.nan)
    frames, bands = envelope_frames(values, step), widest_bands(half, values, step)
    assert len(frames) == len(bands) == 2 * -(-len(values) // step)
    assert (np.diff(frames) >= 0).all()
    for first, own in enumerate(np.split(values, range(step, len(values), step))):
        pair = slice(2 * first, 2 * first + 2)
        if not np.isfinite(own).any():
            assert np.isnan([*values[frames[pair]], *bands[pair]]).all()
            continue
        assert set(values[frames[pair]]) == {np.nanmin(own), np.nanmax(own)}
        assert (bands[pair] == np.nanmax(np.abs(own))).all()


def test_long_curves_keep_their_peaks_and_widest_bands(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plot_data, "MOST_SAMPLES", 40)
    motion = replace(walk(), confidence=certain_to(2.0, walk()))
    analysis = analyse(motion)
    found = angle_curves(analysis, shown_frames(motion.times))
    (group,) = [group for group in found["groups"] if group["name"] == "knee flexion"]
    (right,) = [series for series in group["series"] if series["side"] == "right"]
    a = analysis.angles.names.index("right_knee_flexion")
    assert analysis.angles.sigma is not None
    for curve, given_ in (
        (right["y"], analysis.angles.values[:, a]),
        (right["half"], 1.96 * analysis.angles.sigma[:, a]),
    ):
        values = unpacked(curve, 10)
        assert len(values) == len(found["times"]) <= 40
        assert values.max() == pytest.approx(np.degrees(given_).max(), abs=0.06)
    assert found["interval"] == pytest.approx(9 / motion.poses.rate_hz, abs=1e-3)
    assert (np.diff(found["times"]) > 0).all()
    peak = found["times"][int(unpacked(right["y"], 10).argmax())]
    assert peak == pytest.approx(motion.times[analysis.angles.values[:, a].argmax()], abs=found["interval"])


def test_unreliable_samples_are_marked(monkeypatch: pytest.MonkeyPatch) -> None:
    analysis = analyse(walk())
    a = analysis.angles.names.index("right_knee_flexion")

    def right_knee(first: int, stop: int) -> dict[str, Any]:
        trusted = np.ones(analysis.angles.values.shape, dtype=bool)
        trusted[first:stop, a] = False
        changed = replace(analysis, angles=replace(analysis.angles, trusted=trusted))
        groups = angle_curves(changed, slice(None))["groups"]
        series = {(group["name"], one["side"]): one for group in groups for one in group["series"]}
        found: dict[str, Any] = series.pop(("knee flexion", "right"))
        assert not any("doubtful" in other for other in series.values())
        return found

    assert right_knee(20, 30)["doubtful"] == [(20, 30)]
    monkeypatch.setattr(plot_data, "MOST_SAMPLES", 68)  # intervals of five frames, two samples of each
    assert right_knee(20, 30)["doubtful"] == [(8, 12)]
    partly = right_knee(20, 24)  # one of five is reliable, and is shown
    assert "doubtful" not in partly
    only = np.degrees(analysis.angles.values[24, a])
    np.testing.assert_allclose(unpacked(partly["y"], 10)[8:10], [only, only], atol=0.06)


def test_a_long_way_is_played_without_gaps() -> None:
    motion = walk()
    far = motion.poses.p_world_joint + np.linspace(0, 200, len(motion.times))[:, None, None] * [1.0, 0, 0]
    player = player_data(replace(motion, poses=replace(motion.poses, p_world_joint=far)), slice(None), floor=0.0)
    p = unpacked(player["p"], player["scale"], (len(motion.times), -1, 3))
    step = 1 / player["scale"]
    np.testing.assert_allclose(p - p[:1, :1], far - far[:1, :1], atol=1.01 * step)
    assert step < 0.004


def test_frames_of_any_length_are_bounded() -> None:
    for seconds in (1, 60, 1200, 7200):
        times = np.arange(seconds * 60) / 60
        assert len(times[shown_frames(times)]) <= plot_data.MOST_SHOWN
    assert shown_frames(np.arange(72000) / 60).step == 6


def test_ranges_have_bands_and_headings_have_none() -> None:
    analysis = analyse(replace(walk(), confidence=certain_to(2.0, walk())))
    html = html_of(*range_tables(analysis.ranges, analysis.angles.rows))
    found = {own.name: own for own in analysis.ranges}["right_knee_flexion"]
    half = round(1.96 * float(np.degrees(found.range_sigma)))
    assert half > 0
    assert f"<b>{round(float(np.degrees(found.range)))}</b> ± {half}" in html
    assert "pelvis rotation" not in html
    assert "pelvis tilt" in html
    assert "curve" not in html
    whole = curve_bands(analysis.ranges, 0)
    half = round(float(np.degrees(whole["right_knee_flexion"].half)))
    html = html_of(*range_tables(analysis.ranges, analysis.angles.rows, whole))
    assert f"<small class='curve'>(± {half})</small>" in html
    assert "right: from, to (curve)" in html
    unknown = html_of(*range_tables(analyse(walk()).ranges, analysis.angles.rows))
    assert "±" not in unknown


def test_few_reliable_frames_have_no_range_and_no_difference_of_the_sides() -> None:
    analysis = analyse(replace(walk(), confidence=certain_to(2.0, walk())))

    def knee(right: float, left: float) -> list[str]:
        shares = {"right_knee_flexion": right, "left_knee_flexion": left}
        ranges = [replace(own, trusted_share=shares.get(own.name, 1.0)) for own in analysis.ranges]
        html = html_of(*range_tables(ranges, analysis.angles.rows))
        row = next(row for row in html.split("<tr") if "knee flexion" in row)
        return re.findall(r"<td[^>]*>(.*?)</td>", row)

    assert re.fullmatch(r"[+-]?\d+", knee(1.0, 1.0)[4])
    assert knee(1.0, 0.6)[4] == ""
    assert "<b>" in knee(1.0, 0.6)[2]
    right, ends, *_, peak, _ = knee(0.11, 0.04)
    assert (right, ends, peak) == ("<small>reliable only 11 %</small>", "", "")


def test_the_figure_opens_on_a_frame_in_which_the_person_is_seen() -> None:
    motion = walk()
    valid, observed = motion.poses.valid.copy(), motion.poses.orientation_observed.copy()
    valid[:30] = observed[:30] = False
    provenance = np.full(valid.shape, Provenance.CAMERA, dtype=np.uint8)
    provenance[:30] = Provenance.PRIOR
    poses = replace(motion.poses, valid=valid, orientation_observed=observed, provenance=provenance)
    assert player_data(replace(motion, poses=poses), slice(None), 0.0)["first"] == 30
    assert player_data(replace(motion, poses=poses), slice(None, None, 2), 0.0)["first"] == 15
    assert player_data(motion, slice(None), 0.0)["first"] == 0
    assert "data.times[data.first]" in asset("player.js")


def test_an_uncertain_range_is_a_least_one_without_a_difference_of_the_sides() -> None:
    motion = walk()
    analysis = analyse(replace(motion, confidence=certain_to(2.0, motion)))
    end = UncertainEnd(1.0, np.radians(141.0), np.radians(200.0))
    rows = [replace(row, uncertain_high=end) if row.name == "right_hip_flexion" else row for row in analysis.ranges]
    html = html_of(*range_tables(rows, analysis.angles.rows))
    (hip,) = re.findall(r"<tr[^>]*>(?:(?!</tr>).)*>hip flexion .*?</tr>", html, re.DOTALL)
    assert "<small>the highest 1.0 s is uncertain (up to 141)</small>" in hip
    assert "&gt;= " in hip
    assert re.search(r'data-label="right - left"></td>', hip)


def test_the_way_says_how_far_and_which_way_it_turned() -> None:
    way = analyse(walk()).travel
    text = way_line(way)
    assert text == f"{way.text}."
    turned = replace(way, turned_left=np.pi, turned_left_sigma=np.radians(5.0), observed_share=0.5)
    text = way_line(turned)
    assert "turning 180 ± 10° left" in text
    assert "turns within their error" in way_line(replace(way, unsure_turns=True))
    assert "position observed in 50 %" in text
    assert "not observed" in way_line(replace(way, path_length=np.nan))


@pytest.mark.parametrize("text", ['"; } </style><script>', "P07\\", "Müller", "a\nb"])
def test_the_foot_of_a_page_cannot_leave_its_string(text: str) -> None:
    written = css_string(text)
    assert re.fullmatch(r'"(?:[A-Za-z0-9]|\\[0-9a-f]+ )*"', written)
    back = re.sub(r"\\([0-9a-f]+) ", lambda found: chr(int(found[1], 16)), written[1:-1])
    assert back == text.replace("\n", "")


def _luminance(colour: str) -> float:
    linear = [
        v / 12.92 if v <= 0.03928 else ((v + 0.055) / 1.055) ** 2.4
        for v in (int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5))
    ]
    return float(np.dot([0.2126, 0.7152, 0.0722], linear))


def test_texts_have_enough_contrast_in_light_and_dark() -> None:
    schemes = re.findall(r":root \{(.*?)\}", asset("page.css"), re.DOTALL)
    assert len(schemes) == 2
    for scheme in schemes:
        colours = dict(re.findall(r"--([\w-]+): (#[0-9a-f]{6})", scheme))
        for text in ("ink", "soft", "right", "left", "pass", "plausible", "warn", "fail", "not-checked"):
            for ground in ("paper", "panel"):
                light, dark = sorted((_luminance(colours[text]), _luminance(colours[ground])), reverse=True)
                assert (light + 0.05) / (dark + 0.05) >= 4.5, (text, ground)


def test_gait_is_shown_only_where_it_is_gait() -> None:
    analysis = analyse(walk())
    assert analysis.gait.is_gait
    html = html_of(gait_table(analysis.gait))
    mean, spread, strides = analysis.gait.summary["right"]["stride_time"]
    assert f'<td data-label="right">{mean:.2f} ± {spread:.2f} ({strides})</td>' in html
    assert len(cycle_curves_data(analysis)["groups"]) > 10
    short = analyse(walk()[:60])
    assert not short.gait.is_gait
    assert cycle_curves_data(short)["groups"] == []

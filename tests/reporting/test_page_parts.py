"""Parts of the report page: names of angles, thinned curves, tables, colours, ranges with bands."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from clinical_support import walk
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from markupsafe import Markup
from report_support import certain_to, unpacked

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.clinical.analysis import analyse
from rtof_kin.clinical.angle_table import angle_table
from rtof_kin.clinical.range_of_motion import UncertainEnd
from rtof_kin.data.poses import Provenance
from rtof_kin.reporting import plot_data
from rtof_kin.reporting.angle_names import angle_name, side_and_name
from rtof_kin.reporting.audit_results import Grade
from rtof_kin.reporting.document import Document, Section, Table, badge, page
from rtof_kin.reporting.html import asset, css_string
from rtof_kin.reporting.page import gait_table, range_tables, way_line
from rtof_kin.reporting.plot_data import (
    angle_curves,
    cycle_curves_data,
    envelope_frames,
    player_data,
    shown_frames,
    widest_bands,
)


def html_of(*parts: Any) -> str:
    """A page of these parts alone, without its style."""
    return page(Document("x", "x", "x", sections=[Section("x", "x", parts)])).partition("</style>")[2]


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
    for packed, given_ in (
        (right["y"], analysis.angles.values[:, a]),
        (right["half"], 1.96 * analysis.angles.sigma[:, a]),
    ):
        values = unpacked(packed, 10)
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


def test_good_poor_and_wrong_have_other_words_signs_and_shapes() -> None:
    grades = (Grade.PASS, Grade.WARN, Grade.FAIL)
    assert [*map(badge, grades)] == ["good", "use with care", "do not use"]
    assert [badge(grade).grade for grade in grades] == ["pass", "warn", "fail"]
    style = asset("page.css")
    signs = re.findall(r'\.grade\.(pass|warn|fail)::before \{ content: "(.+?)"', style)
    assert len({sign for _, sign in signs}) == 3
    assert ".grade.fail { background: var(--fail)" in style


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
    assert f"{way.path_length:.1f} m along its path" in text
    assert "without turns" in text
    turned = replace(way, turned_left=np.pi, turned_left_sigma=np.radians(5.0), observed_share=0.5)
    text = way_line(turned)
    assert "turning 180 ± 10° left" in text
    assert "turns within their error" in way_line(replace(way, unsure_turns=True))
    assert "position observed in 50 %" in text
    assert "not observed" in way_line(replace(way, path_length=np.nan))


def test_tables_have_scopes_labels_and_captions() -> None:
    rows, attributes = [(Markup("<i>x</i>"), "1")], [{"data-in": "isb"}]
    html = html_of(Table(("a <b>", "value"), rows, "c & d", row_headers=True, attributes=attributes))
    assert '<th scope="col">a &lt;b&gt;</th>' in html
    assert '<tr data-in="isb"><th scope="row"><i>x</i></th><td data-label="value">1</td></tr>' in html
    assert "<caption>c &amp; d</caption>" in html
    assert html.count("<tr") == html.count("</tr>") == 2


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
        for text in ("ink", "soft", "right", "left", "pass", "warn", "fail", "not-checked"):
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

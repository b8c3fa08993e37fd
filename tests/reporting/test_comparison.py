"""A comparison in words, as files and as a page in a browser."""

from __future__ import annotations

import csv
import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from browser_support import BrowserPage
from clinical_support import walk
from comparison_support import one
from report_support import BROWSER, Page, certain_to, folder_of, plotted_data, unpacked

from rtof_kin.clinical.comparison import Compared, Comparison, agreement, compare
from rtof_kin.core.errors import FileFormatError
from rtof_kin.formats.opensim import write_mot
from rtof_kin.reporting.comparison import distinct, document, read_compared
from rtof_kin.reporting.document import page, write_files

KNEE, HIP, ELBOW = "right_knee_flexion", "left_hip_flexion", "right_elbow_flexion"
TIMES = np.arange(300) / 60
WAVE = 30 + 20 * np.sin(2 * np.pi * TIMES)
COLUMNS_A = {KNEE: WAVE, HIP: WAVE / 2, ELBOW: WAVE + 20}
COLUMNS_B = {KNEE: WAVE + 15, HIP: WAVE / 2 - 0.4, ELBOW: WAVE + 20}


def found_in_time(a: Compared, b: Compared, shift: float = 0.0) -> Comparison:
    return compare(a, b, "time", shift=shift, alignment=agreement(a, b, shift))


@pytest.fixture(scope="module")
def planted_change() -> Comparison:
    """The right knee bends 15 degrees more in B; names have markup."""
    a, b = one("<b>before</b>", TIMES, COLUMNS_A, 2.0), one("after & </script>", TIMES, COLUMNS_B, 2.0)
    return found_in_time(a, b)


def opening(found: Comparison, why: str = "") -> list[str]:
    return list(document(found, why).plain()["sentences"])


def said(found: Comparison, why: str = "") -> str:
    return " ".join([*opening(found, why), *document(found, why).cautions])


# --- sentences -----------------------------------------------------------------------------------


def test_first_lines_say_what_how_and_what_changed(planted_change: Comparison) -> None:
    lines = opening(planted_change, "both are alike")
    assert lines[0].startswith("A is <b>before</b>, B is after & </script>; differences are B - A, \u00b1 half of the ")
    assert lines[0].endswith("the 95 % interval of the angle alone.")
    assert "same instants, 0.00 to 4.98 s" in lines[1]
    assert "100 % of the frames, by angle, are observed" in lines[1]
    assert "Chosen because both are alike." in lines[1]
    assert "1 of 3 angles has changed" in lines[2]
    assert "right knee flexion (mean) by +15.0 \u00b1 5.5 deg" in lines[2]


def test_not_shown_is_told_from_equal() -> None:
    a, b = one("a", TIMES, COLUMNS_A, 2.0), one("b", TIMES, COLUMNS_A | {KNEE: WAVE + 3}, 2.0)
    text = said(found_in_time(a, b))
    assert "None of 3 angles is shown to have changed" in text
    assert "not the same as equal: a change of the mean below 7" in text


def test_identical_motions_are_called_so_first() -> None:
    a = one("a", TIMES, COLUMNS_A, 2.0)
    lines = opening(found_in_time(a, replace(a, name="b")))
    assert lines[0].startswith("A and B have the same values")


def test_other_movement_is_doubted_first() -> None:
    other = {name: 30 + 20 * np.sin(np.pi * 1.7 * TIMES + k) for k, name in enumerate(COLUMNS_A)}
    found = found_in_time(one("a", TIMES, COLUMNS_A, 2.0), one("b", TIMES, other, 2.0))
    assert opening(found)[0].startswith("The curves hardly agree")


def test_a_better_shift_is_pointed_out_and_a_used_one_is_stated() -> None:
    chirp = {name: 30 + 20 * np.sin(2 * np.pi * TIMES * (1 + TIMES / 5) + k) for k, name in enumerate(COLUMNS_A)}
    a, b = one("a", TIMES, chirp, 2.0), one("b", TIMES - 0.3, chirp, 2.0)
    assert "shifted by +0.30 s: if the clocks differ, use --align" in said(found_in_time(a, b))
    shifted = said(found_in_time(a, b, 0.3))
    assert "with B shifted by +0.300 s" in shifted
    assert "The shift of B is +0.300 \u00b1" in shifted
    assert "--align" not in shifted


def test_missing_bands_and_another_models_zero_are_said() -> None:
    a, b = one("a", TIMES, COLUMNS_A, 2.0), one("b.mot", TIMES, COLUMNS_B, other_system=True)
    text = said(found_in_time(a, b))
    assert "B (b.mot) has no bands and is taken as exact" in text
    assert "The zero of b.mot is that of its own model" in text
    assert "zero" not in said(found_in_time(a, replace(b, own_export=True)))
    neither = said(found_in_time(replace(b, name="a"), b))
    assert "none is tested" in neither
    assert "Neither has bands" in neither


def test_shared_errors_of_one_recording_are_said() -> None:
    a, b = (one(n, TIMES, c, 2.0, recording="demo") for n, c in (("a", COLUMNS_A), ("b", COLUMNS_B)))
    assert "'demo'" in said(found_in_time(a, b))
    assert "share errors" not in said(found_in_time(a, replace(b, recording="other")))


def test_curves_outside_their_bands_are_named() -> None:
    bump = np.where(TIMES < 1.5, 8.0, 0.0)
    a, b = one("a", TIMES, COLUMNS_A, 2.0), one("b", TIMES, COLUMNS_A | {KNEE: WAVE + bump}, 2.0)
    text = said(found_in_time(a, b))
    assert "None of 3 angles" in text
    assert "more than their 95 % bands allow" in text
    assert "right knee flexion (30 %)" in text


def test_range_alone_warns_of_other_movements() -> None:
    a, b = one("a", TIMES, COLUMNS_A, 2.0), one("b", TIMES, COLUMNS_B, 2.0)
    assert "did something else" in said(compare(a, b, "range"))


# --- files ---------------------------------------------------------------------------------------


def test_table_and_json_have_the_same_numbers(planted_change: Comparison, tmp_path: Path) -> None:
    write_files(document(planted_change, "why"), tmp_path)
    rows = list(csv.DictReader(io.StringIO((tmp_path / "comparison.csv").read_text())))
    data = json.loads((tmp_path / "comparison.json").read_text())
    assert (rows[0]["angle"], rows[0]["measure"], rows[0]["verdict"]) == (KNEE, "mean", "changed")
    assert float(rows[0]["difference_deg"]) == pytest.approx(15, abs=1e-4)
    assert float(rows[0]["difference_sd_deg"]) == pytest.approx(2 * np.sqrt(2), abs=1e-4)
    for row, same in zip(rows, data["angles"], strict=True):
        assert row == {name: "" if value is None else str(value) for name, value in same.items()}
    assert data["sentences"] == opening(planted_change, "why")
    assert data["agreement"]["at_the_shift"] == pytest.approx(1.0, abs=1e-3)


# --- inputs --------------------------------------------------------------------------------------


def test_outputs_motions_and_coordinates_are_read(tmp_path: Path) -> None:
    motion = replace(walk(), confidence=certain_to(2.0, walk()))
    out = folder_of(motion, tmp_path / "out")
    inside = folder_of(motion, tmp_path / "run" / "motion")
    write_mot(tmp_path / "walk.mot", walk())
    found = [read_compared(p) for p in (out, out / "motion.h5", inside.parent, tmp_path / "walk.mot")]
    assert [one.name for one in found] == ["out (rtof)", "out (rtof)", "run (rtof)", "walk.mot"]
    assert [one.recording for one in found] == ["walk", "walk", "walk", ""]
    assert [one.other_system for one in found] == [False, False, False, True]
    assert (
        distinct(found[0], found[1], (out, out / "motion.h5"))[0]
        != distinct(found[0], found[1], (out, out / "motion.h5"))[1]
    )
    paths = (tmp_path / "before" / "out", tmp_path / "after" / "out")
    assert distinct(found[0], found[0], paths) == ("before/out", "after/out")  # a page is passed on
    exported = compare(found[0], found[3], "time")
    assert max(abs(c.difference) for angle in exported.angles for c in angle.changes) < 1e-6
    with pytest.raises(FileFormatError, match=r"motion\.h5"):
        read_compared(tmp_path)


# --- the page ------------------------------------------------------------------------------------


def test_page_is_well_formed_and_escaped(planted_change: Comparison) -> None:
    html = page(document(planted_change))
    parsed = Page(html)
    assert parsed.wrong == []
    assert "<b>before</b>" not in html
    assert html.count("</script>") == 2
    assert "changed" in parsed.text["differences"]
    assert "15.0" in parsed.text["errors"]


def test_curves_are_those_of_the_motions(planted_change: Comparison) -> None:
    data = plotted_data(page(document(planted_change)))
    overlay, difference = data["groups"][:2]
    assert overlay["name"] == "right knee flexion"
    assert [s["side"] for s in overlay["series"]] == ["A", "B"]
    a, b = (unpacked(s["y"], 10) for s in overlay["series"])
    np.testing.assert_allclose(a, WAVE[::2], atol=0.051)
    np.testing.assert_allclose(b - a, 15, atol=0.11)
    np.testing.assert_allclose(unpacked(difference["series"][0]["y"], 10), 15, atol=0.051)
    np.testing.assert_allclose(unpacked(difference["series"][0]["half"], 10), 1.96 * 2 * np.sqrt(2), atol=0.06)
    assert data["x"][:2] == pytest.approx([0, 1 / 30], abs=1e-4)


@pytest.mark.skipif(BROWSER is None, reason="no browser")
def test_page_draws_in_a_browser_without_requests_at_any_width(planted_change: Comparison, tmp_path: Path) -> None:
    file = tmp_path / "comparison.html"
    file.write_text(page(document(planted_change)), encoding="utf-8")
    with BrowserPage(tmp_path / "profile", 1200, 900) as browser:
        browser.open(file.as_uri())
        browser.until("document.documentElement.dataset.state === 'ready'")
        assert browser.value("document.querySelectorAll('#curve-charts figure').length") == 6
        for kind, dashed in (("A", False), ("B", True)):
            style = browser.value(f"getComputedStyle(document.querySelector('.curve.{kind}')).strokeDasharray")
            assert (style != "none") == dashed
        colours = browser.value("['A', 'B'].map(k => getComputedStyle(document.querySelector('.curve.' + k)).stroke)")
        assert len({*colours}) == 2
        browser.resize(390, 800)
        assert browser.value("document.documentElement.scrollWidth") <= 390
        printed = browser.call("Page.printToPDF", paperWidth=8.27, paperHeight=11.69)
        assert len(printed["data"]) > 10_000
        assert browser.errors == []
        assert [url for url in browser.requests if not url.startswith("file:")] == []

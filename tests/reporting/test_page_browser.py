"""The report page in a real browser: widths, paper, conventions, keyboard, alternative texts."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from dataclasses import replace
from datetime import date
from pathlib import Path

import numpy as np
import pytest
from browser_support import WIDTHS, BrowserPage, needs_browser
from clinical_support import walk
from pypdf import PdfReader
from report_support import certain_to, folder_of

from rtof_kin.clinical.analysis import analyse
from rtof_kin.reporting.audit_results import AuditResult
from rtof_kin.reporting.page import report

pytestmark = needs_browser
READY = "document.documentElement.dataset.state === 'ready'"
PICTURE = "document.getElementById('scene').toDataURL()"
LONG = "Anderson-Featherstonehaugh" * 3
CAUSE = "a long reason that goes on and on, " * 8
SENSORS = [
    {"name": f"S{i}", "segment": name, "lever_arm_m": [0.01, 0.02, 0.03], "rate_hz": 100.0}
    for i, name in enumerate(("LeftUpLeg", "RightUpLeg", "LeftLeg", "RightLeg", "LeftForeArm", "RightForeArm"))
]
INPUTS = {
    "software": "rtof_kin 9.9",
    "session": {"subject": LONG, "operator": "A. Analyst", "date": "2026-01-31", "protocol": "walks, " * 20},
    "subject": {"height_m": 1.7, "mass_kg": 70.0},
    "camera": {"width_px": 1920, "height_px": 1080, "rate_hz": 60.0},
    "sensors": SENSORS,
    "calibration": {"columns": ["quantity", "of", "estimate"], "rows": [["delay", "camera", "0.1 s"]] * 9},
}


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Address of the page of a walk with bands, torques and long texts."""
    motion = replace(walk(), confidence=certain_to(2.0, walk()))
    results = [AuditResult("image", f"error {i}", "Head", 7.0, "px", 2.0, 5.0, note=CAUSE) for i in range(8)]
    folder = folder_of(
        motion, tmp_path_factory.mktemp("page") / "out", inputs=INPUTS, audit=[r.plain() for r in results]
    )
    page = folder / "report.html"
    page.write_text(report(folder, made=date(2026, 2, 3)), encoding="utf-8")
    return page.as_uri()


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[BrowserPage]:
    with BrowserPage(tmp_path_factory.mktemp("browser"), 1280, 900) as page:
        yield page


@pytest.fixture
def opened(browser: BrowserPage, url: str) -> BrowserPage:
    """The page, newly opened on a desktop."""
    browser.resize(1280, 900)
    browser.open("about:blank")
    browser.errors.clear()
    browser.requests.clear()
    browser.open(url)
    browser.until(READY)
    return browser


@pytest.fixture(scope="module")
def paper(browser: BrowserPage, url: str, tmp_path_factory: pytest.TempPathFactory) -> PdfReader:
    """The page as it is printed at first."""
    browser.resize(1280, 900)
    browser.open(url)
    browser.until(READY)
    return PdfReader(browser.pdf(tmp_path_factory.mktemp("paper") / "page.pdf"))


def shown(page: BrowserPage, selector: str) -> str:
    """Text of an element as it is shown."""
    return str(page.value(f"document.querySelector({selector!r}).innerText"))


def printed(paper: PdfReader, last: int = 0) -> list[str]:
    """Text of each printed page, or of the last ones."""
    return [" ".join(one.extract_text().split()) for one in paper.pages[-last:]]


def choose(page: BrowserPage, convention: str) -> None:
    page.value(
        f"(select => {{ select.value = '{convention}'; select.dispatchEvent(new Event('change')); }})"
        "(document.getElementById('convention'))"
    )


@pytest.mark.parametrize("width", WIDTHS)
def test_nothing_is_cut_or_broken_at_any_width(opened: BrowserPage, url: str, width: int, tmp_path: Path) -> None:
    opened.resize(width, 900)
    picture = opened.picture(tmp_path / f"{width}.png")
    assert picture.stat().st_size > 50_000
    assert opened.layout_faults() == []
    opened.value("document.querySelectorAll('details').forEach(details => { details.open = true; })")
    assert opened.layout_faults() == []
    choose(opened, "opensim")
    assert opened.layout_faults() == []
    if width == WIDTHS[0]:
        assert opened.small_targets() == []
    assert opened.errors == []
    assert opened.requests == [url]


def test_a_phone_shows_the_main_angles_within_a_few_screens(opened: BrowserPage) -> None:
    height = "document.documentElement.scrollHeight"
    count = "[...document.querySelectorAll('#angle-charts figure')].filter(one => one.checkVisibility()).length"
    every = opened.value(count)
    opened.resize(WIDTHS[0], 900)
    short, few = opened.value(height), opened.value(count)
    assert short < 8500  # long names, eight failures and a gait: the demo has 5,900
    assert few < every / 2
    opened.value("document.querySelector('label[for=all-angles]').click()")
    assert opened.value(count) == every
    assert opened.value(height) > short + 2000


def test_paper_has_at_most_six_pages_without_what_is_folded(paper: PdfReader) -> None:
    texts = printed(paper)
    assert len(texts) <= 6
    sides = paper.pages[0].mediabox[2:]
    assert [round(float(side) / 72 * 25.4) for side in sides] == [210, 297]
    whole = " ".join(texts)
    assert "warns above" not in whole  # audit
    assert "to be filled in" not in whole  # checklist
    assert "Findings" in texts[0]
    for number, text in enumerate(texts, 1):
        assert f"{number} / {len(texts)}" in text
        assert "2026-01-31" in text
    names = ("hip flexion", "knee flexion", "ankle dorsiflexion", "elbow flexion")
    (table,) = [text for text in texts if "Right and left" in text]
    rows = table[table.index("Right and left") :]
    assert all(f"{name} +" in rows for name in names)


def test_folded_parts_are_printed_if_asked_for(opened: BrowserPage, url: str, tmp_path: Path) -> None:
    opened.open("about:blank")
    opened.open(f"{url}#print-all")
    opened.until(READY)
    texts = printed(PdfReader(opened.pdf(tmp_path / "page.pdf")), last=7)
    assert sum("warns above" in text for text in texts) > 1  # the head of the audit is repeated
    assert "to be filled in" in " ".join(texts)
    assert opened.value("document.querySelectorAll('details[open]').length") == 0


def test_paper_is_light_even_if_the_screen_is_dark(opened: BrowserPage) -> None:
    colour = "getComputedStyle(document.body).backgroundColor"
    dark = [{"name": "prefers-color-scheme", "value": "dark"}]
    opened.call("Emulation.setEmulatedMedia", features=dark)
    assert opened.value(colour) == "rgb(20, 24, 27)"
    opened.call("Emulation.setEmulatedMedia", media="print", features=dark)
    assert opened.value(colour) == "rgb(255, 255, 255)"
    opened.call("Emulation.setEmulatedMedia", media="", features=[])


def test_names_and_signs_follow_the_chosen_convention(opened: BrowserPage) -> None:
    usual = shown(opened, "#ranges")
    for text in ("knee flexion", "shoulder elevation", "pelvis tilt", "spine flexion"):
        assert text in usual
    assert not any(text in usual for text in ("knee_angle", "shoulder abduction", "pelvis_tilt"))
    choose(opened, "xzy")
    assert "shoulder abduction" in shown(opened, "#ranges")
    assert "shoulder elevation" not in shown(opened, "#ranges")
    choose(opened, "opensim")
    other = shown(opened, "#ranges")
    for text in ("knee_angle_r, _l", "pelvis_tilt", "lumbar_extension", "no OpenSim coordinate"):
        assert text in other
    assert "knee flexion" not in other
    found = {own.name: own for own in analyse(walk()).ranges}["spine_flexion"]
    low, high = (round(float(np.degrees(angle))) for angle in (found.low, found.high))
    assert f"{low} to {high}" in usual
    assert f"{-high} to {-low}" in other
    assert "lumbar_extension" in shown(opened, "#angle-charts")


def test_the_curve_of_the_opposite_sign_is_turned_over(opened: BrowserPage) -> None:
    middle = (
        "(name => [...document.querySelectorAll('#angle-charts svg')]"
        ".find(one => one.ariaLabel.startsWith(name)).ariaLabel)"
    )
    usual, turned = (
        re.findall(r"(lowest|highest) (-?\d+) deg at ([\d.]+) s", opened.value(f"{middle}('{name}')"))
        for name in ("spine flexion", "lumbar_extension")
    )
    (_, low, first), (_, high, last) = usual
    assert [(text, -int(degrees), at) for text, degrees, at in turned] == [
        ("lowest", int(high), last),
        ("highest", int(low), first),
    ]


def test_each_chart_has_its_extremes_in_words(opened: BrowserPage) -> None:
    labels = opened.value("[...document.querySelectorAll('figure svg')].map(one => one.ariaLabel)")
    assert all("lowest" in label or "not observed" in label for label in labels)
    (knee,) = [label for label in labels if label.startswith("knee flexion") and " s," in label]
    angles = analyse(walk()).angles
    values = np.degrees(angles["right_knee_flexion"])
    # The curve has a half of the frames.
    lowest = re.search(r"right: lowest (-?\d+) deg at ([\d.]+) s, highest (-?\d+) deg at ([\d.]+) s", knee)
    assert lowest
    assert float(lowest[1]) == pytest.approx(values.min(), abs=2)
    assert float(lowest[3]) == pytest.approx(values.max(), abs=2)
    assert float(lowest[4]) == pytest.approx(angles.times[values.argmax()], abs=0.1)


def test_the_scene_turns_by_keys_and_buttons_and_does_not_trap_the_page(opened: BrowserPage) -> None:
    assert opened.value("getComputedStyle(document.getElementById('scene')).touchAction") == "pan-y pinch-zoom"
    opened.value("document.getElementById('scene').scrollIntoView({block: 'center'})")
    box = "(box => [box.x + box.width / 2, box.y + box.height / 2])"
    x, y = opened.value(f"{box}(document.getElementById('scene').getBoundingClientRect())")
    seen, before = [opened.value(PICTURE)], opened.value("scrollY")
    opened.call("Input.dispatchMouseEvent", type="mouseWheel", x=x, y=y, deltaX=0, deltaY=120)
    opened.until(f"scrollY > {before}")
    assert opened.value(PICTURE) == seen[0]
    opened.value("document.getElementById('scene').focus()")
    for key in ("ArrowLeft", "ArrowUp", "+"):
        opened.press(key)
        seen.append(opened.value(PICTURE))
    for key in ("ArrowRight", "-"):
        opened.value(f"document.querySelector('.views button[data-key=\"{key}\"]').click()")
        seen.append(opened.value(PICTURE))
    assert len(set(seen)) == len(seen)


def stroke(page: BrowserPage, right: float, down: float) -> None:
    """Move a finger over the middle of the scene."""
    page.value("document.getElementById('scene').scrollIntoView({block: 'center'})")
    place = "(box => [box.x + box.width / 2, box.y + box.height / 2])"
    x, y = page.value(f"{place}(document.getElementById('scene').getBoundingClientRect())")
    for i in range(11):
        points = [{"x": x + right * i / 10, "y": y + down * i / 10}]
        page.call("Input.dispatchTouchEvent", type="touchMove" if i else "touchStart", touchPoints=points)
    page.call("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])


def test_a_finger_turns_the_scene_to_the_sides_and_scrolls_the_page(opened: BrowserPage) -> None:
    opened.resize(390, 800)
    opened.call("Emulation.setTouchEmulationEnabled", enabled=True)
    opened.value("document.getElementById('scene').scrollIntoView({block: 'center'})")
    before, seen = opened.value("scrollY"), opened.value(PICTURE)
    stroke(opened, 80, 0)
    opened.until(f"{PICTURE} !== {seen!r}")
    assert opened.value("scrollY") == before
    stroke(opened, 0, -150)
    opened.until(f"scrollY > {before} + 50")
    opened.call("Emulation.setTouchEmulationEnabled", enabled=False)


def test_nothing_moves_until_it_is_played_and_calm_is_kept(opened: BrowserPage) -> None:
    clock = "document.getElementById('clock')"
    start = opened.value(f"{clock}.textContent")
    time.sleep(0.3)
    assert opened.value(f"{clock}.textContent") == start
    calm = [{"name": "prefers-reduced-motion", "value": "reduce"}]
    opened.call("Emulation.setEmulatedMedia", features=calm)
    opened.value(
        f"window.seen = []; new MutationObserver(() => seen.push(performance.now()))"
        f".observe({clock}, {{childList: true}}); document.getElementById('play').click()"
    )
    opened.until("seen.length >= 4")
    assert opened.value("seen[3] - seen[0]") > 1300  # ms
    opened.call("Emulation.setEmulatedMedia", features=[])


def test_the_keyboard_reaches_the_contents_first_and_the_focus_is_visible(opened: BrowserPage) -> None:
    outline = "getComputedStyle(document.activeElement).outlineStyle"
    names = []
    for _ in range(4):
        opened.call("Input.dispatchKeyEvent", type="keyDown", key="Tab", code="Tab", windowsVirtualKeyCode=9)
        names.append(opened.value("document.activeElement.textContent"))
        assert opened.value(outline) == "solid"
    assert names == ["Skip to the ranges of motion", "Ranges", "Curves", "Motion in 3D"]


def test_parts_have_names_and_tables_have_heads(opened: BrowserPage) -> None:
    assert opened.value("document.querySelectorAll('main, nav[aria-label], header, footer').length") == 4
    titles = (
        "[...document.querySelectorAll('section')]"
        ".map(one => document.getElementById(one.getAttribute('aria-labelledby'))?.textContent)"
    )
    assert all(opened.value(titles))
    assert opened.value("document.querySelectorAll('th:not([scope])').length") == 0
    assert opened.value("[...document.querySelectorAll('tbody tr')].every(row => row.querySelector('th'))")


def test_values_are_read_off_at_the_time_of_the_slider(opened: BrowserPage) -> None:
    caption = "document.querySelector('#angle-charts figcaption').textContent"
    assert "positive" in opened.value(caption)
    opened.value(
        "(slider => { slider.value = 30; slider.dispatchEvent(new Event('input')); })(document.getElementById('time'))"
    )
    assert re.match(r"[\d.]+ s: .*deg", opened.value(caption))

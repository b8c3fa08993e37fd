"""A document and its four writers: terminal, JSON, CSV and the page."""

from __future__ import annotations

import io
import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
from markupsafe import Markup
from matplotlib.figure import Figure as Plot
from report_support import Page
from rich.console import Console

from rtof_kin.core.checks import some
from rtof_kin.core.errors import OutputExistsError
from rtof_kin.reporting.document import Badge, Document, Figure, Section, Table, fixed, number, page, show, write

NAME = Markup("{} <small>bent</small>").format("knee & hip")
TABLE = Table(
    ("angle", "value [deg]", "verdict"),
    [(NAME, 1.23456, Badge("changed", "warn")), ("hip", math.nan, None)],
    "Angles <1>",
    ["a note"],
    digits=(None, 1, None),
    row_headers=True,
    attributes=[{"data-in": "isb"}, {}],
)
DRAWN = Figure("figures/one", "a line <up>", lambda: Plot(figsize=(1, 1)))
WHOLE = Document(
    "study",
    "A <study>",
    "It is <b>so</b>.",
    ["And so."],
    ["Be careful & calm"],
    printed=[TABLE, "and more"],
    sections=[
        Section("parts", "Parts", ["text", ("one", "two"), {"word": "meaning"}, TABLE, DRAWN]),
        Section("rest", "Rest", [Section("", "folded", [Markup("<i>all</i>")], folded=True)]),
    ],
    figures=[DRAWN],
    tables={"study.csv": TABLE},
    facts={"count": 2, "rows": TABLE.records()},
    data={"more.json": [1]},
)


def test_all_files_are_written_once_and_replaced_on_request(tmp_path: Path) -> None:
    write(WHOLE, tmp_path / "out")
    names = {path.relative_to(tmp_path / "out").as_posix() for path in (tmp_path / "out").rglob("*.*")}
    assert names >= {"study.json", "study.csv", "more.json", "study.html", "figures/one.png"}
    data = json.loads((tmp_path / "out" / "study.json").read_text())
    assert data["sentences"] == ["It is <b>so</b>.", "And so."]
    assert (data["headline"], data["cautions"], data["count"]) == (WHOLE.headline, WHOLE.cautions, 2)
    assert data["rows"][1] == {"angle": "hip", "value [deg]": None, "verdict": None}
    rows = (tmp_path / "out" / "study.csv").read_text().splitlines()
    assert rows == ["angle,value [deg],verdict", "knee & hip bent,1.23456,changed", "hip,,"]
    with pytest.raises(OutputExistsError, match="--overwrite"):
        write(WHOLE, tmp_path / "out")
    write(replace(WHOLE, figures=(), sections=()), tmp_path / "out", overwrite=True)
    assert not (tmp_path / "out" / "study.html").exists()


def test_without_facts_the_first_table_tells_the_kind_of_the_folder(tmp_path: Path) -> None:
    plain = replace(WHOLE, facts=None, figures=(), sections=())
    write(plain, tmp_path / "out")
    assert plain.marker == "study.csv"
    assert not (tmp_path / "out" / "study.json").exists()


def test_the_page_is_escaped_well_formed_and_loads_nothing(tmp_path: Path) -> None:
    html = page(WHOLE, {"figures/one": b"PNG"})
    parsed = Page(html)
    assert parsed.wrong == []
    for text in ("A &lt;study&gt;", "It is &lt;b&gt;so&lt;/b&gt;.", "Be careful &amp; calm", "<li>two</li>"):
        assert text in html
    assert '<tr data-in="isb"><th scope="row">knee &amp; hip <small>bent</small></th>' in html
    assert '<td data-label="value [deg]">1.2</td>' in html
    assert '<span class="grade warn">changed</span>' in html
    assert "<caption>Angles &lt;1&gt;</caption>" in html
    assert 'alt="a line &lt;up&gt;"' in html
    assert "<dt>word</dt><dd>meaning</dd>" in html
    assert "<details><summary>folded</summary>" in html
    assert "script-src" not in html
    assert all(value.startswith("data:") for _, name, value in parsed.attributes if name in ("src", "href"))
    assert "was not drawn" in page(WHOLE)


@pytest.mark.parametrize("width", [60, 200])
def test_the_terminal_has_sentences_cautions_and_the_table(width: int) -> None:
    stream = io.StringIO()
    show(WHOLE, Console(file=stream, width=width, markup=False))
    text = stream.getvalue()
    for part in ("It is <b>so</b>.", "caution: Be careful & calm", "value [deg]", "changed", "a note", "and more"):
        assert part in text
    assert "small" not in text


def test_markdown_has_one_line_for_each_row() -> None:
    text = Table(("a", "b"), [("x|y\nz", None)], "T", ["note"]).markdown()
    assert text == "### T\n\n| a | b |\n|---|---|\n| x\\|y z | - |\n\n- note\n"


def test_numbers_have_their_digits_and_no_sign_of_zero() -> None:
    assert [fixed(value, 2, True) for value in (-0.001, 0.126, math.nan)] == ["0.00", "+0.13", ""]
    assert [number(value) for value in (1.23456789, math.nan, math.inf)] == [1.23457, None, None]
    assert some(["a", "b", "c", "d"]) == "a, b, c and 1 more"

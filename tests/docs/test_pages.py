"""Pages of the documentation: their links, pictures and quotations exist."""

from __future__ import annotations

import ast
import re
from collections import defaultdict
from functools import cache
from pathlib import Path

import pytest

import rtof_kin
from rtof_kin.cli import COMMANDS, app, command_names

ROOT = Path(__file__).parents[2]
GENERATED = ("_build", "commands")
PAGES = sorted(
    path
    for path in [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(ROOT / "benchmarks").glob("*.md")]
    if not set(path.relative_to(ROOT).parts) & set(GENERATED)
)
LINK = re.compile(r"(!?)\[([^\]]*)\]\(([^)\s]+)\)")


def text_of(page: Path) -> str:
    """Return a page without its code."""
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    return re.sub(r"`[^`\n]*`", "", text)


def anchors(page: Path) -> set[str]:
    """Return what its headings are called in addresses, as repository pages and MyST do."""
    headings = re.findall(r"^#+ +(.+?) *$", page.read_text(encoding="utf-8"), flags=re.MULTILINE)
    plain = (re.sub(r"[^\w\- ]", "", heading.lower()) for heading in headings)
    return {heading.replace(" ", "-") for heading in plain}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_relative_links_lead_to_files_and_headings(page: Path) -> None:
    missing = []
    for _, _, address in LINK.findall(text_of(page)):
        if "://" in address or address.startswith("mailto:"):
            continue
        name, _, heading = address.partition("#")
        target = (page.parent / name).resolve() if name else page
        if not target.exists() or (heading and target.suffix == ".md" and heading not in anchors(target)):
            missing.append(address)
    assert not missing


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_pictures_have_a_text_for_who_does_not_see_them(page: Path) -> None:
    short = [address for mark, text, address in LINK.findall(text_of(page)) if mark and len(text) < 15]
    assert not short


def test_every_name_of_the_front_door_is_in_the_reference() -> None:
    pages = "\n".join(path.read_text(encoding="utf-8") for path in (ROOT / "docs/reference").glob("*.md"))
    documented = set(re.findall(r"^\.\. auto\w+:: rtof_kin\.(\w+)$", pages, flags=re.MULTILINE))
    assert documented == set(rtof_kin.__all__)


def command_line() -> str:
    return (ROOT / "docs/command_line.md").read_text("utf-8")


def test_every_command_has_a_row_under_what_it_is_for() -> None:
    parts = re.split(r"^### (.*)$", command_line().partition("## Options")[0], flags=re.MULTILINE)
    rows = {title.lower(): re.findall(r"^\| `rtof-kin ([\w-]+)", text, re.MULTILINE) for title, text in batched(parts)}
    assert rows == {purpose: list(commands) for purpose, commands in COMMANDS.items()}


def batched(parts: list[str]) -> list[tuple[str, str]]:
    return list(zip(parts[1::2], parts[2::2], strict=True))


def test_an_option_of_several_commands_has_one_row_with_its_meaning() -> None:
    rows = re.findall(r"^\| `(--[\w-]+)[^`]*` \| .+ \| (.+) \|$", command_line(), re.MULTILINE)
    listed = {option: set(re.findall("`([^`]+)`", commands)) for option, commands in rows}
    found = defaultdict[str, set[str]](set)
    for name in command_names():
        whole = app([name])[name]
        for command in (whole, *(whole[inner] for inner in whole if not inner.startswith("-"))):
            for argument in command.assemble_argument_collection():
                if not argument.field_info.is_positional:
                    found[argument.names[0]].add(name)
    assert len(listed) == len(rows)
    assert {option: names for option, names in found.items() if option in listed or len(names) > 1} == listed


@cache
def literals() -> str:
    """Return all texts in the code, docstrings left out, a line each, with ... for each value put in."""
    found = []
    for path in (ROOT / "rtof_kin").rglob("*.py"):
        docstrings = set[int]()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):  # a statement before its value
            if isinstance(node, ast.Expr):
                docstrings.add(id(node.value))
            elif isinstance(node, ast.JoinedStr):
                parts = (part.value if isinstance(part, ast.Constant) else "..." for part in node.values)
                found.append("".join(map(str, parts)))
            elif isinstance(node, ast.Constant) and id(node) not in docstrings:
                found.append(str(node.value))
    return "\n".join(text.replace("\n", " ") for text in found)


def said(quotation: str) -> bool:
    """Return whether a text of the code has all parts of a quotation in their order."""
    parts = (re.escape(part.strip()) for part in quotation.split("..."))
    return re.search(".*".join(parts), literals()) is not None


def quotations(page: str) -> list[str]:
    rows = re.findall(r"^\| (.*?) \|", (ROOT / "docs" / page).read_text(encoding="utf-8"), flags=re.MULTILINE)
    return [quotation for row in rows for quotation in re.findall(r'"([^"]+)"', row)]


def test_the_program_says_what_troubleshooting_quotes() -> None:
    quoted = quotations("troubleshooting.md")
    assert len(quoted) > 40
    assert [quotation for quotation in quoted if not said(quotation)] == []


def test_a_message_that_nobody_prints_is_found() -> None:
    assert not said("the cat sat on ... of the camera")

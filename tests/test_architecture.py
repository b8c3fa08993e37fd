"""The pages for engineers are of today's code: the drawing, the links into files, the decisions."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

from docs.architecture_drawing import PICTURE, PLACES, drawing
from docs.recording_fields import PAGE, page
from tests.test_layers import FOLDERS

DOCS = Path(__file__).parent.parent / "docs"
DECISIONS = sorted(DOCS.glob("decisions/0*.md"))
SECTIONS = ["Context", "Decision", "Consequences", "Evidence", "Alternatives", "When to revisit"]


def defined(path: Path) -> set[str]:
    """Names that a module defines, methods with their class, and its own name."""
    names = {path.stem}
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ClassDef | ast.FunctionDef):
            names.add(node.name)
            names |= {
                f"{node.name}.{one.name}" for one in ast.iter_child_nodes(node) if isinstance(one, ast.FunctionDef)
            }
        elif isinstance(node, ast.AnnAssign | ast.Assign):
            names |= {ast.unparse(one) for one in getattr(node, "targets", [getattr(node, "target", None)])}
    return names


def links(page: Path) -> list[tuple[str, str]]:
    return re.findall(r"\[([^\]]+)\]\((?!https?:)([^)#]+)", page.read_text(encoding="utf-8").replace("\n", " "))


def test_drawing_is_that_of_the_imports() -> None:
    assert set(PLACES) == {*FOLDERS, "lifting"}
    assert PICTURE.read_text(encoding="utf-8") == drawing(), "run python -m docs.architecture_drawing"


def test_table_of_folders_is_in_the_order_of_imports() -> None:
    rows = re.findall(r"^\| `(\w+)/` \|", (DOCS / "architecture.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert rows == list(FOLDERS)


@pytest.mark.parametrize("name", ["architecture.md", "development.md", "recording.md", "decisions/index.md"])
def test_links_lead_to_files_and_to_what_they_name(name: str) -> None:
    for text, target in links(DOCS / name):
        path = ((DOCS / name).parent / target).resolve()
        assert path.exists(), f"{name}: {target}"
        if path.suffix == ".py" and text.startswith("`"):
            assert text.strip("`") in defined(path), f"{name}: {text} is not in {target}"


def test_fields_in_the_page_of_recordings_are_those_of_the_schema() -> None:
    assert PAGE.read_text(encoding="utf-8") == page(), "run python -m docs.recording_fields"


@pytest.mark.parametrize("path", DECISIONS, ids=lambda path: path.stem)
def test_a_decision_is_short_and_complete_and_its_files_exist(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    assert re.findall(r"^## (.+)$", text, re.MULTILINE) == SECTIONS
    assert len(text.splitlines()) <= 40
    for _, target in links(path):
        assert (path.parent / target).resolve().exists(), target


def test_index_lists_all_decisions() -> None:
    listed = [target for _, target in links(DOCS / "decisions/index.md") if target.startswith("0")]
    assert sorted(listed) == [path.name for path in DECISIONS]
    assert [path.name[:4] for path in DECISIONS] == [f"{i + 1:04}" for i in range(len(DECISIONS))]

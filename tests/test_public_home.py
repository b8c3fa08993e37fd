"""Workflows, changelog and citation of a public home agree with the package."""

from __future__ import annotations

import re
import runpy
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).parents[1]
pytestmark = pytest.mark.skipif(not (ROOT / ".github").exists(), reason="a source distribution has no .github")
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
YAML = sorted([*(ROOT / ".github").rglob("*.yml"), ROOT / "CITATION.cff"])
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def notes() -> dict[str, Any]:
    return runpy.run_path(str(ROOT / ".github" / "release_notes.py"))


def read(path: Path) -> Any:
    return yaml.safe_load(path.read_text(encoding="utf-8"))


def steps(workflow: Path) -> list[dict[str, Any]]:
    return [step for job in read(workflow)["jobs"].values() for step in job["steps"]]


@pytest.mark.parametrize("path", YAML, ids=lambda path: path.name)
def test_yaml_is_read(path: Path) -> None:
    assert isinstance(read(path), dict)


@pytest.mark.parametrize("workflow", WORKFLOWS, ids=lambda path: path.name)
def test_make_targets_of_a_workflow_exist(workflow: Path) -> None:
    called = re.findall(r"\bmake ([\w-]+)", "\n".join(step.get("run", "") for step in steps(workflow)))
    targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    assert set(called) <= set(targets)
    assert called or workflow.name == "codeql.yml"


def test_the_attested_bill_of_materials_is_the_one_that_make_writes() -> None:
    (attested,) = (
        step["with"]["sbom-path"]
        for step in steps(ROOT / ".github" / "workflows" / "release.yml")
        if "sbom-path" in step.get("with", {})
    )
    assert f"-o {attested} " in (ROOT / "Makefile").read_text(encoding="utf-8")


@pytest.mark.parametrize("workflow", WORKFLOWS, ids=lambda path: path.name)
def test_actions_are_pinned_and_permissions_stated(workflow: Path) -> None:
    used = [step["uses"] for step in steps(workflow) if "uses" in step]
    assert used
    assert all(re.fullmatch(r"[\w./-]+@[0-9a-f]{40}", action) for action in used)
    assert read(workflow)["permissions"] in ({}, {"contents": "read"})


def test_the_matrix_has_the_pythons_of_the_classifiers() -> None:
    matrix = read(ROOT / ".github" / "workflows" / "tests.yml")["jobs"]["test"]["strategy"]["matrix"]
    named = [c.rpartition(" ")[2] for c in PROJECT["classifiers"] if re.search(r"Python :: 3\.\d+$", c)]
    assert matrix["python"] == named
    assert PROJECT["requires-python"] == f">={named[0]}"


def test_the_gate_needs_no_workflow() -> None:
    assert ".github" not in (ROOT / ".ci" / "run").read_text(encoding="utf-8")


def test_changelog_and_citation_are_of_this_version() -> None:
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    released = re.findall(r"^## \[(\d+\.\d+\.\d+)\] - (\d{4}-\d{2}-\d{2})$", changelog, re.MULTILINE)
    assert released == sorted(released, key=lambda one: [int(n) for n in one[0].split(".")], reverse=True)
    citation = read(ROOT / "CITATION.cff")
    assert released[0] == (PROJECT["version"], str(citation["date-released"]))
    assert citation["version"] == PROJECT["version"]
    kinds = set(re.findall(r"^### (.+)$", changelog, re.MULTILINE))
    assert kinds <= {"Added", "Changed", "Deprecated", "Removed", "Fixed", "Security"}


def test_notes_of_a_release_are_its_section(capsys: pytest.CaptureFixture[str]) -> None:
    changelog = "# Changelog\n\n## [1.2.0] - 2026-01-02\n\nNew.\n\n## [1.1.0] - 2026-01-01\n\nOld.\n"
    assert notes()["section"](changelog, "1.2.0") == "New."
    assert notes()["section"](changelog + "\n[1.1.0]: https://example.org\n", "1.1.0") == "Old."
    assert notes()["section"](changelog, "1.2") == ""
    assert notes()["main"](f"v{PROJECT['version']}") == 0
    assert capsys.readouterr().out.strip()
    assert notes()["main"]("v9.9.9") == 1
    assert "the tag is v9.9.9" in capsys.readouterr().err

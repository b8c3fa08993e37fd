"""What the engine says, in the words of a page."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import rtof_kin
from rtof_kin.app.texts import worded

SHOWN = [
    "calibration",
    "core",
    "data",
    "formats",
    "inertial",
    "reconstruction",
    "recording",
    "setup",
    "solve",
    "vision",
    "body",
]
"""Packages whose sentences a page can show: as an error, or as what was found."""
ELSEWHERE = (
    "--fix -o OUT",  # of `inspect`
    "--calibrate-only",  # of a calibration that is given
    "--overwrite",  # a page replaces its own results
    "ray start",
    "pip install",  # not an option, and the only remedy
    "gait-reference",
    "--finish",
    "--only recording",  # of a recording that is there without its index
    "made by rtof-kin run",  # the title of a file
    "--subject",  # a page sets it
    "--lift",
)
"""Parts of sentences that no page shows."""
OPTION = re.compile(r"(?<![\w-])(--[a-z][\w-]+|-o)\b|rtof-kin")


def sentences() -> Iterator[tuple[str, str]]:
    """Place and text of each string that is no documentation, with 7 for what is filled in."""
    for package in SHOWN:
        for path in sorted(Path(rtof_kin.__file__).parent.glob(f"{package}/**/*.py")):
            if not OPTION.search(text := path.read_text(encoding="utf-8")):
                continue
            tree = ast.parse(text)
            inside = {id(part) for node in ast.walk(tree) if isinstance(node, ast.JoinedStr) for part in node.values}
            documentation = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
            for node in ast.walk(tree):
                if id(node) in inside | documentation:
                    continue
                if isinstance(node, ast.Constant) and isinstance(node.value, str):
                    yield f"{path.name}:{node.lineno}", node.value
                elif isinstance(node, ast.JoinedStr):
                    parts = (str(part.value) if isinstance(part, ast.Constant) else "7" for part in node.values)
                    yield f"{path.name}:{node.lineno}", "".join(parts)


def test_no_sentence_of_the_engine_names_an_option_of_the_command_line() -> None:
    named = {place: text for place, text in sentences() if " " in text and OPTION.search(text)}
    assert len(named) > 20
    left = {place: said for place, text in named.items() if OPTION.search(said := worded(text))}
    known = [word for word in ELSEWHERE if any(word in said for said in left.values())]
    unknown = {place: said for place, said in left.items() if not any(word in said for word in ELSEWHERE)}
    assert unknown == {}
    assert known == [*ELSEWHERE]  # or this list is out of date

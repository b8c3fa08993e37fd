"""Docstrings of this package for autodoc: several arguments in a line, names in single backticks."""

from __future__ import annotations

import inspect
import re
from typing import Any

from docutils import nodes
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from sphinx.util.inspect import TypeAliasForwardRef
from sphinx.util.nodes import make_refnode

SECTION = re.compile(r"^(Args|Raises|Yields|Returns|Attributes):$")
DATA, COLON = ("attribute", "property", "data"), "\ufff0"
ERROR = re.compile(r"(?<=[.:;]) (?=[A-Z]\w+: )")


def split_arguments(app: Sphinx, what: str, name: str, subject: Any, options: Any, lines: list[str]) -> None:
    """Give each argument and each error of a Google-style docstring a line of its own."""
    try:
        parameters = list(inspect.signature(subject).parameters) if callable(subject) else []
    except (TypeError, ValueError):
        parameters = []
    one = "|".join(map(re.escape, parameters)) or "-"
    starts = re.compile(rf"(?<=[.;]) (?=(?:{one})(?:, (?:{one}))*: )")
    section, changed = "", list[str]()
    for line in _joined(lines):
        if found := SECTION.match(line):
            section = found[1]
        elif line and not line.startswith(" "):
            section = ""
        pattern = {"Args": starts, "Raises": ERROR}.get(section)
        indent = line[: len(line) - len(line.lstrip())]
        parts = pattern.split(line.strip()) if pattern and line.startswith(" ") else [line.strip()]
        changed += [f"{indent}{part}" if part else "" for part in parts]
    lines[:] = [_escaped(line) for line in changed]
    if what in DATA:  # else napoleon reads the words before a colon as a type
        lines[:] = [line.replace(":", COLON) for line in lines]


def restore_colons(app: Sphinx, what: str, name: str, subject: Any, options: Any, lines: list[str]) -> None:
    """Undo what `split_arguments` did to the docstrings of fields, after napoleon."""
    if what in DATA:
        lines[:] = [line.replace(COLON, ":") for line in lines]


def _joined(lines: list[str]) -> list[str]:
    """Return the lines with each entry of Args and Raises, which may be wrapped, in one."""
    joined, section = list[str](), ""
    for line in lines:
        if found := SECTION.match(line):
            section = found[1]
        elif line and not line.startswith(" "):
            section = ""
        if section in ("Args", "Raises") and line.startswith("     ") and joined[-1].strip():
            joined[-1] += " " + line.strip()
        else:
            joined.append(line)
    return joined


def _escaped(line: str) -> str:
    """Return a line without accidental substitutions and references outside of code."""
    parts = re.split(r"(``?[^`]+``?)", line)
    return "".join(
        part if i % 2 else re.sub(r"(?<=\w)_(?!\w)", r"\\_", re.sub(r"([|*])", r"\\\1", part))
        for i, part in enumerate(parts)
    )


def resolve_by_name(
    app: Sphinx, env: BuildEnvironment, node: pending_xref, contnode: nodes.TextElement
) -> nodes.Element | None:
    """Link a name of this package that is documented under another module, such as the front door's."""
    if node.get("refdomain") != "py":
        return None
    objects = env.domains["py"].objects
    parts = node["reftarget"].split(".")
    for tail in (".".join(parts[start:]) for start in range(len(parts))):
        found = _by_tail(env).get(tail)
        if found is not None:
            return make_refnode(
                app.builder, node["refdoc"], objects[found].docname, objects[found].node_id, contnode, found
            )
    return None


def _by_tail(env: BuildEnvironment) -> dict[str, str]:
    """Return the full name of what is documented, by each of its ends that nothing else has."""
    objects = env.domains["py"].objects
    if len(objects) != getattr(env, "rtof_kin_documented", 0):
        tails: dict[str, set[str]] = {}
        for name in objects:
            parts = name.split(".")
            for start in range(len(parts)):
                tails.setdefault(".".join(parts[start:]), set()).add(name)
        env.rtof_kin_documented = len(objects)
        env.rtof_kin_tails = {tail: next(iter(names)) for tail, names in tails.items() if len(names) == 1}
    return env.rtof_kin_tails


def dashes(app: Sphinx, document: nodes.document) -> None:
    """Write the dash before what a parameter is."""
    for text in list(document.findall(nodes.Text)):
        if text == " -- ":
            text.parent.replace(text, nodes.Text(" – "))


TypeAliasForwardRef.__repr__ = lambda self: self.name  # type: ignore[method-assign]  # of `Array | None`


def setup(app: Sphinx) -> dict[str, bool]:
    app.connect("autodoc-process-docstring", split_arguments, priority=400)  # before napoleon
    app.connect("autodoc-process-docstring", restore_colons, priority=600)
    app.connect("doctree-read", dashes)
    app.connect("missing-reference", resolve_by_name)
    return {"parallel_read_safe": True, "parallel_write_safe": True}

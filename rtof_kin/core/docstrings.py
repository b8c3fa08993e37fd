"""Docstrings of the fields of a class, which Python itself does not keep."""

from __future__ import annotations

import ast
import inspect
import textwrap
from functools import cache


@cache
def field_docstrings(owner: type) -> dict[str, str]:
    """Return the docstring or ``#:`` comment of each field of a class that has one, in one line."""
    source = textwrap.dedent(inspect.getsource(owner))
    (node,) = ast.parse(source).body
    assert isinstance(node, ast.ClassDef)
    found = {}
    for field, after in zip(node.body, [*node.body[1:], None], strict=True):
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name):
            text = source.splitlines()[field.lineno - 1].partition("  #: ")[2]
            if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant):
                text = str(after.value.value)
            if line := " ".join(text.split()):
                found[field.target.id] = line
    return found

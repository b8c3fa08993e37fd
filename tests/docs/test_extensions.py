"""Extensions of the documentation site: pages of commands, docstrings, equations."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("sphinx", reason="the extra docs is not installed")

from docutils.utils.math.latex2mathml import tex2mathml

from docs.extensions import commands, docstrings
from rtof_kin.cli import app, command_names


def test_the_page_of_a_command_has_all_its_options() -> None:
    for name in command_names():
        page = commands.page(name, "What it does.")
        options = {option for one in app([name])[name].assemble_argument_collection() for option in one.names}
        assert not [option for option in options if option.startswith("--") and option not in page]


def test_a_help_text_is_plain_but_for_options_commands_files_and_pages() -> None:
    text = "a * of -o OUT as rtof-kin run does, in motion.npz; docs/live.md has more"
    found = commands.escaped(text)
    assert found == "a \\* of `-o` OUT as `rtof-kin run` does, in `motion.npz`; [live](../live.md) has more"


def test_several_arguments_in_a_line_become_one_each() -> None:
    def function(first: Any, second: Any, third: Any) -> None:
        """See below."""

    text = """Args:
    first: (T,) s. second, third: m, with
        more words.

Raises:
    ShapeError: wrong. OSError: full disk."""
    lines = text.splitlines()
    docstrings.split_arguments(SimpleNamespace(), "function", "", function, None, lines)  # type: ignore[arg-type]
    assert [line.strip() for line in lines if line.startswith(" ")] == [
        "first: (T,) s.",
        "second, third: m, with more words.",
        "ShapeError: wrong.",
        "OSError: full disk.",
    ]


def test_the_equations_of_the_method_are_understood() -> None:
    text = (Path(__file__).parents[2] / "docs/method.md").read_text(encoding="utf-8")
    equations = re.findall(r"\$\$(.+?)\$\$", text, flags=re.DOTALL)
    assert len(equations) > 8
    assert all(tex2mathml(equation, as_block=True).startswith("<math") for equation in equations)

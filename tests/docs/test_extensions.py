"""Extensions of the documentation site: pages of commands, docstrings, equations."""

from __future__ import annotations

import argparse
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("sphinx", reason="the extra docs is not installed")

from docutils.utils.math.latex2mathml import tex2mathml

from docs.extensions import commands, docstrings
from rtof_kin.cli import _parser


def test_the_page_of_a_command_has_all_its_options() -> None:
    for name, parser in _parser()[1].choices.items():
        page = commands.page(name, parser, "What it does.")
        shown = [action for action in parser._actions if action.help not in (None, argparse.SUPPRESS)]
        options = {option for action in shown for option in action.option_strings} - {"-h", "--help"}
        assert not [option for option in options if option not in page]


def test_a_help_text_is_plain_but_for_options_commands_files_and_pages() -> None:
    text = "a * of -o OUT as rtof-kin init does, in motion.npz; docs/live.md has more"
    found = commands.escaped(text)
    assert found == "a \\* of `-o` OUT as `rtof-kin init` does, in `motion.npz`; [live](../live.md) has more"


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

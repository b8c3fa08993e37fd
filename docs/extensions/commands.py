"""A page for each command, made from its parser; command lines in all pages lead to them.

The pages are `docs/commands/NAME.md`, written before sources are looked for and ignored by git. Their first
sentence is the command's row in docs/command_line.md.
"""

from __future__ import annotations

import argparse
import os
import re
from collections.abc import Iterator
from pathlib import Path

from docutils import nodes
from sphinx.application import Sphinx

from rtof_kin.cli import _parser

DOCS = Path(__file__).parents[1]
ROW = re.compile(r"^\| `rtof-kin ([a-z0-9-]+)[^`]*` \| (.*) \|$", re.MULTILINE)
LINE = re.compile(r"rtof-kin ([a-z0-9-]+)")
FILE = r"[\w./*]+\.(?:toml|npz|csv|json|html|md|png|mp4|onnx|pt)"
CODE = re.compile(rf"(?<![\w-])(rtof-kin [a-z][a-z0-9-]+|--?[a-z][\w-]*|{FILE})(?![\w*])")
MARKS = re.compile(r"([\\`*_{}\[\]<>|$#~^])")


def escaped(text: str) -> str:
    """Return a help text as Markdown: options, commands and files as code, pages as links."""
    out = []
    for i, part in enumerate(CODE.split(text)):
        if i % 2 and part.startswith("docs/"):
            out.append(f"[{Path(part).stem.replace('_', ' ')}](../{part.removeprefix('docs/')})")
        else:
            out.append(f"`{part}`" if i % 2 else MARKS.sub(r"\\\1", part))
    return "".join(out)


def page(name: str, parser: argparse.ArgumentParser, summary: str) -> str:
    """Return the page of one command."""
    formatter = argparse.HelpFormatter(parser.prog, width=88)
    formatter.add_usage(parser.usage, parser._actions, parser._mutually_exclusive_groups)
    usage = formatter.format_help().removeprefix("usage: ").strip()
    lines = [f"# rtof-kin {name}", "", summary, "", "```text", usage, "```", ""]
    if parser.description:
        lines += [escaped(parser.description.replace("%(prog)s", parser.prog)), ""]
    for group in parser._action_groups:
        actions = [a for a in group._group_actions if a.help != argparse.SUPPRESS and a.dest != "help"]
        if actions:
            title = (group.title or "options").replace("positional arguments", "arguments")
            lines += [f"## {title[0].upper()}{title[1:]}", ""]
            lines += [escaped(group.description), ""] if group.description else []
            for action in actions:
                lines += [*_entry(action, formatter), ""]
    if parser.epilog:
        lines += [escaped(parser.epilog), ""]
    return "\n".join(lines)


def _entry(action: argparse.Action, formatter: argparse.HelpFormatter) -> Iterator[str]:
    """Yield one argument or option as an entry of a definition list."""
    heading = formatter._format_action_invocation(action)
    yield f"`` {heading} ``"
    text = formatter._expand_help(action) if action.help else ""
    if action.option_strings and action.required:
        text += " (required)"
    yield f": {escaped(text) or '-'}"


def write_pages(folder: Path = DOCS / "commands") -> None:
    """Write the page of every command, and remove those of commands that are no more."""
    os.environ["COLUMNS"] = "88"
    rows = dict(ROW.findall((DOCS / "command_line.md").read_text(encoding="utf-8")))
    folder.mkdir(exist_ok=True)
    commands = _parser()[1].choices
    for old in folder.glob("*.md"):
        if old.stem not in commands:
            old.unlink()
    for name, parser in commands.items():
        summary = re.sub(r"\]\((?=[\w]+\.md)", "](../", rows[name]).replace(r"\|", "|")
        summary = re.sub(r"[a-z]", lambda first: first[0].upper(), summary, count=1)
        text = page(name, parser, summary.removesuffix(".") + ".")
        path = folder / f"{name}.md"
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


def link_command_lines(app: Sphinx, document: nodes.document, here: str) -> None:
    """Turn each `rtof-kin NAME ...` in a text into a link to the page of that command."""
    if app.builder.format != "html":
        return
    for literal in list(document.findall(nodes.literal)):
        found = LINE.match(literal.astext())
        target = f"docs/commands/{found[1]}" if found else ""
        if target == here or target not in app.env.found_docs:
            continue
        inside = literal.parent
        while inside is not None and not isinstance(inside, nodes.title | nodes.reference):
            inside = inside.parent
        if inside is None:
            link = nodes.reference(internal=True, refuri=app.builder.get_relative_uri(here, target))
            literal.replace_self(link)
            link += literal


def setup(app: Sphinx) -> dict[str, bool]:
    app.connect("config-inited", lambda *_: write_pages())
    app.connect("doctree-resolved", link_command_lines)
    return {"parallel_read_safe": True, "parallel_write_safe": True}

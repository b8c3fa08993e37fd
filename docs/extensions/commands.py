"""A page for each command, made from its function; command lines in all pages lead to them.

The pages are `docs/commands/NAME.md`, written before sources are looked for and ignored by git. Their first
sentence is the command's row in docs/command_line.md.
"""

from __future__ import annotations

import re
from pathlib import Path

from docutils import nodes
from sphinx.application import Sphinx

from rtof_kin.cli import app, command_names

DOCS = Path(__file__).parents[1]
ROW = re.compile(r"^\| `rtof-kin ([a-z0-9-]+)[^`]*` \| (.*) \|$", re.MULTILINE)
LINE = re.compile(r"rtof-kin ([a-z0-9-]+)")
FILE = r"[\w./*]+\.(?:toml|npz|csv|json|html|md|png|mp4|onnx|pt)"
CODE = re.compile(rf"(?<![\w-])(rtof-kin [a-z][a-z0-9-]+|--?[a-z][\w-]*|{FILE})(?![\w*])")
ENTRY = re.compile(r"(\* (?:`[^`]*`|\[`[^`]*`\]\([^)]*\)): )(.*?)((?: \*\*?\[.*)?)$")
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


def page(name: str, summary: str) -> str:
    """Return the page of one command, with those below it."""
    text = re.sub(r"## Table of Contents\n.*?(?=\n\*\*)", "", app([name])[name].generate_docs(), flags=re.DOTALL)
    _, usage, rest = re.split(r"```console\n|```\n", text, maxsplit=2)
    lines = [f"# rtof-kin {name}", "", summary, "", f"```text\nrtof-kin {usage}```"]
    for line in rest.partition("\n\n")[2].splitlines():  # without the first sentence
        entry = ENTRY.match(line)
        if entry:
            lines.append(f"{entry[1]}{escaped(entry[2])}{entry[3]}")
        else:
            lines.append(line if line.startswith(("**", "#", "`", "rtof-kin", "evaluate ")) else escaped(line))
    whole = "\n".join(lines) + "\n"
    return whole.replace("](#evaluate", "](#rtof-kin-evaluate").replace("## evaluate", "## rtof-kin evaluate")


def write_pages(folder: Path = DOCS / "commands") -> None:
    """Write the page of every command, and remove those of commands that are no more."""
    rows = dict(ROW.findall((DOCS / "command_line.md").read_text(encoding="utf-8")))
    folder.mkdir(exist_ok=True)
    for old in folder.glob("*.md"):
        if old.stem not in command_names():
            old.unlink()
    for name in command_names():
        summary = re.sub(r"\]\((?=[\w]+\.md)", "](../", rows[name]).replace(r"\|", "|")
        summary = re.sub(r"[a-z]", lambda first: first[0].upper(), summary, count=1)
        text = page(name, summary.removesuffix(".") + ".")
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

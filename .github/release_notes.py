"""Print the changelog's section of a version: ``python .github/release_notes.py v0.2.0``."""

import re
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]


def section(changelog: str, version: str) -> str:
    """Text below the heading ``## [version] - date`` up to the next one; empty where there is none."""
    heading = rf"^## \[{re.escape(version)}\] - \d{{4}}-\d{{2}}-\d{{2}}$"
    found = re.search(rf"{heading}\n(.*?)(?=^## \[|^\[[^\]]+\]: |\Z)", changelog, re.DOTALL | re.MULTILINE)
    return found[1].strip() if found else ""


def main(tag: str) -> int:
    """Print the section, or say what is wrong."""
    version = tag.removeprefix("v")
    own = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    notes = section((ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), version)
    if version != own:
        print(f"the tag is {tag}, but pyproject.toml has version {own}", file=sys.stderr)
    elif not notes:
        print(f"CHANGELOG.md has no section '## [{version}] - date'", file=sys.stderr)
    else:
        print(notes)
    return 0 if version == own and notes else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))

"""The runner of all studies: ``python -m benchmarks`` lists them, ``python -m benchmarks STUDY ...`` runs one."""

from __future__ import annotations

import ast
import runpy
import sys
from pathlib import Path

from rtof_kin.core.errors import RtofError

HERE = Path(__file__).parent


def studies() -> dict[str, str]:
    """Each study's name, a module or a folder of `benchmarks`, with the first sentence of its description."""
    found = {}
    for path in sorted(HERE.rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        if path != Path(__file__) and "\nif __name__ ==" in text:
            module = path.parent if path.name == "__main__.py" else path.with_suffix("")
            first = (ast.get_docstring(ast.parse(text)) or "").split("\n\n")[0].replace("\n", " ")
            found[".".join(module.relative_to(HERE).parts)] = first
    return found


def main() -> None:
    """Run the study that is named, with its own options."""
    known = studies()
    if len(sys.argv) < 2 or sys.argv[1] not in known:
        for name, first in known.items():
            print(f"{name:28} {first}")
        sys.exit(0 if len(sys.argv) < 2 else f"no study is called {sys.argv[1]!r}; these are all")
    del sys.argv[0]
    try:
        runpy.run_module(f"benchmarks.{sys.argv[0]}", run_name="__main__", alter_sys=True)
    except RtofError as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()

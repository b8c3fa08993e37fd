"""Which extras of this package can be installed from wheels alone, by Python version and platform.

    python -m benchmarks.wheel_availability > benchmarks/results/wheel_availability.md

Asks the package index through `uv pip compile --only-binary :all:` (`pip install uv`), so that the packages that
the dependencies need are looked at too. Where an extra fails, its direct dependencies are asked one by one.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tomllib
from concurrent.futures import ThreadPoolExecutor
from itertools import product
from pathlib import Path
from typing import Final

PROJECT: Final = Path(__file__).parents[1] / "pyproject.toml"
PYTHONS: Final = ("3.11", "3.12", "3.13", "3.14")
PLATFORMS: Final = {
    "Linux x86_64": "x86_64-manylinux_2_28",
    "Linux aarch64": "aarch64-manylinux_2_28",
    "macOS arm64": "aarch64-apple-darwin",
    "macOS x86_64": "x86_64-apple-darwin",
    "Windows x86_64": "x86_64-pc-windows-msvc",
}
MACOS: Final = "14.0"
NONE: Final = "(none)"


def resolves(requirements: str, python: str, platform: str) -> bool:
    """Return whether wheels satisfy requirements, with all that these need."""
    uv = [sys.executable, "-m", "uv", "pip", "compile", "--quiet", "--no-config", "--only-binary", ":all:"]
    where = ["--python-version", python, "--python-platform", PLATFORMS[platform]]
    done = subprocess.run(
        [*uv, *where, "-"], input=requirements, text=True, capture_output=True, cwd=PROJECT.parent,
        env={**os.environ, "MACOSX_DEPLOYMENT_TARGET": MACOS},
    )  # fmt: skip
    return done.returncode == 0


def requirements(project: dict[str, object], extra: str) -> list[str]:
    """Return the requirements of the package, or those that an extra adds."""
    if extra == NONE:
        return [str(one) for one in project["dependencies"]]  # type: ignore[attr-defined]
    found: list[str] = []
    for one in project["optional-dependencies"][extra]:  # type: ignore[index]
        if one.startswith(f"{project['name']}["):
            inner = one.partition("[")[2].rstrip("]").split(",")
            found += [each for name in inner for each in requirements(project, name)]
        else:
            found.append(one)
    return found


def main() -> None:
    """Print the table: an extra a line, for each platform the Python versions."""
    project = tomllib.loads(PROJECT.read_text(encoding="utf-8"))["project"]
    extras = [NONE, *(name for name in project["optional-dependencies"] if name not in ("dev", "docs"))]
    base = requirements(project, NONE)
    cells = list(product(extras, PLATFORMS, PYTHONS))

    def answer(cell: tuple[str, str, str]) -> list[str]:
        extra, platform, python = cell
        own = requirements(project, extra)
        if resolves("\n".join({*base, *own}), python, platform):
            return []
        return [one for one in own if not resolves(one, python, platform)] or ["together"]

    with ThreadPoolExecutor(2) as pool:
        missing = dict(zip(cells, pool.map(answer, cells), strict=True))
    print(f"| extra | {' | '.join(PLATFORMS)} |\n|---{'|---' * len(PLATFORMS)}|")
    for extra in extras:
        row = []
        for platform in PLATFORMS:
            there = [python for python in PYTHONS if not missing[extra, platform, python]]
            lacking = {
                one.split(">")[0].split("[")[0] for p in PYTHONS for one in missing[extra, platform, p]
            }
            without = f" (no {', '.join(sorted(lacking))})" if lacking else ""
            row.append(("all" if len(there) == len(PYTHONS) else ", ".join(there) or "none") + without)
        print(f"| `{extra}` | {' | '.join(row)} |".replace(f"`{NONE}`", NONE))
    print(f"\nPython {PYTHONS[0]} to {PYTHONS[-1]}; macOS {MACOS.removesuffix('.0')}")


if __name__ == "__main__":
    main()

"""Which dependencies have wheels, by extra, Python version and platform.

    python -m benchmarks wheel_availability > benchmarks/results/wheel_availability.md

Reads the index of each direct dependency once (`packaging` is needed), and looks for a wheel of any version
that pyproject.toml allows.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Final
from urllib.request import Request, urlopen

from packaging.requirements import Requirement
from packaging.tags import Tag, compatible_tags, cpython_tags, mac_platforms
from packaging.utils import InvalidWheelFilename, parse_wheel_filename

INDEX: Final = "https://pypi.org/simple"
PYTHONS: Final = ("3.11", "3.12", "3.13", "3.14")
GLIBC: Final = 35  # manylinux_2_35: Ubuntu 22.04
MACOS: Final = (14, 0)
PLATFORMS: Final = {
    "Linux x86_64": ("linux", "x86_64"),
    "Linux aarch64": ("linux", "aarch64"),
    "macOS arm64": ("darwin", "arm64"),
    "macOS x86_64": ("darwin", "x86_64"),
    "Windows x86_64": ("win32", "AMD64"),
}
"""Title -> values of the markers `sys_platform` and `platform_machine`."""
NONE: Final = "(none)"


def requirements(project: dict[str, Any], extra: str) -> list[Requirement]:
    """Return the requirements of the package, or those that an extra adds."""
    if extra == NONE:
        return [Requirement(one) for one in project["dependencies"]]
    found: list[Requirement] = []
    for one in map(Requirement, project["optional-dependencies"][extra]):
        own = sorted(one.extras) if one.name == project["name"] else []
        found += [each for name in own for each in requirements(project, name)] if own else [one]
    return found


def tags(python: str, platform: str) -> set[Tag]:
    """Return the tags of wheels that an interpreter on a platform can use."""
    system, machine = PLATFORMS[platform]
    names = ["win_amd64"]
    if system == "linux":
        old = {"manylinux1": 5, "manylinux2010": 12, "manylinux2014": 17}
        names = [f"manylinux_2_{minor}_{machine}" for minor in range(5, GLIBC + 1)]
        names += [f"{name}_{machine}" for name in old]
    elif system == "darwin":
        names = list(mac_platforms(MACOS, machine))
    version = tuple(map(int, python.split(".")))
    return {*cpython_tags(version, platforms=names), *compatible_tags(version, platforms=names)}


def wheels(name: str) -> list[tuple[Any, frozenset[Tag]]]:
    """Return version and tags of every wheel of a package."""
    accept = {"Accept": "application/vnd.pypi.simple.v1+json"}
    with urlopen(Request(f"{INDEX}/{name}/", headers=accept), timeout=180) as answer:
        files = json.load(answer)["files"]
    return list(_read(file["filename"] for file in files if not file.get("yanked")))


def _read(names: Iterator[str]) -> Iterator[tuple[Any, frozenset[Tag]]]:
    for name in names:
        try:
            _, version, _, found = parse_wheel_filename(name)
            yield version, found
        except InvalidWheelFilename:  # a source distribution, or a name of old times
            pass


def main() -> None:
    """Print the table: for each extra and platform what has no wheel."""
    path = Path(__file__).parents[1] / "pyproject.toml"
    project = tomllib.loads(path.read_text(encoding="utf-8"))["project"]
    composed = {"all", "dev", "docs"}
    extras = [NONE, *(name for name in project["optional-dependencies"] if name not in composed)]
    needed = {extra: requirements(project, extra) for extra in extras}
    packages = sorted({one.name for own in needed.values() for one in own})
    with ThreadPoolExecutor(6) as pool:
        found = dict(zip(packages, pool.map(wheels, packages), strict=True))
    print(f"| extra | {' | '.join(PLATFORMS)} |\n|---{'|---' * len(PLATFORMS)}|")
    for extra in extras:
        row = []
        for platform, (system, machine) in PLATFORMS.items():
            lacking: dict[str, list[str]] = {}
            for python in PYTHONS:
                usable = tags(python, platform)
                marks = {"sys_platform": system, "platform_machine": machine, "python_version": python}
                for one in needed[extra]:
                    there = (v in one.specifier and usable & tag for v, tag in found[one.name])
                    if not any(there):
                        wanted = one.marker is None or one.marker.evaluate(marks)
                        lacking.setdefault(one.name if wanted else f"({one.name})", []).append(python)
            every = len(PYTHONS)
            said = [n if len(on) == every else f"{n} on {', '.join(on)}" for n, on in lacking.items()]
            row.append(f"no {', no '.join(said)}" if said else "yes")
        print(f"| {extra} | {' | '.join(row)} |")
    where = f"Python {PYTHONS[0]} to {PYTHONS[-1]}, glibc 2.{GLIBC}, macOS {MACOS[0]}"
    print(f"\n{where}. *yes*: wheels for all. In brackets: a marker excludes it there.")


if __name__ == "__main__":
    main()

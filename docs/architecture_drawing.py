"""Draws docs/architecture.svg from the imports between the folders of `rtof_kin`, and `lifting`.

An arrow means *imports*. Arrows that follow from others are left out: A -> C where A -> B and B -> C are
there. `python -m docs.architecture_drawing` writes the picture; with `--check` it compares.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from html import escape
from pathlib import Path

ROOT = Path(__file__).parent.parent
PICTURE = Path(__file__).with_name("architecture.svg")
PLACES = {
    "cli": (2.5, 0, "the command line,\nthe only place that prints"),
    "app": (0.0, 0, "people and visits\nin the browser"),
    "setup": (0.0, 1, "raw files\nto a recording"),
    "live": (2.0, 1, "pose while\nthe person moves"),
    "view": (3.0, 1, "3D scene,\nskeleton on the video"),
    "protocols": (1.0, 1, "protocols and tables\nof papers, data sets"),
    "batch": (4.0, 1, "many recordings,\nresumable"),
    "plan": (5.0, 1, "errors to expect,\nbefore recording"),
    "reporting": (2.75, 2, "audit, page,\nexport, study"),
    "reconstruction": (1.25, 3, "recording to motion:\nprepare, lift, SF², solve"),
    "calibration": (0.3, 4, "delay, mounting, bones\nfrom the motion"),
    "lifting": (2.2, 4, "network: 2D to 3D\n(beside rtof_kin)"),
    "robots": (4.2, 6, "motions on\nhumanoid robots"),
    "clinical": (4.0, 4, "angles, gait,\nrepetitions, torques"),
    "markers": (1.1, 5, "optical laboratories:\nbody, IK"),
    "solve": (0.0, 6, "energy, fragments,\nuncertainty"),
    "simulation": (2.2, 5, "recordings from\nmotion capture"),
    "datasets": (3.2, 5, "Total Capture and other\npublic data sets"),
    "recording": (2.2, 6, "Recording\nand its folder"),
    "inertial": (0.6, 7, "physics, orientation,\nalignment of sensors"),
    "vision": (2.5, 7, "detectors, layouts,\ntracking"),
    "formats": (3.2, 8, "one file\nper file format"),
    "body": (1.5, 9, "skeleton, kinematics,\npose prior"),
    "data": (2.75, 9, "camera, keypoints,\nIMUs, poses"),
    "core": (4.0, 9, "errors, files,\nrotations, numerics"),
}
"""Folder -> column, row, what it is."""
KINDS = {
    "for people": (
        "cli",
        "app",
        "setup",
        "live",
        "view",
        "protocols",
        "batch",
        "plan",
        "reporting",
        "clinical",
        "robots",
    ),
    "the method": ("reconstruction", "calibration", "lifting", "markers", "solve"),
    "its data": ("simulation", "datasets", "recording"),
    "foundations": ("inertial", "vision", "formats", "body", "data", "core"),
}
WIDTH, HEIGHT, COLUMN, ROW, LEFT, TOP = 168, 62, 196, 96, 40, 56
STYLE = """
text { font-family: system-ui, sans-serif; fill: #1f2328; text-anchor: middle; }
.name { font-size: 16px; font-weight: 600; } .what { font-size: 12.5px; }
.arrow { fill: none; stroke: #59636e; stroke-width: 1.5; } .tip { fill: #59636e; }
rect { stroke-width: 1.5; } .page { fill: #ffffff; }
.k0 { fill: #ddf4ff; stroke: #0969da; } .k1 { fill: #ffebd6; stroke: #bc4c00; }
.k2 { fill: #dafbe1; stroke: #1a7f37; } .k3 { fill: #eef0f2; stroke: #59636e; }
@media (prefers-color-scheme: dark) {
text { fill: #f0f6fc; } .page { fill: #0d1117; } .arrow { stroke: #9198a1; } .tip { fill: #9198a1; }
.k0 { fill: #0c2d6b; stroke: #4493f8; } .k1 { fill: #5a2a05; stroke: #f0883e; }
.k2 { fill: #0f3d1d; stroke: #3fb950; } .k3 { fill: #262c36; stroke: #9198a1; }
}"""


def files(folder: str) -> list[Path]:
    return sorted((ROOT / folder if folder == "lifting" else ROOT / "rtof_kin" / folder).rglob("*.py"))


def folders_imported(path: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        if isinstance(node, ast.ImportFrom):
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        for package, *inner in (name.split(".") for name in names):
            if package == "lifting" or (package == "rtof_kin" and inner and inner[0] in PLACES):
                yield inner[0] if package == "rtof_kin" else package


def imports() -> dict[str, set[str]]:
    """Folder -> folders that it imports; the entry point of `lifting` borrows the command line's options."""
    uses = {name: set[str]() for name in PLACES}
    for folder in PLACES:
        for path in files(folder):
            if path.name != "__main__.py":
                uses[folder] |= set(folders_imported(path)) - {folder}
    return uses


def reduced(uses: dict[str, set[str]]) -> list[tuple[str, str]]:
    """The arrows that the others follow from."""

    def reached(folder: str) -> set[str]:
        return uses[folder].union(*(reached(inner) for inner in uses[folder]))

    return [
        (folder, used)
        for folder in uses
        for used in sorted(uses[folder])
        if not any(used in reached(other) for other in uses[folder] - {used})
    ]


def centre(folder: str) -> tuple[float, float]:
    column, row, _ = PLACES[folder]
    return LEFT + WIDTH / 2 + (column + 0.1) * COLUMN, TOP + HEIGHT / 2 + row * ROW


def arrow(start: str, end: str) -> str:
    (x, y), (u, v) = centre(start), centre(end)
    if abs(v - y) < 1:
        way = f"M{x + WIDTH / 2:.0f},{y:.0f} L{u - WIDTH / 2 - 3:.0f},{v:.0f}"
        if u < x:
            way = f"M{x - WIDTH / 2:.0f},{y:.0f} L{u + WIDTH / 2 + 3:.0f},{v:.0f}"
        return f'<path class="arrow" d="{way}" marker-end="url(#tip)"/>'
    shift = max(-0.36, min(0.36, (u - x) / (3 * COLUMN))) * WIDTH
    x, y, u, v = x + shift, y + HEIGHT / 2, u - shift, v - HEIGHT / 2 - 3
    bend = (v - y) / 2
    way = f"M{x:.0f},{y:.0f} C{x:.0f},{y + bend:.0f} {u:.0f},{v - bend:.0f} {u:.0f},{v:.0f}"
    return f'<path class="arrow" d="{way}" marker-end="url(#tip)"/>'


def box(folder: str) -> str:
    x, y = centre(folder)
    kind = next(i for i, names in enumerate(KINDS.values()) if folder in names)
    lines = escape(PLACES[folder][2]).split("\n")
    return (
        f'<rect class="k{kind}" x="{x - WIDTH / 2:.0f}" y="{y - HEIGHT / 2:.0f}" width="{WIDTH}" '
        f'height="{HEIGHT}" rx="8"/><text class="name" x="{x:.0f}" y="{y - 11:.0f}">{folder}</text>'
        + "".join(f'<text class="what" x="{x:.0f}" y="{y + 7 + 16 * i:.0f}">{t}</text>' for i, t in enumerate(lines))
    )


def drawing() -> str:
    arrows = reduced(imports())
    upwards = [pair for pair in arrows if PLACES[pair[0]][1] > PLACES[pair[1]][1]]
    if upwards:
        raise SystemExit(f"{upwards}: place the first of each pair above the second in PLACES")
    width = LEFT * 2 + WIDTH + 5.2 * COLUMN
    height = TOP + HEIGHT + 16 + ROW * max(row for _, row, _ in PLACES.values())
    keys = "".join(
        f'<rect class="k{i}" x="{LEFT + 150 * i}" y="14" width="18" height="18" rx="4"/>'
        f'<text class="what" style="text-anchor:start" x="{LEFT + 26 + 150 * i}" y="28">{name}</text>'
        for i, name in enumerate(KINDS)
    )
    text = "; ".join(f"{a} imports {b}" for a, b in arrows)
    return f"""<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {height:.0f}" role="img">
<title>Folders of rtof_kin and their imports</title>
<desc>{text}. Imports that follow from these are not drawn.</desc>
<style>{STYLE}</style>
<defs><marker id="tip" viewBox="0 0 8 8" refX="6" refY="4" markerWidth="7" markerHeight="7" orient="auto">
<path class="tip" d="M0,0 L8,4 L0,8 z"/></marker></defs>
<rect class="page" width="100%" height="100%" rx="8"/>
{keys}
<text class="what" style="text-anchor:end" x="{width - LEFT:.0f}" y="28">\
A → B: A imports B; what follows from other arrows is not drawn</text>
{chr(10).join(arrow(a, b) for a, b in arrows)}
{chr(10).join(box(folder) for folder in PLACES)}
</svg>
"""


if __name__ == "__main__":
    if sys.argv[1:] == ["--check"]:
        sys.exit(0 if PICTURE.read_text(encoding="utf-8") == drawing() else f"{PICTURE} is not that of today's imports")
    PICTURE.write_text(drawing(), encoding="utf-8")

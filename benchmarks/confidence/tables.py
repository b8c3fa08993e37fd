"""The rows of the study as Markdown."""

from __future__ import annotations

from collections.abc import Sequence

from benchmarks.confidence.study import COVERED, WIDEST, Row, honest

TITLES = {"position": "Positions in world", "relative": "Positions relative to the root", "angle": "Clinical angles"}


def report(found: Sequence[Row], how: str) -> str:
    """The whole text.

    Args:
        how: a sentence that describes the data.
    """
    parts = [
        "# How honest the bands are\n",
        f"{how} A cell has the share of errors inside the 95 % band, the root mean square error, and "
        "the band's mean width from edge to edge in such errors; of positions all three axes count. "
        "Errors last: frames of a recording are much alike. The share is over frames, cameras and "
        "motions together, and only the motions are independent (95 % bootstrap over them, "
        "median over the rows: see the end). Bold: less than "
        f"{100 * COVERED[0]:.0f} % or more than {100 * COVERED[1]:.0f} %, or wider than {WIDEST:g}.\n",
    ]
    for keypoints in dict.fromkeys(row["keypoints"] for row in found):
        own = [row for row in found if row["keypoints"] == keypoints]
        parts += [f"## {keypoints} 2D\n", *(_table(own, kind) for kind in TITLES)]
    return "\n".join([*parts, _summary(found)])


def _table(found: Sequence[Row], kind: str) -> str:
    own = [row for row in found if row["kind"] == kind]
    counts = list(dict.fromkeys(row["sensors"] for row in own))
    cells = {(row["name"], row["sensors"]): _cell(row) for row in own}
    lines = [
        f"### {TITLES[kind]} ({own[0]['unit']})\n",
        "| | " + " | ".join(f"{count} sensors" for count in counts) + " |",
        "|---|" + "---|" * len(counts),
    ]
    for name in dict.fromkeys(row["name"] for row in own):
        shown = [cells.get((name, count), "-") for count in counts]
        lines.append(f"| {name.replace('_', ' ')} | " + " | ".join(shown) + " |")
    return "\n".join(lines) + "\n"


def _cell(row: Row) -> str:
    text = f"{100 * row['coverage']['0.95']:.0f} %, {row['rms']:.1f}, {row['ratio']:.1f}"
    return text if honest(row) else f"**{text}**"


def _summary(found: Sequence[Row]) -> str:
    """Shares of rows that are honest, by kind of 2D and number of sensors."""
    lines = [
        "## Rows that are honest\n",
        "| 2D | sensors | positions | relative | angles | usual interval of a share |",
        "|---|---|---|---|---|---|",
    ]
    for keypoints, sensors in dict.fromkeys((row["keypoints"], row["sensors"]) for row in found):
        own = [r for r in found if (r["keypoints"], r["sensors"]) == (keypoints, sensors)]
        cells = []
        for kind in TITLES:
            accepted = [honest(row) for row in own if row["kind"] == kind]
            cells.append(f"{sum(accepted)} of {len(accepted)}")
        low, high = (sorted(row["interval"][i] for row in own)[len(own) // 2] for i in (0, 1))
        cells.append(f"{100 * low:.0f}-{100 * high:.0f} %")
        lines.append(f"| {keypoints} | {sensors} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"

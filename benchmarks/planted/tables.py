"""Tables of the benchmark of planted faults, as Markdown."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.stats import binomtest

from benchmarks.planted.faults import FAULTS, RIGHT
from benchmarks.planted.gross import GROSS
from benchmarks.planted.measuring import ERRORS, Row

COVERED = 0.9
"""Share in the 95 % bands from which what is not named is no silent error."""
_UNVERIFIED = re.compile(r"position in the room (?!fails)[^;]*")
_WORDS = 90  # characters of a first line


def false_alarm(row: Row) -> bool:
    """Whether the first line of a right recording fails, or warns of what would be a planted fault."""
    return row["grade"] in ("fail", "error", "crash") or "room fails" in row["line"] or bool(row["causes"])


def silent(row: Row) -> bool:
    """Whether a fault is neither named nor within the bands that its definition asks for."""
    return not row["named"] and not covered(row)


def unverified(row: Row) -> bool:
    """Whether a fault that is not named is within its bands, and the line says that it is not verified."""
    said = _UNVERIFIED.search(row["line"])
    return not row["named"] and covered(row) and said is not None and FAULTS[row["fault"]].names(said.group())


def covered(row: Row) -> bool:
    """Whether the judged bands hold what they promise; an error message states nothing."""
    share = _inside(row)
    return ("inside" not in row and row["grade"] == "error") or share >= COVERED


def _inside(row: Row) -> float:
    return float(row.get("inside", {}).get(FAULTS[row["fault"]].band, np.nan))


def totals(rows: Sequence[Row]) -> dict[str, Any]:
    """The benchmark's figures."""
    right = [row for row in rows if row["fault"] in RIGHT]
    wrong = [row for row in rows if row["fault"] in FAULTS]
    unnamed = [row for row in wrong if not row["named"]]
    alarms = sum(map(false_alarm, right))
    bands = [share for row in unnamed if np.isfinite(share := _inside(row))]
    found: dict[str, Any] = {
        "faults": len(wrong),
        "right": len(right),
        "named": _mean([row["named"] for row in wrong]),
        "named_interval": _interval(sum(row["named"] for row in wrong), len(wrong)),
        "named or said to be unverified": _mean([row["named"] or unverified(row) for row in wrong]),
        "named or within bands": _mean([not silent(row) for row in wrong]),
        "false alarms": alarms,
        "false_alarm_interval": _interval(alarms, len(right)),
        "coverage under unnamed": _mean(bands),
        "unnamed with bands that hold": _mean([covered(row) for row in unnamed]),
        "other causes in a naming line": _mean([len(row["causes"]) - 1 for row in wrong if row["named"]]),
        "crashes": sum(row["grade"] == "crash" for row in rows),
    }
    return found


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values)) if len(values) else float("nan")


def _interval(count: int, of: int) -> list[float]:
    """95 % interval of a share (Clopper and Pearson)."""
    if not of:
        return [0.0, 1.0]
    found = binomtest(count, of).proportion_ci(method="exact")
    return [float(found.low), float(found.high)]


def markdown(rows: Sequence[Row], how: str) -> str:
    """All tables and totals."""
    t = totals(rows)
    (low, high), (least, most) = t["named_interval"], t["false_alarm_interval"]
    lines = [
        "# Planted faults",
        "",
        how,
        "",
        f"- named in the first line: **{t['named']:.0%}** of {t['faults']} ({low:.0%} to {high:.0%})",
        f"- named, or within the band that the line says is not verified because of it: "
        f"{t['named or said to be unverified']:.0%}",
        f"- named or within their bands: {t['named or within bands']:.0%}",
        f"- false alarms in right recordings: **{t['false alarms']}** of {t['right']} ({least:.1%} to {most:.1%})",
        f"- coverage of the 95 % bands under faults that are not named: "
        f"**{t['coverage under unnamed']:.0%}**; {t['unnamed with bands that hold']:.0%} of them have at "
        f"least {COVERED:.0%}",
        f"- other faults that a naming first line names too: {t['other causes in a naming line']:.1f}; "
        f"crashes: {t['crashes']}",
        "",
        *_by_fault(rows),
        *_of_gross(rows),
        "",
        "## Right recordings",
        "",
        *_of_right(rows),
        "",
    ]
    return "\n".join(lines)


def _by_fault(rows: Sequence[Row]) -> list[str]:
    lines = [
        "| fault | size | n | named | silent | band | inside where not named | "
        + " | ".join(ERRORS.values())
        + " | first line where not named |",
        "|---" * (8 + len(ERRORS)) + "|",
    ]
    for name, fault in FAULTS.items():
        for size in fault.sizes:
            key = size if isinstance(size, str) else f"{size:g}"
            own = [row for row in rows if row["fault"] == name and row["size"] == key]
            if not own:
                continue
            left = [row for row in own if not row["named"]]
            shares = [_inside(row) for row in left if "inside" in row]
            within = f"{np.nanmean(shares):.0%}" if np.isfinite(shares).any() else ""
            errors = [f"{np.mean([r[e] for r in own if e in r] or [np.nan]):.1f}" for e in ERRORS]
            cells = [
                name,
                f"{key} {fault.unit}".strip(),
                str(len(own)),
                f"{_mean([r['named'] for r in own]):.0%}",
                f"{_mean([silent(r) for r in own]):.0%}",
                fault.band,
                within,
                *errors,
                _typical(left),
            ]
            lines.append("| " + " | ".join(cells) + " |")
    return lines


def _of_gross(rows: Sequence[Row]) -> list[str]:
    lines = ["", "## Gross faults", "", "| fault | n | named | first line where not named |", "|---|---|---|---|"]
    for name in GROSS:
        own = [row for row in rows if row["fault"] == name]
        left = [row for row in own if not row["named"]]
        if own:
            lines.append(f"| {name} | {len(own)} | {1 - len(left) / len(own):.0%} | {_typical(left)} |")
    return lines if len(lines) > 5 else []


def _typical(rows: Sequence[Row]) -> str:
    counts = Counter(row["line"].partition("; more ")[0][:_WORDS].replace("|", "/") for row in rows)
    return "; ".join(f"{text} ({count})" if count > 1 else text for text, count in counts.most_common(1))


def _of_right(rows: Sequence[Row]) -> list[str]:
    lines = [
        "| | n | false alarms | world | relative | angles | " + " | ".join(ERRORS.values()) + " | world stated mm |",
        "|---" * (7 + len(ERRORS)) + "|",
    ]
    alarms = []
    for name in RIGHT:
        for sensors in sorted({row["sensors"] for row in rows}, key=int):
            own = [row for row in rows if row["fault"] == name and row["sensors"] == sensors]
            if not own:
                continue
            wrong = [row for row in own if false_alarm(row)]
            told = [row for row in own if "inside" in row]
            shares = [f"{np.nanmean([r['inside'][b] for r in told]):.0%}" for b in told[0]["inside"]]
            errors = [f"{np.mean([r[e] for r in told]):.1f}" for e in ERRORS]
            sigma = f"{_mean([r['world_sigma_mm'] for r in told if 'world_sigma_mm' in r]):.0f}"
            cells = [f"{name}, {sensors} sensors", str(len(own)), str(len(wrong)), *shares, *errors, sigma]
            lines.append("| " + " | ".join(cells) + " |")
            alarms += [f"- {name}, {r['motion']}, {sensors} sensors: {r['line'][:200]}" for r in wrong]
    image = np.array([row["image"] for row in rows if row["fault"] in RIGHT and "image" in row])
    if len(image):
        every, worst = np.quantile(image, 0.95, axis=0)
        words = "Reprojection errors, medians of a recording, 95 % of recordings, in % of the body's height"
        lines += ["", f"{words} in the image: all landmarks {every:.1f}, the worst landmark {worst:.1f}."]
    return [*lines, "", *alarms]

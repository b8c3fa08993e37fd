"""Rows of planted errors as tables in Markdown."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence

import numpy as np

from benchmarks.calibration.planted_rows import ALL, BUT, FIGURES, KNOWN, PLAIN, SEEN, Row
from benchmarks.calibration.planting import ERRORS
from rtof_kin.calibration.result import Verdict
from rtof_kin.core.array_types import Array

UNITS = {
    "delay": (1e3, "ms"),
    "heading": (180 / np.pi, "deg"),
    "mounting": (180 / np.pi, "deg"),
    "size": (100.0, "%"),
    "proportions": (100.0, "%"),
    "image bias": (1.0, "px"),
}
"""Error -> factor and unit that people read."""
STAGES = ("before", "after", "known")
_HEADS = {"mpjpe_rr_mm": "rr", "mpjpe_mm": "abs", "flexion_deg": "flexion"}
_SAME = ("session", "seconds", "floor", "keypoints", "sensors", "camera")
"""Fields shared with the recording without errors."""


def report(rows: Sequence[Row]) -> str:
    """All tables."""
    rows = with_known(rows)
    planted = [r for r in rows if r["study"] == "planted"]
    parts = [
        ("Joint errors (mm) and flexion (deg): as given, calibrated, nothing wrong", motion(planted)),
        ("All wrong but what was measured: joint errors (mm), flexion (deg), calibrated", measured(rows)),
        ("Each error alone, besides what is usually wrong", alone(planted)),
        ("What is found where all are wrong, and where only the usual is", together(planted)),
        ("Claimed standard deviations: truths within one and two", coverage(planted)),
        ("Length and variety (all at once, floor known)", lengths(rows)),
        ("Where sensors were calibrated well: change by calibrating", harm(rows)),
    ]
    return "\n".join(f"### {title}\n\n{text}\n" for title, text in parts if text)


def with_known(rows: Sequence[Row]) -> list[Row]:
    """Rows of calibrations, each with what the same recording gives where nothing is wrong, if it was
    asked for."""
    known = {_recording(r): r["before"] for r in rows if r["case"] == KNOWN}
    return [{**r, "known": known.get(_recording(r))} for r in rows if r["case"] != KNOWN]


def _recording(row: Row) -> tuple[object, ...]:
    return tuple(row[name] for name in _SAME)


def mean(rows: Sequence[Row], stage: str, figure: str) -> float:
    """Over frames."""
    return float(np.average([r[stage][figure] for r in rows], weights=[r["frames"] for r in rows]))


def numbers(rows: Iterable[Row], error: str) -> dict[str, Array]:
    """Columns of an error of several rows, one after the other; without any where it was not open."""
    parts = [r["found"][error] for r in rows if error in r["found"]]
    names = ("truth", "value", "sigma", "prior", "verdict")
    return {n: np.concatenate([p[n] for p in parts]) for n in names} if parts else {}


def _table(head: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    rows = [" | ".join(cells) for cells in (head, ["---"] * len(head), *lines)]
    return "\n".join(f"| {row} |" for row in rows) if len(rows) > 2 else ""


def _grouped(rows: Iterable[Row], *by: str) -> dict[tuple[object, ...], list[Row]]:
    out: dict[tuple[object, ...], list[Row]] = {}
    for row in rows:
        out.setdefault(tuple(row[name] for name in by), []).append(row)
    return out


def _floor(known: object) -> str:
    return "known" if known else "-"


def motion(rows: Sequence[Row]) -> str:
    """Errors of joints, pooled over recordings."""
    head = ["wrong", "size", "floor", "sensors", "recordings"]
    head += [f"{_HEADS[f]} {' / '.join(STAGES)}" for f in FIGURES]
    lines, rows = [], [r for r in rows if "after" in r]
    for (case, scale, floor, sensors), own in _grouped(rows, "case", "scale", "floor", "sensors").items():
        cells = [" / ".join(f"{mean(own, s, f):.1f}" for s in STAGES) for f in FIGURES]
        lines.append([str(case), f"x{scale:g}", _floor(floor), str(sensors), str(len(own)), *cells])
    return _table(head, lines)


def _recovered(rows: Sequence[Row], error: str) -> list[str] | None:
    """Planted, left, claimed, coverage and verdicts."""
    n = numbers(rows, error)
    if not n:
        return None
    factor, unit = UNITS[error]
    left = n["value"] - n["truth"]
    z = np.abs(left / n["sigma"])
    sizes = [f"{factor * np.sqrt(np.mean(v**2)):.3g}" for v in (n["truth"], left, n["sigma"])]
    count = Counter(n["verdict"].tolist())
    verdicts = " / ".join(f"{100 * count[v.value] / len(z):.0f}" for v in Verdict)
    within = f"{100 * np.mean(z < 1):.0f} / {100 * np.mean(z < 2):.0f}"
    return [unit, *sizes, within, verdicts, str(len(z))]


_FOUND = [
    "unit",
    "planted rms",
    "left rms",
    "claimed",
    "within 1 / 2 sigma, %",
    "observed / in doubt / weakly / prior, %",
    "numbers",
]


def alone(rows: Sequence[Row]) -> str:
    """One error after the other."""
    lines = []
    for error in ERRORS:
        own = [r for r in rows if r["case"] == error]
        for (scale, floor), same in _grouped(own, "scale", "floor").items():
            cells = _recovered(same, error)
            if cells:
                lines.append([error, f"x{scale:g}", _floor(floor), *cells])
    return _table(["error", "size", "floor", *_FOUND], lines)


def together(rows: Sequence[Row]) -> str:
    """All errors at once, and the usual ones."""
    lines = []
    own = [r for r in rows if r["case"] in (PLAIN, ALL) and r["sensors"] == "8"]
    for (case, scale, floor), same in _grouped(own, "case", "scale", "floor").items():
        for error in ERRORS:
            cells = _recovered(same, error)
            if cells:
                lines.append([str(case), f"x{scale:g}", _floor(floor), error, *cells])
    return _table(["wrong", "size", "floor", "error", *_FOUND], lines)


def coverage(rows: Sequence[Row]) -> str:
    """Table by verdict, over all estimated errors."""
    lines = []
    for verdict in Verdict:
        z = []
        for error in ERRORS:
            n = numbers(rows, error)
            if n:
                z.append(((n["value"] - n["truth"]) / n["sigma"])[n["verdict"] == verdict.value])
        values = np.abs(np.concatenate(z)) if z else np.zeros(0)
        if len(values):
            shares = [f"{100 * np.mean(values < k):.0f}" for k in (1, 2, 3)]
            lines.append([verdict.value, str(len(values)), *shares, f"{np.median(values) / 0.674:.2f}"])
    head = ["verdict", "numbers", "within 1 sigma, %", "2", "3", "median error over a normal one's"]
    return _table(head, lines)


def chosen_lengths(rows: Sequence[Row]) -> list[Row]:
    """Rows of all errors at once with known floor and 8 sensors, of any length."""
    own = [r for r in rows if r["case"] == ALL and r["scale"] == 1]
    return [r for r in own if r["floor"] and r["sensors"] == "8"]


def lengths(rows: Sequence[Row]) -> str:
    """Errors of joints and verdicts by what is done and for how long."""
    own = chosen_lengths(rows)
    errors = [e for e in ERRORS if numbers(own, e)]
    lines = []
    for (session, seconds), same in sorted(_grouped(own, "session", "seconds").items(), key=_in_order):
        cells = [" / ".join(f"{mean(same, s, f):.0f}" for s in STAGES) for f in FIGURES[:2]]
        lines.append([str(session), f"{seconds:g}", *cells, *(_verdicts(same, e) for e in errors)])
    return _table(["motion", "s", *(f"{h} {' / '.join(STAGES)}" for h in ("rr", "abs")), *errors], lines)


def _in_order(entry: tuple[tuple[object, ...], object]) -> tuple[str, float]:
    """Sort key: motion, then length."""
    (session, seconds), _ = entry
    return str(session), float(str(seconds))


def _verdicts(rows: Sequence[Row], error: str) -> str:
    """Remaining share of a planted error, and its usual verdict."""
    n = numbers(rows, error)
    if not n:
        return ""
    left = np.sqrt(np.mean((n["value"] - n["truth"]) ** 2) / np.mean(n["truth"] ** 2))
    usual, _ = Counter(n["verdict"].tolist()).most_common(1)[0]
    return f"{100 * left:.0f} % {usual.split()[0]}"


def measured(rows: Sequence[Row]) -> str:
    """Remaining errors where all quantities but the measured ones are wrong, largest first."""
    own = [r for r in rows if r["study"] == "measured"]
    same = {_recording(r) for r in own}
    own += [r for r in rows if r["case"] == ALL and r["scale"] == 1 and _recording(r) in same]
    lines = []
    for (case,), some in _grouped(own, "case").items():
        figures = [mean(some, "after", f) for f in FIGURES]
        name = "nothing" if case == ALL else str(case).removeprefix(BUT)
        lines.append((figures, [name, str(len(some)), *(f"{value:.1f}" for value in figures)]))
    head = ["measured", "recordings", *(_HEADS[f] for f in FIGURES)]
    return _table(head, [line for _, line in sorted(lines, reverse=True)])


def harm(rows: Sequence[Row]) -> str:
    """Change of every figure, in percent; the largest over recordings too."""
    own = [r for r in rows if r["study"] == "harm"]

    def change(some: Sequence[Row], figure: str) -> float:
        return 100 * (mean(some, "after", figure) / mean(some, "before", figure) - 1)

    lines = []
    for (keypoints, case, seconds), same in _grouped(own, "keypoints", "case", "seconds").items():
        cells = []
        for f in FIGURES:
            worst = max(change([r], f) for r in same)
            cells.append(f"{mean(same, 'before', f):.1f}: {change(same, f):+.1f} (worst {worst:+.1f})")
        seen = f"{keypoints}, biased" if case == SEEN else str(keypoints)
        lines.append([seen, f"{seconds:g}", str(len(same)), *cells])
    return _table(["2D", "s", "recordings", *(f"{_HEADS[f]}: change, %" for f in FIGURES)], lines)

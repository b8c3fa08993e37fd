"""Tables of the rows of all jobs, and the arithmetic that they need."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence

import numpy as np

from benchmarks import harness
from benchmarks.accuracy.faults import FAULTS, NOMINAL
from benchmarks.accuracy.rows import FIGURES, Row
from rtof_kin.protocols.tables import Cell, Table


def chosen(rows: Iterable[Row], **wanted: str) -> list[Row]:
    """The rows in which the fields named have these values."""
    return [row for row in rows if all(row[name] == value for name, value in wanted.items())]


def paired(rows: Sequence[Row], base: Sequence[Row]) -> list[tuple[Row, Row]]:
    """Rows and base rows of the same motion and camera, where there are both."""
    other = {(row["motion"], row["camera"]): row for row in base}
    keys = [(row["motion"], row["camera"]) for row in rows]
    return [(row, other[key]) for row, key in zip(rows, keys, strict=True) if key in other]


def cost(rows: Sequence[Row], base: Sequence[Row], figure: str) -> tuple[float, list[float]]:
    """Mean difference of a figure, and its 95 % bootstrap interval over source motions."""
    pairs = paired(rows, base)
    values = [row[figure] - other[figure] for row, other in pairs]
    frames = [row["frames"] for row, _ in pairs]
    interval = harness.bootstrap([row["source"] for row, _ in pairs], values, frames)
    return float(np.average(values, weights=frames)), interval


def against_sf2(rows: Sequence[Row]) -> list[Row]:
    """Per motion, kind of 2D and sensors: the solver's root-relative error less that of SF2.

    The interval is the 95 % bootstrap over the motion's second-long stretches of all cameras.
    """
    found, about = [], ("keypoints", "sensors", "motion")
    for key in dict.fromkeys(tuple(row[name] for name in about) for row in rows):
        same = chosen(rows, **dict(zip(about, key, strict=True)))
        solved = [row for row in same if row["mode"] in ("rto", "rtof")]
        seconds = [
            (frames, after, before)
            for row, other in paired(solved, chosen(same, mode="sf2"))
            for (frames, after), (_, before) in zip(row["seconds_rr_mm"], other["seconds_rr_mm"], strict=True)
        ]
        if not seconds:
            continue
        frames, after, before = np.array(seconds).T
        means = [float(np.average(v, weights=frames)) for v in (before, after, after - before)]
        found.append(
            {
                **dict(zip(about, key, strict=True)),
                **dict(zip(("sf2", "solved", "difference"), means, strict=True)),
                "interval": harness.bootstrap(range(len(frames)), after - before, frames),
                "stretches": len(frames),
            }
        )
    return found


def _figures(rows: Sequence[Row]) -> list[Cell]:
    """Cells of `FIGURES` and of the interval; empty ones where there are no rows."""
    if not rows:
        return [*(None for _ in FIGURES), "-"]
    pool = harness.pooled(rows, FIGURES, "source")
    low, high = pool["rr_interval"]
    return [*(pool[name] for name in FIGURES), f"{low:.1f}-{high:.1f}"]


_HEADINGS = (*(heading for heading, _ in FIGURES.values()), "rr 95 %")
_DIGITS = (*(digits for _, digits in FIGURES.values()), 0)
_POOLED = "Means over frames pooled over motions and cameras; intervals are 95 % bootstraps over motions."


def sensors_tables(rows: Sequence[Row]) -> list[Table]:
    """Errors by kind of 2D, sensors and stage; where the solver is worse than SF2."""
    lines: list[tuple[Cell, ...]] = []
    for kind in dict.fromkeys(row["keypoints"] for row in rows):
        same = chosen(rows, keypoints=kind)
        lines.append((kind, "-", "zero motion", *_figures(chosen(same, mode="zero motion"))))
        for count in dict.fromkeys(row["sensors"] for row in same):
            for mode in ("lift", "sf2", *(("rto",) if count == "0" else ("rtof, as given", "rtof"))):
                lines.append((kind, count, mode, *_figures(chosen(same, mode=mode, sensors=count))))
    main = Table(
        "sensors",
        "Sensors",
        ("2D", "sensors", "stage", *_HEADINGS),
        (0, 0, 0, *_DIGITS),
        tuple(lines),
        (_POOLED, "sf2 of no sensors: the lifted pose with the right bone lengths."),
    )
    return [main, *_check_tables(against_sf2(rows))]


def _check_tables(differences: Sequence[Row]) -> list[Table]:
    lines: list[tuple[Cell, ...]] = []
    for kind, count in dict.fromkeys((d["keypoints"], d["sensors"]) for d in differences):
        same = chosen(differences, keypoints=kind, sensors=count)
        worse = [d for d in same if d["difference"] > 0]
        beyond = [d for d in worse if d["interval"][0] > 0]
        lines.append((kind, count, str(len(same)), str(len(worse)), str(len(beyond))))
    exceptions: list[tuple[Cell, ...]] = [
        (
            d["keypoints"],
            d["sensors"],
            d["motion"],
            d["sf2"],
            d["solved"],
            d["difference"],
            "{:.1f} to {:.1f}".format(*d["interval"]),
            str(d["stretches"]),
            "yes" if d["interval"][0] > 0 else "no",
        )
        for d in differences
        if d["difference"] > 0
    ]
    note = (
        "Beyond: the whole 95 % interval of the difference in rr lies above 0. It is a bootstrap over "
        "the motion's second-long stretches of all cameras; those of one camera share its bias, so it "
        "is narrower than it should be and finds too many rather than too few."
    )
    return [
        Table(
            "check",
            "Motions on which the solver is worse than SF2",
            ("2D", "sensors", "motions", "worse", "worse beyond the interval"),
            (0,) * 5,
            tuple(lines),
            (note,),
        ),
        Table(
            "exceptions",
            "Every motion on which it is worse",
            ("2D", "sensors", "motion", "sf2 rr mm", "solver rr mm", "difference", "95 %", "stretches", "beyond"),
            (0, 0, 0, 1, 1, 1, 0, 0, 0),
            tuple(exceptions),
            () if exceptions else ("There is none.",),
        ),
    ]


def _costs(rows: Sequence[Row], base: Sequence[Row], figures: Sequence[str]) -> list[Cell]:
    """Differences to the base, with the interval after the first."""
    if not paired(rows, base):
        return [None, "-", *[None] * (len(figures) - 1)]
    (first, (low, high)), *others = (cost(rows, base, figure) for figure in figures)
    return [first, f"{low:.1f} to {high:.1f}", *(value for value, _ in others)]


def _converged(rows: Sequence[Row]) -> Cell:
    """Share of fragments, %."""
    return 100 * float(np.mean([row["converged"] for row in rows])) if rows else None


def _found(rows: Sequence[Row]) -> Cell:
    """Share of recordings in which a fault of a stream was reported, %."""
    return 100 * float(np.mean([bool(row["found"]) for row in rows])) if rows else None


def robustness_tables(rows: Sequence[Row]) -> list[Table]:
    """Errors under each fault, and around those that come and go."""
    nominal = chosen(rows, case=NOMINAL)
    base = chosen(nominal, mode="rtof")
    lines: list[tuple[Cell, ...]] = [
        (f"{NOMINAL}: {mode}", *_figures(chosen(nominal, mode=mode)), None, "-", *[None] * 4)
        for mode in ("zero motion", "lift", "sf2")
    ]
    for name in dict.fromkeys(row["case"] for row in rows):
        solved = chosen(rows, case=name, mode="rtof")
        start = _figures(chosen(rows, case=name, mode="sf2"))[0]
        costs = _costs(solved, base, ("mpjpe_rr_mm", "mpjpe_mm"))
        lines.append((name, *_figures(solved), *costs, start, _converged(solved), _found(solved)))
    costs_of = ("+ rr", "95 %", "+ abs")
    columns = ("rtof with", *_HEADINGS, *costs_of, "sf2 rr mm", "converged %", "found %")
    digits = (0, *_DIGITS, 1, 0, 1, 1, 0, 0)
    note = "Found: share of recordings in which the pipeline reported a wrong stream."
    main = Table("robustness", "Robustness", columns, digits, tuple(lines), (_POOLED, note))
    return [main, _phases_table(rows, base)]


def _phases_table(rows: Sequence[Row], base: Sequence[Row]) -> Table:
    lines: list[tuple[Cell, ...]] = []
    for name in (name for name, fault in FAULTS.items() if fault.window is not None):
        faulty = chosen(rows, case=name, mode="rtof")
        for column, joints in ((1, "affected"), (2, "all")):
            for label, some in (("faulty", faulty), (NOMINAL, base)):
                lines.append((name, label, joints, *_phases(some, name, column)))
    notes = (
        "Root-relative, mm. During: as long as it lasts, or the first second of what does not end; short "
        "motions have nothing after that.",
        *(f"{n}, affected: {', '.join(f.joints)}." for n, f in FAULTS.items() if f.joints),
    )
    columns = ("rtof with", "recording", "joints", "before", "during", "after")
    digits = (0, 0, 0, 1, 1, 1)
    return Table("phases", "Before, during and after", columns, digits, tuple(lines), notes)


def _phases(rows: Sequence[Row], fault: str, column: int) -> Iterator[float]:
    for phase in range(3):
        parts = np.array([row["phases"][fault][phase] for row in rows]).reshape(-1, 3)
        frames = parts[:, 0].sum()
        yield float(parts[:, 0] @ parts[:, column] / frames) if frames else float("nan")


def ablation_tables(rows: Sequence[Row]) -> list[Table]:
    """Cost of leaving out each term."""
    figures = ("mpjpe_rr_mm", "mpjpe_mm", "flexion_deg", "mpjje")
    lines: list[tuple[Cell, ...]] = []
    for kind in dict.fromkeys(row["keypoints"] for row in rows):
        same = chosen(rows, keypoints=kind)
        for mode in ("zero motion", "lift", "sf2"):
            stage = chosen(same, mode=mode, case=NOMINAL)
            lines.append((kind, mode, *_figures(stage), None, "-", *[None] * 4))
        base: list[Row] = []
        for name in dict.fromkeys(row["case"] for row in same):
            solved = [r for r in chosen(same, case=name) if r["mode"] in ("rto", "rtof")]
            if name.startswith(NOMINAL):
                base = solved
            label = name if name.startswith(NOMINAL) else f"without {name}"
            costs = _costs(solved, base, figures)
            lines.append((kind, label, *_figures(solved), *costs, _converged(solved)))
    costs_of = ("+ rr", "95 %", "+ abs", "+ flexion", "+ MPJJE")
    columns = ("2D", "rtof", *_HEADINGS, *costs_of, "converged %")
    digits = (0, 0, *_DIGITS, 1, 0, 1, 1, 0, 0)
    notes = (
        _POOLED,
        "What is left out costs the difference to the nominal row above it.",
        "The start (SF2) has the sensors' orientation in every row with sensors.",
    )
    return [Table("ablation", "Ablation", columns, digits, tuple(lines), notes)]


def failures(rows: Sequence[Row]) -> list[str]:
    """A line for every case that ended with an error."""
    return [
        f"FAILED: {r['motion']}, camera {r['camera']}, {r['keypoints']}, {r['case']}: {r['error']}"
        for r in chosen(rows, mode="failed")
    ]


TABLES: dict[str, Callable[[Sequence[Row]], list[Table]]] = {
    "sensors": sensors_tables,
    "robustness": robustness_tables,
    "ablation": ablation_tables,
}

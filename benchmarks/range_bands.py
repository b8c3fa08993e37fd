"""Coverage of the bands of ranges of motion: ``python -m benchmarks range_bands --corpus DIR``.

The benchmark's motions of held-out people and rigs (or those of the validation people, ``--subset
validation``), realistic 2D of one of four cameras, which take turns, with 8 sensors and without. The range of
each angle and its two ends are compared with those of the truth in the same frames; so are differences of
range between the sides, the verdict on gait, and the way and turning of the pelvis. Only ranges that a report
compares count (`summary_lines.is_comparable`), and with (all) every one that has a band. Five minutes of
one core.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import track

from benchmarks import harness
from benchmarks.command_line import study_parser
from rtof_kin.body.metrics import at_times
from rtof_kin.clinical.analysis import MotionAnalysis, analyse
from rtof_kin.clinical.angles import ClinicalAngles, all_observed, clinical_angles
from rtof_kin.core.array_types import Array
from rtof_kin.data.confidence import BAND_95
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.reporting.clinical_findings import SECOND_PELVIS
from rtof_kin.reporting.summary_lines import LEAST_DIFFERENCE, is_comparable
from rtof_kin.simulation.mocap import MocapClip, read_corpus, resample_clip
from rtof_kin.simulation.simulate import low_passed

SENSORS = ("8", "0")
MEDIAN_OF_NORMAL = 0.6745  # of the size of a normal error, standard deviations
FEWEST = 10  # frames in which estimate and truth are known
Row = dict[str, Any]


def clips(corpus: Path, subset: str) -> list[MocapClip]:
    """Motions, at most as long as those of the benchmark."""
    if subset == "test":
        return harness.test_clips(corpus)
    found = read_corpus(corpus, harness.mocap_people(subset), output_rate_hz=120.0)
    whole = [resample_clip(low_passed(clip, 10.0), 60.0) for clip in found]
    return [harness.middle(clip, harness.split()["benchmark"]["seconds"]) for clip in whole]


def rows_of(clip: MocapClip, camera: int, sensors: str, seed: int) -> tuple[list[Row], Row]:
    """Ranges of one recording beside those of the truth, and its gait and way beside those of the truth."""
    own = harness.SENSOR_SETS.get(sensors, ())
    recording = harness.recorded(clip, camera, "realistic", own, seed)
    result = reconstruct(recording, mode="rtof" if own else "rto")
    assert recording.truth is not None
    truth = all_observed(at_times(recording.truth, result.motion.times))
    found = analyse(result.motion)
    skeleton = result.motion.skeleton
    true = analyse(skeleton.motion(truth)) if np.isfinite(truth.p_world_joint).all() else None
    about = {"motion": clip.name, "rig": clip.rig, "sensors": sensors}
    ranges = [about | row for row in compared(found, clinical_angles(truth, skeleton))]
    return ranges, about | {
        "is_gait": found.gait.is_gait,
        "truly_gait": true.gait.is_gait if true else None,
        "path_m": found.travel.path_length,
        "true_path_m": true.travel.path_length if true else None,
        "turned_deg": float(np.degrees(found.travel.turned_left - found.travel.turned_right)),
        "true_turned_deg": float(np.degrees(true.travel.turned_left - true.travel.turned_right)) if true else None,
    }


def compared(found: MotionAnalysis, true: ClinicalAngles) -> Iterator[Row]:
    """Each range with a band, and that of the truth in the same frames, degrees."""
    angles = found.angles
    off = (angles.values - true.values + np.pi) % (2 * np.pi) - np.pi
    usable = np.isfinite(angles.trusted_values + off) & ~angles.singular
    for a, row in enumerate(found.ranges):
        own = usable[:, a]
        skipped = row.about_vertical or row.name.startswith(SECOND_PELVIS)
        if own.sum() >= FEWEST and np.isfinite(row.range_sigma) and not skipped:
            values = (angles.values[:, a] - off[:, a])[own]
            ends = {"range": np.ptp(values), "low": values.min(), "high": values.max()}
            yield {"angle": row.name, "comparable": is_comparable(row)} | {
                key: float(np.degrees(value))
                for name, value in ends.items()
                for key, value in (
                    (name, getattr(row, name)),
                    (f"true_{name}", value),
                    (f"{name}_sigma", getattr(row, f"{name}_sigma")),
                )
            }


def side_differences(rows: Sequence[Row]) -> list[Row]:
    """Differences of range, right minus left, of the comparable angles of each recording."""
    known = {(r["motion"], r["sensors"], r["angle"]): r for r in rows if r["comparable"]}
    out = []
    for (motion, sensors, angle), right in known.items():
        if not angle.startswith("right_"):
            continue
        if left := known.get((motion, sensors, angle.replace("right", "left", 1))):
            difference = {key: right[key] - left[key] for key in ("range", "true_range")}
            sigma = float(np.hypot(right["range_sigma"], left["range_sigma"]))
            out.append(right | difference | {"range_sigma": sigma})
    return out


def errors(rows: Sequence[Row], name: str = "range") -> tuple[Array, Array]:
    """Errors and standard deviations of a figure, degrees."""
    error = np.array([row[name] - row[f"true_{name}"] for row in rows])
    return error, np.array([row[f"{name}_sigma"] for row in rows])


def coverage_line(title: str, rows: Sequence[Row], name: str = "range") -> str:
    """One line of a table: number, coverage, bias, median actual and stated error."""
    error, sigma = errors(rows, name)
    inside = 100 * float(np.mean(np.abs(error) <= BAND_95 * sigma))
    stated = float(np.median(sigma)) * MEDIAN_OF_NORMAL
    figures = f"{np.median(error):+.1f} | {np.median(np.abs(error)):.1f} | {stated:.1f}"
    return f"| {title} | {len(rows)} | {inside:.0f} | {figures} |"


HEAD = (
    "| | number | inside 95 % bands, % | median error, deg | median size, deg | stated size, deg |\n" + "|---" * 6 + "|"
)


def table(rows: Sequence[Row], key: Callable[[Row], str]) -> list[str]:
    """A line for each value of a key, by number of sensors."""
    lines = [HEAD]
    for sensors in SENSORS:
        own = [row for row in rows if row["sensors"] == sensors]
        for value in sorted({key(row) for row in own}):
            chosen = [row for row in own if key(row) == value]
            lines.append(coverage_line(f"{sensors} sensors, {value}", chosen))
    return lines


def report(rows: Sequence[Row], recordings: Sequence[Row], subset: str) -> str:
    """The tables as Markdown."""
    used = [row for row in rows if row["comparable"]]
    lines = [
        "# Bands of ranges of motion",
        "",
        f"Made by `python -m benchmarks range_bands --corpus DIR --subset {subset}`: "
        f"{len(recordings)} recordings, realistic 2D of one of four cameras each. Ranges are those that a "
        "report compares; (all): every one with a band. Truth and estimate are of the same frames. The "
        "stated size is the median of a normal error of that standard deviation.",
        "",
        "## All angles",
        "",
        HEAD,
    ]
    sides = side_differences(rows)
    for sensors in SENSORS:
        own, every, pairs = ([r for r in part if r["sensors"] == sensors] for part in (used, rows, sides))
        lines += [
            coverage_line(f"{sensors} sensors: range", own),
            coverage_line(f"{sensors} sensors: low end", own, "low"),
            coverage_line(f"{sensors} sensors: high end", own, "high"),
            coverage_line(f"{sensors} sensors: range (all)", every),
            coverage_line(f"{sensors} sensors: right - left", pairs),
        ]
    lines += ["", "## By rig", "", *table(used, lambda row: str(row["rig"]))]
    single = table(used, lambda row: row["angle"].removeprefix("right_").removeprefix("left_"))
    lines += ["", "## By angle", "", *single, "", "## Findings", "", *stated_differences(sides)]
    return "\n".join([*lines, "", "## Gait and way", "", *gait_and_way(recordings)])


def stated_differences(sides: Sequence[Row]) -> Iterator[str]:
    """Sentences on the side differences that a report would state."""
    for sensors in SENSORS:
        own = [row for row in sides if row["sensors"] == sensors]
        least = np.degrees(LEAST_DIFFERENCE)
        stated = [r for r in own if abs(r["range"]) > max(least, BAND_95 * r["range_sigma"])]
        right = sum(row["range"] * row["true_range"] > 0 for row in stated)
        yield (
            f"- {sensors} sensors: {len(stated)} of {len(own)} differences exceed their band and "
            f"{least:.0f} deg; {right} of these have the sign of the true difference"
        )


def gait_and_way(recordings: Sequence[Row]) -> Iterator[str]:
    """Sentences on the verdicts and the ways of reconstructions beside those of the truth."""
    for sensors in SENSORS:
        own = [r for r in recordings if r["sensors"] == sensors and r["truly_gait"] is not None]
        agree = sum(row["is_gait"] == row["truly_gait"] for row in own)
        gait = sum(row["truly_gait"] for row in own)
        path = np.median([abs(row["path_m"] - row["true_path_m"]) for row in own])
        turn = np.median([abs(row["turned_deg"] - row["true_turned_deg"]) for row in own])
        yield (
            f"- {sensors} sensors: {agree} of {len(own)} recordings have the truth's verdict on gait "
            f"({gait} are gait); median error of the path {path:.2f} m, of the net turn {turn:.0f} deg"
        )


def main(arguments: Sequence[str] | None = None) -> None:
    """Simulate, reconstruct and write the tables."""
    parser = study_parser("range_bands", __doc__)
    parser.add_argument("--subset", choices=["test", "validation"], default="test")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    rows: list[Row] = []
    recordings: list[Row] = []
    for i, clip in enumerate(track(clips(options.corpus, options.subset), "motions")):
        for sensors in SENSORS:
            ranges, whole = rows_of(clip, i % 4, sensors, options.seed)
            rows += ranges
            recordings.append(whole)
    text = report(rows, recordings, options.subset)
    print(harness.write_results(options.out, {"ranges": rows, "recordings": recordings}, text))


if __name__ == "__main__":
    main()

"""How much of a recording a calibration needs.

``python -m benchmarks calibration.excerpt_length --corpus DIR``:
recordings of 20 and 60 s of the validation people and their rigs, by different cameras, with planted errors
(`planting`), each calibrated with every `CalibrationPriors.most_seconds` of `--settings` and reconstructed
with the result. Those of 60 s are motions of one person over and over with other errors of the 2D; where a
setting uses all of a recording, it stands for longer ones. A recording's cost is that of the estimate: its
preparation is shared. An interrupted run resumes where it stopped.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np

from benchmarks import harness
from benchmarks.accuracy.row_file import RowFile, version_of
from benchmarks.calibration.planted_rows import ALL, BUT, FIGURES, PLAIN, SESSIONS, Job, Row, found, recorded, truths
from benchmarks.calibration.planted_tables import numbers
from benchmarks.calibration.sessions import joined
from benchmarks.command_line import study_parser
from lifting.predict import Lifter
from rtof_kin.calibration.estimate import calibrate
from rtof_kin.calibration.result import SelfCalibration
from rtof_kin.calibration.shared_fragments import Slice
from rtof_kin.core.array_types import Array
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.reconstruction.prepare import Job as Reconstructing
from rtof_kin.reconstruction.settings import ReconstructionSettings
from rtof_kin.recording.recording import Recording
from rtof_kin.simulation.mocap import MocapClip
from rtof_kin.solve.settings import JointSpaceSettings

PEOPLE = SESSIONS["validation"] | {"figure of eight": ["pymo_8walk_meredith"]}
BODY = BUT + "heading"
"""Delay, mountings, the detector's biases and the bones are wrong."""
CASES = {BODY: "delay, mounting, bias, bones", ALL: "all", PLAIN: "usual"}
ROUNDS = ((60.0, 0), (20.0, 1), (60.0, 2), (20.0, 3), (20.0, 0), (20.0, 2), (60.0, 1), (60.0, 3))
"""Seconds and camera of a recording of every person."""
SCORED = ReconstructionSettings(confidence=False, checks=False)
"""Nothing that does not move the poses."""


def jobs(rounds: int) -> Iterator[Job]:
    """Recordings; what is wrong changes from one to the next."""
    for i, (seconds, camera) in enumerate(ROUNDS[:rounds]):
        for k, name in enumerate(PEOPLE):
            yield Job("excerpt", name, list(CASES)[(i + k) % len(CASES)], seconds=seconds, camera=camera)


@cache
def clips(corpus: Path) -> dict[str, MocapClip]:
    """Motions by name."""
    names = [name for own in PEOPLE.values() for name in own]
    return {c.name: c for c in harness.whole_clips(corpus, harness.mocap_people("validation"), names)}


def session(corpus: Path, job: Job) -> MocapClip:
    """Motions of one person over and over."""
    own = [clips(corpus)[name] for name in PEOPLE[job.session]]
    return joined(own * 8, job.seconds, job.session)


def rows(corpus: Path, job: Job, settings: Sequence[float], lifter: Lifter) -> list[Row]:
    """One row for every setting that uses more than the one before; None stands for no calibration."""
    right, wrong, given = recorded(session(corpus, job), job)
    about = {"session": job.session, "camera": job.camera, "seconds": job.seconds, "case": CASES[job.case]}
    made, solver = prepared(given, lifter)
    out: list[Row] = [about | {"setting": None} | scored(given, None, lifter)]
    length, enough = float(np.ptp(given.video.times)), False
    for most in sorted(settings):
        if enough:
            break
        enough = most >= length
        began = process_time()
        calibration = calibrate(
            [made], replace(job.priors, most_seconds=most), solver, SCORED.frames, without_slipped=True
        )
        seconds = process_time() - began
        known = truths(right, wrong, calibration.middle)
        row = about | {"setting": most, "cpu_s": round(seconds, 2), "converged": calibration.converged}
        out.append(row | {"found": found(calibration, known)} | scored(given, calibration, lifter))
        print(json.dumps({name: value for name, value in out[-1].items() if name != "found"}), flush=True)
    return out


def prepared(given: Recording, lifter: Lifter) -> tuple[Slice, JointSpaceSettings]:
    """A recording as `calibrate_recording` prepares it, with the compiled problem."""
    job = Reconstructing.of(given, None, lifter, SCORED, None).with_solver(None)
    solver = job.settings.fragment
    assert isinstance(solver, JointSpaceSettings)
    made = job.prepare("sf2")
    assert made.bone_imus is not None  # without IMUs, mode sf2 has raised
    return Slice(made.recording, made.guess, made.bone_imus), solver


def scored(given: Recording, calibration: SelfCalibration | None, lifter: Lifter) -> Row:
    """Errors of the motion."""
    made = reconstruct(given, lifter=lifter, settings=SCORED, calibration=calibration or SelfCalibration(()))
    assert made.metrics is not None
    return {name: round(float(made.metrics[name]), 3) for name in FIGURES}


def by_recording(found_rows: Sequence[Row]) -> list[dict[float | None, Row]]:
    """Recordings, each with a row for every setting; the largest made stands for larger ones."""
    out: dict[tuple[object, ...], dict[float | None, Row]] = {}
    for row in found_rows:
        key = tuple(row[name] for name in ("session", "camera", "seconds", "case"))
        out.setdefault(key, {})[row["setting"]] = row
    every = sorted({r["setting"] for r in found_rows if r["setting"] is not None})
    for own in out.values():
        made = max(s for s in own if s is not None)
        own.update({s: own[made] for s in every if s not in own})
    return list(out.values())


def report(found_rows: Sequence[Row]) -> str:
    """All tables as Markdown."""
    recordings = by_recording(found_rows)
    settings = sorted(s for s in recordings[0] if s is not None)
    parts = []
    for seconds in sorted({own[None]["seconds"] for own in recordings}):
        some = [own for own in recordings if own[None]["seconds"] == seconds]
        parts.append(f"{len(some)} recordings of {seconds:g} s:\n\n{motion(some, settings)}\n")
    if len(parts) > 1:
        parts.append(f"{len(recordings)} recordings, all:\n\n{motion(recordings, settings)}\n")
    parts.append(f"Estimates, all recordings:\n\n{estimates(recordings, settings)}\n")
    return "\n".join(parts)


def motion(recordings: Sequence[dict[float | None, Row]], settings: Sequence[float]) -> str:
    """Errors of joints and cost by setting, and the paired differences from the largest."""
    lines = [
        "| seconds used | rr / abs mm, flexion deg | difference from the last row, ± its standard error "
        "| worse in | CPU s |",
        "|---|---|---|---|---|",
    ]
    last = _values(recordings, settings[-1])
    for setting in (None, *settings):
        own = _values(recordings, setting)
        off, name = own - last, "not calibrated" if setting is None else f"{setting:g}"
        rr, absolute, flexion = own.mean(axis=0)
        cells = _with_error(off)
        worse = " / ".join(str(n) for n in (off > 0).sum(axis=0))
        cost = "" if setting is None else f"{np.mean([r[setting]['cpu_s'] for r in recordings]):.1f}"
        paired = ["", ""] if setting == settings[-1] else [", ".join(cells), worse]
        lines.append(f"| {name} | {rr:.2f} / {absolute:.1f}, {flexion:.2f} | {' | '.join(paired)} | {cost} |")
    return "\n".join(lines)


def _values(recordings: Sequence[dict[float | None, Row]], setting: float | None) -> Array:
    """(R, 3) of `FIGURES`."""
    return np.array([[own[setting][name] for name in FIGURES] for own in recordings])


def estimates(recordings: Sequence[dict[float | None, Row]], settings: Sequence[float]) -> str:
    """Errors in standard deviations of the prior and shares within two claimed, means over recordings, each
    with its paired difference from the largest setting."""
    lines = [
        "| quantity | recordings | " + " | ".join(f"{s:g} s" for s in settings) + " |",
        "|---|---|" + "---|" * len(settings),
    ]
    for name in dict.fromkeys(name for own in recordings for name in own[settings[0]]["found"]):
        some = [own for own in recordings if name in own[settings[0]]["found"]]
        made = {s: np.array([_quality(own[s], name) for own in some]) for s in settings}
        cells = []
        for setting in settings:
            values, off = made[setting].mean(axis=0), made[setting] - made[settings[-1]]
            paired = [""] * 2 if setting == settings[-1] else [f" ({text})" for text in _with_error(off)]
            cells.append("; ".join(f"{v:.2f}{more}" for v, more in zip(values, paired, strict=True)))
        lines.append(f"| {name} | {len(some)} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _quality(row: Row, name: str) -> tuple[float, float]:
    """Root mean square error of an estimate in standard deviations of its prior; share within two claimed."""
    n: dict[str, Any] = numbers([row], name)
    off = n["value"] - n["truth"]
    return float(np.sqrt(np.mean((off / n["prior"]) ** 2))), float(np.mean(np.abs(off / n["sigma"]) < 2))


def _with_error(values: Array) -> list[str]:
    """Means of columns (R, n) with their standard errors."""
    error = values.std(axis=0, ddof=1) / np.sqrt(len(values)) if len(values) > 1 else values[0] * np.nan
    return [f"{m:+.2f} ± {e:.2f}" for m, e in zip(values.mean(axis=0), error, strict=True)]


def main(arguments: list[str] | None = None) -> None:
    """Command line."""
    parser = study_parser("calibration.excerpt_length", __doc__, page="calibration_excerpt.jsonl")
    parser.add_argument("--settings", default="12.5,20,30,60", help="s of a recording that are used")
    parser.add_argument("--rounds", type=int, default=4, choices=range(1, len(ROUNDS) + 1))
    parser.add_argument("--tables", action="store_true", help="of what is there; make no more")
    parser.add_argument("--restart", action="store_true", help="throw away rows of a run cut short")
    options = parser.parse_args(arguments)
    if options.tables:
        lines = options.out.read_text(encoding="utf-8").splitlines()[1:]
        print(report([row for line in lines for row in json.loads(line)["rows"]]))
        return
    settings, lifter = [float(s) for s in options.settings.split(",")], Lifter.load(None)
    file = RowFile(options.out, version_of(settings), options.restart)
    for job in jobs(options.rounds):
        if job.key not in file.rows:
            file.add(job.key, rows(options.corpus, job, settings, lifter))
    print(report([row for own in file.rows.values() for row in own]))


if __name__ == "__main__":
    main()

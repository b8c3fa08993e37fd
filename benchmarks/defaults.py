"""Is every default better on than off?

``python -m benchmarks defaults --corpus DIR`` reconstructs the harness' motions with each default and
without it, realistic 2D, by people and rigs that are held out. A default deserves its place where on is
better than off in the mean and in nine of ten recordings, for each of root-relative and absolute error and
flexion, where changes of less than one per cent are none. A pair of cases (`SWITCHES`) differs in one thing;
rows of a case are shared by its switches.

Guards are classifiers too (`GUARDED`): false alarms per hour of recordings without exchanged sides, and
planted faults that were missed.

Rows are written as they come: an interrupted run resumes where it stopped. A recording of 5 s takes half a
minute on one core.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.progress import track

from benchmarks import harness
from benchmarks.accuracy.faults import FAULTS
from benchmarks.accuracy.row_file import RowFile, version_of
from benchmarks.accuracy.windows import bounds
from benchmarks.command_line import study_parser
from lifting.predict import Lifter
from rtof_kin.calibration.priors import CalibrationPriors
from rtof_kin.core.choices import GUARDS
from rtof_kin.data.imu_stream import FaultKind, StreamFault
from rtof_kin.protocols.tables import Cell, Table
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.reconstruction.prepare import cleaned
from rtof_kin.reconstruction.settings import ReconstructionSettings
from rtof_kin.recording.recording import Recording
from rtof_kin.simulation.mocap import MocapClip
from rtof_kin.solve.settings import JointSpaceSettings

Row = dict[str, Any]
FIGURES = {"mpjpe_rr_mm": "rr mm", "mpjpe_mm": "abs mm", "flexion_deg": "flexion deg"}
HEAD = """# Defaults, on less off

`python -m benchmarks defaults`: realistic 2D, eight sensors where not said otherwise, as given where not said
otherwise. Negative: on is better. *better*: of the recordings whose figure changes by more than one per cent,
those in which it falls. *off*: a figure grows in the mean, or falls in less than nine of ten.

"""
NEEDED = 0.9
"""Share of the recordings that it changes in which a default must be better on than off."""
NEGLIGIBLE = 0.01
"""Relative change of a figure below which a recording counts as unchanged."""
DELAY = CalibrationPriors(sigma_swing=None, sigma_image_bias=None, sigma_ankle_height=None)
"""A calibration of the delay alone."""


@dataclass(frozen=True)
class Case:
    """How recordings are reconstructed."""

    settings: ReconstructionSettings = field(default_factory=ReconstructionSettings)
    calibrate: bool = False
    priors: CalibrationPriors | None = None
    floor: bool = False
    """Whether the floor's height is told."""
    sensors: str = "8"


def _solved(sensors: str = "8", **changes: Any) -> Case:
    """A case with other settings of the fragment solver."""
    return Case(ReconstructionSettings(fragment=JointSpaceSettings(**changes)), sensors=sensors)


def _with(**changes: Any) -> Case:
    return Case(ReconstructionSettings(**changes))


SLACK = ReconstructionSettings(fragment=JointSpaceSettings(sigma_acceleration=2.5, jerk=3.0))
"""Once the solver's settings after a calibration."""
CASES = {
    "usual": Case(),
    "image alone": Case(sensors="0"),
    "calibrated": Case(calibrate=True),
    "calibrated, slack solver": Case(SLACK, calibrate=True),
    "delay alone calibrated": Case(calibrate=True, priors=DELAY),
    "floor": Case(floor=True),
    **{f"no guard {name}": _with(guards=tuple(g for g in GUARDS if g != name)) for name in GUARDS},
    "no sigma_torso": _solved(sigma_torso=None),
    "no sigma_bone": _solved("0", sigma_bone=None),
    "no sigma_root": _solved("0", sigma_root=None),
    "image-only lift": _with(lift_with_sensors=False),
    "no hinges": _solved(hinges=False),
    "no limits": _solved(limits=False),
}
SWITCHES = {
    "calibrate": ("calibrated", "usual"),
    "calibrate the delay alone": ("delay alone calibrated", "usual"),
    "slack solver after a calibration": ("calibrated, slack solver", "calibrated"),
    "floor_height": ("floor", "usual"),
    **{f"guard {name}": ("usual", f"no guard {name}") for name in GUARDS},
    "sigma_torso": ("usual", "no sigma_torso"),
    "sigma_bone without sensors": ("image alone", "no sigma_bone"),
    "sigma_root without sensors": ("image alone", "no sigma_root"),
    "lift_with_sensors": ("usual", "image-only lift"),
    "hinges": ("usual", "no hinges"),
    "limits": ("usual", "no limits"),
}
"""Cases on and off."""
GUARDED: dict[str, tuple[tuple[FaultKind, ...], str]] = {
    "sides": ((FaultKind.SIDES, FaultKind.SIDES_IN_DOUBT), "left and right exchanged for 0.5 s"),
    "person": ((FaultKind.SOMEBODY_ELSE, FaultKind.JUMP), "somebody else followed for 0.5 s"),
    "samples": ((FaultKind.STUCK, FaultKind.SATURATED), "left forearm's sensor sticks halfway"),
    "motion": ((FaultKind.DISAGREES,), "left forearm's sensor slips by 30 deg halfway"),
}
"""What a guard reports, and the fault that is planted for it (`benchmarks.accuracy.faults`)."""


def solved(clip: MocapClip, camera: int, name: str, lifter: Lifter) -> Row:
    """Reconstruct a recording as a case says."""
    case = CASES[name]
    recording = harness.recorded(clip, camera, "realistic", harness.SENSOR_SETS.get(case.sensors, ()), 0)
    result = reconstruct(
        replace(recording, floor_height=0.0) if case.floor else recording,
        mode="rtof" if recording.imus is not None else "rto",
        lifter=lifter,
        settings=replace(case.settings, confidence=False),
        calibrate=case.calibrate,
        priors=case.priors,
    )
    assert result.metrics is not None
    return {figure: result.metrics[figure] for figure in FIGURES}


def guarded(clip: MocapClip, camera: int, lifter: Lifter) -> Row:
    """How often each guard speaks without a fault, and whether it does where one is planted."""
    recording = harness.recorded(clip, camera, "unexchanged", harness.SENSOR_SETS["8"], 0)
    row: Row = {}
    for guard, (reported, fault) in GUARDED.items():
        planted = FAULTS[fault].apply(recording, np.random.default_rng(camera))
        window = bounds(recording.video.times, FAULTS[fault].window or (0.0, 1.0))
        alarms, found = (
            [f for f in found if f.kind in reported]
            for found in (faults(r, guard, lifter) for r in (recording, planted))
        )
        row[guard] = {
            "alarms": len(alarms),
            "missed": not any(f.start < window[1] and f.stop > window[0] for f in found),
        }
    return row


def faults(recording: Recording, guard: str, lifter: Lifter) -> tuple[StreamFault, ...]:
    """What the guards find in a recording; only that of motion needs to solve it."""
    settings = ReconstructionSettings(confidence=False)
    if guard != "motion":
        return cleaned(recording, settings)[1]
    return reconstruct(recording, lifter=lifter, settings=settings, calibrate=False).faults


def measured(clips: Sequence[MocapClip], cameras: int, switches: Sequence[str], guards: bool, file: RowFile) -> None:
    """Make the rows that are missing; those of one recording come together."""
    lifter = Lifter.load()
    wanted = list(dict.fromkeys(case for name in switches for case in SWITCHES[name]))
    jobs = [
        (f"{case}/{clip.name}/{camera}", clip, camera, case)
        for camera in range(cameras)
        for clip in clips
        for case in (*wanted, *(["guards"] if guards else []))
    ]
    for key, clip, camera, case in track([job for job in jobs if job[0] not in file.rows], "recordings"):
        found = guarded(clip, camera, lifter) if case == "guards" else solved(clip, camera, case, lifter)
        about = {"case": case, "motion": clip.name, "rig": clip.rig, "camera": camera}
        held = "rigs" if clip.rig in harness.split()["benchmark"]["rigs"] else "people"
        seconds = float(clip.poses.times[-1])
        file.add(key, [about | {"held out": held, "seconds": seconds} | found])


def changes(rows: Sequence[Row], switch: str, figure: str) -> tuple[list[str], NDArray[np.float64]]:
    """Motion, and figure (n, 2) on and off, of each recording that has both cases."""
    on, off = (
        {(row["motion"], row["camera"]): row[figure] for row in rows if row["case"] == case}
        for case in SWITCHES[switch]
    )
    both = [key for key in on if key in off]
    return [motion for motion, _ in both], np.array([[on[key], off[key]] for key in both])


def verdict(rows: Sequence[Row], switch: str) -> list[Cell]:
    """Cells of a switch: recordings, each figure's change and in how many it falls, and what follows."""
    cells: list[Cell] = []
    harms, helps = False, False
    for figure in FIGURES:
        motions, values = changes(rows, switch, figure)
        change = values[:, 0] - values[:, 1]
        other = np.abs(change) > NEGLIGIBLE * values[:, 1]
        low, high = harness.bootstrap(motions, change, np.ones(len(change)))
        better = float((change[other] < 0).mean()) if other.any() else np.nan
        share = f"{np.sum(change[other] < 0)} of {other.sum()}"
        cells += [f"{change.mean():+.2f} ({low:+.2f} to {high:+.2f})", share]
        good = change.mean() < 0 and better >= NEEDED
        helps, harms = helps or bool(good), harms or bool(other.any() and not good)
    return [len(change), *cells, "off" if harms else "on" if helps else "no effect"]


def tables(rows: Sequence[Row]) -> list[Table]:
    """Switches over all recordings and by what is held out, and guards as classifiers."""
    headings = [h for figure in FIGURES.values() for h in (f"{figure}: on - off (95 %)", "better")]
    found = []
    for held in ("all", "rigs", "people"):
        own = [row for row in rows if held in ("all", row["held out"])]
        known = {row["case"] for row in own}
        lines = [(name, *verdict(own, name)) for name, pair in SWITCHES.items() if known.issuperset(pair)]
        columns = ("default", "recordings", *headings, "verdict")
        digits = (0, 0, *(0, 0) * len(FIGURES), 0)
        title = "All recordings" if held == "all" else f"Held-out {held}"
        found.append(Table(held, title, columns, digits, tuple(lines)))
    seen = [row for row in rows if row["case"] == "guards"]
    hours = sum(row["seconds"] for row in seen) / 3600
    lines = [
        (
            guard,
            sum(row[guard]["alarms"] for row in seen) / hours if hours else np.nan,
            fault,
            sum(row[guard]["missed"] for row in seen),
            len(seen),
        )
        for guard, (_, fault) in GUARDED.items()
    ]
    columns = ("guard", "false alarms per hour", "planted fault", "missed", "of")
    return [*found, Table("guards", "Guards as classifiers", columns, (0, 0, 0, 0, 0), tuple(lines))]


def main(arguments: list[str] | None = None) -> None:
    """Command line."""
    parser = study_parser("defaults", __doc__)
    parser.add_argument("--only", default=",".join([*SWITCHES, "guards"]), help="switches, and 'guards'")
    parser.add_argument("--cameras", type=int, choices=(1, 2, 3, 4), default=2)
    parser.add_argument("--motions", help="names, with commas; default: all of the benchmark")
    parser.add_argument("--seconds", type=float, default=5.0, help="of each motion's middle")
    parser.add_argument("--restart", action="store_true", help="throw rows of other code away")
    options = parser.parse_args(arguments)
    clips = [harness.middle(clip, options.seconds) for clip in harness.test_clips(options.corpus)]
    if options.motions:
        clips = [clip for clip in clips if clip.name in options.motions.split(",")]
    names = options.only.split(",")
    file = RowFile(options.out.with_suffix(".rows"), version_of(options.seconds), options.restart)
    measured(clips, options.cameras, [n for n in names if n != "guards"], "guards" in names, file)
    rows = [row for own in file.rows.values() for row in own]
    text = HEAD + "\n".join(table.markdown() for table in tables(rows))
    print(harness.write_results(options.out, {"seconds": options.seconds, "rows": rows}, text))


if __name__ == "__main__":
    main()

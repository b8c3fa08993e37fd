"""Calibration that goes on while a person moves, beside calibration from a whole recording.

``python -m benchmarks sequential_calibration --corpus DIR`` joins motions of one held-out person (or rig),
again and again where they are short, to 60 s; realistic 2D, 8 sensors. One window of 50 frames in each second
is passed to `SequentialCalibration`, with states that the batch solver finds for it with what is applied by
then: a stand-in for the online estimator. Estimates after 10, 30 and 60 s, and of `calibrate` from all
60 s, are compared with the truth. The states of all windows from 10 s on are compared with those that the
same solver finds without calibration: what a user gets, with what was still wrong at that time.

Cases: nothing planted; the detector's usual delay; delay, headings, mountings planted as well. On the
re-posed rig (``_tc``) the posture of everybody is known and none is that of the prior. Each set of open
unknowns is a variant. An interrupted run resumes where it stopped.
"""

from __future__ import annotations

import sys
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from time import thread_time
from typing import Any

import numpy as np

from benchmarks import harness
from benchmarks.accuracy.row_file import RowFile, version_of
from benchmarks.calibration import planting
from benchmarks.calibration.planted_rows import truths as exact
from benchmarks.calibration.sessions import joined
from benchmarks.command_line import study_parser
from benchmarks.defaults import FIGURES, NEGLIGIBLE
from benchmarks.rerigged import rerigged
from lifting.predict import Lifter
from rtof_kin.body.metrics import evaluate
from rtof_kin.calibration.estimate import calibrate, even_noise
from rtof_kin.calibration.priors import CalibrationPriors
from rtof_kin.calibration.residuals import CalibrationObservations
from rtof_kin.calibration.result import SelfCalibration
from rtof_kin.calibration.sequential import SequentialCalibration, WindowObservations
from rtof_kin.core.array_types import Array
from rtof_kin.core.numerics.levenberg_marquardt import LevenbergMarquardt
from rtof_kin.protocols.tables import Cell, Table
from rtof_kin.reconstruction.prepare import Job, Prepared
from rtof_kin.reconstruction.settings import ReconstructionSettings
from rtof_kin.recording.recording import Recording
from rtof_kin.simulation.detector_errors import DetectorErrors
from rtof_kin.simulation.mocap import MocapClip
from rtof_kin.simulation.simulate import SimulationSettings
from rtof_kin.solve.joint_space.annealing import Annealing
from rtof_kin.solve.joint_space.observations import Observations, low_passed, sensor_data
from rtof_kin.solve.settings import JointSpaceSettings

SESSIONS = {
    "16": ("16_15", "16_16", "16_21", "16_22", "16_31", "16_32", "16_47", "16_58"),
    "02": ("02_06", "02_10", "02_05", "02_07", "02_08"),
    "14": ("14_08",),
    "09": ("09_12", "09_01", "09_03"),
    "snu": ("snu_balance", "snu_dance", "snu_kick", "snu_pirouette"),
    "rokoko": ("ad_rokoko_jesse_dance",),
    "02_tc": ("02_10", "02_06", "02_05", "02_07"),
    "14_tc": ("14_08",),
    "16_tc": ("16_15", "16_16", "16_31", "16_47"),
}
"""Motions of one person; `_tc`: re-posed."""
SECONDS, FROM = 60.0, 10.0  # of a recording, and from when on the effect is measured, s
MOMENTS = (10.0, 30.0, 60.0)
FRAMES = 50
DELAY, HEADING, MOUNTING = 0.03, np.radians(8.0), np.radians(5.0)
"""Planted errors: a delay of either sign, the deviation of headings, the angle of mountings."""
_CLOSED = CalibrationPriors(sigma_delay=None, sigma_swing=None, sigma_image_bias=None, sigma_ankle_height=None)
_ALL = replace(
    _CLOSED, sigma_delay=0.05, sigma_heading=np.radians(8.0), sigma_swing=np.radians(4.0), sigma_twist=np.radians(5.0)
)
VARIANTS = {
    "delay": replace(_CLOSED, sigma_delay=0.05),
    "delay, heading": replace(_CLOSED, sigma_delay=0.05, sigma_heading=np.radians(8.0)),
    "delay, heading, mounting": _ALL,
}
"""What is open."""
STUDIED = {"planted": tuple(VARIANTS)[:3], "right": tuple(VARIANTS), "usual": tuple(VARIANTS)[:2]}
"""Case -> variants."""
BATCH = (("planted", "delay, heading, mounting"),)
"""Case and variant of which the batch calibration is made too."""
Row = dict[str, Any]
Truths = dict[str, dict[str, Array]]
"""Kind -> item -> what a perfect calibration finds."""
HEAD = """# Calibration that goes on while a person moves

`python -m benchmarks sequential_calibration`: see the module. *stated*: mean deviation at 60 s.
*better / worse*: recordings whose figure changes by more than one per cent.

"""


@dataclass(frozen=True)
class Case:
    """One recording."""

    session: str
    camera: int
    case: str
    """'right': nothing is planted. 'usual': the detector is two frames late. 'planted'."""

    @property
    def key(self) -> str:
        """Its name."""
        return f"{self.session}/{self.camera}/{self.case}"


@cache
def session(corpus: Path, name: str) -> MocapClip:
    """Motions of one person, one after the other, again where there are too few."""
    rows, wanted = harness.split(), SESSIONS[name]
    clips = harness.whole_clips(corpus, rows["test"], sorted(set(wanted)))
    by_name = {clip.name: clip for clip in clips}
    chosen = [by_name[n] for n in wanted] * 20
    clip = joined(chosen, SECONDS, name)
    return replace(rerigged(clip), name=name) if name.endswith("_tc") else clip


def recorded(clip: MocapClip, case: Case) -> tuple[Recording, Truths]:
    """The recording, and kind -> item -> truth of what is wrong."""
    detector = DetectorErrors(delay_frames=(2 if case.case == "usual" else 0,))
    own = zlib.crc32(clip.name.encode())
    settings = SimulationSettings(keypoints=detector, sensors=harness.SENSOR_SETS["8"])
    recording = harness.filmed(clip, own, case.camera, settings)
    rng = np.random.default_rng([own, case.camera])
    wrong: planting.Wrong = {}
    if case.case == "planted":
        assert recording.calibration is not None
        sensors, axes = recording.calibration.joints, rng.standard_normal((8, 3))
        axes /= np.linalg.norm(axes, axis=1, keepdims=True)
        wrong = {
            "delay": {"video": DELAY * rng.choice([-1.0, 1.0], 1)},
            "heading": {joint: HEADING * rng.standard_normal(1) for joint in sensors},
            "mounting": dict(zip(sensors, MOUNTING * axes, strict=True)),
        }
    known = exact(recording, wrong)
    known["delay", "video"] = known["delay", "video"][:1] + (2 / 60 if case.case == "usual" else 0.0)
    truths: Truths = {}
    for (kind, item), value in known.items():
        truths.setdefault(kind, {})[item] = value[:1] if kind == "heading" else value
    recording = planting.with_late_video(recording, planting.unknowns(recording, wrong)["delay", "video"])
    return planting.with_turned_sensors(recording, planting.unknowns(recording, wrong)), truths


class StandIn:
    """Windows of a recording with states that the batch solver finds, as an online estimator would."""

    def __init__(self, job: Job, prepared: Prepared) -> None:
        """Collect the observations of the recording."""
        recording, solver = prepared.recording, job.settings.fragment
        assert isinstance(solver, JointSpaceSettings)
        truth = recording.truth
        assert truth is not None
        assert recording.imus is not None
        assert recording.calibration is not None
        native = recording.calibration.apply(recording.imus)
        self.settings, self.times = solver, prepared.start.times
        self.start, self.truth, self.skeleton = prepared.start, truth, prepared.skeleton
        self.data, again = (
            Observations(
                prepared.skeleton,
                FRAMES,
                solver,
                prepared.guess,
                prepared.recording.video,
                native.resample(self.times),
                places=native.joints,
            )
            for _ in range(2)
        )
        self.problem = again.problem
        self.given = CalibrationObservations(
            self.times, self.data.rows, self.data.constant, self.data.a_world, self.data.w_acceleration
        )
        slow = low_passed(even_noise(native), solver)
        assert slow is not None
        self._sensors = slow
        self._solver = LevenbergMarquardt(self.data.problem, self.data.limits)

    def window(self, first: int, found: SequentialCalibration) -> WindowObservations:
        """Frames from `first`, solved with what is applied."""
        data, part, given = self.data, slice(first, first + FRAMES), self.given
        rows = {name: values[part] for name, values in given.rows.items()}
        own = CalibrationObservations(
            self.times[part], rows, given.constant, given.a_world[part], given.w_acceleration[part]
        )
        near = slice(*np.searchsorted(self._sensors.times, own.times[[0, -1]] + [-0.5, 0.5]).tolist())
        sensors = self._sensors[near]  # what an estimator keeps

        def sampled(times: Array) -> tuple[Array, Array, Array, Array]:
            q, w, a, w_a, _ = sensor_data(times, sensors, data.sensors, self.settings)
            return q, w, a, w_a

        corrected = found.applied(own, sampled)
        values = corrected.fragment(0, FRAMES)
        data.problem.bind(values)
        s = self.settings
        annealing = Annealing(s, data.problem, data.confidence[part], data.points.sizes, values.observation)
        solved = self._solver.solve(data.start[part], s.annealing + s.max_iterations, s.tolerance, None, annealing)
        variance = annealing.sigma**2
        knee = s.robust_reprojection / s.largest_correlation_factor
        own = own.changed(w_visual=data.confidence[part] / variance, knee_visual=np.full((FRAMES, 1), knee))
        return WindowObservations(own, solved.x, sampled, solved.multipliers)

    def figures(self, first: int, x: Array, delay: float) -> dict[str, float]:
        """Errors of the states of a window, whose stamps are late by a delay, s."""
        poses = self.start.with_poses(slice(first, first + FRAMES), *self.data.space.poses(x))
        poses = replace(poses, times=poses.times - delay)
        found = dict(evaluate(poses, self.truth, self.skeleton))
        return {name: float(found[name]) for name in FIGURES}


@dataclass(frozen=True)
class Passed:
    """What one pass of a recording found."""

    after: dict[float, SelfCalibration]
    """Moment -> calibration."""
    seconds: list[float]
    """CPU time of every slice, s."""
    figures: dict[str, float]
    """Errors of the states, in the mean of the windows."""


def passed(stand_in: StandIn, found: SequentialCalibration, learns: bool = True) -> Passed:
    """Pass the recording once; without learning nothing is estimated."""
    after, seconds, figures = dict[float, SelfCalibration](), list[float](), list[dict[str, float]]()
    since = stand_in.times - stand_in.times[0]
    for moment in np.arange(1.0, SECONDS + 0.1):
        first = int(np.searchsorted(since, moment)) - FRAMES
        if first >= 0 and first + FRAMES <= len(since):
            delay = found.corrections(1.0).delay
            window = stand_in.window(first, found)
            if moment > FROM:
                figures.append(stand_in.figures(first, window.x, delay))
            slices, done = found.update(window), not learns
            while not done:
                began = thread_time()
                done = next(slices, True) is True
                seconds.append(thread_time() - began)
        if moment in MOMENTS:
            after[float(moment)] = found.as_self_calibration()
    means = {name: float(f"{np.mean([f[name] for f in figures]):.5g}") for name in FIGURES}
    return Passed(after, seconds, means)


def errors(found: SelfCalibration, truths: Truths) -> dict[str, list[float]]:
    """Kind -> root mean squares of the truth, of what remains of it, and of the stated deviations."""
    out = {}
    for kind in dict.fromkeys(q.kind for q in found.quantities):
        applied, truth = found.of_kind(kind), truths.get(kind, {})
        off = [applied.get(item, np.zeros_like(value)) - value for item, value in truth.items()]
        stated = [q.sigma for q in found.quantities if q.kind == kind]
        if off:
            sizes = (np.sqrt(np.mean(np.square(v))) for v in (list(truth.values()), off, stated))
            out[kind] = [float(f"{size:.4g}") for size in sizes]
    return out


def rows_of(corpus: Path, case: Case, lifter: Lifter) -> Iterator[Row]:
    """What each variant finds, and what it does to the poses."""
    recording, truths = recorded(session(corpus, case.session), case)
    settings = ReconstructionSettings(confidence=False)
    job = Job.of(recording, None, lifter, settings, None).with_solver(None)
    prepared = job.prepare("sf2")
    stand_in = StandIn(job, prepared)

    def sequential(variant: str) -> SequentialCalibration:
        return SequentialCalibration(stand_in.problem, stand_in.settings, VARIANTS[variant])

    before = passed(stand_in, sequential("delay"), learns=False)
    yield {**vars(case), "variant": "", "how": "none", **before.figures}
    for variant in STUDIED[case.case]:
        about, found = {**vars(case), "variant": variant}, sequential(variant)
        run = passed(stand_in, found)
        for moment, calibration in run.after.items():
            row = {**about, "how": f"{moment:g} s", "errors": errors(calibration, truths)}
            if moment == SECONDS:
                times = np.percentile(run.seconds, [50, 99, 100])
                row |= {**run.figures, "slices_ms": [float(f"{1e3 * v:.3g}") for v in times]}
                row["slices"] = len(run.seconds) / max(found.windows, 1)
            yield row
        if (case.case, variant) in BATCH:
            batch = calibrate(prepared.recording, prepared.guess, VARIANTS[variant], stand_in.settings, FRAMES)
            yield {**about, "how": "batch", "errors": errors(batch, truths)}


def tables(rows: list[Row]) -> list[Table]:
    """What remains of the errors, what it does, and in how many recordings."""
    remaining: list[tuple[Cell, ...]] = []
    effects: list[tuple[Cell, ...]] = []
    moments = tuple(f"{m:g} s" for m in MOMENTS)
    before = {(r["session"], r["camera"], r["case"]): r for r in rows if r["how"] == "none"}
    for case, variant in [(name, variant) for name in STUDIED for variant in STUDIED[name]]:
        own = [r for r in rows if (r["case"], r["variant"]) == (case, variant)]
        for kind in dict.fromkeys(k for r in own for k in r["errors"]):
            factor = 1e3 if kind == "delay" else float(np.degrees(1.0))
            sizes = {
                how: factor * np.sqrt(np.mean([np.square(r["errors"][kind]) for r in group], axis=0))
                for how in (*moments, "batch")
                if (group := [r for r in own if r["how"] == how and kind in r["errors"]])
            }
            last = sizes[f"{SECONDS:g} s"]
            told = [sizes.get(how, np.full(3, np.nan))[1] for how in (*moments, "batch")]
            remaining.append((case, variant, kind, float(last[0]), *map(float, told), float(last[2])))
        shown, group = list[Cell](), [r for r in own if "flexion_deg" in r]
        for figure in FIGURES if group else ():
            off = np.array([before[r["session"], r["camera"], case][figure] for r in group])
            change = np.array([r[figure] for r in group]) - off
            moved = np.abs(change) > NEGLIGIBLE * off
            shown += [f"{off.mean():.1f}", f"{change.mean():+.2f}"]
            shown += [f"{np.sum(change[moved] < 0)} / {np.sum(change[moved] > 0)}"]
        if group:
            effects.append((case, variant, len(group), *shown))
    headings = tuple(h for f in FIGURES.values() for h in (f, "change", "better / worse"))
    return [
        Table(
            "remaining",
            "Errors of the calibration, root mean square, ms and degrees",
            ("case", "open", "of", "before", *moments, "batch", "stated"),
            (0, 0, 0, 1, 1, 1, 1, 1, 1),
            tuple(remaining),
        ),
        Table(
            "effects", "Effect from 10 to 60 s", ("case", "open", "recordings", *headings), (0,) * 12, tuple(effects)
        ),
    ]


def main(arguments: list[str] | None = None) -> None:
    """Command line."""
    parser = study_parser("sequential_calibration", __doc__)
    parser.add_argument("--sessions", default=",".join(SESSIONS), help="some, separated by commas")
    parser.add_argument("--cameras", type=int, default=1, choices=range(1, 5))
    parser.add_argument("--restart", action="store_true", help="throw rows of other code away")
    options = parser.parse_args(arguments)
    file = RowFile(options.out.with_suffix(".rows"), version_of(), options.restart)
    lifter = Lifter.load()
    for camera in range(options.cameras):
        for case in STUDIED:
            for name in options.sessions.split(","):
                one = Case(name, camera, case)
                if one.key not in file.rows:
                    print(one.key, file=sys.stderr, flush=True)
                    file.add(one.key, list(rows_of(options.corpus, one, lifter)))
    rows = [row for own in file.rows.values() for row in own]
    text = HEAD + "\n".join(table.markdown() for table in tables(rows))
    print(harness.write_results(options.out, {"rows": rows}, text))


if __name__ == "__main__":
    main()

"""Calibration that goes on while a person moves, beside calibration from a whole recording.

``python -m benchmarks.sequential_calibration --corpus DIR`` joins motions of one held-out person (or rig),
again and again where they are short, to 70 s; realistic 2D, 8 sensors. Of the first 60 s, one window of 50
frames in each second is passed to `SequentialCalibration`, with states that the batch solver finds for it
with what is applied by then: a stand-in for the online estimator. Estimates after 10, 30 and 60 s, and of
`calibrate` from all 60 s, are compared with the truth, and applied to the last 10 s, which no
calibration has seen.

Cases: nothing planted; the detector's usual delay; delay, headings, mountings planted as well. On the
re-posed rig (``_tc``) the posture of everybody is known and none is that of the prior. Each set of open
unknowns is a variant. An interrupted run resumes where it stopped.
"""

from __future__ import annotations

import argparse
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
from benchmarks.calibration.sessions import joined
from benchmarks.rerigged import rerigged, t_pose
from lifting.predict import Lifter
from rtof_kin.body.neutral_posture import JOINTS, NeutralPosture
from rtof_kin.calibration.estimate import calibrate, even_noise
from rtof_kin.calibration.priors import CalibrationPriors
from rtof_kin.calibration.residuals import CalibrationObservations
from rtof_kin.calibration.result import SelfCalibration
from rtof_kin.calibration.sequential import SequentialCalibration, WindowObservations
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.numerics.levenberg_marquardt import LevenbergMarquardt
from rtof_kin.protocols.tables import Cell, Table
from rtof_kin.reconstruction.job import Job
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.reconstruction.prepare import Prepared
from rtof_kin.reconstruction.settings import ReconstructionSettings
from rtof_kin.recording.recording import Recording
from rtof_kin.simulation.detector_errors import DetectorErrors
from rtof_kin.simulation.mocap import MocapClip
from rtof_kin.simulation.simulate import SimulationSettings, simulate, standard_cameras
from rtof_kin.solve.joint_space.annealing import Annealing
from rtof_kin.solve.joint_space.observations import Observations, low_passed, sensor_data
from rtof_kin.solve.joint_space.settings import JointSpaceSettings

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
SECONDS, LAST = 60.0, 10.0
"""[s] that are calibrated from, and that the effect is measured on."""
MOMENTS = (10.0, 30.0, 60.0)
FRAMES = 50
DELAY, HEADING, MOUNTING = 0.03, np.radians(8.0), np.radians(5.0)
"""Planted errors: a delay of either sign, the deviation of headings, the angle of mountings."""
_CLOSED = CalibrationPriors(
    sigma_delay=None, sigma_swing=None, sigma_image_bias=None, sigma_ankle_height=None
)
_ALL = replace(
    _CLOSED, sigma_delay=0.05, sigma_heading=np.radians(8.0), sigma_swing=np.radians(4.0),
    sigma_twist=np.radians(5.0),
)  # fmt: skip
VARIANTS = {
    "delay": replace(_CLOSED, sigma_delay=0.05),
    "delay, heading": replace(_CLOSED, sigma_delay=0.05, sigma_heading=np.radians(8.0)),
    "delay, mounting": replace(_ALL, sigma_heading=None),
    "delay, heading, mounting": _ALL,
    "posture": replace(_CLOSED, sigma_posture=np.radians(5.0)),
}
"""What is open."""
STUDIED = {
    "right": tuple(VARIANTS),
    "usual": ("delay", "delay, heading, mounting"),
    "planted": ("delay", "delay, heading, mounting"),
}
"""Case -> variants."""
FULL = (("planted", "delay, heading, mounting"), ("right", "delay, heading, mounting"))
"""Case and variant of which the batch calibration is made too, and other thresholds are tried."""
THRESHOLDS = {"60 s, all": 0.0, "60 s, 3 sigma": 3.0}
"""Other values of `Pace.significant`."""
FIGURES = {"mpjpe_rr_mm": "rr mm", "mpjpe_mm": "abs mm", "flexion_deg": "flexion deg"}
NEGLIGIBLE = 0.01
"""Relative change of a figure below which a recording counts as unchanged."""
Row = dict[str, Any]
Truths = dict[str, dict[str, Array]]
"""Kind -> item -> what a perfect calibration finds."""
HEAD = """# Calibration that goes on while a person moves

`python -m benchmarks.sequential_calibration`: held-out people and rigs, 60 s, realistic 2D, eight sensors;
see the module. *stated*: mean deviation at 60 s. *better / worse*: recordings whose figure changes by more
than one per cent.

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
    clip = joined(chosen, SECONDS + LAST, name)
    return replace(rerigged(clip), name=name) if name.endswith("_tc") else clip


def recorded(clip: MocapClip, case: Case) -> tuple[Recording, Truths]:
    """The recording, and kind -> item -> truth of what is wrong."""
    detector = DetectorErrors(delay_frames=(2 if case.case == "usual" else 0,))
    own = zlib.crc32(clip.name.encode())
    settings = SimulationSettings(keypoints=detector, sensors=harness.SENSOR_SETS["8"])
    recording = simulate(
        clip.poses, clip.joint_offsets, camera=standard_cameras(clip.poses, own)[case.camera],
        settings=settings, seed=own + case.camera, name=clip.name,
    )  # fmt: skip
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
    known = planting.unknowns(recording, wrong)
    for joint, slip in planting.slips(recording).items():
        known["mounting", joint] = so3.log(so3.exp(known["mounting", joint]) @ so3.exp(slip))
    known["delay", "video"] = known["delay", "video"][:1] + (2 / 60 if case.case == "usual" else 0.0)
    truths: Truths = {}
    for (kind, item), value in known.items():
        truths.setdefault(kind, {})[item] = value[:1] if kind == "heading" else value
    recording = planting.with_late_video(recording, planting.unknowns(recording, wrong)["delay", "video"])
    return planting.with_turned_sensors(recording, planting.unknowns(recording, wrong)), truths


def part(recording: Recording, start: float, stop: float) -> Recording:
    """Between two times of the video."""
    seen, truth, imus = recording.video, recording.truth, recording.imus
    assert truth is not None
    assert imus is not None
    frames = slice(*np.searchsorted(seen.times, [start, stop]).tolist())
    own = slice(*np.searchsorted(imus.times, [start - 0.5, stop + 0.5]).tolist())
    cut = replace(
        imus, times=imus.times[own], R_inertial_sensor=imus.R_inertial_sensor[own],
        f_sensor=imus.f_sensor[own],
    )  # fmt: skip
    return replace(recording, keypoints=seen[frames], truth=truth[frames], imus=cut)


class StandIn:
    """Windows of a recording with states that the batch solver finds, as an online estimator would."""

    def __init__(self, job: Job, prepared: Prepared) -> None:
        """Collect the observations of the recording."""
        recording, solver = prepared.recording, job.settings.fragment
        assert isinstance(solver, JointSpaceSettings)
        assert recording.imus is not None
        assert recording.calibration is not None
        native = recording.calibration.apply(recording.imus)
        self.settings, self.times = solver, prepared.start.times
        self.data, again = (
            Observations(
                prepared.skeleton, FRAMES, solver, prepared.guess, prepared.keypoints,
                native.resample(self.times), places=native.joints,
            )
            for _ in range(2)
        )  # fmt: skip
        self.problem = again.problem
        self.given = CalibrationObservations.of(self.data, self.times)
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
        solved = self._solver.solve(
            data.start[part], s.annealing + s.max_iterations, s.tolerance, None, annealing
        )
        variance = annealing.sigma**2
        knee = s.robust_reprojection / s.largest_correlation_factor
        own = own.changed(
            w_visual=data.confidence[part] / variance, knee_visual=np.full((FRAMES, 1), knee)
        )
        return WindowObservations(own, solved.x, sampled, solved.multipliers)


Passed = tuple[dict[float, SelfCalibration], list[float]]


def passed(stand_in: StandIn, found: SequentialCalibration) -> Passed:
    """Pass the recording once; calibration after each of the moments, and CPU time of every slice, s."""
    after, seconds = dict[float, SelfCalibration](), list[float]()
    since = stand_in.times - stand_in.times[0]
    for moment in np.arange(1.0, SECONDS + 0.1):
        first = int(np.searchsorted(since, moment)) - FRAMES
        if first >= 0 and first + FRAMES <= len(since):
            found.corrections(1.0)
            slices, done = found.update(stand_in.window(first, found)), False
            while not done:
                began = thread_time()
                done = next(slices, True) is True
                seconds.append(thread_time() - began)
        if moment in MOMENTS:
            after[float(moment)] = found.as_self_calibration()
    return after, seconds


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
    """What each variant finds, and what it does to the last seconds."""
    recording, truths = recorded(session(corpus, case.session), case)
    first, last = part(recording, 0.0, SECONDS), part(recording, SECONDS, SECONDS + LAST)
    settings = ReconstructionSettings(confidence=False)
    own = Job.of(first, None, lifter, settings, None).with_solver(None)
    prepared = own.prepare("sf2")
    stand_in = StandIn(own, prepared)
    if case.session.endswith("_tc"):
        truths["posture"] = postures(corpus, case.session, prepared)

    def effect(found: SelfCalibration | None) -> Row:
        made = reconstruct(last, lifter=lifter, settings=settings, calibrate=False, calibration=found)
        assert made.metrics is not None
        return {name: float(f"{made.metrics[name]:.5g}") for name in FIGURES}

    before = effect(None)
    yield {**vars(case), "variant": "", "how": "none", **before}
    for variant in STUDIED[case.case]:
        priors, about = VARIANTS[variant], {**vars(case), "variant": variant}
        found = SequentialCalibration(stand_in.problem, stand_in.settings, priors)
        after, seconds = passed(stand_in, found)
        for moment, calibration in after.items():
            row = {**about, "how": f"{moment:g} s", "errors": errors(calibration, truths)}
            if moment == SECONDS or (case.case == "planted" and moment == MOMENTS[0]):
                row |= effect(calibration)
            if moment == SECONDS:
                row["slices_ms"] = [float(f"{1e3 * v:.3g}") for v in np.percentile(seconds, [50, 99, 100])]
                row["slices"] = len(seconds) / max(found.windows, 1)
            yield row
        if (case.case, variant) not in FULL:
            continue
        for how, least in THRESHOLDS.items():
            other = found.as_self_calibration(least)
            yield {**about, "how": how, "errors": errors(other, truths), **effect(other)}
        batch = calibrate(
            replace(prepared.recording, keypoints=prepared.keypoints), prepared.guess, priors,
            stand_in.settings, FRAMES,
        )  # fmt: skip
        yield {**about, "how": "batch", "errors": errors(batch, truths), **effect(batch)}


def postures(corpus: Path, name: str, prepared: Prepared) -> dict[str, Array]:
    """Joint -> how the prior's mean differs from that about the person's posture, in the parent's axes."""
    wanted = SESSIONS[name]
    clips = harness.whole_clips(corpus, harness.split()["test"], sorted(set(wanted)))
    local = {joint: R for joint, R in t_pose(clips[0]).items() if joint in JOINTS}
    posture = NeutralPosture(tuple(local), so3.to_quat_wxyz(np.stack(list(local.values()))))
    prior = prepared.skeleton.table.prior
    known = so3.from_quat_wxyz(prior.about(posture).mean_quat_wxyz)
    mean = so3.from_quat_wxyz(prior.mean_quat_wxyz)
    at = {joint: prior.joints.index(joint) - 1 for joint in local}
    return {joint: so3.log(known[j] @ mean[j].T) for joint, j in at.items()}


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
                for how in (*moments, *THRESHOLDS, "batch")
                if (group := [r for r in own if r["how"] == how and kind in r["errors"]])
            }
            last = sizes[f"{SECONDS:g} s"]
            told = [sizes.get(how, np.full(3, np.nan))[1] for how in (*moments, *THRESHOLDS, "batch")]
            remaining.append((case, variant, kind, float(last[0]), *map(float, told), float(last[2])))
        for how in (f"{MOMENTS[0]:g} s", f"{SECONDS:g} s", *THRESHOLDS, "batch"):
            shown, group = list[Cell](), [r for r in own if r["how"] == how and "flexion_deg" in r]
            if not group:
                continue
            for figure in FIGURES:
                off = np.array([before[r["session"], r["camera"], case][figure] for r in group])
                change = np.array([r[figure] for r in group]) - off
                moved = np.abs(change) > NEGLIGIBLE * off
                shown += [f"{off.mean():.1f}", f"{change.mean():+.2f}"]
                shown += [f"{np.sum(change[moved] < 0)} / {np.sum(change[moved] > 0)}"]
            effects.append((case, variant, how, len(group), *shown))
    headings = tuple(h for f in FIGURES.values() for h in (f, "change", "better / worse"))
    return [
        Table(
            "remaining", "Errors of the calibration, root mean square, ms and degrees",
            ("case", "open", "of", "before", *moments, *THRESHOLDS, "batch", "stated"),
            (0, 0, 0, 1, 1, 1, 1, 1, 1, 1, 1),
            tuple(remaining),
        ),
        Table(
            "effects", "Effect on the last 10 s",
            ("case", "open", "by", "recordings", *headings), (0,) * 13, tuple(effects),
        ),
    ]  # fmt: skip


def main(arguments: list[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.sequential_calibration", description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument("--corpus", type=Path, required=True, help="folder of free motion")
    parser.add_argument("--sessions", default=",".join(SESSIONS), help="some, separated by commas")
    parser.add_argument("--cases", default=",".join(STUDIED))
    parser.add_argument("--cameras", type=int, default=1, choices=range(1, 5))
    parser.add_argument("--restart", action="store_true", help="throw rows of other code away")
    parser.add_argument(
        "--out", type=Path, default=harness.HERE / "results" / "sequential_calibration.json"
    )
    options = parser.parse_args(arguments)
    file = RowFile(options.out.with_suffix(".rows"), version_of(), options.restart)
    lifter = Lifter.load()
    for camera in range(options.cameras):
        for case in options.cases.split(","):
            for name in options.sessions.split(","):
                one = Case(name, camera, case)
                if one.key not in file.rows:
                    print(one.key, file=sys.stderr, flush=True)
                    file.add(one.key, list(rows_of(options.corpus, one, lifter)))
    rows = [row for own in file.rows.values() for row in own]
    text = HEAD + "\n".join(table.markdown() for table in tables(rows))
    harness.write_results(options.out, {"rows": rows}, text)
    print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())

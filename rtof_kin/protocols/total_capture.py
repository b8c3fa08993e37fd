"""The paper's protocol on Total Capture.

A job is one take seen by one camera: all modes, and the studies of fragment length and k_V. One more job per
take scores what needs no camera (no motion, and the truth low-passed at 6 Hz) and checks the take's files.
The tables of the paper have the measured figures beside the published ones.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from time import perf_counter
from typing import Any, Final

import numpy as np

from rtof_kin.body.metrics import evaluate, motionless
from rtof_kin.body.pose_prior import NeutralPosture
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import indices_of, some
from rtof_kin.core.choices import CAMERA_MODES, SPACES, Space
from rtof_kin.core.errors import FileFormatError, InvalidInputError
from rtof_kin.core.jobs import JobResult, Outcome
from rtof_kin.core.resources import lifter_path
from rtof_kin.data.poses import PoseSequence
from rtof_kin.datasets.total_capture import (
    SUBJECTS,
    TEST,
    TRAIN,
    Take,
    TotalCapture,
    check_camera,
    check_keypoints,
    check_take,
)
from rtof_kin.datasets.total_capture_files import read_detections
from rtof_kin.protocols import published
from rtof_kin.protocols.measures import CameraProtocol, Job, curves, reconstructions, save_motion
from rtof_kin.protocols.tables import LOW_PASSED, STILL, Table, pooled, rows_of
from rtof_kin.reconstruction.result import Reconstruction
from rtof_kin.reconstruction.settings import ReconstructionSettings
from rtof_kin.recording.tables import RECOGNISE
from rtof_kin.reporting.document import Cell
from rtof_kin.simulation.simulate import LIMB_SENSORS
from rtof_kin.solve.fragment_solver import FragmentSolver
from rtof_kin.solve.settings import CartesianSettings
from rtof_kin.vision.layouts import detector_table

TEST_TAKES = ("walking2", "acting3", "freestyle3")
CAMERAS = (1, 3, 4, 5, 6, 7, 8)  #: All cameras but the miscalibrated camera 2
SENSOR_SETS = {
    "8": LIMB_SENSORS,
    "10": (*LIMB_SENSORS, "Pelvis", "Sternum"),
    "13": (*LIMB_SENSORS, "Pelvis", "Sternum", "Head", "L_Foot", "R_Foot"),
}
"""Sets of sensors: the paper's eight on the limbs, with the trunk, all."""
_NAMES: Final = (
    "Hips RightUpLeg RightLeg RightFoot LeftUpLeg LeftLeg LeftFoot Spine Neck Head "
    "LeftArm LeftForeArm LeftHand RightArm RightForeArm RightHand"
)
SIXTEEN = tuple(_NAMES.split())  #: Joints of the multi-view papers (GeoFuse and those after it)
SIXTEEN_CAMERAS, SIXTEEN_STEP = (1, 3, 5, 7), 16
"""Cameras of the multi-view papers, and their step between scored frames."""
POSTURES: Final = {
    "take": "of the first T-pose",
    "person": "of the T-poses of the subject's other takes",
    "unknown": "unknown",
}
"""Source of the neutral posture -> in words."""
_LOW_PASS_HZ: Final = 6.0
_KNEE: Final = "RightLeg"


@dataclass(frozen=True)
class TotalCaptureProtocol(CameraProtocol):
    """Settings of the measurements."""

    title = "Total Capture"
    rate_hz = 60.0
    skeleton = "total_capture"

    root: Path  #: Folder of the dataset
    subjects: tuple[str, ...] = SUBJECTS  #: Subjects that are measured
    takes: tuple[str, ...] = TEST_TAKES  #: Takes of each subject; default: the paper's three test takes
    cameras: tuple[int, ...] = CAMERAS  #: Numbers of the cameras; camera 2 is miscalibrated
    keypoints: Path | None = None  #: Folder with a detector's 2D; default: ground-truth 2D
    layout: str | None = None
    """Layout of the detector's points, such as body25, coco17 or mediapipe33, or auto to have it recognised; default:
    landmarks of the skeleton."""
    noise_px: float = 0.0  #: Standard deviation of white noise added to ground-truth 2D, px per axis
    sensors: tuple[str, ...] = LIMB_SENSORS  #: Names of the sensors, or 8, 10 or 13 for the sets of the paper
    space: Space = SPACES[0]  #: Variables of the fragment solver; the studies use those of the paper
    modes: tuple[str, ...] = CAMERA_MODES  #: Stages to measure
    lifter: Path | None = None  #: A file, or the name of a shipped one; the shipped default where not given
    calibrate: bool = False  #: Whether every take is self-calibrated first; the paper does not
    posture: tuple[str, ...] = ("take",)
    """Where the subject's neutral posture is from: take: its first T-pose, as bone lengths; person: the T-poses of the
    subject's other takes; unknown, or none. Of several the first is that of all tables, and one table compares them."""
    studies: bool = True  #: Whether fragment length and k_V are varied too
    seed: int = 0  #: Seed of the noise
    save: Path | None = None  #: Folder for the motions of every take, camera and mode, if wanted

    def __post_init__(self) -> None:
        object.__setattr__(self, "subjects", tuple(name.upper() for name in self.subjects))
        object.__setattr__(self, "takes", tuple(name.lower() for name in self.takes))
        if len(self.sensors) == 1:
            object.__setattr__(self, "sensors", SENSOR_SETS.get(self.sensors[0], self.sensors))
        object.__setattr__(self, "posture", self.posture or ("unknown",))
        for name in ("subjects", "takes", "cameras", "modes"):
            if not getattr(self, name):
                raise InvalidInputError(f"{name}: none are named, so there is nothing to measure")
        indices_of("subject", self.subjects, SUBJECTS)
        indices_of("take", self.takes, sorted({take for _, take in (*TRAIN, *TEST)}))
        indices_of("mode", self.modes, CAMERA_MODES)
        indices_of("space", [self.space], SPACES)
        indices_of("posture", self.posture, [*POSTURES])
        indices_of("sensor", self.sensors, list(SkeletonModel.default().sensors))
        indices_of("camera", [str(c) for c in self.cameras], [str(c) for c in range(1, 9)])
        if not self.sensors and {"sf2", "rtof"} & set(self.modes):
            raise InvalidInputError("modes sf2 and rtof need sensors; name some, or only lift and rto")
        if self.keypoints is not None and self.noise_px:
            raise InvalidInputError("noise is added to ground-truth 2D only, not to a detector's")
        if not 0 <= self.noise_px < np.inf or self.seed < 0:
            raise InvalidInputError(f"noise_px {self.noise_px:g}, seed {self.seed}: neither is negative or infinite")
        if self.keypoints is not None and not self.keypoints.is_dir():
            raise FileFormatError(self.keypoints, "there is no such folder of detections")
        lifter_path(self.lifter)
        if self.layout is not None:
            indices_of("layout", [self.layout], (RECOGNISE, *detector_table().layouts))
            if self.keypoints is None:
                raise InvalidInputError("layout is that of a detector's points; name their folder as keypoints")

    def jobs(self) -> dict[str, Job]:
        """Return all jobs by key, take by take."""
        return {
            f"{subject}_{take}" + (f"_cam{camera}" if camera else ""): Job(self, subject, take, camera)
            for subject in self.subjects
            for take in self.takes
            for camera in (None, *self.cameras)
        }

    def run(self, folder: Path, **options: Any) -> Outcome:
        """See `CameraProtocol.run`; fails early without a dataset."""
        TotalCapture(self.root)
        return super().run(folder, **options)

    def measure(self, job: Job) -> JobResult:
        """Run one job: a take seen by one camera, or without a camera."""
        take = _take(self.root, job.subject, job.take)
        return _reference(take) if job.camera is None else _seen_by(self, take, job, job.camera)

    def tables(self, outcome: Outcome) -> list[Table]:
        """Return every table for which something was measured, and one of missing and suspicious data."""
        rows = list(rows_of(outcome))
        tables = [part(self, rows) for part in (_by_take, _inertial_only, _ablation, _sixteen_joints)]
        if len(self.posture) > 1 and _optimised(self):
            tables.append(_by_posture(self, rows))
        if self.studies and "rtof" in self.modes:
            tables += _studied(rows)
        state = _state_of_data(self, outcome)
        return [*tables, state] if state.rows else tables


@lru_cache(maxsize=1)
def _take(root: Path, subject: str, name: str) -> Take:
    """Read a take; jobs are ordered by take, so one is cached."""
    return TotalCapture(root).take(subject, name)


@lru_cache(maxsize=1)
def _postures(root: Path, subject: str) -> dict[str, NeutralPosture]:
    """Return the neutral posture of a subject in each take that can be read and has a T-pose."""
    data, found = TotalCapture(root), dict[str, NeutralPosture]()
    for _, name in (key for key in data.takes if key[0] == subject):
        with suppress(FileFormatError):
            if (posture := data.take(subject, name).posture) is not None:
                found[name] = posture
    return found


def _posture(root: Path, take: Take, source: str) -> NeutralPosture | None:
    """Return the neutral posture of a subject by its source, of `POSTURES`; None where it is unknown."""
    if source != "person":
        return take.posture if source == "take" else None
    others = [own for name, own in _postures(root, take.subject).items() if name != take.name]
    if not others:
        return None
    mean = so3.nearest_rotation(np.mean([own.R_parent_bone for own in others], axis=0))
    return NeutralPosture(others[0].joints, so3.to_quat_wxyz(mean))


def _reference(take: Take) -> JobResult:
    """Score the calibration rows and check the files of a take."""
    truth, skeleton = take.truth, take.skeleton
    smooth = signals.low_pass(_without_glitches(truth), truth.rate_hz, _LOW_PASS_HZ)
    low_passed = _scores(replace(truth, p_world_joint=smooth), truth, skeleton)
    rows = {
        STILL: _scores(motionless(truth), truth, skeleton),
        LOW_PASSED: low_passed | {"angle_deg": None},  # its orientations are the truth's own
    }
    failed = [check.message for check in check_take(take) if not check.passed]
    about = {"subject": take.subject, "take": take.name, "camera": None}
    return JobResult(about | {"methods": rows, "failed_checks": failed, "notes": [*take.notes, *take.missing]})


def _without_glitches(truth: PoseSequence) -> Array:
    """Return positions (T, J, 3) m, interpolated where invalid, as a filter would spread glitches."""
    p = np.array(truth.p_world_joint)
    for j, valid in enumerate(truth.valid.T):
        for i in range(3 if valid.any() else 0):
            p[:, j, i] = np.interp(truth.times, truth.times[valid], p[valid, j, i])
    return p


def _seen_by(protocol: TotalCaptureProtocol, take: Take, job: Job, number: int) -> JobResult:
    notes: list[str] = []
    absent = [s for s in protocol.sensors if take.imus is None or s not in take.imus.names]
    if absent and {"sf2", "rtof"} & set(protocol.modes):
        notes.append(f"sf2 and rtof are left out, without the sensors {', '.join(absent)}")
    detected, folder = None, protocol.keypoints
    if folder is not None:
        detected = read_detections(folder, job.subject, job.take, number, take.cameras[number], layout=protocol.layout)
    recording = take.recording(
        number,
        keypoints=detected,
        noise_px=protocol.noise_px,
        seed=protocol.seed,
        sensors=() if absent else protocol.sensors,
        posture=False,
    )
    first, *others = protocol.posture
    postures = {source: _posture(protocol.root, take, source) for source in protocol.posture}
    notes += [f"posture {k}: no T-pose, so unknown" for k, own in postures.items() if own is None and k != "unknown"]
    recording = replace(recording, posture=postures[first])
    truth, skeleton = recording.truth, recording.skeleton
    assert truth is not None
    settings = ReconstructionSettings(fragment=None if protocol.space == "joint" else CartesianSettings())
    results = reconstructions(recording, protocol.modes, protocol.lifter, settings, protocol.calibrate)
    notes += sorted({warning for result in results.values() for warning in result.warnings})
    methods: dict[str, Any] = {}
    for mode, result in results.items():
        methods[mode] = _scores(result.stages[mode], truth, skeleton)
        save_motion(result, mode, job.motion_file(mode))
    for source in others:
        known = replace(recording, posture=postures[source])
        again = reconstructions(known, _optimised(protocol), protocol.lifter, settings, protocol.calibrate)
        for mode, result in again.items():
            methods[posture_name(mode, source)] = _scores(result.stages[mode], truth, skeleton)
    if protocol.studies and "rtof" in results:
        methods |= _studies(results["rtof"], truth)
    checks = check_camera(number)
    if protocol.keypoints is not None:
        checks += check_keypoints(take, number, recording.video)
    failed = [check.message for check in checks if not check.passed]
    about = {"subject": take.subject, "take": take.name, "camera": number}
    facts = about | {"methods": methods, "failed_checks": failed, "notes": notes}
    return JobResult(facts, curves(recording, results, _KNEE))


def _studies(result: Reconstruction, truth: PoseSequence) -> dict[str, dict[str, Any]]:
    """Solve the energy of the paper from SF2's poses with other fragment lengths and weights k_V."""
    printed = CartesianSettings.paper()
    variants = {length_name(N): (N, printed) for N in published.FRAGMENT_LENGTH}
    for k_V in published.VISUAL_WEIGHT:
        if k_V != printed.k_V:
            variants[weight_name(k_V)] = (50, replace(printed, k_V=k_V, k_I=round(1 - k_V, 6)))
    rows = {}
    skeleton = result.motion.skeleton
    for name, (N, settings) in variants.items():
        solver = FragmentSolver(skeleton, N, settings)
        began = perf_counter()
        solution = solver.solve(result.stages["sf2"], result.keypoints, result.bone_imus)
        rows[name] = _scores(solution.poses, truth, skeleton) | {"seconds": perf_counter() - began}
    return rows


def _optimised(protocol: TotalCaptureProtocol) -> tuple[str, ...]:
    """Return the modes that use the neutral posture."""
    return tuple(mode for mode in protocol.modes if mode in ("rto", "rtof"))


def posture_name(mode: str, source: str) -> str:
    """Return the name of a mode with another posture than that of all tables."""
    return f"{mode}, posture {source}"


def length_name(N: int) -> str:
    """Return the name of the method with the energy of the paper and fragments of N frames."""
    return f"as printed, N = {N}"


def weight_name(k_V: float) -> str:
    """Return the name of the method with the energy of the paper and another visual weight."""
    return length_name(50) if k_V == CartesianSettings.paper().k_V else f"as printed, k_V = {k_V:g}"


def _scores(estimate: PoseSequence, truth: PoseSequence, skeleton: SkeletonModel) -> dict[str, Any]:
    """Return every figure, the number of scored frames, and the error of the multi-view papers."""
    metrics = evaluate(estimate, truth, skeleton)
    error = metrics.over_time["joint_mm"]
    sixteen = error[::SIXTEEN_STEP, skeleton.index(*SIXTEEN)]
    scored = np.isfinite(sixteen).all(axis=1)
    return dict(metrics) | {
        "frames": int(np.isfinite(error).all(axis=1).sum()),
        "sixteen_mm": float(sixteen[scored].mean()) if scored.any() else None,
        "sixteen_frames": int(scored.sum()),
    }


# --- tables of the paper, with the measured figures beside the published ones -----------------------

Row = dict[str, Any]
_SEEN: Final = ("S1", "S2", "S3")  #: Subjects with other takes in the training set of the paper's lifter
_STUDIED: Final = ("mpjpe_rr_mm", "mpjpe_mm", "mpjje")
_PRINTED: Final = {"paper: MPJPE [mm]": 2, "paper: MPJJE": 2}
_MEASURED: Final = {"root-relative [mm]": 2, "absolute [mm]": 2, "MPJJE [m/s3]": 2}
"""Columns of the two studies, with their digits."""
_AS_PRINTED = (
    "Ours here: the energy as printed with a weak prior on positions (CartesianSettings.paper()), from "
    "the poses of sf2; the other tables have the default settings."
)


def _by_take(protocol: TotalCaptureProtocol, rows: list[Row]) -> Table:
    """Make table 1: MPJPE by take, for subjects seen and unseen in training, and over all frames."""
    groups = [(seen, take) for seen in (True, False) for take in TEST_TAKES]

    def cells(method: str, figure: str) -> list[Cell]:
        own = _of(rows, method)
        parts = [[r for r in own if (r["subject"] in _SEEN, r["take"]) == group] for group in groups]
        return [pooled(part, figure) for part in (*parts, own)]

    printed: list[tuple[Cell, ...]] = [(name, *row) for name, row in published.TABLE_1.items()]
    ours = [
        (f"{mode}, ours, {label}", *cells(mode, figure))
        for mode in protocol.modes
        for figure, label in (("mpjpe_rr_mm", "root-relative"), ("mpjpe_mm", "absolute"))
    ]
    columns = {"method": 0} | dict.fromkeys(published.NAMES_1, 1)
    notes = _notes(protocol, rows)
    return _table("by_take", "Total Capture, table 1: MPJPE [mm] by take", columns, [*printed, *ours], notes)


def _inertial_only(protocol: TotalCaptureProtocol, rows: list[Row]) -> Table:
    """Make the comparison with methods that have IMUs and no camera."""
    printed: list[tuple[Cell, ...]] = [
        (name, mpjpe, None, mpjje) for name, (mpjpe, mpjje) in published.INERTIAL_ONLY.items()
    ]
    figures = ("mpjpe_mm", "mpjpe_rr_mm", "mpjje")
    ours = [(f"{m}, ours", *_means(rows, m, figures)) for m in ("sf2", "rtof") if m in protocol.modes]
    columns = {"method": 0, "MPJPE [mm]": 1, "root-relative [mm]": 1, "MPJJE [m/s3]": 1}
    lines = [*printed, *ours, *_calibration_rows(rows, figures)]
    return _table("inertial_only", "Total Capture: methods of IMUs alone", columns, lines, _notes(protocol, rows))


def _ablation(protocol: TotalCaptureProtocol, rows: list[Row]) -> Table:
    """Make the ablation: every mode, and the calibration rows below."""
    columns = {"mode": 0, "paper: MPJPE [mm]": 1, "paper: MPJAE": 2, "paper: MPJJE": 1}
    columns |= dict.fromkeys(("root-relative [mm]", "absolute [mm]", "Procrustes [mm]"), 1)
    columns |= {"MPJAE [m/s2]": 2, "MPJJE [m/s3]": 1, "joint angle [deg]": 1, "flexion [deg]": 1, "valid": 0}
    figures = ("mpjpe_rr_mm", "mpjpe_mm", "mpjpe_pa_mm", "mpjae", "mpjje", "angle_deg", "flexion_deg")
    ours: list[tuple[Cell, ...]] = []
    for mode in CAMERA_MODES:
        if mode in protocol.modes:
            share = pooled(_of(rows, mode), "coverage")
            valid = None if share is None else f"{100 * share:.0f} %"
            ours.append((mode, *published.ABLATION[mode], *_means(rows, mode, figures), valid))
    calibration = [(name, None, None, None, *cells, None) for name, *cells in _calibration_rows(rows, figures)]
    notes = _notes(protocol, rows)
    if protocol.keypoints is not None or protocol.noise_px:
        notes = (*notes, "The paper's ablation has exact ground-truth 2D; this run has not.")
    title = "Total Capture, ablation: what each stage gives"
    return _table("ablation", title, columns, [*ours, *calibration], notes)


def _by_posture(protocol: TotalCaptureProtocol, rows: list[Row]) -> Table:
    """Make the comparison of the sources of the neutral posture."""
    columns = {"mode": 0, "neutral posture": 0, "root-relative [mm]": 1, "absolute [mm]": 1, "joint angle [deg]": 1}
    figures, lines = ("mpjpe_rr_mm", "mpjpe_mm", "angle_deg"), list[tuple[Cell, ...]]()
    for mode in _optimised(protocol):
        for source in protocol.posture:
            name = mode if source == protocol.posture[0] else posture_name(mode, source)
            lines.append((mode, POSTURES[source], *_means(rows, name, figures)))
    return _table("posture", "Total Capture: neutral posture", columns, lines, _notes(protocol, rows))


def _sixteen_joints(protocol: TotalCaptureProtocol, rows: list[Row]) -> Table:
    """Make the table of the multi-view papers: 16 joints, absolute, every 16th frame, four cameras."""
    chosen = [row for row in rows if row["camera"] in SIXTEEN_CAMERAS]
    ours: list[tuple[Cell, ...]] = [
        (f"{mode}, ours, each camera alone", pooled(_of(chosen, mode), "sixteen_mm", "sixteen_frames"))
        for mode in protocol.modes
    ]
    printed: list[tuple[Cell, ...]] = [(name, row[-1]) for name, row in published.TABLE_1.items() if "VP3D" not in name]
    cameras = sorted({row["camera"] for row in chosen})
    note = (
        f"16 joints, every {SIXTEEN_STEP}th frame, cameras {', '.join(map(str, cameras)) or 'none'} "
        f"of {', '.join(map(str, SIXTEEN_CAMERAS))}. GeoFuse and its family score so; the other "
        "printed averages are as table 1 has them."
    )
    title, notes = "Total Capture as multi-view papers score it", (note, *_incomplete(protocol, rows))
    return Table("sixteen_joints", title, ("method", "absolute MPJPE [mm]"), (0, 1), (*printed, *ours), notes)


def _studied(rows: list[Row]) -> list[Table]:
    """Make the studies of the fragment length N, with its speed, and of the visual weight k_V."""
    lines: list[tuple[Cell, ...]] = []
    for N, printed in published.FRAGMENT_LENGTH.items():
        own = _of(rows, length_name(N))
        seconds = sum(row["seconds"] for row in own)
        speed = sum(row["frames"] for row in own) / seconds if seconds else None
        lines.append((str(N), *map(float, printed), speed, *_means(rows, length_name(N), _STUDIED)))
    note = (
        "Frames per second of one process while all cores work, N/2 new frames a solve, from SF2 "
        "output to blended output: a time, so the one column that differs from run to run."
    )
    columns = {"N": 0, "paper: frames/s": 0} | _PRINTED | {"frames/s": 0} | _MEASURED
    title = "Total Capture: length N of the fragments"
    lengths = _table("fragment_length", title, columns, lines, (_AS_PRINTED, note))
    lines = [
        (f"{k_V:g}", *printed, *_means(rows, weight_name(k_V), _STUDIED))
        for k_V, printed in published.VISUAL_WEIGHT.items()
    ]
    title, columns = "Total Capture: weight k_V of the visual energy", {"k_V": 0} | _PRINTED | _MEASURED
    return [lengths, _table("visual_weight", title, columns, lines, (_AS_PRINTED, "k_I = 1 - k_V."))]


def _state_of_data(protocol: TotalCaptureProtocol, outcome: Outcome) -> Table:
    """List failed measurements, failed checks and notes of the loader."""
    lines: list[tuple[Cell, ...]] = []
    for key, job in protocol.jobs().items():
        problem, facts = outcome.failed.get(key), outcome.done.get(key, {})
        if problem and (job.camera is None or problem != outcome.failed.get(f"{job.subject}_{job.take}")):
            lines.append((job.name, "not measured", problem))
        lines += [(job.name, "check failed", text) for text in facts.get("failed_checks", ())]
        lines += [(job.name, "note", text) for text in facts.get("notes", ())]
    title = "Total Capture: missing, suspicious, mended"
    return Table("state_of_data", title, ("take", "what", "message"), (0, 0, 0), lines)


# --- parts of tables ---------------------------------------------------------------------------------


def _table(
    name: str, title: str, columns: dict[str, int], rows: Sequence[tuple[Cell, ...]], notes: tuple[str, ...]
) -> Table:
    """Make a table, with digits by column, that ends with the caveats on the paper's figures."""
    notes = (*notes, *published.TOTAL_CAPTURE_CAVEATS)
    return Table(name, title, tuple(columns), tuple(columns.values()), rows, notes)


def _of(rows: list[Row], method: str) -> list[Row]:
    return [row for row in rows if row["method"] == method]


def _means(rows: list[Row], method: str, figures: Iterable[str]) -> list[Cell]:
    return [pooled(_of(rows, method), figure) for figure in figures]


def _calibration_rows(rows: list[Row], figures: Iterable[str]) -> list[tuple[Cell, ...]]:
    return [(name, *_means(rows, name, figures)) for name in (STILL, LOW_PASSED)]


def _notes(protocol: TotalCaptureProtocol, rows: list[Row]) -> tuple[str, ...]:
    """Describe the setup of our rows, and what is missing."""
    if protocol.keypoints is not None:
        keypoints = f"the detections in {protocol.keypoints.name}"
    elif protocol.noise_px:
        keypoints = f"ground-truth 2D with {protocol.noise_px:g} px of white noise per axis"
    else:
        keypoints = "ground-truth 2D of every joint, also outside the picture"
    cameras = sorted({row["camera"] for row in rows if row["camera"]})
    frames = sum(row["frames"] for row in rows if row["method"] == protocol.modes[0])
    lifter = "the shipped one, trained on free motion alone" if protocol.lifter is None else Path(protocol.lifter).name
    setup = (
        f"Ours: one camera at a time ({', '.join(map(str, cameras)) or 'none'}), pooled over all {frames} frames of "
        f"all cameras; {len(protocol.sensors)} IMUs where a mode uses them; 2D: {keypoints}; 21 joints, root included; "
        f"solved in {protocol.space} space, the sensors' calibration "
        f"{'found from each take itself' if protocol.calibrate else 'as the files have it'}, neutral posture "
        f"{POSTURES[protocol.posture[0]]}; lifter: {lifter}. Mode lift is scored with the "
        "joints of the network; its saved motions have rigid bones."
    )
    return (setup, *_incomplete(protocol, rows))


def _incomplete(protocol: TotalCaptureProtocol, rows: list[Row]) -> list[str]:
    """Return a sentence that names the takes, cameras and modes without a result, if any."""
    done = {(row["subject"], row["take"], row["camera"], row["method"]) for row in rows}
    names = []
    for job in protocol.jobs().values():
        methods = (STILL,) if job.camera is None else protocol.modes
        lost = [m for m in methods if (job.subject, job.take, job.camera, m) not in done]
        if lost:
            names.append(job.name + ("" if len(lost) == len(methods) else f" ({', '.join(lost)})"))
    return [f"INCOMPLETE, without: {some(names, 8)}. The last table says why."] if names else []

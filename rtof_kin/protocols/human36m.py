"""The paper's protocol on Human3.6M: 17 joints, 50 Hz, vision only, subjects S9 and S11."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Final

import numpy as np

from rtof_kin.body.metrics import evaluate, motionless
from rtof_kin.core.checks import indices_of
from rtof_kin.core.choices import CAMERA_MODES
from rtof_kin.core.errors import FileFormatError, InvalidInputError, UnknownNameError
from rtof_kin.core.jobs import JobResult, Outcome
from rtof_kin.core.resources import lifter_path
from rtof_kin.datasets.human36m import RATE_HZ, SUBJECTS_TEST, SUBJECTS_TRAIN, Human36M
from rtof_kin.protocols import published
from rtof_kin.protocols.measures import CameraProtocol, Job, curves, reconstructions, save_motion
from rtof_kin.protocols.tables import STILL, Table, pooled, rows_of
from rtof_kin.reporting.document import Cell

CAMERAS = (0, 1, 2, 3)
_VISION: Final = ("lift", "rto")


@dataclass(frozen=True)
class Human36MProtocol(CameraProtocol):
    """Settings of the measurements."""

    title = "Human3.6M"
    rate_hz = RATE_HZ
    skeleton = "human36m"

    root: Path  #: Folder of the archives
    lifter: Path  #: File of a 17-joint lifter; the shipped ones have 21 joints
    cameras_file: Path | None = None  #: File of cameras; by default one in the folder
    keypoints: str = "gt"  #: 'gt', or the detector's part of the archive's name
    subjects: tuple[str, ...] = SUBJECTS_TEST  #: Subjects that are measured
    actions: tuple[str, ...] = ()  #: Names such as 'Walking', with or without their number; empty for all
    cameras: tuple[int, ...] = CAMERAS  #: Numbers of the cameras
    modes: tuple[str, ...] = _VISION  #: Stages to measure
    save: Path | None = None  #: Folder for the motions, if wanted

    def __post_init__(self) -> None:
        for name in ("subjects", "cameras", "modes"):
            if not getattr(self, name):
                raise InvalidInputError(f"{name}: none are named, so there is nothing to measure")
        indices_of("subject", self.subjects, SUBJECTS_TRAIN + SUBJECTS_TEST)
        indices_of("mode without sensors", self.modes, _VISION)
        indices_of("camera", [str(c) for c in self.cameras], [str(c) for c in CAMERAS])
        try:
            lifter_path(self.lifter)
        except FileFormatError as error:
            problem = "no such file; train a lifter of 17 joints with: rtof-kin train --human36m DIR"
            raise FileFormatError(self.lifter, problem) from error

    def jobs(self) -> dict[str, Job]:
        """Return all jobs by key. `FileFormatError`: the archive cannot be read, or has nothing of the subjects;
        `UnknownNameError`: an action that no subject has.
        """
        dataset = _dataset(self.root, self.cameras_file, self.keypoints)
        found = [(s, action) for s, action in dataset.sequences if s in self.subjects]
        if not found:
            raise FileFormatError(self.root, f"has no action by {', '.join(self.subjects)}")
        short = [action.rsplit(" ", 1)[0] for _, action in found]
        known = sorted({*short, *(action for _, action in found)})
        unknown = [action for action in self.actions if action not in known]
        if unknown:
            raise UnknownNameError("action", unknown, known)
        return {
            f"{subject}_{action}_cam{camera}".replace(" ", "_"): Job(self, subject, action, camera)
            for (subject, action), name in zip(found, short, strict=True)
            if not self.actions or {action, name} & set(self.actions)
            for camera in self.cameras
        }

    def measure(self, job: Job) -> JobResult:
        """Score the modes of one action seen by one camera, and the row of no motion."""
        recording = _dataset(self.root, self.cameras_file, self.keypoints).recording(
            job.subject, job.take, job.camera or 0
        )
        truth, skeleton = recording.truth, recording.skeleton
        assert truth is not None
        results = reconstructions(recording, self.modes, self.lifter)
        scores = {STILL: evaluate(motionless(truth), truth, skeleton)}
        for mode, result in results.items():
            scores[mode] = result.stage_metrics[mode]
            save_motion(result, mode, job.motion_file(mode))
        methods = {
            name: dict(metrics) | {"frames": int(np.isfinite(metrics.over_time["mpjpe_mm"]).sum())}
            for name, metrics in scores.items()
        }
        facts = {"subject": job.subject, "take": job.take, "camera": job.camera, "methods": methods}
        notes = [recording.notes] if recording.notes else []
        return JobResult(facts | {"failed_checks": [], "notes": notes}, curves(recording, results, "RKnee"))

    def tables(self, outcome: Outcome) -> list[Table]:
        """Return the paper's table with ours, and one of missing and suspicious data."""
        rows = list(rows_of(outcome))
        printed: list[tuple[Cell, ...]] = [
            (name, mpjpe, mpjae, mpjje, None, None) for name, (mpjpe, mpjae, mpjje) in published.HUMAN36M.items()
        ]
        figures = ("mpjpe_rr_mm", "mpjae_frame_mm", "mpjje_frame_mm", "mpjpe_pa_mm", "mpjpe_mm")
        for name in (*[mode for mode in CAMERA_MODES if mode in self.modes], STILL):
            own = [row for row in rows if row["method"] == name]
            label = name if name == STILL else f"{name}, ours"
            printed.append((label, *(pooled(own, figure) for figure in figures)))
        frames = sum(row["frames"] for row in rows if row["method"] == STILL)
        kind = "ground-truth 2D" if self.keypoints == "gt" else f"2D of {self.keypoints}"
        notes = [
            f"Ours: {', '.join(self.subjects)}, cameras {', '.join(map(str, self.cameras))}, {frames} frames, all "
            f"pooled; {kind}; lifter: {self.lifter.name}. The printed rows have detected 2D.",
            *published.HUMAN36M_CAVEATS,
        ]
        found = {job.subject for job in self.jobs().values()}
        absent = [subject for subject in self.subjects if subject not in found]
        if lacking := [
            *([f"{len(outcome.failed)} recordings"] if outcome.failed else []),
            *(f"any of {s}" for s in absent),
        ]:
            notes.insert(1, f"INCOMPLETE, without {' and '.join(lacking)}: see the last table.")
        columns = ["method", "MPJPE, root-relative [mm]", "MPJAE [mm/frame2]", "MPJJE [mm/frame3]"]
        columns += ["Procrustes [mm]", "absolute [mm]"]
        table = Table("human36m", "Human3.6M, vision alone", columns, (0, 1, 2, 2, 1, 1), printed, notes)
        state: list[tuple[Cell, ...]] = [
            (subject, "not measured", "the archive of positions has no such subject") for subject in absent
        ]
        state += [(key, "not measured", problem) for key, problem in outcome.failed.items()]
        for key, facts in outcome.done.items():
            state += [(key, "note", note) for note in facts["notes"]]
        title = "Human3.6M: missing, suspicious"
        about = Table("state_of_data", title, ("recording", "what", "message"), (0, 0, 0), state)
        return [table, about] if state else [table]


@lru_cache(maxsize=1)
def _dataset(root: Path, cameras: Path | None, keypoints: str) -> Human36M:
    return Human36M(root, cameras, keypoints)

"""What a recording says of its person, merged into the person's file."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from filelock import FileLock

from rtof_kin.body import kinematics
from rtof_kin.body.pose_prior import SPINE, STOOD, NeutralPosture, has_prior, reference_pose
from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.calibration.estimate import fragments_of
from rtof_kin.calibration.priors import CalibrationPriors
from rtof_kin.calibration.result import Quantity, SelfCalibration, bone_groups
from rtof_kin.calibration.shared_fragments import Excerpt, Slice
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.choices import Mode
from rtof_kin.core.errors import RtofError
from rtof_kin.core.files.manifest import fingerprint
from rtof_kin.core.resources import cache_folder
from rtof_kin.data.confidence import Confidence
from rtof_kin.data.keypoints import layout_and_point
from rtof_kin.reconstruction.camera_evidence import ANKLE_HEIGHT
from rtof_kin.reconstruction.checks.camera import standing
from rtof_kin.reconstruction.lift import LifterLike
from rtof_kin.reconstruction.prepare import Job
from rtof_kin.reconstruction.result import Reconstruction
from rtof_kin.reconstruction.self_calibration import as_declared
from rtof_kin.reconstruction.settings import ReconstructionSettings
from rtof_kin.recording.recording import Recording, RecordingSource
from rtof_kin.recording.subject import (
    Estimate,
    Subject,
    contradictions,
    given_by,
    merged,
    read_subject,
    sd_of,
    write_subject,
)
from rtof_kin.solve.settings import JointSpaceSettings

_SHOWN: Final = 0.7
"""Largest standard deviation of a joint in the T-pose, relative to the prior's, with which the recording shows it."""
_SEEN: Final = ("Head", "Arm", "UpLeg", "Leg")
"""Joints whose places are told apart from the rest: of ten planted people, errors 14 to 7 of 24 to 12 mm; places at
elbows, wrists and ankles are not better known than before (benchmarks/results/known_person.md)."""
_CAUTION: Final = 2.5**0.5  #: [1] Their errors relative to the stated ones
_LEAST_S: Final = 20.0  #: [s] Shortest motion that tells a posture by itself
_ANKLE, _LOWEST = JointSpaceSettings().ankle_height, 0.02  #: [m] Usual and lowest height of ankles
_LONGEST, _FITTED = 8.0, 5.0  #: [s] of a recording, and of its fragments, by which a file's bones are compared
_ALIKE: Final = 8.0  #: [nats] of a fragment that count as one
_USUAL_LARGER, _SIGMA_LARGER = 0.007, 0.019  #: [1] Mean and standard deviation of `_Fit.larger` with the right bones
_SIGMA_ANKLE, _TILT = 0.033, 0.0067  #: [m] The latter of `_Fit.ankle`, and per m of distance: 0.4 degrees of the camera
_FLOOR_WRONG: Final = 0.6  #: [m] between ankle and floor from which the floor is more likely wrong than the body
ANOTHER: Final = 6.5  #: Sum of contradictions beyond which a file is of another person (benchmarks/results/subject.md)
_News = Mapping[str, tuple[Array | float, float]]  # Value and standard deviation by field


@dataclass
class Person:
    """What a person's file says of a recording, and the recording of the person."""

    subject: Subject | None = None  #: What was known before; None where nothing was
    doubt: str = ""  #: Why the file may be of another person than the recording
    remarks: tuple[str, ...] = ()  #: Values of the file that are not used
    news: dict[str, Estimate[Any]] = field(default_factory=dict)  #: What the recording says, by field

    @classmethod
    def of(cls, subject: Subject | None, source: RecordingSource) -> Person:
        """Compare a recording with its person's file, which is not used where they contradict each other."""
        doubt, remarks = ("", ()) if subject is None else contradictions(subject, source.facts)
        return cls(None if doubt else subject, doubt, remarks)

    def seen(
        self, source: RecordingSource, mode: Mode, lifter: LifterLike | None, settings: ReconstructionSettings
    ) -> Person:
        """Return the person after the file's bones were compared with the motion of a recording: where they contradict
        it, nothing of the file is used; where it fits no better with them, no bones and no posture.
        """
        if self.subject is None:
            return self
        worse, found = contradictions_by_motion(self.subject, source, mode, lifter, settings)
        name, score = self.subject.path.name, sum(found.values())
        if score > ANOTHER:
            said = " and ".join(words for words, share in found.items() if share > score / 4)
            doubt = f"{name} is likely of another person and is not used: with its bones, {said}"
            return replace(self, subject=None, doubt=doubt)
        own = "joint_", "posture_", "image_"
        kept = {path: one for path, one in self.subject.known.items() if not path.startswith(own)}
        if worse <= 0 or len(kept) == len(self.subject.known):
            return self
        why = "the motion fits no better with its bones than without"
        remark = f"bones, posture and image points of {name} are not used: {why}"
        subject = self.subject.with_known(kept, self.subject.history)
        return replace(self, subject=subject, remarks=(*self.remarks, remark))

    def informed(self, source: RecordingSource) -> RecordingSource:
        """Return the recording with what is known of its person where it is silent."""
        return source if self.subject is None else source.with_facts(**self.subject.informed(source.facts))

    @property
    def calibration(self) -> SelfCalibration | None:
        """Height of the ankles, where it is known, as if another recording had been calibrated."""
        if self.subject is None or (ankle := self.subject.ankle_height_m) is None:
            return None
        value, sigma = np.array([ankle.value - _ANKLE]), np.array([sd_of("ankle_height_m", ankle)])
        return SelfCalibration((Quantity("ankle height", "feet", value, sigma, sigma, 1.0),))

    def used(self, facts: Recording) -> dict[str, Any]:
        """Return whose file it is, a digest of bones, posture and ankles of an informed recording, and their standard
        deviations, m and deg; nothing without a file.
        """
        if self.subject is None:
            return {}
        posture = None if (own := facts.posture) is None else (own.joints, own.quat_wxyz.tolist(), own.sigma.tolist())
        ankle = None if (height := self.subject.ankle_height_m) is None else height.value
        found: dict[str, Any] = {"subject": self.subject.subject}
        seen = {layout: {j: at.tolist() for j, at in own.items()} for layout, own in facts.image_points.items()}
        found["constants_sha256"] = fingerprint(facts.joint_offsets.tolist(), posture, ankle, *filter(None, [seen]))
        for field_ in ("joint_offsets_m", "posture_deg", "image_points_m"):
            if sds := [sd_of(path, one) for path, one in self.subject.known.items() if path.startswith(field_)]:
                found[f"sd_{field_}"] = float(np.sqrt(np.mean(np.square(sds))))
        return found

    def learning(
        self, parts: Iterable[Reconstruction], given: Recording, body: SkeletonModel, source: str
    ) -> Iterator[Reconstruction]:
        """Yield the parts of a reconstruction, with doubt and remarks in the first, from which `news` are taken.

        `given`: facts of the recording as it is. `body`: with which it was reconstructed. `source`: of the news.
        """
        for number, part in enumerate(parts):
            if number == 0:
                found = _from_motion(part.motion) | _from_calibration(part.calibration, body, not given.bones_given)
                found |= _image_points(part)
                self.news = _estimates(found, source, given.session.date) | given_by(given, source)
                said = (*filter(None, [self.doubt]), *self.remarks)
                part = replace(part, warnings=(*said, *part.warnings)) if said else part
            yield part


@dataclass(frozen=True)
class _Fit:
    """How a body fits an excerpt of a recording."""

    energy: float  # [nats] of a fragment, negative logarithm of its probability
    sigma_px: float
    larger: float = float("nan")  # [1] by which accelerations would have the body larger; NaN without sensors
    ankle: float = float("nan")
    """[m] of a standing ankle over its usual height where the body is placed by its size; NaN without a floor"""
    distance: float = float("nan")  # [m] from the camera

    @classmethod
    def of(cls, job: Job, mode: Mode, sigma_px: float | None = None, sized: bool = False) -> _Fit:
        """Fit a job; `sigma_px`: of the landmarks, by default that of the residuals; `sized`: with what shows size."""
        prepared, solver = job.prepare(mode), job.settings.fragment
        assert isinstance(solver, JointSpaceSettings)
        recording, sensed = prepared.recording, prepared.bone_imus is not None
        part = Slice(recording, prepared.guess, prepared.bone_imus)
        excerpt = Excerpt.chosen([part], job.settings.frames, solver, _FITTED)
        priors = CalibrationPriors(sigma_size=0.08, sigma_proportion=0.04)
        priors = priors if sensed else replace(priors, sigma_delay=None, sigma_swing=None)
        fragments = fragments_of(excerpt, priors, solver)
        fragments.begin(sigma_px)
        y = np.zeros(len(fragments.prior))
        found = cls(fragments.settle(fragments.corrected(y, full=True)) / len(excerpt.fragments), fragments.sigma_px)
        if sized and sensed:
            given = fragments.corrected(y)
            fragments.settle(given)
            information, slope = fragments.profile(given, y)
            found_y = -np.linalg.solve(information + fragments.prior, slope)
            kinds = [unknown.name for unknown in fragments.unknowns]
            found = replace(found, larger=float(found_y[fragments.columns[kinds.index("bones")]].mean()))
        stands = standing(prepared.lifted.poses, recording.video, sensed) if sized else None
        if stands is None or recording.floor_height is None:
            return found
        return replace(found, ankle=stands.height - recording.floor_height - ANKLE_HEIGHT, distance=stands.distance)


def contradictions_by_motion(
    subject: Subject, source: RecordingSource, mode: Mode, lifter: LifterLike | None, settings: ReconstructionSettings
) -> tuple[float, dict[str, float]]:
    """Return the energy below, and how much an excerpt of a recording contradicts the bones of a file, by words on what
    does; 0 and nothing where it cannot. It is solved with the file's bones and with those that the recording has alone.

    ::

        energy / 8          of a fragment with the file's bones, less that without, nats
        (larger / sigma)^2  by which the sensors' accelerations would have the body larger
        (ankle / sigma)^2   how far standing ankles are off the floor where the body is placed by its size

    The constant errors of a detector make fragments alike, so their energies do not add. The size counts where the
    recording does not give the height.
    """
    facts = subject.informed(source.facts)
    if "joint_offsets" not in facts or mode not in ("rto", "rtof"):
        return 0.0, {}
    bones = {name: facts[name] for name in ("height", "joint_offsets") if name in facts}
    middle = (source.start_s + source.stop_s) / 2
    try:
        job = Job.of(source.between(middle - _LONGEST / 2, middle + _LONGEST / 2), None, lifter, settings)
        job = job.with_solver(None)
        if job.recording.video.camera.uncertainty or not isinstance(job.settings.fragment, JointSpaceSettings):
            return 0.0, {}
        own: Mode = "rtof" if job.sensed(mode) and as_declared(job) else "rto"
        alone = _Fit.of(job, own)
        other = replace(job, recording=replace(job.recording, **bones))
        fit = _Fit.of(other, own, alone.sigma_px, sized=source.facts.height is None)
    except RtofError:  # the reconstruction says so
        return 0.0, {}
    worse = fit.energy - alone.energy
    found = {f"{job.settings.frames} frames fit worse by {worse:.0f} nats": worse / _ALIKE}
    if np.isfinite(fit.larger):
        words = f"the sensors' accelerations are those of a body {1 + fit.larger:.2f} times as large"
        found[words] = ((fit.larger - _USUAL_LARGER) / _SIGMA_LARGER) ** 2
    if abs(fit.ankle) < _FLOOR_WRONG:
        where = "over" if fit.ankle > 0 else "under"
        words = f"the feet stand {abs(fit.ankle):.2f} m {where} the floor, unless that is wrong"
        found[words] = (fit.ankle / np.hypot(_SIGMA_ANKLE, _TILT * fit.distance)) ** 2
    return worse, found


def update_subject(path: Path, news: Mapping[str, Estimate[Any]], skeleton: str, doubt: str = "") -> tuple[str, ...]:
    """Merge news into a person's file, which is made if there is none, and return what happened, for display.

    `news`: of joints of the table `skeleton`, which are left out where the file has another. `doubt`: why all are
    refused. Errors as `read_subject` and `write_subject`.
    """
    lock = cache_folder() / "locks" / f"{hashlib.sha256(str(path.resolve()).encode()).hexdigest()[:16]}.lock"
    lock.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(lock):  # recordings of a batch wait for each other; nothing is left beside the file
        new = {"subject": path.stem, "skeleton": skeleton}
        subject = read_subject(path) if path.exists() else Subject.of(new, path)
        same = subject.skeleton == skeleton
        subject, said = merged(subject, {k: v for k, v in news.items() if same or "." not in k}, doubt)
        write_subject(path, subject, overwrite=True)
    return tuple(f"{subject.subject}: {one}" for one in said or ("nothing new in this recording",))


def news_of_markers(body: SkeletonModel, sigma: Array, source: str) -> dict[str, Estimate[Any]]:
    """Return the bones of a body that was fitted to markers; sigma: (J, 3) m, of the offsets."""
    sds = np.maximum(np.sqrt(np.mean(sigma**2, axis=1)), 1e-4).tolist()
    rows = [*zip(body.names, body.joint_offsets, sds, strict=True)][1:]
    return _estimates({f"joint_offsets_m.{joint}": (offset, sd) for joint, offset, sd in rows}, source)


def _estimates(news: _News, source: str, date: str = "") -> dict[str, Estimate[Any]]:
    return {path: Estimate[Any](value=value, sd=sd, source=source, date=date) for path, (value, sd) in news.items()}


def _from_calibration(found: SelfCalibration | None, body: SkeletonModel, bones: bool) -> dict[str, Any]:
    """Return bones and ankles, m, that a self-calibration observed, as the recording alone shows them: without the
    information of their prior, whose mean is zero.
    """
    news = dict[str, Any]()
    for q in () if found is None else found.quantities:
        precision = float(q.sigma[0] ** -2 - q.sigma_prior[0] ** -2)
        if not q.observed or precision <= 0 or q.kind not in ("bones", "ankle height"):
            continue
        value, sd = float(q.value[0] / q.sigma[0] ** 2) / precision, precision**-0.5
        if q.kind == "ankle height" and value + _ANKLE > _LOWEST:
            news["ankle_height_m"] = value + _ANKLE, sd
        for _, joints in bone_groups(body, (q.item,)) if q.kind == "bones" and bones else ():
            for j in joints:
                offset = body.joint_offsets[j]
                news[f"joint_offsets_m.{body.names[j]}"] = offset * (1 + value), sd * float(np.linalg.norm(offset))
    return news


def _image_points(part: Reconstruction) -> dict[str, Any]:
    """Return where the detector sees the joints of the person, m, as this recording alone shows it: without the
    information of the prior, about what was known.
    """
    keypoints, known = part.keypoints, part.recording.image_points
    layouts = {layout for layout, _ in map(layout_and_point, () if keypoints is None else keypoints.names) if layout}
    if part.calibration is None or len(layouts) != 1:
        return {}
    (layout,) = layouts
    news = dict[str, Any]()
    for q in part.calibration.places:
        variance, prior = float(np.mean(q.sigma**2)), float(np.mean(q.sigma_prior**2))
        if q.item.removeprefix("Left").removeprefix("Right") not in _SEEN or variance >= prior:
            continue
        precision = 1 / variance - 1 / prior
        value = q.value / variance / precision + known.get(layout, {}).get(q.item, 0.0)
        news[f"image_points_m.{layout}.{q.item}"] = value, _CAUTION * precision**-0.5
    return news


def _from_motion(motion: Motion) -> dict[str, Any]:
    """Return the posture, deg, in which the person stands (`reference_pose`), else that which the whole motion tells
    where it is long enough, of joints that it shows better than the prior; nothing without covariances.
    """
    skeleton, confidence, poses = motion.skeleton, motion.confidence, motion.poses
    if confidence is None or not has_prior(skeleton.name):
        return {}
    names, prior, seconds = skeleton.names, skeleton.table.general_prior, len(poses) / poses.rate_hz
    stood = reference_pose(poses)
    if stood is not None:
        confidence = confidence[stood[0]]
    elif seconds < _LEAST_S:
        return {}
    pairs = zip((names[parent] for parent in skeleton.parents[1:]), names[1:], strict=True)
    sigma = np.array([_turn_sigma(confidence, *pair) for pair in pairs])
    # Where the trunk bends is not seen, only how much: each joint of the spine has its share.
    sigma[[names.index(joint) - 1 for joint in SPINE]] = _turn_sigma(confidence, "Hips", SPINE[-1]) / len(SPINE)
    if stood is not None:
        own = np.sqrt(np.mean(sigma[[names.index(joint) - 1 for joint in stood[1]]] ** 2, axis=1))
        posture = replace(NeutralPosture.of(poses[stood[0]], skeleton.parents, stood[1]), sigma=np.hypot(own, STOOD))
    else:
        known = np.isfinite(poses.R_world_bone).all(axis=(1, 2, 3))
        local = kinematics.local_rotations(skeleton.parents, poses.R_world_bone[known])[:, 1:]
        found = prior.posture_of(local, seconds, sigma)
        if found is None:
            return {}
        posture = found
    usual = np.sqrt(np.diagonal(prior.covariance)).reshape(-1, 3)
    shown = np.linalg.norm(sigma, axis=1) < _SHOWN * np.linalg.norm(usual, axis=1)
    turns, sds = np.degrees(so3.log(posture.R_parent_bone)), np.degrees(posture.sigma)
    return {
        f"posture_deg.{joint}": (turn, float(sd))
        for joint, turn, sd in zip(posture.joints, turns, sds, strict=True)
        if shown[names.index(joint) - 1]
    }


def _turn_sigma(confidence: Confidence, parent: str, child: str) -> Array:
    """Root mean square (3,) of the standard deviations of a segment relative to another, rad; pi where unobserved."""
    variance = np.diagonal(confidence.turn(parent, child), axis1=1, axis2=2)
    known = np.isfinite(variance).all(axis=1)
    return np.sqrt(variance[known].mean(axis=0)) if known.any() else np.full(3, np.pi)

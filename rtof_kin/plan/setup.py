"""`Setup`: a planned recording, and simulated recordings of it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from rtof_kin.body import kinematics
from rtof_kin.body.motion_file import motion_path
from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.choices import Mode
from rtof_kin.core.errors import InvalidInputError, UnknownNameError
from rtof_kin.data.camera import Camera
from rtof_kin.data.poses import PoseSequence
from rtof_kin.formats.measurements_file import measurements_path, read_measurements
from rtof_kin.plan.movements import MOVEMENTS, movement
from rtof_kin.plan.protocol import MEASURED, Protocol, place_of
from rtof_kin.reconstruction.lift import LifterLike
from rtof_kin.reconstruction.person import Person
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.reconstruction.prepare import Progress
from rtof_kin.recording.index import INDEX
from rtof_kin.recording.recording import Recording
from rtof_kin.recording.subject import Estimate, Subject, sd_of
from rtof_kin.simulation.detector_errors import DetectorErrors
from rtof_kin.simulation.simulate import SimulationSettings, another_person, simulate
from rtof_kin.vision.layouts import layout_named


@dataclass(frozen=True)
class Setup:
    """A movement, and what records it."""

    poses: PoseSequence  #: (T, J) the movement at the video's rate, finite everywhere, world z up
    skeleton: SkeletonModel  #: Of the person
    camera: Camera
    sensors: tuple[str, ...]  #: Names of the skeleton's table
    detector: str = MEASURED  #: Layout by name, or a file of one
    error_factor: float = 1.0  #: [1] on the errors in the image of the measured detector
    floor_height: float | None = None  #: [m] z of a flat floor that the recording declares; None if it declares none
    subject: Subject | None = None
    """The person's file, by whose standard deviations bones and posture are wrong; without one bones are right and the
    posture is unknown."""

    @property
    def mode(self) -> Mode:
        """Mode of its reconstruction."""
        return "rtof" if self.sensors else "rto"

    def recorded(self, seed: int, late: bool = True) -> Recording:
        """Simulate a recording with the errors of a real detector and of real sensors.

        Each seed is another person, with a neutral posture of their own, another detector and other sensors. Equal
        seeds draw equal errors, whatever camera and sensors: differences between setups are theirs.
        `InvalidInputError`: the person is not in the camera's view, or the movement is too short.

        Args:
            seed: of the person's and the recording's errors.
            late: whether the detector's frames are late, as they are by one to three of 60 Hz.
        """
        f = self.error_factor
        errors = DetectorErrors(view=f, constant=f, coloured=f, jumps=f, layout=layout_named(self.detector))
        errors = errors if late else replace(errors, delay_frames=(0,))
        poses = another_person(np.random.default_rng([seed, 1]), self.poses, self.skeleton)
        recording = simulate(
            poses,
            self.skeleton.joint_offsets,
            camera=self.camera,
            skeleton=self.skeleton,
            seed=seed,
            settings=SimulationSettings(keypoints=errors, sensors=self.sensors),
            name="plan",
        )
        recording = replace(recording, floor_height=self.floor_height)
        if self.subject is not None:
            silent = recording.with_facts(joint_offsets=np.empty((0, 3)), height=self.skeleton.height)
            recording = silent.with_facts(**self._drawn(self.subject, seed).informed(silent))
        return recording

    def _drawn(self, subject: Subject, seed: int) -> Subject:
        """Return a person's file as it may be of the person of a draw, with errors of its standard deviations."""
        rng, names = np.random.default_rng([seed, 3]), self.skeleton.names
        R = np.tile(np.eye(3), (2, len(names), 1, 1))
        still = kinematics.positions(self.skeleton.parents, self.skeleton.joint_offsets, np.zeros((2, 3)), R)
        t_pose = PoseSequence(self.poses.times[:2], still, R, names)
        t_pose = another_person(np.random.default_rng([seed, 1]), t_pose, self.skeleton)
        turns = np.degrees(so3.log(kinematics.local_rotations(self.skeleton.parents, t_pose.R_world_bone)[0]))
        true = {"joint_offsets_m": self.skeleton.joint_offsets, "posture_deg": turns}
        known = dict[str, Estimate[Any]]()
        for path, one in subject.known.items():
            field, _, joint = path.partition(".")
            if field in true and joint in names:
                sd = sd_of(path, one)
                known[path] = Estimate[Any](value=true[field][names.index(joint)] + rng.normal(0, sd, 3), sd=sd)
        return subject.with_known(known, {})


def seen_share(setup: Setup) -> float:
    """Return the share of the joints' positions inside the camera's image, over the movement."""
    uv = setup.camera.project(setup.poses.p_world_joint)
    size = np.array([setup.camera.width_px, setup.camera.height_px])
    return float(np.mean(((uv >= 0) & (uv <= size)).all(axis=-1)))


_LONGEST: Final = 30.0  #: [s] of a movement that are planned with


def planned(
    what: str | Path, lifter: LifterLike | None = None, progress: Progress | None = None, subject: Subject | None = None
) -> tuple[Protocol, Setup]:
    """Return the protocol and the setup of what a plan is asked for. `InvalidInputError`: no camera filmed the
    recording, or it has no complete frame; `UnknownNameError`: there is no such movement; `FileFormatError`: a file
    cannot be read.

    Args:
        what: a protocol's TOML file; the name of a movement of the library, recorded by a usual camera;
            the folder of a recording, or the output of `reconstruct`, planned as it was recorded.
        lifter, progress: as for `reconstruct`, for a recording.
        subject: file of the person, whose bones and height are planned with.
    """
    path = Path(what)
    if path.is_file() and path.suffix == ".toml" and path.name != INDEX:
        protocol = Protocol.read(path)
        return protocol, setup_of(protocol, lifter, progress, subject)
    folder = path.parent if path.name == INDEX else path
    if not folder.is_dir():
        if str(what) not in MOVEMENTS:
            raise UnknownNameError("file, folder or movement", [str(what)], tuple(MOVEMENTS))
        protocol = Protocol(str(what), any_camera=True)
        return protocol, setup_of(protocol, lifter, subject=subject)
    poses, skeleton, camera, sensors, floor = _moved(folder, lifter, progress, subject)
    if camera is None:
        raise InvalidInputError(f"plan: no camera filmed {folder}; name it as movement in a protocol's file")
    protocol = Protocol(str(folder), camera=place_of(camera, poses, poses.rate_hz), sensors=sensors)
    return protocol, Setup(poses, skeleton, camera, sensors, floor_height=floor, subject=subject)


def setup_of(
    protocol: Protocol,
    lifter: LifterLike | None = None,
    progress: Progress | None = None,
    subject: Subject | None = None,
) -> Setup:
    """Return the setup of a protocol with the name of a movement, or the folder of a motion or recording."""
    if protocol.movement in MOVEMENTS:
        skeleton = SkeletonModel.default()
        known = None if subject is None or subject.height_m is None else subject.height_m.value
        if (height := protocol.height_m or known) is not None:
            skeleton = skeleton.with_height(height)
        if subject is not None and subject.skeleton == skeleton.name:
            skeleton = skeleton.with_offsets({joint: one.value for joint, one in subject.joint_offsets_m.items()})
        poses = movement(protocol.movement, skeleton, protocol.repetitions, protocol.camera.rate_hz)
    elif Path(protocol.movement).is_dir():
        poses, skeleton, *_ = _moved(Path(protocol.movement), lifter, progress, subject)
    else:
        raise UnknownNameError("movement", [protocol.movement], tuple(MOVEMENTS))
    camera = protocol.camera.camera(poses)
    return Setup(poses, skeleton, camera, protocol.sensors, protocol.detector, protocol.error_factor, subject=subject)


def _moved(
    folder: Path, lifter: LifterLike | None, progress: Progress | None, subject: Subject | None
) -> tuple[PoseSequence, SkeletonModel, Camera | None, tuple[str, ...], float | None]:
    """The movement of a recording, which is reconstructed, or of a motion; the camera that filmed it, usual names of
    the sensors worn, and z of a flat floor, m, where it is declared.
    """
    camera, joints, floor = None, tuple[str, ...](), None
    if (folder / INDEX).exists():
        recording = Recording.load(folder)
        if (person := Person.of(subject, recording)).doubt:
            raise InvalidInputError(f"plan: {person.doubt}")
        recording = person.informed(recording).whole()
        motion = reconstruct(recording, lifter=lifter, progress=progress).motion
        camera = None if recording.keypoints is None else recording.keypoints.camera
        joints = () if recording.calibration is None else recording.calibration.joints
        floor = recording.floor_height
    else:
        path = motion_path(folder)
        motion = Motion.load(path)
        if (beside := measurements_path(path.parent)).exists():
            measured = read_measurements(beside)
            camera = measured.views[0].camera if measured.views else None
            joints, floor = measured.segments, measured.floor_height
    known = np.isfinite(motion.poses.p_world_joint).all(axis=(1, 2))
    known &= np.isfinite(motion.poses.R_world_bone).all(axis=(1, 2, 3))
    stretches = signals.runs(known)
    if not stretches:
        raise InvalidInputError(f"plan: the motion of {folder} has no complete frame")
    start, stop = max(stretches, key=lambda stretch: stretch[1] - stretch[0])
    sensors = tuple(name for name, (joint, _) in motion.skeleton.sensors.items() if joint in joints)
    return liveliest(motion.poses[start:stop], _LONGEST), motion.skeleton, camera, sensors, floor


def liveliest(poses: PoseSequence, seconds: float) -> PoseSequence:
    """Return the part of a movement with the fastest turns, of some seconds or all of a shorter one, from time 0."""
    count = min(round(seconds * poses.rate_hz), len(poses))
    speed = np.linalg.norm(np.diff(poses.R_world_bone, axis=0), axis=(2, 3)).sum(axis=1)
    total = np.concatenate([[0.0], np.cumsum(speed)])
    first = int(np.argmax(total[count - 1 :] - total[: len(total) - count + 1]))
    return replace(poses[first : first + count], times=poses.times[:count] - poses.times[0])

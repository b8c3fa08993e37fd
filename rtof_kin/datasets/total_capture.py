"""Total Capture (Trumble et al., BMVC 2017): takes and cameras as `Recording`s, z up, metres, seconds.

The data are available from their authors for research only; this package has none of them. Conventions::

    R_world_bone     = C . R_vicon_segment . M             world_of_vicon C, segment_of_bone M
    R_world_inertial = C . R_ref                           calib_imu_ref.txt
    R_sensor_bone    = R_bone^T . M                        calib_imu_bone.txt
    so that R_world_bone = R_world_inertial . R_inertial_sensor . R_sensor_bone

60 Hz throughout; positions in inches; acceleration is raw specific force in sensor axes.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Final

import numpy as np

from rtof_kin.body.pose_prior import NeutralPosture, posture_from_t_pose
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import Check, indices_of
from rtof_kin.core.errors import FileFormatError, InvalidInputError, UnknownNameError
from rtof_kin.data.camera import Camera
from rtof_kin.data.imu import BoneImuSequence, ImuCalibration, ImuSequence
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.datasets.total_capture_files import (
    CAMERA_FILE,
    CAMERAS,
    MISCALIBRATED,
    SUBJECTS,
    TEST,
    TRAIN,
    FileIndex,
    find_files,
    only_one,
)
from rtof_kin.datasets.total_capture_truth import (
    RATE_HZ,
    RIGID_MM,
    SEGMENT_OF_BONE,
    WORLD_OF_VICON,
    read_truth,
    rotations_of,
)
from rtof_kin.formats.total_capture import SensorTable, read_cameras, read_imu_calibration, read_sensors
from rtof_kin.recording.recording import Recording
from rtof_kin.recording.streams import naming

__all__ = ["ACKNOWLEDGEMENT", "CAMERAS", "SUBJECTS", "TEST", "TRAIN", "Take", "TotalCapture"]

ACKNOWLEDGEMENT = (
    "Total Capture: M. Trumble, A. Gilbert, C. Malleson, A. Hilton, J. Collomosse, 'Total Capture: 3D "
    "Human Pose Estimation Fusing Video and Inertial Sensors', BMVC 2017. Research use only."
)
_STAMP_FRAMES = 10  #: First frames, in which a foot may be stamped while the pose is constant
_NEEDED = {
    "positions": "positions (gt_skel_gbl_pos.txt)",
    "orientations": "orientations (gt_skel_gbl_ori.txt)",
    "sensors": "sensors (*_Xsens.sensors)",
    "calib_bone": "IMU calibration (*_calib_imu_bone.txt)",
    "calib_ref": "IMU calibration (*_calib_imu_ref.txt)",
}
"""Files of a complete take, by kind."""


@dataclass(frozen=True)
class Take:
    """One take: reference poses, sensors and cameras."""

    subject: str  #: S1 to S5
    name: str  #: Such as acting3
    truth: PoseSequence  #: Poses at 60 Hz from time 0; not `valid` where the reference has a known glitch
    joint_offsets: Array  #: (J, 3) each joint in its parent's link frame, m, measured in this take
    spread_mm: float  #: Largest standard deviation of an offset, mm; NaN where orientations were derived
    imus: ImuSequence | None
    """The calibrated sensors; None where there are none. The acceleration of the first ten frames, in which
    a foot may be stamped, is NaN."""
    calibration: ImuCalibration | None
    """Calibration of those sensors, from the take's files; lever arms are those of the skeleton table."""
    cameras: Mapping[int, Camera]  #: By number, 1 to 8; empty without a camera calibration
    missing: tuple[str, ...]  #: Missing files
    notes: tuple[str, ...]  #: Derived, repaired and omitted data

    @cached_property
    def skeleton(self) -> SkeletonModel:
        """The subject's skeleton in this take."""
        return SkeletonModel.default().with_offsets(self.joint_offsets)

    @cached_property
    def posture(self) -> NeutralPosture | None:
        """The subject's neutral posture, from the T-pose that takes begin with; None where there is none."""
        return posture_from_t_pose(self.truth, self.skeleton.parents)

    def recording(
        self,
        camera: int,
        keypoints: KeypointSequence | None = None,
        noise_px: float = 0.0,
        seed: int = 0,
        sensors: Sequence[str] | None = None,
        posture: bool = True,
    ) -> Recording:
        """Return the take as recorded by one camera and some sensors, with the truth. `UnknownNameError`: no such
        camera or sensor; `InvalidInputError`: keypoints of other times, or noise on a detector's keypoints.

        Args:
            camera: number, 1 to 8. sensors: names, by default all.
            keypoints: a detector's, of this camera's video; by default the projected joints, also outside
                the image. The recording ends with the shorter of keypoints and reference.
            noise_px: standard deviation of white noise on projected joints, px per axis.
            seed: of the noise; takes and cameras have different noise.
            posture: whether the reference's T-pose is known, as its joint offsets are.
        """
        self.camera(camera)
        if noise_px and keypoints is not None:
            raise InvalidInputError("noise_px: noise is added to true joints only, not to a detector's")
        if keypoints is None:
            keypoints = self._projected(camera, noise_px, seed)
        count = min(len(self.truth), len(keypoints))
        if not np.allclose(self.truth.times[:count], keypoints.times[:count], atol=0.1 / RATE_HZ):
            raise InvalidInputError(
                f"{self.subject} {self.name}: keypoints must begin at time 0 and have {RATE_HZ:g} "
                "samples a second, as the videos do"
            )
        truth = self.truth[:count]
        imus, calibration = self._sensors(sensors)
        notes = [*self.notes, *self.missing]
        if len(keypoints) != len(self.truth):
            notes.append(f"video of {len(keypoints)} frames, reference of {len(self.truth)}: cut")
        if camera in MISCALIBRATED:
            notes.append(MISCALIBRATED[camera])
        return Recording(
            name=f"{self.subject} {self.name} cam{camera}",
            keypoints=keypoints[: len(truth)],
            imus=imus,
            calibration=calibration,
            joint_offsets=self.joint_offsets,
            posture=self.posture if posture else None,
            truth=truth,
            acknowledgement=ACKNOWLEDGEMENT,
            notes="; ".join(notes),
        )

    def camera(self, number: int) -> Camera:
        """Return a camera, 1 to 8; raises UnknownNameError: no such camera, or no calibration of the cameras."""
        if number not in self.cameras:
            known = [str(n) for n in self.cameras] or ["none, without calibration.cal"]
            raise UnknownNameError("camera", [str(number)], known)
        return self.cameras[number]

    def _projected(self, number: int, noise_px: float, seed: int) -> KeypointSequence:
        """Project the true joints and add white noise."""
        camera = self.cameras[number]
        uv = camera.project(self.truth.p_world_joint)
        if noise_px:
            own = zlib.crc32(f"{self.subject} {self.name} {number}".encode())
            uv = uv + np.random.default_rng([seed, own]).normal(0, noise_px, uv.shape)
        confidence = np.isfinite(uv).all(axis=-1).astype(float)
        return KeypointSequence(camera, self.truth.times, uv, confidence, self.truth.names)

    def _sensors(self, names: Sequence[str] | None) -> tuple[ImuSequence | None, ImuCalibration | None]:
        if names is not None and not names:
            return None, None
        if self.imus is None or self.calibration is None or names is None:
            return self.imus, self.calibration
        return self.imus.select(names), self.calibration.select(tuple(names))


class TotalCapture:
    """The dataset in a folder. Files are searched once, and read when a take is requested."""

    def __init__(self, root: str | Path):
        """Search for the files; raises FileFormatError: there is no such folder, or no file of the dataset in it."""
        self.root = Path(root)
        self.index: FileIndex = find_files(self.root)

    @property
    def takes(self) -> tuple[tuple[str, str], ...]:
        """Subject and name of every take with at least one file."""
        return tuple(sorted(self.index.files))

    @cached_property
    def cameras(self) -> dict[int, Camera]:
        """Cameras in the z-up world by number; empty without a calibration file."""
        path = only_one(self.index.cameras)
        if path is None:
            return {}
        return {
            number: replace(camera, R_camera_world=camera.R_camera_world @ WORLD_OF_VICON.T)
            for number, camera in read_cameras(path).items()
        }

    def take(self, subject: str, name: str) -> Take:
        """Read a take of S1 to S5, such as acting3. `UnknownNameError`: no file of it was found; `FileFormatError`: no
        ground truth, a damaged file, or files that do not belong together.
        """
        key = (subject.upper(), name.lower())
        if key not in self.index.files:
            raise UnknownNameError(f"take in {self.root}", [" ".join(key)], [" ".join(take) for take in self.takes])
        if (positions := self.index.one(key, "positions")) is None:
            raise FileFormatError(self.root, f"{' '.join(key)} has no gt_skel_gbl_pos.txt: no ground truth")
        truth = read_truth(key, positions, self.index.one(key, "orientations"))
        notes = list(truth.notes)
        imus, calibration = self._imus(key, len(truth.poses), notes)
        have = {kind.replace("aux_", "") for kind in self.index.files[key]}
        missing = [f"no {what}" for kind, what in _NEEDED.items() if kind not in have]
        if not self.cameras:
            missing.append(f"no cameras ({CAMERA_FILE})")
        return Take(
            subject=key[0],
            name=key[1],
            truth=truth.poses,
            joint_offsets=truth.joint_offsets,
            spread_mm=truth.spread_mm,
            imus=imus,
            calibration=calibration,
            cameras=self.cameras,
            missing=tuple(missing),
            notes=tuple(notes),
        )

    def _imus(
        self, take: tuple[str, str], frames: int, notes: list[str]
    ) -> tuple[ImuSequence | None, ImuCalibration | None]:
        """Read the sensors that have data, a calibration and a place on the skeleton."""
        path, aux, calib_bone, calib_ref = (
            self.index.one(take, kind) for kind in ("sensors", "aux_sensors", "calib_bone", "calib_ref")
        )
        if path is None and aux is not None:
            path = aux
            notes.append(f"sensors from {path.name}, as there is no _Xsens.sensors")
        if path is None or calib_bone is None or calib_ref is None:
            return None, None
        table = read_sensors(path)
        bone, ref = read_imu_calibration(calib_bone), read_imu_calibration(calib_ref)
        known = SkeletonModel.default().sensors
        tables = {path.name: table.names, calib_bone.name: bone, calib_ref.name: ref, "the skeleton": known}
        for where, have in tables.items():
            if absent := [name for name in dict.fromkeys((*table.names, *known)) if name not in have]:
                notes.append(f"sensors left out, as they are not in {where}: {', '.join(absent)}")
        names = [name for name in table.names if name in bone and name in ref and name in known]
        if not names:
            return None, None
        imus = _sequence(path, table, names, frames, notes)
        R_ref, R_bone = (so3.from_quat_wxyz(np.roll([own[name] for name in names], 1, axis=1)) for own in (ref, bone))
        return imus, ImuCalibration(
            sensors=tuple(names),
            joints=tuple(known[name][0] for name in names),
            R_world_inertial=WORLD_OF_VICON @ R_ref,
            R_sensor_bone=np.swapaxes(R_bone, -1, -2) @ SEGMENT_OF_BONE,
            p_bone_sensor=np.array([known[name][1] for name in names]),
        )


def _sequence(path: Path, table: SensorTable, names: list[str], frames: int, notes: list[str]) -> ImuSequence:
    """Return the sensors named."""
    count = len(table.quat_wxyz)
    if count != frames:
        notes.append(f"{path.name} has {count} frames, the reference {frames}")
    index = indices_of("sensor", names, table.names)
    R, absent = rotations_of(path, table.quat_wxyz[:, index], names)
    f = table.f_sensor[:, index].copy()
    dead = (f == 0).all(axis=-1)
    for what, lost in (("orientation", absent.sum(axis=0)), ("acceleration", dead.sum(axis=0))):
        notes += [f"{name}: no {what} in {n} frames: unknown" for name, n in zip(names, lost, strict=True) if n]
    f[dead] = np.nan
    f[:_STAMP_FRAMES] = np.nan
    notes.append(f"accelerations of the first {_STAMP_FRAMES} frames are unknown: a foot may be stamped")
    with naming(path):
        return ImuSequence(np.arange(count) / RATE_HZ, R, f, tuple(names))


_T_POSE_DEG: Final = 25.0  #: Largest angle of a limb from the T-pose, deg; subjects are up to 20 deg off
_FACING_DEG: Final = 45.0
_HEIGHT, _HEIGHT_RANGE = 1.7, 0.5  #: Standing height of an adult and its largest deviation, m
_ACCELERATION: Final = 0.5  #: Largest mean over a take of acceleration minus gravity and the reference's, m/s^2
_IMU_DEG: Final = 15.0  #: Largest median angle between a sensor's segment and the reference's, deg
_REPROJECTION_PX: Final = 20.0
_BIAS_PX: Final = {2: float(np.hypot(20, -8))}  #: Known error of detections on a miscalibrated camera's video, px
_T_POSE_BONES = ("RightForeArm", "RightHand", "LeftForeArm", "LeftHand", "RightLeg", "RightFoot", "LeftLeg", "LeftFoot")
"""Child joints of the limb bones that make a T-pose."""


def check_take(take: Take) -> list[Check]:
    """Check the T-pose and facing at frame 0, the body's size, rigidity, and every sensor."""
    height = take.skeleton.height  # wrong if positions are not in inches
    advice = f"It stands {height:.3g} m tall: are the file's positions in inches, as the dataset's are?"
    size = Check(f"standing height from {_HEIGHT} m", "take", abs(height - _HEIGHT), _HEIGHT_RANGE, "m", advice)
    checks = [*_check_start(take), size, _check_bones(take)]
    if take.imus is not None and take.calibration is not None:
        bone_imus = take.calibration.apply(take.imus)
        checks += _check_orientations(take, bone_imus, take.imus.names)
        checks += _check_accelerations(take, bone_imus, take.imus.names)
    return checks


def check_camera(camera: int) -> list[Check]:
    """Return a failed check for a camera, 1 to 8, that is known to be miscalibrated, none for others."""
    if camera not in MISCALIBRATED:
        return []
    advice = f"{MISCALIBRATED[camera].capitalize()}; ground-truth 2D is not affected"
    name = "known bias of the calibration"
    return [Check(name, f"camera {camera}", _BIAS_PX[camera], _REPROJECTION_PX, "px", advice)]


def check_keypoints(take: Take, camera: int, keypoints: KeypointSequence) -> list[Check]:
    """Check the median reprojection error of the reference's joints in a camera, 1 to 8. `UnknownNameError`: the take
    has no such camera.
    """
    seen_by = take.camera(camera)
    names = [name for name in keypoints.names if name in take.truth.names]
    count = min(len(take.truth), len(keypoints))
    index = [take.truth.names.index(name) for name in names]
    true = seen_by.project(take.truth.p_world_joint[:count, index])
    error = np.linalg.norm(keypoints.select(names).uv_px[:count] - true, axis=-1)
    advice = "Detections of another take, person or camera, or landmarks far from the joints?"
    if camera in MISCALIBRATED:
        advice = MISCALIBRATED[camera].capitalize()
    value = _median(error)
    return [Check("median reprojection", f"camera {camera}", value, _REPROJECTION_PX, "px", advice)]


def _check_start(take: Take) -> Iterator[Check]:
    """Check that frame 0 is a T-pose that faces +y of the z-up world (-Z of the dataset's)."""
    skeleton, p = take.skeleton, take.truth.p_world_joint[0]
    right = p[skeleton.index("RightUpLeg")[0]] - p[skeleton.index("LeftUpLeg")[0]]
    turned_deg = float(np.degrees(np.arctan2(right[1], right[0])))
    advice = "Is the take cut, or in another world frame?"
    yield Check("turn from the usual facing at frame 0", "take", abs(turned_deg), _FACING_DEG, "deg", advice)
    R_world_t_pose = so3.about_axis("z", np.radians(turned_deg + 90.0))
    children = skeleton.index(*_T_POSE_BONES)
    bones = p[children] - p[[skeleton.parents[child] for child in children]]
    expected = skeleton.joint_offsets[children] @ R_world_t_pose.T
    angles = np.degrees(so3.angle_of(bones, expected))
    worst = int(np.argmax(angles))  # the first NaN, if there is one
    bone = f"{skeleton.names[skeleton.parents[children[worst]]]} to {_T_POSE_BONES[worst]}"
    name = f"largest angle of a limb from the T-pose at frame 0 ({bone})"
    advice = "Takes begin in a T-pose: is this one cut?"
    yield Check(name, "take", float(angles[worst]), _T_POSE_DEG, "deg", advice)


def _check_bones(take: Take) -> Check:
    """Check that the skeleton is rigid; with derived orientations, that bones have constant length."""
    if np.isfinite(take.spread_mm):
        advice = "Do positions and orientations belong together?"
        return Check("spread of joints in their parents' frames", "take", take.spread_mm, RIGID_MM, "mm", advice)
    p = take.truth.p_world_joint
    lengths = np.linalg.norm(p[:, 1:] - p[:, list(take.skeleton.parents[1:])], axis=-1)
    spread_mm = 1000 * float(np.nanstd(lengths, axis=0).max())
    advice = "The reference's bones are rigid: are the positions damaged?"
    return Check("spread of bone lengths", "take", spread_mm, RIGID_MM, "mm", advice)


def _check_orientations(take: Take, imus: BoneImuSequence, sensors: tuple[str, ...]) -> list[Check]:
    """Check the median angle between a sensor's segment and the reference's, where that is known."""
    truth, count = take.truth, min(len(take.truth), len(imus))
    medians_deg: dict[str, float] = {}
    for s, (sensor, joint) in enumerate(zip(sensors, imus.joints, strict=True)):
        j = truth.names.index(joint)
        if truth.orientation_observed[:, j].any():
            angles = so3.angle_between(imus.R_world_bone[:count, s], truth.R_world_bone[:count, j])
            medians_deg[sensor] = float(np.degrees(_median(angles)))
    failed = sum(not median <= _IMU_DEG for median in medians_deg.values())
    advice = "Has the sensor slipped, or is this the calibration of another take?"
    if failed > len(medians_deg) / 2:
        advice = f"{failed} of {len(medians_deg)} sensors fail this: is it the calibration of another take?"
    return [
        Check("median angle to the reference's segment", f"sensor {sensor}", value, _IMU_DEG, "deg", advice)
        for sensor, value in medians_deg.items()
    ]


def _check_accelerations(take: Take, imus: BoneImuSequence, sensors: tuple[str, ...]) -> Iterator[Check]:
    """Check the mean of a sensor's acceleration minus gravity and minus the reference's at its place."""
    truth, count = take.truth, min(len(take.truth), len(imus))
    j = [truth.names.index(joint) for joint in imus.joints]
    p = truth.p_world_joint[:count, j]
    p = p + np.einsum("tsij,sj->tsi", truth.R_world_bone[:count, j], imus.p_bone_sensor)
    excess = imus.a_world[1 : count - 1] - signals.derivative(p, RATE_HZ, 2)
    name = "mean acceleration less gravity and the reference's"
    advice = "Is gravity in the data, in m/s^2, and is the calibration this take's?"
    for s, sensor in enumerate(sensors):
        known = excess[np.isfinite(excess[:, s]).all(axis=-1), s]
        mean = float(np.linalg.norm(known.mean(axis=0))) if len(known) else float("nan")
        yield Check(name, f"sensor {sensor}", mean, _ACCELERATION, "m/s^2", advice)


def _median(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else float("nan")

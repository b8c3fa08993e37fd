"""Total Capture (Trumble et al., BMVC 2017): takes and cameras as `Recording`s, z up, metres, seconds.

The data are handed out by their authors for research only; nothing of them is in this package. Facts
about the files are those that their users and public loaders agree on::

    R_world_bone     = C . R_vicon_segment . M             world_of_vicon C, segment_of_bone M
    R_world_inertial = C . R_ref                           calib_imu_ref.txt
    R_sensor_bone    = R_bone^T . M                        calib_imu_bone.txt
    so that R_world_bone = R_world_inertial . R_inertial_sensor . R_sensor_bone

60 Hz throughout; positions in inches; acceleration is raw specific force in sensor axes.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rtof_kin import rotations as so3
from rtof_kin.calibration import ImuCalibration
from rtof_kin.checks import indices_of
from rtof_kin.datasets.total_capture_files import (
    SUBJECTS,
    TEST,
    TRAIN,
    FileIndex,
    find_files,
    only_one,
)
from rtof_kin.datasets.total_capture_truth import (
    RATE_HZ,
    SEGMENT_OF_BONE,
    WORLD_OF_VICON,
    read_truth,
)
from rtof_kin.errors import FileFormatError, ShapeError, UnknownNameError
from rtof_kin.io.total_capture import (
    SensorTable,
    read_cameras,
    read_imu_calibration,
    read_sensors,
)
from rtof_kin.recording import Recording
from rtof_kin.skeleton import SkeletonModel
from rtof_kin.types import Camera, ImuSequence, KeypointSequence, PoseSequence

__all__ = ["SUBJECTS", "TEST", "TRAIN", "Take", "TotalCapture"]

Array = NDArray[np.float64]
ACKNOWLEDGEMENT = (
    "Total Capture: M. Trumble, A. Gilbert, C. Malleson, A. Hilton, J. Collomosse, 'Total Capture: 3D "
    "Human Pose Estimation Fusing Video and Inertial Sensors', BMVC 2017. Research use only."
)
MISCALIBRATED = {2: "camera 2 is miscalibrated: detections on its video lie (+20, -8) px off"}
_STAMP_FRAMES = 10
"""A foot may be stamped in these first frames while the pose stands still."""
_NEEDED = ("positions", "orientations", "sensors", "calib_bone", "calib_ref")


@dataclass(frozen=True)
class Take:
    """One take: what Vicon saw, what the sensors gave, and the cameras around."""

    subject: str
    """S1 to S5."""
    name: str
    """Such as acting3."""
    truth: PoseSequence
    """Poses at 60 Hz from time 0; not `valid` where the reference is known to jump."""
    joint_offsets: Array
    """(J, 3) each joint in its parent's link frame, m, measured in this take."""
    spread_mm: float
    """Largest standard deviation of an offset, mm; NaN where orientations were derived."""
    imus: ImuSequence | None
    """The sensors that have a calibration; None where there are none. Without acceleration in the first
    ten frames, in which a foot may be stamped while the pose stands still."""
    calibration: ImuCalibration | None
    """Of those sensors, from the take's own files; lever arms are the skeleton's usual ones."""
    cameras: Mapping[int, Camera]
    """By number, 1 to 8; empty without a camera calibration."""
    missing: tuple[str, ...]
    """What was not found."""
    notes: tuple[str, ...]
    """What was derived, mended or left out."""

    @property
    def skeleton(self) -> SkeletonModel:
        """The subject's skeleton in this take."""
        return SkeletonModel.default().with_offsets(self.joint_offsets)

    def recording(
        self,
        camera: int,
        keypoints: KeypointSequence | None = None,
        noise_px: float = 0.0,
        seed: int = 0,
        sensors: Sequence[str] | None = None,
    ) -> Recording:
        """The take as one camera and some of the sensors recorded it.

        Args:
            camera: number, 1 to 8. keypoints: a detector's, of this camera's video; where not given,
                the true joints as the camera sees them, outside of the picture too.
            noise_px: standard deviation of white noise on true joints, px per axis.
            seed: of the noise; every take and camera has its own.
            sensors: names; all there are where not given.

        Returns:
            With the truth, cut to the shorter of video and reference.

        Raises:
            UnknownNameError: no such camera or sensor. ShapeError: keypoints of other times.
        """
        if camera not in self.cameras:
            raise UnknownNameError(
                "camera", [str(camera)], [str(number) for number in self.cameras]
            )
        if keypoints is None:
            keypoints = self._projected(self.cameras[camera], camera, noise_px, seed)
        truth = self._cut_to(keypoints)
        imus, calibration = self._sensors(sensors)
        notes = [*self.notes, *self.missing]
        if camera in MISCALIBRATED:
            notes.append(MISCALIBRATED[camera])
        return Recording(
            name=f"{self.subject} {self.name} cam{camera}",
            keypoints=keypoints[: len(truth)],
            imus=imus,
            calibration=calibration,
            joint_offsets=self.joint_offsets,
            truth=truth,
            acknowledgement=ACKNOWLEDGEMENT,
            notes="; ".join(notes),
        )

    def _projected(
        self, camera: Camera, number: int, noise_px: float, seed: int
    ) -> KeypointSequence:
        uv = camera.project(self.truth.p_world_joint)
        if noise_px:
            own = zlib.crc32(f"{self.subject} {self.name} {number}".encode())
            uv = uv + np.random.default_rng([seed, own]).normal(0, noise_px, uv.shape)
        confidence = np.isfinite(uv).all(axis=-1).astype(float)
        return KeypointSequence(camera, self.truth.times, uv, confidence, self.truth.names)

    def _cut_to(self, keypoints: KeypointSequence) -> PoseSequence:
        count = min(len(self.truth), len(keypoints))
        if not np.allclose(self.truth.times[:count], keypoints.times[:count], atol=0.1 / RATE_HZ):
            raise ShapeError(
                f"{self.subject} {self.name}: keypoints must begin at time 0 and have {RATE_HZ:g} "
                "samples a second, as the videos do"
            )
        return self.truth[:count]

    def _sensors(
        self, names: Sequence[str] | None
    ) -> tuple[ImuSequence | None, ImuCalibration | None]:
        if names is not None and not names:
            return None, None
        if self.imus is None or self.calibration is None or names is None:
            return self.imus, self.calibration
        return self.imus.select(names), self.calibration.select(tuple(names))


class TotalCapture:
    """The dataset in somebody's folder. Files are looked for once, and read when a take is asked for."""

    def __init__(self, root: str | Path):
        """Look for the files.

        Raises:
            FileFormatError: there is no such folder, or nothing of the dataset in it.
        """
        self.root = Path(root)
        self.index: FileIndex = find_files(self.root)

    @property
    def takes(self) -> tuple[tuple[str, str], ...]:
        """Subject and name of every take of which anything was found."""
        return tuple(sorted(self.index.files))

    @cached_property
    def cameras(self) -> dict[int, Camera]:
        """The cameras in the z-up world by number; empty where there is no calibration file.

        Raises:
            FileFormatError: the file is damaged, or there are several different ones.
        """
        path = only_one(self.index.cameras)
        if path is None:
            return {}
        return {
            number: replace(camera, R_camera_world=camera.R_camera_world @ WORLD_OF_VICON.T)
            for number, camera in read_cameras(path).items()
        }

    def missing(self, takes: Iterable[tuple[str, str]] = (*TRAIN, *TEST)) -> list[str]:
        """One line for every take that is not complete, and for files that cannot be assigned."""
        lines = [] if self.index.cameras else ["calibration.cal (all takes): not found"]
        for subject, name in takes:
            what = self._missing_of((subject, name))
            if what:
                lines.append(f"{subject} {name}: no {', '.join(what)}")
        lines += [
            f"{path}: neither its name nor its folders tell subject and take; not used"
            for path in self.index.unassigned
        ]
        return lines

    def _missing_of(self, take: tuple[str, str]) -> list[str]:
        have = set(self.index.files.get(take, ()))
        if not have:
            return ["file at all"]
        return [
            kind.replace("calib_", "IMU calibration (") + (")" if kind.startswith("calib_") else "")
            for kind in _NEEDED
            if kind not in have and not (kind == "sensors" and "aux_sensors" in have)
        ]

    def take(self, subject: str, name: str) -> Take:
        """Read a take.

        Raises:
            UnknownNameError: nothing of it was found. FileFormatError: no ground truth, or a file that
                is damaged, or files that do not belong together.
        """
        key = (subject.upper(), name.lower())
        if key not in self.index.files:
            raise UnknownNameError(
                f"take in {self.root}", [" ".join(key)], [" ".join(take) for take in self.takes]
            )
        truth = read_truth(key, lambda kind: self.index.one(key, kind), lambda: self._others(key))
        if truth is None:
            raise FileFormatError(
                self.root,
                f"{' '.join(key)} has no gt_skel_gbl_pos.txt and no BVH file: no ground truth",
            )
        notes: list[str] = list(truth.notes)
        imus, calibration = self._imus(key, len(truth.poses), notes)
        return Take(
            *key,
            truth.poses,
            truth.joint_offsets,
            truth.spread_mm,
            imus,
            calibration,
            self.cameras,
            tuple(f"no {what}" for what in self._missing_of(key)),
            tuple(notes),
        )

    def _others(self, take: tuple[str, str]) -> list[Array]:
        """Joint offsets of the subject's other takes, of those that can be read."""
        found = []
        for other in self.takes:
            kinds = self.index.files[other]
            if (
                other[0] == take[0]
                and other != take
                and {"positions", "orientations"} <= set(kinds)
            ):
                try:
                    truth = read_truth(other, lambda k, o=other: self.index.one(o, k), list)  # type: ignore[misc]
                except FileFormatError:
                    continue
                if truth is not None:
                    found.append(truth.joint_offsets)
        return found

    def _imus(
        self, take: tuple[str, str], frames: int, notes: list[str]
    ) -> tuple[ImuSequence | None, ImuCalibration | None]:
        path = self.index.one(take, "sensors") or self.index.one(take, "aux_sensors")
        calib_bone, calib_ref = (self.index.one(take, k) for k in ("calib_bone", "calib_ref"))
        if path is None or calib_bone is None or calib_ref is None:
            return None, None
        table = read_sensors(path)
        bone, ref = read_imu_calibration(calib_bone), read_imu_calibration(calib_ref)
        known = SkeletonModel.default().sensors
        names = [name for name in table.names if name in bone and name in ref and name in known]
        left_out = [name for name in table.names if name not in names]
        if left_out:
            notes.append(f"sensors without calibration or place, left out: {', '.join(left_out)}")
        if not names:
            return None, None
        imus = _sequence(path, table, names, frames, notes)
        R_ref = so3.from_quat_wxyz(np.array([np.roll(ref[name], 1) for name in names]))
        R_bone = so3.from_quat_wxyz(np.array([np.roll(bone[name], 1) for name in names]))
        return imus, ImuCalibration(
            sensors=tuple(names),
            joints=tuple(known[name][0] for name in names),
            R_world_inertial=WORLD_OF_VICON @ R_ref,
            R_sensor_bone=np.swapaxes(R_bone, -1, -2) @ SEGMENT_OF_BONE,
            p_bone_sensor=np.array([known[name][1] for name in names]),
        )


def _sequence(
    path: Path, table: SensorTable, names: list[str], frames: int, notes: list[str]
) -> ImuSequence:
    """The sensors named over the frames of the reference."""
    index = indices_of("sensor", names, table.names)
    count = len(table.quat_wxyz)
    if count != frames:
        notes.append(f"{path.name} has {count} frames, the reference {frames}")
    quat, f = table.quat_wxyz[:, index], table.f_sensor[:, index].copy()
    norm = np.linalg.norm(quat, axis=-1)
    absent = ~np.isfinite(norm) | (norm < 1e-6)
    wrong = ~absent & (np.abs(norm - 1) > 0.01)
    if wrong.any():
        frame, sensor = np.argwhere(wrong)[0]
        raise FileFormatError(
            path, f"the quaternion of {names[sensor]} in frame {frame + 1} has norm "
            f"{norm[frame, sensor]:.3g}, not 1",
        )  # fmt: skip
    for sensor, name in enumerate(names):
        if absent[:, sensor].any():
            notes.append(
                f"{name}: no orientation in {int(absent[:, sensor].sum())} frames, left open"
            )
    R = so3.from_quat_wxyz(np.where(absent[..., None], [1.0, 0, 0, 0], quat))
    R[absent] = np.nan
    dead = ~np.isfinite(f).all(axis=-1) | (np.abs(f).max(axis=-1) == 0)
    for sensor in np.flatnonzero(dead.any(axis=0)):
        lost = int(dead[:, sensor].sum())
        notes.append(f"{names[sensor]}: no acceleration in {lost} frames, left open")
    f[dead] = np.nan
    f[:_STAMP_FRAMES] = np.nan
    return ImuSequence(np.arange(count) / RATE_HZ, R, f, tuple(names))

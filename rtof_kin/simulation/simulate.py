"""Simulated recordings of known motion: a virtual camera and virtual IMUs with realistic errors.

The clock is that of the poses and the IMUs. `rtof_kin.simulation.noise` simulates the IMUs and the errors.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final, Self

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline

from rtof_kin.body import kinematics
from rtof_kin.body.pose_prior import SPINE
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.core.checks import indices_of
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.core.files.arrays import write_csv
from rtof_kin.core.files.folder import new_folder
from rtof_kin.core.files.text import write_text
from rtof_kin.data.camera import Camera
from rtof_kin.data.imu import GRAVITY_WORLD
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.formats.camera_toml import write_camera_toml
from rtof_kin.recording.recording import Recording
from rtof_kin.simulation.detector_errors import DetectorErrors, simulate_detections
from rtof_kin.simulation.mocap import MocapClip, read_mocap, resample_clip
from rtof_kin.simulation.mocap_families import PARENTS
from rtof_kin.simulation.noise import ImuNoise, simulate_imus
from rtof_kin.vision.keypoints import keypoints_from_detections

PELVIS_DEG: Final = (1.5, 5.0, 1.5)  #: Spread over people of the pelvis, about its axes x forward, y left, z up
BEND_DEG: Final = (1.5, 5.0, 1.5)  #: The same of each part of the spine, relative to the mean of all parts
CLAVICLE_DEG: Final = (5.0, 1.5, 6.0)  #: The same of a clavicle


def another_person(rng: Generator, poses: PoseSequence, skeleton: SkeletonModel) -> PoseSequence:
    """Return a movement (T, J) as a person with another neutral posture makes it: with pelvis, lumbar spine and
    clavicles turned by constants in their own frames. Limbs, head and upper trunk keep their orientations; the lowest
    foot keeps its height.
    """
    R, p_root = np.array(poses.R_world_bone), poses.p_world_joint[:, 0]
    at = {name: skeleton.names.index(name) for name in ("Hips", *SPINE, "LeftShoulder", "RightShoulder")}
    bends = np.radians(rng.normal(0.0, BEND_DEG, (len(SPINE), 3)))
    bends -= bends.mean(axis=0)
    turned = np.zeros(3)
    for name, bend in zip(SPINE[:-1], bends[:-1], strict=True):
        turned = turned + bend
        R[:, at[name]] = R[:, at[name]] @ so3.exp(turned)
    R[:, at["Hips"]] = R[:, at["Hips"]] @ so3.exp(np.radians(rng.normal(0.0, PELVIS_DEG)))
    for side, mirror in (("Left", 1.0), ("Right", -1.0)):
        constant = np.radians(rng.normal(0.0, CLAVICLE_DEG)) * [mirror, 1.0, mirror]
        R[:, at[f"{side}Shoulder"]] = R[:, at[f"{side}Shoulder"]] @ so3.exp(constant)
    p = kinematics.positions(skeleton.parents, skeleton.joint_offsets, p_root, R)
    p[..., 2] += poses.p_world_joint[..., 2].min() - p[..., 2].min()
    return replace(poses, p_world_joint=p, R_world_bone=R)


LIMB_SENSORS = ("L_UpArm", "R_UpArm", "L_LowArm", "R_LowArm", "L_UpLeg", "R_UpLeg", "L_LowLeg", "R_LowLeg")
"""The eight sensors of the paper: upper arms, forearms, thighs, shanks."""
_CAMERA_DISTANCE, _CAMERA_HEIGHT, _FURTHEST_CAMERA = (3.0, 6.0), (0.8, 2.6), 12.0  #: Ranges and largest distance, m
_FOCAL_PX: Final = 1250.0
_IN_VIEW: Final = 0.9
_FEWEST_FRAMES: Final = 4


LandmarkErrors = Callable[[Generator, Array, Sequence[str], Array, Mask], tuple[Array, Array]]
"""From a source of randomness, times (T,), s, the joints that carry L landmarks, their exact pixels (T, L, 2) and which
are inside the image (T, L): what a detector finds of them, NaN where nothing, and its confidences (T, L)."""


@dataclass(frozen=True)
class SimulationSettings:
    """Sensors, landmarks and errors of a simulated recording."""

    keypoints: DetectorErrors | LandmarkErrors | None = field(default_factory=DetectorErrors)  # None: exact 2D
    imu: ImuNoise = field(default_factory=ImuNoise)
    # A pair is the range of a uniform distribution.
    imu_rate_hz: float = 60.0  # [Hz]
    imu_start_frames: tuple[float, float] = (0.0, 1.0)  # [samples] after the poses
    video_lag_frames: tuple[float, float] = (0.0, 0.0)  # [frames] video behind IMUs, a detector's delay aside
    sensors: tuple[str, ...] = LIMB_SENSORS  # names in the skeleton's table; none: no IMUs
    landmarks: tuple[str, ...] = ()  # what the detector finds; none: the joints, or all that it shows

    @classmethod
    def noiseless(cls) -> Self:
        """Return exact data of every kind."""
        return replace(cls.perfect(), imu=ImuNoise.perfect(), imu_start_frames=(0.0, 0.0))

    @classmethod
    def perfect(cls) -> Self:
        """Return exact 2D on the IMUs' clock, with realistic IMUs."""
        return cls(keypoints=None)

    @classmethod
    def realistic(cls) -> Self:
        """Return the 2D of a real detector (`DetectorErrors`), its delay included, with realistic IMUs."""
        return cls()


def simulate(
    clip_poses: PoseSequence,
    joint_offsets: ArrayLike,
    *,
    camera: Camera | Sequence[Camera],
    settings: SimulationSettings,
    seed: int,
    skeleton: SkeletonModel | None = None,
    name: str = "simulated",
    acknowledgement: str = "",
) -> Recording:
    """Simulate a recording of known motion. Equal arguments give equal recordings, bit for bit.
    `InvalidInputError`: too few or unknown poses, or implausible motion; `UnknownNameError`: a sensor or landmark that
    the skeleton does not have.

    Args:
        clip_poses: the motion, at the rate of the video; finite everywhere, at least four frames.
        joint_offsets: (J, 3) m, of the motion and of the recording.
        camera: that films; of several the one that sees the person for longest.
        settings: errors; their parameters are drawn for this recording.
        skeleton: names, landmarks and usual sensors; the 21-joint one by default.

    Returns:
        The recording with the poses as truth. Where the video lags, frame k shows an earlier instant;
        frames from before the motion's start are left out, and `Recording.first_frame` counts them.
    """
    skeleton = (skeleton or SkeletonModel.default()).with_offsets(joint_offsets)
    _check(clip_poses, skeleton)
    draws, video, imu = np.random.default_rng(seed).spawn(3)
    lag = float(draws.uniform(*settings.video_lag_frames)) / clip_poses.rate_hz
    start = float(draws.uniform(*settings.imu_start_frames)) / settings.imu_rate_hz
    if isinstance(settings.keypoints, DetectorErrors):
        lag += settings.keypoints.draw_delay(draws)
    cut = int(np.searchsorted(clip_poses.times, clip_poses.times[0] + lag - 1e-9))
    if len(clip_poses) - cut < _FEWEST_FRAMES:
        raise InvalidInputError(f"simulation: {len(clip_poses)} poses are too few for a lag of {lag:g} s")
    imus, calibration = None, None
    if settings.sensors:
        first, last = clip_poses.times[0] + start, clip_poses.times[-1]
        count = int(np.floor((last - clip_poses.times[0] - start) * settings.imu_rate_hz + 1e-6)) + 1
        imu_times = np.minimum(first + np.arange(count) / settings.imu_rate_hz, last)
        imus, calibration = simulate_imus(imu, clip_poses, skeleton, settings.sensors, imu_times, settings.imu)
    cameras = [camera] if isinstance(camera, Camera) else camera
    filmed = (_simulate_keypoints(deepcopy(video), clip_poses, skeleton, one, settings, lag, cut) for one in cameras)
    return Recording(
        name=name,
        keypoints=max(filmed, key=lambda keypoints: float(keypoints.seen.mean())),
        imus=imus,
        calibration=calibration,
        skeleton_table=skeleton.name,
        joint_offsets=skeleton.joint_offsets,
        truth=clip_poses[cut:],
        first_frame=cut,
        acknowledgement=acknowledgement,
    )


def simulate_file(
    path: str | Path,
    *,
    settings: SimulationSettings,
    seed: int,
    camera: Camera | int | None = None,
    video_rate_hz: float = 60.0,
    smooth_hz: float | None = 10.0,
    rate_hz: float | None = None,
    unit_m: float | None = None,
    asf: str | Path | None = None,
    acknowledgement: str = "",
) -> Recording:
    """Simulate a recording of a motion capture file (.bvh, .amc).

    Args:
        path, rate_hz, unit_m, asf: as for `rtof_kin.simulation.mocap.read_mocap`.
        settings, seed, acknowledgement: as for `simulate`.
        camera: that films, or the number of one of the `standard_cameras` of this seed (0 to 3); by
            default the one of these that sees the person for longest.
        video_rate_hz: frames per second of the recording, Hz.
        smooth_hz: cutoff of `low_passed`, Hz; None does not filter.
    """
    clip = read_mocap(path, rate_hz=rate_hz, unit_m=unit_m, output_rate_hz=None, asf=asf)
    clip = resample_clip(clip if smooth_hz is None else low_passed(clip, smooth_hz), video_rate_hz)
    films: Camera | Sequence[Camera]
    if isinstance(camera, Camera):
        films = camera
    else:
        films = standard_cameras(clip.poses, seed)
        if camera is not None:
            indices_of("standard camera", [str(camera)], [str(i) for i in range(len(films))])
            films = films[camera]
    return simulate(
        clip.poses,
        clip.joint_offsets,
        camera=films,
        settings=settings,
        seed=seed,
        name=clip.name,
        acknowledgement=acknowledgement,
    )


def low_passed(clip: MocapClip, cutoff_hz: float) -> MocapClip:
    """Remove the jitter of optical markers, which would dominate an IMU's acceleration. Orientations are low-pass
    filtered by element (zero phase, -3 dB at `cutoff_hz`, below half that rate) and projected to the nearest rotation,
    the root's position likewise; joints follow by forward kinematics.
    """
    poses = clip.poses
    if not 0 < cutoff_hz < poses.rate_hz / 2:
        raise InvalidInputError(f"low-pass: {cutoff_hz:g} Hz does not lie between 0 and half of {poses.rate_hz:g} Hz")
    p_root = signals.low_pass(poses.p_world_joint[:, 0], poses.rate_hz, cutoff_hz)
    R = np.empty_like(poses.R_world_bone)
    for j in range(len(poses.names)):  # one by one, in less memory
        R[:, j] = so3.nearest_rotation(signals.low_pass(poses.R_world_bone[:, j], poses.rate_hz, cutoff_hz))
    p = kinematics.positions(PARENTS, clip.joint_offsets, p_root, R)
    return replace(clip, poses=replace(poses, p_world_joint=p, R_world_bone=R))


def standard_cameras(poses: PoseSequence, seed: int) -> list[Camera]:
    """Return the benchmark's four cameras around a motion, about 90 degrees apart: 1920 x 1080, f = 1250 px, 0.8-2.6 m
    high, aimed at the middle of the motion from 3-6 m away, or from further where less than nine tenths of it would be
    in view.
    """
    rng = np.random.default_rng(seed)
    p = poses.p_world_joint[np.isfinite(poses.p_world_joint).all(axis=(1, 2))]
    if len(p) == 0:
        raise InvalidInputError("cameras: no frame of the motion is complete")
    centre = (p.min(axis=(0, 1)) + p.max(axis=(0, 1))) / 2
    first = rng.uniform(0, 2 * np.pi)
    cameras = []
    for quarter in range(4):
        azimuth = first + quarter * np.pi / 2 + rng.uniform(-0.3, 0.3)
        height, distance = rng.uniform(*_CAMERA_HEIGHT), rng.uniform(*_CAMERA_DISTANCE)
        direction = np.array([np.cos(azimuth), np.sin(azimuth)])
        while True:
            position = np.array([*(centre[:2] + distance * direction), height])
            camera = Camera.looking_at(position, centre, _FOCAL_PX)
            if _inside(camera, camera.project(p)).mean() >= _IN_VIEW or distance >= _FURTHEST_CAMERA:
                break
            distance += 0.25
        cameras.append(camera)
    return cameras


def _check(poses: PoseSequence, skeleton: SkeletonModel) -> None:
    if poses.names != skeleton.names:
        raise InvalidInputError(
            f"simulation: the poses' joints are not those of the skeleton {skeleton.name} in their "
            f"order; expected {', '.join(skeleton.names)}"
        )
    if len(poses) < _FEWEST_FRAMES:
        raise InvalidInputError(f"simulation: {len(poses)} poses; {_FEWEST_FRAMES} at least are needed")
    known = np.isfinite(poses.p_world_joint).all(axis=(1, 2))
    known &= np.isfinite(poses.R_world_bone).all(axis=(1, 2, 3))
    if not known.all():
        raise InvalidInputError(
            f"simulation: the pose of frame {int(np.flatnonzero(~known)[0])} is not "
            "complete; cut the motion into pieces without gaps"
        )


# --- keypoints -----------------------------------------------------------------------------------


def _simulate_keypoints(
    rng: Generator,
    poses: PoseSequence,
    skeleton: SkeletonModel,
    camera: Camera,
    settings: SimulationSettings,
    lag: float,
    cut: int,
) -> KeypointSequence:
    """Return what a detector finds in the frames from number `cut` on, which show what was `lag` s earlier."""
    noise, times = settings.keypoints, poses.times[cut:]
    if isinstance(noise, DetectorErrors):
        at = np.maximum(times - lag, poses.times[0])  # up to rounding within the motion
        R = signals.interpolate_rotations(poses.times, poses.R_world_bone, at)
        shown = PoseSequence(at, CubicSpline(poses.times, poses.p_world_joint)(at), R, poses.names)
        found = simulate_detections(rng, shown, skeleton, camera, noise)
        keypoints = keypoints_from_detections(found, times, camera).keypoints
        return keypoints.select(settings.landmarks) if settings.landmarks else keypoints
    names, known = settings.landmarks or skeleton.names, list(skeleton.landmarks)
    landmarks = [skeleton.landmarks[known[i]] for i in indices_of("landmark", names, known)]
    joints = [joint for joint, _ in landmarks]
    index, offsets = skeleton.index(*joints), np.array([offset for _, offset in landmarks])
    p = poses.p_world_joint[:, index] + np.einsum("tlij,lj->tli", poses.R_world_bone[:, index], offsets)
    p = CubicSpline(poses.times, p)(times - lag) if lag > 0 else p
    uv = exact = camera.project(p)
    confidence = np.ones(uv.shape[:2])
    if noise is not None:
        uv, confidence = noise(rng, times, joints, exact, _inside(camera, exact))
    seen = np.asarray(np.isfinite(uv).all(axis=-1))
    uv, confidence = np.where(seen[..., None], uv, np.nan), np.where(seen, confidence, 0.0)
    return KeypointSequence(camera, times, uv, confidence, names)


def _inside(camera: Camera, uv_px: Array) -> Mask:
    """Return whether pixels (..., 2) lie inside the image; NaN does not."""
    size = np.array([camera.width_px, camera.height_px])
    return np.asarray(((uv_px >= 0) & (uv_px <= size)).all(axis=-1))


KEYPOINTS, SENSORS, PLACES, CAMERA = "keypoints.csv", "dots", "places.csv", "camera.toml"
"""What `write_raw_files` writes."""
_BEGUN: Final = 37.0  #: [s] What the sensors' clock shows when the video begins
_WORDS: Final = {"UpLeg": "thigh", "Leg": "shank", "ForeArm": "forearm", "Arm": "upper arm", "Foot": "foot"}
_DOT_COLUMNS: Final = "PacketCounter,SampleTimeFine,Quat_W,Quat_X,Quat_Y,Quat_Z,FreeAcc_X,FreeAcc_Y,FreeAcc_Z"


def write_raw_files(recording: Recording, folder: str | Path, overwrite: bool = False) -> None:
    """Write keypoints, sensors on a clock of their own, their places and the camera, as a user has them; `overwrite`
    replaces what this wrote earlier. The sensors' files are those of Movella DOTs, one per sensor, named by a letter
    and a number. Mounting, headings and the time between the two clocks are in none of the files. `InvalidInputError`:
    no keypoints; `OutputExistsError`: `folder` may not be replaced.
    """
    keypoints = recording.video
    with new_folder(folder, KEYPOINTS, overwrite) as fresh:
        write_csv(fresh / KEYPOINTS, keypoints.columns())
        write_camera_toml(fresh / CAMERA, {"phone": keypoints.camera})
        if recording.imus is not None:
            _write_sensors(recording, fresh)


def _write_sensors(recording: Recording, folder: Path) -> None:
    imus, calibration = recording.imus, recording.calibration
    if imus is None or calibration is None:
        raise InvalidInputError(f"recording {recording.name}: its sensors have no places")
    (folder / SENSORS).mkdir()
    places, rate = [], 1 / float(np.median(np.diff(imus.times)))
    R, f = imus.R_inertial_sensor, imus.f_sensor
    free = np.einsum("tsij,tsj->tsi", R, f) + GRAVITY_WORLD
    stamps = np.round(1e6 * (imus.times - recording.video.times[0] + _BEGUN))
    for s, name in enumerate(imus.names):
        rows = np.column_stack([np.arange(len(stamps)), stamps, so3.to_quat_wxyz(R[:, s]), free[:, s]])
        lines = [_DOT_COLUMNS, *(",".join(f"{value:.9g}" for value in row) for row in rows)]
        head = f"sep=,\nDeviceTag:,D{s + 1}\nOutputRate:,{rate:.0f}Hz\n\n"
        path = folder / SENSORS / f"D{s + 1}_20260131_101500.csv"
        write_text(path, head + "\n".join(lines) + "\n")
        places.append(f"D{s + 1}, {_place(calibration.joints[calibration.sensors.index(name)])}\n")
    write_text(folder / PLACES, "sensor, segment\n" + "".join(places))


def _place(joint: str) -> str:
    """Return the segment of a joint in words, such as 'left thigh'."""
    for side in ("Left", "Right"):
        if joint.startswith(side) and joint.removeprefix(side) in _WORDS:
            return f"{side.lower()} {_WORDS[joint.removeprefix(side)]}"
    return {"Hips": "pelvis", "Spine3": "chest"}.get(joint, joint)

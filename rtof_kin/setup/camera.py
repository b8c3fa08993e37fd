"""The camera of a recording: as a file has it, or assumed, with standard deviations of what is assumed.

An assumed camera stands at (0, 0, its height), looks along +x, level, over a floor at z = 0.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from rtof_kin.calibration.camera_estimate import pitch_and_roll
from rtof_kin.core.errors import FileFormatError, InvalidInputError, RtofError
from rtof_kin.data.camera import Camera, CameraUncertainty
from rtof_kin.data.camera_motion import CameraMotion
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.formats.cameras import read_camera
from rtof_kin.formats.sensors.files import read_sensor_log
from rtof_kin.formats.sensors.tables import phone_files, read_phone
from rtof_kin.inertial.orientation import match_to_image, with_gravity
from rtof_kin.reconstruction.lift import LifterLike
from rtof_kin.reconstruction.pipeline import calibrate_camera
from rtof_kin.reconstruction.prepare import Progress
from rtof_kin.recording.recording import Recording
from rtof_kin.setup.recording_text import Field, Origin, Tables
from rtof_kin.vision.background_motion import BackgroundMotion, estimate_camera_motion
from rtof_kin.vision.detections import Detections
from rtof_kin.vision.video_metadata import LensPrior

HEIGHT, SIGMA_HEIGHT = 1.2, 0.4  # Height of an assumed camera over the floor and its standard deviation, m
SIGMA_PITCH_DEG, SIGMA_ROLL_DEG = 10.0, 4.0
"""Standard deviations of pitch and roll of an assumed camera, degrees: tripods and shelves look down."""
_POSE: Final = "pose"


@dataclass(frozen=True)
class SetupCamera:
    """A camera and the table of ``recording.toml`` that describes it."""

    camera: Camera
    fields: Tables

    @property
    def placed(self) -> bool:
        """Whether position and direction were measured."""
        return _POSE not in self.camera.assumed


def assumed_camera(width_px: int, height_px: int, lens: LensPrior, size: Field) -> SetupCamera:
    """Return the camera that is assumed where none is calibrated."""
    focal, k1 = float(round(lens.focal_px, 1)), float(round(lens.k1, 4))
    camera = replace(
        Camera.looking_at([0, 0, HEIGHT], [1, 0, HEIGHT], focal, width_px, height_px),
        distortion=np.array([k1, 0.0, 0.0, 0.0, 0.0]),
        assumed=("focal length", "lens distortion", _POSE),
    )
    optics = {
        "focal_px": Field(
            focal,
            Origin.ASSUMED,
            lens.source,
            f"focal length {focal:.0f} px ± {100 * lens.sigma_focal:.0f} % ({lens.source})",
        ),
        "distortion": Field(camera.distortion.tolist(), Origin.ASSUMED, f"k1 = {k1:g} ± {lens.sigma_k1:.2g}"),
    }
    return _placed(camera, size, optics, float(lens.sigma_focal), float(lens.sigma_k1))


def calibrated_camera(path: str | Path, name: str | None, size_px: tuple[int, int] | None, video: str) -> SetupCamera:
    """Read a calibration; where it has no pose, the pose is assumed.

    `path`: see `rtof_kin.formats.cameras`. size_px: of the video's upright image, None where unknown.
    `InvalidInputError`: it is of another image size. Errors of `read_camera`.
    """
    camera = read_camera(path, name)
    own = camera.width_px, camera.height_px
    if size_px not in (None, own):
        assert size_px is not None
        raise InvalidInputError(
            f"{path}: is of a camera of {own[0]} x {own[1]} px, and {video} has {size_px[0]} x {size_px[1]} "
            "px; give the calibration of this camera at this size"
        )
    origin = Path(path).name + (f", camera {name}" if name else "")
    size = Field(None, Origin.FILE, origin, f"the camera of {origin}")
    optics = {"K": Field(camera.K.tolist()), "distortion": Field(camera.distortion.tolist())}
    if _POSE in camera.assumed:
        level = Camera.looking_at([0, 0, HEIGHT], [1, 0, HEIGHT], 1.0)
        camera = replace(camera, R_camera_world=level.R_camera_world, t_camera_world=level.t_camera_world)
        return _placed(camera, size, optics, 0.0, 0.0)
    assumed = {"assumed": Field(list(camera.assumed), Origin.FILE, origin)} if camera.assumed else {}
    fields = {
        **_size(camera, size),
        **optics,
        "R_camera_world": Field(camera.R_camera_world.tolist()),
        "t_camera_world_m": Field(camera.t_camera_world.tolist()),
        **assumed,
    }
    return SetupCamera(camera, fields)


def _placed(camera: Camera, size: Field, optics: dict[str, Field], sigma_focal: float, sigma_k1: float) -> SetupCamera:
    unsure = Origin.ASSUMED
    pitch, roll = (float(np.radians(deg)) for deg in (SIGMA_PITCH_DEG, SIGMA_ROLL_DEG))
    sigma = CameraUncertainty(sigma_focal, pitch, SIGMA_HEIGHT, sigma_k1, roll)
    fields: dict[str, Field | Tables] = {
        **_size(camera, size),
        **optics,
        "position_m": Field(
            [0.0, 0.0, HEIGHT],
            unsure,
            f"± {SIGMA_HEIGHT:g} m over the floor; measure the height of the lens, write it in both lines",
            f"the camera is {HEIGHT:g} ± {SIGMA_HEIGHT:g} m over the floor, and level ± "
            f"{SIGMA_PITCH_DEG:.0f} degrees (roll {SIGMA_ROLL_DEG:.0f})",
        ),
        "target_m": Field([1.0, 0.0, HEIGHT], unsure, f"level, ± {SIGMA_PITCH_DEG:.0f} degrees"),
        "assumed": Field(list(camera.assumed), note="named in reports; take out what you have measured"),
        "uncertainty": {
            "focal": Field(sigma.focal, note="standard deviations: relative,"),
            "tilt_deg": Field(SIGMA_PITCH_DEG, note="of pitch,"),
            "roll_deg": Field(SIGMA_ROLL_DEG),
            "height_m": Field(sigma.height, note="over the floor (0.01 where it is measured),"),
            "k1": Field(sigma.k1, note="before the motion; reconstruct estimates the four"),
        },
    }
    return SetupCamera(replace(camera, uncertainty=sigma), fields)


def seen_camera(
    camera: SetupCamera,
    keypoints: KeypointSequence,
    height: float | None,
    lifter: LifterLike | None,
    progress: Progress,
) -> SetupCamera:
    """Return an assumed camera as the person before it shows it; sensors are aligned with this one.

    Sensors whose mounting is found with the image do not tell its tilt any more, so what floor and posture
    say is used here, before them.

    `height`: of the person, m. `lifter`: default: the shipped one. `progress`: called with (stage, steps done, in all).
    Errors of the lift.
    """
    recording = Recording("camera", keypoints, floor_height=0.0, height=height)
    found = calibrate_camera(recording, lifter=lifter, progress=progress).found
    own = found.uncertainty
    assert own is not None
    assert own.roll is not None
    down, right = (float(np.degrees(angle)) for angle in pitch_and_roll(found))
    note = (
        f"looks down by {down:.1f} ± {np.degrees(own.tilt):.1f} degrees, turned by {right:.1f} ± "
        f"{np.degrees(own.roll):.1f}, {found.center_world[2]:.2f} ± {own.height:.2f} m over the floor"
    )
    fields: Tables = {
        **{name: field for name, field in camera.fields.items() if name not in ("position_m", "target_m")},
        "focal_px": Field(float(found.K[0, 0]), Origin.FOUND, f"± {100 * own.focal:.0f} %"),
        "R_camera_world": Field(found.R_camera_world.tolist(), Origin.FOUND, note, f"the camera {note}"),
        "t_camera_world_m": Field(found.t_camera_world.tolist()),
        "uncertainty": {
            "focal": Field(own.focal, note="what remains: relative,"),
            "tilt_deg": Field(float(np.degrees(own.tilt)), note="of pitch,"),
            "roll_deg": Field(float(np.degrees(own.roll))),
            "height_m": Field(own.height),
            "k1": Field(own.k1),
            "of_motion": Field(True, note="floor and posture of this recording are in these already"),
        },
    }
    return SetupCamera(found, fields)


def _size(camera: Camera, size: Field) -> dict[str, Field]:
    return {"width_px": replace(size, value=camera.width_px), "height_px": Field(camera.height_px)}


MOTION: Final = "camera_motion.npz"  # File of a recording's folder
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class FilmingCamera:
    """The camera of a take, and how it turned."""

    camera: SetupCamera
    motion: CameraMotion | None = None  # None where it stood still, or nothing tells
    doubts: tuple[str, ...] = ()


def filming_camera(
    video: Path | None, people: Detections, camera: SetupCamera, phone: Path | None, progress: Progress
) -> FilmingCamera:
    """Find out whether a camera stood still; of one that turned, its focal length follows too.

    `video`: None where there is none. progress: called with ("camera", frames done, in total). `InvalidInputError`: a
    log without a video; `FileFormatError`: the log cannot be read.
    """
    if video is None:
        if phone is not None:
            raise InvalidInputError(f"{phone}: give the video too, which tells the time between both")
        return FilmingCamera(camera)
    unsure = camera.camera.uncertainty
    try:
        found = rotation_of_video(
            video, people, camera.camera, unsure.focal if unsure else 0.0, phone=phone, progress=progress
        )
    except FileFormatError:
        raise
    except RtofError as error:  # nothing to follow, or OpenCV is not installed
        return FilmingCamera(camera, None, (f"whether the camera stood still is not known: {error}",))
    if found.turning().passed:
        return FilmingCamera(camera)
    fields = dict(camera.fields)
    if unsure is not None and found.sigma_focal < unsure.focal:
        focal, sigma = round(float(found.camera.K[0, 0]), 1), round(found.sigma_focal, 4)
        why = f"focal length {focal:.0f} px ± {100 * sigma:.0f} %, by how the background moves as it turns"
        fields["focal_px"] = Field(focal, Origin.FOUND, why, why)
        uncertainty = fields["uncertainty"]
        assert not isinstance(uncertainty, Field)
        fields["uncertainty"] = {**uncertainty, "focal": Field(sigma, note="standard deviations: relative,")}
        camera = SetupCamera(replace(camera.camera, K=found.camera.K, uncertainty=replace(unsure, focal=sigma)), fields)
    fields["motion"] = {"file": Field(MOTION, Origin.FOUND, "keypoints are stabilised by it", found.summary)}
    return FilmingCamera(SetupCamera(camera.camera, fields), found.motion)


def rotation_of_video(
    video: str | Path,
    people: Detections | KeypointSequence | None,
    camera: Camera,
    sigma_focal: float,
    *,
    phone: str | Path | None = None,
    progress: Progress | None = None,
) -> BackgroundMotion:
    """Estimate the turning of a camera, and its focal length where it turned.

    `video`, `people`, `camera`, `sigma_focal`: as for `estimate_camera_motion`. `phone`: log of the gyroscope of the
    phone that filmed, and of its accelerometer, which gives the tilt. `progress`: called with ("camera", frames done,
    in total). `FileFormatError`: a file cannot be read; `InvalidInputError`: the background has nothing to follow, or
    the log no gyroscope; `RtofError`: the extra ``video`` is not installed.
    """
    found = estimate_camera_motion(video, people, camera, sigma_focal=sigma_focal, progress=progress)
    if phone is None:
        return found
    files = phone_files(Path(phone))
    stream = (read_phone(files) if files else read_sensor_log(phone)).streams[0]
    match = match_to_image(stream, found.motion)
    if match.doubt:
        _log.warning("%s: %s; it is not used", phone, match.doubt)
        return found
    _log.info("%s: held %s, %+.3f s to the clock of the video", phone, match.held, match.offset)
    return replace(found, motion=with_gravity(found.motion, stream, match))

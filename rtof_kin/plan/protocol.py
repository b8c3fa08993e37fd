"""`Protocol`: what is to be recorded, with which camera and sensors; read from a TOML file.

docs/plan.md describes the file. A direction of a camera is its place as seen from above, in degrees: 0 before
the person as the movement begins, 90 to the person's left, 180 behind.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Final, Self

import numpy as np

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.clinical.angle_table import angle_table
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import indices_of
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.core.files.input_table import InputTable, Integer, Names, Number, Row
from rtof_kin.data.camera import Camera
from rtof_kin.data.poses import PoseSequence
from rtof_kin.vision.layouts import OWN_LAYOUTS, is_layout_file, layout_named

_PLACES: Final = {
    "Head": "forehead, on a headband",
    "Spine3": "breastbone",
    "Hips": "back of the pelvis, on the sacrum",
    "ForeArm": "back of the {side} forearm just above the wrist, as a watch",
    "Arm": "outside of the {side} upper arm, lower third, away from the biceps",
    "UpLeg": "outside of the {side} thigh, upper third",
    "Leg": "flat inner face of the {side} shin, upper half",
    "Foot": "back of the {side} foot, on the laces",
}
"""End of a joint's name -> where its segment's sensor goes, as in docs/sensor_placement.md."""


@dataclass(frozen=True)
class Framing:
    """Place of a camera relative to a movement."""

    distance: float  #: [m] horizontal, from the middle of the pelvis' path
    height: float  #: [m] over the floor
    angle_deg: float
    """Direction of the camera from that middle, from the person's facing at the start: 0 in front, 90 to the
    person's left, -90 to the right."""
    tilt_deg: float  #: Of the optical axis, downwards
    field_deg: tuple[float, float]  #: Horizontal and vertical field of view
    middle: Array  #: (2,) m, of the pelvis' path
    inside: float  #: Share of frames with all landmarks in the picture
    margin: float
    """Least distance of a landmark from the border over all frames, share of the picture's height; negative
    outside, NaN where a landmark is behind the camera."""

    @property
    def tilt(self) -> str:
        """Tilt in words."""
        down = "down" if self.tilt_deg > 0 else "up"
        return "level" if abs(self.tilt_deg) < 1 else f"tilted {abs(self.tilt_deg):.0f}° {down}"

    @property
    def view(self) -> str:
        """What the picture shows, in words."""
        if self.inside < 1:
            return (
                f"the whole body is in the picture only {100 * self.inside:.0f} % of the time: move the "
                "camera back or aim it better"
            )
        return f"the whole body stays in the picture, with {100 * self.margin:.0f} % of its height to spare"


def framing(poses: PoseSequence, skeleton: SkeletonModel, camera: Camera) -> Framing:
    """Return where a camera stands relative to a movement on the floor z = 0, and whether it sees all of it."""
    distance, height, angle_deg = stand_of(camera, poses)
    axis = camera.R_camera_world[2]
    uv = camera.project(skeleton.landmark_positions(poses.p_world_joint, poses.R_world_bone))
    size = np.array([camera.width_px, camera.height_px])
    least = np.minimum(uv, size - uv).min(axis=(1, 2)) / camera.height_px
    fields = 2 * np.arctan(size / 2 / np.diag(camera.K)[:2])
    return Framing(
        distance=distance,
        height=height,
        angle_deg=angle_deg,
        tilt_deg=float(np.degrees(np.arcsin(np.clip(-axis[2], -1, 1)))),
        field_deg=(float(np.degrees(fields[0])), float(np.degrees(fields[1]))),
        middle=centre_of(poses)[:2],
        inside=float(np.mean(least >= 0)),
        margin=float(least.min()),
    )


def stand_of(camera: Camera, poses: PoseSequence) -> tuple[float, float, float]:
    """Return a camera's horizontal distance from the middle of a movement, m, its height, m, and its
    direction from there, deg from the person's facing at the start, positive to the left.
    """
    way = camera.center_world[:2] - centre_of(poses)[:2]
    angle = np.degrees(np.arctan2(way[1], way[0]) - facing_of(poses))
    return float(np.hypot(*way)), float(camera.center_world[2]), float((angle + 180) % 360 - 180)


def centre_of(poses: PoseSequence) -> Array:
    """Return the middle (3,) m of a movement: of the pelvis' path on the floor, and of the body's height."""
    path, heights = poses.p_world_joint[:, 0, :2], poses.p_world_joint[..., 2]
    middle = (path.min(axis=0) + path.max(axis=0)) / 2
    return np.array([*middle, (heights.min() + heights.max()) / 2])


def facing_of(poses: PoseSequence) -> float:
    """Return the heading of the pelvis in the first frame, rad from world's x."""
    return float(so3.heading(poses.R_world_bone[:1, 0])[0])


def sensor_places(skeleton: SkeletonModel, sensors: Sequence[str]) -> dict[str, str]:
    """Return where to strap each sensor, in words: name -> "outside of the left thigh, upper third".
    `UnknownNameError`: a sensor that it does not have.
    """
    indices_of("sensor", sensors, list(skeleton.sensors))
    found = {}
    for name in sensors:
        joint, _ = skeleton.sensors[name]
        side = "left" if joint.startswith("Left") else "right"
        found[name] = next(words for end, words in _PLACES.items() if joint.endswith(end)).format(side=side)
    return found


MEASURED: Final = "mediapipe33"
"""Layout of the detector whose errors were measured; the points of others err as those next to them."""
_PLAUSIBLE: Final = {
    "distance_m": (0.8, 30.0),
    "height_m": (0.1, 6.0),
    "angle_deg": (-360.0, 360.0),
    "width_px": (160, 16000),
    "height_px": (120, 16000),
    "rate_hz": (10, 400),
}
_FIELD_OF_VIEW_DEG: Final = (10.0, 150.0)
_PLACE: Final = ("angle_deg", "distance_m", "height_m")


@dataclass(frozen=True)
class CameraPlace:
    """Where a level camera stands, and its lens; it is aimed at the middle of the movement."""

    angle_deg: float = 45.0  #: [deg] see the module
    distance_m: float = 4.0  #: [m] horizontal, from the middle of the pelvis' path
    height_m: float = 1.2  #: [m] over the floor
    focal_px: float = 1400.0  #: [px] focal length
    width_px: int = 1920
    height_px: int = 1080
    rate_hz: float = 60.0  #: [Hz] frames per second

    def __post_init__(self) -> None:
        for name, (low, high) in _PLAUSIBLE.items():
            if not low <= (value := getattr(self, name)) <= high:
                raise InvalidInputError(f"camera: {name} is {value:g}; expected {low:g} to {high:g}")
        low, high = _FIELD_OF_VIEW_DEG
        if not low <= self.field_of_view_deg <= high:
            raise InvalidInputError(
                f"camera: focal_px of {self.focal_px:g} with a width of {self.width_px} px is a field of view of "
                f"{self.field_of_view_deg:.0f} deg; expected {low:g} to {high:g}. The focal length is in pixels, not mm"
            )

    @property
    def field_of_view_deg(self) -> float:
        """Horizontal field of view, deg."""
        return float(np.degrees(2 * np.arctan2(self.width_px / 2, self.focal_px)))

    def camera(self, poses: PoseSequence) -> Camera:
        """Return the camera for a movement in world, z up, floor at 0."""
        centre, angle = centre_of(poses), facing_of(poses) + np.radians(self.angle_deg)
        at = centre + self.distance_m * np.array([np.cos(angle), np.sin(angle), 0.0])
        at[2] = self.height_m
        return Camera.looking_at(at, centre, self.focal_px, self.width_px, self.height_px)

    @property
    def words(self) -> str:
        """The place in words."""
        lens = f"{self.distance_m:g} m away, lens {self.height_m:g} m above the floor"
        return f"{direction(self.angle_deg)}, {lens}"


@dataclass(frozen=True)
class Protocol:
    """What is to be recorded."""

    movement: str  #: Name in the library, or folder of a motion
    repetitions: int | None = None  #: Of the movement; None for the usual number
    height_m: float | None = None  #: [m] standing height of the person; None for the skeleton's
    camera: CameraPlace = field(default_factory=CameraPlace)
    sensors: tuple[str, ...] = ()  #: Worn, names of the skeleton's table
    possible_sensors: tuple[str, ...] | None = None  #: Where one more could go; None: everywhere else
    possible_cameras: tuple[CameraPlace, ...] | None = None
    """Places that the camera could have; None: eight directions at its distance and height."""
    any_camera: bool = False
    """Whether nothing is said about the camera's place, so that the best of the possible ones is planned."""
    detector: str = MEASURED  #: Layout by name, or a file of one
    error_factor: float = 1.0  #: [1] on the errors of the measured detector in the image
    wanted: tuple[str, ...] = ()  #: Clinical angles that matter; () for all
    wanted_sd_deg: float | None = None  #: [deg] standard deviation that they need

    def __post_init__(self) -> None:
        skeleton = SkeletonModel.default()
        for name in ("sensors", "possible_sensors"):
            indices_of(f"sensor of {name}", getattr(self, name) or (), tuple(skeleton.sensors))
        indices_of("angle", self.wanted, [row.name for row in angle_table(skeleton.table).rows])
        if (known := layout_named(self.detector)) in OWN_LAYOUTS:
            raise InvalidInputError(f"detector: {known} are points of the skeleton; name the layout of a detector")
        ranges = {"height_m": (0.8, 2.3), "repetitions": (1, 50), "error_factor": (0.1, 10.0)}
        for name, (low, high) in ranges.items():
            value = getattr(self, name)
            if value is not None and not low <= value <= high:
                raise InvalidInputError(f"protocol: {name} is {value:g}; expected {low:g} to {high:g}")

    @classmethod
    def read(cls, path: str | Path) -> Self:
        """Read a protocol's TOML file; the folder of a motion is relative to it. `FileFormatError`: a field is missing,
        unknown, or of another type; `InvalidInputError`: a value is not plausible; `UnknownNameError`: no such sensor
        or angle.
        """
        path = Path(path)
        top = ProtocolTable.read(path)
        movement = top.movement
        if (path.parent / movement).is_dir():
            movement = str(path.parent / movement)
        detector = top.detector.points
        if is_layout_file(detector):
            detector = str((path.parent / detector).resolve())
        return cls(
            movement,
            repetitions=top.repetitions,
            height_m=top.height_m,
            camera=top.camera.place(),
            sensors=top.sensors.worn,
            possible_sensors=top.sensors.possible,
            possible_cameras=top.camera.places(),
            any_camera=not {*_PLACE} & top.camera.model_fields_set,
            detector=detector,
            error_factor=top.detector.error_factor,
            wanted=top.wanted.angles,
            wanted_sd_deg=top.wanted.sd_deg,
        )

    @property
    def further_sensors(self) -> tuple[str, ...]:
        """Places where one more sensor could go."""
        possible = self.possible_sensors
        every = tuple(SkeletonModel.default().sensors) if possible is None else possible
        return tuple(name for name in every if name not in self.sensors)

    @property
    def further_cameras(self) -> tuple[CameraPlace, ...]:
        """Places that the camera could have, its own among them."""
        possible = self.possible_cameras
        if possible is None:
            possible = tuple(replace(self.camera, angle_deg=angle) for angle in range(-135, 181, 45))
        return possible if self.camera in possible else (self.camera, *possible)


class PossibleTable(InputTable):
    """Positions that the camera could have."""

    angle_deg: Row | None = None
    distance_m: Row | None = None
    height_m: Row | None = None


class CameraPlaceTable(InputTable):
    """See `CameraPlace`."""

    angle_deg: Number = CameraPlace.angle_deg
    distance_m: Number = CameraPlace.distance_m
    height_m: Number = CameraPlace.height_m
    focal_px: Number | None = None
    field_of_view_deg: Number | None = None
    """Horizontal, in place of `focal_px`."""
    width_px: Integer = CameraPlace.width_px
    height_px: Integer = CameraPlace.height_px
    rate_hz: Number = CameraPlace.rate_hz
    possible: PossibleTable = PossibleTable()

    def place(self) -> CameraPlace:
        """Return the camera."""
        focal = self.focal_px
        if focal is None and self.field_of_view_deg is not None:
            half = np.radians(np.clip(self.field_of_view_deg, *_FIELD_OF_VIEW_DEG)) / 2
            focal = float(self.width_px / 2 / np.tan(half))
        if focal is None:
            focal = CameraPlace.focal_px * self.width_px / CameraPlace.width_px
        given = self.model_dump(exclude={"possible", "field_of_view_deg", "focal_px"})
        return CameraPlace(**given, focal_px=focal)

    def places(self) -> tuple[CameraPlace, ...] | None:
        """Return the positions that it could have, None where none are named."""
        if not (names := self.possible.model_fields_set):
            return None
        rows = {n: getattr(self.possible, n).tolist() if n in names else [getattr(self, n)] for n in _PLACE[::-1]}
        return tuple(
            replace(self.place(), **dict(zip(rows, values, strict=True))) for values in product(*rows.values())
        )


class SensorsTable(InputTable):
    """Names of the skeleton's table."""

    worn: Names = ()
    possible: Names | None = None


class DetectorTable(InputTable):
    """The detector and its errors."""

    points: str = MEASURED
    error_factor: Number = 1.0


class WantedTable(InputTable):
    """The angles that matter, and the standard deviation that they need."""

    angles: Names = ()
    sd_deg: Number | None = None


class ProtocolTable(InputTable):
    """The file."""

    movement: str
    repetitions: Integer | None = None
    height_m: Number | None = None
    camera: CameraPlaceTable = CameraPlaceTable()
    sensors: SensorsTable = SensorsTable()
    detector: DetectorTable = DetectorTable()
    wanted: WantedTable = WantedTable()


def place_of(camera: Camera, poses: PoseSequence, rate_hz: float) -> CameraPlace:
    """Return where a camera of a frame rate stands relative to a movement."""
    distance, height, angle_deg = stand_of(camera, poses)
    return CameraPlace(
        angle_deg=round(angle_deg, 1),
        distance_m=round(distance, 2),
        height_m=round(height, 2),
        focal_px=float(np.trace(camera.K[:2, :2]) / 2),
        width_px=camera.width_px,
        height_px=camera.height_px,
        rate_hz=rate_hz,
    )


def direction(angle_deg: float) -> str:
    """Return a camera's direction in words; for the angle see the module."""
    angle = (angle_deg + 180) % 360 - 180
    side = "left" if angle > 0 else "right"
    places = {
        0: "in front of",
        45: f"in front to the {side} of",
        90: f"to the {side} of",
        135: f"behind to the {side} of",
        180: "behind",
    }
    nearest = min(places, key=lambda place: abs(place - abs(angle)))
    return f"{places[nearest]} the person ({180 if angle == -180 else round(angle, 1):g} deg)"

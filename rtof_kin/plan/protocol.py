"""`Protocol`: what is to be recorded, with which camera and sensors; read from a TOML file.

docs/plan.md describes the file. A direction of a camera is its place as seen from above, in degrees: 0 before
the person as the movement begins, 90 to the person's left, 180 behind.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final, Self

import numpy as np

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.clinical.angle_table import angle_table
from rtof_kin.core.checks import indices_of
from rtof_kin.core.errors import InvalidInputError, UnknownNameError
from rtof_kin.core.files.section import Section
from rtof_kin.data.camera import Camera
from rtof_kin.data.poses import PoseSequence
from rtof_kin.plan.placing import centre_of, facing_of, stand_of

DETECTORS: Final = ("mediapipe33", "coco17")
"""Layouts of detectors that can be simulated: the measured one, and its points that COCO has too."""
_PLAUSIBLE: Final = {
    "distance_m": (0.8, 30.0),
    "height_m": (0.1, 6.0),
    "angle_deg": (-360.0, 360.0),
    "width_px": (160, 16000),
    "height_px": (120, 16000),
    "rate_hz": (10, 400),
}
_FIELD_OF_VIEW_DEG: Final = (10.0, 150.0)


@dataclass(frozen=True)
class CameraPlace:
    """Where a level camera stands, and its lens; it is aimed at the middle of the movement."""

    angle_deg: float = 45.0
    """[deg] see the module."""
    distance_m: float = 4.0
    """[m] horizontal, from the middle of the pelvis' path."""
    height_m: float = 1.2
    """[m] over the floor."""
    focal_px: float = 1400.0
    """[px] focal length."""
    width_px: int = 1920
    height_px: int = 1080
    rate_hz: float = 60.0
    """[Hz] frames per second."""

    def __post_init__(self) -> None:
        for name, (low, high) in _PLAUSIBLE.items():
            if not low <= (value := getattr(self, name)) <= high:
                raise InvalidInputError(f"camera: {name} is {value:g}; expected {low:g} to {high:g}")
        low, high = _FIELD_OF_VIEW_DEG
        if not low <= self.field_of_view_deg <= high:
            raise InvalidInputError(
                f"camera: focal_px of {self.focal_px:g} with a width of {self.width_px} px is a field of "
                f"view of {self.field_of_view_deg:.0f} deg; expected {low:g} to {high:g}. The focal length "
                "is in pixels, not mm"
            )

    @property
    def field_of_view_deg(self) -> float:
        """Horizontal field of view, deg."""
        return float(np.degrees(2 * np.arctan2(self.width_px / 2, self.focal_px)))

    def camera(self, poses: PoseSequence) -> Camera:
        """Return the camera.

        Args:
            poses: the movement, world z up, floor at 0.
        """
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

    movement: str
    """Name in the library, or folder of a motion."""
    repetitions: int | None = None
    """Of the movement; None for the usual number."""
    height_m: float | None = None
    """[m] standing height of the person; None for the skeleton's."""
    camera: CameraPlace = field(default_factory=CameraPlace)
    sensors: tuple[str, ...] = ()
    """Worn, names of the skeleton's table."""
    possible_sensors: tuple[str, ...] | None = None
    """Where one more could go; None: everywhere else."""
    possible_cameras: tuple[CameraPlace, ...] | None = None
    """Places that the camera could have; None: eight directions at its distance and height."""
    any_camera: bool = False
    """Whether nothing is said about the camera's place, so that the best of the possible ones is planned."""
    detector: str = DETECTORS[0]
    error_factor: float = 1.0
    """[1] on the errors of the measured detector in the image."""
    wanted: tuple[str, ...] = ()
    """Clinical angles that matter; () for all."""
    wanted_sd_deg: float | None = None
    """[deg] standard deviation that they need."""

    def __post_init__(self) -> None:
        skeleton = SkeletonModel.default()
        for name in ("sensors", "possible_sensors"):
            indices_of(f"sensor of {name}", getattr(self, name) or (), tuple(skeleton.sensors))
        indices_of("angle", self.wanted, [row.name for row in angle_table(skeleton.table).rows])
        if self.detector not in DETECTORS:
            raise UnknownNameError("detector", [self.detector], DETECTORS)
        if self.height_m is not None and not 0.8 <= self.height_m <= 2.3:
            raise InvalidInputError(f"protocol: a height_m of {self.height_m:g} is not plausible")
        if self.repetitions is not None and not 1 <= self.repetitions <= 50:
            raise InvalidInputError(f"protocol: {self.repetitions} repetitions; expected 1 to 50")
        if not 0.1 <= self.error_factor <= 10:
            raise InvalidInputError(f"protocol: an error_factor of {self.error_factor:g}; expected 0.1 to 10")

    @classmethod
    def read(cls, path: str | Path) -> Self:
        """Read a protocol's TOML file.

        Args:
            path: of the file; the folder of a motion is relative to it.

        Raises:
            FileFormatError: a field is missing, unknown, or of another type.
            InvalidInputError: a value is not plausible. UnknownNameError: no such sensor or angle.
        """
        path = Path(path)
        top = Section.of_file(path)
        movement = top.text("movement")
        if (path.parent / movement).is_dir():
            movement = str(path.parent / movement)
        seen, worn, detector, wanted = (top.table(name) for name in ("camera", "sensors", "detector", "wanted"))
        camera, possible = _camera(seen)
        own = cls(
            movement,
            repetitions=top.integer("repetitions") if top.has("repetitions") else None,
            height_m=top.optional_number("height_m"),
            camera=camera,
            sensors=worn.optional_names("worn") or (),
            possible_sensors=worn.optional_names("possible"),
            possible_cameras=possible,
            any_camera=not {"angle_deg", "distance_m", "height_m"} & {*seen.data},
            detector=detector.text("points", DETECTORS[0]),
            error_factor=detector.number("error_factor", 1.0),
            wanted=wanted.optional_names("angles") or (),
            wanted_sd_deg=wanted.optional_number("sd_deg"),
        )
        for section in (worn, detector, wanted, top):
            section.close()
        return own

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


def _camera(section: Section) -> tuple[CameraPlace, tuple[CameraPlace, ...] | None]:
    """The camera, and the places that it could have."""
    own = CameraPlace()
    width = section.integer("width_px", own.width_px)
    usual = own.focal_px * width / own.width_px
    if section.has("field_of_view_deg"):
        half = np.radians(np.clip(section.number("field_of_view_deg"), *_FIELD_OF_VIEW_DEG)) / 2
        usual = float(width / 2 / np.tan(half))
    camera = CameraPlace(
        angle_deg=section.number("angle_deg", own.angle_deg),
        distance_m=section.number("distance_m", own.distance_m),
        height_m=section.number("height_m", own.height_m),
        focal_px=section.number("focal_px", usual),
        width_px=width,
        height_px=section.integer("height_px", own.height_px),
        rate_hz=section.number("rate_hz", own.rate_hz),
    )
    possible = section.table("possible")
    ranges = {
        name: possible.numbers(name) if possible.has(name) else [getattr(camera, name)]
        for name in ("angle_deg", "distance_m", "height_m")
    }
    found = None
    if len(possible):
        found = tuple(
            replace(camera, angle_deg=float(a), distance_m=float(d), height_m=float(h))
            for h in ranges["height_m"]
            for d in ranges["distance_m"]
            for a in ranges["angle_deg"]
        )
    possible.close()
    section.close()
    return camera, found


def place_of(camera: Camera, poses: PoseSequence, rate_hz: float) -> CameraPlace:
    """Return where a camera stands relative to a movement.

    Args:
        rate_hz: frames per second.
    """
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
    """Return a camera's direction in words.

    Args:
        angle_deg: see the module.
    """
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
    return f"{places[nearest]} the person ({180 if angle == -180 else angle:g} deg)"

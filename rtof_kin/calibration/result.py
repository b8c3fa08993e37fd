"""What a recording said about itself: every quantity with its standard deviation, and a verdict.

`calibrate` estimates it. `SelfCalibration.apply` gives the recording with what was observed put right;
what was not observed stays as it was given.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import Self

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.checks import indices_of, readonly
from rtof_kin.core.errors import CalibrationError, ShapeError, UnknownNameError
from rtof_kin.data.camera import Camera
from rtof_kin.data.imu import ImuSequence
from rtof_kin.data.imu_calibration import ImuCalibration
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.recording.recording import Recording

Array = NDArray[np.float64]
_OBSERVED, _WEAKLY = 0.9, 0.5
"""Share of the prior's variance that the recording takes away, from which on something is observed, and
weakly observed."""
_DEGREES = (float(np.degrees(1.0)), "deg")
_UNITS = {
    "delay": (1e3, "ms"), "heading": _DEGREES, "mounting": _DEGREES, "lever arm": (1e3, "mm"),
    "bones": (100.0, "%"), "image bias": (1.0, "px"), "place": (1e3, "mm"),
    "focal length": (100.0, "%"), "camera tilt": _DEGREES, "ankle height": (1e3, "mm"),
}  # fmt: skip
"""Kind -> factor and unit of what people read; of what drifts, the constant's."""
_DRIFTING = ("delay", "heading")
BONE_GROUPS = {
    "trunk": ("Spine", "Spine1", "Spine2", "Spine3", "LeftShoulder", "RightShoulder"),
    "head": ("Neck", "Head"),
    "shoulders": ("LeftArm", "RightArm"),
    "upper arms": ("LeftForeArm", "RightForeArm"),
    "forearms": ("LeftHand", "RightHand"),
    "pelvis": ("LeftUpLeg", "RightUpLeg"),
    "thighs": ("LeftLeg", "RightLeg"),
    "shanks": ("LeftFoot", "RightFoot"),
}
"""Joints at the ends of the bones that are estimated together."""


class Verdict(Enum):
    """How well the recording knew something."""

    OBSERVED = "observed"
    DOUBTFUL = "in doubt"
    WEAKLY = "weakly observed"
    PRIOR = "taken from the prior"


@dataclass(frozen=True)
class Quantity:
    """One thing that was estimated."""

    kind: str
    """As `calibration.unknowns` names it."""
    item: str
    """Whose: a segment with a sensor, a landmark, a group of bones, 'video', 'camera' or 'feet'."""
    value: Array
    """(w,) in SI units or px; zero where nothing was wrong."""
    sigma: Array
    """(w,) standard deviations."""
    sigma_prior: Array
    """(w,) before."""
    known: float
    """Share of the prior's variance that the recording took away, of the number it knows best; errors
    that last are not allowed for, as they are in `sigma`."""
    doubt: str = ""
    """Why the value may be wrong whatever its standard deviation says; empty where nothing says so."""

    def __post_init__(self) -> None:
        if self.kind not in _UNITS:
            raise UnknownNameError("kind of quantity", [self.kind], tuple(_UNITS))
        for name in ("value", "sigma", "sigma_prior"):
            given = readonly(f"{self.kind} of {self.item}, {name}", getattr(self, name), ("w",))
            if len(given) != len(self.value) or not np.isfinite(given).all():
                raise ShapeError(f"{self.kind} of {self.item}: {name} must be finite, as many as values")
            object.__setattr__(self, name, given)
        if not ((self.sigma > 0) & (self.sigma_prior > 0)).all():
            raise ShapeError(f"{self.kind} of {self.item}: standard deviations must be positive")
        if not 0 <= self.known <= 1:
            raise ShapeError(f"{self.kind} of {self.item}: known is {self.known}, no share of 1")

    @property
    def verdict(self) -> Verdict:
        """How well it was observed."""
        if self.doubt:
            return Verdict.DOUBTFUL
        if self.known >= _OBSERVED:
            return Verdict.OBSERVED
        return Verdict.WEAKLY if self.known >= _WEAKLY else Verdict.PRIOR


@dataclass(frozen=True)
class Detector:
    """What is left of one landmark's reprojection errors."""

    landmark: str
    sigma_px: float
    """Size per axis."""
    memory: float
    """[s] for which an error lasts."""


@dataclass(frozen=True)
class SelfCalibration:
    """What a recording said about itself."""

    quantities: tuple[Quantity, ...]
    detector: tuple[Detector, ...] = ()
    middle: float = 0.0
    """[s] Stamp at which what drifts has its value."""
    converged: bool = True

    def __getitem__(self, kind_item: tuple[str, str]) -> Quantity:
        """One quantity by its kind and item.

        Raises:
            CalibrationError: it was not estimated.
        """
        for quantity in self.quantities:
            if (quantity.kind, quantity.item) == kind_item:
                return quantity
        raise CalibrationError(f"{' of '.join(kind_item)} was not estimated")

    def of_kind(self, kind: str) -> dict[str, Array]:
        """Item -> value of what was observed of one kind."""
        return {
            q.item: q.value.copy() for q in self.quantities  # SciPy's rotations take no read-only arrays
            if q.kind == kind and q.verdict is not Verdict.PRIOR
        }  # fmt: skip

    @property
    def ankle_height(self) -> float:
        """[m] by which ankles stand higher over the floor than they are held to, observed or not: the
        bones were found with it.
        """
        return float(sum(q.value[0] for q in self.quantities if q.kind == "ankle height"))

    def for_another_recording(self) -> Self:
        """What is true of the person and the detector in other recordings too: bones, ankles and places
        of landmarks, and the detector's errors. Sensors are mounted anew, clocks are started anew.
        """
        kept = tuple(q for q in self.quantities if q.kind in ("bones", "ankle height", "place"))
        return replace(self, quantities=kept)

    def followed_by(self, later: Self) -> Self:
        """This and what a recording said that this had been applied to; of what both have, the later."""
        again = {(q.kind, q.item) for q in later.quantities}
        kept = tuple(q for q in self.quantities if (q.kind, q.item) not in again)
        return replace(later, quantities=(*kept, *later.quantities))

    def apply(self, recording: Recording) -> Recording:
        """The recording with what was observed put right; keypoints get the times of what they show."""
        keypoints = recording.keypoints
        if keypoints is not None:
            keypoints = self._keypoints(keypoints)
        imus, calibration = recording.imus, recording.calibration
        if imus is not None and calibration is not None:
            imus = self._imus(imus, calibration)
            calibration = self._calibration(calibration)
        recording = replace(recording, keypoints=keypoints, imus=imus, calibration=calibration)
        if bones := self.of_kind("bones"):
            offsets = self._offsets(recording.skeleton, bones)
            recording = replace(recording, joint_offsets=offsets, bone_lengths=None)
        return recording

    def moved(self, keypoints: KeypointSequence, poses: PoseSequence) -> KeypointSequence:
        """Keypoints where the skeleton's landmarks are, by the places that the detector sees instead.

        Args:
            keypoints, poses: at the same times.
        """
        places = {n: v for n, v in self.of_kind("place").items() if n in keypoints.names}
        if not places:
            return keypoints
        skeleton = SkeletonModel.default()
        slopes = image_slopes(keypoints.camera, skeleton, poses, tuple(places))
        shift = np.einsum("tlij,lj->tli", slopes, np.array(list(places.values())))
        uv = keypoints.uv_px.copy()
        uv[:, [keypoints.names.index(name) for name in places]] -= shift
        return replace(keypoints, uv_px=uv)

    def table(self) -> list[tuple[str, str, str, str, str, str]]:
        """Kind, item, size of the value, its standard deviation, that of the prior (each per axis, root
        mean square), with units that people read, and the verdict.
        """
        rows = []
        for q in self.quantities:
            factor, unit = _UNITS[q.kind]
            own = slice(1) if q.kind in _DRIFTING else slice(None)
            size = q.value[0] if len(q.value[own]) == 1 else _rms(q.value)
            sizes = size, _rms(q.sigma[own]), _rms(q.sigma_prior[own])
            value, sigma, prior = (f"{factor * size:.3g}" for size in sizes)
            rows.append((q.kind, q.item, f"{value} {unit}", sigma, prior, q.verdict.value))
        return rows

    # --- parts -----------------------------------------------------------------------------------

    def _keypoints(self, keypoints: KeypointSequence) -> KeypointSequence:
        uv = keypoints.uv_px.copy()
        for name, bias in self.of_kind("image bias").items():
            if name in keypoints.names:
                uv[:, keypoints.names.index(name)] -= bias
        times = keypoints.times
        for delay in self.of_kind("delay").values():
            times = times - np.polyval(delay[::-1], times - self.middle)
        camera = self._camera(keypoints.camera)
        return replace(keypoints, uv_px=uv, times=times, camera=camera)

    def _camera(self, camera: Camera) -> Camera:
        for longer in self.of_kind("focal length").values():
            K = camera.K.copy()
            K[:2, :2] *= 1 + longer[0]
            camera = replace(camera, K=K)
        for tilt in self.of_kind("camera tilt").values():
            turn = so3.exp(tilt)
            R, t = turn @ camera.R_camera_world, turn @ camera.t_camera_world
            camera = replace(camera, R_camera_world=R, t_camera_world=t)
        return camera

    def _calibration(self, given: ImuCalibration) -> ImuCalibration:
        R_world_inertial, R_sensor_bone = given.R_world_inertial.copy(), given.R_sensor_bone.copy()
        levers = given.p_bone_sensor.copy()
        index = {joint: s for s, joint in enumerate(given.joints)}
        for joint, heading in self.of_kind("heading").items():
            s = index[joint]
            R_world_inertial[s] = so3.about_axis("z", heading[0]) @ R_world_inertial[s]
        for joint, turn in self.of_kind("mounting").items():
            R_sensor_bone[index[joint]] = R_sensor_bone[index[joint]] @ so3.exp(turn)
        for joint, more in self.of_kind("lever arm").items():
            levers[index[joint]] += more
        return replace(
            given, R_world_inertial=R_world_inertial, R_sensor_bone=R_sensor_bone, p_bone_sensor=levers
        )

    def _imus(self, imus: ImuSequence, calibration: ImuCalibration) -> ImuSequence:
        """Without what headings drifted."""
        R = imus.R_inertial_sensor.copy()
        for joint, heading in self.of_kind("heading").items():
            if len(heading) < 2:
                continue
            own = calibration.joints.index(joint)
            s = imus.names.index(calibration.sensors[own])
            turn = so3.about_axis("z", heading[1] * (imus.times - self.middle))
            R_world_inertial = calibration.R_world_inertial[own]
            R[:, s] = R_world_inertial.T @ turn @ R_world_inertial @ R[:, s]
        return replace(imus, R_inertial_sensor=R)

    def _offsets(self, skeleton: SkeletonModel, bones: dict[str, Array]) -> Array:
        offsets = skeleton.joint_offsets.copy()
        for name, joints in bone_groups(skeleton, tuple(bones)):
            offsets[list(joints)] *= 1 + bones[name][0]
        return offsets


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def image_slopes(camera: Camera, skeleton: SkeletonModel, poses: PoseSequence, names: Sequence[str]) -> Array:
    """(T, L, 2, 3) px per m by which landmarks move in the image as they move in their segments."""
    camera = camera.undistorted()
    on = [skeleton.landmarks[name] for name in names]
    own = list(skeleton.index(*[joint for joint, _ in on]))
    R, p = poses.R_world_bone[:, own], poses.p_world_joint[:, own]
    p = p + np.einsum("tlij,lj->tli", R, np.array([place for _, place in on]))
    xyz = camera.to_camera(p) @ camera.K.T
    uv, depth = xyz[..., :2] / xyz[..., 2:], xyz[..., 2]
    by_world = camera.K @ camera.R_camera_world
    J = (by_world[:2] - uv[..., None] * by_world[2]) / depth[..., None, None]
    return np.asarray(J @ R)


def bone_groups(skeleton: SkeletonModel, names: Sequence[str]) -> tuple[tuple[str, tuple[int, ...]], ...]:
    """Name, and joints at the ends of the bones, of groups of `BONE_GROUPS`; 'all' are all bones."""
    known = {n: tuple(j for j in joints if j in skeleton.names) for n, joints in BONE_GROUPS.items()}
    known["all"] = tuple(skeleton.names[1:])
    indices_of("group of bones", names, tuple(known))
    return tuple((name, tuple(skeleton.index(*known[name]))) for name in names)

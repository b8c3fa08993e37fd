"""Result of a self-calibration: every quantity with its standard deviation and a verdict.

`SelfCalibration.apply` corrects a recording by the observed quantities.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path
from typing import Any, Final, Literal, Self

import numpy as np
import tomli_w

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.calibration.camera_unknowns import refocused, turned
from rtof_kin.core import quaternions as quat
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import indices_of, readonly
from rtof_kin.core.errors import CalibrationError, FileFormatError, InvalidInputError, UnknownNameError
from rtof_kin.core.files.input_table import InputTable, Integer, Number, Row
from rtof_kin.core.files.text import load_toml, write_text
from rtof_kin.data.camera import Camera
from rtof_kin.data.imu import ImuCalibration, ImuSequence
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.recording.recording import Recording
from rtof_kin.vision.image_points import image_points

_OBSERVED: Final = 0.9
_WEAKLY = 0.5  # Least relative reductions of the prior's variance of observed and weakly observed quantities
_DEGREES: Final = (float(np.degrees(1.0)), "deg")
_UNITS: Final = {
    "delay": (1e3, "ms"),
    "heading": _DEGREES,
    "mounting": _DEGREES,
    "lever arm": (1e3, "mm"),
    "bones": (100.0, "%"),
    "image bias": (1.0, "px"),
    "place": (1e3, "mm"),
    "focal length": (100.0, "%"),
    "camera tilt": _DEGREES,
    "ankle height": (1e3, "mm"),
    "posture": _DEGREES,
}
"""Kind -> factor and unit for display; of drifting kinds, those of the constant."""
_DETECTOR: Final = (0.0, 0.05)
_USUAL_DETECTOR, SIGMA_DETECTOR = 0.028, 0.014
"""[s] Range, mean and standard deviation of detectors' delays: up to 3 frames at 60 Hz."""
_DRIFTING: Final = ("delay", "heading")
BONE_GROUPS: Final = {
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


PLACE_ERROR: Final = 0.025
"""[m] Standard deviation of the constant distance between a joint and where a detector sees it; 20 to 30 mm
were measured at the knees of people on a treadmill."""


class Verdict(Enum):
    """How well a quantity was observed."""

    OBSERVED = "observed"
    DOUBTFUL = "in doubt"
    WEAKLY = "weakly observed"
    PRIOR = "taken from the prior"


@dataclass(frozen=True)
class Quantity:
    """An estimated quantity."""

    kind: str  #: Name in `calibration.unknowns`
    item: str  #: A segment with a sensor, a landmark, a group of bones, 'video', 'camera' or 'feet'
    value: Array  #: (w,) in SI units or px; zero without an error
    sigma: Array  #: (w,) standard deviations
    sigma_prior: Array  #: (w,) standard deviations of the prior
    known: float  #: Largest relative reduction of the prior's variance, without allowance for autocorrelated errors
    doubt: str = ""  #: Reason why the value may be wrong regardless of its standard deviation; empty for none

    def __post_init__(self) -> None:
        if self.kind not in _UNITS:
            raise UnknownNameError("kind of quantity", [self.kind], tuple(_UNITS))
        whose = f"{self.kind} of {self.item}"
        for name in ("value", "sigma", "sigma_prior"):
            given = readonly(f"{whose}, {name}", getattr(self, name), ("w",))
            if len(given) != len(self.value) or not np.isfinite(given).all():
                raise InvalidInputError(f"{whose}: {name} must be finite, as many as values")
            object.__setattr__(self, name, given)
        if not ((self.sigma > 0) & (self.sigma_prior > 0)).all():
            raise InvalidInputError(f"{whose}: standard deviations must be positive")
        if not 0 <= self.known <= 1:
            raise InvalidInputError(f"{whose}: known is {self.known}, no share of 1")

    @property
    def verdict(self) -> Verdict:
        """Verdict by `known` and `doubt`."""
        if self.doubt:
            return Verdict.DOUBTFUL
        if self.known >= _OBSERVED:
            return Verdict.OBSERVED
        return Verdict.WEAKLY if self.known >= _WEAKLY else Verdict.PRIOR


@dataclass(frozen=True)
class Detector:
    """Remaining reprojection errors of a landmark."""

    landmark: str
    sigma_px: float  # Standard deviation per axis
    memory: float  # [s] Correlation time


@dataclass(frozen=True)
class SelfCalibration:
    """Estimated quantities of a recording, and the detector's remaining errors."""

    quantities: tuple[Quantity, ...]
    detector: tuple[Detector, ...] = ()
    middle: float = 0.0  #: [s] Time stamp of the constants of drifting quantities
    converged: bool = True

    def __getitem__(self, kind_item: tuple[str, str]) -> Quantity:
        """Return a quantity by its kind and item; CalibrationError where it was not estimated."""
        for quantity in self.quantities:
            if (quantity.kind, quantity.item) == kind_item:
                return quantity
        raise CalibrationError(f"{' of '.join(kind_item)} was not estimated")

    def of_kind(self, kind: str) -> dict[str, Array]:
        """Return the quantities of a kind that are observed and not in doubt: item -> value."""
        return {
            q.item: q.value.copy()
            for q in self.quantities  # SciPy's rotations need writable arrays
            if q.kind == kind and q.verdict not in (Verdict.PRIOR, Verdict.DOUBTFUL)
        }

    @property
    def ankle_height(self) -> float:
        """[m] Correction of the ankles' height, observed or not: the bones were estimated with it."""
        return float(sum(q.value[0] for q in self.quantities if q.kind == "ankle height"))

    def for_another_recording(self) -> Self:
        """Return what holds in other recordings of the person: bones, ankles, places, and the detector."""
        kept = tuple(q for q in self.quantities if q.kind in ("bones", "ankle height", "place"))
        return replace(self, quantities=kept)

    def followed_by(self, later: Self) -> Self:
        """Return this combined with a later calibration of the corrected recording, which takes precedence."""
        again = {(q.kind, q.item) for q in later.quantities}
        kept = tuple(q for q in self.quantities if (q.kind, q.item) not in again)
        return replace(later, quantities=(*kept, *later.quantities))

    def after(self, clocks: Self) -> Self:
        """Return this, estimated on a recording with corrected clocks, for the recording as it was."""
        (delay,) = clocks.quantities
        value, sigma = delay.value.copy(), delay.sigma.copy()
        value[0] += value[1:].sum() * (self.middle - clocks.middle)
        for own in self.quantities:
            if own.kind == "delay" and own.verdict not in (Verdict.PRIOR, Verdict.DOUBTFUL):
                value[0], sigma[0] = value[0] + own.value[0], own.sigma[0]
        delay = replace(delay, value=value, sigma=sigma)
        return self.followed_by(replace(self, quantities=(delay,)))

    def apply(self, recording: Recording) -> Recording:
        """Return the recording corrected by the observed quantities."""
        keypoints = recording.keypoints
        if keypoints is not None:
            keypoints = self._keypoints(keypoints)
        views = tuple(self._view(view, recording.video.camera) for view in recording.views)
        imus, calibration = recording.imus, recording.calibration
        if imus is not None:
            imus = imus if calibration is None else self._imus(imus, calibration)
            imus = self._on_clock(imus)
            calibration = None if calibration is None else self._calibration(calibration)
        recording = replace(recording, keypoints=keypoints, views=views, imus=imus, calibration=calibration)
        if turns := self.of_kind("posture"):
            recording = _with_posture(recording, turns)
        if bones := self.of_kind("bones"):
            offsets = self._offsets(recording.skeleton, bones)
            recording = replace(recording, joint_offsets=offsets, bone_lengths=None)
        return recording

    def place_variances(self, skeleton: SkeletonModel) -> dict[str, float]:
        """Return the variance, rad^2, that the detector's place errors add to each estimated mounting, by
        segment: no more than the mounting was uncertain before.
        """
        return {
            q.item: min(place_swing(skeleton, q.item), float(q.sigma_prior.max())) ** 2
            for q in self.quantities
            if q.kind == "mounting" and q.verdict is not Verdict.PRIOR
        }

    def moved(self, keypoints: KeypointSequence, poses: PoseSequence) -> KeypointSequence:
        """Return keypoints corrected by the places of the detector's landmarks."""
        places = {n: v for n, v in self.of_kind("place").items() if n in keypoints.names}
        if not places:
            return keypoints
        points = image_points(SkeletonModel.default(), tuple(places))
        slopes = points.slopes(keypoints.camera, poses.p_world_joint, poses.R_world_bone)
        shift = np.einsum("tlij,lj->tli", slopes, np.array(list(places.values())))
        uv = keypoints.uv_px.copy()
        uv[:, [keypoints.names.index(name) for name in places]] -= shift
        return replace(keypoints, uv_px=uv)

    def table(self) -> list[tuple[str, str, str, str, str, str]]:
        """Return rows of kind, item, value, its standard deviation, that of the prior (root mean square of
        the axes) and verdict, for display.
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

    def _keypoints(self, keypoints: KeypointSequence) -> KeypointSequence:
        uv = keypoints.uv_px.copy()
        for name, bias in self.of_kind("image bias").items():
            if name in keypoints.names:
                uv[:, keypoints.names.index(name)] -= bias
        camera = self._camera(keypoints.camera)
        return replace(keypoints, uv_px=uv, camera=camera).on_clock(self.on_clock(keypoints.times))

    def _view(self, view: KeypointSequence, first: Camera) -> KeypointSequence:
        """A further camera's keypoints; its pose relative to the first one stays."""
        camera = view.camera.carried(first, self._camera(first))
        return replace(view, camera=camera).on_clock(self.on_clock(view.times))

    @property
    def sensors_late(self) -> float:
        """[s] Part of the delay, in the middle of the recording, that is the sensors' and not the detector's.

        A detector's delay of usual size explains a delay alone; else the clocks are wrong, and the
        detector's delay is taken to be the usual one.
        """
        for q in self.quantities:
            if q.kind == "delay" and q.item in self.of_kind("delay"):
                margin = 2 * q.sigma[0]
                if not _DETECTOR[0] - margin <= q.value[0] <= _DETECTOR[1] + margin:
                    return _USUAL_DETECTOR - float(q.value[0])
        return 0.0

    def on_clock(self, times: Array) -> Array:
        """Return when what the video shows at times (T,), s, happened: the detector's delay earlier."""
        for delay in self.of_kind("delay").values():
            times = times - (delay[0] + self.sensors_late)
        return times

    def _on_clock(self, imus: ImuSequence) -> ImuSequence:
        """IMUs on the clock that `on_clock` returns."""
        for delay in self.of_kind("delay").values():
            if len(delay) > 1 or self.sensors_late:
                rate = float(np.append(delay, 0.0)[1])
                seen = self.middle + (imus.times - self.middle + delay[0]) / (1 - rate)
                return replace(imus, times=self.on_clock(seen))
        return imus

    def _camera(self, camera: Camera) -> Camera:
        for longer in self.of_kind("focal length").values():
            camera = refocused(camera, longer[0])
        for tilt in self.of_kind("camera tilt").values():
            camera = turned(camera, tilt)
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
        return replace(given, R_world_inertial=R_world_inertial, R_sensor_bone=R_sensor_bone, p_bone_sensor=levers)

    def _imus(self, imus: ImuSequence, calibration: ImuCalibration) -> ImuSequence:
        """IMUs without the drift of their headings."""
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


def _with_posture(recording: Recording, turns: dict[str, Array]) -> Recording:
    """The recording with its neutral posture, or where that is unknown its pose prior, moved."""
    known = recording.posture
    if known is None:
        return replace(recording, model_prior=recording.skeleton.table.prior.moved(turns))
    moved = [turns.get(joint, np.zeros(3)) for joint in known.joints]
    turned = quat.multiply(quat.exp(np.array(moved)), known.quat_wxyz)
    return replace(recording, posture=replace(known, quat_wxyz=turned))


def place_swing(skeleton: SkeletonModel, joint: str) -> float:
    """Return the standard deviation, rad, of a segment whose ends are both seen `PLACE_ERROR` beside the joints."""
    j = skeleton.names.index(joint)
    ends = [skeleton.joint_offsets[i] for i, parent in enumerate(skeleton.parents) if parent == j]
    length = max((float(np.linalg.norm(end)) for end in ends), default=0.2)
    return float(np.arctan(np.sqrt(2) * PLACE_ERROR / max(length, PLACE_ERROR)))


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def bone_groups(skeleton: SkeletonModel, names: Sequence[str]) -> tuple[tuple[str, tuple[int, ...]], ...]:
    """Return groups of bones, of `BONE_GROUPS` or 'all', with the joints at their ends."""
    known = {n: tuple(j for j in joints if j in skeleton.names) for n, joints in BONE_GROUPS.items()}
    known["all"] = tuple(skeleton.names[1:])
    indices_of("group of bones", names, tuple(known))
    return tuple((name, tuple(skeleton.index(*known[name]))) for name in names)


SCHEMA_VERSION = 1


class QuantityTable(InputTable):
    """A quantity: SI units or px."""

    value: Row
    sigma: Row
    sigma_prior: Row
    known: Number
    """Relative reduction of the prior's variance."""
    doubt: str = ""
    """Why the value may be wrong."""


class DetectorTable(InputTable):
    """Remaining reprojection errors of a landmark."""

    sigma_px: Number
    memory_s: Number


class CalibrationTable(InputTable):
    """The file."""

    schema_version: Literal[1]
    middle_s: Number
    """Time stamp of the constants of what drifts."""
    converged: Integer
    quantities: dict[str, dict[str, QuantityTable]]
    """By kind and item."""
    detector: dict[str, DetectorTable] = {}


def write_self_calibration_toml(path: str | Path, calibration: SelfCalibration, overwrite: bool = False) -> None:
    """Write a calibration; `read_self_calibration_toml` restores it exactly.

    ::

        schema_version = 1
        middle_s = 10.0                 # time stamp of the constants of what drifts
        converged = 1
        [quantities.mounting.LeftArm]   # kind, then item
        value = [0.01, -0.02, 0.0]      # SI units or px, as in `unknowns`
        sigma = [0.01, 0.01, 0.03]
        sigma_prior = [0.035, 0.035, 0.07]
        known = 0.4
        [detector.LeftArm]
        sigma_px = 5.1
        memory_s = 0.4

    Args:
        overwrite: whether an existing file is replaced.

    Raises:
        OutputExistsError: the file exists and overwriting was not asked for.
        RtofError: it cannot be written.
    """
    quantities: dict[str, dict[str, Any]] = {}
    for q in calibration.quantities:
        quantities.setdefault(q.kind, {})[q.item] = {
            "value": q.value.tolist(),
            "sigma": q.sigma.tolist(),
            "sigma_prior": q.sigma_prior.tolist(),
            "known": q.known,
            **({"doubt": q.doubt} if q.doubt else {}),
        }
    content = {
        "schema_version": SCHEMA_VERSION,
        "middle_s": calibration.middle,
        "converged": int(calibration.converged),
        "quantities": quantities,
        "detector": {d.landmark: {"sigma_px": d.sigma_px, "memory_s": d.memory} for d in calibration.detector},
    }
    write_text(Path(path), tomli_w.dumps(content), overwrite)


def read_self_calibration_toml(path: str | Path) -> SelfCalibration:
    """Read a calibration.

    Raises:
        FileFormatError, UnknownNameError: the message names file, field and remedy.
    """
    data = load_toml(path)
    if "quantities" not in data:
        raise FileFormatError(
            path,
            "no calibration that `rtof-kin reconstruct --calibrate-only` wrote, as it has no table [quantities]; give "
            "the file named by its -o",
        )
    if (version := data.get("schema_version", SCHEMA_VERSION)) != SCHEMA_VERSION:
        raise FileFormatError(
            path,
            f"schema_version: {version} is not {SCHEMA_VERSION}, which this version of the package "
            "reads; use the version that wrote it, or a newer one",
        )
    file = CalibrationTable.of(data, Path(path))
    try:
        return SelfCalibration(
            tuple(_quantity(one, kind, item) for kind, items in file.quantities.items() for item, one in items.items()),
            tuple(Detector(name, one.sigma_px, one.memory_s) for name, one in file.detector.items()),
            file.middle_s,
            bool(file.converged),
        )
    except InvalidInputError as error:
        raise FileFormatError(path, str(error)) from error


def _quantity(table: QuantityTable, kind: str, item: str) -> Quantity:
    for name in ("sigma", "sigma_prior"):
        if (shape := getattr(table, name).shape) != table.value.shape:
            raise table.error(name, f"expected {len(table.value)} numbers, got shape {shape}")
    return Quantity(kind, item, table.value, table.sigma, table.sigma_prior, table.known, table.doubt)

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
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import indices_of, readonly
from rtof_kin.core.errors import CalibrationError, FileFormatError, InvalidInputError, UnknownNameError, reading
from rtof_kin.core.files.input_table import InputTable, Integer, Number, Row
from rtof_kin.core.files.text import load_toml, write_text
from rtof_kin.data.imu import ImuSequence
from rtof_kin.recording.recording import Recording

_OBSERVED: Final = 0.9
_WEAKLY = 0.5  # Least relative reductions of the prior's variance of observed and weakly observed quantities
_DEGREES: Final = (float(np.degrees(1.0)), "deg")
_KINDS: Final = {
    "delay": (2, 1e3, "ms"),
    "heading": (1, *_DEGREES),
    "mounting": (3, *_DEGREES),
    "bones": (1, 100.0, "%"),
    "image bias": (2, 1.0, "px"),
    "place": (3, 1e3, "mm"),
    "ankle height": (1, 1e3, "mm"),
}
"""Kind -> largest count of its numbers, factor and unit for display; the second number of a delay is the drift of the
clocks, s/s, and not displayed."""
_DETECTOR: Final = (0.0, 0.05)
_USUAL_DETECTOR, SIGMA_DETECTOR = 0.028, 0.014
"""[s] Range, mean and standard deviation of detectors' delays: up to 3 frames at 60 Hz."""
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
    item: str  #: A segment with a sensor, a landmark, a group of bones, 'video' or 'feet'
    value: Array  #: (w,) in SI units or px; zero without an error
    sigma: Array  #: (w,) standard deviations
    sigma_prior: Array  #: (w,) standard deviations of the prior
    known: float  #: Largest relative reduction of the prior's variance, without allowance for autocorrelated errors
    doubt: str = ""  #: Reason why the value may be wrong regardless of its standard deviation; empty for none

    def __post_init__(self) -> None:
        if self.kind not in _KINDS:
            raise UnknownNameError("kind of quantity", [self.kind], tuple(_KINDS))
        whose = f"{self.kind} of {self.item}"
        for name in ("value", "sigma", "sigma_prior"):
            given = readonly(f"{whose}, {name}", getattr(self, name), ("w",))
            if not np.isfinite(given).all() or not len(self.value) == len(given) <= _KINDS[self.kind][0]:
                raise InvalidInputError(
                    f"{whose}: {name} must be finite, as many as values, {_KINDS[self.kind][0]} at most"
                )
            object.__setattr__(self, name, given)
        if not ((self.sigma > 0) & (self.sigma_prior > 0)).all():
            raise InvalidInputError(f"{whose}: standard deviations must be positive")
        if not 0 <= self.known <= 1:
            raise InvalidInputError(f"{whose}: known is {self.known}, no share of 1")

    @property
    def observed(self) -> bool:
        """Whether the value is applied: at least weakly observed, and not in doubt."""
        return self.verdict in (Verdict.OBSERVED, Verdict.WEAKLY)

    @property
    def verdict(self) -> Verdict:
        """Verdict by `known` and `doubt`."""
        if self.doubt:
            return Verdict.DOUBTFUL
        if self.known >= _OBSERVED:
            return Verdict.OBSERVED
        return Verdict.WEAKLY if self.known >= _WEAKLY else Verdict.PRIOR


@dataclass(frozen=True)
class SelfCalibration:
    """Estimated quantities of a recording."""

    quantities: tuple[Quantity, ...]
    middle: float = 0.0  #: [s] Time stamp of the constant of a delay with a drift
    converged: bool = True
    places: tuple[Quantity, ...] = ()
    """By joint, how far from their usual place the detector sees the points next to it, m, in the axes of their
    segments; of the person and the detector, neither applied nor written"""

    def __getitem__(self, kind_item: tuple[str, str]) -> Quantity:
        """Return a quantity by its kind and item; CalibrationError where it was not estimated."""
        for quantity in self.quantities:
            if (quantity.kind, quantity.item) == kind_item:
                return quantity
        raise CalibrationError(f"{' of '.join(kind_item)} was not estimated")

    def of_kind(self, kind: str) -> dict[str, Array]:
        """Return the quantities of a kind that are observed and not in doubt: item -> value."""
        return {q.item: q.value.copy() for q in self.quantities if q.kind == kind and q.observed}

    @property
    def ankle_height(self) -> float:
        """[m] Correction of the ankles' height, observed or not: the bones were estimated with it."""
        return float(sum(q.value[0] for q in self.quantities if q.kind == "ankle height"))

    def for_another_recording(self) -> Self:
        """Return what holds in other recordings of the person: bones and ankles."""
        kept = tuple(q for q in self.quantities if q.kind in ("bones", "ankle height"))
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
        if (own := self._delay) is not None:
            value[0], sigma[0] = value[0] + own.value[0], own.sigma[0]
        return self.followed_by(replace(self, quantities=(replace(delay, value=value, sigma=sigma),)))

    def apply(self, recording: Recording) -> Recording:
        """Return the recording corrected by the observed quantities."""
        keypoints, imus, known = recording.keypoints, recording.imus, recording.calibration
        if keypoints is not None:
            uv, times = keypoints.uv_px.copy(), self.on_clock(keypoints.times)
            for name, bias in self.of_kind("image bias").items():
                if name in keypoints.names:
                    uv[:, keypoints.names.index(name)] -= bias
            keypoints = replace(keypoints, uv_px=uv).on_clock(times)
        if imus is not None and known is not None:
            R_world_inertial, R_sensor_bone = known.R_world_inertial.copy(), known.R_sensor_bone.copy()
            for joint, (heading,) in self.of_kind("heading").items():
                s = known.joints.index(joint)
                R_world_inertial[s] = so3.about_axis("z", heading) @ R_world_inertial[s]
            for joint, turn in self.of_kind("mounting").items():
                s = known.joints.index(joint)
                R_sensor_bone[s] = R_sensor_bone[s] @ so3.exp(turn)
            known = replace(known, R_world_inertial=R_world_inertial, R_sensor_bone=R_sensor_bone)
        recording = replace(
            recording,
            keypoints=keypoints,
            views=tuple(view.on_clock(self.on_clock(view.times)) for view in recording.views),
            imus=None if imus is None else self._on_clock(imus),
            calibration=known,
        )
        if bones := self.of_kind("bones"):
            offsets = recording.skeleton.joint_offsets.copy()
            for name, joints in bone_groups(recording.skeleton, tuple(bones)):
                offsets[list(joints)] *= 1 + bones[name][0]
            recording = replace(recording, joint_offsets=offsets, bone_lengths=None)
        return recording

    def mounting_variances(self, skeleton: SkeletonModel) -> dict[str, float]:
        """Return the variance, rad^2, that each estimated mounting has about an axis across its bone, by segment."""
        return {
            q.item: across(skeleton, q.item, q.sigma) ** 2
            for q in self.quantities
            if q.kind == "mounting" and q.verdict is not Verdict.PRIOR
        }

    def table(self) -> list[tuple[str, str, str, str, str, str]]:
        """Return rows of kind, item, value, its standard deviation, that of the prior (root mean square of
        the axes) and verdict, for display.
        """
        rows = []
        for q in self.quantities:
            _, factor, unit = _KINDS[q.kind]
            own = slice(1 if q.kind == "delay" else None)
            size = q.value[0] if len(q.value[own]) == 1 else _rms(q.value)
            sizes = size, _rms(q.sigma[own]), _rms(q.sigma_prior[own])
            value, sigma, prior = (f"{factor * size:.3g}" for size in sizes)
            rows.append((q.kind, q.item, f"{value} {unit}", sigma, prior, q.verdict.value))
        return rows

    @property
    def _delay(self) -> Quantity | None:
        """The delay of the video, if it is observed."""
        return next((q for q in self.quantities if q.kind == "delay" and q.observed), None)

    @property
    def sensors_late(self) -> float:
        """[s] Part of the delay, in the middle of the recording, that is the sensors' and not the detector's.

        A detector's delay of usual size explains a delay alone; else the clocks are wrong, and the
        detector's delay is taken to be the usual one.
        """
        if (q := self._delay) is not None:
            margin = 2 * q.sigma[0]
            if not _DETECTOR[0] - margin <= q.value[0] <= _DETECTOR[1] + margin:
                return _USUAL_DETECTOR - float(q.value[0])
        return 0.0

    def on_clock(self, times: Array) -> Array:
        """Return when what the video shows at times (T,), s, happened: the detector's delay earlier."""
        q = self._delay
        return times if q is None else times - (q.value[0] + self.sensors_late)

    def _on_clock(self, imus: ImuSequence) -> ImuSequence:
        """IMUs on the clock that `on_clock` returns."""
        q = self._delay
        if q is None or not (len(q.value) > 1 or self.sensors_late):
            return imus
        rate = float(q.value[1:].sum())
        seen = self.middle + (imus.times - self.middle + q.value[0]) / (1 - rate)
        return replace(imus, times=self.on_clock(seen))


def across(skeleton: SkeletonModel, joint: str, sigma: Array) -> float:
    """Return the root mean square of standard deviations (3,) in a segment's axes about axes across its bone."""
    share = 1 - skeleton.bone_axis(joint) ** 2
    return float(np.sqrt(np.sum(share * sigma**2) / np.sum(share)))


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


class CalibrationTable(InputTable):
    """The file."""

    schema_version: Literal[1]
    middle_s: Number
    """Time stamp of the constants of what drifts."""
    converged: Integer
    quantities: dict[str, dict[str, QuantityTable]]
    """By kind and item."""
    detector: dict[str, Any] = {}
    """Of earlier versions: the detector's errors by landmark, which are not used."""


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

    `OutputExistsError`: the file exists and overwriting was not asked for; `RtofError`: it cannot be written.

    Args:
        overwrite: whether an existing file is replaced.
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
    }
    write_text(Path(path), tomli_w.dumps(content), overwrite)


def read_self_calibration_toml(path: str | Path) -> SelfCalibration:
    """Read a calibration; `FileFormatError` or `UnknownNameError`, which names file, field and remedy."""
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
    with reading(path, "{}", InvalidInputError, UnknownNameError):
        quantities = tuple(
            Quantity(kind, item, one.value, one.sigma, one.sigma_prior, one.known, one.doubt)
            for kind, items in file.quantities.items()
            for item, one in items.items()
        )
        return SelfCalibration(quantities, file.middle_s, bool(file.converged))

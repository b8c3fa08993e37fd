"""Checks that the image is upright, of the declared size and not mirrored, and that left is left.

Each usual mistake is a hypothesis that can be undone. Keypoints as given and with a mistake undone are
compared by the lifter's predicted uncertainty, which is larger for people upside down or with knees that
bend backwards, and by the sensors, whose segments point where they do in any image. A hypothesis that
fits much better than the keypoints as given is reported.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Final, NamedTuple, Self

import numpy as np

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.calibration.bone_images import Limbs, sensed_bones
from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import Check
from rtof_kin.core.errors import CalibrationError, InvalidInputError
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.reconstruction.lift import LifterLike
from rtof_kin.recording.recording import Recording
from rtof_kin.vision.outlier_rejection import side_pairs

Undo = Callable[[KeypointSequence], KeypointSequence]
STEP, PIECE, PIECES = 0.1, 48, 2  # [s] between the frames of an excerpt, frames of a piece, and number of pieces
LEAST_GAIN, LEAST_GAIN_SENSED = 1.1, 0.35
"""Least gain of a hypothesis to be reported, without and with sensors; correct recordings stay below
(benchmarks/results/planted.md)."""
LEAST_GAIN_OF_SIZE = 0.1  # The same for the lifter's certainty in another image size
_CERTAINTY = 3.0  # Weight of a gain in certainty relative to one in the logarithm of the sensors' misfit
_CONTRADICTED, _UNSUPPORTED = -0.1, 0.7
"""Gain in certainty below which a hypothesis is excluded whatever the sensors measure; and the gain by
sensors that a hypothesis needs about which the lifter is neutral."""
_UNSEEN, _UPRIGHT = 4.4, 6.3
"""Certainty below which keypoints are no person, and above which they are one standing upright."""
_AGREED = 0.5  # Misfit of sensors below which the image is upright; in rotated images it is above 0.8
_CLOSE = 0.5  # Hypotheses whose gains differ by less are reported together
_REPROJECTION, _LEAST_REPROJECTION, _LEAST_MISFIT = 0.3, 1e-3, 0.02
_HEADINGS = np.radians(np.arange(0, 360, 15))
_REACH = 0.55  # Fraction of the image beyond which points of an image half as large cannot lie
_SIZE, _TURN, _SIDES = "another size of the picture", "a turned picture or world", "exchanged sides"
OF_IMAGE: Final = (_SIZE, _TURN, _SIDES)
_LEGS = "left and right of the legs' keypoints are exchanged"
_SWAPPED, _MIRRORED = "left and right of the keypoints are exchanged", "the picture is mirrored"
_MIRRORED_OR_HEADING = f"{_MIRRORED}, or all sensors head the wrong way"
_SMALL = "the keypoints are of a picture 2 times smaller than the camera's"
_MIRRORED_VIDEO = "the video is mirrored, and its sides were named as they appear"


class Lifted(NamedTuple):
    """Keypoints as lifted."""

    poses: PoseSequence  # Positions; no orientations
    certainty: float  # Larger for keypoints as people have them; NaN of a lifter without uncertainties


def excerpt(keypoints: KeypointSequence) -> KeypointSequence:
    """Return at most `PIECES` pieces of `PIECE` frames, `STEP` apart."""
    every = 1
    if len(keypoints) > 1:
        every = max(1, round(STEP / float(np.median(np.diff(keypoints.times)))))
    frames = np.arange(0, len(keypoints), every)
    if len(frames) > PIECES * PIECE:
        starts = np.linspace(0, len(frames) - PIECE, PIECES).astype(int)
        frames = frames[(starts[:, None] + np.arange(PIECE)).ravel()]
    uv, confidence = keypoints.uv_px[frames], keypoints.confidence[frames]
    return keypoints.at(frames, uv, confidence)


def sensed(recording: Recording, times: Array) -> BoneImuSequence | None:
    """Return the calibrated sensors at times (T,), s; None where they have no samples."""
    try:
        found = recording.bone_imus(times=times)
    except CalibrationError:
        return None
    return found if found is not None and np.isfinite(found.R_world_bone).any() else None


def _agreement(given: float, other: float) -> float:
    """Log ratio of the sensors' misfits in the image given and in another."""
    return float(np.log((given + _LEAST_MISFIT) / (other + _LEAST_MISFIT)))


def _unknown(name: str, why: str) -> Check:
    return Check.unknown(name, "keypoints", "", why)


# --- mistakes, undone ----------------------------------------------------------------------------


def exchanged_sides(keypoints: KeypointSequence, only: str = "") -> KeypointSequence:
    """Return the keypoints with left and right names exchanged, of all or `only` one group of `side_pairs`."""
    order = np.arange(len(keypoints.names))
    for group, pairs in side_pairs(keypoints.names).items():
        if only not in ("", group):
            continue
        order[pairs.ravel()] = pairs[:, ::-1].ravel()
    uv, confidence = keypoints.uv_px[:, order], keypoints.confidence[:, order]
    return replace(keypoints, uv_px=uv, confidence=confidence)


def _moved(M: tuple[tuple[int, int], tuple[int, int]], by: tuple[int, int]) -> Undo:
    """Pixels M (2, 2) uv + by, in widths and heights of the image where M turns."""

    def undo(k: KeypointSequence) -> KeypointSequence:
        size = np.array([k.camera.width_px, k.camera.height_px])
        return replace(k, uv_px=k.uv_px @ np.array(M).T + size * by)

    return undo


mirrored = _moved(((-1, 0), (0, 1)), (1, 0))
upside_down = _moved(((-1, 0), (0, -1)), (1, 1))
exchanged_axes = _moved(((0, 1), (1, 0)), (0, 0))
_TURNED: Mapping[str, Undo] = {
    "the camera or its picture is upside down": upside_down,
    "the picture is turned by 90 degrees clockwise": _moved(((0, 1), (-1, 0)), (0, 1)),
    "the picture is turned by 90 degrees anticlockwise": _moved(((0, -1), (1, 0)), (1, 0)),
    "u and v of the keypoints are exchanged": exchanged_axes,
}


def _stood_up(keypoints: KeypointSequence) -> tuple[str, Undo] | None:
    """The axis of the declared world that points up in the picture, if not z, and how to put z there."""
    camera = keypoints.camera
    up = -camera.R_camera_world[1]
    axis = int(np.argmax(np.abs(up)))
    if axis == 2 and up[2] > 0:
        return None
    z = np.sign(up[axis]) * np.eye(3)[axis]
    x = np.eye(3)[(axis + 1) % 3]
    R_given_world = np.stack([x, np.cross(z, x), z], axis=1)
    upright = replace(camera, R_camera_world=camera.R_camera_world @ R_given_world)
    name = f"{'+' if up[axis] > 0 else '-'}{'xyz'[axis]}"
    cause = f"the camera is given in a world whose {name} points up, not z"
    return cause, lambda k: replace(k, camera=upright)


def halved(keypoints: KeypointSequence) -> KeypointSequence:
    """Return the points scaled from an image half as wide."""
    return replace(keypoints, uv_px=2 * keypoints.uv_px)


# --- what is compared ----------------------------------------------------------------------------


def certainty(keypoints: KeypointSequence, skeleton: SkeletonModel, lifter: LifterLike) -> Lifted | None:
    """Lift keypoints without sensors and floor; None where no person is visible."""
    try:
        result = lifter.predict(keypoints, skeleton.joint_offsets)
    except InvalidInputError:
        return None
    p, seen = np.asarray(result.p_world_joint), keypoints.select(skeleton.names)
    poses = PoseSequence(keypoints.times, p, np.broadcast_to(np.eye(3), (*p.shape, 3)), skeleton.names)
    off = np.linalg.norm(keypoints.camera.project(p) - seen.uv_px, axis=-1)
    spreads = [s[np.isfinite(s)] for s in (result.sigma_m, result.sigma_rad)]
    if not (np.isfinite(off).any() and all(s.size for s in spreads)):
        return Lifted(poses, np.nan)
    uv = seen.uv_px[seen.seen.any(axis=1)]
    extent = float(np.median(np.nanmax(uv, axis=1) - np.nanmin(uv, axis=1), axis=0).sum())  # width and height, px
    reprojection = float(np.nanmedian(off)) / max(extent, 1.0)
    logs = [float(np.log(s).mean()) for s in spreads]
    return Lifted(poses, -sum(logs) - _REPROJECTION * float(np.log(max(reprojection, _LEAST_REPROJECTION))))


@dataclass(frozen=True)
class ImageExcerpt:
    """An excerpt of a recording, compared with each mistake undone."""

    skeleton: SkeletonModel
    lifter: LifterLike | None  # None for one that predicts no uncertainties: image orientation remains unchecked
    keypoints: KeypointSequence
    bone_imus: BoneImuSequence | None  # The sensors at the same times

    @classmethod
    def of(cls, recording: Recording, skeleton: SkeletonModel, lifter: LifterLike | None) -> Self:
        """Return the excerpt of a recording."""
        keypoints = excerpt(recording.video)
        bone_imus = sensed(recording, keypoints.times)
        if bone_imus is not None and not sensed_bones(bone_imus, skeleton):
            bone_imus = None
        return cls(skeleton, lifter, keypoints, bone_imus)

    @cached_property
    def lifted(self) -> Lifted | None:
        """The keypoints as given, lifted; None where too little is visible."""
        return None if self.lifter is None else certainty(self.keypoints, self.skeleton, self.lifter)

    @cached_property
    def checks(self) -> tuple[Check, ...]:
        """Checks of the image's orientation, its size and its sides."""
        if self.lifted is None or np.isnan(self.lifted.certainty):
            seen = self.lifter is not None and self.lifted is None
            why = "too little of the person is visible" if seen else "the lifter predicts no uncertainties"
            return tuple(_unknown(name, why) for name in OF_IMAGE)
        checks = tuple[Check, ...]()
        for name, check in ((_TURN, self.turn), (_SIZE, self.size), (_SIDES, self.sides)):
            wrong = next((earlier.cause for earlier in checks if earlier.failed), "")
            checks += (_unknown(name, wrong) if wrong else check(),)
        return checks

    @property
    def small(self) -> str:
        """Cause of a wrong scale if points fill little of the image; else empty."""
        return _SMALL if self.reach < _REACH else ""

    @cached_property
    def _given_misfit(self) -> float:
        """The sensors' wherever north is: a wrong heading of all of them is no mistake of the picture."""
        return self._misfit(self.keypoints, _HEADINGS)

    @cached_property
    def _sides_gain(self) -> float:
        return self._gain(exchanged_sides)

    def size(self) -> Check:
        """Whether the person looks more like one twice as large, and not rather like one mirrored."""
        gain = self._gain(halved) if self.reach < _REACH else 0.0
        return Check(
            _SIZE,
            "keypoints",
            gain if gain > max(self._sides_gain, 0.0) else 0.0,
            LEAST_GAIN_OF_SIZE,
            "gain in certainty",
            f"Points reach {100 * self.reach:.0f} % of the picture; give the camera "
            "of the picture that was detected in, or scale the keypoints",
            cause=_SMALL,
        )

    @cached_property
    def reach(self) -> float:
        """How far to the right or down points lie, as a share of the picture."""
        size = [self.keypoints.camera.width_px, self.keypoints.camera.height_px]
        return float(np.max(np.nanpercentile(self.keypoints.uv_px, 99.5, axis=(0, 1)) / size))

    def turn(self) -> Check:
        """Whether the picture or the world would better be turned; not asked of who stands upright."""
        assert self.lifted is not None
        hypotheses, headings = dict(_TURNED), set[str]()
        agreed = self.bone_imus is not None and self._given_misfit < _AGREED
        if agreed or self.lifted.certainty > _UPRIGHT:
            hypotheses = {}
        elif (other := _stood_up(self.keypoints)) is not None:
            hypotheses[other[0]] = other[1]
            headings = {other[0]}
        certain = {cause: self._gain(undo) for cause, undo in hypotheses.items()}
        gains = {
            cause: self._with_sensors(certain[cause], hypotheses[cause], cause in headings) for cause in hypotheses
        }
        return self._check(
            _TURN,
            gains,
            certain,
            "Look at a frame with its points; give R_camera_world of a world with "
            "z up, for the picture as it was detected in",
        )

    def sides(self) -> Check:
        """Whether left and right would better be the other way round."""
        gain = self._sides_gain
        if self.bone_imus is None and abs(_CERTAINTY * gain) < LEAST_GAIN / 2:
            return _unknown(_SIDES, "the picture looks as likely with its sides exchanged")
        # A mirrored person is one with exchanged sides, in a mirrored room.
        undone = {_SWAPPED: exchanged_sides, _MIRRORED: mirrored}
        gains = {cause: self._with_sensors(gain, undo) for cause, undo in undone.items()}
        certain = dict.fromkeys(gains, gain)
        legs = partial(exchanged_sides, only="legs")
        name = _LEGS if self.bone_imus is None else f"{_LEGS}, or of the sensors on the legs"
        certain[name] = self._gain(legs)
        gains[name] = self._with_sensors(certain[name], legs)
        if self.bone_imus is not None:
            as_given = self._misfit(self.keypoints, _HEADINGS[:1])
            heads = _agreement(as_given, self._misfit(mirrored(self.keypoints), _HEADINGS[:1]))
            video = self._with_sensors(0.0, lambda k: exchanged_sides(mirrored(k)))
            unsure = {_MIRRORED_OR_HEADING: (gain, heads), _MIRRORED_VIDEO: (0.0, video)}
            if max(gains.values()) < self._limit:
                for cause, (sure, found) in unsure.items():
                    gains[cause], certain[cause] = found if found > _UNSUPPORTED else 0.0, sure
        advice = "Look at a frame with the names of its points, and at how the video was written"
        return self._check(_SIDES, gains, certain, advice)

    @property
    def _limit(self) -> float:
        return LEAST_GAIN if self.bone_imus is None else LEAST_GAIN_SENSED

    def _check(self, name: str, gains: Mapping[str, float], certain: Mapping[str, float], advice: str) -> Check:
        possible = {c: g for c, g in gains.items() if certain[c] > _CONTRADICTED}
        most = max(possible.values(), default=0.0)
        named = sorted((c for c, g in possible.items() if g > most - _CLOSE), key=lambda c: -gains[c])
        value = max(most, 0.0)
        return Check(name, "keypoints", value, self._limit, "gain in likelihood", advice, cause=", or ".join(named))

    def _gain(self, undo: Undo) -> float:
        assert self.lifted is not None
        assert self.lifter is not None
        other = certainty(undo(self.keypoints), self.skeleton, self.lifter)
        if other is None or not other.certainty > _UNSEEN:
            return -np.inf
        return other.certainty - self.lifted.certainty

    def _with_sensors(self, gain: float, undo: Undo, any_heading: bool = False) -> float:
        if self.bone_imus is None:
            return _CERTAINTY * gain
        other = self._misfit(undo(self.keypoints), _HEADINGS if any_heading else _HEADINGS[:1])
        return _CERTAINTY * gain + _agreement(self._given_misfit, other)

    def _misfit(self, keypoints: KeypointSequence, headings: Array) -> float:
        assert self.bone_imus is not None
        return Limbs.of(keypoints, self.bone_imus, self.skeleton).misfit(headings, keypoints.camera)

"""`CovarianceInflation`: covariances inflated for autocorrelated errors.

A Hessian assumes independent residuals. A detector's bias, a misaligned sensor, a landmark beside the
joint centre, a neutral posture or a camera that is not where it is said to be are constant for seconds or
for the whole recording: they do not average out. So every covariance C becomes

::

    K C K + B^2 + a^2 D + (m f)^2 r r^T      K = k0 + m (k - k0)      B = m d b

with diagonal matrices of a factor k and a floor b for every joint and every pair of segments, equal for right and
left. D are mean squares of the difference between solution and initial guess (`disagreement`), with one factor a for
all joints of a kind. r is the vector from the camera to a joint, of positions in world only: how far a person is away
follows from the apparent size, and is known to a share f of it. `ResidualStatistics` of the recording give the rest:

- m: autocorrelation of the keypoints' residuals, 0 (white) to 1 (a detector's). k0 stands for the errors
  of the sensors alone.
- d: the lifter's sigma of the trunk over the usual one; only without sensors there.
- the class of the observation:

=======  ==========================================================================================
camera   no sensors; for positions in world, no limb has sensors on both of its bones
fused    with sensors, but not as in the next row
sensed   both segments of a pair (the one of a pair with the world) have a sensor; for positions
         relative to the root, the root's segment has one
=======  ==========================================================================================

The numbers were fitted on recordings of other people (``python -m benchmarks confidence --fit``).

Difference between a solution and its initial guess, frame by frame, as covariances. The initial guess (SF2; without
sensors the lifter) and the solution are two estimates of the same pose. Where they differ more than usual one of them
is wrong, which the Hessian at the solution does not show. `CovarianceInflation` adds a share of the difference.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from itertools import combinations_with_replacement
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import maximum_filter1d, uniform_filter1d

from rtof_kin.body.kinematics import both_bones_sensed
from rtof_kin.body.skeleton import Motion
from rtof_kin.core import quaternions as quat
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import checked_names
from rtof_kin.core.errors import InvalidInputError, reading
from rtof_kin.core.files.text import load_toml
from rtof_kin.core.resources import model_path
from rtof_kin.data.confidence import WORLD, Confidence
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.solve.joint_space.terms import TORSO
from rtof_kin.vision.image_points import image_points, measurements

WINDOW: Final = 0.15  #: [s] averaged before and after a frame


def disagreement(solved: PoseSequence, start: PoseSequence, like: Confidence) -> Confidence:
    """Return mean squares of differences over `WINDOW`; 0 where one is missing. `like`: one of the times and pairs."""
    off = solved.p_world_joint - start.p_world_joint
    names = (*solved.names, WORLD)
    world = np.broadcast_to([1.0, 0.0, 0.0, 0.0], (len(off), 1, 4))
    q = [np.concatenate([so3.known_to_quat_wxyz(poses.R_world_bone), world], axis=1) for poses in (solved, start)]
    parents, children = np.array([[names.index(name) for name in pair] for pair in like.pairs]).T
    seen = [quat.multiply(quat.conjugate(one[:, parents]), one[:, children]) for one in q]
    turn = quat.log(quat.multiply(quat.conjugate(seen[1]), seen[0]))
    parts, reach = zip(like.rows, (off, off - off[:, :1], turn), strict=True), round(WINDOW * solved.rate_hz)
    return like.changed(**{name: _mean_square(d, reach) for name, d in parts})


def _mean_square(d: Array, reach: int) -> Array:
    """(T, n, 3, 3) mean of the outer products of vectors (T, n, 3) over frames up to `reach` away."""
    d = np.where(np.isfinite(d).all(axis=-1, keepdims=True), d, 0.0)
    i, total, mean = np.arange(len(d)), np.zeros((len(d) + 1, d.shape[1])), np.empty((*d.shape, 3))
    first, stop = np.maximum(i - reach, 0), np.minimum(i + reach + 1, len(d))
    for a, b in combinations_with_replacement(range(3), 2):
        np.cumsum(d[..., a] * d[..., b], axis=0, out=total[1:])
        mean[..., a, b] = mean[..., b, a] = (total[stop] - total[first]) / (stop - first)[:, None]
    return mean


UNITS: Final = {"position": "m", "relative": "m", "turn": "rad"}
"""Kinds of covariances of a `Confidence`, and the unit of their floors."""
SEEN: Final = {"camera": tuple(UNITS), "fused": tuple(UNITS), "sensed": ("relative", "turn")}
"""Classes of observations, and the kinds of covariances that have them."""
OTHER: Final = "other"  #: Name of the default widening
USUAL_TORSO_SIGMA: Final = 0.09  #: [rad] Usual sigma of pelvis and upper trunk by the lifter
CURVES: Final = "curve"  #: Table of the factors of whole curves in a file
SHARES: Final = "apart"  #: Table of the factors a in a file
DEPTHS: Final = "depth"  #: Table of the shares f in a file
WHITE_FACTOR: Final = 1.2  #: k0, fitted with white 2D errors and eight real sensors


@dataclass(frozen=True)
class ResidualStatistics:
    """Statistics of a recording's errors; the defaults are those of a usual one without sensors."""

    sensors: tuple[str, ...] = ()  #: Joints whose segments carry one
    autocorrelation: float = 1.0  #: m, 0 to 1: autocorrelation of the keypoints' residuals, from white to a detector's
    torso_sigma: float = USUAL_TORSO_SIGMA  #: [rad] The lifter's standard deviation of pelvis and upper trunk

    def __post_init__(self) -> None:
        object.__setattr__(self, "sensors", checked_names("residual statistics sensors", self.sensors))
        if not 0 <= self.autocorrelation <= 1:
            raise InvalidInputError(f"autocorrelation: {self.autocorrelation} is not in [0, 1]")
        if not 0 < self.torso_sigma < np.inf:
            raise InvalidInputError(f"torso_sigma: {self.torso_sigma} must be positive and finite")

    def torso_factor(self, kind: str, seen: str) -> float:
        """Return d. kind: of `UNITS`. seen: of `SEEN`."""
        return 1.0 if kind == "position" or seen == "sensed" else self.torso_sigma / USUAL_TORSO_SIGMA


@dataclass(frozen=True)
class Widening:
    """Factor and floor of one covariance."""

    factor: Array  #: k (3,) by axis: world's for positions, the child segment's for turns. At least 1.
    floor: Array  #: b (3,) standard deviation, m or rad

    def __post_init__(self) -> None:
        for name, least in (("factor", 1.0), ("floor", 0.0)):
            value = np.asarray(getattr(self, name), dtype=float)
            if value.shape not in ((), (3,)) or not np.all(np.isfinite(value) & (value >= least)):
                raise InvalidInputError(f"widening {name}: {value} must be one or three numbers, none below {least:g}")
            object.__setattr__(self, name, np.broadcast_to(value, 3))


@dataclass(frozen=True)
class CurveFactors:
    """Half widths, in standard deviations, of bands that contain the whole curve of a clinical angle.

    Split-conformal prediction over people (Vovk et al. 2005; of several recordings a person: Lee, Barber & Willett
    2023): a factor is the quantile of max |error| / sigma along a recording, each of n people with weight 1 / (n + 1).
    """

    factors: Mapping[int, Mapping[str, float]]  #: By number of sensors, and name of the angle without its side
    people: int  #: n
    level: float  #: Share of the curves that are inside throughout, 0 to 1
    made_of: str = ""

    def __post_init__(self) -> None:
        if not (0 < self.level < 1 and self.people > 0):
            raise InvalidInputError(f"curve factors: level {self.level} of {self.people} people cannot be")
        for sensors, own in self.factors.items():
            for angle, factor in own.items():
                if not 0 < factor < np.inf:
                    raise InvalidInputError(f"curve factors: {factor} of {angle} with {sensors} sensors cannot be")

    @classmethod
    def from_plain(cls, table: Mapping[str, Any]) -> Self:
        """Return those of a file's table."""
        own = {int(name): value for name, value in table.items() if name.isdecimal()}
        return cls(own, **{name: value for name, value in table.items() if not name.isdecimal()})

    def factor(self, angle: str, sensors: int) -> float | None:
        """Return the factor of an angle by its clinical name; None where too few people showed it. `sensors`: their
        number; the next smaller one that has factors counts.
        """
        known = [count for count in self.factors if count <= sensors]
        name = angle.removeprefix("right_").removeprefix("left_")
        return self.factors[max(known)].get(name) if known else None


@dataclass(frozen=True)
class CovarianceInflation:
    """Widenings of all covariances of a skeleton."""

    widenings: Mapping[str, Mapping[str, Mapping[str, Widening]]]
    """By class (`SEEN`), kind (`UNITS`) and `unsided` name of the joint, or of parent and child."""
    shares: Mapping[str, Mapping[str, float]] = field(default_factory=dict)  #: a, by class and kind; 0 where not given
    depths: Mapping[str, float] = field(default_factory=dict)  #: f, by class; 0 where not given
    curves: CurveFactors | None = None  #: Of the angles' standard deviations that follow; None if not measured

    def __post_init__(self) -> None:
        for seen, share in self.depths.items():
            if "position" not in SEEN.get(seen, ()) or not 0 <= share < np.inf:
                raise InvalidInputError(f"inflation: the share {share} of {seen}.depth cannot be")
        for seen, shares in self.shares.items():
            for kind, share in shares.items():
                if kind not in SEEN.get(seen, ()) or not 0 <= share < np.inf:
                    raise InvalidInputError(f"inflation: the share {share} of {seen}.{kind} cannot be")
        for seen, kinds in SEEN.items():
            for kind in kinds:
                if OTHER not in self.widenings.get(seen, {}).get(kind, {}):
                    raise InvalidInputError(f"inflation: no widening {OTHER!r} of {seen}.{kind}")

    @classmethod
    @cache
    def shipped(cls) -> CovarianceInflation:
        """Return that of ``models/confidence.toml``, read once."""
        return cls.read(model_path("confidence.toml"))

    @classmethod
    def read(cls, path: str | Path) -> Self:
        """Read a file such as ``models/confidence.toml``, or raise `FileFormatError`."""
        data = load_toml(Path(path))
        with reading(path, "no table of widenings: {}", KeyError, TypeError, AttributeError, ValueError):
            widenings = {
                seen: {kind: {name: Widening(**entry) for name, entry in data[seen][kind].items()} for kind in kinds}
                for seen, kinds in SEEN.items()
            }
            curves = CurveFactors.from_plain(data[CURVES]) if CURVES in data else None
            return cls(widenings, data.get(SHARES, {}), data.get(DEPTHS, {}), curves)

    def apply(
        self,
        confidence: Confidence,
        statistics: ResidualStatistics,
        apart: Confidence | None = None,
        p_camera_joint: Array | None = None,
    ) -> Confidence:
        """Return inflated covariances.

        Args:
            apart: `disagreement` of solution and initial guess; None: D = 0.
            p_camera_joint: (T, J, 3) m, joints as seen from the camera, world axes; None: f = 0.
        """
        root, m = confidence.names[0], statistics.autocorrelation

        def widened(kind: str) -> Array:
            entries = [" ".join(pair) for pair in confidence.pairs] if kind == "turn" else confidence.names
            seen = [seen_by(kind, name, root, statistics.sensors) for name in entries]
            tables = [self.widenings[who][kind] for who in seen]
            own = [table.get(unsided(name), table[OTHER]) for name, table in zip(entries, tables, strict=True)]
            factor = np.array([correlated_factor(w.factor, m) for w in own])
            torso = [statistics.torso_factor(kind, who) for who in seen]
            floor = np.array([w.floor * m * d for w, d in zip(own, torso, strict=True)])
            wide = getattr(confidence, f"{kind}_covariance") * (factor[:, :, None] * factor[:, None, :])
            wide += np.eye(3) * floor[:, :, None] ** 2
            if apart is not None:
                shares = np.array([self.shares.get(who, {}).get(kind, 0.0) for who in seen])
                wide += shares[:, None, None] ** 2 * getattr(apart, f"{kind}_covariance")
            return np.asarray(wide)

        wide = {f"{kind}_covariance": widened(kind) for kind in UNITS}
        wide["relative_covariance"][:, 0] = 0.0  # the root relative to itself
        if p_camera_joint is not None:
            depth = self.depths.get(seen_by("position", root, root, statistics.sensors), 0.0)
            wide["position_covariance"] += (
                (m * depth) ** 2 * p_camera_joint[..., :, None] * p_camera_joint[..., None, :]
            )
        return confidence.changed(**wide)


def correlated_factor(factor: ArrayLike, autocorrelation: ArrayLike) -> Array:
    """Return K. autocorrelation: m, 0 to 1."""
    k = np.asarray(factor, dtype=float)
    white = np.minimum(k, WHITE_FACTOR)
    return np.asarray(white + (k - white) * autocorrelation)


def seen_by(kind: str, name: str, root: str, sensors: Collection[str]) -> str:
    """Return the class of the observation of a covariance of a kind in `UNITS`, a key of `SEEN`."""
    if not sensors:
        return "camera"
    if kind == "position":
        return "fused" if both_bones_sensed(sensors) else "camera"
    needs = {root} if kind == "relative" else {*name.split()} - {WORLD}
    return "sensed" if needs <= {*sensors} else "fused"


def unsided(name: str) -> str:
    """Return a joint's name, or those of a pair separated by a space, without their side."""
    return " ".join(word.removeprefix("Right").removeprefix("Left") for word in name.split())


_LAG: Final = 1 / 15  #: [s] Lag of the autocorrelation
_DETECTORS_CORRELATION: Final = 0.8  #: Autocorrelation with a detector: the median of the fitted recordings
_NORMAL_MEDIAN: Final = 0.6745  #: Median of the absolute values of a standard normal distribution
_OUTLIER: Final = 3.0  #: [sigma] at which residuals are clipped
_FEWEST: Final = 100  #: Residuals that an estimate needs
_MEAN_S, _NEAR_S, _KNOWN = 2.0, 4.0, 0.2
"""[s] over which residuals of the legs are averaged, [s] before and after for which the largest average
counts, and the share of frames that an average needs."""
_USUAL_M, _USUAL_ALONE_M = 0.045, 0.1
"""[m] Misfit of the legs that right recordings of people whom nothing was fitted on hardly exceed, with
sensors on the thighs and without."""
_LEGS, _SENSED_LEGS, _REST, _TURNS = 2.5, 0.7, 0.3, 0.5
"""Errors relative to the misfit beyond the usual: of knees and feet without and with a sensor on the thigh,
of all other joints; and of turns relative to the knee's. Of six of those recordings with displaced legs."""


def residual_statistics(
    keypoints: KeypointSequence, motion: Motion, lifted: PoseSequence, sensors: Sequence[str] = ()
) -> ResidualStatistics:
    """Return the statistics of a reconstruction: its even keypoints, and lifted poses with `PoseSequence.sigma_rad`."""
    keypoints = measurements(keypoints, motion.skeleton)
    points, poses = image_points(motion.skeleton, keypoints.names), motion.poses
    at = points.positions(poses.p_world_joint, poses.R_world_bone)
    r = autocorrelation(keypoints.uv_px - keypoints.camera.project(at), keypoints.times)
    torso = lifted.sigma_rad[:, motion.skeleton.index(*TORSO)]
    sigmas = torso[np.isfinite(torso)]
    return ResidualStatistics(
        tuple(sensors),
        1.0 if r is None else float(np.clip(r / _DETECTORS_CORRELATION, 0.0, 1.0)),
        float(np.median(sigmas)) if len(sigmas) else USUAL_TORSO_SIGMA,
    )


def autocorrelation(residuals_px: Array, times: Array) -> float | None:
    """Return the autocorrelation of residuals about zero, at a fifteenth of a second; None for too few.

    Args:
        residuals_px: (T, L, 2) px, NaN where unobserved. times: (T,) s, evenly spaced.
    """
    step = max(1, round(_LAG * (len(times) - 1) / (times[-1] - times[0]))) if len(times) > 1 else 1
    size = np.nanmedian(np.abs(residuals_px)) if np.isfinite(residuals_px).any() else 0.0
    most = _OUTLIER * size / _NORMAL_MEDIAN
    cut = np.clip(residuals_px, -most, most)
    earlier, later = cut[:-step], cut[step:]
    both = np.isfinite(earlier + later)
    if both.sum() < _FEWEST or size == 0.0:
        return None
    return float(np.sum(earlier[both] * later[both]) / np.sum(later[both] ** 2))


@dataclass(frozen=True)
class LegMisfit:
    """Mean residuals of the legs' points in the image, as far as both sides agree; 0 where unseen.

    A detector that is wrong about the legs as a whole, with confidence, leaves little residual at knees and
    feet, which the motion follows; bones cannot follow everywhere, and hips are pulled off their own points.
    """

    thighs: Array  #: (T,) m, of the knees less those of the hips
    shanks: Array  #: (T,) m, of the ankles less those of the knees
    px_per_m: float  #: Size of the person in the image

    def excess(self, rate_hz: float, sensed: bool = True) -> Array:
        """Return by how much the thighs' misfit exceeds the usual (T,), m, at its largest near a frame."""
        usual = _USUAL_M if sensed else _USUAL_ALONE_M
        near = maximum_filter1d(self.thighs, 2 * round(_NEAR_S * rate_hz) + 1)
        return np.asarray(np.sqrt(np.maximum(near**2 - usual**2, 0.0)))


def leg_misfit(keypoints: KeypointSequence, motion: Motion) -> LegMisfit:
    """Return the misfit of the legs; arguments as for `residual_statistics`."""
    keypoints, poses = measurements(keypoints, motion.skeleton), motion.poses
    points, camera = image_points(motion.skeleton, keypoints.names), keypoints.camera
    at = points.positions(poses.p_world_joint, poses.R_world_bone)
    off = points.displaced(camera, poses.p_world_joint, poses.R_world_bone)
    scale = camera.to_camera(at)[..., 2:] / camera.K[0, 0]
    residuals = (keypoints.uv_px - camera.project(at) - off) * scale
    anchors, width = [motion.skeleton.names[j] for j in points.anchors], round(_MEAN_S * poses.rate_hz) | 1

    def of(joint: str) -> Array:
        """Return the mean residual (T, 2) of a joint's points, m; NaN where too few are seen."""
        at = [i for i, name in enumerate(anchors) if name == joint]
        own = residuals[:, at]
        known = np.isfinite(own) * keypoints.confidence[:, at, None]
        total, share = (
            uniform_filter1d(values, width, axis=0, mode="nearest").sum(axis=1)
            for values in (known * np.nan_to_num(own), known)
        )
        return np.where(share > _KNOWN, total / np.maximum(share, _KNOWN), np.nan)

    def shared(upper: str, lower: str) -> Array:
        left, right = (of(f"{side}{lower}") - of(f"{side}{upper}") for side in ("Left", "Right"))
        return np.asarray(np.sqrt(np.maximum(np.nan_to_num(np.sum(left * right, axis=-1)), 0.0)))

    seen = np.isfinite(scale)
    px_per_m = 1 / float(np.median(scale[seen])) if seen.any() else np.nan
    return LegMisfit(shared("UpLeg", "Leg"), shared("Leg", "Foot"), px_per_m)


def leg_spread(
    confidence: Confidence, misfit: LegMisfit, motion: Motion, sensors: Collection[str] = ()
) -> Confidence | None:
    """Return the covariances that a misfit of the legs adds, isotropic; None where it is usual."""
    excess = misfit.excess(motion.poses.rate_hz, bool({"LeftUpLeg", "RightUpLeg"} & {*sensors}))
    if not excess.any():
        return None
    skeleton = motion.skeleton

    def factor(name: str) -> float:
        if unsided(name) not in ("UpLeg", "Leg", "Foot"):
            return _REST
        return _SENSED_LEGS if name.replace(unsided(name), "UpLeg") in sensors else _LEGS

    joints = [_REST if name.endswith("UpLeg") else factor(name) for name in confidence.names]
    length = skeleton.bone_lengths
    turns = [
        max(
            (
                _TURNS * factor(name) / length[name.replace("UpLeg", "Leg")]
                for name in pair
                if name.endswith("Leg") and name not in sensors
            ),
            default=0.0,
        )
        for pair in confidence.pairs
    ]
    position, turn = ((excess[:, None] * factors)[..., None, None] ** 2 * np.eye(3) for factors in (joints, turns))
    relative = position.copy()
    relative[:, 0] = 0.0
    return confidence.changed(position_covariance=position, relative_covariance=relative, turn_covariance=turn)

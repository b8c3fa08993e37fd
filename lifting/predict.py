"""`Lifter`: landmarks of one calibrated camera, and sensors where there are any, to poses in world."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from threadpoolctl import ThreadpoolController

from lifting.checkpoint import LifterDescription, load_checkpoint
from lifting.model import FoldedNetwork
from lifting.source import Source
from lifting.windows import SIGMA_TURN, Estimate, decode, encode, orthonormal, rotations
from rtof_kin.body.kinematics import shared_frames, to_shared
from rtof_kin.body.pose_prior import PosePrior
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.core.checks import checked_times, freeze, readonly
from rtof_kin.core.errors import InvalidInputError, ViewError
from rtof_kin.core.over_time import OverTime
from rtof_kin.core.resources import DEFAULT_LIFTER, lifter_path
from rtof_kin.data.camera import Camera
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.keypoints import KeypointSequence

MIN_JOINTS = 6  #: Fewest different joints seen in a window that can be lifted
CHUNK = 16  #: Windows lifted at once: fewer cost more calls, more leave the cache


@dataclass(frozen=True)
class LiftedPoses(OverTime):
    """Poses of one person in world with standard deviations."""

    times: Array  #: (T,) s, those of the keypoints
    p_world_joint: Array  #: (T, J, 3) m, finite everywhere
    seen: Mask
    """(T,) whether the camera saw enough around the frame; other positions are interpolated between
    those that were, and constant at the ends."""
    names: tuple[str, ...]  #: J joint names
    sigma_m: Array
    """(T, J, 2) standard deviation per axis across the camera's ray and along it, m, of joints relative
    to the root and, in the root's row, of the root. NaN where not seen or not estimated."""
    R_world_bone: Array  #: (T, J, 3, 3) orientations of segments; NaN where not seen or not estimated
    sigma_rad: Array  #: (T, J) their standard deviation per axis, rad; NaN likewise
    rows = ("p_world_joint", "seen", "sigma_m", "R_world_bone", "sigma_rad")

    def __post_init__(self) -> None:
        set_ = object.__setattr__
        set_(self, "names", tuple(self.names))
        set_(self, "times", checked_times("lifted times", self.times))
        T, J = len(self.times), len(self.names)
        set_(self, "seen", readonly("lifted seen", self.seen, (T,), np.bool_))
        freeze(self, "lifted", p_world_joint=(T, J, 3), sigma_m=(T, J, 2), R_world_bone=(T, J, 3, 3), sigma_rad=(T, J))


class Lifter:
    """A trained lifter, ready to predict. Equal calls give equal answers."""

    def __init__(
        self, weights: Mapping[str, NDArray[Any]], description: LifterDescription, sha256: str = "", name: str = ""
    ) -> None:
        """Take weights, not to be changed afterwards, see `NetworkConfig.weight_shapes`; `load` reads a file."""
        self.weights, self.description = weights, description
        self.sha256, self.name = sha256, name
        self._folded: dict[bool, FoldedNetwork] = {}

    @classmethod
    def load(cls, path: str | Path | None = None) -> Lifter:
        """Read a lifter: a file, a shipped one by name (`rtof_kin.core.resources.lifter_path`), or the default one.
        `FileFormatError`: no such file, or see `load_checkpoint`.
        """
        name = DEFAULT_LIFTER if path is None else Path(path).name  # without folders, for reports
        path = lifter_path(path)
        weights, description = load_checkpoint(path)
        return cls(weights, description, hashlib.sha256(path.read_bytes()).hexdigest(), name)

    @property
    def names(self) -> tuple[str, ...]:
        """J joint names of input and output."""
        return self.description.body.names

    @property
    def prior(self) -> PosePrior | None:
        """Pose prior learned from the same motion; None where the file has none."""
        return self.description.prior

    def receptive_field(self) -> int:
        """Return the number of frames at `description.rate_hz` that one estimate depends on."""
        return self.description.network.receptive_field()

    def estimated(self) -> int:
        """Return the index of the estimated frame among these; the last one of a causal lifter."""
        return self.description.network.estimated()

    def predict(
        self,
        keypoints: KeypointSequence,
        joint_offsets: ArrayLike | None = None,
        *,
        bone_imus: BoneImuSequence | None = None,
        floor_height: float | None = None,
        flip: bool = True,
    ) -> LiftedPoses:
        """Estimate poses in world at the keypoints' times.

        Windows are resampled to the lifter's rate; before the first and after the last frame, that frame is repeated.
        `InvalidInputError`: fewer than `MIN_JOINTS` joints are ever seen; `joint_offsets` or `floor_height` are wrong.

        Args:
            keypoints: landmarks of one person, taken by joint name (others are ignored, missing ones
                count as unseen); the camera's orientation gives the vertical.
            joint_offsets: (J, 3) m, each joint in its parent's link frame, in the order of `names`; gives
                bone lengths and scale. None where unknown.
            bone_imus: calibrated sensors at any times, NaN where missing; segments without a sensor in
                the lifter's training are ignored.
            floor_height: z of a flat floor in world, m; improves the distance. None where unknown.
            flip: average with the mirrored scene: slower by half, and more accurate.
        """
        self._check_seen(keypoints)
        bones, R_bone_shared = self.bones_of(joint_offsets), self.shared_frames(joint_offsets)
        height = camera_height(keypoints.camera, floor_height)
        source = Source.of(self.description.body, keypoints, bone_imus, R_bone_shared)
        chunks = (keypoints.times[first : first + CHUNK] for first in range(0, len(keypoints), CHUNK))
        parts = [self.lift_windows(source, times, bones, height, flip) for times in chunks]
        p, sigma_m, R, sigma_rad, enough = (np.concatenate(part) for part in zip(*parts, strict=True))
        p, ok = _bridge(keypoints.times, keypoints.camera.center_world + p, enough)
        for values in (sigma_m, R, sigma_rad):
            values[~ok] = np.nan
        R_world_bone = R @ R_bone_shared.swapaxes(-1, -2)
        return LiftedPoses(keypoints.times, p, ok, self.names, sigma_m, R_world_bone, sigma_rad)

    def lift_windows(
        self, source: Source, times: Array, bones: Array, height: float, flip: bool = True
    ) -> tuple[Array, Array, Array, Array, Mask]:
        """Estimate the poses at B times, s; orientations are NaN for a body without sensors.

        Bones (3 G,), m, see `bones_of`, and the camera's height over the floor, m, may be NaN.

        Returns:
            Positions (B, J, 3) from the optical centre, m; their sigma (B, J, 2), m; orientations (B, J, 3, 3) of the
            segments' shared frames; their sigma (B, J), rad; whether enough joints were seen (B,).
        """
        body, network = self.description.body, self.description.network
        size, estimated = network.receptive_field(), network.estimated()
        if flip not in self._folded:
            self._folded[flip] = FoldedNetwork(body, network, self.weights, flip)
        with _libraries().limit(limits=1), np.errstate(all="ignore"):  # NaN where something is not known
            windows = source.windows(times, size, estimated, self.description.rate_hz, bones, height)
            encoded = encode(body, windows)
            output = self._folded[flip](encoded.features, encoded.constants)
            arrays = _arrays(decode(body, output, encoded))
        return *arrays, windows.seen.any(axis=1).sum(axis=1) >= MIN_JOINTS

    def _check_seen(self, keypoints: KeypointSequence) -> None:
        known = [name for name in self.names if name in keypoints.names]
        ever = [name for name in known if keypoints.seen[:, keypoints.names.index(name)].any()]
        if not keypoints.seen.any():
            raise InvalidInputError(
                "keypoints: no person was seen in any frame (every point is NaN or has confidence 0); "
                "check the detector's output, or use mode 'imu' where there are sensors"
            )
        if len(ever) < MIN_JOINTS:
            raise InvalidInputError(
                f"keypoints: the lifter needs at least {MIN_JOINTS} joints that are seen at some time, and sees "
                f"{len(ever)} ({', '.join(ever) or 'none'}); its joints are {', '.join(self.names)}: rename the "
                "detector's landmarks, use its adapter, or give a lifter trained for these joints"
            )

    def bones_of(self, joint_offsets: ArrayLike | None) -> Array:
        """Return a person's bones in shared frames, as the network takes them (`Body.bones_of`); NaN if None.

        The offsets (J, 3), m, are of each joint in its parent's link frame. `InvalidInputError`: not finite, or not a
        human's bone lengths.
        """
        body = self.description.body
        if joint_offsets is None:
            return np.full(len(body.nominal_bones), np.nan)
        offsets = readonly("joint_offsets", joint_offsets, (len(self.names), 3))
        length = np.linalg.norm(offsets[1:], axis=1)
        if not np.all(np.isfinite(offsets)) or np.any(length > 2) or not np.any(length > 0):
            raise InvalidInputError(
                f"joint_offsets: bone lengths from {np.min(length):.3g} to {np.max(length):.3g} m "
                "are not a human's; give metres, finite, root row zero"
            )
        shared = to_shared(self.shared_frames(offsets), body.parents, offsets)
        return np.asarray(body.bones_of(shared))

    def shared_frames(self, joint_offsets: ArrayLike | None) -> Array:
        """Return R_bone_shared (J, 3, 3), from the frames in which the network knows a person's segments to
        their link frames, see `rtof_kin.body.kinematics`; the same frames if the offsets (J, 3), m, are None.
        """
        if joint_offsets is None:
            return np.tile(np.eye(3), (len(self.names), 1, 1))
        return shared_frames(self.names, np.asarray(joint_offsets, float))


@cache
def _libraries() -> ThreadpoolController:
    """Libraries of linear algebra that are loaded; a second thread of theirs costs more than it gains on windows."""
    return ThreadpoolController()


def camera_height(camera: Camera, floor_height: float | None) -> float:
    """Return the height of the camera over a floor (z, m) in world, m; NaN where the floor is None. `ViewError`: the
    camera is below the floor.
    """
    if floor_height is None:
        return np.nan
    height = float(camera.center_world[2] - floor_height)
    if not height > 0:
        raise ViewError(f"floor_height: the camera is {-height:.2f} m below the floor; give z of the floor in world, m")
    return height


def _arrays(estimate: Estimate) -> tuple[Array, Array, Array, Array]:
    p = (estimate.pose + estimate.root[:, :, None]).swapaxes(1, 2)
    R, turn = np.full((*p.shape, 3), np.nan), np.full(p.shape[:2], np.nan)
    if estimate.axes is not None and estimate.log_turn is not None:
        R = rotations(orthonormal(estimate.axes.astype(float))).transpose(0, 3, 1, 2)
        turn = (SIGMA_TURN * np.exp(estimate.log_turn)).astype(float)
    return p.astype(float), estimate.sigma_m().astype(float), R, turn


def _bridge(times: Array, p: Array, enough: Mask) -> tuple[Array, Mask]:
    """Interpolate the positions (T, J, 3) of frames where too little was seen."""
    ok = enough & np.isfinite(p).all(axis=(1, 2))
    if not ok.any():
        raise InvalidInputError(
            f"keypoints: {MIN_JOINTS} joints are not seen in any window; the person is never visible "
            "enough to be lifted"
        )
    columns = [np.interp(times, times[ok], column) for column in p[ok].reshape(ok.sum(), -1).T]
    return np.where(ok[:, None, None], p, np.stack(columns, axis=1).reshape(p.shape)), ok

"""`Lifter`: landmarks of one calibrated camera to joints in world.

This is the boundary between the package's float64 arrays and float32 tensors.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from lifting.checkpoint import LifterDescription, load_checkpoint
from lifting.model import TemporalNetwork
from lifting.threads import torch_threads
from lifting.windows import answer, decode, encode
from rtof_kin import signals
from rtof_kin.checks import checked_times, readonly
from rtof_kin.errors import ShapeError
from rtof_kin.resources import model_path
from rtof_kin.types import KeypointSequence

Array = NDArray[np.float64]
Progress = Callable[[int, int], None]
"""Called with the frames done and their total."""

SHIPPED = "lifter.pt"
MIN_JOINTS = 6
"""Fewer different joints than this in a window, and the lifted pose means nothing."""
CHUNK = 512
"""Windows lifted at once."""
MAX_STEP = 0.15
"""Longest time between two frames that is interpolated across, s."""
LOW_PASS_HZ = 6.0
"""Cut-off of the optional filter."""


@dataclass(frozen=True)
class LiftedPoses:
    """Joint positions of one person in world, from one camera alone."""

    times: Array
    """(T,) seconds, those of the keypoints."""
    p_world_joint: Array
    """(T, J, 3) m, finite everywhere."""
    seen: NDArray[np.bool_]
    """(T,) whether the camera saw enough around the frame; elsewhere positions are interpolated
    between the frames it did see, and held at the ends."""
    names: tuple[str, ...]
    """J joint names."""

    def __post_init__(self) -> None:
        set_ = object.__setattr__
        set_(self, "names", tuple(self.names))
        set_(self, "times", checked_times("lifted times", self.times))
        T, J = len(self.times), len(self.names)
        set_(self, "p_world_joint", readonly("lifted p_world_joint", self.p_world_joint, (T, J, 3)))
        set_(self, "seen", readonly("lifted seen", self.seen, (T,), np.bool_))

    def __len__(self) -> int:
        return len(self.times)


class Lifter:
    """A trained lifter, ready to predict. Equal calls give equal answers."""

    def __init__(self, network: TemporalNetwork, description: LifterDescription, sha256: str = ""):
        """Take a network in evaluation mode and what it is; `load` reads both from a file."""
        self.description = description
        self.sha256 = sha256
        """Of the file that the lifter was read from, in hexadecimal; empty where there is none."""
        self._network = network

    @classmethod
    def load(cls, path: str | Path | None = None) -> Lifter:
        """Read a lifter from a file, or the one that ships with the package.

        Raises:
            FileFormatError: see `load_checkpoint`; or none ships.
        """
        path = model_path(SHIPPED) if path is None else Path(path)
        network, description = load_checkpoint(path)
        return cls(network, description, hashlib.sha256(path.read_bytes()).hexdigest())

    @property
    def names(self) -> tuple[str, ...]:
        """J joint names that the lifter reads and gives."""
        return self.description.body.names

    def receptive_field(self) -> int:
        """Frames at `description.rate_hz` that one estimate depends on."""
        return self._network.receptive_field()

    def predict(
        self,
        keypoints: KeypointSequence,
        joint_offsets: ArrayLike | None = None,
        progress: Progress | None = None,
        *,
        floor_height: float | None = None,
        flip: bool = True,
        smooth: bool = False,
    ) -> LiftedPoses:
        """Joint positions in world at the keypoints' own times.

        Landmarks are taken by joint name; those the lifter does not know are ignored, and joints
        without a landmark count as unseen. Windows are made at the lifter's rate by interpolating
        in time; before the first and after the last frame the nearest one stands.

        Args:
            keypoints: landmarks of one person; the camera's orientation gives the vertical.
            joint_offsets: (J, 3) m, each joint in its parent's link frame, in the order of `names`;
                tells the person's bone lengths, and with them the scale. None where unknown.
            progress: see `Progress`.
            floor_height: z of a flat floor in world, m, where it is known; helps the distance.
            flip: average with the mirrored scene: slower by half, and better.
            smooth: low-pass positions at 6 Hz without delay.

        Returns:
            Finite positions for every frame, and whether each was seen.

        Raises:
            ShapeError: fewer than `MIN_JOINTS` joints are ever seen; `joint_offsets` or
                `floor_height` are wrong.
        """
        self._check_seen(keypoints)
        bones = self._bones(joint_offsets)
        height = np.nan
        if floor_height is not None:
            height = float(keypoints.camera.center_world[2] - floor_height)
            if not height > 0:
                raise ShapeError(
                    f"floor_height: the camera is {-height:.2f} m below the floor; give z of the "
                    "floor in world, m"
                )
        source = _Rays.of(keypoints.select(self.names))
        parts, enough = [], []
        for first in range(0, len(keypoints), CHUNK):
            times = keypoints.times[first : first + CHUNK]
            rays, seen = source.windows(times, self.receptive_field(), self.description.rate_hz)
            with torch_threads(1):
                parts.append(self._lift(rays, seen, bones, height, flip))
            enough.append(seen.any(axis=1).sum(axis=1) >= MIN_JOINTS)
            if progress:
                progress(first + len(times), len(keypoints))
        p = keypoints.camera.center_world + np.concatenate(parts)
        p, ok = _bridge(keypoints.times, p, np.concatenate(enough))
        if smooth:
            p = _smooth(keypoints.times, p)
        return LiftedPoses(keypoints.times, p, ok, self.names)

    def _lift(
        self,
        rays: NDArray[np.float32],
        seen: NDArray[np.bool_],
        bones: Array,
        camera_height: float,
        flip: bool,
    ) -> Array:
        """Joints (B, J, 3) from the optical centre, world axes, of windows (B, W, J, 3)."""
        body, B = self.description.body, len(rays)
        encoded = encode(
            body,
            torch.from_numpy(rays).permute(0, 3, 1, 2),
            torch.from_numpy(seen),
            torch.from_numpy(bones).float().expand(B, -1),
            torch.full((B,), camera_height),
        )
        pose, root = decode(body, answer(body, self._network, encoded, flip), encoded)
        p: Array = (pose + root[:, :, None]).transpose(1, 2).double().numpy()
        return p

    def _check_seen(self, keypoints: KeypointSequence) -> None:
        known = [name for name in self.names if name in keypoints.names]
        ever = [name for name in known if keypoints.seen[:, keypoints.names.index(name)].any()]
        if len(ever) < MIN_JOINTS:
            raise ShapeError(
                f"keypoints: the lifter needs at least {MIN_JOINTS} joints that are seen at some "
                f"time, and sees {len(ever)} ({', '.join(ever) or 'none'}); it knows "
                f"{', '.join(self.names)}: rename the detector's landmarks, use its adapter, or give a "
                "lifter trained for these joints"
            )

    def _bones(self, joint_offsets: ArrayLike | None) -> Array:
        body = self.description.body
        if joint_offsets is None:
            return np.full(len(body.nominal_bones), np.nan)
        offsets = readonly("joint_offsets", joint_offsets, (len(self.names), 3))
        length = np.linalg.norm(offsets[1:], axis=1)
        if not np.all(np.isfinite(offsets)) or np.any(length > 2) or not np.any(length > 0):
            raise ShapeError(
                f"joint_offsets: bone lengths from {np.min(length):.3g} to {np.max(length):.3g} m "
                "are no human's; give metres, finite, root row zero"
            )
        return np.asarray(body.bones_of(torch.from_numpy(offsets.copy())).numpy())


@dataclass(frozen=True)
class _Rays:
    """Undistorted rays of a keypoint sequence, to be looked up at any time."""

    times: Array
    rays: NDArray[np.float32]
    """(T, J, 3) directions in world; zeros where unseen."""
    seen: NDArray[np.bool_]
    """(T, J)."""

    @classmethod
    def of(cls, keypoints: KeypointSequence) -> _Rays:
        rays = keypoints.camera.rays_world(keypoints.uv_px)
        seen = keypoints.seen & np.isfinite(rays).all(axis=-1)
        rays = np.where(seen[..., None], rays, 0.0)
        return cls(keypoints.times, rays.astype(np.float32), seen)

    def windows(
        self, times: Array, size: int, rate_hz: float
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Rays (B, W, J, 3) and what is seen (B, W, J), W instants around each of B times.

        Between two frames a landmark is interpolated where both saw it.
        """
        steps = (np.arange(size) - size // 2) / rate_hz
        at = np.clip(times[:, None] + steps, self.times[0], self.times[-1])
        right = np.clip(np.searchsorted(self.times, at), 0, len(self.times) - 1)
        left = np.maximum(right - 1, 0)
        step = self.times[right] - self.times[left]
        since, until = at - self.times[left], self.times[right] - at
        share = np.divide(since, step, out=np.ones_like(at), where=step > 0)
        # Within a tenth of a frame of an image, that image alone stands.
        near = 0.1 / rate_hz
        share = np.where(until < near, 1.0, np.where(since < near, 0.0, share))
        between = (share > 0) & (share < 1)
        weight = share[..., None, None].astype(np.float32)
        rays = (1 - weight) * self.rays[left] + weight * self.rays[right]
        from_left = self.seen[left] | (share == 1)[..., None]
        from_right = self.seen[right] | (share == 0)[..., None]
        seen = from_left & from_right & ~(between & (step > MAX_STEP))[..., None]
        return rays, seen


def _bridge(times: Array, p: Array, enough: NDArray[np.bool_]) -> tuple[Array, NDArray[np.bool_]]:
    """Positions (T, J, 3) with frames that were not seen enough interpolated or held."""
    ok = enough & np.isfinite(p).all(axis=(1, 2))
    if not ok.any():
        raise ShapeError(
            f"keypoints: in no window are {MIN_JOINTS} joints seen; the person is never visible "
            "enough to be lifted"
        )
    flat = p.reshape(len(p), -1).copy()
    for column in range(flat.shape[1]):
        flat[~ok, column] = np.interp(times[~ok], times[ok], flat[ok, column])
    return flat.reshape(p.shape), ok


def _smooth(times: Array, p: Array) -> Array:
    """Zero-phase low-pass; sequences too short or too slow for it stay as they are."""
    if len(times) < 4:
        return p
    rate_hz = float(1 / np.median(np.diff(times)))
    return p if rate_hz <= 2 * LOW_PASS_HZ else signals.low_pass(p, rate_hz, LOW_PASS_HZ)

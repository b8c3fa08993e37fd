"""`Lifter`: landmarks of one calibrated camera, and sensors where there are any, to poses in world."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from lifting.checkpoint import LifterDescription, load_checkpoint
from lifting.folded import FoldedNetwork
from lifting.model import TemporalNetwork
from lifting.models import RAYS, model_of
from lifting.source import Source
from lifting.threads import torch_threads
from lifting.windows import SIGMA_TURN, Encoded, Estimate, answer, orthonormal, rotations
from rtof_kin.core import signals
from rtof_kin.core.checks import checked_times, readonly
from rtof_kin.core.errors import ShapeError, ViewError
from rtof_kin.core.resources import DEFAULT_LIFTER, lifter_path
from rtof_kin.data.camera import Camera
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.keypoints import KeypointSequence

Array = NDArray[np.float64]
Progress = Callable[[int, int], None]
"""Called with the frames done and their total."""

MIN_JOINTS = 6
"""Fewer different joints than this in a window, and the lifted pose means nothing."""
CHUNK = 128
"""Windows lifted at once: fewer cost more calls, more leave the cache."""
LOW_PASS_HZ = 6.0
"""Cut-off of the optional filter."""


@dataclass(frozen=True)
class LiftedPoses:
    """Poses of one person in world, from one camera and the sensors there were, each with its spread."""

    times: Array
    """(T,) seconds, those of the keypoints."""
    p_world_joint: Array
    """(T, J, 3) m, finite everywhere."""
    seen: NDArray[np.bool_]
    """(T,) whether the camera saw enough around the frame; elsewhere positions are interpolated
    between the frames it did see, and held at the ends."""
    names: tuple[str, ...]
    """J joint names."""
    sigma_m: Array = None  # type: ignore[assignment]
    """(T, J, 2) standard deviation per axis across the camera's ray and along it, m: of joints relative
    to the root, and in the root's place of the root. NaN where not seen, and of a lifter that gives
    none."""
    R_world_bone: Array = None  # type: ignore[assignment]
    """(T, J, 3, 3) orientations of segments; NaN where not seen, and of a lifter that gives none."""
    sigma_rad: Array = None  # type: ignore[assignment]
    """(T, J) their standard deviation per axis, rad; likewise."""

    def __post_init__(self) -> None:
        set_ = object.__setattr__
        set_(self, "names", tuple(self.names))
        set_(self, "times", checked_times("lifted times", self.times))
        T, J = len(self.times), len(self.names)
        set_(self, "p_world_joint", readonly("lifted p_world_joint", self.p_world_joint, (T, J, 3)))
        set_(self, "seen", readonly("lifted seen", self.seen, (T,), np.bool_))
        shapes = {"sigma_m": (T, J, 2), "R_world_bone": (T, J, 3, 3), "sigma_rad": (T, J)}
        for name, shape in shapes.items():
            given = getattr(self, name)
            value = np.full(shape, np.nan) if given is None else given
            set_(self, name, readonly(f"lifted {name}", value, shape))

    def __len__(self) -> int:
        return len(self.times)


class Lifter:
    """A trained lifter, ready to predict. Equal calls give equal answers."""

    def __init__(
        self, network: TemporalNetwork, description: LifterDescription, sha256: str = "", name: str = ""
    ) -> None:
        """Take a network in evaluation mode and what it is; `load` reads both from a file."""
        self.description = description
        self.sha256 = sha256
        """Of the file that the lifter was read from, in hexadecimal; empty where there is none."""
        self.name = name
        """The name under which it is shipped, or its file; empty where there is none."""
        self._network = network
        self._folded: dict[bool, FoldedNetwork] = {}

    @classmethod
    def load(cls, path: str | Path | None = None) -> Lifter:
        """Read a lifter.

        Args:
            path: a file, or the name of a shipped one, see `rtof_kin.core.resources.lifter_path`; the default
                of these where not given.

        Raises:
            FileFormatError: no such file; else see `load_checkpoint`.
        """
        name = DEFAULT_LIFTER if path is None else str(path)
        path = lifter_path(path)
        network, description = load_checkpoint(path)
        return cls(network, description, hashlib.sha256(path.read_bytes()).hexdigest(), name)

    @property
    def names(self) -> tuple[str, ...]:
        """J joint names that the lifter reads and gives."""
        return self.description.body.names

    def receptive_field(self) -> int:
        """Frames at `description.rate_hz` that one estimate depends on."""
        return self._network.receptive_field()

    def estimated(self) -> int:
        """Which of these frames it is an estimate of; the last one for a causal lifter."""
        return self._network.estimated()

    @property
    def network(self) -> TemporalNetwork:
        """The network, in evaluation mode; not to be changed."""
        return self._network

    def predict(
        self,
        keypoints: KeypointSequence,
        joint_offsets: ArrayLike | None = None,
        progress: Progress | None = None,
        *,
        bone_imus: BoneImuSequence | None = None,
        floor_height: float | None = None,
        flip: bool = True,
        smooth: bool = False,
    ) -> LiftedPoses:
        """Poses in world at the keypoints' own times.

        Landmarks are taken by joint name; those the lifter does not know are ignored, and joints
        without a landmark count as unseen. Windows are made at the lifter's rate by interpolating
        in time; before the first and after the last frame the nearest one stands.

        Args:
            keypoints: landmarks of one person; the camera's orientation gives the vertical.
            joint_offsets: (J, 3) m, each joint in its parent's link frame, in the order of `names`;
                tells the person's bone lengths, and with them the scale. None where unknown.
            progress: see `Progress`.
            bone_imus: calibrated sensors on any segments, at any times; NaN where missing. Those on
                segments that the lifter knows no sensor of are ignored, as all are by a lifter without.
            floor_height: z of a flat floor in world, m, where it is known; helps the distance.
            flip: average with the mirrored scene: slower by half, and better.
            smooth: low-pass positions (not orientations) at 6 Hz without delay.

        Returns:
            Finite positions for every frame, and whether each was seen.

        Raises:
            ShapeError: fewer than `MIN_JOINTS` joints are ever seen; `joint_offsets` or
                `floor_height` are wrong.
        """
        self._check_seen(keypoints)
        bones = self.bones_of(joint_offsets)
        height = camera_height(keypoints.camera, floor_height)
        source = Source.of(self.description.body, keypoints, bone_imus)
        parts, enough = [], []
        for first in range(0, len(keypoints), CHUNK):
            times = keypoints.times[first : first + CHUNK]
            estimate, seen = self._lift(source, times, bones, height, flip)
            parts.append(_arrays(estimate))
            enough.append(seen)
            if progress:
                progress(first + len(times), len(keypoints))
        p, sigma_m, R, sigma_rad = (np.concatenate(part) for part in zip(*parts, strict=True))
        p, ok = _bridge(keypoints.times, keypoints.camera.center_world + p, np.concatenate(enough))
        for values in (sigma_m, R, sigma_rad):
            values[~ok] = np.nan
        if smooth:
            p = _smooth(keypoints.times, p)
        return LiftedPoses(keypoints.times, p, ok, self.names, sigma_m, R, sigma_rad)

    def _lift(
        self, source: Source, times: Array, bones: Array, height: float, flip: bool
    ) -> tuple[Estimate, NDArray[np.bool_]]:
        """What the network says at times (B,), and whether enough was seen around each (B,)."""
        body, size = self.description.body, self.receptive_field()
        estimated, rate_hz = self._network.estimated(), self.description.rate_hz
        model = model_of(self.description.network.model)
        with torch_threads(1), torch.inference_mode():
            picture = self.description.network.model != RAYS
            windows = source.windows(times, size, estimated, rate_hz, bones, height, picture)
            encoded = model.encode(body, windows)
            estimate = model.decode(body, self._answer(encoded, flip), encoded)
            enough = windows.seen.any(dim=1).sum(dim=1) >= MIN_JOINTS
        return estimate, enough.numpy()

    def _answer(self, encoded: Encoded, flip: bool) -> Tensor:
        """The network's output (B, outputs); of the package's own kind by its faster copy."""
        if self.description.network.model != RAYS:
            return answer(self.description.body, self._network, encoded, flip)
        if flip not in self._folded:
            self._folded[flip] = FoldedNetwork(self.description.body, self._network, flip)
        output: Tensor = self._folded[flip](encoded.features, encoded.constants)
        return output

    def _check_seen(self, keypoints: KeypointSequence) -> None:
        known = [name for name in self.names if name in keypoints.names]
        ever = [name for name in known if keypoints.seen[:, keypoints.names.index(name)].any()]
        if not keypoints.seen.any():
            raise ShapeError(
                "keypoints: nobody was seen in any frame (every point is NaN or has confidence 0); "
                "look at the detector's output, or use mode 'imu' where there are sensors"
            )
        if len(ever) < MIN_JOINTS:
            raise ShapeError(
                f"keypoints: the lifter needs at least {MIN_JOINTS} joints that are seen at some "
                f"time, and sees {len(ever)} ({', '.join(ever) or 'none'}); it knows "
                f"{', '.join(self.names)}: rename the detector's landmarks, use its adapter, or give a "
                "lifter trained for these joints"
            )

    def bones_of(self, joint_offsets: ArrayLike | None) -> Array:
        """What the network is told of a person, see `Body.bones_of`; NaN where `joint_offsets` is None.

        Raises:
            ShapeError: they are wrong.
        """
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


def camera_height(camera: Camera, floor_height: float | None) -> float:
    """Height of the camera over a floor at this z in world, m; NaN where it is not known.

    Raises:
        ViewError: the camera is below the floor.
    """
    if floor_height is None:
        return np.nan
    height = float(camera.center_world[2] - floor_height)
    if not height > 0:
        raise ViewError(
            f"floor_height: the camera is {-height:.2f} m below the floor; give z of the floor in world, m"
        )
    return height


def _arrays(estimate: Estimate) -> tuple[Array, Array, Array, Array]:
    """Positions (B, J, 3) from the optical centre, their sigma (B, J, 2), orientations (B, J, 3, 3) and
    their sigma (B, J); NaN where there are none.
    """
    p = (estimate.pose + estimate.root[:, :, None]).transpose(1, 2)
    R, turn = torch.full((*p.shape, 3), torch.nan), torch.full(p.shape[:2], torch.nan)
    if estimate.axes is not None and estimate.log_turn is not None:
        R = rotations(orthonormal(estimate.axes.double())).permute(0, 3, 1, 2)
        turn = SIGMA_TURN * estimate.log_turn.exp()
    values = p, estimate.sigma_m(), R, turn
    p_np, sigma_np, R_np, turn_np = (x.double().numpy() for x in values)
    return p_np, sigma_np, R_np, turn_np


def _bridge(times: Array, p: Array, enough: NDArray[np.bool_]) -> tuple[Array, NDArray[np.bool_]]:
    """Positions (T, J, 3) with frames that were not seen enough interpolated or held."""
    ok = enough & np.isfinite(p).all(axis=(1, 2))
    if not ok.any():
        raise ShapeError(
            f"keypoints: in no window are {MIN_JOINTS} joints seen; the person is never visible "
            "enough to be lifted"
        )
    if ok.all():
        return p, ok
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

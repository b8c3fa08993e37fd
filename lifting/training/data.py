"""Random training windows from a corpus of motion, in batches, on one device.

A window is a moment of a recorded motion, re-timed, mirrored, re-proportioned, sometimes tilted or combined from the
upper body of one motion and the lower body of another, seen by a random camera. Arrays are (B, 3, W, J), see `windows`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lifting.body import Body, bone_groups
from lifting.training.corpus import Corpus
from lifting.training.joint_errors import Draw, View, about_axis, cross
from lifting.training.noise import (
    HALF_HEIGHT,
    HALF_WIDTH,
    PERFECT,
    TRAINING_NOISE,
    NoiseConfig,
    RigConfig,
    SensorConfig,
    add_noise,
    places,
    runs,
    trunk_segments,
    turns,
    with_errors,
    worn,
)
from lifting.windows import Windows
from rtof_kin.body import kinematics
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import UnknownNameError


@dataclass
class Moving:
    """B moving bodies."""

    bones: Tensor  #: (B, 3, W, J-1) bone vectors in world, m
    root: Tensor  #: (B, 3, W) path of the root from the estimated frame, m
    offsets: Tensor  #: (B, J, 3) joint offsets, m
    axes: Tensor  #: (B, 3, 2, J) x and z axes of all segments in the estimated frame
    carried: Tensor  #: (B, 3, W, 2, S) those of the segments that may carry sensors, at the sensors' times

    def turned(self, R: Tensor) -> Moving:
        """Return the bodies turned by rotations (B, 3, 3)."""

        def turn(x: Tensor) -> Tensor:
            return torch.bmm(R, x.flatten(2)).reshape(x.shape)

        bones, root, axes, carried = map(turn, (self.bones, self.root, self.axes, self.carried))
        return Moving(bones, root, self.offsets, axes, carried)

    def put_on(self, count: int, upper: Moving, joints: Tensor, segments: Tensor, sensors: Tensor) -> None:
        """Replace the upper bodies of the first rows; masks (J,), (J,), (S,) select what is upper."""

        def exchange(mine: Tensor, other: Tensor, mask: Tensor) -> None:
            mine[:count] = torch.where(mask, other, mine[:count])

        exchange(self.bones, upper.bones, joints[1:])
        exchange(self.offsets, upper.offsets, joints[:, None])
        exchange(self.axes, upper.axes, segments)
        exchange(self.carried, upper.carried, sensors)

    def displace(
        self, body: Body, rows: Tensor, axes: Tensor, segments: list[int], shift: Tensor, estimated: int
    ) -> None:
        """Displace joints that segments (n,), root first, with x and z axes (B', 3, W, 2, n) start and end with in some
        rows (B',), by shifts (B', J, 3) in the parents' frames, of the root in its own, m.
        """
        x, z = axes.unbind(dim=3)
        columns = torch.stack([x, cross(z, x), z])  # (3, B', 3, W, n)
        for i, j in enumerate(segments):
            for child in kinematics.children_of(body.parents, j):
                change = shift[:, child] - shift[:, j]
                self.offsets[rows, child] += change
                self.bones[rows, ..., child - 1] += _turned(columns[..., i], change[..., None])
        path = _turned(columns[..., 0], shift[:, 0, :, None])
        self.root[rows] += path - path[..., estimated : estimated + 1]

    def vary(self, body: Body, rows: Tensor, R: Tensor, segments: list[int], estimated: int) -> None:
        """Turn segments by rotations R (B', W, n, 3, 3) in world in some rows (B',), with their bones."""
        for i, j in enumerate(segments):
            columns = R[:, :, i].permute(3, 0, 2, 1)  # (3, B', 3, W)
            for child in kinematics.children_of(body.parents, j):
                self.bones[rows, ..., child - 1] = _turned(columns, self.bones[rows, ..., child - 1])
            self.axes[rows, ..., j] = R[:, estimated, i] @ self.axes[rows, ..., j]
            if j in body.sensor_joints:
                s = body.sensor_joints.index(j)
                for axis in range(2):
                    self.carried[rows, :, :, axis, s] = _turned(columns, self.carried[rows, :, :, axis, s])


def _turned(columns: Tensor, v: Tensor) -> Tensor:
    """Vectors (B, 3, W or 1) turned by rotations with columns (3, B, 3, W), as (B, 3, W)."""
    x, y, z = columns
    turned: Tensor = x * v[:, :1] + y * v[:, 1:2] + z * v[:, 2:]
    return turned


Offsets = NDArray[np.float32]


@dataclass(frozen=True)
class AugmentConfig:
    """What is drawn for each window."""

    distance: tuple[float, float] = (1.8, 7.5)  #: Horizontal distance from the camera to the root, m
    camera_height: tuple[float, float] = (0.5, 3.2)  #: Height of the camera over the floor, m
    off_axis: float = 0.75  #: Share of the image's width and height in which the root may be
    roll: float = 0.05  #: Standard deviation of the camera's roll, rad
    mirror: float = 0.5  #: Share of windows with left and right swapped
    tilt: float = 1 / 3  #: Share of windows with a tilted body
    tilt_angle: float = 0.7  #: Largest tilt about a random horizontal axis, rad
    warp: tuple[float, float] = (0.7, 1.4)  #: Range of the speed relative to the recording
    overall_scale: float = 0.07  #: Relative standard deviation of the body's size
    bone_scale: float = 0.05  #: Relative standard deviation of each bone's length, left and right together
    own_skeleton: float = 0.5
    """Share of windows on the skeleton of their motion; the rest have another one of the bank."""
    recombine: float = 0.2  #: Share of windows whose upper body comes from another motion
    rigs: RigConfig = field(default_factory=RigConfig)  #: How other rigs and people differ in the trunk
    hide_bones: float = 0.2  #: Share of windows without known bones
    bone_error: float = 0.003  #: Standard deviation per axis of the known bones, m
    hide_height: float = 0.6  #: Share of windows without a known camera height
    height_error: float = 0.02  #: Standard deviation of the known camera height, m
    noise: NoiseConfig = field(default_factory=NoiseConfig)  #: Errors of the detector
    sensors: SensorConfig = field(default_factory=SensorConfig)  #: Sensors worn, and their errors


def plain(noise: NoiseConfig = PERFECT) -> AugmentConfig:
    """Return the settings of validation: motion as recorded, exact bones, virtual cameras, no sensors."""
    return AugmentConfig(
        mirror=0.0,
        tilt=0.0,
        warp=(1.0, 1.0),
        overall_scale=0.0,
        bone_scale=0.0,
        own_skeleton=1.0,
        recombine=0.0,
        hide_bones=0.0,
        bone_error=0.0,
        hide_height=1.0,
        noise=noise,
        sensors=SensorConfig(none=1.0),
        rigs=RigConfig(share=0.0),
    )


def augmentation(noise: str, camera: Sequence[float] | None = None) -> AugmentConfig:
    """Return the settings for a kind of 2D, a key of `TRAINING_NOISE`; `UnknownNameError` for others.

    `camera` has distance and height of all cameras, m; None for random.
    """
    if noise not in TRAINING_NOISE:
        raise UnknownNameError("noise of the keypoints", [noise], list(TRAINING_NOISE))
    config = AugmentConfig(noise=TRAINING_NOISE[noise])
    if camera is None:
        return config
    distance, height = camera
    return replace(config, distance=(distance, distance), camera_height=(height, height))


@dataclass(frozen=True)
class Batch:
    """Observed windows, and the ground truth of their estimated frames."""

    windows: Windows  #: Observations before encoding
    pose: Tensor  #: (B, 3, J) root-relative joints in world axes, m
    root: Tensor  #: (B, 3) root from the optical centre in world axes, m
    axes: Tensor  #: (B, 3, 2, J) x and z axes of the segments in world


class MotionBank:
    """A corpus as tensors on one device, to draw windows from."""

    def __init__(self, corpus: Corpus, clips: list[int], device: torch.device, skeletons: Sequence[Offsets] = ()):
        """Prepare motion. skeletons: joint offsets (J, 3) of further bodies for every clip, m, scaled to its size."""
        self.body, self.rate_hz = corpus.body(), corpus.rate_hz
        self.device = device
        bodies: list[Offsets | None] = [None, *skeletons]
        bones = [torch.cat([_bones(corpus, clip, body) for clip in clips]) for body in bodies]
        offsets = [torch.stack([_offsets(corpus, clip, body) for clip in clips]) for body in bodies]
        self.bones, self.offsets = torch.stack(bones).to(device), torch.stack(offsets).to(device)
        p = [corpus.positions(clip) for clip in clips]
        R = np.concatenate([corpus.R_world_bone[corpus.frames(clip)] for clip in clips])
        count = np.array([len(part) for part in p])
        clip, last = np.repeat(np.arange(len(clips)), count), np.cumsum(count) - 1

        def tensor(values: NDArray[Any], dtype: torch.dtype = torch.float32) -> Tensor:
            return torch.from_numpy(values).to(device, dtype)

        self.roots = tensor(np.concatenate([part[:, 0] for part in p]))
        self.lowest = tensor(np.concatenate([part[:, :, 2].min(axis=1) for part in p]))
        self.heading = tensor(so3.heading(R[:, 0]))
        self.axes = tensor(np.ascontiguousarray(R[..., [0, 2]].transpose(0, 2, 3, 1)))
        self.trunk = trunk_segments(self.body)
        self.axes_of_trunk = self.axes[..., self.trunk]
        self.carried = self.axes[..., self.body.sensor_joints]
        self.clip = tensor(clip, torch.long)
        self.first, self.last = tensor((last - count + 1)[clip], torch.long), tensor(last[clip], torch.long)
        self.chain = _chain(self.body).to(device)
        self.upper = _upper_body(self.body).to(device)
        self.upper_segments = _upper_segments(self.body, self.upper)
        self.bone_axes = _bone_axes(corpus, self.body).to(device)
        groups = bone_groups(self.body.names)
        self.groups = len(groups)
        self.group_of_joint = torch.zeros(len(self.body.names), dtype=torch.long, device=device)
        for i, joints in enumerate(groups.values()):
            self.group_of_joint[joints] = i

    def __len__(self) -> int:
        return len(self.roots)

    def draw(
        self,
        batch: int,
        window: int,
        config: AugmentConfig,
        generator: torch.Generator,
        frames: Tensor | None = None,
        causal: bool = False,
    ) -> Batch:
        """Draw a batch of windows.

        Args:
            window: frames per window, odd, at the corpus' rate. generator: random numbers, on the bank's device.
            frames: (batch,) estimated frames; random if None.
            causal: estimate the last frame of each window instead of the middle one.
        """
        draw = Draw(batch, generator, self.device)
        estimated = window - 1 if causal else window // 2
        if frames is None:
            frames = draw.integers(len(self))
        step = torch.arange(window, device=self.device) - estimated
        moving = self._motion(frames, step, config, draw)
        scale = 1 + config.overall_scale * draw.normal(batch, 1)
        scale = scale * (1 + config.bone_scale * draw.normal(batch, self.groups))
        factor = scale.clamp(0.6, 1.6)[:, self.group_of_joint]
        moving.bones *= factor[:, None, None, 1:]
        bones = self.body.bones_of(moving.offsets * factor[:, :, None])
        self._mirror(moving, draw.uniform(batch) < config.mirror)
        moving = moving.turned(self._orientation(config, draw))
        pose = torch.matmul(moving.bones, self.chain)
        now = pose[:, :, estimated].clone()
        # The lowest joint stays as high over the floor as it was recorded.
        root_height = self.lowest[frames] - now[:, 2].min(dim=1).values
        height = draw.between(config.camera_height, batch)
        ahead = draw.between(config.distance, batch)
        towards_root = torch.stack([ahead, torch.zeros_like(height), root_height - height], 1)
        p = pose.add_((moving.root + towards_root[:, :, None])[..., None])
        body = View(p[:, :, estimated], moving.axes, moving.offsets * factor[:, :, None])
        rays, seen = self._observe(p, towards_root, body, config, draw)
        bones = bones + config.bone_error * draw.normal(*bones.shape)
        bones = torch.where(draw.uniform(batch, 1) < config.hide_bones, torch.nan, bones)
        height = height + config.height_error * draw.normal(batch)
        height = torch.where(draw.uniform(batch) < config.hide_height, torch.nan, height)
        axes, sensed = self._sense(moving.carried, config.sensors, draw)
        windows = Windows(rays, seen, bones, height, axes, sensed, estimated)
        return Batch(windows, now, towards_root, moving.axes)

    def _motion(self, frames: Tensor, step: Tensor, config: AugmentConfig, draw: Draw) -> Moving:
        """Motion at offsets `step` (W,) from frames (B,), re-timed."""
        speed = draw.between(config.warp, len(frames))[:, None]
        offset = step[None] * speed
        lag = draw.between(config.sensors.lag, len(frames))[:, None] * speed
        moving, heading = self._at(frames, offset, lag, self._bodies(config, draw))
        self._vary(moving, frames, offset, config.rigs, draw)
        count = round(config.recombine * len(frames))
        if count:
            other, body = draw.integers(len(self))[:count], self._bodies(config, draw)[:count]
            upper, other_heading = self._at(other, offset[:count], lag[:count], body)
            self._vary(upper, other, offset[:count], config.rigs, draw)
            upper = upper.turned(about_axis(2, heading[:count] - other_heading))
            sensors = self.upper_segments[self.body.sensor_joints]
            moving.put_on(count, upper, self.upper, self.upper_segments, sensors)
        return moving

    def _bodies(self, config: AugmentConfig, draw: Draw) -> Tensor:
        """(B,) index of the skeleton of each window, 0 for its own."""
        others = len(self.bones) - 1
        if others == 0:
            return torch.zeros(draw.batch, dtype=torch.long, device=self.device)
        return (1 + draw.integers(others)) * (draw.uniform(draw.batch) >= config.own_skeleton)

    def _at(self, frames: Tensor, offset: Tensor, lag: Tensor, body: Tensor) -> tuple[Moving, Tensor]:
        """Motion at offsets (B, W) from frames, within their clip, and the heading (B,) in the frames; segments with
        sensors are taken `lag` (B, 1) frames later, from the nearest frame.
        """
        low, high, share = self._between(frames, offset)
        bones = torch.lerp(self.bones[body[:, None], low], self.bones[body[:, None], high], share)
        root = torch.lerp(self.roots[low], self.roots[high], share[..., 0])
        root = (root - self.roots[frames][:, None]).transpose(1, 2)
        nearest = self._between(frames, offset + lag + 0.5)[0]
        bones, carried = (x.transpose(1, 2).contiguous() for x in (bones, self.carried[nearest]))
        moving = Moving(bones, root, self.offsets[body, self.clip[frames]], self.axes[frames], carried)
        return moving, self.heading[frames]

    def _vary(self, moving: Moving, frames: Tensor, offset: Tensor, config: RigConfig, draw: Draw) -> None:
        """Give some of the bodies the trunk of another rig, in place."""
        rows = (draw.uniform(len(frames)) < config.share).nonzero()[:, 0]
        if not len(rows) or not self.trunk:
            return
        W, estimated = offset.shape[1], int(offset[0].abs().argmin())
        nearest = self._between(frames[rows], offset[rows] + 0.5)[0]
        axes = self.axes_of_trunk[nearest].permute(0, 2, 1, 3, 4)
        some = replace(draw, batch=len(rows))
        moving.displace(self.body, rows, axes, self.trunk, places(self.body, config, some), estimated)
        keys = [0, W // 2, W - 1]  # the estimated frame is one of them
        R = turns(axes[:, :, keys], config, some)
        at = torch.linspace(0, 2, W, device=self.device)
        low = at.floor().long().clamp(max=1)
        between = torch.lerp(R[:, low], R[:, low + 1], (at - low)[:, None, None, None])
        moving.vary(self.body, rows, between, self.trunk, estimated)

    def _between(self, frames: Tensor, offset: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Frames (B, W) before and after, and the weight (B, W, 1, 1) of the one after."""
        at = frames[:, None] + offset
        at = at.clamp(self.first[frames][:, None].float(), self.last[frames][:, None].float())
        low = at.floor().long()
        high = torch.minimum(low + 1, self.last[frames][:, None])
        return low, high, (at - low)[..., None, None]

    def _mirror(self, moving: Moving, which: Tensor) -> None:
        """Mirror the bodies selected by a mask (B,), in place."""
        rows = which.nonzero()[:, 0]
        order = self.body.mirrored

        def mirror(x: Tensor, order: list[int]) -> None:
            across = x.new_tensor([1.0, -1.0, 1.0]).reshape(3, *[1] * (x.ndim - 2))
            index = torch.tensor(order, dtype=torch.long, device=self.device)
            x[rows] = x[rows].index_select(-1, index) * across

        mirror(moving.bones, [j - 1 for j in order[1:]])
        moving.root[rows, 1] *= -1
        mirror(moving.axes, order)
        mirror(moving.carried, self.body.mirrored_sensors)

    def _sense(self, axes: Tensor, config: SensorConfig, draw: Draw) -> tuple[Tensor, Tensor]:
        """Measured axes (B, 3, W, 2, S), and which are measured (B, W, S)."""
        B, _, W, _, S = axes.shape
        if S == 0 or config.none >= 1:
            return axes, torch.zeros((B, W, S), dtype=torch.bool, device=self.device)
        lost = runs(config.missing, W, S, draw, self.rate_hz)
        sensed = worn(self.body, config, draw)[:, None] & ~lost
        return with_errors(self.bone_axes, axes, config, draw), sensed

    def _orientation(self, config: AugmentConfig, draw: Draw) -> Tensor:
        """(B, 3, 3) random heading, and for some a tilt about a horizontal axis."""
        B = draw.batch
        tilted = draw.uniform(B) < config.tilt
        angle = torch.where(tilted, config.tilt_angle * draw.uniform(B), 0.0)
        axis, yaw = 2 * torch.pi * draw.uniform(B), 2 * torch.pi * draw.uniform(B)
        tilt = about_axis(2, axis) @ about_axis(0, angle) @ about_axis(2, -axis)
        return tilt @ about_axis(2, yaw)

    def _observe(
        self, p: Tensor, towards_root: Tensor, body: View, config: AugmentConfig, draw: Draw
    ) -> tuple[Tensor, Tensor]:
        """Rays (B, 3, W, J) in world and visibility for a camera that has the root in its image."""
        right = (2 * draw.uniform(draw.batch) - 1) * config.off_axis * HALF_WIDTH
        down = (2 * draw.uniform(draw.batch) - 1) * config.off_axis * HALF_HEIGHT
        azimuth = torch.atan2(towards_root[:, 1], towards_root[:, 0]) + right.atan()
        elevation = torch.atan2(towards_root[:, 2], towards_root[:, :2].norm(dim=1)) + down.atan()
        upright = torch.tensor([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]], device=self.device)
        roll = about_axis(2, config.roll * draw.normal(draw.batch))
        R_camera_world = roll @ upright @ about_axis(1, elevation) @ about_axis(2, -azimuth)
        q = torch.bmm(R_camera_world, p.flatten(2)).reshape(p.shape)
        seen = q[:, 2] > 0.2
        xy = q[:, :2] / q[:, 2:].clamp_min(0.2)
        view = body.turned(R_camera_world) if self.trunk else None
        xy, seen = add_noise(self.body, config.noise, xy, seen, draw, self.rate_hz, view)
        ray = torch.cat([xy, torch.ones_like(xy[:, :1])], dim=1)
        world = torch.bmm(R_camera_world.transpose(1, 2), ray.flatten(2))
        return world.reshape(p.shape), seen


def _offsets(corpus: Corpus, clip: int, body: Offsets | None) -> Tensor:
    """Joint offsets (J, 3) of a clip, or of another body scaled to the same size."""
    own = corpus.joint_offsets[clip]
    if body is not None:
        own = body * (np.linalg.norm(own, axis=1).sum() / np.linalg.norm(body, axis=1).sum())
    return torch.from_numpy(own)


def _bones(corpus: Corpus, clip: int, body: Offsets | None) -> Tensor:
    """Bone vectors (T, 3, J-1) in world of a clip on its own or another body."""
    p = corpus.positions(clip, _offsets(corpus, clip, body).numpy())
    bones = p[:, 1:] - p[:, list(corpus.parents[1:])]
    return torch.from_numpy(np.ascontiguousarray(np.swapaxes(bones, 1, 2)))


def _chain(body: Body) -> Tensor:
    """(J-1, J) ones for the bones between the root and a joint: bones @ chain = positions."""
    chain = torch.zeros(len(body.names) - 1, len(body.names))
    for j in range(1, len(body.names)):
        chain[:, j] = chain[:, body.parents[j]]
        chain[j - 1, j] = 1.0
    return chain


def _upper_body(body: Body) -> Tensor:
    """(J,) joints whose bone belongs neither to the pelvis nor to the legs."""
    legs = set(body.hips)
    for j, parent in enumerate(body.parents):
        if parent in legs:
            legs.add(j)
    return torch.tensor([j not in legs and parent > 0 for j, parent in enumerate(body.parents)])


def _upper_segments(body: Body, upper: Tensor) -> Tensor:
    """(J,) segments whose bones end in joints of the upper body, and its end segments."""
    children = [kinematics.children_of(body.parents, j) for j in range(len(upper))]
    ends = [bool(upper[(own or [j])[0]]) for j, own in enumerate(children)]
    return torch.tensor(ends, device=upper.device)


def _bone_axes(corpus: Corpus, body: Body) -> Tensor:
    """(S, 3) unit vectors along the bones of segments with sensors; zero for several bones or none."""
    mean = corpus.joint_offsets.mean(axis=0)
    axes = torch.zeros(len(body.sensors), 3)
    for s, j in enumerate(body.sensor_joints):
        children = kinematics.children_of(body.parents, j)
        if len(children) == 1:
            axes[s] = torch.from_numpy(mean[children[0]] / np.linalg.norm(mean[children[0]]))
    return axes

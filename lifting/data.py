"""Training windows from a corpus of motion: everything is drawn anew, in batches, on one device.

Every window is a moment of a real motion, re-timed, mirrored, re-proportioned, sometimes tilted as a
whole or put together from the upper body of one motion and the lower body of another, and watched by
a camera that exists only for it. Arrays are (B, 3, W, J), see `windows`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lifting.corpus import Corpus
from lifting.draws import Draw, about_x, about_y, about_z
from lifting.noise import HALF_HEIGHT, HALF_WIDTH, NoiseConfig, add_noise, perfect
from lifting.windows import Body, bone_groups
from rtof_kin import rotations as so3


@dataclass(frozen=True)
class AugmentConfig:
    """What is drawn for each window."""

    distance: tuple[float, float] = (1.8, 7.5)
    """Horizontal distance from the camera to the root, m."""
    camera_height: tuple[float, float] = (0.5, 3.2)
    """Height of the camera over the floor, m."""
    off_axis: float = 0.75
    """The root is anywhere in this share of the image's width and height."""
    roll: float = 0.05
    """Standard deviation of the camera's roll, rad."""
    mirror: float = 0.5
    """Share of windows with left and right swapped."""
    tilt: float = 1 / 3
    """Share of windows with the whole body tilted."""
    tilt_angle: float = 0.7
    """Largest tilt about a random horizontal axis, rad."""
    warp: tuple[float, float] = (0.7, 1.4)
    """Range of the speed, 1 = as recorded."""
    overall_scale: float = 0.07
    """Standard deviation of the whole body's size, relative."""
    bone_scale: float = 0.05
    """Standard deviation of each bone's length, left and right alike, relative."""
    own_skeleton: float = 0.5
    """Share of windows on the skeleton of their own motion; the rest on another of the bank's."""
    recombine: float = 0.2
    """Share of windows whose upper body comes from another motion."""
    hide_bones: float = 0.2
    """Share of windows that are not told the bones."""
    bone_error: float = 0.003
    """Standard deviation per axis of the bones the network is told, m."""
    hide_height: float = 0.6
    """Share of windows that are not told the camera's height."""
    height_error: float = 0.02
    """Standard deviation of the height the network is told, m."""
    noise: NoiseConfig = field(default_factory=NoiseConfig)


def plain(noise: NoiseConfig | None = None) -> AugmentConfig:
    """Motion as recorded, from virtual cameras, bones known exactly: what validation uses."""
    return AugmentConfig(
        mirror=0.0, tilt=0.0, warp=(1.0, 1.0), overall_scale=0.0, bone_scale=0.0, own_skeleton=1.0,
        recombine=0.0, hide_bones=0.0, bone_error=0.0, hide_height=1.0, noise=noise or perfect(),
    )  # fmt: skip


@dataclass(frozen=True)
class Batch:
    """What the network is given, before encoding, and the truth about it."""

    rays_world: Tensor
    """(B, 3, W, J) directions from the optical centre."""
    seen: Tensor
    """(B, W, J) bool."""
    bones: Tensor
    """(B, 3 G) bones, m, see `Body.bones_of`; NaN rows where not told."""
    camera_height: Tensor
    """(B,) m; NaN where not told."""
    pose: Tensor
    """(B, 3, J) root-relative joints of the middle frame in world axes, m."""
    root: Tensor
    """(B, 3) root of the middle frame from the optical centre in world axes, m."""


class MotionBank:
    """A corpus as tensors on one device, from which windows are drawn."""

    def __init__(
        self,
        corpus: Corpus,
        clips: list[int],
        device: torch.device,
        skeletons: Sequence[NDArray[np.float32]] = (),
    ):
        """Take motion.

        Args:
            corpus: the motion.
            clips: numbers of the clips to take, at least one.
            device: where windows are made.
            skeletons: joint offsets (J, 3) of other bodies to carry every clip over to, m. A clip
                scales them to its own size.
        """
        self.body, self.rate_hz = corpus.body(), corpus.rate_hz
        self.device = device
        bodies: list[NDArray[np.float32] | None] = [None, *skeletons]
        self.bones = torch.stack(
            [torch.cat([_bones(corpus, clip, body) for clip in clips]) for body in bodies]
        ).to(device)
        self.offsets = torch.stack(
            [torch.stack([_offsets(corpus, clip, body) for clip in clips]) for body in bodies]
        ).to(device)
        p_root, lowest, heading, first, last = [], [], [], [], []
        count = 0
        for clip in clips:
            p = corpus.positions(clip)
            p_root.append(p[:, 0])
            lowest.append(p[:, :, 2].min(axis=1))
            heading.append(so3.heading(corpus.R_world_bone[corpus.frames(clip), 0]))
            first.append(np.full(len(p), count))
            count += len(p)
            last.append(np.full(len(p), count - 1))

        def tensor(parts: list[Any], dtype: torch.dtype = torch.float32) -> Tensor:
            return torch.from_numpy(np.concatenate(parts)).to(device, dtype)

        self.roots, self.lowest, self.heading = tensor(p_root), tensor(lowest), tensor(heading)
        self.first, self.last = tensor(first, torch.long), tensor(last, torch.long)
        self.clip = torch.searchsorted(torch.unique(self.first), self.first)
        self.chain = _chain(self.body).to(device)
        self.upper = _upper_body(self.body).to(device)
        self.group_of_joint = _group_of_joint(self.body).to(device)
        self.groups = len(bone_groups(self.body.names))

    def __len__(self) -> int:
        return len(self.roots)

    def draw(
        self,
        batch: int,
        window: int,
        config: AugmentConfig,
        generator: torch.Generator,
        frames: Tensor | None = None,
    ) -> Batch:
        """A batch of windows.

        Args:
            batch: how many windows.
            window: frames in each, odd, at the corpus' rate.
            config: what is drawn for each.
            generator: the only source of randomness, on the bank's device.
            frames: (batch,) the middle frames; drawn where not given.
        """
        draw = Draw(batch, generator, self.device)
        if frames is None:
            frames = draw.integers(len(self))
        bones, root, offsets = self._motion(frames, window, config, draw)
        scale = 1 + config.overall_scale * draw.normal(batch, 1)
        scale = scale * (1 + config.bone_scale * draw.normal(batch, self.groups))
        factor = scale.clamp(0.6, 1.6)[:, self.group_of_joint]
        bones = bones * factor[:, None, None, 1:]
        told = self.body.bones_of(offsets * factor[:, :, None])
        mirrored = draw.uniform(batch) < config.mirror
        bones = torch.where(mirrored[:, None, None, None], self._mirror(bones), bones)
        root[:, 1] *= torch.where(mirrored, -1.0, 1.0)[:, None]
        R = self._orientation(config, draw)
        bones = torch.bmm(R, bones.flatten(2)).reshape(bones.shape)
        root = torch.bmm(R, root)
        pose = torch.matmul(bones, self.chain)
        middle = pose[:, :, window // 2].clone()
        # The lowest joint stays as high over the floor as it was recorded.
        root_height = self.lowest[frames] - middle[:, 2].min(dim=1).values
        height = draw.between(config.camera_height, batch)
        towards_root = torch.stack(
            [draw.between(config.distance, batch), torch.zeros_like(height), root_height - height],
            1,
        )
        p = pose.add_((root + towards_root[:, :, None])[..., None])
        rays, seen = self._observe(p, towards_root, config, draw)
        told = told + config.bone_error * draw.normal(*told.shape)
        told = torch.where(draw.uniform(batch, 1) < config.hide_bones, torch.nan, told)
        height = height + config.height_error * draw.normal(batch)
        height = torch.where(draw.uniform(batch) < config.hide_height, torch.nan, height)
        return Batch(rays, seen, told, height, middle, towards_root)

    def _motion(
        self, frames: Tensor, window: int, config: AugmentConfig, draw: Draw
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Bone vectors (B, 3, W, J-1), the root's path from the middle frame (B, 3, W), and the joint
        offsets (B, J, 3) of who moves."""
        step = (torch.arange(window, device=self.device) - window // 2)[None]
        offset = step * draw.between(config.warp, len(frames))[:, None]
        body = self._bodies(config, draw)
        bones, root, heading = self._at(frames, offset, body)
        offsets = self.offsets[body, self.clip[frames]]
        count = round(config.recombine * len(frames))
        if count:
            other, body = draw.integers(len(self))[:count], self._bodies(config, draw)[:count]
            upper, _, other_heading = self._at(other, offset[:count], body)
            turn = heading[:count] - other_heading
            c, s = turn.cos()[..., None], turn.sin()[..., None]
            x, y, z = upper.unbind(dim=1)
            upper = torch.stack([c * x - s * y, s * x + c * y, z], dim=1)
            bones[:count] = torch.where(self.upper[1:], upper, bones[:count])
            upper_offsets = self.offsets[body, self.clip[other]]
            offsets[:count] = torch.where(self.upper[:, None], upper_offsets, offsets[:count])
        return bones, root - root[:, :, window // 2, None], offsets

    def _bodies(self, config: AugmentConfig, draw: Draw) -> Tensor:
        """(B,) whose skeleton each window is on, 0 for its own."""
        others = len(self.bones) - 1
        if others == 0:
            return torch.zeros(draw.batch, dtype=torch.long, device=self.device)
        return (1 + draw.integers(others)) * (draw.uniform(draw.batch) >= config.own_skeleton)

    def _at(self, frames: Tensor, offset: Tensor, body: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Bones (B, 3, W, J-1), root (B, 3, W) and heading (B, W) around frames, inside their clip."""
        at = frames[:, None] + offset
        at = at.clamp(self.first[frames][:, None].float(), self.last[frames][:, None].float())
        low = at.floor().long()
        high = torch.minimum(low + 1, self.last[frames][:, None])
        share = (at - low)[..., None]
        body = body[:, None]
        bones = torch.lerp(self.bones[body, low], self.bones[body, high], share[..., None])
        root = torch.lerp(self.roots[low], self.roots[high], share)
        return bones.transpose(1, 2).contiguous(), root.transpose(1, 2), self.heading[low]

    def _mirror(self, bones: Tensor) -> Tensor:
        order = [j - 1 for j in self.body.mirrored[1:]]
        return bones[..., order] * bones.new_tensor([1.0, -1.0, 1.0])[:, None, None]

    def _orientation(self, config: AugmentConfig, draw: Draw) -> Tensor:
        """(B, 3, 3): any heading, and for some a tilt about a horizontal axis."""
        B = draw.batch
        tilted = draw.uniform(B) < config.tilt
        angle = torch.where(tilted, config.tilt_angle * draw.uniform(B), 0.0)
        axis, yaw = 2 * torch.pi * draw.uniform(B), 2 * torch.pi * draw.uniform(B)
        tilt = about_z(axis) @ about_x(angle) @ about_z(-axis)
        return tilt @ about_z(yaw)

    def _observe(
        self, p: Tensor, towards_root: Tensor, config: AugmentConfig, draw: Draw
    ) -> tuple[Tensor, Tensor]:
        """Rays (B, 3, W, J) in world and what is seen, by a camera that has the root in its image."""
        right = (2 * draw.uniform(draw.batch) - 1) * config.off_axis * HALF_WIDTH
        down = (2 * draw.uniform(draw.batch) - 1) * config.off_axis * HALF_HEIGHT
        azimuth = torch.atan2(towards_root[:, 1], towards_root[:, 0]) + right.atan()
        elevation = torch.atan2(towards_root[:, 2], towards_root[:, :2].norm(dim=1)) + down.atan()
        upright = torch.tensor([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]], device=self.device)
        roll = about_z(config.roll * draw.normal(draw.batch))
        R_camera_world = roll @ upright @ about_y(elevation) @ about_z(-azimuth)
        q = torch.bmm(R_camera_world, p.flatten(2)).reshape(p.shape)
        seen = q[:, 2] > 0.2
        xy = q[:, :2] / q[:, 2:].clamp_min(0.2)
        xy, seen = add_noise(self.body, config.noise, xy, seen, draw.generator, self.rate_hz)
        ray = torch.cat([xy, torch.ones_like(xy[:, :1])], dim=1)
        world = torch.bmm(R_camera_world.transpose(1, 2), ray.flatten(2))
        return world.reshape(p.shape), seen


def _offsets(corpus: Corpus, clip: int, body: NDArray[np.float32] | None) -> Tensor:
    """Joint offsets (J, 3) of a clip, or of another body scaled to its size."""
    own = corpus.joint_offsets[clip]
    if body is not None:
        own = body * (np.linalg.norm(own, axis=1).sum() / np.linalg.norm(body, axis=1).sum())
    return torch.from_numpy(own)


def _bones(corpus: Corpus, clip: int, body: NDArray[np.float32] | None) -> Tensor:
    """Bone vectors (T, 3, J-1) in world of a clip on its own or another body."""
    p = corpus.positions(clip, _offsets(corpus, clip, body).numpy())
    bones = p[:, 1:] - p[:, list(corpus.parents[1:])]
    return torch.from_numpy(np.ascontiguousarray(np.swapaxes(bones, 1, 2)))


def _chain(body: Body) -> Tensor:
    """(J-1, J) ones where a bone lies between the root and a joint: bones @ chain = positions."""
    chain = torch.zeros(len(body.names) - 1, len(body.names))
    for j in range(1, len(body.names)):
        chain[:, j] = chain[:, body.parents[j]]
        chain[j - 1, j] = 1.0
    return chain


def _upper_body(body: Body) -> Tensor:
    """(J,) bool: joints whose bone hangs on the trunk, not on the pelvis or the legs."""
    legs = set(body.hips)
    for j, parent in enumerate(body.parents):
        if parent in legs:
            legs.add(j)
    return torch.tensor([j not in legs and parent > 0 for j, parent in enumerate(body.parents)])


def _group_of_joint(body: Body) -> Tensor:
    """(J,) which of `bone_groups` ends at each joint; 0 for the root."""
    index = torch.zeros(len(body.names), dtype=torch.long)
    for i, joints in enumerate(bone_groups(body.names).values()):
        index[joints] = i
    return index

"""Make models/joint_errors.npz: errors of joints that are regressed from a real detector's points.

``python -m models.build_joint_errors CORPUS`` with CORPUS as in benchmarks/README.md. The training subjects'
motion is seen by cameras all around. The simulated points of the detector, without exchanges and jumps, are
regressed to joints, and their errors (px x depth / f) are described as `lifting.training.joint_errors` has it: the
mean by least squares, then covariances from pairs of frames, by the view and the lag between them.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from lifting.body import Body
from lifting.training.corpus import Corpus, read_corpus
from lifting.training.joint_errors import (
    LEG_M,
    MEMORY_S,
    JointErrors,
    View,
    designs,
    hidden_joints,
    mean_error,
    rig_places,
)
from rtof_kin.body.kinematics import shared_frames
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.array_types import Array
from rtof_kin.data.camera import Camera
from rtof_kin.data.poses import PoseSequence
from rtof_kin.simulation.detector_errors import DetectorErrors, simulate_detections
from rtof_kin.vision.landmark_regression import LandmarkRegression

LAYOUT, CAMERAS, SEED, FOCAL_PX = "mediapipe33", 3, 0, 1250.0
DETECTOR = DetectorErrors(jumps=0.0, exchanges=0.0, camera=0.0, delay_frames=(0.0,))
LARGEST_M = 0.2
"""Larger errors are shortened to this."""
RIDGE = 300.0
"""Weight of zero for the coefficients of the mean, as a number of frames."""
LAGS = (0, 1, 2, 3, 5, 8, 12, 18, 26)
"""Frames between the frames of a pair."""
RANK = 8
ACROSS = torch.tensor([1.0, -1.0, 1.0])


@dataclass(frozen=True)
class Seen:
    """Joints as cameras saw them in N frames."""

    view: View
    error: Tensor
    """(N, J, 2) m; NaN where a joint was not observed."""
    take: Tensor
    """(N,) index of clip and camera."""

    def mirrored(self, body: Body) -> Seen:
        """Return the frames in a mirror."""
        order, flip = body.mirrored, torch.tensor([-1.0, 1.0, 1.0])
        view = View(
            (self.view.joints * flip[:, None])[..., order],
            (self.view.axes * flip[:, None, None])[..., order],
            (self.view.offsets * ACROSS)[:, order],
        )
        return Seen(view, (self.error * flip[:2])[:, order], self.take)


def main(corpus_folder: str) -> None:
    """See, fit, write."""
    corpus = read_corpus(corpus_folder).in_shared_frames()
    body, seen = corpus.body(), see(corpus)
    usual = rig_places(body, torch.from_numpy(corpus.joint_offsets[corpus.clips("train")])).mean(dim=0)
    usual = (usual + usual[body.mirrored] * ACROSS) / 2
    place, view, follows = fit_mean(body, seen, usual)
    table = JointErrors(place, view, usual, follows, *torch.zeros(3, 0))
    residual = seen.error - mean_error(body, table, seen.view, torch.ones(len(seen.take)))
    where = hidden_joints(body, seen.view)
    hidden = fit_hidden(body, residual, where)
    residual /= torch.where(where, hidden, 1.0)[..., None]
    factor, rest = fit_covariance(body, Seen(seen.view, residual, seen.take))
    np.savez_compressed(
        Path(__file__).with_name("joint_errors.npz"),
        place=place,
        view=view,
        follows=follows,
        usual=usual,
        hidden=hidden,
        factor=factor.half(),
        rest=rest,
    )
    print(f"fitted to {len(residual)} frames; rms of the rest {1e3 * rest.square().mean().sqrt():.1f} mm")


def see(corpus: Corpus) -> Seen:
    """Return the training motion as cameras see it."""
    rng, usual = np.random.default_rng(SEED), SkeletonModel.default()
    R_bone_shared = shared_frames(usual.names, usual.joint_offsets)
    regression, parts, offsets = LandmarkRegression.default(), [], []
    for clip in corpus.clips("train"):
        own = corpus.joint_offsets[clip].astype(float)
        skeleton = usual.with_offsets(np.einsum("jab,jb->ja", R_bone_shared[np.maximum(corpus.parents, 0)], own))
        p, R_shared = corpus.positions(clip).astype(float), corpus.R_world_bone[corpus.frames(clip)]
        times = np.arange(len(p)) / corpus.rate_hz
        R_bone = R_shared.astype(float) @ R_bone_shared.swapaxes(-1, -2)
        poses = PoseSequence(times, p, R_bone, corpus.names)
        for _ in range(CAMERAS):
            camera = random_camera(rng, p[:, 0].mean(axis=0))
            found = simulate_detections(rng, poses, skeleton, camera, DETECTOR)
            joints = regression.apply(LAYOUT, found.uv_px[:, 0], found.confidence[:, 0])
            q, uv = camera.to_camera(p), camera.project(p)
            error = (joints.uv_px[:, : len(corpus.names)] - uv) * q[..., 2:] / FOCAL_PX
            error[joints.confidence[:, : len(corpus.names)] <= 0] = np.nan
            inside = np.all((uv > 0) & (uv < [camera.width_px, camera.height_px]), axis=-1)
            error[inside.mean(axis=1) < 0.9] = np.nan
            axes = (camera.R_camera_world @ R_shared)[..., [0, 2]]
            parts.append((q.swapaxes(1, 2), axes.transpose(0, 2, 3, 1), error))
            offsets.append(own)
    take = torch.from_numpy(np.repeat(np.arange(len(parts)), [len(part[0]) for part in parts]))
    joints_, axes_, error_ = (torch.from_numpy(np.concatenate(x)).float() for x in zip(*parts, strict=True))
    of_take = torch.from_numpy(np.stack(offsets)).float()[take]
    error_ *= (LARGEST_M / error_.norm(dim=-1, keepdim=True)).clamp(max=1)
    return Seen(View(joints_, axes_, of_take), error_, take)


def random_camera(rng: np.random.Generator, centre: Array) -> Camera:
    """Return a camera somewhere around a person, who is somewhere in its image."""
    azimuth, away, height = rng.uniform([0, 2.2, 0.5], [2 * np.pi, 6.5, 3.0])
    eye = [centre[0] + away * np.cos(azimuth), centre[1] + away * np.sin(azimuth), height]
    return Camera.looking_at(eye, centre + rng.normal(size=3) * [0.2, 0.2, 0.15] * away / 4, FOCAL_PX)


def fit_mean(body: Body, seen: Seen, usual: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return places (J, 3), view coefficients (J, 9, 3) and follows (J,); left mirrors right."""
    J, both = len(body.names), (seen, seen.mirrored(body))
    fitted = torch.zeros(J, 31)
    for j in range(J):
        A, b = RIDGE * torch.eye(31).double(), torch.zeros(31).double()
        for each in both:
            known = each.error[:, j].isfinite().all(dim=-1)
            X = _columns(body, each.view, usual, j)[known].flatten(0, 1).double()
            y = each.error[known, j].flatten().double()
            A, b = A + X.T @ X, b + X.T @ y
        fitted[j] = torch.linalg.solve(A, b).float()
    return fitted[:, :3], fitted[:, 3:30].reshape(J, 9, 3), fitted[:, 30]


def _columns(body: Body, view: View, usual: Tensor, j: int) -> Tensor:
    """(N, 2, 31) what the error of a joint is linear in."""
    R, R_pelvis, h = designs(view)
    plane = torch.zeros(len(R), 2, 3)
    plane[:, 0, 0] = plane[:, 1, 1] = 1.0
    plane[:, :, 2] = -view.joints[:, :2, j] / view.joints[:, 2:, j]
    of_view = (plane @ R_pelvis)[:, :, None, :] * h[:, j, None, :, None]
    rig = LEG_M * (rig_places(body, view.offsets)[:, j] - usual[j])  # zero for limbs
    in_segment = plane @ R[:, j]
    return torch.cat([in_segment, of_view.flatten(2), -(in_segment @ rig[..., None])], dim=-1)


def fit_hidden(body: Body, residual: Tensor, hidden: Tensor) -> Tensor:
    """Return how much larger (J,) the errors of hidden joints are; 1 for the trunk's."""
    square, limbs = residual.square().sum(dim=-1), [j for limb in body.arms + body.legs for j in limb]
    factor = torch.ones(len(body.names))
    for j in limbs:
        factor[j] = (square[hidden[:, j], j].nanmean() / square[~hidden[:, j], j].nanmean()).sqrt()
    return (factor + factor[body.mirrored]) / 2


def fit_covariance(body: Body, seen: Seen) -> tuple[Tensor, Tensor]:
    """Return factors (3, parts, 2 J, rank) and rests (3, parts, 2 J).

    Views from the right are mirrored. The expected product of the errors of two frames is the sum over views
    and parts of squared weight x correlation x covariance.
    """
    sin, cos = seen.view.azimuth()
    right = sin < 0
    error = torch.where(right[:, None, None], seen.mirrored(body).error, seen.error).flatten(1)
    weight = torch.stack([cos.clamp(min=0), (-cos).clamp(min=0), sin.abs()], dim=1) ** 2
    whole, n, size = error.isfinite().all(dim=1), 3 * len(MEMORY_S), error.shape[1]
    A, B = torch.zeros(n, n).double(), torch.zeros(n, size, size).double()
    for lag in LAGS:
        first = torch.arange(len(error) - lag)
        second = first + lag
        pair = (seen.take[first] == seen.take[second]) & (right[first] == right[second])
        first, second = (x[pair & whole[first] & whole[second]] for x in (first, second))
        correlation = torch.tensor([np.exp(-lag / 60 / memory) for memory in MEMORY_S]).float()
        share = (weight[first][:, :, None] * correlation).flatten(1)
        A += (share.T @ share).double()
        for i in range(n):
            B[i] += ((error[first] * share[:, i : i + 1]).T @ error[second]).double()
    C = torch.linalg.solve(A, B.flatten(1)).reshape(3, -1, size, size)
    values, vectors = torch.linalg.eigh((C + C.transpose(2, 3)) / 2)
    factor = vectors[..., -RANK:] * values[..., None, -RANK:].clamp(min=0).sqrt()
    rest = (C.diagonal(dim1=2, dim2=3) - factor.square().sum(dim=-1)).clamp(min=0).sqrt()
    return factor.float(), rest.float()


if __name__ == "__main__":
    main(sys.argv[1])

"""What training minimises, in metres."""

from __future__ import annotations

from torch import Tensor

ROOT_WEIGHT = 0.3
"""Weight of the root's distance against the mean joint distance."""


def mean_joint_distance(pose: Tensor, truth: Tensor) -> Tensor:
    """Mean distance (B,) of root-relative joints (B, 3, J); the root's own 0 is not counted."""
    distance: Tensor = (pose - truth)[:, :, 1:].norm(dim=1)
    return distance.mean(dim=1)


def root_distance(root: Tensor, truth: Tensor) -> Tensor:
    """Distance (B,) of root positions (B, 3)."""
    distance: Tensor = (root - truth).norm(dim=1)
    return distance


def lifting_loss(pose: Tensor, root: Tensor, true_pose: Tensor, true_root: Tensor) -> Tensor:
    """Mean over the batch of joint distance + `ROOT_WEIGHT` x root distance."""
    joints = mean_joint_distance(pose, true_pose)
    return (joints + ROOT_WEIGHT * root_distance(root, true_root)).mean()

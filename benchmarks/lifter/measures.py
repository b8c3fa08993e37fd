"""Figures of one lifted motion: positions, torso, and whether the errors are as large as was said."""

from __future__ import annotations

from math import sqrt

import numpy as np
from scipy.integrate import quad
from scipy.special import erf, k1

from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.data.poses import PoseSequence

Figures = dict[str, float]
TORSO = {"pelvis": "Hips", "upper trunk": "Spine3"}
PARTS = ("total", "yaw", "lean")
SIGMAS = (1, 2)
DIRECTIONS = {"joints across": 2, "joints along": 1, "root across": 2, "root along": 1, "turns": 3}
"""Quantities with a standard deviation -> dimensions of their density."""


def position_figures(p: Array, truth: PoseSequence, known: Mask) -> Figures:
    """Errors of joints (T, J, 3) in the frames known (T,): in mm, m/s^2, m/s^3; of each joint, mm.

    As in `rtof_kin.body.metrics`: the root's 0 counts among the root-relative errors.
    """
    p_true, rate = truth.p_world_joint, truth.rate_hz
    difference = np.where(known[:, None, None], p - p_true, np.nan)
    relative = 1000 * np.linalg.norm(difference - difference[:, :1], axis=-1)
    figures = {
        "mpjpe_rr_mm": _mean(relative),
        "mpjpe_mm": _mean(1000 * np.linalg.norm(difference, axis=-1)),
        "mpjae": _mean(np.linalg.norm(signals.derivative(difference, rate, 2), axis=-1)),
        "mpjje": _mean(np.linalg.norm(signals.derivative(difference, rate, 3), axis=-1)),
    }
    joints = {f"{name} mm": _mean(relative[:, j]) for j, name in enumerate(truth.names)}
    return figures | joints


def torso_figures(R: Array, truth: PoseSequence, known: Mask) -> Figures:
    """Errors of orientation (T, J, 3, 3) of pelvis and upper trunk, degrees: see `turn_parts`."""
    figures: Figures = {}
    for name, joint in TORSO.items():
        j = truth.names.index(joint)
        parts = turn_parts(R[known, j], truth.R_world_bone[known, j])
        figures |= {f"{name} {part} deg": _mean(v) for part, v in zip(PARTS, parts, strict=True)}
    return figures


def turn_parts(R: Array, R_true: Array) -> tuple[Array, Array, Array]:
    """Angles (T,) between orientations (T, 3, 3), degrees: in all, about the vertical, and about a
    horizontal axis (the turn that takes one to the other is the second after the third)."""
    error = R @ np.swapaxes(R_true, -1, -2)
    yaw = np.arctan2(error[:, 1, 0] - error[:, 0, 1], error[:, 0, 0] + error[:, 1, 1])
    lean = np.arccos(np.clip(error[:, 2, 2], -1, 1))
    total, yaw, lean = map(np.degrees, (so3.angle_between(R, R_true), np.abs(yaw), lean))
    return total, yaw, lean


def calibration_figures(
    p: Array, R: Array, sigma_m: Array, sigma_rad: Array, truth: PoseSequence, centre: Array
) -> Figures:
    """Share of errors per axis within one and two of the standard deviations stated.

    Args:
        p, R: (T, J, 3) and (T, J, 3, 3) estimated. sigma_m: (T, J, 2), sigma_rad: (T, J), as lifted;
            NaN does not count. centre: (3,) the camera's, in world, m.
    """
    error = p - truth.p_world_joint
    ray = so3.unit(truth.p_world_joint[:, 0] - centre)
    beside = so3.unit(np.cross(ray, [0.0, 0.0, 1.0]))
    axes = np.stack([beside, np.cross(ray, beside), ray], axis=1)  # (T, 3, 3): one in each row
    relative = np.einsum("tac,tjc->tja", axes, error[:, 1:] - error[:, :1])
    root = np.einsum("tac,tc->ta", axes, error[:, 0])
    turned = np.isfinite(sigma_rad).all(axis=1)
    turns = so3.log(np.swapaxes(R[turned], -1, -2) @ truth.R_world_bone[turned])
    ratios = {
        "joints across": relative[..., :2] / sigma_m[:, 1:, :1],
        "joints along": relative[..., 2] / sigma_m[:, 1:, 1],
        "root across": root[:, :2] / sigma_m[:, 0, :1],
        "root along": root[:, 2] / sigma_m[:, 0, 1],
        "turns": turns / sigma_rad[turned][..., None],
    }
    return {
        f"{name} within {k}": _mean((np.abs(ratio[np.isfinite(ratio)]) < k).astype(float))
        for name, ratio in ratios.items()
        for k in SIGMAS
    }


def expected_share(dimensions: int, k: float) -> float:
    """Share per axis within k standard deviations of the density that spreads are learnt with.

    It is exp(-r / b) of the length r of an error, up to a constant, in so many dimensions: Laplace's in
    one; per axis its variance is (n + 1) b^2, and its marginal is integrated here.
    """
    a = k * sqrt(dimensions + 1)  # in units of b
    if dimensions == 1:
        return float(1 - np.exp(-a))
    if dimensions == 3:
        return float(1 - (a / 2 + 1) * np.exp(-a))
    return float(2 / np.pi * quad(lambda x: x * k1(x), 0, a)[0])


def gaussian_share(k: float) -> float:
    """Share within k standard deviations of a normal distribution."""
    return float(erf(k / sqrt(2)))


def _mean(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if known.size else float("nan")

"""A small recording for the solver in Cartesian space, and a solver whose fragments can be inspected."""

from __future__ import annotations

from typing import Any

import numpy as np
import planted
from numpy.typing import NDArray

from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.solve.cartesian.problem import TERMS, FragmentProblem
from rtof_kin.solve.fragment_solver import FragmentReport, FragmentSolver
from rtof_kin.solve.initial_guess import InertialGuidedIK

Array = NDArray[np.float64]
BODY, SMALL = SkeletonModel.default(), SkeletonModel.human36m()
SMALL_SENSORS = ("LElbow", "RKnee", "LHip", "Hip")


class Inspected(FragmentSolver):
    """A solver that keeps the values of each fragment and its solution before blending."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.answers: list[Array] = []
        self.values: list[dict[str, Array]] = []
        self.inner: Any = self._solver
        solve, call = self.inner._solve_fragment, self.inner._call

        def kept(*arguments: Any) -> tuple[Array, FragmentReport]:
            X, report = solve(*arguments)
            self.answers.append(X)
            return X, report

        def called(x: Array, values: dict[str, Array], first: int) -> Any:
            self.values.append(values)
            return call(x, values, first)

        self.inner._solve_fragment, self.inner._call = kept, called


class Scene:
    """A motion, its observations, and an initial guess."""

    def __init__(self, skeleton: SkeletonModel, frames: int, seed: int = 0) -> None:
        joints = planted.LIMBS if skeleton is BODY else SMALL_SENSORS
        self.truth: Motion = planted.moving(skeleton, frames, 3 * seed)
        self.p = self.truth.poses.p_world_joint
        self.seen = planted.keypoints(self.truth.poses, 4.0, 7 + seed)
        self.imus = planted.bone_imus(skeleton, self.truth.poses, joints, 4.0, 0.4, 11 + seed)
        self.lifted = planted.lifted_poses(self.truth)
        self.start = InertialGuidedIK(skeleton).refine(self.lifted, self.imus)


def gaps(rng: np.random.Generator, weight: Array) -> Array:
    """Weights (n, frames) with zeros: single ones, in two frames, in the last row."""
    out = weight * (rng.uniform(size=weight.shape) < 0.8)
    out[:, 2:4] = 0.0
    out[-1:] = 0.0
    return np.asarray(out)


def parameters(problem: FragmentProblem, X: Array, seed: int) -> dict[str, Array]:
    """Parameters of a problem about positions X (N, J, 3) m, with weights of every size and gaps."""
    rng, cam, (N, J) = np.random.default_rng(seed), planted.camera(), X.shape[:2]
    B, (a, b) = len(problem.sensor_bones), np.array(problem.pairs).T
    w_visual = gaps(rng, rng.uniform(0, 0.01, (J, N))).T.ravel()
    uv = (cam.project(X) + rng.normal(size=(N, J, 2)) * 15).reshape(-1, 2)
    jerks = N - 3 if problem.settings.as_printed else 0
    return {
        "R_camera_world": cam.R_camera_world,
        "t_camera_world": cam.t_camera_world,
        "K": cam.K,
        "rate_hz": np.array([60.0]),
        "sigma_reprojection": np.array([7.0]),
        "uv_px": np.where(w_visual[:, None] > 0, uv, 0.0).T,
        "w_visual": w_visual,
        "shares": rng.uniform(0.2, 0.9, B),
        "a_world": rng.normal(size=(3 * B, N - 2)) * 5,
        "w_acceleration": gaps(rng, rng.uniform(0, 0.1, (B, N - 2))),
        "b_world": rng.normal(size=(3 * B, N)) * 0.2,
        "w_bone": gaps(rng, rng.uniform(0, 0.1, (B, N))),
        "w_smooth": rng.uniform(0, 0.01, N - 3),
        "j_world": rng.normal(size=(3 * J, jerks)) * 100,
        "w_length": gaps(rng, rng.uniform(0, 0.1, (2, N)))[0],
        "lengths": np.linalg.norm(X[0, b] - X[0, a], axis=-1) + 0.01 * rng.normal(size=len(a)),
        "p_prior": (X + rng.normal(size=X.shape) * 0.05).reshape(N, -1).T,
        "k": rng.uniform(0.3, 2.0, len(TERMS)),
    }

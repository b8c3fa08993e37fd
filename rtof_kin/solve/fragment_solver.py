"""`FragmentSolver`: temporal optimisation in overlapping fragments of N frames.

Fragments begin every N/2 frames, so every frame is solved twice and the two solutions are blended. Two
spaces of variables: configurations of the skeleton (``joint``, the default: rigid bones, orientations,
limits) and the paper's joint positions (``cartesian``). Equal calls give equal results.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from rtof_kin.body.pose_prior import has_prior
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.choices import SPACES, Space
from rtof_kin.core.errors import InvalidInputError, SolverError, UnknownNameError, ViewError
from rtof_kin.data.confidence import Confidence, joined
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.inertial.root_path import ContactPoints
from rtof_kin.solve.cartesian.problem import TERMS as CARTESIAN_TERMS
from rtof_kin.solve.cartesian.solver import CartesianSolver
from rtof_kin.solve.initial_guess import InitialGuess, initial_guess
from rtof_kin.solve.joint_space.solver import JointSpaceSolver
from rtof_kin.solve.joint_space.terms import BUILT_IN
from rtof_kin.solve.settings import CartesianSettings, JointSpaceSettings
from rtof_kin.solve.solution import Block, FragmentReport, FragmentSolution, SolverStatus
from rtof_kin.solve.terms import PointData, PointTerm, Term, check_terms

__all__ = ["FragmentReport", "FragmentSolution", "FragmentSolver", "SolverStatus"]

Progress = Callable[[int, int], None]  #: Called with (fragments done, fragments in all)


def usual_space(skeleton: SkeletonModel) -> Space:
    """Return the default space of a skeleton: joint space needs a pose prior."""
    return "joint" if has_prior(skeleton.name) else "cartesian"


class FragmentSolver:
    """Optimises pose sequences of one skeleton with keypoints and any subset of its sensors."""

    def __init__(
        self,
        skeleton: SkeletonModel,
        frames: int = 50,
        settings: CartesianSettings | JointSpaceSettings | None = None,
        sensor_joints: tuple[str, ...] | None = None,
        space: Space | None = None,
        terms: Sequence[Term] = (),
    ) -> None:
        """Build the solver. `InvalidInputError`: invalid N, settings of the other space, or joint space without a pose
        prior; `UnknownNameError`: unknown segment, space or joint of a term.

        Args:
            frames: N, even, at least 8.
            settings: `JointSpaceSettings` or `CartesianSettings`; the defaults of `space` where None.
            sensor_joints: segments that have a place for a sensor; a recording may use any subset, which in joint
                space shares the compiled code. None: in Cartesian space every segment that usually carries one, in
                joint space those with data.
            space: one of `SPACES`. None: that of the settings, else `usual_space`.
            terms: further residuals, whose observations `solve` takes.
        """
        if frames < 8 or frames % 2:
            raise InvalidInputError(f"frames: N = {frames} must be even and at least 8")
        if space is None:
            space = usual_space(skeleton)
            if settings is not None:
                space = "joint" if isinstance(settings, JointSpaceSettings) else "cartesian"
        if space not in SPACES:
            raise UnknownNameError("space", [space], SPACES)
        if space == "joint" and not has_prior(skeleton.name):
            raise InvalidInputError(f"space 'joint': no pose prior is shipped for {skeleton.name!r}; use 'cartesian'")
        settings = settings or (JointSpaceSettings() if space == "joint" else CartesianSettings())
        self.skeleton, self.frames, self.space, self.settings = skeleton, frames, space, settings
        carriers = tuple(joint for joint, _ in skeleton.sensors.values())
        self.sensor_joints = carriers if sensor_joints is None else tuple(sensor_joints)
        skeleton.index(*self.sensor_joints)
        self.terms = tuple(terms)
        check_terms(self.terms, skeleton.names, BUILT_IN if space == "joint" else CARTESIAN_TERMS, space)
        self._solver: CartesianSolver | JointSpaceSolver
        if space == "joint" and isinstance(settings, JointSpaceSettings):
            places = tuple(sensor_joints or ())
            self._solver = JointSpaceSolver(skeleton, frames, settings, places, self.terms)
        elif space == "cartesian" and isinstance(settings, CartesianSettings):
            points = tuple(term for term in self.terms if isinstance(term, PointTerm))
            self._solver = CartesianSolver(skeleton, frames, settings, self.sensor_joints, points)
        else:
            raise InvalidInputError(f"settings: {type(settings).__name__} are not those of space {space!r}")

    def solve(
        self,
        start: PoseSequence | InitialGuess,
        keypoints: KeypointSequence | None,
        bone_imus: BoneImuSequence | Sequence[BoneImuSequence] | None = None,
        progress: Progress | None = None,
        contact_points: ContactPoints | None = None,
        confidence: bool = False,
        views: Sequence[KeypointSequence] = (),
        observed: Mapping[str, PointData] | None = None,
    ) -> FragmentSolution:
        """Optimise a sequence: RTOF with sensors, RTO without, sensors only without keypoints.

        Args:
            start: (T, J) finite poses, usually those after SF2, or an initial guess; also the centre of weak priors.
            keypoints: at the frames' times, NaN where unobserved, named as the skeleton's landmarks. None for sensors
                only, in joint space.
            bone_imus: any subset of the sensors, at any times; several sequences where sensors have their own times.
                None for vision only.
            contact_points: of standing feet, one row per frame; in joint space.
            confidence: whether to compute covariances of the poses, in joint space.
            views: keypoints of further cameras at the frames' times, in joint space.
            observed: observations of the solver's `terms` by name, one per frame.

        Raises:
            InvalidInputError: times differ or are uneven, or a pose is not finite. ViewError: the person
                is behind the camera. UnknownNameError: joints or sensors of another skeleton.
            SolverError: there is nothing to solve with, or the space cannot use it.
        """
        guess, bone_imus = self._guess(start, keypoints, bone_imus, contact_points, views)
        run = self._solver.run(
            guess, keypoints, bone_imus, contact_points, progress, confidence=confidence, views=views, observed=observed
        )
        blocks = list(run)
        whole = replace(
            guess.poses,
            p_world_joint=np.concatenate([block.p_world_joint for block in blocks]),
            R_world_bone=np.concatenate([block.R_world_bone for block in blocks]),
        )
        confidences = [block.confidence for block in blocks if block.confidence is not None]
        return FragmentSolution(
            self._solver.oriented(whole, keypoints, bone_imus, views),
            tuple(report for block in blocks for report in block.fragments),
            joined(confidences) if confidences else None,
            _spread(blocks),
        )

    def _guess(
        self,
        start: PoseSequence | InitialGuess,
        keypoints: KeypointSequence | None,
        bone_imus: BoneImuSequence | Sequence[BoneImuSequence] | None,
        contact_points: ContactPoints | None,
        views: Sequence[KeypointSequence] = (),
    ) -> tuple[InitialGuess, BoneImuSequence | None]:
        """The initial guess, made where only poses are given, and the sensors as one sequence."""
        poses = start.poses if isinstance(start, InitialGuess) else start
        if bone_imus is not None and not isinstance(bone_imus, BoneImuSequence):
            bone_imus = BoneImuSequence.joined(bone_imus, poses.times)
        self._check(poses, keypoints, bone_imus, contact_points)
        if views and (keypoints is None or self.space == "cartesian"):
            raise SolverError("several cameras are used in space 'joint' only; leave out the views, or use that space")
        for i, view in enumerate(views):
            if not np.array_equal(poses.times, view.times):
                raise InvalidInputError(f"start and view {i + 1}: must have the same times")
            _check_before(view, poses, f"of view {i + 1} ")
        if isinstance(start, InitialGuess):
            return start, bone_imus
        bridging = bone_imus if self.space == "joint" else None  # positions alone are not bridged
        refit = self.settings.refit_root
        guess = initial_guess(start, keypoints, bridging, self.skeleton, refit_root=refit, views=views)
        return guess, bone_imus

    def _check(
        self,
        start: PoseSequence,
        keypoints: KeypointSequence | None,
        bone_imus: BoneImuSequence | None,
        contact_points: ContactPoints | None,
    ) -> None:
        self.skeleton.check_joints(start.names, "start")
        if keypoints is None and bone_imus is None:
            raise SolverError("neither keypoints nor bone_imus: give at least one of the two")
        if keypoints is not None and not np.array_equal(start.times, keypoints.times):
            raise InvalidInputError("start and keypoints: must have the same times, one sample per frame")
        if contact_points is not None and len(contact_points) != len(start):
            raise InvalidInputError(f"contact points: {len(contact_points)} frames, but start has {len(start)}")
        finite = np.isfinite(start.p_world_joint).all(axis=(1, 2))
        if self.space == "joint":
            finite &= np.isfinite(start.R_world_bone).all(axis=(1, 2, 3))
        if not finite.all():
            frame = int(np.argmin(finite))
            raise InvalidInputError(f"start: the pose of frame {frame} is not finite; bridge gaps first")
        if len(start) > 1 and np.any(np.abs(np.diff(start.times) * start.rate_hz - 1) > 0.1):
            raise InvalidInputError("start: frames are not evenly spaced; resample the keypoints first")
        if bone_imus is not None:
            unknown = [j for j in bone_imus.joints if j not in self.sensor_joints]
            if unknown:
                raise UnknownNameError("IMU segment", unknown, self.sensor_joints)
        if keypoints is not None:
            _check_before(keypoints, start)


def _spread(blocks: Sequence[Block]) -> Confidence | None:
    """Covariances of what is unseen, zero in blocks without any; None for none at all."""
    if all(block.spread is None for block in blocks):
        return None
    return joined([block.spread or block.confidence.scaled(0.0) for block in blocks if block.confidence is not None])


def _check_before(keypoints: KeypointSequence, start: PoseSequence, whose: str = "") -> None:
    """Raise where the person is not before a camera."""
    depth = keypoints.camera.to_camera(start.p_world_joint)[..., 2]
    if np.any(depth < 0.05):
        frame = int(np.argwhere(depth < 0.05)[0][0])
        raise ViewError(
            f"start: frame {frame} is behind the camera {whose}or in it; check R_camera_world, "
            "t_camera_world (world to camera, metres) and the world's z axis"
        )

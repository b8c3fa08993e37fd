"""`FragmentSolver`: temporal optimisation in overlapping fragments of N frames.

Fragments begin every N/2 frames, so every frame is solved twice; the two answers are blended. Two spaces
of variables are offered: the configuration of the skeleton (``joint``, the default: rigid bones, whole
orientations, limits) and the paper's joint positions (``cartesian``). Two equal calls give equal answers.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from rtof_kin.body.pose_prior import has_prior
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.choices import SPACES
from rtof_kin.core.errors import ShapeError, SolverError, UnknownNameError, ViewError
from rtof_kin.data.confidence import joined
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.inertial.contacts import Footholds
from rtof_kin.solve.cartesian.settings import CartesianSettings
from rtof_kin.solve.cartesian.solver import CartesianSolver
from rtof_kin.solve.joint_space.initial_guess import InitialGuess, initial_guess
from rtof_kin.solve.joint_space.settings import JointSpaceSettings
from rtof_kin.solve.joint_space.solver import JointSpaceSolver
from rtof_kin.solve.solution import FragmentReport, FragmentSolution, SolverStatus

__all__ = ["FragmentReport", "FragmentSolution", "FragmentSolver", "SolverStatus"]

Progress = Callable[[int, int], None]
"""Called with (fragments done, fragments in all)."""


def usual_space(skeleton: SkeletonModel) -> str:
    """The space of a skeleton for which nobody names one: joint space needs a pose prior."""
    return "joint" if has_prior(skeleton.name) else "cartesian"


class FragmentSolver:
    """Optimises pose sequences of one skeleton with keypoints and any subset of its sensors."""

    def __init__(
        self,
        skeleton: SkeletonModel,
        frames: int = 50,
        settings: CartesianSettings | JointSpaceSettings | None = None,
        sensor_joints: tuple[str, ...] | None = None,
        space: str | None = None,
    ) -> None:
        """Choose the problem.

        Args:
            skeleton: gives the joints, the bone lengths and the limits.
            frames: N, even, at least 8.
            settings: what the observations are worth; `JointSpaceSettings` or, for Cartesian space,
                `CartesianSettings`.
            sensor_joints: segments whose sensors the problem has a place for, of which a recording may
                have any subset: in joint space all subsets take the same compiled code. Where not given,
                every segment that usually carries one, in joint space those that say anything.
            space: one of `SPACES`; where not given, that of the settings, else 'joint' for a skeleton
                that a pose prior is shipped for and 'cartesian' for others (Human3.6M's).

        Raises:
            ShapeError: N is odd or too small; settings of the other space; joint space without a pose
                prior. UnknownNameError: a segment or a space that does not exist.
        """
        if frames < 8 or frames % 2:
            raise ShapeError(f"frames: N = {frames} must be even and at least 8")
        kinds = {"joint": JointSpaceSettings, "cartesian": CartesianSettings}
        if space is None:
            usual = usual_space(skeleton)
            space = next((s for s in SPACES if isinstance(settings, kinds[s])), usual)
        if space not in SPACES:
            raise UnknownNameError("space", [space], SPACES)
        if space == "joint" and not has_prior(skeleton.name):
            raise ShapeError(
                f"space 'joint': no pose prior is shipped for {skeleton.name!r}; use 'cartesian'"
            )
        settings = settings or kinds[space]()
        self.skeleton, self.frames, self.space, self.settings = skeleton, frames, space, settings
        carriers = tuple(joint for joint, _ in skeleton.sensors.values())
        self.sensor_joints = carriers if sensor_joints is None else tuple(sensor_joints)
        skeleton.index(*self.sensor_joints)
        self._solver: CartesianSolver | JointSpaceSolver
        if space == "joint" and isinstance(settings, JointSpaceSettings):
            self._solver = JointSpaceSolver(skeleton, frames, settings, tuple(sensor_joints or ()))
        elif space == "cartesian" and isinstance(settings, CartesianSettings):
            self._solver = CartesianSolver(skeleton, frames, settings, self.sensor_joints)
        else:
            raise ShapeError(f"settings: {type(settings).__name__} are not those of space {space!r}")

    def solve(
        self,
        start: PoseSequence | InitialGuess,
        keypoints: KeypointSequence | None,
        bone_imus: BoneImuSequence | Sequence[BoneImuSequence] | None = None,
        progress: Progress | None = None,
        footholds: Footholds | None = None,
        confidence: bool = False,
    ) -> FragmentSolution:
        """Optimise a whole sequence: RTOF with sensors, RTO without, sensors alone without keypoints.

        Args:
            start: finite poses of this skeleton, usually SF2's, or an initial guess made from them; also
                the centre of weak priors.
            keypoints: one sample a frame of `start`, landmarks named like joints (in joint space also
                the skeleton's other landmarks); NaN where unseen. None for sensors alone, in joint space.
            bone_imus: any subset of the sensors, at any times; several sequences where sensors have
                times of their own. None for vision alone.
            progress: told after every fragment.
            footholds: where feet stand still, one row a frame of `start`; in joint space.
            confidence: whether to tell how well the poses are known; in Cartesian space nobody does.

        Returns:
            The poses and a report for each fragment.

        Raises:
            ShapeError: start and keypoints differ in their times, a pose is not finite, or the person
                is behind the camera. UnknownNameError: joints or sensors of another skeleton.
            SolverError: none of the landmarks is known; there are neither keypoints nor sensors; it is
                the joint space alone that can do with what is given.
        """
        guess, bone_imus = self._guess(start, keypoints, bone_imus, footholds)
        blocks = list(
            self._solver.run(guess, keypoints, bone_imus, footholds, progress, confidence=confidence)
        )
        whole = replace(
            guess.poses,
            p_world_joint=np.concatenate([block.p_world_joint for block in blocks]),
            R_world_bone=np.concatenate([block.R_world_bone for block in blocks]),
        )
        told = [block.confidence for block in blocks if block.confidence is not None]
        return FragmentSolution(
            self._solver.oriented(whole, keypoints, bone_imus),
            tuple(report for block in blocks for report in block.fragments),
            joined(told) if told else None,
        )

    def stream(
        self,
        start: PoseSequence | InitialGuess,
        keypoints: KeypointSequence,
        bone_imus: BoneImuSequence | Sequence[BoneImuSequence] | None = None,
    ) -> Iterator[PoseSequence]:
        """The poses of `solve`, N/2 frames at a time, each as soon as nothing to come can change it."""
        guess, bone_imus = self._guess(start, keypoints, bone_imus, None)
        for block in self._solver.run(guess, keypoints, bone_imus, None, None):
            p, R = block.p_world_joint, block.R_world_bone
            poses = replace(guess.poses[block.frames], p_world_joint=p, R_world_bone=R)
            yield self._solver.oriented(poses, keypoints[block.frames], bone_imus)

    def _guess(
        self, start: PoseSequence | InitialGuess, keypoints: KeypointSequence | None,
        bone_imus: BoneImuSequence | Sequence[BoneImuSequence] | None, footholds: Footholds | None,
    ) -> tuple[InitialGuess, BoneImuSequence | None]:  # fmt: skip
        """The initial guess, made where only poses are given, and the sensors as one sequence."""
        poses = start.poses if isinstance(start, InitialGuess) else start
        if bone_imus is not None and not isinstance(bone_imus, BoneImuSequence):
            bone_imus = BoneImuSequence.joined(bone_imus, poses.times)
        self._check(poses, keypoints, bone_imus, footholds)
        if isinstance(start, InitialGuess):
            return start, bone_imus
        bridging = bone_imus if self.space == "joint" else None  # positions alone are not bridged
        refit = self.settings.refit_root
        return initial_guess(start, keypoints, bridging, self.skeleton, refit_root=refit), bone_imus

    def _check(
        self, start: PoseSequence, keypoints: KeypointSequence | None,
        bone_imus: BoneImuSequence | None, footholds: Footholds | None,
    ) -> None:  # fmt: skip
        self.skeleton.check_joints(start.names, "start")
        if keypoints is None and bone_imus is None:
            raise SolverError("neither keypoints nor bone_imus: give at least one of the two")
        if keypoints is not None and not np.array_equal(start.times, keypoints.times):
            raise ShapeError("start and keypoints: must have the same times, one sample a frame")
        if footholds is not None and len(footholds) != len(start):
            raise ShapeError(f"footholds: {len(footholds)} frames, but start has {len(start)}")
        finite = np.isfinite(start.p_world_joint).all(axis=(1, 2))
        if self.space == "joint":  # the paper's positions have no use for orientations
            finite &= np.isfinite(start.R_world_bone).all(axis=(1, 2, 3))
        if not finite.all():
            frame = int(np.argmin(finite))
            raise ShapeError(f"start: the pose of frame {frame} is not finite; bridge gaps first")
        if len(start) > 1:
            steps = np.diff(start.times) * start.rate_hz
            if np.any(np.abs(steps - 1) > 0.1):
                raise ShapeError("start: frames are not evenly spaced; resample the keypoints first")
        if bone_imus is not None:
            unknown = [j for j in bone_imus.joints if j not in self.sensor_joints]
            if unknown:
                raise UnknownNameError("IMU segment", unknown, self.sensor_joints)
        if keypoints is None:
            return
        depth = keypoints.camera.to_camera(start.p_world_joint)[..., 2]
        if np.any(depth < 0.05):
            frame = int(np.argwhere(depth < 0.05)[0][0])
            raise ViewError(
                f"start: frame {frame} is behind the camera or in it; check R_camera_world, "
                "t_camera_world (world to camera, metres) and the world's z axis"
            )

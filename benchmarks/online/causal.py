"""The baseline without memory but the lifter's: the newest lift of every frame, corrected by the sensors."""

from __future__ import annotations

from typing import Any

import numpy as np

from lifting.predict import LiftedPoses, Lifter
from lifting.streaming import StreamedPose, StreamingLifter
from rtof_kin.core.array_types import Array
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.reconstruction.settings import ReconstructionSettings
from rtof_kin.recording.recording import Recording


class NewestLift:
    """A lifter that sees nothing of what follows a frame."""

    def __init__(self) -> None:
        self._lifter = Lifter.load("live")
        self.name = f"{self._lifter.name}, newest frames"

    def predict(
        self,
        keypoints: KeypointSequence,
        joint_offsets: Array | None = None,
        *,
        bone_imus: BoneImuSequence | None = None,
        floor_height: float | None = None,
    ) -> LiftedPoses:
        """Poses of every frame from the frames up to it; without one, those of the frame before."""
        stream = StreamingLifter(self._lifter, keypoints.camera, joint_offsets, floor_height, names=keypoints.names)
        found: list[StreamedPose | None] = []
        for t, time in enumerate(keypoints.times.tolist()):
            sensed = {} if bone_imus is None else dict(zip(bone_imus.joints, bone_imus.R_world_bone[t], strict=True))
            found += stream.push(time, keypoints.uv_px[t], keypoints.confidence[t], sensed)
        return _joined(found, keypoints.times, self._lifter.names)


def _joined(found: list[StreamedPose | None], times: Array, names: tuple[str, ...]) -> LiftedPoses:
    """Poses of all frames; a frame without one has the positions of the last one, or of the first."""
    seen = np.array([pose is not None for pose in found])
    known = [pose for pose in found if pose is not None]
    index = np.maximum(np.cumsum(seen) - 1, 0)
    arrays: dict[str, Any] = {
        name: np.array([getattr(pose, name) for pose in known])[index]
        for name in ("p_world_joint", "sigma_m", "R_world_bone", "sigma_rad")
    }
    for name in ("sigma_m", "R_world_bone", "sigma_rad"):
        arrays[name][~seen] = np.nan
    return LiftedPoses(times=times, seen=seen, names=names, **arrays)


def causal_sf2(recording: Recording) -> PoseSequence:
    """SF2 of the newest lifts: nothing but the past, and no memory but the lifter's."""
    settings = ReconstructionSettings(guards=(), confidence=False)
    return reconstruct(recording, mode="sf2", lifter=NewestLift(), settings=settings).stages["sf2"]

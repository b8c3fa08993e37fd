"""What is open when a recording is calibrated from itself, and how well it is known before."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Self

import numpy as np

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.errors import ShapeError
from rtof_kin.recording.recording import Recording


@dataclass(frozen=True)
class CalibrationPriors:
    """How well things are known before: a standard deviation each; None for what is known exactly, and
    so is not estimated.
    """

    sigma_delay: float | None = 0.05
    """[s] of the video behind the sensors."""
    sigma_clock_drift: float | None = None
    """[s/s] by which their clocks differ."""
    sigma_swing: float | None = np.radians(2.0)
    """[rad] of a sensor's mounting, about axes across its bone."""
    sigma_twist: float = np.radians(4.0)
    """[rad] about the bone."""
    sigma_heading: float | None = None
    """[rad] of each sensor's reference about the vertical."""
    sigma_heading_drift: float | None = None
    """[rad/s] by which that changes."""
    sigma_lever_arm: float | None = None
    """[m] per axis."""
    sigma_size: float | None = None
    """[1] of the skeleton as a whole."""
    sigma_proportion: float | None = None
    """[1] of each group of bones beside that."""
    sigma_image_bias: float | None = 6.0
    """[px] per axis, of each landmark, constant in the image; for a person 500 px tall."""
    sigma_place: float | None = None
    """[m] per axis, of each landmark in its segment."""
    sigma_focal: float | None = None
    """[1] of the focal length."""
    sigma_tilt: float | None = None
    """[rad] of the camera's orientation about each axis."""
    sigma_ankle_height: float | None = 0.02
    """[m] of ankles over the floor that they stand on; only where there is one."""
    lasting_seconds: float = 6.0
    """[s] of a recording that all of it counts for where it is longer: errors that last, of landmarks,
    sensors and poses alike, do not average out however long it is."""
    worth_vision: float = 1.0
    """[1] What landmarks count here, as a share of what they count in a reconstruction."""
    worth_sensors: float = 1.0
    """[1] The same of the sensors' orientations."""
    worth_poses: float = 0.1
    """[1] The same of the prior of poses and of the start's torso: postures last for seconds."""
    overcount: float = 3.0
    """[1] By how much errors that last make the recording's information count for too much: claimed
    standard deviations allow for it."""
    most_seconds: float = 60.0
    """[s] of the recording that is looked at, in fragments all over it."""
    rounds: int = 5
    """Gauss-Newton steps at most."""

    def __post_init__(self) -> None:
        for entry in fields(self):
            value = getattr(self, entry.name)
            if value is None and entry.name.startswith("sigma_"):
                continue
            if not isinstance(value, int | float | np.number) or not 0 < value < np.inf:
                raise ShapeError(
                    f"{entry.name} is {value}: give a positive, finite number"
                    + ("; None leaves out what is known" if entry.name.startswith("sigma_") else "")
                )

    @classmethod
    def of(cls, recording: Recording) -> Self:
        """What is usually unknown of such a recording: bones only where nobody measured them."""
        usual, told = SkeletonModel.named(recording.skeleton_table), recording.height
        if told is not None:
            usual = usual.with_height(told)
        if recording.bone_lengths or not np.allclose(recording.joint_offsets, usual.joint_offsets):
            return cls()
        return replace(cls(), sigma_size=0.05 if told is None else 0.02, sigma_proportion=0.03)

"""Settings of a reconstruction: one record for all stages."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Self

from rtof_kin.core.choices import GUARDS, SPACES, Guard, Space
from rtof_kin.core.errors import InvalidInputError, UnknownNameError
from rtof_kin.solve.settings import CartesianSettings, JointSpaceSettings

if TYPE_CHECKING:
    from rtof_kin.body.skeleton import SkeletonModel


@dataclass(frozen=True)
class ReconstructionSettings:
    """Settings of all stages."""

    lift_with_sensors: bool = True
    """Give the lifter the sensors' orientations in the modes that use sensors, if its network takes them."""
    fragment: JointSpaceSettings | CartesianSettings | None = None
    """Settings of the fragment solver; their type gives the space. Default: those of `space`."""
    space: Space | None = None
    """Variables of the fragment solver: configurations of the skeleton, or joint positions (the paper's); default:
    joint, where a pose prior is shipped for the skeleton."""
    frames: int = 50  #: Frames of a fragment, N
    guards: tuple[Guard, ...] = GUARDS
    """Which outliers of keypoints and sensors are rejected, see `Reconstruction.faults`; none: no rejection."""
    confidence: bool = True  #: Compute pose covariances (`Motion.confidence`) in modes rto and rtof in joint space
    checks: bool = True  #: Check what the recording declares (`Reconstruction.checks`)
    certificate: bool = False
    """Predict each sensor from all the rest and compare with what it measured (`Reconstruction.certificate`); of
    recordings over 15 s in the liveliest 15 s. Takes about as long as reconstructing 30 s."""
    sensor_joints: tuple[str, ...] = ()
    """Segments for which the compiled problem has room for a sensor, besides those of the recording:
    recordings with any subset of them share one compilation."""

    def __post_init__(self) -> None:
        if self.fragment is not None and self.space is not None:
            raise InvalidInputError("settings: give the space, or the settings of a fragment, not both")
        if self.space is not None and self.space not in SPACES:
            raise UnknownNameError("space", [self.space], SPACES)
        if self.frames < 8 or self.frames % 2:
            raise InvalidInputError(f"frames: N = {self.frames} must be even and at least 8")
        if unknown := sorted({*self.guards} - {*GUARDS}):
            raise UnknownNameError("guard", unknown, GUARDS)

    def solver(self, skeleton: SkeletonModel) -> JointSpaceSettings | CartesianSettings:
        """Return the settings of the fragment solver: those given, else the defaults of the space."""
        if self.fragment is not None:
            return self.fragment
        from rtof_kin.solve.fragment_solver import usual_space

        return JointSpaceSettings() if (self.space or usual_space(skeleton)) == "joint" else CartesianSettings()

    def with_fragment(self, fragment: JointSpaceSettings | CartesianSettings | None) -> Self:
        """Return the same settings with others of the fragment solver, or its defaults for None."""
        return replace(self, fragment=fragment, space=None)

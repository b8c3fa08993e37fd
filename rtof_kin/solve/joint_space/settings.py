"""Settings of the joint-space fragment solver: a standard deviation with its unit for every residual."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from rtof_kin.core.errors import ShapeError


@dataclass(frozen=True)
class JointSpaceSettings:
    """What each observation is worth, and how fragments are solved.

    The energy is the negative logarithm of a posterior: half the sum of squared residuals, each divided
    by its standard deviation, with a robust loss where outliers come.
    """

    sigma_reprojection: float | None = None
    """[px] per axis. None: estimated in every fragment from the residuals, their correlation in time
    included."""
    sigma_reprojection_range: tuple[float, float] = (0.5, 25.0)
    """[px] that the estimate is kept in."""
    largest_correlation_factor: float = 2.2
    """By how much errors that stay for long are counted as larger than they are."""
    robust_reprojection: float = 2.0
    """[1] where the loss of a landmark turns from square to linear, in sizes of a usual residual: sigma
    without what correlation in time adds."""
    sigma_swing: float = np.radians(5.0)
    """[rad] of a sensor's segment about axes across its bone."""
    sigma_twist: float = np.radians(20.0)
    """[rad] about the bone, where soft tissue rolls."""
    robust_orientation: float = 3.0
    """[sigma] where the loss of an orientation turns from square to linear."""
    sigma_acceleration: float = 2.0
    """[m/s^2] of a sensor."""
    acceleration_cutoff_hz: float | None = 12.0
    """[Hz] low-pass of the sensors' accelerations, both ways: what is faster is soft tissue and noise,
    which the motion would follow. None takes them as they are."""
    robust_acceleration: float = 2.0
    """[sigma] where the loss of an acceleration turns from square to linear."""
    jerk: float = 2.5
    """[1] factor on the jerk of free motion (`PosePrior`), the standard deviation of the jerk's."""
    jerk_without_sensors: float = 1.0
    """[1] the same of limbs that carry no sensor, and of all where there is none: vision alone knows
    little of what is fast."""
    prior_inflation: float = 1.7
    """[1] factor on the standard deviations of the pose prior: frames are not independent."""
    sigma_prior_least: float = np.radians(3.0)
    """[rad] added (in squares) to each of the prior's."""
    sigma_torso: float | None = np.radians(18.0)
    """[rad] of pelvis and upper trunk about the start's orientation, with a Cauchy loss; only where no
    sensor sits on them, and the start does not tell how certain it is. None leaves the anchor out."""
    torso_inflation: float = 2.0
    """[1] factor on the start's own standard deviations of them: a lifter's errors last for seconds."""
    sigma_bone: float | None = 0.05
    """[m] of the end of a limb's bone about where the start has it, with a Cauchy loss; only of limbs
    that carry no sensor: with one, its acceleration and the prior know better. None leaves it out."""
    sigma_root: float | None = 0.15
    """[m] of the root about the start's position, with a Cauchy loss; only where no limb has a sensor on
    each of its two bones, from whose accelerations the root's path is known better, or where there is no
    landmark, which would say where it is; twice as far where landmarks and other sensors tell of it too.
    None leaves it out."""
    floor_height: float | None = None
    """[m] of a flat floor in world; None where there is none or it is not known."""
    ankle_height: float = 0.08
    """[m] of the ankle over the floor it stands on."""
    sigma_floor: float = 0.1
    """[m] of an ankle that stands, in one frame: how high it is over the floor differs by some cm from
    body to body and from shoe to shoe, for as long as it stands."""
    floor_cutoff: float = 0.1
    """[m] above or below which an ankle hardly feels the floor."""
    sigma_contact: float = 0.02
    """[m] of a foot's joint about its foothold, where footholds are given."""
    hinges: bool = True
    """Whether knees and elbows turn about one axis alone."""
    limits: bool = True
    """Whether hinges keep the skeleton's anatomical limits (`limits`)."""
    refit_root: bool = True
    """Whether the start's root is moved onto the rays (`inertial.root_position.refit_root`) first."""
    smooth_start_hz: float = 6.0
    """[Hz] low-pass of the starting poses: a lifter's jitter is no start."""
    torso_yaws: tuple[float, ...] = ()
    """[rad] Further starts with the trunk turned about the vertical by these; the lowest energy wins."""
    annealing: int = 6
    """How often the reprojection sigma may be estimated anew; it is fixed after them."""
    max_iterations: int = 60
    """Iterations after the annealing."""
    tolerance: float = 1e-4
    """[1] The fragment is solved when a step would lower the energy by less than this share."""
    backend: str = "realtime"
    """'realtime' (Levenberg-Marquardt on the banded system) or 'ipopt'."""
    compile: str = "auto"
    """'auto' compiles the energy once where there is a C compiler and keeps it; 'never' interprets."""

    @classmethod
    def calibrated(cls) -> Self:
        """For a recording that was calibrated from itself: of the sensors' errors slip and wobble are
        left, without a mounting that is wrong all through. Orientations then tell quick motion, so
        accelerations and the jerk of free motion are worth less.
        """
        return cls(
            sigma_swing=np.radians(2.0), sigma_twist=np.radians(12.0), sigma_acceleration=2.5, jerk=3.0
        )

    def __post_init__(self) -> None:
        for field, values in {"backend": ("realtime", "ipopt"), "compile": ("auto", "never")}.items():
            if getattr(self, field) not in values:
                raise ShapeError(f"{field}: {getattr(self, field)!r} is none of {', '.join(values)}")
        low, high = self.sigma_reprojection_range
        if not 0 < low <= high < np.inf:
            raise ShapeError("sigma_reprojection_range must be positive, the smaller one first")
        optional = (
            "sigma_reprojection", "sigma_torso", "sigma_bone", "sigma_root", "acceleration_cutoff_hz",
        )  # fmt: skip
        object.__setattr__(self, "sigma_reprojection_range", (float(low), float(high)))
        object.__setattr__(self, "torso_yaws", tuple(float(yaw) for yaw in self.torso_yaws))
        positive = [name for name in vars(self) if name.startswith(("sigma_", "robust_"))]
        positive += [
            "torso_inflation", "jerk", "jerk_without_sensors", "prior_inflation", "floor_cutoff",
            "smooth_start_hz", "tolerance", "ankle_height", "largest_correlation_factor",
            "acceleration_cutoff_hz",
        ]  # fmt: skip
        for field in positive:
            value = getattr(self, field)
            if isinstance(value, tuple) or (value is None and field in optional):
                continue
            if not isinstance(value, int | float | np.number) or not 0 < value < np.inf:
                raise ShapeError(f"{field} must be positive and finite")
        if self.floor_height is not None and not np.isfinite(self.floor_height):
            raise ShapeError("floor_height must be finite, or None where there is no floor")
        if self.largest_correlation_factor < 1:
            raise ShapeError("largest_correlation_factor must be at least 1")
        for field in ("annealing", "max_iterations"):
            value = getattr(self, field)
            if not isinstance(value, int | np.integer) or value < 0:
                raise ShapeError(f"{field} must be a whole number, not negative")

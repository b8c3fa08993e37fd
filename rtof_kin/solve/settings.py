"""Settings of the Cartesian fragment solver: a weight or a standard deviation with its unit each."""

from __future__ import annotations

import math
from dataclasses import dataclass
from numbers import Integral, Real
from typing import Final, get_args

from rtof_kin.core.choices import Compile
from rtof_kin.core.errors import InvalidInputError

_OPTIONAL: Final = ("sigma_reprojection", "sigma_torso", "sigma_bone", "sigma_root", "acceleration_cutoff_hz")
"""Fields that may be None."""
_POSITIVE: Final = (
    "torso_inflation",
    "jerk",
    "jerk_without_sensors",
    "prior_inflation",
    "floor_cutoff",
    "smooth_start_hz",
    "tolerance",
    "ankle_height",
    "largest_correlation_factor",
    "acceleration_cutoff_hz",
)
"""Fields that are positive and finite, with those that begin with sigma_ or robust_."""


@dataclass(frozen=True)
class JointSpaceSettings:
    """Standard deviations of the residuals, and how fragments are solved.

    The energy is the negative logarithm of a posterior: half the sum of squared residuals, each divided by its standard
    deviation, with a robust loss where outliers occur.
    """

    sigma_reprojection: float | None = None
    """[px] per axis. None: estimated in every fragment from the residuals and their autocorrelation."""
    sigma_reprojection_range: tuple[float, float] = (0.5, 25.0)  #: [px] Bounds of the estimate
    largest_correlation_factor: float = 2.2  #: [1] Largest factor on sigma for errors that are correlated in time
    robust_reprojection: float = 2.0
    """[1] Residual where the loss of a landmark turns from square to linear, in units of sigma without the correlation
    factor."""
    sigma_swing: float = math.radians(5.0)  #: [rad] of a sensor's segment about axes across its bone
    sigma_twist: float = math.radians(20.0)  #: [rad] about the bone, where soft tissue rolls
    robust_orientation: float = 3.0  #: [sigma] where the loss of an orientation turns from square to linear
    sigma_acceleration: float = 2.0  #: [m/s^2] of a sensor
    acceleration_cutoff_hz: float | None = 12.0
    """[Hz] Zero-phase low-pass of the sensors' accelerations against soft tissue and noise. None: none."""
    robust_acceleration: float = 2.0  #: [sigma] where the loss of an acceleration turns from square to linear
    jerk: float = 2.5  #: [1] Factor on the standard deviation of the jerk of free motion (`PosePrior`)
    jerk_without_sensors: float = 1.0
    """[1] The same for limbs without a sensor, and for all joints where there are no sensors."""
    prior_inflation: float = 1.7  #: [1] Factor on the standard deviations of the pose prior: frames are not independent
    sigma_prior_least: float = math.radians(3.0)  #: [rad] added in squares to each standard deviation of the prior
    sigma_torso: float | None = math.radians(18.0)
    """[rad] of pelvis, upper trunk, neck and clavicles about the initial guess, with a Cauchy loss; only without a
    sensor on them, and where the initial guess has no standard deviation of its own. None: no anchor."""
    torso_inflation: float = 2.0
    """[1] Factor on the initial guess's own standard deviations: a lifter's errors are autocorrelated."""
    sigma_bone: float | None = 0.05
    """[m] of the end of a limb's bone about the initial guess, with a Cauchy loss; only for limbs without a sensor.
    None: no anchor."""
    sigma_root: float | None = 0.15
    """[m] of the root about the initial guess, with a Cauchy loss; not where landmarks are observed and a limb has a
    sensor on each of its two bones; doubled with landmarks and other sensors. None: none."""
    floor_height: float | None = None  #: [m] of a flat floor in world; None: no floor
    ankle_height: float = 0.08  #: [m] of the ankle over the floor it stands on
    sigma_floor: float = 0.1  #: [m] of a standing ankle in one frame; bodies and shoes differ by some cm
    floor_cutoff: float = 0.1  #: [m] Scale of the Cauchy loss of an ankle's height
    sigma_contact: float = 0.02  #: [m] of a foot's joint about its contact point, where contact points are given
    hinges: bool = True  #: Whether knees and elbows turn about one axis only
    limits: bool = True  #: Whether hinges keep the skeleton's anatomical limits (`joint_space.state.Limits`)
    refit_root: bool = True
    """Whether the root of the initial guess is moved onto its rays (`inertial.initial_poses.refit_root`)."""
    smooth_start_hz: float = 6.0  #: [Hz] Low-pass cutoff of the initial guess
    annealing: int = 6  #: How often the reprojection sigma is estimated again before it is fixed
    max_iterations: int = 60  #: Iterations after the annealing
    tolerance: float = 1e-4  #: [1] Relative decrease of the energy below which a fragment is solved
    compile: Compile = "auto"
    """'auto': compile the energy where a C compiler exists and cache it. 'never': interpret it."""

    def __post_init__(self) -> None:
        if self.compile not in get_args(Compile):
            raise InvalidInputError(f"compile: {self.compile!r} is none of {', '.join(get_args(Compile))}")
        _check_range(self)
        sigmas = [name for name in vars(self) if name.startswith(("sigma_", "robust_"))]
        for field in (*sigmas, *_POSITIVE):
            value = getattr(self, field)
            if isinstance(value, tuple) or (value is None and field in _OPTIONAL):
                continue
            if not isinstance(value, Real) or not 0 < float(value) < math.inf:
                raise InvalidInputError(f"{field} must be positive and finite")
        if self.floor_height is not None and not math.isfinite(self.floor_height):
            raise InvalidInputError("floor_height must be finite, or None where there is no floor")
        if self.largest_correlation_factor < 1:
            raise InvalidInputError("largest_correlation_factor must be at least 1")
        for field in ("annealing", "max_iterations"):
            value = getattr(self, field)
            if not isinstance(value, Integral) or value < 0:
                raise InvalidInputError(f"{field} must be a whole number, not negative")


@dataclass(frozen=True)
class CartesianSettings:
    """Weights and standard deviations of the Cartesian energy.

    The printed energy has no minimiser: the depth of unobserved joints is free, and everything shrinks towards the
    camera. Two terms are added: `sigma_length` ties the points of every rigid segment to each other, and `sigma_prior`
    is a weak prior about the initial guess (SF2).
    """

    as_printed: bool = False
    """The paper's energy and fragments, see `paper`: smoothness about the differentiated acceleration of joints with a
    sensor (which adds differentiated noise) instead of zero; a prior of every position instead of root and bone
    vectors; free lengths; fragments padded by copies instead of frames without observations, and averaged instead of
    blended by tapered weights."""
    k_V: float = 0.67
    """Weight of the visual term. The default of each k is the term's number of residuals over the prior's, so that E is
    the negative log posterior; `paper` has the paper's weights."""
    k_I: float = 1.0  #: Weight of the inertial terms together
    k_A: float = 0.37  #: Weight of acceleration within them
    k_B: float = 0.38  #: Weight of bone vectors within them
    k_S: float = 0.94  #: Weight of smoothness within them
    sigma_reprojection: float | None = None
    """[px] None: a fragment is solved with `sigma_reprojection_first`, then again with twice the size of its residuals
    (a detector's errors are autocorrelated)."""
    sigma_reprojection_first: float = 10.0  #: [px] of the first of the two
    sigma_reprojection_range: tuple[float, float] = (2.0, 20.0)  #: [px] Bounds of the estimate
    huber_reprojection: float | None = 2.0
    """[sigma] where the visual loss turns from square to linear; None: squares, as in the paper."""
    sigma_acceleration: float = 1.0  #: [m/s^2]
    sigma_bone: float = 0.04  #: [m] of a bone's end, from an orientation error of 5-10 degrees
    sigma_jerk: float = 120.0  #: [m/s^3]
    sigma_length: float = 0.005  #: [m] of the distance of two points of a rigid segment; not in the energy as printed
    sigma_prior: float = 0.3  #: [m] of the root, or of every position
    sigma_prior_bone: float = 0.04  #: [m] of a bone vector
    refit_root: bool = True
    """Whether the root of the initial guess is moved onto its rays (`inertial.initial_poses.refit_root`)."""
    ipopt: bool = False
    """Whether IPOPT solves the fragments, as in the paper: the same minima in several times the time."""
    tolerance: float = 1e-6
    """Of the gradient, IPOPT's; a thousandth of it is the relative decrease of the energy below which the package's own
    solver has solved a fragment."""
    max_iterations: int = 200

    def __post_init__(self) -> None:
        _check_range(self)
        for field, value in vars(self).items():
            if field.startswith("sigma_") and isinstance(value, int | float) and not value > 0:
                raise InvalidInputError(f"{field} must be positive; leave a term out by its weight k")
            if field.startswith("k_") and not 0 <= value < math.inf:
                raise InvalidInputError(f"{field} must not be negative, and finite")
        if self.huber_reprojection is not None and not self.huber_reprojection > 0:
            raise InvalidInputError("huber_reprojection must be positive; None stands for plain squares")
        if not (self.tolerance > 0 and self.max_iterations >= 0):
            raise InvalidInputError("tolerance must be positive and max_iterations not negative")

    @classmethod
    def paper(cls) -> CartesianSettings:
        """Return the energy as printed, with the weak prior that gives it a minimiser."""
        return cls(
            k_V=0.9,
            k_I=0.1,
            k_A=0.5,
            k_B=0.2,
            k_S=0.3,
            sigma_reprojection=10.0,
            huber_reprojection=None,
            as_printed=True,
        )

    def term_weights(self) -> dict[str, float]:
        """Return the weight of each term in the total energy."""
        return {
            "visual": self.k_V,
            "acceleration": self.k_I * self.k_A,
            "bone": self.k_I * self.k_B,
            "smooth": self.k_I * self.k_S,
            "length": 0.0 if self.as_printed else 1.0,
            "prior": 1.0,
        }


def _check_range(settings: JointSpaceSettings | CartesianSettings) -> None:
    low, high = settings.sigma_reprojection_range
    if not 0 < low <= high < math.inf:
        raise InvalidInputError("sigma_reprojection_range must be positive, the smaller one first")
    object.__setattr__(settings, "sigma_reprojection_range", (float(low), float(high)))

"""Settings of the Cartesian fragment solver: a weight or a standard deviation with its unit each."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final, Literal, get_args

from rtof_kin.core.choices import BACKENDS, Backend
from rtof_kin.core.errors import InvalidInputError

JerkTarget = Literal["zero", "sensor"]
BoneLengths = Literal["weighted", "constraint", "free"]
PositionPrior = Literal["bones", "positions"]
Blend = Literal["tapered", "average"]
Padding = Literal["masked", "replicate"]
_CHOICES: Final[dict[str, tuple[Any, ...]]] = {
    "backend": BACKENDS,
    "jerk_target": get_args(JerkTarget),
    "bone_lengths": get_args(BoneLengths),
    "prior": get_args(PositionPrior),
    "blend": get_args(Blend),
    "padding": get_args(Padding),
}


@dataclass(frozen=True)
class CartesianSettings:
    """Weights and standard deviations of the Cartesian energy.

    The printed energy has no minimiser: the depth of unobserved joints is free, and everything shrinks
    towards the camera. Two terms are added: `sigma_length` ties the points of every rigid segment to each
    other, and `sigma_prior` is a weak prior about the initial guess (SF2).
    """

    k_V: float = 0.67
    """Weight of the visual term. The default of each k is the term's number of residuals over the
    prior's, so that E is the negative log posterior; `paper` has the paper's weights."""
    k_I: float = 1.0
    """Weight of the inertial terms together."""
    k_A: float = 0.37
    """Weight of acceleration within them."""
    k_B: float = 0.38
    """Weight of bone vectors within them."""
    k_S: float = 0.94
    """Weight of smoothness within them."""
    sigma_reprojection: float | None = None
    """[px] None: a fragment is solved with `sigma_reprojection_first`, then again with twice the size of
    its residuals (a detector's errors are autocorrelated)."""
    sigma_reprojection_first: float = 10.0
    """[px] of the first of the two."""
    sigma_reprojection_range: tuple[float, float] = (2.0, 20.0)
    """[px] Bounds of the estimate."""
    huber_reprojection: float | None = 2.0
    """[sigma] where the visual loss turns from square to linear; None: squares, as in the paper."""
    sigma_acceleration: float = 1.0
    """[m/s^2]"""
    sigma_bone: float = 0.04
    """[m] of a bone's end, from an orientation error of 5-10 degrees."""
    sigma_jerk: float = 120.0
    """[m/s^3]"""
    jerk_target: JerkTarget = "zero"
    """'zero' on all joints, or 'sensor': the differentiated acceleration on joints with a sensor (the
    paper's E_S, which adds differentiated noise)."""
    sigma_length: float = 0.005
    """[m] of `bone_lengths` = 'weighted'."""
    prior: PositionPrior = "bones"
    """'bones': the root and every bone vector have a prior. 'positions': every joint has its own."""
    sigma_prior: float = 0.3
    """[m] of the root, or of every position."""
    sigma_prior_bone: float = 0.04
    """[m] of a bone vector."""
    bone_lengths: BoneLengths = "weighted"
    """'weighted' by sigma_length, 'constraint' (equalities in every fragment; blending changes lengths by
    about a millimetre), or 'free' (as printed)."""
    blend: Blend = "tapered"
    """'tapered' weights of overlapping fragments, or 'average' (the paper's mean)."""
    padding: Padding = "masked"
    """'masked': frames beyond the ends have no observations; 'replicate': the paper's copies."""
    refit_root: bool = True
    """Whether the root of the initial guess is moved onto its rays (`inertial.root_position`)."""
    backend: Backend = "ipopt"
    """'ipopt', or 'realtime' for energies without constraints (Levenberg-Marquardt on a banded Hessian)."""
    tolerance: float = 1e-6
    """IPOPT's tolerance on the scaled gradient; with 'realtime', 1e4 times the relative decrease."""
    max_iterations: int = 60

    def __post_init__(self) -> None:
        for field, values in _CHOICES.items():
            if getattr(self, field) not in values:
                raise InvalidInputError(f"{field}: {getattr(self, field)!r} is none of {', '.join(values)}")
        low, high = self.sigma_reprojection_range
        if not 0 < low <= high:
            raise InvalidInputError("sigma_reprojection_range must be positive, the smaller one first")
        object.__setattr__(self, "sigma_reprojection_range", (float(low), float(high)))
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
    def paper(cls, backend: Backend = "ipopt") -> CartesianSettings:
        """Return the energy as printed, with the weak prior that gives it a minimiser."""
        return cls(
            k_V=0.9,
            k_I=0.1,
            k_A=0.5,
            k_B=0.2,
            k_S=0.3,
            sigma_reprojection=10.0,
            huber_reprojection=None,
            jerk_target="sensor",
            bone_lengths="free",
            prior="positions",
            blend="average",
            padding="replicate",
            backend=backend,
        )

    def term_weights(self) -> dict[str, float]:
        """Return the weight of each term in the total energy."""
        return {
            "visual": self.k_V,
            "acceleration": self.k_I * self.k_A,
            "bone": self.k_I * self.k_B,
            "smooth": self.k_I * self.k_S,
            "length": 1.0 if self.bone_lengths == "weighted" else 0.0,
            "prior": 1.0,
        }

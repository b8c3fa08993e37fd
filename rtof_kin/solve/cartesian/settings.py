"""Settings of the Cartesian fragment solver: a weight or a standard deviation with its unit each."""

from __future__ import annotations

import math
from dataclasses import dataclass

from rtof_kin.core.errors import ShapeError


@dataclass(frozen=True)
class CartesianSettings:
    """Weights and standard deviations of the Cartesian energy, and how fragments are cut.

    The printed energy has no minimiser: the depth of unobserved joints is free, and everything shrinks
    towards the camera. Two terms with names mend that: `sigma_length` ties the points of every rigid
    segment to each other, and `sigma_prior` pulls weakly towards the starting poses (SF2).
    """

    k_V: float = 0.67
    """Weight of the visual term. The defaults of the k are each term's number of residuals over the
    prior's: with means of whitened residuals, that makes E the negative log posterior, so that the
    standard deviations mean what they say. `paper` has the paper's."""
    k_I: float = 1.0
    """Weight of the inertial terms together."""
    k_A: float = 0.37
    """Weight of acceleration within them."""
    k_B: float = 0.38
    """Weight of bone vectors within them."""
    k_S: float = 0.94
    """Weight of smoothness within them."""
    sigma_reprojection: float | None = None
    """[px] None: every fragment is solved with `sigma_reprojection_first`, then once more from there
    with twice the size of its residuals (errors of a detector are correlated in time)."""
    sigma_reprojection_first: float = 10.0
    """[px] of the first of the two."""
    sigma_reprojection_range: tuple[float, float] = (2.0, 20.0)
    """[px] that the estimate is kept in."""
    huber_reprojection: float | None = 2.0
    """[sigma] where the visual loss turns from square to linear; None for the paper's plain squares."""
    sigma_acceleration: float = 1.0
    """[m/s^2]"""
    sigma_bone: float = 0.04
    """[m] of a bone's end, from an orientation that is 5-10 degrees off."""
    sigma_jerk: float = 120.0
    """[m/s^3]"""
    jerk_target: str = "zero"
    """'zero' on all joints, or 'sensor': the differentiated acceleration on joints that carry one
    (the paper's E_S, which only adds differentiated noise)."""
    sigma_length: float = 0.005
    """[m] of `bone_lengths` = 'weighted'."""
    prior: str = "bones"
    """What is pulled to the start: 'bones' (the root and every bone vector, so that a root the start has
    wrong does not bend the pose) or 'positions' (every joint on its own)."""
    sigma_prior: float = 0.3
    """[m] of the root, or of every position."""
    sigma_prior_bone: float = 0.04
    """[m] of a bone vector."""
    bone_lengths: str = "weighted"
    """'weighted' by sigma_length, 'constraint' (equalities in every fragment; blending two fragments
    bends bones by about a millimetre again), or 'free' (as printed)."""
    blend: str = "tapered"
    """'tapered' weights of overlapping fragments, or 'average' (the paper's plain mean)."""
    padding: str = "masked"
    """'masked': frames beyond the ends carry no observation; 'replicate': the paper's copies."""
    refit_root: bool = True
    """Whether the start's root is moved onto the rays (`inertial.root_position.refit_root`) first."""
    backend: str = "ipopt"
    """'ipopt', or 'realtime': Levenberg-Marquardt on the Hessian's band, for energies without
    constraints."""
    tolerance: float = 1e-6
    """IPOPT's convergence tolerance on the scaled gradient; in real time, 1e4 times the relative
    decrease that a step must promise to go on."""
    max_iterations: int = 60
    """The solver's iteration limit."""

    def __post_init__(self) -> None:
        allowed = {
            "backend": ("ipopt", "realtime"),
            "jerk_target": ("zero", "sensor"),
            "bone_lengths": ("weighted", "constraint", "free"),
            "prior": ("bones", "positions"),
            "blend": ("tapered", "average"),
            "padding": ("masked", "replicate"),
        }
        for field, values in allowed.items():
            if getattr(self, field) not in values:
                raise ShapeError(f"{field}: {getattr(self, field)!r} is none of {', '.join(values)}")
        if not 0 < self.sigma_reprojection_range[0] <= self.sigma_reprojection_range[1]:
            raise ShapeError("sigma_reprojection_range must be positive, the smaller one first")
        low_high = tuple(map(float, self.sigma_reprojection_range))
        object.__setattr__(self, "sigma_reprojection_range", low_high)
        sigmas = [name for name in vars(self) if name.startswith("sigma_")]
        for field in sigmas:
            value = getattr(self, field)
            if isinstance(value, int | float) and not value > 0:
                raise ShapeError(f"{field} must be positive; leave a term out by its weight k")
        for field in ("k_V", "k_I", "k_A", "k_B", "k_S"):
            if not 0 <= getattr(self, field) < math.inf:
                raise ShapeError(f"{field} must not be negative, and finite")
        if self.huber_reprojection is not None and not self.huber_reprojection > 0:
            raise ShapeError("huber_reprojection must be positive; None stands for plain squares")
        if not (self.tolerance > 0 and self.max_iterations >= 0):
            raise ShapeError("tolerance must be positive and max_iterations not negative")

    @classmethod
    def paper(cls, backend: str = "ipopt") -> CartesianSettings:
        """The energy as printed, with its weights, and the weak prior that gives it a minimiser.

        Plain squares, free bone lengths, the sensor's jerk as target, plain mean of fragments padded
        with copies; the prior on positions.
        """
        return cls(
            backend=backend,
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
        )

    def term_weights(self) -> dict[str, float]:
        """Weight of each term in the total energy."""
        return {
            "visual": self.k_V,
            "acceleration": self.k_I * self.k_A,
            "bone": self.k_I * self.k_B,
            "smooth": self.k_I * self.k_S,
            "length": 1.0 if self.bone_lengths == "weighted" else 0.0,
            "prior": 1.0,
        }

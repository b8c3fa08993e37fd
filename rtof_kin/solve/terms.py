"""Terms of the energies: a residual with its unit, loss, symbols and data, one object each.

Residuals are pure functions on CasADi matrices, (state, observation) -> vector with a unit; they return plain
differences, which the term weighs by 1 / sigma^2. The built-in terms of joint space are in `joint_space.terms`. A term
from outside is a further object: a `PointTerm` (positions of joints, in both spaces), a `MotionTerm` (velocity or
acceleration of a point), or a class of its own for anything that a `Frame` has. Value, gradient and Hessian follow by
CasADi, compiled, interpreted and with IPOPT. The guide is CONTRIBUTING.md.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Final

import numpy as np

from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import readonly
from rtof_kin.core.errors import InvalidInputError, UnknownNameError
from rtof_kin.core.packages import casadi as ca

if TYPE_CHECKING:
    from rtof_kin.solve.joint_space.energy import Frame
    from rtof_kin.solve.joint_space.observations import Observations

Matrix = Any  #: casadi.SX, MX or DM; (3, n) with a point or an instant in each column unless said otherwise
Loss = Callable[[Matrix], tuple[Matrix, Matrix]]  #: Weighted squares -> their robust loss and its derivative
Shapes = dict[str, tuple[int, ...]]  #: Name of a symbol -> its shape


@dataclass(frozen=True)
class PointData:
    """Observations of a term from outside, one for each of T frames."""

    values: Array  #: (T, size), in the units of the residual; NaN where nothing was observed
    sigma: Array | float  #: Standard deviation of the residual per component, in its unit: of all frames, or (T,)


class Term(ABC):
    """A term of the joint-space energy.

    A frozen dataclass: energies are built, and compiled, once for equal terms. Its fields say what it acts on; numbers
    that differ from recording to recording are observations.
    """

    name: str  #: Name in reports, a Python identifier
    unit: ClassVar[str] = "1"  #: Of its residuals
    constant_errors: ClassVar[tuple[str, ...]] = ()
    """Weights of observations whose errors are constant over a fragment; those of vision average out."""

    def symbols(self) -> Shapes:
        """Return what is observed in a frame; names of weights, 1 / sigma^2, begin with ``w_``, 0 where unobserved."""
        return {}

    def constants(self) -> Shapes:
        """Return what is constant over a fragment."""
        return {}

    @abstractmethod
    def add(self, frame: Frame) -> None:
        """Add the residuals of one frame."""

    def rows(self, data: Observations) -> dict[str, Array]:  # noqa: ARG002 - for those that have any
        """Return the observations (T, ...) of a recording, by the names of `symbols`."""
        return {}

    def constant(self, data: Observations) -> dict[str, Array]:  # noqa: ARG002 - for those that have any
        """Return the values of `constants`."""
        return {}


@dataclass(frozen=True)
class ObservedTerm(Term):
    """A term from outside, with `size` numbers and a weight observed in a frame (`PointData`)."""

    name: str

    @property
    @abstractmethod
    def size(self) -> int:
        """Numbers observed in a frame."""

    @property
    def observed(self) -> str:
        """Name of its observation."""
        return f"point_{self.name}"

    @property
    def weight(self) -> str:
        """Name of its weight, 1 / sigma^2."""
        return f"w_point_{self.name}"

    def symbols(self) -> Shapes:
        """Return observation and weight."""
        return {self.observed: (self.size,), self.weight: (1,)}

    def rows(self, data: Observations) -> dict[str, Array]:
        """Return observations and weights."""
        return observed_rows([self], data.observed, len(data.times))

    def check(self) -> None:
        """Raise an `InvalidInputError` for a name or size that cannot be."""
        if not self.name.isidentifier():
            raise InvalidInputError(f"term {self.name!r}: the name must be letters, digits and underscores")
        if not (self.size >= 1 and getattr(self, "robust", 1.0) > 0):
            raise InvalidInputError(f"term {self.name!r}: size and robust must be positive")

    @property
    def joints(self) -> tuple[str, ...]:
        """Joints that it acts on, for checks."""
        return ()


@dataclass(frozen=True)
class PointTerm(ObservedTerm):
    """A residual of the positions of one or more joints in a frame, in both spaces."""

    joint: str | tuple[str, ...]  #: Joint or joints of the skeleton that it acts on
    residual: Callable[..., Matrix]
    """(position (3, 1) of each joint in world, m; observation (size, 1)) -> plain difference (k, 1) with a unit;
    finite where the observation is 0. A function of a module: the energy is built, and compiled, once for each."""
    size: int = 1  #: Numbers observed in a frame
    robust: float = 3.0  #: [sigma] Threshold of the pseudo-Huber loss

    def __post_init__(self) -> None:
        self.check()

    @property
    def joints(self) -> tuple[str, ...]:
        """Joints that it acts on."""
        return (self.joint,) if isinstance(self.joint, str) else self.joint

    def at(self, points: Sequence[Matrix], observed: Matrix) -> Matrix:
        """Return the residual of positions (3, 1) of the joints."""
        return self.residual(*points, observed)

    def add(self, frame: Frame) -> None:
        """Add the residual of a frame."""
        observed, weight, loss = frame.O[self.observed], frame.O[self.weight], pseudo_huber_loss(self.robust)
        points = [(j, frame.p[j]) for j in frame.index(*self.joints)]
        if len(points) == 1:
            frame.point(self, *points[0], lambda p: self.at([p], observed), weight, loss)
        else:
            frame.points(self, points, lambda p: self.at(p, observed), weight, loss)


@dataclass(frozen=True)
class MotionTerm(ObservedTerm):
    """Measured velocity (m/s) or acceleration (m/s^2) in world of a point of a segment, in joint space."""

    joint: str  #: Joint that the segment begins at
    derivative: int  #: 1 for velocities, 2 for accelerations; central differences of three frames
    p_bone_point: tuple[float, float, float] = (0.0, 0.0, 0.0)  #: [m] The point in the segment's frame
    robust: float = 3.0  #: [sigma] Threshold of the pseudo-Huber loss

    def __post_init__(self) -> None:
        self.check()
        if self.derivative not in DIFFERENCES:
            raise InvalidInputError(f"term {self.name!r}: derivative must be 1 (velocity) or 2 (acceleration)")

    @property
    def size(self) -> int:
        """Components observed in a frame."""
        return 3

    @property
    def joints(self) -> tuple[str, ...]:
        """The joint."""
        return (self.joint,)

    def symbols(self) -> Shapes:
        """Return nothing: observations of paths are bound with those of the sensors."""
        return {}

    def add(self, frame: Frame) -> None:
        """Add the path of the point."""
        (j,) = frame.index(self.joint)
        frame.path(self, j, frame.p[j] + frame.R[j] @ ca.DM(self.p_bone_point), self.derivative, self.robust)

    def measured(self, data: Observations) -> tuple[Array, Array]:
        """Return derivatives (T, 1, 3) and their weights (T, 1)."""
        rows = self.rows(data)
        return rows[self.observed][:, None], rows[self.weight][:, None]


def check_terms(terms: Sequence[Term], joints: Sequence[str], built_in: Sequence[str], space: str) -> None:
    """Check that terms from outside can stand beside those of an energy. `UnknownNameError`: no such joint;
    `InvalidInputError`: a name is taken, or the space has no such terms.
    """
    names = [*built_in, *(term.name for term in terms)]
    if double := [name for name in names if names.count(name) > 1]:
        raise InvalidInputError(f"term {double[0]!r}: there is one of this name; choose another")
    known = [joint for term in terms if isinstance(term, ObservedTerm) for joint in term.joints]
    if unknown := [joint for joint in known if joint not in joints]:
        raise UnknownNameError("joint of a term", unknown, joints)
    for term in terms:
        if isinstance(term, ObservedTerm):
            term.check()
        if space == "cartesian" and not isinstance(term, PointTerm):
            raise InvalidInputError(
                f"term {term.name!r}: space 'cartesian' has positions alone (PointTerm); use 'joint'"
            )


def observed_rows(terms: Sequence[Term], data: Mapping[str, PointData], frames: int) -> dict[str, Array]:
    """Return observations (T, size) and weights (T,) of terms from outside by name, 0 where nothing was observed.
    `InvalidInputError`: wrong shapes, or sigma is not positive.
    """
    out: dict[str, Array] = {}
    for term in (t for t in terms if isinstance(t, ObservedTerm)):
        values, weight = np.zeros((frames, term.size)), np.zeros(frames)
        if term.name in data:
            what = f"observations of the term {term.name}"
            values = readonly(what, data[term.name].values, (frames, term.size))
            sigma = np.asarray(data[term.name].sigma, dtype=float)
            if sigma.shape not in ((), (frames,)):
                raise InvalidInputError(f"{what}: sigma is of {len(sigma)} frames, not of {frames}")
            sigma = np.broadcast_to(sigma, frames)
            seen = np.isfinite(values).all(axis=1)
            if not (sigma[seen] > 0).all():
                raise InvalidInputError(f"{what}: sigma must be positive")
            weight[seen] = 1 / sigma[seen] ** 2
            values = np.where(seen[:, None], values, 0.0)
        out |= {term.observed: values, term.weight: weight}
    return out


def check_observed(terms: Sequence[Term], data: Mapping[str, PointData]) -> None:
    """Raise an `UnknownNameError` for data of a term that is not there."""
    known = [term.name for term in terms]
    if unknown := [name for name in data if name not in known]:
        raise UnknownNameError("term", unknown, known)


# --- losses ----------------------------------------------------------------------------------------


def pseudo_huber(squared: Matrix, delta: Matrix | float) -> Matrix:
    """Return the robust loss ``2 delta^2 (sqrt(1 + s / delta^2) - 1)``. squared: s, squared whitened residual."""
    return 2 * delta**2 * (ca.sqrt(1 + squared / delta**2) - 1)


def pseudo_huber_weight(squared: Matrix, delta: Matrix | float) -> Matrix:
    """Return the derivative of `pseudo_huber` by `squared`, the weight in a Gauss-Newton Hessian."""
    return 1 / ca.sqrt(1 + squared / delta**2)


def pseudo_huber_loss(delta: Matrix | float) -> Loss:
    """Return the `Loss` that turns from square to linear at delta sigmas."""
    return lambda s: (pseudo_huber(s, delta), pseudo_huber_weight(s, delta))


def cauchy_loss(squared: Matrix) -> tuple[Matrix, Matrix]:
    """Return log(1 + s) of a squared whitened residual s, and its derivative."""
    return ca.log(1 + squared), 1 / (1 + squared)


def cut_off_loss(weight: Matrix, cutoff: float) -> Loss:
    """Return Cauchy's loss with its scale at a distance in m instead of at one sigma."""

    def loss(s: Matrix) -> tuple[Matrix, Matrix]:
        scale = weight * cutoff**2 + 1e-12
        value, slope = cauchy_loss(s / scale)
        return scale * value, slope

    return loss


# --- residuals -------------------------------------------------------------------------------------


def reprojection(p_camera: Matrix, uv_px: Matrix, K: Matrix) -> Matrix:
    """Return projected minus observed landmarks (2, n), px: the paper's E_V.

    Args:
        p_camera: (3, n) camera coordinates, m. uv_px: (2, n) undistorted pixels. K: (3, 3) px.
    """
    homogeneous: Matrix = ca.mtimes(K, p_camera)
    return ca.vertcat(*(homogeneous[i, :] / homogeneous[2, :] for i in range(2))) - uv_px


def acceleration(p: Matrix, a_world: Matrix, rate_hz: Matrix) -> Matrix:
    """Return central second difference of positions (3, n), m, minus measured acceleration (3, n - 2), m/s^2: E_A."""
    return (p[:, 2:] - 2 * p[:, 1:-1] + p[:, :-2]) * rate_hz**2 - a_world


def velocity(p: Matrix, v_world: Matrix, rate_hz: Matrix) -> Matrix:
    """Return central difference of points (3, n), m, minus measured velocity (3, n - 2), m/s."""
    return (p[:, 2:] - p[:, :-2]) / 2 * rate_hz - v_world


DIFFERENCES: Final = {1: (velocity, (-0.5, 0.0, 0.5)), 2: (acceleration, (1.0, -2.0, 1.0))}
"""Order of a derivative by time -> its residual, and its coefficients of three frames in units of 1 / frame^order."""


def bone_vector(p_joint: Matrix, p_child: Matrix, b_world: Matrix) -> Matrix:
    """Return bone from joint to child minus the rest bone turned by the sensor, all (3, n), m: E_B."""
    return p_child - p_joint - b_world


def jerk(p: Matrix, j_world: Matrix, rate_hz: Matrix) -> Matrix:
    """Return third difference of p (3, n), m, minus a target (3, n - 3), m/s^3, zero for smoothness: E_S."""
    difference = p[:, 3:] - 3 * p[:, 2:-1] + 3 * p[:, 1:-2] - p[:, :-3]
    return difference * rate_hz**3 - j_world


def distance(p_a: Matrix, p_b: Matrix, length: Matrix) -> Matrix:
    """Return the distance of two points (3, n) of a rigid segment minus its length (1, n), m."""
    difference = p_b - p_a
    return ca.sqrt(ca.sum1(difference * difference)) - length


def position(p: Matrix, p_prior: Matrix) -> Matrix:
    """Return position minus that of a prior or a contact point (3, n), m: E_P. p, p_prior: (3, n) m."""
    return p - p_prior


def quat_multiply(a: Matrix, b: Matrix) -> Matrix:
    """Return the product of quaternions w x y z (4, 1): first b, then a."""
    w, v, s, u = a[0], a[1:], b[0], b[1:]
    return ca.vertcat(w * s - ca.dot(v, u), w * u + s * v + ca.cross(v, u))


def quat_conjugate(q: Matrix) -> Matrix:
    """Return the inverse of a unit quaternion (4, 1)."""
    return ca.vertcat(q[0], -q[1:])


def quat_matrix(q: Matrix) -> Matrix:
    """Return the rotation matrix (3, 3) of a unit quaternion (4, 1)."""
    w, x, y, z = (q[i] for i in range(4))
    return ca.vertcat(
        ca.horzcat(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        ca.horzcat(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        ca.horzcat(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


def orientation(q: Matrix, q_measured: Matrix) -> Matrix:
    """Return the error of an orientation in the segment's axes (3, 1), rad.

    ``2 sin(angle / 2)`` along the axis: smooth and monotone up to half a turn.

    Args:
        q, q_measured: unit quaternions (4, 1).
    """
    error = quat_multiply(quat_conjugate(q_measured), q)
    return 2 * ca.if_else(error[0] < 0, -1, 1) * error[1:]


def rotation_vector(q: Matrix, q_mean: Matrix) -> Matrix:
    """Return the rotation vector of a joint from its mean, unit quaternions (4, 1), in its axes (3, 1), rad."""
    error = quat_multiply(quat_conjugate(q_mean), q)
    sign = ca.if_else(error[0] < 0, -1, 1)
    sine = ca.sqrt(ca.sumsqr(error[1:]) + 1e-18)
    return 2 * sign * ca.atan2(sine, sign * error[0]) / sine * error[1:]


def step_jerk(steps: Matrix, rate_hz: Matrix) -> Matrix:
    """Return the jerk, m/s^3 or rad/s^3 (D, n - 2), of steps (D, n), m or rad, from each frame to the next."""
    return (steps[:, 2:] - 2 * steps[:, 1:-1] + steps[:, :-2]) * rate_hz**3


def height(p: Matrix, floor: Matrix) -> Matrix:
    """Return the height (1, n), m, of a point p (3, n), m, over `floor`, that of a standing point, m."""
    return p[2, :] - floor

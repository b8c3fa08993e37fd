"""How well a fragment's solution is known: covariances of its states, and what they say of poses.

At the optimum the Gauss-Newton Hessian is the inverse covariance of all states of the fragment, as far
as residuals are worth what their weights say. Of its inverse only the diagonal blocks are made, by frame
(`banded.inverse_diagonal`): what is known of one frame whatever the others are. Robust losses count with
the weight they have there, and a limit that pushes holds its angle to a degree.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rtof_kin import kinematics
from rtof_kin import rotations as so3
from rtof_kin.banded import inverse_diagonal
from rtof_kin.confidence import WORLD, Confidence
from rtof_kin.errors import SolverError
from rtof_kin.joint_space.jerk import LAGS
from rtof_kin.joint_space.problem import JointProblem
from rtof_kin.joint_space.state import StateSpace
from rtof_kin.levenberg_marquardt import LevenbergMarquardt, Solved
from rtof_kin.skeleton import SkeletonModel

Array = NDArray[np.float64]
_DAMPING = 1e-6
"""Of the Hessian: a root of which nothing is known is known to a kilometre, which is nothing."""
_NOWHERE = 3.0
"""[m] of a position whose standard deviation is larger, nobody knows anything."""


def state_covariances(problem: JointProblem, solver: LevenbergMarquardt, solved: Solved) -> Array:
    """(N, D, D) of the states' tangents in every frame; NaN where the Hessian is not definite."""
    N, D = len(solved.x), problem.space.size
    solver.linearise(solved.x, solved.multipliers)
    try:
        factor = problem.factorise(_DAMPING)
    except SolverError:
        return np.full((N, D, D), np.nan)
    return inverse_diagonal(factor.blocks(D, LAGS))


def blended(earlier: Array, later: Array, share: Array) -> Array:
    """Covariances (T, D, D) of states blended from two fragments; where one is NaN, the other's.

    Both fragments have the same data, so their errors are no independent draws: the weighted mean of the
    two covariances is what the blend's can be at most, however they are correlated.

    Args:
        share: (T,) of the later one in the blend.
    """
    mean = (1 - share)[:, None, None] * earlier + share[:, None, None] * later
    return np.where(np.isnan(earlier), later, np.where(np.isnan(later), earlier, mean))


def segment_pairs(skeleton: SkeletonModel) -> tuple[tuple[str, str], ...]:
    """Pairs of segments of a `Confidence`: each against the world, against its parent, and against the
    nearest segment above that usually carries a sensor (upper arm in trunk, trunk in pelvis)."""
    names, parents = skeleton.names, skeleton.parents
    carriers = {joint for joint, _ in skeleton.sensors.values()}
    pairs = [(WORLD, name) for name in names]
    pairs += [(names[parent], name) for name, parent in zip(names, parents, strict=True) if parent >= 0]
    for j in sorted(skeleton.index(*carriers)):
        above = [names[i] for i in kinematics.line_to_root(parents, j)[1:] if names[i] in carriers]
        pairs += [(above[0], names[j])] if above else []
    return tuple(dict.fromkeys(pairs))


def confidence_of(space: StateSpace, times: Array, x: Array, covariance: Array) -> Confidence:
    """What covariances (T, D, D) of states x (T, 3 + 4A) say of positions and orientations."""
    skeleton = space.skeleton
    moves, turns = _rates(space, x)
    R = space.poses(x)[1]
    pairs = segment_pairs(skeleton)
    seen_from = np.zeros((len(x), len(pairs), *turns.shape[2:]))
    for k, (parent, child) in enumerate(pairs):
        c = skeleton.names.index(child)
        rate = turns[:, c] - (0.0 if parent == WORLD else turns[:, skeleton.names.index(parent)])
        seen_from[:, k] = np.swapaxes(R[:, c], 1, 2) @ rate
    turned = _covariance(seen_from, covariance)
    fixed = [child not in space.names for _, child in pairs]  # the model turns it with its parent
    turned[:, fixed] = np.nan
    positions = _covariance(moves, covariance)
    positions[np.trace(positions, axis1=2, axis2=3) > 3 * _NOWHERE**2] = np.nan
    moves[..., :3] = 0.0  # as seen from the root
    return Confidence(times, skeleton.names, positions, _covariance(moves, covariance), pairs, turned)


def _covariance(J: Array, covariance: Array) -> Array:
    """(T, n, 3, 3) of n vectors with derivatives J (T, n, 3, D) by what has a covariance (T, D, D)."""
    T, n, _, D = J.shape
    JC = (J.reshape(T, n * 3, D) @ covariance).reshape(J.shape)
    out = JC @ np.swapaxes(J, -1, -2)
    return np.asarray((out + np.swapaxes(out, -1, -2)) / 2)


def _rates(space: StateSpace, x: Array) -> tuple[Array, Array]:
    """Derivatives (T, J, 3, D) of joints' positions, and of segments' small turns, in world by a state's
    tangent."""
    skeleton, (p, R) = space.skeleton, space.poses(x)
    T, J = len(x), len(skeleton.names)
    moves, turns = np.zeros((T, J, 3, space.size)), np.zeros((T, J, 3, space.size))
    moves[..., :3] = np.eye(3)
    for a, i in enumerate(space.joints):
        axes = R[:, i] @ space.axes(a)
        columns = slice(int(space.first[a]), int(space.first[a]) + axes.shape[-1])
        beyond = [j for j in range(J) if i in kinematics.line_to_root(skeleton.parents, j)]
        turns[:, beyond, :, columns] = axes[:, None]
        arms = so3.skew(p[:, beyond] - p[:, [i]])
        moves[:, beyond, :, columns] = -arms @ axes[:, None]
    return moves, turns

"""How well a fragment's solution is known: covariances of its states, and what they say of poses.

At the optimum the Gauss-Newton Hessian is the inverse covariance of all states of the fragment, as far
as residuals are worth what their weights say. Of its inverse only the diagonal blocks are made, by frame
(`banded.inverse_diagonal`): what is known of one frame whatever the others are. Robust losses count with
the weight they have there, and a limit that pushes holds its angle to a degree.
"""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body import kinematics
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.errors import SolverError
from rtof_kin.core.numerics.banded import inverse_diagonal
from rtof_kin.core.numerics.levenberg_marquardt import LevenbergMarquardt, Solved
from rtof_kin.data.confidence import WORLD, Confidence
from rtof_kin.solve.compiled.fragment_energy import FragmentEnergy
from rtof_kin.solve.energy.jerk import LAGS
from rtof_kin.solve.energy.state import StateSpace

Array = NDArray[np.float64]
_DAMPING = 1e-6
"""Of the Hessian: a root of which nothing is known is known to a kilometre, which is nothing."""
_NOWHERE = 3.0
"""[m] of a position whose standard deviation is larger, nobody knows anything."""


def state_covariances(problem: FragmentEnergy, solver: LevenbergMarquardt, solved: Solved) -> Array:
    """(N, D, D) of the states' tangents in every frame; NaN where the Hessian does not tell."""
    N, D = len(solved.x), problem.space.size
    solver.linearise(solved.x, solved.multipliers)
    try:
        factor = problem.factorise(_DAMPING)
    except SolverError:
        return np.full((N, D, D), np.nan)
    covariance = inverse_diagonal(factor.blocks(D, LAGS))
    covariance[~np.isfinite(covariance).all(axis=(1, 2))] = np.nan
    return covariance


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
    nearest segment above that usually carries a sensor (upper arm in trunk, trunk in pelvis).
    """
    names, parents = skeleton.names, skeleton.parents
    carriers = {joint for joint, _ in skeleton.sensors.values()}
    pairs = [(WORLD, name) for name in names]
    pairs += [(names[parent], name) for name, parent in zip(names, parents, strict=True) if parent >= 0]
    for j in sorted(skeleton.index(*carriers)):
        above = [names[i] for i in kinematics.line_to_root(parents, j)[1:] if names[i] in carriers]
        pairs += [(above[0], names[j])] if above else []
    return tuple(dict.fromkeys(pairs))


def confidence_of(
    space: StateSpace, times: Array, x: Array, covariance: Array, held: Collection[str] = ()
) -> Confidence:
    """What covariances (T, D, D) of states x (T, 3 + 4A) say of positions and orientations.

    Args:
        held: joints of the space that nothing turns.
    """
    skeleton, (p, R) = space.skeleton, space.poses(x)
    moves, turns = _rates(space, p, R)
    pairs = segment_pairs(skeleton)
    names = (*skeleton.names, WORLD)
    parents, children = np.array([[names.index(name) for name in pair] for pair in pairs]).T
    turns = np.concatenate([turns, np.zeros_like(turns[:, :1])], axis=1)  # the world's
    seen_from = np.swapaxes(R[:, children], -1, -2) @ (turns[:, children] - turns[:, parents])
    turned = _covariance(seen_from, covariance)
    turning = {*space.names} - {*held}
    turned[:, [child not in turning for _, child in pairs]] = np.nan  # turned with its parent
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


def _rates(space: StateSpace, p: Array, R: Array) -> tuple[Array, Array]:
    """Derivatives (T, J, 3, D) of joints' positions (T, J, 3) and of small turns of their segments
    (T, J, 3, 3), in world, by a state's tangent.
    """
    parents, joints = space.skeleton.parents, np.array(space.joints)
    widths = np.where(space.hinge_axis < 0, 3, 1)
    of = np.repeat(joints, widths)  # the joint of each coordinate that turns
    local = np.concatenate([space.axes(a) for a in range(len(joints))], axis=1)
    axes = np.einsum("tdij,jd->tdi", R[:, of], local)
    above = np.zeros((len(parents), len(parents)), dtype=bool)
    for j in range(len(parents)):
        above[j, kinematics.line_to_root(parents, j)] = True
    turn = np.where(above[:, of, None], axes[:, None], 0.0)
    move = np.cross(turn, p[:, :, None] - p[:, None, of])
    root = np.broadcast_to(np.eye(3), (*p.shape, 3))
    moves = np.concatenate([root, np.swapaxes(move, -1, -2)], axis=-1)
    turns = np.concatenate([np.zeros_like(root), np.swapaxes(turn, -1, -2)], axis=-1)
    return moves, turns

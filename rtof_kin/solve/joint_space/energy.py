"""Energy of one frame as CasADi symbols: value, gradient and Gauss-Newton Hessian in tangent space.

Terms add residuals of a single instant to a `Frame`, and paths of points whose derivatives by time are measured, which
`stencils` makes residuals of. Derivatives are taken at the state itself (tangent zero).

A residual on a segment depends on the twist (v, w) of that segment in world: a point p of it moves by v + w x (p -
p_root). With G the derivative of the residual by the twist, it adds G^T G to the segment's 6 x 6 stiffness and G^T r
to its force. A joint moves its whole subtree, so it takes the sums over the subtree; with S_i the twist of joint i,
the Hessian's block of joints i and j (j in the subtree of i) is S_i^T K_j S_j: the composite-rigid-body algorithm
(Featherstone 2008, ch. 6) with stiffness in place of inertia. Residuals of several segments, and the quadratic form of
the joints' rotations, are added in tangent coordinates.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

from rtof_kin.core.packages import casadi as ca
from rtof_kin.solve import terms as residuals
from rtof_kin.solve.joint_space.layout import FrameLayout
from rtof_kin.solve.joint_space.state import StateSpace
from rtof_kin.solve.terms import DIFFERENCES, Loss, Term

_Residual = Callable[[Any], Any]  #: Residual as a function of a point, or of a small rotation vector


class Path(NamedTuple):
    """A point of a segment whose derivative by time is measured."""

    term: str
    joint: int
    point: Any  #: (3, 1) position in world, m
    derivative: int  #: 1 velocity, 2 acceleration
    robust: float  #: [sigma] Threshold of the pseudo-Huber loss

    @property
    def coefficients(self) -> tuple[float, ...]:
        """Coefficients of the positions of three frames, in units of rate^derivative."""
        return DIFFERENCES[self.derivative][1]


class Frame:
    """Symbols of a frame, and the sums to which terms add.

    Attributes:
        p, R, q: position (3), rotation (3, 3) and quaternion (4) in world of every segment.
        O, C: symbols of what is observed in a frame and of what is constant over a fragment, by name.
        energies: name of each term -> its energy. paths: of points. reprojections: residuals in px.
    """

    def __init__(self, space: StateSpace, terms: Sequence[Term]) -> None:
        self.space, self.terms = space, terms
        skeleton, A = space.skeleton, len(space.joints)
        self.p_root, self.quats = ca.SX.sym("p", 3), ca.SX.sym("q", 4, A)
        constants = {"offsets": (3, len(skeleton.names))}
        self.O = _symbols(shapes for term in terms for shapes in term.symbols().items())
        self.C = _symbols([*constants.items(), *(shapes for term in terms for shapes in term.constants().items())])
        self._local = [self.quats[:, a] for a in range(A)]
        self.q, self.R, self.p = list[Any](), list[Any](), list[Any]()
        self._forward()
        self.energies: dict[str, Any] = {}
        self.paths, self.reprojections = list[Path](), list[Any]()
        self._stiffness = [ca.SX(6, 6) for _ in skeleton.parents]
        self._force = [ca.SX(6, 1) for _ in skeleton.parents]
        self._several, self._quadratic = list[tuple[Any, ...]](), list[tuple[Any, ...]]()
        for term in terms:
            before = len(self.paths)
            term.add(self)
            if len(self.paths) == before:
                self.energies.setdefault(term.name, ca.SX(0))

    def _forward(self) -> None:
        space, offsets = self.space, self.C["offsets"]
        local = dict(zip(space.joints, self._local, strict=True))
        for j, parent in enumerate(space.skeleton.parents):
            if parent < 0:
                q, p = local[j], self.p_root
            else:
                q = residuals.quat_multiply(self.q[parent], local[j]) if j in local else self.q[parent]
                p = self.p[parent] + self.R[parent] @ offsets[:, j]
            self.q.append(q)
            self.p.append(p)
            self.R.append(residuals.quat_matrix(q) if j in local else self.R[parent])

    def index(self, *joints: str) -> list[int]:
        """Return the segments that begin at joints."""
        return [self.space.skeleton.names.index(joint) for joint in joints]

    def turned(self, j: int, e: Any) -> Any:
        """Return segment j's quaternion after a small rotation vector in its own axes, to first order."""
        return _turned(self.q[j], e)

    def point(self, term: Term, j: int, point: Any, residual: _Residual, weight: Any, loss: Loss) -> Any:
        """Add a residual of a point (3, 1) of segment j and return it."""
        r, P = _derivative(lambda e: residual(point + e), 3)
        self._add(term, j, r, P @ self._lever(point), weight, loss)
        return r

    def turn(self, term: Term, j: int, residual: _Residual, weight: Any, loss: Loss) -> None:
        """Add a residual of segment j turned by a small rotation vector (3, 1) in its own axes."""
        r, Q = _derivative(residual, 3)
        self._add(term, j, r, ca.horzcat(ca.SX(r.numel(), 3), Q @ self.R[j].T), weight, loss)

    def points(
        self, term: Term, points: Sequence[tuple[int, Any]], residual: _Residual, weight: Any, loss: Loss
    ) -> None:
        """Add a residual of points (segment, (3, 1) position) of several segments, a function of their list."""
        r, P = _derivative(
            lambda e: residual([p + e[3 * k : 3 * k + 3] for k, (_, p) in enumerate(points)]), 3 * len(points)
        )
        parts = [(j, P[:, 3 * k : 3 * k + 3] @ self._lever(p)) for k, (j, p) in enumerate(points)]
        slope = self._energy(term, r, weight, loss)
        self._several.append((parts, r, slope))

    def rotations(self, term: Term, mean: Any, precision: Any) -> None:
        """Add half a quadratic form of the rotation vectors of all joints but the root from quaternions (4, A - 1)."""
        vectors, slopes = [], []
        for a, q in enumerate(self._local[1:], start=1):
            axes = ca.DM(self.space.axes(a))
            r, B = _derivative(_from_mean(q, mean[:, a - 1], axes), axes.shape[1])
            vectors.append(r)
            slopes.append(B)
        J, r = ca.diagcat(*slopes), ca.vertcat(*vectors)
        force = precision @ r
        self.energies[term.name] = 0.5 * ca.dot(r, force)
        self._quadratic.append((J, force, precision))

    def path(self, term: Term, j: int, point: Any, derivative: int, robust: float) -> None:
        """Add a point (3, 1) of segment j whose velocity (1) or acceleration (2) is measured."""
        self.paths.append(Path(term.name, j, point, derivative, robust))

    def _add(self, term: Term, j: int, r: Any, G: Any, weight: Any, loss: Loss) -> None:
        slope = self._energy(term, r, weight, loss)
        self._force[j] += G.T @ (slope * r)
        self._stiffness[j] += ca.tril2symm(ca.tril((G.T * slope) @ G))

    def _energy(self, term: Term, r: Any, weight: Any, loss: Loss) -> Any:
        """Add half of the loss of a residual's weighted square; its weight in the Hessian."""
        value, slope = loss(weight * ca.sumsqr(r))
        self.energies[term.name] = self.energies.get(term.name, ca.SX(0)) + 0.5 * value
        return weight * slope

    def _lever(self, point: Any) -> Any:
        """(3, 6) derivative of a point by the twist of its segment."""
        return ca.horzcat(ca.SX.eye(3), -ca.skew(point - self.p[0]))

    def composed(self, forces: Any = None) -> tuple[Any, Any]:
        """Return gradient (D) and lower Hessian (D, D), with forces (3P) on the paths' points if given."""
        space, parents = self.space, self.space.skeleton.parents
        stiffness, force = list(self._stiffness), list(self._force)
        pulls: dict[int, Any] = {}
        for k, path in enumerate(self.paths if forces is not None else ()):
            pulls[path.joint] = pulls.get(path.joint, 0) + self._lever(path.point).T @ forces[3 * k : 3 * k + 3]
        for j, pull in pulls.items():
            force[j] = force[j] + pull
        for j in range(len(parents) - 1, 0, -1):
            stiffness[parents[j]] = stiffness[parents[j]] + stiffness[j]
            force[parents[j]] = force[parents[j]] + force[j]
        gradient, hessian = ca.SX(space.size, 1), ca.SX(space.size, space.size)
        twists = self._twists()
        for j, twist in twists.items():
            rows, pushed = space.columns(j), stiffness[j] @ twist
            gradient[rows] = twist.T @ force[j]
            for i in self._movers(j, twists):
                block = pushed.T @ twists[i]
                hessian[rows, space.columns(i)] = ca.tril(block) if i == j else block
        for parts, r, slope in self._several:
            J = sum(self._jacobian(j, G, twists) for j, G in parts)
            gradient += J.T @ (slope * r)
            hessian += ca.tril((J.T * slope) @ J)
        for J, torque, precision in self._quadratic:
            gradient[6:] += J.T @ torque
            hessian[6:, 6:] += ca.tril(J.T @ (precision @ J))
        return gradient, hessian

    def path_jacobian(self) -> Any:
        """Return the derivatives (3P, D) of the paths' points."""
        twists = self._twists()
        rows = [self._jacobian(path.joint, self._lever(path.point), twists) for path in self.paths]
        return ca.vertcat(*rows) if rows else ca.SX(0, self.space.size)

    def covariances(self, pairs: Sequence[tuple[int, int]]) -> Any:
        """Return the function (state, offsets of the joints, covariance of the tangent) -> entries of the covariances
        (3, 3) of the joints' positions in world, of these less the root's, and of the orientations of pairs of a parent
        segment (-1: world) and a child, in the child's axes.

        Along a line of joints, a twist X becomes X + S d by the tangent d of the next one: its covariance with all
        tangents W becomes W + S C_d, and its own K becomes K + W_d S^T + S W_d^T + S C_dd S^T. Root positions apart.
        """
        given = ca.SX.sym("C", self.space.size, self.space.size)
        C, twists = ca.tril2symm(ca.tril(given)), self._twists()
        columns = {j: self.space.columns(j) for j in self.space.joints}
        twists[0], columns[0] = twists[0][:, 3:], slice(3, 6)
        W, K = {-1: ca.SX(6, self.space.size)}, {-1: ca.SX(6, 6)}
        world, relative, turns = list[Any](), list[Any](), list[Any]()
        for j, parent in enumerate(self.space.skeleton.parents):
            lever = self._lever(self.p[j])
            about, with_root = lever @ K[parent] @ lever.T, lever @ W[parent][:, :3]
            relative.append(about)
            world.append(about + with_root + with_root.T + C[:3, :3])
            W[j], K[j] = W[parent], K[parent]
            if j in twists:
                S, own = twists[j], columns[j]
                cross = W[j][:, own] @ S.T
                K[j] = ca.tril2symm(ca.tril(K[j] + cross + cross.T + S @ C[own, own] @ S.T))
                W[j] = W[j] + S @ C[own, :]
        for i, j in pairs:
            between = [k for k in self._movers(j, twists) if k not in self._movers(i, twists)]
            at = [c for k in between for c in range(columns[k].start, columns[k].stop)]
            axes = ca.horzcat(ca.SX(3, 0), *(twists[k][3:, :] for k in between))
            about = axes @ C[at, at] @ axes.T if i >= 0 else K[j][3:, 3:]
            turns.append(self.R[j].T @ about @ self.R[j])
        entries = (ca.vec(ca.tril2symm(ca.tril(one))) for one in (*world, *relative, *turns))
        inputs = [ca.vertcat(self.p_root, ca.vec(self.quats)), ca.vec(self.C["offsets"]), ca.vec(given)]
        return _function("covariances", inputs, [ca.vertcat(*entries)])

    def _jacobian(self, j: int, G: Any, twists: dict[int, Any]) -> Any:
        """(n, D) of a derivative G (n, 6) by the twist of segment j."""
        J = ca.SX(G.shape[0], self.space.size)
        for i in self._movers(j, twists):
            J[:, self.space.columns(i)] = G @ twists[i]
        return J

    def _movers(self, j: int, twists: dict[int, Any]) -> Iterator[int]:
        """The moving joints from j to the root."""
        while j >= 0:
            if j in twists:
                yield j
            j = self.space.skeleton.parents[j]

    def _twists(self) -> dict[int, Any]:
        """(6, width) of each moving joint."""
        out: dict[int, Any] = {}
        for a, j in enumerate(self.space.joints):
            turn = self.R[j] @ ca.DM(self.space.axes(a))
            out[j] = ca.vertcat(ca.skew(self.p[j] - self.p[0]) @ turn, turn)
            if j == 0:
                out[j] = ca.horzcat(ca.vertcat(ca.SX.eye(3), ca.SX(3, 3)), out[j])
        return out


class FrameEnergy:
    """CasADi functions of one frame, of D tangent coordinates, L landmarks and P points of paths.

    Attributes:
        layout: terms, energies, and what is bound. paths: points whose derivatives are measured.
        full: (state, observation, constant) -> energies, gradient (D), Hessian (D, D, lower part), positions of the
            paths' points (3P), their Jacobian (3P, D), reprojection residuals (2L) in px.
        value: the same inputs -> energies, positions of the points, reprojection residuals. gradient: the same inputs
            and a force on the points (3P) -> gradient with it.
    """

    def __init__(self, space: StateSpace, terms: tuple[Term, ...]) -> None:
        self.space, frame = space, Frame(space, terms)
        self.paths = tuple(frame.paths)
        shapes = ({name: v.shape for name, v in symbols.items()} for symbols in (frame.O, frame.C))
        self.layout = FrameLayout.of(terms, frame.energies, [path.term for path in self.paths], *shapes)
        inputs = [ca.vertcat(frame.p_root, ca.vec(frame.quats)), _stacked(frame.O), _stacked(frame.C)]
        gradient, hessian = frame.composed()
        points = ca.vertcat(*(path.point for path in self.paths)) if self.paths else ca.SX(0, 1)
        energy, seen = ca.vertcat(*frame.energies.values()), ca.vertcat(*frame.reprojections)
        force = ca.SX.sym("force", points.numel())
        self.full = _function("full", inputs, [energy, gradient, hessian, points, frame.path_jacobian(), seen])
        self.value = _function("value", inputs, [energy, points, seen])
        self.gradient = _function("gradient", [*inputs, force], [frame.composed(force)[0]])


def _symbols(shapes: Iterable[tuple[str, tuple[int, ...]]]) -> dict[str, Any]:
    return {name: ca.SX.sym(name, *shape) for name, shape in shapes}


def _stacked(symbols: dict[str, Any]) -> Any:
    return ca.vertcat(*(ca.vec(v) for v in symbols.values()))


def _function(name: str, inputs: list[Any], outputs: list[Any]) -> Any:
    """A CasADi function; ``cse`` would save a tenth of the evaluation and take longer than all the rest."""
    return ca.Function(name, inputs, [ca.densify(v) for v in outputs])


def _turned(q: Any, e: Any) -> Any:
    return residuals.quat_multiply(q, ca.vertcat(1, e / 2))


def _from_mean(q: Any, mean: Any, axes: Any) -> _Residual:
    return lambda e: residuals.rotation_vector(_turned(q, axes @ e), mean)


def _derivative(residual: _Residual, size: int) -> tuple[Any, Any]:
    """A residual and its Jacobian at 0."""
    e = ca.SX.sym("e", size)
    r = residual(e)
    zero = ca.SX.zeros(size, 1)
    return ca.substitute(r, e, zero), ca.sparsify(ca.substitute(ca.jacobian(r, e), e, zero))

"""A person's body and marker places from trials, and the motion of a trial on that body.

The fit is bilevel (Werling et al. 2022, AddBiomechanics): body b (joint offsets and marker places, shared by all trials
of a person) and postures x_t of many different frames minimise one energy with priors::

    E(b) = sum over frames t of min_x E_t(x; b)  +  1/2 |b - b_0|^2_Lambda  +  hip regression

by Gauss-Newton steps on b in which the postures are eliminated (Schur complement; markers are linear in b). So knees,
hips, shoulders and elbows are placed where the motion turns about them (functional centres), as far as it shows them;
else at the prior: proportions of the skeleton at the person's size, places of the marker set, and hip joint centres by
regression from the pelvis' width and depth (Harrington et al. 2007, J. Biomech. 40). A trial is then solved on
the fixed body over time, with soft tissue as each marker's own standard deviation.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Final

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from rtof_kin.body import kinematics
from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.core.errors import CalibrationError, InvalidInputError
from rtof_kin.core.numerics.levenberg_marquardt import LevenbergMarquardt
from rtof_kin.data.poses import PoseSequence, Provenance
from rtof_kin.formats.markers import MarkerSequence, rate_hz
from rtof_kin.markers.energy import MarkerModel, MarkerTrial
from rtof_kin.markers.marker_sets import MarkerPlaces, places_of

_FRAMES: Final = 200  #: Frames of all trials on which the body is fitted
_CANDIDATES: Final = 3000  #: Frames among which they are chosen
_MOST: Final = 0.4  #: Least share of all trials' markers in a frame that is used: some are of a standing trial alone
_ROUNDS: Final = 25  #: Largest number of Gauss-Newton steps
_ENOUGH: Final = 1e-4  #: Relative decrease of the energy at which they end
_STIFF: Final = 0.05  #: Largest relative spread of the distance of two markers that count as on one segment
_FAR_APART: Final = 0.12  #: [m] shortest distance by which the size of a body is measured
_SIZES: Final = (0.45, 1.35)  #: Sizes of people relative to the shipped skeleton
_TWIST: Final = 0.15  #: Weight of the parent's orientation in the first estimate of a segment's
_WIDE: Final = 5.0  #: Factor on the pose prior's standard deviations along movements in a fit
_ALIKE: Final = 4.0  #: Soft tissue moves alike in like postures: so many frames count as one
_HIP: Final = 0.008  #: [m] standard deviation of a hip joint centre about its regression, by axis
MISFIT: Final = 0.03  #: [m] residual at which markers and body do not belong together
_DOUBTFUL: Final = 3.0  #: Ratio of a marker's residual to its soft tissue's at which it contradicts the others
_MOST_LEFT_OUT: Final = 5  #: Number of contradicting markers at which nothing is sure
_WINDOW, _OVERLAP = 300, 15  #: Frames of a trial that are solved at once, and that two neighbours share
_TRUNK: Final = ("Hips", "Spine", "Spine1", "Spine2", "Spine3")


@dataclass(frozen=True)
class MarkerBody:
    """A person's skeleton with the markers on it."""

    skeleton: SkeletonModel  #: With the person's joint offsets
    places: MarkerPlaces  #: Fitted places; `sigma_place` is what is left open of them
    sigma_offsets: Array  #: (J, 3) [m] standard deviation of the joint offsets
    rms: Array  #: (K,) [m] residual of each marker over the frames of the fit
    energies: tuple[float, ...]  #: Before the first and after each step
    frames: int  #: Number of frames of the fit
    left_out: dict[str, float] = field(default_factory=dict)
    """Markers that contradict the others, as exchanged or fallen off, and are not used, with their residual, m."""

    @property
    def doubtful(self) -> dict[str, float]:
        """Used markers whose residual is more than three times their soft tissue's, with the residual, m."""
        bad = self.rms > _DOUBTFUL * self.places.sigma_skin
        return {name: float(r) for name, r, far in zip(self.places.names, self.rms, bad, strict=True) if far}


def fit_body(
    trials: Sequence[MarkerSequence],
    skeleton: SkeletonModel | None = None,
    places: MarkerPlaces | None = None,
    frames: int = _FRAMES,
    progress: Callable[[int, int], None] | None = None,
) -> MarkerBody:
    """Fit joint offsets and marker places to all trials of one person. `InvalidInputError`: no trial, no known marker
    set, or too few markers; `CalibrationError`: the markers do not fit a body.

    Args:
        trials: with one marker set, of which each may lack markers, as those of a standing trial alone; the more
            different their movements, the more is found.
        skeleton: proportions to start from; default: the 21-joint skeleton.
        places: of the markers; default: of the set that is recognised by their names.
        frames: number of frames that are used, chosen to be different.
        progress: called with (steps done, steps at most).
    """
    if not trials:
        raise InvalidInputError("trials: none; give at least one trial with markers")
    skeleton = skeleton or SkeletonModel.default()
    places = places or places_of(list(dict.fromkeys(name for trial in trials for name in trial.names)))
    observed = np.concatenate([_of(trial, places) for trial in trials])
    there = np.flatnonzero(_seen(observed).any(axis=0))
    places = places.select([places.names[k] for k in there])
    observed = _chosen(observed[:, there], places, frames)
    scale = _scale(observed, skeleton, places)
    skeleton = skeleton.with_offsets(skeleton.joint_offsets * scale)
    places = places.scaled(scale)
    left_out: dict[str, float] = {}
    while True:
        body = _BodyFit(skeleton, places, observed).solve(progress or (lambda done, total: None))
        ratio = body.rms / places.sigma_skin
        worst = int(np.argmax(ratio))
        if ratio[worst] < _DOUBTFUL or len(left_out) == _MOST_LEFT_OUT:
            break
        left_out[places.names[worst]] = float(body.rms[worst])
        kept = [k for k in range(len(places.names)) if k != worst]
        places, observed = places.select([places.names[k] for k in kept]), observed[:, kept]
    if (middle := float(np.median(body.rms))) > MISFIT or len(left_out) == _MOST_LEFT_OUT:
        raise CalibrationError(
            f"the markers fit no body: median residual {1000 * middle:.0f} mm, worst {', '.join(left_out) or 'none'}. "
            f"Are names, unit and marker set ({places.set_name}) right, and are all trials of one person?"
        )
    return replace(body, left_out=left_out)


def track(trial: MarkerSequence, body: MarkerBody) -> Motion:
    """Return the motion of a trial on a fitted body.

    Frames in which too few markers are seen follow from their neighbours by smoothness and are not valid.
    `InvalidInputError`: no frame shows the pelvis' markers.
    """
    skeleton, observed = body.skeleton, _of(trial, body.places)
    model = _model(skeleton, body.places, _WIDE)
    x = _start(model, skeleton, body.places, observed)
    for first in range(0, len(x), _WINDOW):
        own = slice(max(first - _OVERLAP, 0), min(first + _WINDOW + _OVERLAP, len(x)))
        problem = MarkerTrial(model, observed[own], rate_hz(trial.times))
        solved = LevenbergMarquardt(problem).solve(x[own], 60, 1e-7)
        x[first : own.stop] = solved.x[first - own.start :]
    p, R = model.poses(x)
    seen = _seen(observed)
    provenance = np.where(_supported(skeleton, body.places, seen), Provenance.CAMERA, Provenance.PRIOR)
    valid = np.tile(seen.sum(axis=1)[:, None] > 2, (1, len(skeleton.names)))
    turned = [sum(segment == name for segment in body.places.segments) > 1 for name in skeleton.names]
    poses = PoseSequence(
        trial.times, p, R, skeleton.names, provenance.astype(np.uint8), valid, np.array(turned) | _between(skeleton)
    )
    return skeleton.motion(poses)


def _between(skeleton: SkeletonModel) -> Mask:
    """Return (J,) whether a segment lies between others whose orientation is observed: the trunk and the clavicles."""
    return np.array([name in _TRUNK or name.endswith("Shoulder") or name == "Neck" for name in skeleton.names])


def marker_residuals(trial: MarkerSequence, body: MarkerBody, motion: Motion) -> Array:
    """Return (T, K) distances of the trial's markers from those of the body, m; NaN where missing."""
    model = _model(body.skeleton, body.places)
    points = model.points(motion.poses.p_world_joint, motion.poses.R_world_bone)
    return np.asarray(np.linalg.norm(points - _of(trial, body.places), axis=-1))


def _model(skeleton: SkeletonModel, places: MarkerPlaces, widened: float = 1.0) -> MarkerModel:
    p, sigma = np.array(places.p_bone_marker), np.array(places.sigma_skin)
    return MarkerModel(skeleton, places.segments, p, sigma, widened)


def _of(trial: MarkerSequence, places: MarkerPlaces) -> Array:
    """Return the markers (T, K, 3) of a trial; NaN for those it lacks."""
    out = np.full((len(trial), len(places.names), 3), np.nan)
    for k, name in enumerate(places.names):
        if name in trial.names:
            out[:, k] = trial.p_world[:, trial.names.index(name)]
    return out


def _seen(observed: Array) -> Mask:
    """Return (T, K) which markers are seen."""
    return np.asarray(np.isfinite(observed).all(axis=-1))


def _supported(skeleton: SkeletonModel, places: MarkerPlaces, seen: Mask) -> Mask:
    """Return (T, J) whether a segment's markers, or those of the segment beyond its joint, are seen."""
    out = np.zeros((len(seen), len(skeleton.names)), dtype=bool)
    for k, segment in enumerate(skeleton.index(*places.segments)):
        out[:, segment] |= seen[:, k]
        if skeleton.parents[segment] >= 0:
            out[:, skeleton.parents[segment]] |= seen[:, k]
    return out


# --- the first estimate --------------------------------------------------------------------------


def _chosen(observed: Array, places: MarkerPlaces, frames: int) -> Array:
    """Return the frames (F, K, 3) with the most different shapes, farthest point first."""
    pelvis = [k for k, segment in enumerate(places.segments) if segment == "Hips"]
    seen = _seen(observed)
    usable = np.flatnonzero((seen[:, pelvis].sum(axis=1) >= 3) & (seen.mean(axis=1) > _MOST))
    if len(usable) == 0:
        raise CalibrationError(
            "no frame shows three markers of the pelvis and most others; fill gaps, or choose another marker set"
        )
    usable = usable[np.linspace(0, len(usable) - 1, min(len(usable), _CANDIDATES)).astype(int)]
    R, middle = _rigid(places.p_bone_marker[pelvis], observed[usable][:, pelvis])
    shape = np.einsum("tji,tkj->tki", R, observed[usable] - middle[:, None])
    there = seen[usable][..., None]
    mean = np.where(there, shape, 0.0).sum(axis=0) / np.maximum(there.sum(axis=0), 1)
    shape = np.where(there, shape, mean).reshape(len(usable), -1)
    picked, distance = [0], np.linalg.norm(shape - shape[0], axis=1)
    while len(picked) < min(frames, len(usable)) and distance.max() > 0:
        picked.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(shape - shape[picked[-1]], axis=1))
    return np.asarray(observed[usable[picked]])


def _rigid(places: Array, observed: Array) -> tuple[Array, Array]:
    """Return rotations (T, 3, 3) and origins (T, 3) that bring places (K, 3) to what is seen of (T, K, 3)."""
    seen = _seen(observed)[..., None]
    count = np.maximum(seen.sum(axis=1), 1)
    middle = np.where(seen, observed, 0.0).sum(axis=1) / count
    rest = np.where(seen, places, 0.0).sum(axis=1) / count
    a, b = np.where(seen, places - rest[:, None], 0.0), np.where(seen, observed - middle[:, None], 0.0)
    R = so3.nearest_rotation(np.einsum("tki,tkj->tij", b, a))
    return R, middle - np.einsum("tij,tj->ti", R, rest)


def _scale(observed: Array, skeleton: SkeletonModel, places: MarkerPlaces) -> float:
    """Return the person's size relative to the skeleton, by distances of markers that hardly change."""
    p, R = skeleton.forward_kinematics(skeleton.t_pose()[None])
    rest = _model(skeleton, places).points(p, R)[0]
    ratios = []
    for i, j in combinations(range(len(rest)), 2):
        expected, found = np.linalg.norm(rest[i] - rest[j]), np.linalg.norm(observed[:, i] - observed[:, j], axis=-1)
        if expected > _FAR_APART and np.isfinite(found).sum() > 5 and np.nanstd(found) < _STIFF * np.nanmean(found):
            ratios.append(np.nanmedian(found) / expected)
    scale = float(np.median(ratios)) if ratios else 1.0
    if not _SIZES[0] < scale < _SIZES[1]:
        raise CalibrationError(
            f"the markers are of a person of {scale * skeleton.height:.2f} m: is the unit of the file right?"
        )
    return scale


def _start(model: MarkerModel, skeleton: SkeletonModel, places: MarkerPlaces, observed: Array) -> Array:
    """Return first states (T, 3 + 4A): segments turned to their own markers, from the pelvis outwards."""
    own = {s: [k for k, name in enumerate(places.segments) if name == s] for s in set(places.segments)}
    pelvis, chest = own["Hips"], own.get("Spine3", [])
    seen = _seen(observed)
    known = np.flatnonzero(seen[:, pelvis].sum(axis=1) >= 3)
    if len(known) == 0:
        raise InvalidInputError("no frame shows three markers of the pelvis")
    nearest = np.rint(np.interp(np.arange(len(observed)), known, np.arange(len(known)))).astype(int)
    used = observed[known[nearest]]
    seen = _seen(used)
    T, names = len(used), skeleton.names
    R, p = np.tile(np.eye(3), (T, len(names), 1, 1)), np.zeros((T, len(names), 3))
    R[:, 0], p[:, 0] = _rigid(places.p_bone_marker[pelvis], used[:, pelvis])
    R_chest = R[:, 0].copy()
    complete = seen[:, chest].sum(axis=1) >= 3
    R_chest[complete] = _rigid(places.p_bone_marker[chest], used[complete][:, chest])[0]
    bend = so3.log(np.swapaxes(R[:, 0], 1, 2) @ R_chest)
    for j, name in enumerate(names):
        if j == 0:
            continue
        parent = skeleton.parents[j]
        p[:, j] = p[:, parent] + R[:, parent] @ skeleton.joint_offsets[j]
        if name in _TRUNK:
            R[:, j] = R[:, 0] @ so3.exp(_TRUNK.index(name) / (len(_TRUNK) - 1) * bend)
            continue
        markers = own.get(name, [])
        a = places.p_bone_marker[markers]
        b = np.where(seen[:, markers, None], used[:, markers] - p[:, [j]], 0.0)
        M = np.einsum("tki,kj->tij", b, a) + _TWIST * (np.sum(a**2) + 1e-6) * R[:, parent]
        R[:, j] = so3.nearest_rotation(M)
    return model.space.from_poses(p[:, 0], R)


# --- the fit of the body -------------------------------------------------------------------------


def _body_basis(skeleton: SkeletonModel) -> Array:
    """Return directions (n, J, 3) in which joint offsets may change, per standard deviation.

    Both sides change together by several per cent, and apart by one or two. The four joints of the trunk are one.
    """
    offsets, index = skeleton.joint_offsets, {name: j for j, name in enumerate(skeleton.names)}
    rows: list[Array] = []

    def add(changes: dict[str, Array]) -> None:
        row = np.zeros((len(skeleton.names), 3))
        for name, change in changes.items():
            row[index[name]] = change
        rows.append(row)

    def both(name: str, change: tuple[float, float, float] | float, apart: float) -> None:
        """Change by (x, y, z), m, or by a share of the length, of both sides; `apart`: share of it that differs."""
        left, right = offsets[index["Left" + name]], offsets[index["Right" + name]]
        parts = [change] if isinstance(change, float) else list(np.diag(change)[np.array(change) > 0])
        for part in parts:
            a, b = (part * left, part * right) if isinstance(part, float) else (part, part * [1, -1, 1])
            add({"Left" + name: a, "Right" + name: b})
            add({"Left" + name: apart * a, "Right" + name: -apart * b})

    size = float(np.linalg.norm(offsets[index["LeftLeg"]]) / 0.396)
    add({name: 0.08 * offsets[index[name]] for name in _TRUNK[1:]})
    add({"Spine": np.array([0.012, 0, 0]) * size})
    add({"Spine": np.array([0, 0, 0.012]) * size})
    add({"Neck": 0.08 * offsets[index["Neck"]]})
    add({"Neck": np.array([0.012, 0, 0]) * size})
    add({"Head": 0.10 * offsets[index["Head"]]})
    both("UpLeg", (0.0, 0.010 * size, 0.0), 0.2)  # the root is where it is seen from the hips
    both("Leg", 0.08, 0.2)
    both("Foot", 0.08, 0.2)
    both("Shoulder", (0.012 * size, 0.006 * size, 0.018 * size), 0.2)
    both("Arm", 0.10, 0.2)
    both("ForeArm", 0.08, 0.2)
    both("Hand", 0.08, 0.2)
    return np.array(rows)


class _BodyFit:
    """Gauss-Newton on offsets and marker places with the postures eliminated."""

    def __init__(self, skeleton: SkeletonModel, places: MarkerPlaces, observed: Array) -> None:
        self.skeleton, self.places, self.observed = skeleton, places, observed
        self.basis = _body_basis(skeleton)
        self.model = _model(skeleton, places, _WIDE)
        self.x = _start(self.model, skeleton, places, observed)
        self.y = np.zeros(len(self.basis) + 3 * len(places.names))  # in prior standard deviations; then places

    def _set(self, y: Array) -> None:
        n = len(self.basis)
        self.model.offsets = self.skeleton.joint_offsets + np.einsum("n,njc->jc", y[:n], self.basis)
        self.model.places = self.places.p_bone_marker + y[n:].reshape(-1, 3) * self.places.sigma_place

    def _rates(self, R: Array) -> Array:
        """Return derivatives (T, K, 3, n + 3K) of the markers by y."""
        T, K, n = len(R), len(self.places.names), len(self.basis)
        out = np.zeros((T, K, 3, n + 3 * K))
        moved = np.zeros((T, len(self.skeleton.names), 3, n))  # of each joint
        for j, parent in enumerate(self.skeleton.parents):
            if parent >= 0:
                moved[:, j] = moved[:, parent] + np.einsum("tij,nj->tin", R[:, parent], self.basis[:, j])
        for k, s in enumerate(self.model.segments):
            out[:, k, :, :n] = moved[:, s]
            out[:, k, :, n + 3 * k : n + 3 * k + 3] = R[:, s] * self.places.sigma_place[k]
        return out

    def _prior_slope(self, y: Array) -> tuple[Array, Array]:
        """Return gradient and Hessian of the body's prior with the hip regression."""
        gradient, hessian, residual = y.copy(), np.eye(len(y)), self._hips(y)
        if len(residual):
            rates = np.stack([(self._hips(y + d) - residual) / 1e-5 for d in 1e-5 * np.eye(len(y))], axis=1)
            gradient += rates.T @ residual
            hessian += rates.T @ rates
        return _ALIKE * gradient, _ALIKE * hessian

    def _hips(self, y: Array) -> Array:
        """Return deviations of the hip joint centres from their regression, in its standard deviations."""
        self._set(y)
        at = dict(zip(self.places.points, self.model.places, strict=True))
        back = [at[name] for name in ("left psis", "right psis") if name in at] or [at.get("sacrum")]
        if "left asis" not in at or "right asis" not in at or back[0] is None:
            return np.zeros(0)
        regressed = kinematics.hip_centres(at["left asis"], at["right asis"], np.mean(back, axis=0))
        hips = self.model.offsets[self.skeleton.index("LeftUpLeg", "RightUpLeg")]
        return np.asarray((hips - regressed).ravel() / _HIP)

    def _energy(self, x: Array, y: Array) -> float:
        hips = self._hips(y)  # which sets the body
        prior = _ALIKE * 0.5 * float(y @ y + hips @ hips)
        return float(self.model.energies(x, self.observed).sum()) + prior

    def settle(self, rounds: int) -> None:
        """Optimise the postures on the body as it is, each frame by itself, with damping where a step fails."""
        damping, best = np.full(len(self.x), 1e-3), self.model.energies(self.x, self.observed)
        for _ in range(rounds):
            at = self.model.linearise(self.x, self.observed)
            H = at.hessian + (1e-6 + damping)[:, None, None] * np.eye(self.model.space.size)
            step: Array = -np.asarray(np.linalg.solve(H, at.gradient[..., None])[..., 0], dtype=float)
            candidate = self.model.space.retract(self.x, step)
            after = self.model.energies(candidate, self.observed)
            better = after < best
            self.x = np.where(better[:, None], candidate, self.x)
            gain = np.sum(np.where(better, best - after, 0.0))
            best = np.where(better, after, best)
            damping = np.where(better, damping / 5, np.minimum(10 * np.maximum(damping, 1e-2), 1e6))
            if better.mean() > 0.9 and gain < _ENOUGH * best.sum():
                break

    def solve(self, progress: Callable[[int, int], None]) -> MarkerBody:
        """Alternate Gauss-Newton steps of the body with steps of the postures."""
        self.settle(30)
        energies = [self._energy(self.x, self.y)]
        for done in range(_ROUNDS):
            progress(done, _ROUNDS)
            information, slope, back = self._eliminated()
            step = -cho_solve(cho_factor(information), slope)
            for share in (1.0, 0.3, 0.1):
                change = np.asarray(share * step, dtype=float)
                y, x = self.y + change, self.model.space.retract(self.x, back(change))
                energy = self._energy(x, y)
                if energy < energies[-1]:
                    break
            else:
                self._set(self.y)
                break
            self.x, self.y = x, y
            self.settle(3)
            energies.append(self._energy(self.x, self.y))
            if energies[-2] - energies[-1] < _ENOUGH * energies[-1]:
                break
        progress(_ROUNDS, _ROUNDS)
        return self._result(energies)

    def _eliminated(self) -> tuple[Array, Array, Callable[[Array], Array]]:
        """Return Hessian and gradient by y with the postures eliminated, and the postures' step for a step of y."""
        slope, information = self._prior_slope(self.y)
        self._set(self.y)
        at = self.model.linearise(self.x, self.observed)
        T, D = len(self.x), self.model.space.size
        by_y = self._rates(at.R_world_bone).reshape(T, -1, len(self.y))
        by_x = at.rates.reshape(T, -1, D)
        weight = np.repeat(at.weight, 3, axis=1)[..., None]
        residual = at.residual.reshape(T, -1, 1)
        A = at.hessian + 1e-6 * np.eye(D)
        C = np.swapaxes(by_x, 1, 2) @ (weight * by_y)
        solved = np.linalg.solve(A, np.concatenate([C, at.gradient[..., None]], axis=2))
        information = information + np.einsum("tri,trj->ij", weight * by_y, by_y, optimize=True)
        information -= np.einsum("tdi,tdj->ij", C, solved[..., :-1], optimize=True)
        slope = slope + np.einsum("tri,trj->i", by_y, weight * residual)
        slope -= np.einsum("tdi,td->i", C, solved[..., -1])

        def back(step: Array) -> Array:
            return np.asarray(-(solved[..., -1] + solved[..., :-1] @ step))

        return information, slope, back

    def _result(self, energies: list[float]) -> MarkerBody:
        information = self._eliminated()[0]
        n, covariance = len(self.basis), np.linalg.inv(information / _ALIKE)
        offsets = np.einsum("njc,nm,mjc->jc", self.basis, covariance[:n, :n], self.basis)
        at = self.model.linearise(self.x, self.observed)
        seen = _seen(self.observed)
        rms = np.sqrt(np.sum(at.residual**2, axis=(0, 2)) / np.maximum(seen.sum(axis=0), 1))
        sigma = np.sqrt(np.diag(covariance)[n:]).reshape(-1, 3) * self.places.sigma_place
        places = replace(self.places, p_bone_marker=self.model.places, sigma_place=sigma)
        body = self.skeleton.with_offsets(self.model.offsets)
        return MarkerBody(body, places, np.sqrt(offsets), rms, tuple(energies), len(self.x))

"""Clinical joint angles of a motion, with the observation source of each value.

An unobserved angle is NaN, never the value of a prior. What an angle needs follows from its position in the
sequence, because the child's long axis is the last one:

=========  ======================================  =========================================
angle      needs of the parent segment             needs of the child segment
=========  ======================================  =========================================
first      the direction of its bone               the direction of its bone
second     its complete orientation                the direction of its bone
third      its complete orientation                its complete orientation
=========  ======================================  =========================================

The complete orientation is observed where `PoseSequence.orientation_observed` is set (several bones, or a sensor); the
direction where the joint and its only child are observed. A leaf without a sensor (hand, foot) has neither. An angle of
a knee or elbow that is constant while the joint flexes is fixed by the model of the motion, and counts as unobserved.

**Coordinates of an OpenSim model** give clinical angles too, to compare them with those of a motion.

Coordinates of another system's model are taken by their names, with the sign of `AngleRow.opensim`; their
zero is that of their model. Files of this package's own .osim contain all revolutes of its skeleton, so they
give segment orientations, and from these the same angles as the motion: its ``lumbar_extension`` is one of
four joints of the spine, not the whole angle.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body import kinematics
from rtof_kin.body.motion_source import MotionSource
from rtof_kin.body.observability import DIRECTION, WHOLE, ObservationMasks
from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.clinical import decomposition as jcs
from rtof_kin.clinical.angle_table import AngleRow, AngleTable, JointCoordinateSystem, angle_table
from rtof_kin.clinical.decomposition import DecomposedAngles, reliable_samples
from rtof_kin.clinical.paths import BodyPaths, PathCollector
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.core.checks import checked_times, indices_of, readonly, shared
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.core.over_time import BLOCK, Sampled, Stream
from rtof_kin.data.poses import PoseSequence, Provenance
from rtof_kin.formats.opensim import ROOT_AXES, OpenSimTable, coordinates
from rtof_kin.formats.trial_results import AngleBlock

Sources = NDArray[np.uint8]
_ARRAYS: Final[dict[str, type]] = {
    "values": np.float64,
    "provenance": np.uint8,
    "singular": np.bool_,
    "sigma": np.float32,
    "trusted": np.bool_,
}
_NEEDS: Final = {"parent": (DIRECTION, WHOLE, WHOLE), "child": (DIRECTION, DIRECTION, WHOLE)}


@dataclass(frozen=True)
class ClinicalAngles(Sampled):
    """Joint angles over time by clinical name."""

    times: Array  #: (T,) seconds, strictly increasing
    values: Array  #: (T, A) radians; NaN where unobserved. Continuous between gaps.
    provenance: Sources
    """(T, A) `Provenance` of each value: the weaker of its two segments, at least IMU for a segment whose
    orientation was observed. PRIOR where the pose is known but this angle is unobserved."""
    singular: Mask  #: (T, A) whether only the sum of this and another angle is defined near this posture
    rows: tuple[AngleRow, ...]  #: A rows of the table: name, sign, range, OpenSim coordinate
    notes: tuple[str, ...] = ()
    sigma: NDArray[np.float32] | None = None
    """(T, A) rad, standard deviation, NaN where unknown; None if the motion has no confidence."""
    trusted: Mask | None = None
    """(T, A) whether a value is used for ranges, peaks and gait (`decomposition`); None for all."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "times", checked_times("angle times", self.times))
        shape = (len(self.times), len(self.rows))
        for name, kind in _ARRAYS.items():
            if (given := getattr(self, name)) is not None:
                object.__setattr__(self, name, readonly(f"angle {name}", given, shape, kind))
        if self.sigma is not None and (np.any(self.sigma < 0) or np.isinf(self.sigma).any()):
            raise InvalidInputError("angle sigma: negative or infinite; use NaN where it is unknown")

    def __getitem__(self, name: str) -> Array:
        """(T,) radians of one angle; raises `UnknownNameError` for an unknown name."""
        return np.asarray(self.values[:, indices_of("clinical angle", [name], self.names)[0]])

    @property
    def names(self) -> tuple[str, ...]:
        """A names, e.g. 'right_knee_flexion'."""
        return tuple(row.name for row in self.rows)

    @property
    def known(self) -> Mask:
        """(T, A) whether there is a value."""
        return np.isfinite(self.values)

    @property
    def trusted_values(self) -> Array:
        """(T, A) radians; NaN also where a value is unreliable."""
        return self.values if self.trusted is None else np.where(self.trusted, self.values, np.nan)

    def trusted_angle(self, column: int) -> Array:
        """Return one angle (T,), rad; NaN also where it is unreliable."""
        values = self.values[:, column]
        return values if self.trusted is None else np.where(self.trusted[:, column], values, np.nan)

    def is_trusted(self, frames: slice) -> Mask:
        """Return a mask (T', A) of known and reliable values."""
        known = np.isfinite(self.values[frames])
        return known if self.trusted is None else known & self.trusted[frames]

    def select(self, names: Sequence[str]) -> Self:
        """Return some of the angles."""
        index = indices_of("clinical angle", names, self.names)
        chosen: dict[str, Any] = dict.fromkeys(_ARRAYS)
        for name in _ARRAYS:
            if (array := getattr(self, name)) is not None:
                (chosen[name],) = shared(np.array(array[:, index]))
        return replace(self, rows=tuple(self.rows[i] for i in index), **chosen)


def clinical_angles(
    motion: Motion | MotionSource | PoseSequence | Stream[PoseSequence], skeleton: SkeletonModel | None = None
) -> ClinicalAngles:
    """Compute clinical joint angles from segment orientations. `InvalidInputError`: poses without a skeleton, or
    missing joints; `UnknownNameError`: the skeleton has no clinical table.

    Args:
        motion: a motion, or poses of `skeleton`'s joints. Poses whose provenance is NOBODY throughout count
            as observed where they are `valid`, subject to `orientation_observed`.
        skeleton: of the poses; not needed for a motion.

    Returns:
        All angles of the table, radians, relative to the anatomical standing posture.
    """
    if isinstance(motion, PoseSequence | Stream):
        if skeleton is None:
            raise InvalidInputError("clinical_angles: poses do not contain a skeleton; pass theirs")
        found, masks, start = DecomposedAngles(skeleton, angle_table(skeleton.table), motion.times), [], 0
        for poses in Stream.of(motion).blocks(after=1):
            found.add(slice(start, start + BLOCK), poses, slice(0, BLOCK), None)
            masks.append(ObservationMasks.of_poses(poses, skeleton)[:BLOCK])
            start += BLOCK
        return angles_of(found, ObservationMasks.joined(masks))
    source = MotionSource.of(motion)
    return angles_and_paths(source, angle_table(source.skeleton.table))[0][0]


def angles_and_paths(
    source: MotionSource, *tables: AngleTable, standing: bool = False
) -> tuple[list[ClinicalAngles], BodyPaths]:
    """Return the angles of each table, and the paths, in one pass over the frames."""
    found = [DecomposedAngles(source.skeleton, table, source.times) for table in tables]
    paths = PathCollector(source.skeleton, source.times, standing)
    for block in source.blocks(margin=1, confidence=True):
        for one in found:
            one.add(block.frames, block.motion.poses, block.own, block.motion.confidence)
        paths.add(block.frames, block.motion.poses, block.own)
        del block  # before the next one is read
    return [angles_of(one, source.masks) for one in found], paths.paths(source.masks, source.corrections)


def angle_blocks(source: MotionSource) -> Iterator[AngleBlock]:
    """Yield the angles of a motion in blocks, without second and third ones of hinges, which may be the model's."""
    constant = np.repeat([joint.hinge for joint in angle_table(source.skeleton.table).joints], 3)
    constant[::3] = False
    for block in source.blocks(margin=round(source.rate_hz), confidence=True):
        found, own = clinical_angles(block.motion), block.own
        values = np.where(constant, np.nan, np.degrees(found.values[own]))
        sigma = np.full_like(values, np.nan) if found.sigma is None else np.degrees(found.sigma[own])
        yield found.names, found.times[own], values, sigma


def angles_of(found: DecomposedAngles, masks: ObservationMasks) -> ClinicalAngles:
    """Return clinical angles from those of all frames."""
    table, shape = found.table, found.angles.shape
    seen_by = _segment_sources(masks)
    values, sigma = found.angles, found.sigma
    provenance, singular = np.empty(shape, dtype=np.uint8), np.empty(shape, dtype=np.bool_)
    for j, joint in enumerate(table.joints):
        own = slice(3 * j, 3 * j + 3)
        values[:, own], provenance[:, own], singular[:, own] = _joint_angles(joint, values[:, own], seen_by, masks)
    if sigma is not None:
        sigma[np.isnan(values)] = np.nan
    reliable, note = reliable_samples(table, found.times, found.too_fast, sigma, np.isfinite(values))
    notes = (*_notes(table, values, provenance), *([note] if note else []))
    shared(values, provenance, singular, reliable, *(() if sigma is None else (sigma,)))
    return ClinicalAngles(found.times, values, provenance, singular, table.rows, notes, sigma, reliable)


def all_observed(poses: PoseSequence) -> PoseSequence:
    """Return poses with all orientations marked as observed, e.g. those of motion capture."""
    return replace(poses, orientation_observed=np.ones(len(poses.names), dtype=np.bool_))


def _segment_sources(masks: ObservationMasks) -> Sources:
    """(T, J) `Provenance` of each segment: that of its joint; if only its orientation is observed, that of
    its children, at least IMU.
    """
    out = np.array(masks.provenance)
    for j in range(len(masks.skeleton.names) if masks.has_provenance else 0):
        ends = masks.provenance[:, kinematics.children_of(masks.skeleton.parents, j)]
        turned = (masks.levels[:, j] == WHOLE) & (out[:, j] < Provenance.IMU)
        out[turned, j] = ends[turned].max(axis=1, initial=Provenance.IMU)
    return out


def _joint_angles(
    joint: JointCoordinateSystem, decomposed: Array, seen_by: Sources, masks: ObservationMasks
) -> tuple[Array, Sources, Mask]:
    """Values, provenance and singular flags (T, 3) of one joint coordinate system; decomposed: (T, 3) rad, see
    `DecomposedAngles`; seen_by: (T, J) of the segments.
    """
    names, levels = masks.skeleton.names, masks.levels
    child = names.index(joint.child)
    parent = names.index(joint.parent) if joint.urdf else child
    child_level = levels[:, child]
    parent_level = levels[:, parent] if joint.urdf else np.full(len(levels), WHOLE)
    observed = (parent_level[:, None] >= _NEEDS["parent"]) & (child_level[:, None] >= _NEEDS["child"])
    posed: Mask = np.asarray(np.isfinite(decomposed).all(axis=1))
    signs = np.array([row.sign for row in joint.angles])
    center = signs * np.array([np.mean(row.range) for row in joint.angles])
    raw = np.full(decomposed.shape, np.nan)
    singular = np.zeros(decomposed.shape, dtype=np.bool_)
    for start, stop in signals.runs(posed & observed.any(axis=1)):
        angles = decomposed[start:stop]
        singular[start:stop, ::2] = jcs.near_singular(joint.sequence, angles)[:, None]
        raw[start:stop] = jcs.continuous(joint.sequence, angles, center)
    observed &= posed[:, None]
    if joint.hinge:
        # The angle between the long axes does not depend on the axial rotation of the parent.
        between = np.arccos(np.clip(np.cos(raw[:, 0]) * np.cos(raw[:, 1]), -1, 1))
        signed = np.copysign(between, np.sin(raw[:, 0]))  # the sine: `raw` may be whole turns off
        raw[:, 0] = np.where(parent_level < WHOLE, signed, raw[:, 0])
        if len(moved := raw[np.isfinite(raw).all(axis=1)]):
            span = np.degrees(np.ptp(moved, axis=0))  # a hinge of the model where only the first angle moves
            observed &= ~((span < 1e-3) & (span[0] > 1.0))
    weaker = seen_by[:, [parent, child]].min(axis=1)
    both_seen = (weaker >= Provenance.IMU) | (not seen_by[:, [parent, child]].any())
    unseen = np.where(posed, np.where(both_seen, Provenance.PRIOR, weaker), Provenance.NOBODY)
    provenance = np.where(observed, weaker[:, None], unseen[:, None]).astype(np.uint8)
    return np.where(observed, signs * raw, np.nan), provenance, singular & observed


def _notes(table: AngleTable, values: Array, provenance: Sources) -> tuple[str, ...]:
    """Sentences on the angles that are never observed, and on those with gaps."""
    share = np.isfinite(values).mean(axis=0)
    names = np.array([row.name for row in table.rows])
    notes = []
    never = share == 0
    if never.any():
        why = "not in the data"
        if (provenance == Provenance.PRIOR).any(axis=0)[never].all():
            why = "not observed by any sensor or landmark, or fixed by the model of the motion"
        notes.append(f"no values ({why}): {', '.join(names[never])}")
    gaps = (share > 0) & (share < 1)
    if gaps.any():
        worst = int(np.argmin(np.where(gaps, share, 2)))
        missing = 100 * (1 - share[worst])
        most = "under 1" if missing < 1 else f"{missing:.0f}"
        notes.append(
            f"{gaps.sum()} angles have gaps where they were not observed, at most {most} % of the time: {names[worst]}"
        )
    return tuple(notes)


_PELVIS = ("pelvis_tilt", "pelvis_list", "pelvis_rotation")


def opensim_angles(found: OpenSimTable) -> tuple[ClinicalAngles, tuple[str, ...]]:
    """Return clinical angles, and the coordinates that are none of them. `InvalidInputError`: no coordinate is a
    clinical angle.

    Args:
        found: coordinates of this package's model or another.
    """
    if found.skeleton:
        return _of_own_model(found, SkeletonModel.named(found.skeleton)), ()
    table = angle_table(SkeletonModel.default().table)
    values, used = np.full((len(found.times), len(table.rows)), np.nan), set()
    for column, row in enumerate(table.rows):
        name = row.opensim.removeprefix("-")
        if not name or (angle := found.rotation(name)) is None:
            continue
        used.add(name)
        own = -angle if row.opensim.startswith("-") else angle
        for start, stop in signals.runs(np.isfinite(own)):  # whole turns into the angle's range
            stretch = np.unwrap(own[start:stop])
            turns = np.round((np.median(stretch) - np.mean(row.range)) / (2 * np.pi))
            values[start:stop, column] = stretch - 2 * np.pi * turns
    others = tuple(name for name in found.names if name not in used)
    if not used:
        usual = [row.opensim.removeprefix("-") for row in table.rows if "hip" in row.opensim]
        raise InvalidInputError(
            f"no coordinate is a clinical angle of this package: {', '.join(others[:8])}; rename columns to "
            f"those of Rajagopal's model, e.g. {', '.join(usual[:4])}"
        )
    nothing = np.zeros(values.shape)  # neither provenance, bands nor singular postures
    return ClinicalAngles(found.times, values, nothing.astype(np.uint8), nothing.astype(np.bool_), table.rows), others


def _of_own_model(found: OpenSimTable, skeleton: SkeletonModel) -> ClinicalAngles:
    """Angles of the segment orientations; those of joints without a column are NaN."""
    q = np.zeros((len(found.times), skeleton.nq))
    root, given = np.zeros((len(found.times), 3)), set()
    for number, coordinate in enumerate(coordinates(skeleton.table)):
        angle = found.rotation(coordinate.name) if coordinate.is_rotation else None
        if angle is None:
            continue
        given.add(coordinate.name if number < 3 else coordinate.urdf)
        if number < 3:
            root[:, number] = coordinate.sign * angle
        else:
            q[:, 7 + skeleton.dof_names.index(coordinate.urdf)] = coordinate.sign * angle
    q[:, 3:7] = np.roll(so3.to_quat_wxyz(so3.euler_to_matrix(ROOT_AXES, root)), -1, axis=-1)
    p, R = skeleton.forward_kinematics(q)
    angles = clinical_angles(all_observed(PoseSequence(found.times, p, R, skeleton.names)), skeleton)
    table, values = angle_table(skeleton.table), np.array(angles.values)
    for number, joint in enumerate(table.joints):
        if not given & set(joint.urdf or _PELVIS):
            values[:, 3 * number : 3 * number + 3] = np.nan
    return ClinicalAngles(found.times, values, angles.provenance, angles.singular, angles.rows)


_SHORTEST: Final = 0.5  #: Shortest time of standing still that counts, s
_OWN_ZERO: Final = ("rotation", "shoulder", "elbow", "wrist")  #: Parts of names of angles that standing does not define


def relative_to_standing(angles: ClinicalAngles, paths: BodyPaths) -> ClinicalAngles:
    """Return angles from which those of the person's quiet standing are subtracted.

    Pelvis tilt and list, spine, hips, knees and ankles are changed; headings, rotations about long axes and the arms,
    which hang in one way or another, are not. Standing is the longest time with upright legs and trunk in which no
    segment turns faster than 0.5 rad/s, and its angles are the medians there. `InvalidInputError`: no standing still
    for half a second, or the paths do not have it.

    Args:
        paths: of the same motion, with `BodyPaths.standing`.
    """
    if paths.standing is None:
        raise InvalidInputError("angles relative to standing: the paths are without the frames of standing")
    runs = signals.runs(paths.standing)
    start, stop = max(runs, key=lambda run: run[1] - run[0], default=(0, 0))
    if (stop - start) / paths.rate_hz < _SHORTEST:
        raise InvalidInputError(
            f"angles relative to standing: nobody stands upright and still for {_SHORTEST:g} s in this "
            "motion; record a second of quiet standing, or leave the angles as they are"
        )
    values = np.array(angles.values)
    for column, name in enumerate(angles.names):
        own = values[start:stop, column]
        if not any(part in name for part in _OWN_ZERO) and np.isfinite(own).any():
            values[:, column] -= np.nanmedian(own)
    first, last = paths.times[[start, stop - 1]]
    note = f"angles of trunk and legs are relative to quiet standing from {first:.2f} to {last:.2f} s"
    return replace(angles, values=values, notes=(*angles.notes, note))

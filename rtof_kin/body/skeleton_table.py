"""Skeleton table (``models/*.toml``): joints, parents, offsets, axes, limits, masses, names and landmarks.

It is the only source of the skeleton; the number of joints is not fixed in the code.

Mass, centre of mass and inertia of body segments (de Leva, J. Biomech. 29, 1996, table 4) are in
``segment_masses.toml``. Limb segments run from the proximal to the distal joint, the head from the vertex to C7, trunk
segments from top to bottom. Fractions are of body mass and of segment length.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from rtof_kin.body.pose_prior import NeutralPosture, PosePrior, shipped_prior
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import FileFormatError, reading
from rtof_kin.core.files.text import load_toml


@dataclass(frozen=True)
class SegmentMass:
    """De Leva's values of a segment, (male, female)."""

    mass: Sequence[float]  #: Fraction of body mass
    center: Sequence[float]  #: Centre of mass from the first end, fraction of length
    radii: Sequence[Sequence[float]]
    """Radii of gyration about the sagittal, transverse, longitudinal axis, fraction of length."""
    from_far_end: bool = False  #: True if de Leva's first end is the far end of the link (head and trunk)


SEGMENTS = {
    name: SegmentMass(**row)
    for name, row in tomllib.loads(Path(__file__).with_name("segment_masses.toml").read_text(encoding="utf-8")).items()
}
SEXES = ("male", "female")
_COLUMNS: dict[str | None, list[int]] = {"male": [0], "female": [1], None: [0, 1]}


def mass_fraction(segment: str, sex: str | None) -> float:
    """Return the fraction of body mass of a segment (in `SEGMENTS`); sex: 'male', 'female' or None for the mean."""
    return float(np.mean([SEGMENTS[segment].mass[i] for i in _COLUMNS[sex]]))


def inertia(segment: str, mass_kg: float, end: Array, sex: str | None) -> tuple[Array, Array]:
    """Return centre of mass (3,), m, and inertia about it (3, 3), kg m^2, of a link, in its frame.

    A link with a share of a segment (a vertebral level) has the shape of the segment at its own length. The
    larger of the two transverse inertias is used about both transverse axes.

    Args:
        segment: name in `SEGMENTS`. mass_kg: mass of the link, kg. end: (3,) far end in the link frame, m.
        sex: 'male', 'female' or None for the mean.
    """
    entry = SEGMENTS[segment]
    share = float(np.mean([entry.center[i] for i in _COLUMNS[sex]]))
    radii = np.mean([entry.radii[i] for i in _COLUMNS[sex]], axis=0)
    length = float(np.linalg.norm(end))
    along = end / length
    center = (1 - share if entry.from_far_end else share) * end
    across = mass_kg * (max(radii[0], radii[1]) * length) ** 2
    longitudinal = mass_kg * (radii[2] * length) ** 2
    projector = np.outer(along, along)
    return center, across * (np.eye(3) - projector) + longitudinal * projector


@dataclass(frozen=True)
class DofNames:
    """Names of a degree of freedom."""

    urdf: str  #: Name of the revolute joint in the URDF
    clinical: str  #: Clinical name; a leading '-' means the opposite sign of the URDF's
    opensim: str  #: OpenSim coordinate, with the same sign convention; may be empty


@dataclass(frozen=True)
class Joint:
    """A joint and the segment distal to it."""

    name: str
    parent: str | None  #: None for the root
    offset: Array  #: (3,) position in the parent's link frame, m
    axes: str  #: Order of the three revolutes, e.g. 'yxz'; empty for the root.
    limits: Array  #: (3, 2) radians, in the order of `axes`; (0, 2) for the root
    dofs: tuple[DofNames, ...]
    mass_shares: tuple[tuple[str, float], ...]  #: (de Leva segment, share of it) carried by this link
    end: Array  #: (3,) far end of the segment in its link frame, m
    radius: float  #: Half thickness of the visual, m


@dataclass(frozen=True)
class Landmark:
    """A named point fixed in a segment, or the usual position of a sensor."""

    name: str
    joint: str
    offset: Array  #: (3,) in the link frame of the segment, m


ImageShifts = Mapping[str, Mapping[str, Array]]
"""Detector's layout -> joint -> (3,) by how much the detector sees the points next to the joint beside their usual
places, m, in the axes of their segments."""


@dataclass(frozen=True)
class SkeletonTable:
    """A skeleton as immutable data."""

    name: str
    mass_kg: float  #: Body mass, kg
    sex: str | None  #: Column of de Leva: 'male', 'female' or None for the mean
    joints: tuple[Joint, ...]  #: Parents before children; the root is first
    landmarks: tuple[Landmark, ...]
    sensors: tuple[Landmark, ...]  #: Usual sensors: name, segment, lever arm
    n_pose: dict[str, float]  #: Angles of the N-pose relative to the T-pose by URDF joint, rad
    posture: NeutralPosture | None = None  #: The person's own T-pose, where it is known
    model_prior: PosePrior | None = None  #: Pose prior of the model in use; None for the shipped one
    image_points: ImageShifts = field(default_factory=dict)
    """How far from their usual places a detector sees this person's points"""

    @property
    def names(self) -> tuple[str, ...]:
        """Joint names in order."""
        return tuple(joint.name for joint in self.joints)

    @property
    def parents(self) -> tuple[int, ...]:
        """Index of each joint's parent, -1 for the root."""
        return tuple(-1 if j.parent is None else self.names.index(j.parent) for j in self.joints)

    @property
    def offsets(self) -> Array:
        """Positions (J, 3) of joints in their parents' link frames, m."""
        return np.array([joint.offset for joint in self.joints])

    @property
    def general_prior(self) -> PosePrior:
        """Pose prior of anybody."""
        return self.model_prior or shipped_prior(self.names)

    @property
    def prior(self) -> PosePrior:
        """Pose prior, about the neutral posture where that is known."""
        return self.general_prior if self.posture is None else self.general_prior.about(self.posture)

    def scaled_to(self, offsets: Array) -> SkeletonTable:
        """Return the table with other offsets; ends, landmarks and sensors are scaled.

        The scale of a segment is the ratio of its bone lengths, or that of the whole skeleton if it has no
        child; a far end that coincides with a child stays there.

        Args:
            offsets: (J, 3) m.
        """
        old = self.offsets
        overall = float(np.linalg.norm(offsets, axis=1).sum() / np.linalg.norm(old, axis=1).sum())
        scale = dict.fromkeys(self.names, overall)
        ends = {joint.name: joint.end for joint in self.joints}
        for i, name in enumerate(self.names):
            children = [c for c, parent in enumerate(self.parents) if parent == i]
            if children:
                length = np.linalg.norm(old[children], axis=1).sum()
                scale[name] = float(np.linalg.norm(offsets[children], axis=1).sum() / length)
            ends[name] = ends[name] * scale[name]
            at_end = [c for c in children if np.allclose(old[c], self.joints[i].end, atol=1e-9)]
            if at_end:
                ends[name] = offsets[at_end[0]]
        joints = tuple(
            replace(j, offset=offsets[i], end=ends[j.name], radius=j.radius * overall)
            for i, j in enumerate(self.joints)
        )

        def moved(points: tuple[Landmark, ...]) -> tuple[Landmark, ...]:
            return tuple(replace(p, offset=p.offset * scale[p.joint]) for p in points)

        return replace(self, joints=joints, landmarks=moved(self.landmarks), sensors=moved(self.sensors))


def read_skeleton_table(path: str | Path) -> SkeletonTable:
    """Read and check a skeleton table. `FileFormatError`: not TOML, or an invalid field; the message names the joint or
    point.
    """
    path = Path(path)
    data = load_toml(path)
    with (
        reading(path, "a field is not of the right kind: {}", TypeError, ValueError),
        reading(path, "the field {} is missing", KeyError),
    ):
        joints = tuple(_joint(path, entry) for entry in data["joint"])
        table = SkeletonTable(
            name=data["name"],
            mass_kg=float(data["mass_kg"]),
            sex=data.get("sex"),
            joints=joints,
            landmarks=_landmarks(data.get("landmark", []), "offset_mm"),
            sensors=_landmarks(data.get("sensor", []), "lever_arm_mm"),
            n_pose={k: float(np.radians(v)) for k, v in data.get("n_pose_deg", {}).items()},
        )
    for i in range(len(table.joints)):
        _check_joint(path, table, i)
    _check_table(path, table)
    return table


def _joint(path: Path, entry: dict[str, Any]) -> Joint:
    name, axes = entry["name"], entry.get("axes", "")
    urdf = [f"{name}_{axis}" for axis in axes]
    clinical, opensim = entry.get("clinical", [""] * 3), entry.get("opensim", [""] * 3)
    if sorted(axes) != (["x", "y", "z"] if "parent" in entry else []):
        raise FileFormatError(path, f"joint {name}: axes '{axes}' are not x, y and z in some order (none for the root)")
    if axes and not len(clinical) == len(opensim) == 3:
        raise FileFormatError(path, f"joint {name}: needs three clinical and three OpenSim names")
    return Joint(
        name=name,
        parent=entry.get("parent"),
        offset=_metres(entry.get("offset_mm", [0, 0, 0])),
        axes=axes,
        limits=np.radians(np.array(entry.get("limits_deg", []), dtype=float).reshape(-1, 2)),
        dofs=tuple(DofNames(*names) for names in zip(urdf, clinical, opensim, strict=False)),
        mass_shares=tuple((share["segment"], float(share["share"])) for share in entry["mass"]),
        end=_metres(entry["end_mm"]),
        radius=float(entry["radius_mm"]) / 1000,
    )


def _metres(point_mm: Any) -> Array:
    point = np.array(point_mm, dtype=float) / 1000
    if point.shape != (3,) or not np.all(np.isfinite(point)):
        raise ValueError(f"{point_mm} is no point x, y, z")
    return point


def _landmarks(entries: list[dict[str, Any]], field: str) -> tuple[Landmark, ...]:
    return tuple(Landmark(e["name"], e["joint"], _metres(e[field])) for e in entries)


def _check_joint(path: Path, table: SkeletonTable, i: int) -> None:
    joint = table.joints[i]
    before, where = table.names[:i], f"joint {joint.name}"
    if (joint.parent is None) != (i == 0) or (i > 0 and joint.parent not in before):
        raise FileFormatError(path, f"{where}: its parent must come before it; only the first has none")
    if joint.name in before:
        raise FileFormatError(path, f"{where} occurs twice")
    if i > 0 and not (len(joint.limits) == 3 and np.all(joint.limits[:, 0] < joint.limits[:, 1])):
        raise FileFormatError(path, f"{where}: limits are not three ranges low, high")
    if not joint.end.any() or (i > 0 and not joint.offset.any()):
        raise FileFormatError(path, f"{where}: end_mm or offset_mm is a bone of no length")
    for segment, share in joint.mass_shares:
        if segment not in SEGMENTS:
            raise FileFormatError(path, f"{where}: no segment '{segment}'; known: {', '.join(SEGMENTS)}")
        if not share > 0:
            raise FileFormatError(path, f"{where}: its share of the {segment} is not positive")
    if not joint.mass_shares:
        raise FileFormatError(path, f"{where}: carries no mass, which a simulator cannot use")


def _check_table(path: Path, table: SkeletonTable) -> None:
    if not table.joints:
        raise FileFormatError(path, "there is no joint in it")
    if not 0 < table.mass_kg < np.inf or table.sex not in (None, *SEXES):
        raise FileFormatError(path, f"mass_kg {table.mass_kg} must be positive and sex {table.sex!r} one of {SEXES}")
    for kind, points in (("landmark", table.landmarks), ("sensor", table.sensors)):
        names = [point.name for point in points] + list(table.names if kind == "landmark" else ())
        for point in points:
            if point.joint not in table.names:
                raise FileFormatError(path, f"{kind} {point.name}: there is no joint {point.joint}")
            if names.count(point.name) > 1:
                raise FileFormatError(path, f"{kind} {point.name}: another has this name")
    dofs = {dof.urdf for joint in table.joints for dof in joint.dofs}
    for name in table.n_pose:
        if name not in dofs:
            raise FileFormatError(path, f"n_pose_deg: there is no revolute {name}")

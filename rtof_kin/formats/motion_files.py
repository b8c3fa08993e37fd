"""A motion in the files of other tools, with an index that states what each file holds.

A frame is in a *gap* where no joint is valid (the position of the person was bridged) or the configuration
is unknown. Joints, landmarks and degrees of freedom that are unobserved in other frames come *from the
prior* (`rtof_kin.body.observability`); ``files.json`` lists them. Degrees of freedom that were never
observed are left out of .mot and ros, which cannot hold a NaN.

==========  ===========================================  =============================================
format      files                                        in a gap
==========  ===========================================  =============================================
csv         joint_trajectory.csv and .json, motion.csv   numbers with validity; empty where unknown
parquet     motion.parquet                               the same; null where unknown
npz         motion.npz                                   as in motion.h5
ros         ros_joint_..., ros_base_trajectory.json      bridged; a file each side of unknown frames
osim        skeleton.osim                                (a body has none)
mot, sto    motion.mot, motion.sto                       a file each side: motion_1.mot, motion_2.mot
bvh         motion.bvh                                   the same
bvh-lafan1  motion_lafan1.bvh                            the same
glb         motion.glb                                   the same
rrd         motion.rrd                                   bridged values by colour; nothing where unknown
mcap        motion.mcap                                  bridged values, marked; nothing where unknown
rosbag      motion_bag/, a folder                        the same
mjcf        person.xml, motion_qpos.npz                  the same, of the second: motion_1_qpos.npz
trc, c3d    motion.trc, motion.c3d                       empty cells, residual -1; also of single
                                                         unobserved landmarks
==========  ===========================================  =============================================

``skeleton.urdf`` and ``files.json`` are always written.

The table of csv and parquet has one row per frame. Columns: time, pose of the root link, every revolute of the URDF,
coordinates of every landmark; for every joint whether its position is valid and its provenance; for the root link's
orientation, every revolute and every other landmark whether it was observed. Unknown values are empty cells or nulls;
bridged values and those of a prior alone are present and not valid.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body.motion_file import MOTION, MotionReader, MotionWriter
from rtof_kin.body.motion_source import MotionSource
from rtof_kin.body.observability import (
    ObservationMasks,
    never_observed,
    observed_dofs,
    observed_landmarks,
    root_turn_observed,
)
from rtof_kin.body.skeleton import Motion
from rtof_kin.body.soles import floor_levels
from rtof_kin.core.errors import InvalidInputError, UnknownNameError
from rtof_kin.core.files.arrays import write_npz
from rtof_kin.core.files.folder import new_file
from rtof_kin.core.files.hdf5 import read_arrays
from rtof_kin.core.files.text import load_toml, write_text
from rtof_kin.core.jobs import side_by_side
from rtof_kin.core.packages import optional
from rtof_kin.core.signals import runs
from rtof_kin.data.poses import Provenance
from rtof_kin.formats.bvh import write_bvh
from rtof_kin.formats.glb import write_glb
from rtof_kin.formats.joint_trajectory import BASE_COLUMNS, BASE_TURN, write_ros_trajectory
from rtof_kin.formats.markers import rate_hz, write_c3d, write_trc
from rtof_kin.formats.mjcf import FOOT_RADIUS, to_mjcf, write_qpos
from rtof_kin.formats.motion_views import (
    AnyMotion,
    even_times,
    joint_tree,
    lafan1_tree,
    landmark_markers,
    pieces,
    shares_from_prior,
)
from rtof_kin.formats.opensim import write_mot, write_osim, write_sto
from rtof_kin.formats.rerun_file import write_rrd
from rtof_kin.formats.ros_log import write_ros_log
from rtof_kin.formats.trial_results import MOST_EVENTS, Beside

_TEXTS: Final = load_toml(Path(__file__).with_suffix(".toml"))


def convention(name: str) -> str:
    """Return axes, units, order and names of a format, of ``urdf``, or of the ``table`` of csv and parquet."""
    shared: dict[str, str] = _TEXTS["shared"]
    return str((_TEXTS["formats"] | shared)[name]).format(**shared)


@dataclass(frozen=True)
class Column:
    """One column of the table."""

    name: str
    unit: str  #: 's', 'm', 'rad', '1' (no unit), or '' of values that are no numbers
    values: NDArray[Any]  #: (T,) numbers (NaN where unknown), booleans or texts
    also: dict[str, str] = field(default_factory=dict)
    """'clinical' and 'opensim' names, '-' in front where the sign is opposite."""


def motion_columns(motion: Motion, masks: ObservationMasks | None = None) -> list[Column]:
    """Return the columns of the table of a motion, in their order."""
    skeleton, poses = motion.skeleton, motion.poses
    masks = masks or ObservationMasks.of(motion)
    dofs = {dof.urdf: dof for joint in skeleton.table.joints for dof in joint.dofs}
    columns = [Column("time", "s", motion.times)]
    for name, values in zip(BASE_COLUMNS, motion.q[:, :7].T, strict=True):
        columns.append(Column(name, "1" if name.startswith("base_q") else "m", values))
    for name, values in zip(skeleton.dof_names, motion.q[:, 7:].T, strict=True):
        also = {"clinical": dofs[name].clinical, "opensim": dofs[name].opensim}
        columns.append(Column(name, "rad", values, also))
    p = skeleton.landmark_positions(poses.p_world_joint, poses.R_world_bone)
    for landmark, name in enumerate(skeleton.landmarks):
        columns += [Column(f"p_{name}_{axis}", "m", p[:, landmark, i]) for i, axis in enumerate("xyz")]
    words = np.array([provenance.name.lower() for provenance in Provenance])
    for j, name in enumerate(skeleton.names):
        columns.append(Column(f"{name}_valid", "", poses.valid[:, j]))
        columns.append(Column(f"{name}_seen_by", "", words[poses.provenance[:, j]]))
    beside = len(skeleton.names)  # landmarks are the joints first
    names = (BASE_TURN, *skeleton.dof_names, *tuple(skeleton.landmarks)[beside:])
    observed = np.column_stack([root_turn_observed(masks), observed_dofs(masks), observed_landmarks(masks)[:, beside:]])
    return columns + [Column(f"{n}_valid", "", valid) for n, valid in zip(names, observed.T, strict=True)]


def write_csv(folder: str | Path, motion: Motion | MotionSource) -> None:
    """Write the table as ``motion.csv``, units in brackets in the names of its columns, and of it as
    ``joint_trajectory.csv`` time, base pose, an angle per revolute, and ``NAME_valid`` of the base's orientation and of
    each revolute, 0 where unobserved, with units in the .json beside it. Existing files are replaced.
    """
    folder, source = Path(folder), MotionSource.of(motion)
    skeleton, columns = source.skeleton, list[Column]()
    valid = [f"{name}_valid" for name in (BASE_TURN, *skeleton.dof_names)]
    wanted = ("time", *BASE_COLUMNS, *skeleton.dof_names, *valid)
    with ExitStack() as files:
        wholes = [files.enter_context(new_file(folder / name, overwrite=True)) for name in TABLES]
        streams = [files.enter_context(whole.open("w", encoding="utf-8", newline="")) for whole in wholes]
        for number, (block, masks) in enumerate(source.observed_blocks()):
            columns = motion_columns(block, masks)
            texts = {column.name: _texts(column.values) for column in columns}
            titles = {c.name: f"{c.name} [{c.unit}]" if c.unit else c.name for c in columns}
            for stream, own in zip(streams, ({name: name for name in wanted}, titles), strict=True):
                if number == 0:
                    csv.writer(stream, lineterminator="\n").writerow(own.values())
                rows = zip(*(texts[name] for name in own), strict=True)
                stream.writelines(f"{','.join(row)}\n" for row in rows)  # no value needs quotation marks
    facts = {column.name: column for column in columns}
    sidecar = {
        "file": TABLES[0],
        "urdf": URDF,
        "frame": "world: z up, metres; base: pose of the root link in world, quaternion x y z w",
        "units": {name: facts[name].unit or "1" for name in wanted},
        "valid": "NAME_valid: 1 where NAME was observed, 0 where it comes from a prior or the model",
        "names": {name: facts[name].also for name in skeleton.dof_names},
        "sign": "a leading '-' of a clinical or OpenSim name: its sign is the opposite of the column's",
        "limits": dict(zip(skeleton.dof_names, skeleton.limits.tolist(), strict=True)),
    }
    path = (folder / TABLES[0]).with_suffix(".json")
    write_text(path, json.dumps(sidecar, indent=2) + "\n", overwrite=True)


def _texts(values: NDArray[Any]) -> list[str]:
    """Return values (T,) of a column as texts: numbers with all digits, 1 and 0, and '' for NaN."""
    if values.dtype.kind == "b":
        values = values.astype(int)
    texts = list(map(str, values.tolist()))
    missing = values.dtype.kind == "f" and np.isnan(values).any()
    return ["" if text == "nan" else text for text in texts] if missing else texts


def write_motion_parquet(path: str | Path, motion: Motion | MotionSource, *, overwrite: bool = False) -> None:
    """Write the table with units, clinical and OpenSim names in the metadata of its columns, and convention, skeleton
    and joint offsets in that of the table. Errors as `core.files.folder.new_file`, and where pyarrow is not installed.
    """
    pa, parquet = (optional(name, "parquet", "Parquet") for name in ("pyarrow", "pyarrow.parquet"))
    source = MotionSource.of(motion)
    skeleton = source.skeleton
    offsets = dict(zip(skeleton.names, skeleton.joint_offsets.tolist(), strict=True))
    about = {"convention": convention("table"), "skeleton": skeleton.name, "joint_offsets_m": json.dumps(offsets)}
    with new_file(path, overwrite) as file, ExitStack() as stack:
        writer = None
        for block, masks in source.observed_blocks():
            columns = motion_columns(block, masks)
            arrays = [pa.array(c.values, from_pandas=True) for c in columns]  # from_pandas: NaN is null
            fields = [
                pa.field(c.name, array.type, metadata=({"unit": c.unit} if c.unit else {}) | c.also)
                for c, array in zip(columns, arrays, strict=True)
            ]
            schema = pa.schema(fields, about)
            writer = writer or stack.enter_context(parquet.ParquetWriter(file, schema))
            writer.write_table(pa.Table.from_arrays(arrays, schema=schema))


INDEX: Final = "files.json"
TABLES: Final = ("joint_trajectory.csv", "motion.csv")
URDF: Final = "skeleton.urdf"
DEFAULT: Final = ("csv", "ros")
Facts = dict[str, Any]
_NOTHING: Final = Beside()
Files = dict[str, Facts]  #: Entries of `files.json`, by file name
Writer = Callable[[Path, MotionSource], object]
DEEPEST: Final = 0.01  #: [m] that a foot may be below the floor of mjcf
FormatWriter = Callable[[Path, MotionSource, Beside], Files]
_MOST_FRAMES_C3D: Final = 0xFFFF  #: Frame numbers have 16 bits in the header


@dataclass(frozen=True)
class Format:
    """A kind of file that a motion is written to."""

    write: FormatWriter  #: Write a motion into a folder: ``write(folder, motion, beside)``
    even: bool = False  #: True for formats with a rate in place of times, or whose readers expect even ones


def write_motion_files(
    folder: str | Path, motion: AnyMotion, formats: Sequence[str] = DEFAULT, beside: Beside = _NOTHING
) -> Path:
    """Write a motion, its URDF and an index of the files into an existing folder, which is returned.
    `UnknownNameError`: no such format; `RtofError`: Parquet without pyarrow; `InvalidInputError`: a format needs even
    times or an observed frame.

    Args:
        folder: files of these names in it are replaced; `core.files.folder.new_folder` makes a new one.
        motion: what is written, in blocks; a file of it where work is shared (`core.jobs`).
        formats: names in `FORMATS`. beside: what else some of them contain.
    """
    check_formats(formats)
    folder, source = Path(folder), MotionSource.of(motion)
    (folder / URDF).write_text(source.skeleton.to_urdf(), encoding="utf-8")
    files: Files = {URDF: {"format": "urdf", "convention": convention("urdf")}}
    write = partial(_write_format, folder, source, beside)
    for own in side_by_side(write, [name for name in FORMATS if name in formats]):
        files |= own
    text = json.dumps(_index(source, files), indent=2)
    (folder / INDEX).write_text(text + "\n", encoding="utf-8")
    return folder


def _write_format(folder: Path, motion: MotionSource, beside: Beside, name: str) -> Files:
    kind = FORMATS[name]
    even = motion.with_times(even_times(motion.times)) if kind.even else motion
    about = {"format": name, "convention": convention(name)}
    return {file: about | facts for file, facts in kind.write(folder, even, beside).items()}


def check_formats(formats: Sequence[str]) -> None:
    """Raise `UnknownNameError` for an unknown format; called before long work begins."""
    unknown = [name for name in formats if name not in FORMATS]
    if unknown:
        raise UnknownNameError("format", unknown, list(FORMATS))


def _index(motion: MotionSource, files: Files) -> Facts:
    skeleton, times = motion.skeleton, motion.times
    seen = np.zeros(len(motion), dtype=bool)
    for start, stop in pieces(motion):
        seen[start:stop] = True
    return {
        "skeleton": skeleton.name,
        "height_m": skeleton.height,
        "frames": len(motion),
        "rate_hz": motion.rate_hz,
        "times_s": [float(times[0]), float(times[-1])],
        "gaps": [list(gap) for gap in runs(~seen)],
        **shares_from_prior(motion),
        "meaning": _TEXTS["meaning"],
        "landmarks": {name: joint for name, (joint, _) in skeleton.landmarks.items()},
        "dofs": {
            dof.urdf: {"clinical": dof.clinical, "opensim": dof.opensim}
            for joint in skeleton.table.joints
            for dof in joint.dofs
        },
        "files": files,
    }


# --- one function for each kind of format --------------------------------------------------------


def _whole(write_files: Writer, *names: str) -> FormatWriter:
    """Return a function that writes the whole motion to a file, or to some in a folder."""

    def write(folder: Path, motion: MotionSource, _: Beside) -> Files:
        write_files(folder / names[0] if len(names) == 1 else folder, motion)
        return {name: {"frames": [0, len(motion)], "time_zero_s": 0.0} for name in names}

    return write


def _pieces(suffix: str, write_file: Writer, has_times: bool = True) -> FormatWriter:
    """Return a function that writes a file for each piece without gaps; one without times begins at 0."""

    def write(folder: Path, motion: MotionSource, _: Beside) -> Files:
        parts = pieces(motion)
        if not parts:
            raise InvalidInputError(f"motion: the person was seen in no frame, so nothing for {suffix}")
        files = {}
        for number, (start, stop) in enumerate(parts, 1):
            part = motion[start:stop]
            name = f"motion{suffix}" if len(parts) == 1 else f"motion_{number}{suffix}"
            write_file(folder / name, part)
            zero = 0.0 if has_times else float(part.times[0])
            files[name] = {"frames": [start, stop], "time_zero_s": zero, **shares_from_prior(part)}
            if suffix == ".mot":
                files[name]["left_out"] = list(never_observed(part.masks))
        return files

    return write


def _ros(folder: Path, motion: MotionSource, _: Beside) -> Files:
    paths = write_ros_trajectory(folder, motion)
    facts = {"time_zero_s": float(motion.times[0]), "left_out": list(never_observed(motion.masks))}
    return {path.name: dict(facts) for path in paths}


def _write_npz(path: Path, motion: MotionSource) -> None:
    mode, first_frame = (motion.mode, motion.first_frame) if isinstance(motion, MotionReader) else ("", 0)
    with TemporaryDirectory() as beside:
        source = Path(beside) / MOTION
        with MotionWriter(source, motion.skeleton, mode=mode, first_frame=first_frame) as writer:
            for block in motion.blocks(confidence=True):
                writer.append(block.motion)
        write_npz(path, read_arrays(source), overwrite=True)


def _mjcf(folder: Path, motion: MotionSource, beside: Beside) -> Files:
    def write(path: Path, part: MotionSource) -> None:
        q = np.concatenate([block.motion.q for block in part.blocks()])
        write_qpos(path, part.times, q, part.skeleton.dof_names)

    level, lowest = floor_levels(motion, FOOT_RADIUS)
    floor = min(level, lowest + DEEPEST)
    files = _pieces("_qpos.npz", write)(folder, motion, beside)
    write_text(folder / "person.xml", to_mjcf(motion.skeleton, floor), overwrite=True)
    return {"person.xml": {"floor_m": floor, "floor_lowered_m": level - floor}, **files}


def _osim(folder: Path, motion: MotionSource, _: Beside) -> Files:
    write_osim(folder / "skeleton.osim", motion.skeleton)
    return {"skeleton.osim": {}}


def _streamed(name: str, write_file: Callable[[Path, MotionSource, Beside], float]) -> FormatWriter:
    """Return a function that writes the whole motion to a file, and what is beside it."""

    def write(folder: Path, motion: MotionSource, beside: Beside) -> Files:
        return {name: {"frames": [0, len(motion)], "time_zero_s": write_file(folder / name, motion, beside)}}

    return write


def _c3d(folder: Path, motion: MotionSource, beside: Beside) -> Files:
    """Write times as frame numbers; `time_zero_s` is the remainder of the first one."""
    markers, results = landmark_markers(motion), beside.results and beside.results(motion)
    start, rate = float(markers.times[0]), rate_hz(markers.times)
    first = round(start * rate)
    if not 0 <= first <= _MOST_FRAMES_C3D - len(markers.times):
        first = 0
    zero, times = start - first / rate, (first + np.arange(len(markers.times))) / rate
    write_c3d(folder / "motion.c3d", replace(markers, times=times), results=results, zero_s=zero)
    facts: Facts = {"frames": [0, len(motion)], "time_zero_s": zero}
    if results is not None and (more := len(results.events[MOST_EVENTS:])):
        facts["events_left_out"] = more
    return {"motion.c3d": facts}


FORMATS: Final[dict[str, Format]] = {
    "csv": Format(_whole(write_csv, *TABLES)),
    "parquet": Format(_whole(write_motion_parquet, "motion.parquet")),
    "npz": Format(_whole(_write_npz, "motion.npz")),
    "ros": Format(_ros),
    "osim": Format(_osim),
    "mot": Format(_pieces(".mot", write_mot), even=True),
    "sto": Format(_pieces(".sto", write_sto), even=True),
    "trc": Format(_whole(lambda path, m: write_trc(path, landmark_markers(m), up="opensim"), "motion.trc"), even=True),
    "c3d": Format(_c3d, even=True),
    "bvh": Format(_pieces(".bvh", lambda path, m: write_bvh(path, joint_tree(m), len(m)), has_times=False), even=True),
    "mjcf": Format(_mjcf, even=True),
    "bvh-lafan1": Format(
        _pieces("_lafan1.bvh", lambda path, m: write_bvh(path, lafan1_tree(m), len(m), order="zyx"), has_times=False),
        even=True,
    ),
    "glb": Format(_pieces(".glb", write_glb, has_times=False)),
    "rrd": Format(_streamed("motion.rrd", write_rrd)),
    "mcap": Format(_streamed("motion.mcap", write_ros_log)),
    "rosbag": Format(_streamed("motion_bag", partial(write_ros_log, bag=True))),
}
"""All formats by name; ``motion_files.toml`` has their conventions."""

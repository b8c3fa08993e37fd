"""`RosLog`: messages of ROS 2 as they come, in an MCAP file, which Foxglove and ``ros2 bag`` open, or in a ROS 2 bag.

docs/files.md lists the topics. World is z up, x forward (REP 103). Frames of unknown configuration have neither joint
states nor transforms; what was not observed is marked in ``/bands`` and ``/joints``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final

import numpy as np

from rtof_kin.body.motion_source import MotionSource
from rtof_kin.body.observability import ObservationMasks, observed_dofs
from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.core.array_types import Array
from rtof_kin.core.files.manifest import make_private
from rtof_kin.core.packages import optional
from rtof_kin.data.poses import COLOURS, Provenance
from rtof_kin.formats.joint_trajectory import WORLD_FRAME, ros_time
from rtof_kin.formats.trial_results import Beside

_VIDEO: Final = "foxglove_msgs/msg/CompressedVideo"
_OWN_TYPES: Final = {
    "rtof_kin_msgs/msg/Bands": "".join(f"uint8 {kind.name}={kind.value}\n" for kind in Provenance)
    + Path(__file__).with_name("Bands.msg").read_text(encoding="utf-8"),
    _VIDEO: "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format\n",
}
_POINT: Final = ("x", "y", "z", "rgb", "sigma", "seen_by")  #: Fields of a point of the cloud
_RGB: Final = np.array([int.from_bytes(COLOURS[kind]) for kind in sorted(Provenance)], "<u4").view("<f4")  #: As in ROS
Links = Sequence[tuple[str, str]]  #: Names of a parent and its link
Send = Callable[..., None]  #: Writes a message: time, s, and its fields by name


class RosLog(ExitStack):
    """Writes messages of one robot; a context that completes the file. Killed before, all but the last MB is kept."""

    def __init__(
        self, path: str | Path, urdf: str, joints: Sequence[str], links: Links, zero_s: float = 0.0, bag: bool = False
    ) -> None:
        """Open a new file and write the URDF.

        Args:
            path: must not exist (FileExistsError). joints: D names of the URDF's joints. links: L parents, the first
                is `WORLD_FRAME`, and their links. zero_s: time that the file shows as 0, s; no message
                may be earlier. bag: write a folder, a bag of ROS 2 with MCAP inside, in place of a file.
        """
        types = optional("rosbags.typesys", "connect", "MCAP")
        super().__init__()
        self._store = types.get_typestore(types.Stores.ROS2_HUMBLE)
        for name, text in _OWN_TYPES.items():
            self._store.register(types.get_types_from_msg(text, name))
        self._joints, self._links, self._zero_s = list(joints), list(links), zero_s
        if bag:
            bags = optional("rosbags.rosbag2", "connect", "a ROS 2 bag")
            self._bag = bags.Writer(path, version=8, storage_plugin=bags.StoragePlugin.MCAP)
            self._bag.set_compression(bags.CompressionMode.STORAGE, bags.CompressionFormat.ZSTD)
            self.enter_context(self._bag)
        else:
            stream, self._bag = self.enter_context(Path(path).open("xb")), None  # noqa: SIM115
            make_private(Path(path))
            self._mcap = optional("mcap.writer", "connect", "MCAP").Writer(stream)
            self._mcap.start("ros2", "rtof_kin")
            self.callback(self._mcap.finish)
        self.topic("/robot_description", "std_msgs/msg/String", latched=True)(zero_s, data=urdf)
        self._send_state = self.topic("/joint_states", "sensor_msgs/msg/JointState")
        self._send_tf = self.topic("/tf", "tf2_msgs/msg/TFMessage")

    def write(self, times: Array, positions: Array, p_parent_link: Array, quat_xyzw: Array) -> None:
        """Write states of the joints and transforms of the links.

        Args:
            times: (T,) s. positions: (T, D) rad, or m. p_parent_link: (T, L, 3) m. quat_xyzw: (T, L, 4), x y z w.
                Rows with a NaN are left out.
        """
        none, names = np.zeros(0), ("Vector3", "Quaternion", "Transform", "TransformStamped")
        vector, quaternion, transform, stamped = (self._store.types[f"geometry_msgs/msg/{name}"] for name in names)
        for time, angles, p, quat in zip(times.tolist(), positions, p_parent_link, quat_xyzw, strict=True):
            if np.isfinite(angles).all():
                state = {"name": self._joints, "position": angles, "velocity": none, "effort": none}
                self._send_state(time, header=self.header(time), **state)
            if np.isfinite(p).all() and np.isfinite(quat).all():
                rows = zip(self._links, p.tolist(), quat.tolist(), strict=True)
                transforms = [
                    stamped(self.header(time, parent), link, transform(vector(*xyz), quaternion(*xyzw)))
                    for (parent, link), xyz, xyzw in rows
                ]
                self._send_tf(time, transforms=transforms)

    def header(self, time: float, frame: str = WORLD_FRAME) -> Any:
        """Return a std_msgs/Header. time: s. frame: name."""
        stamp = self._store.types["builtin_interfaces/msg/Time"](**ros_time(time - self._zero_s))
        return self._store.types["std_msgs/msg/Header"](stamp, frame)

    def topic(self, name: str, kind: str, latched: bool = False) -> Send:
        """Add a topic and return what writes its messages. latched: a later subscriber gets the last one."""
        ros = optional("rosbags.interfaces", "connect", "MCAP")
        ever, kept, reliable = ros.QosTime(2**31 - 1, 2**32 - 1), ros.QosHistory.KEEP_LAST, ros.QosReliability.RELIABLE
        lasting = ros.QosDurability.TRANSIENT_LOCAL if latched else ros.QosDurability.VOLATILE
        qos = [ros.Qos(kept, 10, reliable, lasting, ever, ever, ros.QosLiveliness.AUTOMATIC, ever, False)]
        if self._bag is not None:
            bagged = self._bag.add_connection(name, kind, typestore=self._store, offered_qos_profiles=qos)
        else:
            about = {"offered_qos_profiles": optional("rosbags.rosbag2.metadata", "connect").dump_qos_v8(qos)}
            text, _ = self._store.generate_msgdef(kind, ros_version=2)
            schema = self._mcap.register_schema(kind, "ros2msg", text.encode())
            channel = self._mcap.register_channel(name, "cdr", schema, about)

        def send(time: float, **fields: Any) -> None:
            data = bytes(self._store.serialize_cdr(self._store.types[kind](**fields), kind))
            stamp = round((time - self._zero_s) * 1e9)
            if self._bag is not None:
                self._bag.write(bagged, stamp, data)
            else:
                self._mcap.add_message(channel, stamp, data, stamp)

        return send


class PersonLog(RosLog):
    """Writes the motion of a person, with what was observed."""

    def __init__(self, path: Path, skeleton: SkeletonModel, zero_s: float = 0.0, bag: bool = False) -> None:
        """Open a new file, see `RosLog`."""
        self._skeleton, links = skeleton, [(WORLD_FRAME, skeleton.root)]
        self._turns: list[tuple[int, int, Array]] = []
        for joint in skeleton.table.joints[1:]:
            parent = str(joint.parent)
            for i, (axis, dof) in enumerate(zip(joint.axes, joint.dofs, strict=True)):  # as in `body.urdf`
                child = joint.name if i == len(joint.axes) - 1 else f"{joint.name}_{axis}_link"
                offset = np.zeros(3) if i else joint.offset
                self._turns.append((skeleton.dof_names.index(dof.urdf), "xyz".index(axis), offset))
                links.append((parent, child))
                parent = child
        super().__init__(path, skeleton.to_urdf(), skeleton.dof_names, links, zero_s, bag)
        self._send_bands = self.topic("/bands", "rtof_kin_msgs/msg/Bands")
        self._send_points = self.topic("/joints", "sensor_msgs/msg/PointCloud2")

    def write_motion(self, motion: Motion, masks: ObservationMasks | None = None) -> None:
        """Write frames of a motion. masks: of them, see `MotionSource.observed_blocks`."""
        q, masks, poses, known = motion.q, masks or ObservationMasks.of(motion), motion.poses, motion.confidence
        p, quat = np.zeros((len(q), 1 + len(self._turns), 3)), np.zeros((len(q), 1 + len(self._turns), 4))
        p[:, 0], quat[:, 0] = q[:, :3], q[:, 3:7]
        for row, (dof, axis, offset) in enumerate(self._turns, 1):
            p[:, row], half = offset, q[:, 7 + dof] / 2
            quat[:, row, axis], quat[:, row, 3] = np.sin(half), np.cos(half)
        self.write(motion.times, q[:, 7:], p, quat)
        unknown = np.full(poses.valid.shape, np.nan)
        sigmas = (unknown, unknown) if known is None else (known.position_sigma, known.orientation_sigma)
        rest = np.stack([_RGB[poses.provenance], sigmas[0], poses.provenance], axis=2)
        points = np.concatenate([poses.p_world_joint, rest], axis=2).astype("<f4")
        field, (_, width, size) = self._store.types["sensor_msgs/msg/PointField"], points.shape
        layout = {"fields": [field(name, 4 * i, field.FLOAT32, 1) for i, name in enumerate(_POINT)], "height": 1}
        layout |= {"width": width, "point_step": 4 * size, "row_step": 4 * size * width}
        layout |= {"is_bigendian": False, "is_dense": False}
        names, angles, dofs = list(poses.names), list(self._skeleton.dof_names), observed_dofs(masks)
        for t, time in enumerate(motion.times.tolist()):
            header = self.header(time)
            seen = {"valid": poses.valid[t], "seen_by": poses.provenance[t], "observed": dofs[t]}
            seen |= {"position_sigma": sigmas[0][t], "rotation_sigma": sigmas[1][t]}
            self._send_bands(time, header=header, joint=names, angle=angles, **seen)
            self._send_points(time, header=header, data=points[t].view(np.uint8).ravel(), **layout)


def write_ros_log(path: Path, motion: MotionSource, beside: Beside, bag: bool = False) -> float:
    """Write a motion in blocks, with its video where it is known, and return the time at which the clock of the file
    shows 0, s: 0, or that of the earliest message before. path, bag: see `RosLog`.
    """
    frames = beside.video() if beside.video else iter(())
    frame, masks, show = next(frames, None), motion.masks, None
    zero = min(0.0, float(motion.times[0]), frame[0] if frame else 0.0)
    with PersonLog(path, motion.skeleton, zero, bag) as log:
        for block in motion.blocks(confidence=True):
            log.write_motion(block.motion, masks[block.frames])
            while frame is not None and (frame[0] <= block.motion.times[-1] or block.stop == len(motion)):
                show = show or log.topic("/video", _VIDEO)
                time, data = frame[0], np.frombuffer(frame[1], dtype=np.uint8)
                show(time, timestamp=log.header(time).stamp, frame_id="camera", data=data, format="h264")
                frame = next(frames, None)
    return zero

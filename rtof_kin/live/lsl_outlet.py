"""Estimates as a stream of the Lab Streaming Layer, and messages as a second one."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from typing import Any, Final

import numpy as np

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.formats.joint_trajectory import BASE_COLUMNS
from rtof_kin.live.lsl import load_pylsl
from rtof_kin.live.samples import OnlineEstimate

_BUFFER_S: Final = 60  # What a listener that has fallen behind is kept, s; LSL drops older samples
_APART_S: Final = 5.0  # Age of the newest sample above which the clock of the poses is taken to be another than LSL's
_IRREGULAR: Final = 0.0  # No nominal rate, so that receivers do not space the frames equally over a gap


class LslOutlet:
    """Sends every estimate as one sample, see `channels`, stamped with the time of its pose.

    A receiver sees the lag as the age of a sample. Where poses are on another clock than LSL's, as in a replay, stamps
    are shifted so that the newest sample of the sensors is of now. Messages are a stream of text, NAME_messages.
    """

    def __init__(self, name: str, skeleton: SkeletonModel):
        """Open both streams.

        Raises:
            SourceError: pylsl is not installed.
        """
        self._pylsl = load_pylsl()
        self._skeleton = skeleton
        self._shift_s: float | None = None
        host = f"rtof-kin:{name}@{socket.gethostname()}"
        rows = list(channels(skeleton))
        info = self._pylsl.StreamInfo(name, "MoCap", len(rows), _IRREGULAR, "float32", host)
        described = info.desc().append_child("channels")
        for row in rows:
            channel = described.append_child("channel")
            for field, text in row.items():
                channel.append_child_value(field, text)
        facts = info.desc().append_child("skeleton")
        facts.append_child_value("name", skeleton.name)
        facts.append_child_value("frame", "world: z up, metres; base: root link in world")
        facts.append_child_value("urdf", skeleton.to_urdf())
        self._outlet: Any = self._pylsl.StreamOutlet(info, max_buffered=_BUFFER_S)
        text = self._pylsl.StreamInfo(f"{name}_messages", "Markers", 1, _IRREGULAR, "string", f"{host}:messages")
        self._messages: Any = self._pylsl.StreamOutlet(text)

    def send(self, estimate: OnlineEstimate) -> None:
        """Send an estimate; a listener is not waited for.

        Raises:
            UnknownNameError, InvalidInputError: its joints are not those of the skeleton.
        """
        if self._outlet is None:
            return
        poses = estimate.poses[-1:]
        self._skeleton.check_joints(poses.names)
        q = self._skeleton.inverse_kinematics(poses.p_world_joint, poses.R_world_bone)
        angles = self._skeleton.angles(q)[0]
        sample = np.concatenate([q[0, :7], angles, poses.valid[0], [estimate.lag_s, estimate.seconds]])
        time = float(poses.times[0])
        if self._shift_s is None:
            self._shift_s = self._to_lsl_clock(time + estimate.lag_s)
        self._outlet.push_sample(sample.astype(np.float32), time + self._shift_s)

    def _to_lsl_clock(self, newest: float) -> float:
        """Return what poses' times lack to the LSL clock, s; 0 where they are on it."""
        apart = float(self._pylsl.local_clock()) - newest
        if abs(apart) < _APART_S:
            return 0.0
        self.tell(f"poses are on another clock than LSL's; stamps are their times {apart:+.3f} s")
        return apart

    def tell(self, sentence: str) -> None:
        """Send a message about the streams."""
        if self._messages is not None:
            self._messages.push_sample([sentence])

    def close(self) -> None:
        """Close both streams; may be called twice."""
        self._outlet = self._messages = None


def channels(skeleton: SkeletonModel) -> Iterator[dict[str, str]]:
    """Yield the metadata of every channel, in order.

    Pose of the root link in world (m, quaternion x y z w); an angle of each revolute of the URDF, rad, on the turn
    nearest to the middle of its limits, with its clinical and OpenSim names (a leading '-': of opposite sign); for
    each joint 1 where its position is reliable; lag and time of the estimate, s. What is unknown is NaN.
    """
    for label in BASE_COLUMNS:
        axis = label[-1].upper()
        kind, unit = ("Orientation", "quaternion") if "_q" in label else ("Position", "meters")
        yield {"label": label, "unit": unit, "type": kind + axis}
    dofs = {dof.urdf: dof for joint in skeleton.table.joints for dof in joint.dofs}
    for name, (low, high) in zip(skeleton.dof_names, skeleton.limits.tolist(), strict=True):
        yield {
            "label": name,
            "unit": "radians",
            "type": "Angle",
            "clinical": dofs[name].clinical,
            "opensim": dofs[name].opensim,
            "lower_limit": f"{low:.6g}",
            "upper_limit": f"{high:.6g}",
        }
    for name in skeleton.names:
        yield {"label": f"{name}_valid", "unit": "boolean", "type": "Validity"}
    for name in ("lag", "frame_time"):
        yield {"label": name, "unit": "seconds", "type": "Duration"}

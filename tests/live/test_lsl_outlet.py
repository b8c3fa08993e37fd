"""Estimates as an LSL stream: numbers, stamps, metadata, messages."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import planted
import pylsl
import pytest
from lsl_support import DEADLINE_S, unique, until

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.errors import UnknownNameError
from rtof_kin.live.open_sources import LslOutlet, channels
from rtof_kin.live.samples import OnlineEstimate

BODY = SkeletonModel.default()
MOTION = planted.moving(BODY, 10)


def estimate(frame: int, shift_s: float) -> OnlineEstimate:
    poses = planted.replace(MOTION.poses[frame : frame + 1], times=MOTION.times[frame : frame + 1] + shift_s)
    return OnlineEstimate(poses, 0.25, 0.004)


def connected(name: str) -> Any:
    (info,) = pylsl.resolve_byprop("name", name, 1, DEADLINE_S)
    inlet = pylsl.StreamInlet(info, as_numpy=info.channel_format() != pylsl.cf_string)
    inlet.open_stream(DEADLINE_S)
    return inlet


@pytest.fixture
def outlet() -> Iterator[tuple[str, LslOutlet]]:
    name = unique("kinematics")
    out = LslOutlet(name, BODY)
    yield name, out
    out.close()
    out.close()
    out.send(estimate(0, 0.0))
    out.tell("after the end")


def test_samples_are_configurations_at_the_times_of_their_poses(outlet: tuple[str, LslOutlet]) -> None:
    name, out = outlet
    inlet = connected(name)
    begin = pylsl.local_clock() - 0.3
    assert out._outlet.wait_for_consumers(DEADLINE_S)
    for frame in range(10):
        out.send(estimate(frame, begin))
    rows, stamps = [], []

    def all_arrived() -> bool:
        values, at = inlet.pull_chunk(0.0)
        rows.extend(values)
        stamps.extend(at)
        return len(rows) == 10

    until(all_arrived)
    np.testing.assert_allclose(stamps, begin + MOTION.times, atol=1e-6)
    labels = inlet.info(DEADLINE_S).get_channel_labels()
    sent = dict(zip(labels, np.array(rows, dtype=float).T, strict=True))
    for label, values in zip(labels[7:67], BODY.angles(MOTION.q).T, strict=True):
        np.testing.assert_allclose(sent[label], values, atol=1e-5, err_msg=label)
    base = np.stack([sent[label] for label in labels[:7]], axis=1)
    np.testing.assert_allclose(base[:, :3], MOTION.q[:, :3], atol=1e-5)
    alike = np.abs(np.sum(base[:, 3:] * MOTION.q[:, 3:7], axis=1))
    np.testing.assert_allclose(alike, 1, atol=1e-5)
    np.testing.assert_allclose([sent["lag"][3], sent["frame_time"][3]], [0.25, 0.004], atol=1e-6)
    assert all(np.all(sent[f"{joint}_valid"] == 1) for joint in BODY.names)


def test_metadata_has_names_and_units_of_every_channel(outlet: tuple[str, LslOutlet]) -> None:
    info = connected(outlet[0]).info(DEADLINE_S)
    assert (info.type(), info.nominal_srate()) == ("MoCap", 0.0)
    rows = list(channels(BODY))
    assert info.get_channel_labels() == [row["label"] for row in rows]
    assert info.get_channel_units() == [row["unit"] for row in rows]
    assert info.get_channel_types()[7:67] == ["Angle"] * 60
    knee = next(row for row in rows if row["label"] == "LeftLeg_y")
    assert (knee["unit"], knee["opensim"]) == ("radians", "knee_angle_l")
    desc = info.desc().child("skeleton")
    assert desc.child_value("name") == BODY.name


def test_poses_of_another_clock_are_stamped_as_of_now_and_that_is_said(outlet: tuple[str, LslOutlet]) -> None:
    name, out = outlet
    inlet, messages = connected(name), connected(f"{name}_messages")
    assert out._outlet.wait_for_consumers(DEADLINE_S)
    assert out._messages.wait_for_consumers(DEADLINE_S)
    out.send(estimate(0, 0.0))
    out.send(estimate(3, 0.0))
    stamps: list[float] = []
    until(lambda: stamps.extend(inlet.pull_chunk(0.0)[1]) or len(stamps) == 2)
    assert stamps[0] == pytest.approx(pylsl.local_clock() - 0.25, abs=1.0)
    assert stamps[1] - stamps[0] == pytest.approx(3 / planted.RATE_HZ, abs=1e-6)
    assert "clock" in messages.pull_sample(DEADLINE_S)[0][0]
    out.tell("sensor pelvis: nothing since 1 s")
    assert messages.pull_sample(DEADLINE_S)[0] == ["sensor pelvis: nothing since 1 s"]


def test_unknown_poses_are_nan_and_other_joints_are_refused(outlet: tuple[str, LslOutlet]) -> None:
    name, out = outlet
    inlet = connected(name)
    assert out._outlet.wait_for_consumers(DEADLINE_S)
    known = estimate(0, 0.0)
    unknown = known.poses.with_poses(slice(None), np.full_like(known.poses.p_world_joint, np.nan))
    out.send(OnlineEstimate(unknown, 0.0, 0.001))
    row, _ = inlet.pull_sample(DEADLINE_S)
    assert np.isnan(row[:67]).all()
    assert np.all(row[67:88] == 0)
    with pytest.raises(UnknownNameError):
        LslOutlet(unique("other"), SkeletonModel.human36m()).send(known)

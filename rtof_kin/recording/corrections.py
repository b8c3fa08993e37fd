"""Corrections by hand at the samples of a recording: what is left out, and sides that are exchanged."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np

from rtof_kin.core.errors import UnknownNameError
from rtof_kin.core.over_time import Part, Stream
from rtof_kin.data.corrections import Correction
from rtof_kin.data.imu import ImuSequence
from rtof_kin.data.keypoints import KeypointSequence, detector_point, layout_and_point
from rtof_kin.recording.streams import Streams
from rtof_kin.vision.layouts import mirrored

_STREAMS: Final = ("all", "image", "sensors")  #: What is left out as a whole


def corrected(streams: Streams, corrections: Iterable[Correction], path: Path) -> Streams:
    """Return the streams of a recording with the corrections that their samples do not have yet. `UnknownNameError`: a
    sensor that is left out is not there.

    Args:
        path: of ``recording.toml``, for messages.
    """
    for one in corrections:
        if one.applied:
            continue
        if one.kind == "exchange_sides" and streams.keypoints is not None:
            streams = replace(streams, keypoints=_mapped(streams.keypoints, partial(_exchanged, one)))
        if one.kind != "leave_out":
            continue
        if one.what in ("all", "image"):
            unseen = partial(_unseen, one)
            first = None if streams.keypoints is None else _mapped(streams.keypoints, unseen)
            streams = replace(streams, keypoints=first, views=tuple(_mapped(view, unseen) for view in streams.views))
        if one.what != "image" and streams.imus is not None:
            names = streams.imus.part(slice(0, 1)).names
            if one.what not in (*_STREAMS, *names):
                raise UnknownNameError("sensor", [one.what], names, path, "[[corrections]] what")
            left = [i for i, name in enumerate(names) if one.what in (*_STREAMS, name)]
            streams = replace(streams, imus=_mapped(streams.imus, partial(_silent, one, left)))
    return streams


def _mapped(stream: Stream[Part], change: Callable[[Part], Part]) -> Stream[Part]:
    return Stream(stream.times, lambda rows: change(stream.part(rows)))


def _unseen(one: Correction, keypoints: KeypointSequence) -> KeypointSequence:
    confidence = np.where(one.within(keypoints.times)[:, None], 0.0, keypoints.confidence)
    return replace(keypoints, confidence=confidence)


def _exchanged(one: Correction, keypoints: KeypointSequence) -> KeypointSequence:
    """Exchange left and right of all points that have both."""
    names = keypoints.names
    order = list(range(len(names)))
    for i, name in enumerate(names):
        layout, point = layout_and_point(name)
        other = detector_point(layout, mirrored(point)) if layout else mirrored(point)
        order[i] = names.index(other) if other in names else i
    own = one.within(keypoints.times)
    uv, confidence = keypoints.uv_px.copy(), keypoints.confidence.copy()
    uv[own], confidence[own] = keypoints.uv_px[own][:, order], keypoints.confidence[own][:, order]
    return replace(keypoints, uv_px=uv, confidence=confidence)


def _silent(one: Correction, sensors: list[int], imus: ImuSequence) -> ImuSequence:
    R, f, lost = imus.R_inertial_sensor.copy(), imus.f_sensor.copy(), np.ix_(one.within(imus.times), np.array(sensors))
    R[lost], f[lost] = np.nan, np.nan
    return replace(imus, R_inertial_sensor=R, f_sensor=f)

"""An hour of stream with faults, as fast as the machine can: crashes, memory, and drift of the errors.

One in ten samples is lost and arrivals are late by up to 50 ms throughout. Once in `CYCLE` seconds a
sensor dies and comes back, and the camera freezes. Errors at lag 0 are pooled by segment of the hour, in
frames without a fault at that time and with one. Memory is that of a process of its own.
"""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Sequence
from itertools import pairwise
from time import perf_counter
from typing import Any

import numpy as np

from benchmarks import harness
from benchmarks.online.recordings import long_motion, long_recording, truth_of
from benchmarks.online.speed import in_own_process, memory_table, row_of, times_table
from benchmarks.online.streams import Interval, frozen
from rtof_kin.body.metrics import at_times
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.live.replay import Faults
from rtof_kin.protocols.tables import Table
from rtof_kin.recording.recording import Recording

CYCLE = 60.0
"""[s] from one fault of a kind to the next."""
SENSOR_OFF, CAMERA_FROZEN = (10.0, 20.0), (35.0, 40.0)
"""[s] in every cycle."""
AFTERWARDS = 2.0
"""[s] that still count to a fault."""
SEGMENTS = 12
LOSS, JITTER = 0.1, 0.05
"""[-] share of the samples, and s."""
RATE = 100.0
"""[Hz] of the sensors."""


def intervals(recording: Recording, inside: Interval) -> list[Interval]:
    """An interval of every cycle, s of the recording."""
    first, last = recording.video.times[[0, -1]].tolist()
    starts = np.arange(first, last, CYCLE)
    return [(start + inside[0], start + inside[1]) for start in starts if start + inside[1] < last]


def faults_of(recording: Recording, seed: int) -> Faults:
    """Loss, jitter, and one sensor after the other dying."""
    assert recording.imus is not None
    names = recording.imus.names
    dead = tuple((names[i % len(names)], start, stop)
                 for i, (start, stop) in enumerate(intervals(recording, SENSOR_OFF)))  # fmt: skip
    return Faults(loss=LOSS, jitter_s=JITTER, dead=dead, seed=seed)


def faulty(recording: Recording, times: Array) -> Mask:
    """Times (T,) with a dead sensor or a frozen camera, or soon after."""
    out = np.zeros(len(times), dtype=bool)
    for inside in (SENSOR_OFF, CAMERA_FROZEN):
        for start, stop in intervals(recording, inside):
            out |= (times >= start) & (times < stop + AFTERWARDS)
    return out


def rows_of(options: Namespace) -> list[dict[str, Any]]:
    """A row of times and memory, and one of errors for every segment."""
    seconds = 3600 * options.hours
    clip = long_motion(options.corpus, options.person, seconds)
    sensors = options.sensors[-1]
    recording = long_recording(clip, harness.SENSOR_SETS[sensors], RATE, options.seed)
    recording = frozen(recording, intervals(recording, CAMERA_FROZEN))
    began = perf_counter()
    spent = in_own_process(recording, faults_of(recording, options.seed), confidence=options.confidence)
    took = perf_counter() - began
    case = f"{sensors} sensors at {RATE:g} Hz"
    first = {"kind": "times", "case": case, "hours": options.hours, "took_s": took} | row_of(spent)
    return [first, *segments(recording, spent.times, spent.p_world_joint.astype(float))]


def segments(recording: Recording, times: Array, p: Array) -> list[dict[str, Any]]:
    """Errors by segment of the stream, with faults and without.

    Args:
        recording: with the truth. times: (T,) s. p: (T, J, 3) m.
    """
    p_true = at_times(truth_of(recording), times).p_world_joint
    figures = {
        "abs_mm": 1e3 * np.linalg.norm(p - p_true, axis=-1).mean(axis=1),
        "rr_mm": 1e3 * np.linalg.norm(p - p[:, :1] - p_true + p_true[:, :1], axis=-1).mean(axis=1),
    }
    bad = faulty(recording, times)
    rows = []
    for low, high in pairwise(np.linspace(times[0], times[-1], SEGMENTS + 1)):
        for kind, which in (("without", ~bad), ("with", bad)):
            own = (times >= low) & (times < high) & which & np.isfinite(figures["abs_mm"])
            about = {"kind": "errors", "from": low, "to": high, "faults": kind, "frames": int(own.sum())}
            mean = {name: float(values[own].mean()) for name, values in figures.items() if own.any()}
            rows.append(about | mean)
    return rows


def tables(rows: Sequence[dict[str, Any]]) -> list[Table]:
    """Times, memory, and errors by segment."""
    first = [row for row in rows if row["kind"] == "times"]
    return [times_table(first), memory_table(first), _errors(rows)]


def _errors(rows: Sequence[dict[str, Any]]) -> Table:
    every = [row for row in rows if row["kind"] == "errors"]
    lines = []
    for low, high in dict.fromkeys((row["from"], row["to"]) for row in every):
        own = {row["faults"]: row for row in every if row["from"] == low}
        cells = (own[faults].get(name) for name in ("rr_mm", "abs_mm") for faults in ("without", "with"))
        lines.append((f"{low / 60:.1f} to {high / 60:.1f}", *cells))
    columns = ("minutes", "rr mm without faults", "with", "abs mm without faults", "with")
    dead, still = (stop - start for start, stop in (SENSOR_OFF, CAMERA_FROZEN))
    notes = (
        f"{100 * LOSS:g} % loss and {1e3 * JITTER:g} ms jitter throughout. Faults, every {CYCLE:g} s: a dead "
        f"sensor for {dead:g} s and a frozen camera for {still:g} s, and {AFTERWARDS:g} s after each.",
    )
    return Table("errors", "Errors of the newest pose", columns, (0, 1, 1, 1, 1), tuple(lines), notes)

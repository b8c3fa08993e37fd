"""An hour of stream with faults, as fast as the machine can: crashes, memory, and drift of the errors.

A live session of a replayed recording. One in ten samples is lost and arrivals are late by up to 50 ms
throughout. Once in `CYCLE` seconds a sensor dies and comes back, and the camera freezes. Errors at lag 0 are
pooled by segment of the hour, in frames without a fault at that time and with one. Memory is that of a
process of its own.
"""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Iterator, Sequence
from functools import partial
from itertools import pairwise
from time import perf_counter
from typing import Any

import numpy as np

from benchmarks import harness
from benchmarks.online.estimators import estimator, settings
from benchmarks.online.recordings import long_motion, long_recording, truth_of
from benchmarks.online.speed import Spent, Work, host, in_own_process, memory_table, row_of, timed, times_table
from benchmarks.online.streams import Interval, frozen, replayed, setup_of
from rtof_kin.body.metrics import at_times
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.live.clock_map import VIDEO
from rtof_kin.live.replay import Faults
from rtof_kin.live.samples import OnlineEstimate
from rtof_kin.live.session import LiveSession
from rtof_kin.protocols.tables import Table
from rtof_kin.recording.recording import Recording

CYCLE = 60.0
"""[s] from one fault of a kind to the next."""
SENSOR_OFF, CAMERA_FROZEN = (10.0, 20.0), (35.0, 40.0)
"""[s] in every cycle."""
AFTERWARDS = 2.0
"""[s] that still count to a fault."""
SEGMENTS = 12
REPORTED = 3.0
"""[s] in which a sentence counts as the report of a fault."""
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
    dead = tuple(
        (names[i % len(names)], start, stop) for i, (start, stop) in enumerate(intervals(recording, SENSOR_OFF))
    )
    return Faults(loss=LOSS, jitter_s=JITTER, dead=dead, seed=seed)


def faulty(recording: Recording, times: Array) -> Mask:
    """Times (T,) with a dead sensor or a frozen camera, or soon after."""
    out = np.zeros(len(times), dtype=bool)
    for inside in (SENSOR_OFF, CAMERA_FROZEN):
        for start, stop in intervals(recording, inside):
            out |= (times >= start) & (times < stop + AFTERWARDS)
    return out


class Collector:
    """A listener that notes when a sentence names a stream.

    Attributes:
        told: time, s of the recording, and sentence. now: set before every step.
    """

    def __init__(self) -> None:
        self.told: list[tuple[float, str]] = []
        self.now = 0.0

    def send(self, estimate: OnlineEstimate) -> None:
        """Take an estimate."""

    def tell(self, sentence: str) -> None:
        """Take a message."""
        self.told.append((self.now, sentence))

    def close(self) -> None:
        """Stop."""


def session(recording: Recording, faults: Faults, own: dict[str, Any]) -> dict[str, Any]:
    """Run a live session of a replayed recording; times, memory, poses and sentences."""
    listener = Collector()
    replay, reach = replayed(recording, faults)
    setup = setup_of(recording)
    live = LiveSession(
        setup, [replay], estimator(setup, recording.video.names, settings(**own)), sinks=[listener], in_background=False
    )

    def steps() -> Iterator[tuple[float, Work]]:
        for now in recording.video.times.tolist():
            reach(now)
            listener.now = now
            yield now, partial(live.step, now)

    found = dict(vars(timed(recording, steps())))
    live.finish(float(recording.video.times[-1]))
    return found | {
        "told_at": np.array([time for time, _ in listener.told]),
        "told": np.array([sentence for _, sentence in listener.told], dtype=str),
    }


def rows_of(options: Namespace) -> list[dict[str, Any]]:
    """A row of times and memory, one of each kind of fault, and one of errors for every segment."""
    clip = long_motion(options.corpus, options.person, 3600 * options.hours)
    sensors = options.sensors[-1]
    recording = long_recording(clip, harness.SENSOR_SETS[sensors], RATE, options.seed)
    recording = frozen(recording, intervals(recording, CAMERA_FROZEN))
    faults = faults_of(recording, options.seed)
    machine, began = host(), perf_counter()
    found = in_own_process(recording, session, faults, {"confidence": options.confidence})
    took = perf_counter() - began
    told = list(zip(found.pop("told_at").tolist(), found.pop("told").tolist(), strict=True))
    spent = Spent(**found)
    case = f"{sensors} sensors at {RATE:g} Hz"
    about = {"kind": "times", "case": case, "host": machine, "hours": options.hours, "took_s": took}
    first = about | row_of(spent)
    errors = segments(recording, spent.times, spent.p_world_joint.astype(float))
    return [first, *reports(recording, faults, told), *errors]


def reports(recording: Recording, faults: Faults, told: Sequence[tuple[float, str]]) -> list[dict[str, Any]]:
    """How soon the session told of each fault, and of its end.

    Args:
        recording: with the camera that freezes. faults: with the sensors that die. told: times and sentences.
    """
    planted = [("sensor dies", name, start, stop) for name, start, stop in faults.dead]
    planted += [("camera freezes", VIDEO, *inside) for inside in intervals(recording, CAMERA_FROZEN)]
    events = [(kind, name, start) for kind, name, start, _ in planted]
    events += [(f"{kind}: over", name, stop) for kind, name, _, stop in planted]
    rows = []
    for kind in dict.fromkeys(kind for kind, _, _ in events):
        own = [(name, at) for one, name, at in events if one == kind]
        waits = [
            min((time - at for time, sentence in told if 0 <= time - at < REPORTED and name in sentence), default=None)
            for name, at in own
        ]
        known = [wait for wait in waits if wait is not None]
        rows.append(
            {
                "kind": "reports",
                "fault": kind,
                "planted": len(own),
                "told": len(known),
                "median_s": float(np.median(known)) if known else None,
                "longest_s": max(known, default=None),
            }
        )
    return rows


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
    return [times_table(first), memory_table(first), _reports(rows), _errors(rows)]


def _reports(rows: Sequence[dict[str, Any]]) -> Table:
    names = ("fault", "planted", "told", "median_s", "longest_s")
    lines = tuple(tuple(row[name] for name in names) for row in rows if row["kind"] == "reports")
    columns = ("fault", "planted", f"told within {REPORTED:g} s", "median s", "longest s")
    notes = ("Seconds of the stream until the session says a sentence that names the stream.",)
    return Table("reports", "What the session tells", columns, (0, 0, 0, 2, 2), lines, notes)


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

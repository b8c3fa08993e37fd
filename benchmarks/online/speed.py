"""Milliseconds a frame, and memory, over ten minutes of one person on one core.

The motions of one person follow each other for as long as is told, 60 Hz video with realistic 2D, sensors at
60 and at 100 Hz. A frame is everything between two frames of the video: all samples pushed, and the estimate
asked for, the lift included. The process has one core and one thread. Other programs on the machine slow it
down, so both the time on the clock and that of the processor are given.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import platform
import time
import timeit
from argparse import Namespace
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise, product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks import harness
from benchmarks.command_line import resident_memory
from benchmarks.online.estimators import estimator, settings
from benchmarks.online.recordings import long_motion, long_recording
from benchmarks.online.streams import portions, setup_of
from rtof_kin.core.array_types import Array
from rtof_kin.live.samples import OnlineEstimate, Sample
from rtof_kin.protocols.tables import Cell, Table
from rtof_kin.recording.recording import Recording

EVERY = 10.0
"""[s] of the stream between two looks at the memory."""
WARM = 60.0
"""[s] of the stream after which memory is compared with the end."""
PERCENTILES, NAMES = (50, 90, 99, 99.9, 100), ("p50", "p90", "p99", "p99.9", "max")
STEP, MOST = 0.1, 30.0
"""[ms] steps of the counts, and where they end."""
BINS = (0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0, 15.0, 20.0, MOST)
"""[ms] of the histogram in the report."""
Work = Callable[[], list[OnlineEstimate]]
"""What is done at a tick."""
Measure = Callable[..., dict[str, Any]]
SPARE = 1000
"""Poses beyond one a frame that there is room for."""


@dataclass(frozen=True)
class Spent:
    """What a stream took."""

    clock: Array
    """(T,) ms a frame on the clock."""
    processor: Array
    """(T,) ms a frame of the processor."""
    memory_times: Array
    """(M,) s of the stream."""
    memory_mb: Array
    """(M,) resident memory, MB."""
    times: Array
    """(N,) s of the poses that were returned."""
    p_world_joint: NDArray[np.float32]
    """(N, J, 3) m."""


def host() -> dict[str, Any]:
    """Description of the machine, with the best speed of a matrix product, 10^9 operations a second."""
    model = platform.processor()
    if Path("/proc/cpuinfo").exists():
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        model = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), model)
    x, w = np.ones((576, 474), np.float32), np.ones((474, 256), np.float32)
    best = min(timeit.repeat(lambda: x @ w, timer=time.process_time, number=20, repeat=30))
    return {
        "processor": model,
        "cores": os.cpu_count(),
        "load_before": [round(load, 1) for load in os.getloadavg()],
        "matrix_product_gflops": round(2 * 20 * 576 * 474 * 256 / best / 1e9),
        "numpy": np.__version__,
        "python": platform.python_version(),
    }


def timed(recording: Recording, work: Iterable[tuple[float, Work]]) -> Spent:
    """Time the work of every tick. All that is kept of it is allocated before.

    Args:
        recording: that it is of. work: ticks, s, and what is done then.
    """
    ticks, joints = recording.video.times, len(recording.skeleton.names)
    looks = np.arange(ticks[0] + EVERY, ticks[-1], EVERY)
    spent, memory, found, look = np.zeros((2, len(ticks))), np.zeros(len(looks)), 0, 0
    times = np.ones(len(ticks) + SPARE)  # ones, so that their memory is resident
    p = np.ones((len(times), joints, 3), np.float32)
    for t, (now, step) in enumerate(work):
        clock, processor = time.perf_counter(), time.process_time()
        estimates = step()
        spent[:, t] = time.perf_counter() - clock, time.process_time() - processor
        for one in estimates:
            times[found], p[found] = one.poses.times[0], one.poses.p_world_joint[0]
            found += 1
        if look < len(looks) and now >= looks[look]:
            memory[look] = resident_memory(os.getpid()) / 1e6
            look += 1
    clocks, processors = 1e3 * spent
    return Spent(clocks, processors, looks[:look], memory[:look], times[:found], p[:found])


def steps(recording: Recording, own: Any) -> Iterator[tuple[float, Work]]:
    """What the estimator does at each frame of the video: takes the samples, and estimates."""
    live = estimator(setup_of(recording), recording.video.names, own)

    def step(now: float, samples: Sequence[Sample]) -> list[OnlineEstimate]:
        for sample in samples:
            live.push(sample)
        return list(live.advance(now))

    for now, samples in portions(recording, recording.video.times):
        yield now, partial(step, now, samples)


def drift_mb_per_hour(times: Array, memory: Array) -> float:
    """Slope of the resident memory after `WARM`, MB an hour; NaN of a short stream."""
    late = times >= WARM
    return float(3600 * np.polyfit(times[late], memory[late], 1)[0]) if late.sum() >= 3 else float("nan")


def stream(recording: Recording, own: dict[str, Any]) -> dict[str, Any]:
    """Stream a recording through the estimator."""
    return dict(vars(timed(recording, steps(recording, settings(**own)))))


def on_one_core(folder: Path, path: Path, measure: Measure, arguments: tuple[Any, ...]) -> None:
    """Measure the recording of a folder on one core; for a process of its own."""
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    logging.disable(logging.WARNING)
    np.savez(path, **measure(Recording.load(folder), *arguments))


def in_own_process(recording: Recording, measure: Measure, *arguments: Any) -> dict[str, Any]:
    """Measure a recording in a fresh process with one thread, so that its memory is the estimator's.

    Args:
        recording: loaded there. measure: gives arrays by name. arguments: its further ones.

    Raises:
        RuntimeError: the process failed.
    """
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = "1"
    with TemporaryDirectory() as name:
        folder, path = Path(name) / "recording", Path(name) / "spent.npz"
        recording.save(folder)
        work = (folder, path, measure, arguments)
        process = multiprocessing.get_context("spawn").Process(target=on_one_core, args=work)
        process.start()
        process.join()
        if process.exitcode:
            raise RuntimeError(f"the timed process ended with {process.exitcode}")
        with np.load(path) as data:
            return dict(data)


def row_of(spent: Spent) -> dict[str, Any]:
    """Percentiles, counts in steps of `STEP`, memory."""
    edges = np.arange(0.0, MOST + STEP / 2, STEP)
    times = {"processor": spent.processor, "clock": spent.clock}
    known, late = spent.memory_mb, spent.memory_times >= WARM
    return {
        "frames": len(spent.clock),
        "poses": len(spent.times),
        "ms": {
            kind: dict(zip(NAMES, np.percentile(ms, PERCENTILES).tolist(), strict=True)) for kind, ms in times.items()
        },
        "above_10_ms": {kind: float(np.mean(ms > 10.0)) for kind, ms in times.items()},
        "counts": np.histogram(np.minimum(spent.processor, MOST - STEP / 2), edges)[0].tolist(),
        "memory_s": spent.memory_times.tolist(),
        "memory_mb": known.tolist(),
        "after_1_min_mb": float(known[late][0]) if late.any() else None,
        "at_end_mb": float(known[-1]) if len(known) else None,
        "drift_mb_per_hour": drift_mb_per_hour(spent.memory_times, known),
    }


def rows_of(options: Namespace) -> list[dict[str, Any]]:
    """A row of each case."""
    clip = long_motion(options.corpus, options.person, options.seconds or 600.0)
    rows, machine = [], host()
    for sensors, rate in product(options.sensors, options.rates):
        recording = long_recording(clip, harness.SENSOR_SETS[sensors], rate, options.seed)
        for lag in options.lags:
            spent = Spent(**in_own_process(recording, stream, {"confidence": options.confidence, "lag_s": lag}))
            late = f", lag {lag:g} s" if lag else ""
            rows.append({"case": f"{sensors} sensors at {rate:g} Hz{late}", "host": machine} | row_of(spent))
    return rows


def tables(rows: Sequence[dict[str, Any]]) -> list[Table]:
    """Times, histogram and memory."""
    return [times_table(rows), _histogram(rows), memory_table(rows)]


def times_table(rows: Sequence[dict[str, Any]]) -> Table:
    """How long frames take."""
    lines = [
        (row["case"], kind, *row["ms"][kind].values(), 100 * row["above_10_ms"][kind])
        for row in rows
        for kind in ("processor", "clock")
    ]
    columns = ("case", "time", *(f"{name} ms" for name in NAMES), "above 10 ms %")
    machine = rows[0].get("host", {})
    notes = (
        "60 frames a second, 16.7 ms each. Goals: p50 3 ms, p99 6 ms; at lag 1 s 1.5 times that.",
        *(f"{name.replace('_', ' ')}: {value}" for name, value in machine.items()),
    )
    return Table("times", "Time of a frame", columns, (0, 0, 2, 2, 2, 2, 1, 2), tuple(lines), notes)


def _histogram(rows: Sequence[dict[str, Any]]) -> Table:
    lines: list[tuple[Cell, ...]] = []
    for low, high in pairwise(BINS):
        part = slice(round(low / STEP), round(high / STEP))
        lines.append((f"{low:g} to {high:g}", *(float(sum(row["counts"][part])) for row in rows)))
    columns = ("ms of the processor", *(row["case"] for row in rows))
    notes = (f"Longer ones count as {MOST:g} ms.",)
    return Table("histogram", "Frames by time", columns, (0,) * len(columns), tuple(lines), notes)


def memory_table(rows: Sequence[dict[str, Any]]) -> Table:
    """Resident memory over time."""
    names = ("frames", "poses", "after_1_min_mb", "at_end_mb", "drift_mb_per_hour")
    lines = tuple((row["case"], *(row[name] for name in names)) for row in rows)
    columns = ("case", "frames", "poses", "MB after 1 min", "MB at the end", "MB/hour")
    notes = ("Of the process with the whole recording. MB/hour of stream: slope after the first minute.",)
    return Table("memory", "Resident memory", columns, (0, 0, 0, 1, 1, 1), lines, notes)

"""Where the time of a reconstruction goes: processor and clock by stage, cold and warm, on one core and on two.

``python -m benchmarks profile`` runs ``rtof-kin reconstruct`` on recordings of some lengths, made from the demo, each
in a process of its own; ``--video FILE`` adds ``rtof-kin detect``. *Cold* has an empty cache: the energy is compiled.
*start* is what lies before the first stage and between stages: the interpreter, imports, reading, writing motion.h5.
Of several processes, stages are of the first one, which waits for the others in *parts*. *run* goes from
the files of a phone and sensors, with a camera that is not calibrated, to the report, with the certificate. Run nothing
else beside it.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import wraps
from importlib import import_module
from pathlib import Path
from typing import Any, Final

from benchmarks.command_line import study_parser, table_head
from benchmarks.long_recording import long_recording
from rtof_kin.core.environment import processor
from rtof_kin.core.resources import model_path
from rtof_kin.recording.recording import Recording
from rtof_kin.simulation.simulate import write_raw_files

STAGES: Final = {
    "lift": ("rtof_kin.reconstruction.prepare:lift",),
    "setup": ("rtof_kin.reconstruction.parts:estimate_setup",),
    "energy": ("rtof_kin.solve.joint_space.observations:built_energy",),
    "solve": ("rtof_kin.solve.joint_space.solver:_Fragments._solve",),
    "covariances": (
        "rtof_kin.solve.joint_space.solver:state_covariances",
        "rtof_kin.solve.joint_space.solver:confidence_of",
        "rtof_kin.reconstruction.pipeline:with_covariances",
    ),
    "checks": ("rtof_kin.reconstruction.checks:run",),
    "parts": ("rtof_kin.core.jobs.processes:wait",),
    "export": ("rtof_kin.reporting.export:write_motion_files", "rtof_kin.body.motion_file:MotionWriter.append"),
    "detect": ("rtof_kin.vision.video:detect_video",),
}
"""Stage -> functions whose time it is, without that of other stages inside."""


def profiled(arguments: list[str]) -> None:
    """Run a command in this process and print its stages, s of the processor and of the clock, as JSON."""
    began = time.time() - float(os.environ["RTOF_KIN_BEGAN"])
    spent = {name: [0.0, 0.0] for name in ("start", *STAGES)}
    inside = ["start"]
    last = [0.0, time.perf_counter() - began]

    def switch() -> None:
        now = [time.process_time(), time.perf_counter()]
        for i in range(2):
            spent[inside[-1]][i] += now[i] - last[i]
        last[:] = now

    def timed(stage: str, function: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(function)
        def call(*args: Any, **named: Any) -> Any:
            switch()
            inside.append(stage)
            try:
                return function(*args, **named)
            finally:
                switch()
                inside.pop()

        return call

    from rtof_kin.cli import dispatch

    for stage, functions in STAGES.items():
        for place in functions:
            module, _, path = place.partition(":")
            if arguments[0] == "detect" and stage != "detect":
                continue
            if arguments[0] != "detect" and stage == "detect":
                continue
            *owners, name = path.split(".")
            holder = import_module(module)
            for owner in owners:
                holder = getattr(holder, owner)
            setattr(holder, name, timed(stage, getattr(holder, name)))
    dispatch(arguments)
    switch()
    print(json.dumps(spent))


def measured(arguments: list[str], cache: Path | None = None) -> dict[str, Any]:
    """Stages of a command in a process of its own, with all of its processes' processor time, clock and peak memory."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "RTOF_KIN_BEGAN": repr(time.time())}
    if cache is not None:
        environment["RTOF_KIN_CACHE"] = str(cache)
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    command = [sys.executable, "-m", "benchmarks.profile", "--command", *map(str, arguments)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    wall, after = time.perf_counter() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {"cpu_s": cpu, "wall_s": wall, "stages": json.loads(done.stdout.splitlines()[-1])}


def table(rows: list[tuple[str, dict[str, Any]]]) -> str:
    """The rows as a table: totals, then processor seconds of the first process by stage."""
    lines = table_head(" | ".join(["", "clock s", "processor s", *("start", *STAGES)]))
    for name, row in rows:
        cells = [wall if stage == "parts" else cpu for stage, (cpu, wall) in row["stages"].items()]
        lines.append(" | ".join([f"| {name}", *(f"{x:.2f}" for x in (row["wall_s"], row["cpu_s"], *cells))]) + " |")
    return "\n".join(lines)


def main() -> None:
    """Run the command."""
    if sys.argv[1:2] == ["--command"]:
        profiled(sys.argv[2:])
        return
    parser = study_parser("profile", __doc__, motion=False, page="{}.md")
    parser.add_argument("--minutes", type=float, nargs="+", default=[5.0, 60.0], help="long recordings")
    parser.add_argument("--video", type=Path, help="also detect people in it")
    options = parser.parse_args()
    rows: list[tuple[str, dict[str, Any]]] = []

    def measure(name: str, *arguments: str, cache: Path | None = None) -> None:
        rows.append((name, measured(list(arguments), cache)))
        print(table(rows[-1:]).splitlines()[-1], flush=True)

    with tempfile.TemporaryDirectory() as temporary:
        place = Path(temporary)
        demo, short = model_path("demo"), place / "short"
        Recording.load(demo).between(0.0, 8.0).save(short)
        common = "-o", str(place / "out"), "--overwrite", "--threads"
        measure("8 s, cold", "reconstruct", str(short), *common, "1", cache=place / "cache")
        for name, recording in (("8 s", short), ("24 s", demo)):
            measure(name, "reconstruct", str(recording), *common, "1")
        write_raw_files(Recording.load(demo), place / "files")
        files = [str(place / "files" / name) for name in ("keypoints.csv", "dots", "places.csv")]
        for cores in ("1", "2"):
            told = ("--size", "1920x1080", "--height", "1.73", "-o", str(place / f"run_{cores}"), "--threads", cores)
            measure(f"24 s of raw files, `run`, {cores} cores", "run", *files, *told)
        for minutes in options.minutes:
            long_recording(place / "long", minutes, overwrite=True)
            for cores in ("1", "2"):
                measure(f"{minutes:g} min, {cores} cores", "reconstruct", str(place / "long"), *common, cores)
        if options.video:
            measure(f"detect {options.video.name}", "detect", str(options.video), "-o", str(place / "points.npz"))
    text = f"{__doc__}\nOn {processor()}, {os.cpu_count()} cores.\n\n{table(rows)}\n"
    options.out.write_text(text, encoding="utf-8")
    print(f"wrote {options.out}")


if __name__ == "__main__":
    main()

"""Memory and time of the commands that take a motion, on motions of a minute and an hour.

The motion is that of a folder with its measurements, at 60 Hz with 8 sensors, repeated forth and back. Each command
runs in a process of its own; times are of the processor. An hour may cost 60 times as much as a minute, and at most
`MOST_MB`, else the exit code is 1. Recordings are made by `long_recording`: ``--recording FOLDER`` inspects one.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from rtof_kin.body.motion_file import COVARIANCES, MOTION, MotionWriter
from rtof_kin.body.skeleton import Motion
from rtof_kin.data.keypoints import Measurements
from rtof_kin.formats.measurements_file import MEASUREMENTS, MeasurementsWriter, measurements_path, read_measurements

RATE_HZ: Final = 60
BLOCK: Final = 3600
POSES: Final = (
    "p_world_joint",
    "R_world_bone",
    "provenance",
    "valid",
    "orientation_observed",
    "direction_observed",
    "sigma_rad",
)
MOST_MB: Final = 700.0  #: [MB] most memory of a command and of the processes it starts, each
FORMATS: Final = ("csv,parquet,ros", "npz", "osim,mot,sto,trc", "c3d", "bvh,bvh-lafan1", "mjcf", "glb", "rrd", "mcap")
FILM: Final = ("--no-video", "--stop", "20", "--width", "640")
REPLAYED: Final = ("--speed", "inf", "--seconds", "20")
MOTION_FOLDER, RECORDING, OUTPUT = "MOTION", "RECORDING", "OUTPUT"  #: What they stand for in `COMMANDS`
COMMANDS: Final = {
    "analyse": ("report", MOTION_FOLDER, "--weight", "70", "--analysis", OUTPUT),
    "report": ("report", MOTION_FOLDER, "-o", OUTPUT),
    "report with torques": ("report", MOTION_FOLDER, "--weight", "70", "-o", OUTPUT),
    "inspect": ("inspect", MOTION_FOLDER),
    "inspect the recording": ("inspect", RECORDING, "--all"),
    "live, 20 s of a replay": ("live", RECORDING, "--camera", RECORDING, "--imus", RECORDING, *REPLAYED),
    "overlay of 20 s": ("overlay", MOTION_FOLDER, "-o", f"{OUTPUT}.mp4", *FILM),
    "view --html of 5 minutes": ("view", MOTION_FOLDER, "--html", f"{OUTPUT}.html", "--stop", "300"),
    "compare the sides": ("compare", MOTION_FOLDER, "--sides", "-o", OUTPUT),
    "evaluate": ("evaluate", MOTION_FOLDER, "--truth", RECORDING, "--clinical"),
    "compare": ("compare", MOTION_FOLDER, MOTION_FOLDER, "-o", OUTPUT),
    **{f"export {names}": ("export", MOTION_FOLDER, "-o", OUTPUT, "--to", names) for names in FORMATS},
}


def repeated(motion: Motion, start: int, stop: int) -> Motion:
    """Return frames [start, stop) of a motion that goes forth and back.

    Args:
        motion: with a confidence. start, stop: frames.
    """
    T = len(motion.q)
    frames = np.concatenate([np.arange(T), np.arange(T - 2, 0, -1)])[np.arange(start, stop) % (2 * T - 2)]
    times, poses, known = np.arange(start, stop) / RATE_HZ, motion.poses, motion.confidence
    poses = replace(poses, times=times, **{name: getattr(poses, name)[frames] for name in POSES})
    if known is not None:
        known = replace(known, times=times, **{name: getattr(known, name)[frames] for name in COVARIANCES})
    q = motion.q[frames]
    return Motion(motion.skeleton, q, poses, motion.skeleton.check(q), known)


def repeated_measurements(given: Measurements, start: int, stop: int) -> Measurements:
    """Return frames [start, stop) of measurements that go forth and back, as `repeated`."""
    T = len(given.times)
    frames = np.concatenate([np.arange(T), np.arange(T - 2, 0, -1)])[np.arange(start, stop) % (2 * T - 2)]

    def rows(record: Any, **others: Any) -> Any:
        own = {one.name: getattr(record, one.name) for one in fields(record) if one.name != "times"}
        own = {name: array[frames] for name, array in own.items() if isinstance(array, np.ndarray) and len(array) == T}
        return replace(record, times=np.arange(start, stop) / RATE_HZ, **(own | others))

    truth = None if given.truth is None else rows(given.truth)
    return rows(given, views=tuple(map(rows, given.views)), truth=truth)


def write_repeated(path: Path, motion: Motion, minutes: float) -> None:
    """Write a longer motion.

    Args:
        path: the file. motion: what is repeated. minutes: length.
    """
    frames = round(60 * RATE_HZ * minutes)
    with MotionWriter(path, motion.skeleton, mode="rtof") as writer:
        for start in range(0, frames, BLOCK):
            writer.append(repeated(motion, start, min(start + BLOCK, frames)))


def measured(command: tuple[str, ...], output: Path, **paths: Path | None) -> dict[str, float]:
    """Return processor time, s, peak resident memory, MB, and size of the output, MB, of a command.

    Args:
        command: name and options. output: to write, alone in its folder. paths: by `MOTION_FOLDER` and `RECORDING`.
    """
    code = "import sys; from rtof_kin.cli import main; sys.exit(main(sys.argv[1:]))"
    arguments = [str(paths.get(word, word)).replace(OUTPUT, str(output)) for word in command]
    process = subprocess.Popen([sys.executable, "-c", code, *arguments], stdout=subprocess.DEVNULL)
    _, status, used = os.wait4(process.pid, 0)
    if os.waitstatus_to_exitcode(status) not in (0, 1):  # 1: a check of inspect does not hold
        raise RuntimeError(f"{' '.join(arguments)}: failed")
    files = [path for path in output.parent.rglob("*") if path.is_file()]
    return {
        "cpu_s": used.ru_utime + used.ru_stime,
        "peak_mb": used.ru_maxrss / 1024,
        "output_mb": sum(path.stat().st_size for path in files) / 1e6,
    }


def main() -> None:
    """Measure one length and one command, or all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("motion", type=Path, help="output folder of reconstruct, e.g. of the demo")
    parser.add_argument("--minutes", type=float, nargs="+", default=[1, 60])
    parser.add_argument("--only", choices=[*COMMANDS], nargs="+", default=[*COMMANDS])
    parser.add_argument("--keep", type=Path, help="folder of the long motions, to use them again")
    parser.add_argument("--recording", type=Path, help="folder of long_recording, as long as the longest motion")
    options = parser.parse_args()
    most = 0.0
    with tempfile.TemporaryDirectory() as temporary:
        for minutes in options.minutes:
            folder = (options.keep or Path(temporary)) / f"{minutes:g}_minutes"
            if not folder.exists():
                folder.mkdir(parents=True)
                shutil.copy(options.motion / "summary.json", folder)
                write_repeated(folder / MOTION, Motion.load(options.motion), minutes)
                given = read_measurements(measurements_path(options.motion))
                with MeasurementsWriter(folder / MEASUREMENTS) as writer:
                    for start in range(0, round(60 * RATE_HZ * minutes), BLOCK):
                        stop = min(start + BLOCK, round(60 * RATE_HZ * minutes))
                        writer.append(repeated_measurements(given, start, stop))
            for name in options.only:
                if RECORDING in COMMANDS[name] and (options.recording is None or minutes < max(options.minutes)):
                    continue
                (written := Path(temporary) / "written").mkdir()
                found = measured(COMMANDS[name], written / "output", MOTION=folder, RECORDING=options.recording)
                most = max(most, found["peak_mb"])
                print(json.dumps({"minutes": minutes, "command": name} | found), flush=True)
                shutil.rmtree(written)
    if most > MOST_MB:
        sys.exit(f"{most:.0f} MB are more than {MOST_MB:g}")


if __name__ == "__main__":
    main()

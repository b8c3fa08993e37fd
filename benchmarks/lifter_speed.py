"""Speed of the lifter on one thread: a long recording at once, and frame by frame.

``python -m benchmarks lifter_speed`` repeats the demo recording (60 Hz, 21 landmarks, 8 sensors) and
writes results/lifter_speed.json and .md. Other programs slow all of this down, so the time on the clock and
that of the processor are given, of pushes also the median of the best 50 in a row, and the speed of one
matrix product.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from lifting.predict import Lifter
from lifting.streaming import StreamingLifter
from rtof_kin.core.resources import model_path
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.recording.recording import Recording

RESULTS = Path(__file__).parent / "results"
RATE_HZ = 60.0
LOOKAHEADS = ((0,), (0, 4, 13))
LIMBS = tuple(f"{side}{part}" for side in ("Left", "Right") for part in ("Arm", "ForeArm", "UpLeg", "Leg"))


def scene(frames: int) -> tuple[KeypointSequence, BoneImuSequence, Any]:
    """The demo recording again and again, with true orientations of eight segments, and joint offsets."""
    demo = Recording.load(model_path("demo"))
    assert demo.truth is not None
    names, truth = demo.skeleton.names, demo.truth
    turns = np.resize(np.arange(len(truth.times)), frames)
    times = np.arange(frames) / RATE_HZ
    uv = demo.keypoints.camera.project(truth.p_world_joint[turns])
    keypoints = KeypointSequence(demo.keypoints.camera, times, uv, np.ones((frames, len(names))), names)
    R = truth.R_world_bone[turns][:, [names.index(joint) for joint in LIMBS]]
    n = len(LIMBS)
    imus = BoneImuSequence(times, R, np.zeros((frames, n, 3)), np.zeros((n, 3)), LIMBS)
    return keypoints, imus, demo.skeleton.table.offsets


def timed(work: Callable[[], object]) -> tuple[float, float]:
    """Seconds on the clock and of the processor."""
    clock, processor = time.perf_counter(), time.process_time()
    work()
    return time.perf_counter() - clock, time.process_time() - processor


def batch(lifter: Lifter, frames: int, repeats: int) -> dict[str, Any]:
    """Frames per second of `predict`, with and without the mirrored scene."""
    keypoints, imus, offsets = scene(frames)
    rows = {}
    for flip in (True, False):
        spent = np.array(
            [
                timed(
                    lambda flip=flip: lifter.predict(  # type: ignore[misc]
                        keypoints, offsets, bone_imus=imus, floor_height=0.0, flip=flip
                    )
                )
                for _ in range(repeats)
            ]
        )
        names = ("clock", "processor")
        rows["mirror averaged" if flip else "single"] = {
            f"{kind}_{name}": round(frames / float(seconds))
            for i, name in enumerate(names)
            for kind, seconds in (("best", spent[:, i].min()), ("median", np.median(spent[:, i])))
        }
    return rows


def streaming(lifter: Lifter, frames: int) -> dict[str, Any]:
    """Milliseconds per `push`: median and 99th percentile, and the median of the best 50 in a row."""
    keypoints, imus, offsets = scene(frames)
    sensed = [dict(zip(imus.joints, R, strict=True)) for R in imus.R_world_bone]
    rows = {}
    for lookaheads in LOOKAHEADS:
        for flip in (True, False):
            stream = StreamingLifter(lifter, keypoints.camera, offsets, 0.0, lookaheads=lookaheads, flip=flip)
            spent = (
                1000
                * np.array(
                    [
                        timed(
                            lambda t=t, stream=stream: stream.push(  # type: ignore[misc]
                                keypoints.times[t], keypoints.uv_px[t], keypoints.confidence[t], sensed[t]
                            )
                        )
                        for t in range(frames)
                    ]
                )[frames // 10 :]
            )
            row = {}
            for i, name in enumerate(("clock", "processor")):
                row[f"median_{name}_ms"], row[f"p99_{name}_ms"] = np.percentile(spent[:, i], [50, 99])
                row[f"best_{name}_ms"] = min(
                    np.median(spent[first : first + 50, i]) for first in range(0, len(spent) - 49, 50)
                )
            name = "mirror averaged" if flip else "single"
            ks = ", ".join(map(str, lookaheads))
            rows[f"{name}, k = {ks}"] = {key: round(float(value), 3) for key, value in row.items()}
    return rows


def product_speed() -> float:
    """Best speed of the network's first matrix product, 10^9 operations per second."""
    x, w = torch.randn(576, 474), torch.randn(474, 256)
    best = min(timed(lambda: [x @ w for _ in range(20)])[1] for _ in range(30))
    return 2 * 20 * 576 * 474 * 256 / best / 1e9


def host() -> dict[str, Any]:
    """Description of the machine."""
    model = platform.processor()
    if Path("/proc/cpuinfo").exists():
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        model = next((x.split(":", 1)[1].strip() for x in lines if x.startswith("model name")), model)
    return {
        "processor": model,
        "cores": os.cpu_count(),
        "load_before": [round(x, 1) for x in os.getloadavg()],
        "matrix_product_gflops": round(product_speed()),
        "torch": torch.__version__,
        "python": platform.python_version(),
    }


def markdown(result: dict[str, Any]) -> str:
    """Both tables."""
    machine = result["host"]
    lines = [
        "# Speed of the lifter, one thread",
        "",
        f"`{result['command']}`: {machine['processor']}, {machine['cores']} cores, load before "
        f"{machine['load_before'][0]:g}; a matrix product at {machine['matrix_product_gflops']} GFLOP/s. "
        f"{result['channels']} channels, receptive field {result['receptive_field']}, 60 Hz, "
        "21 landmarks, 8 sensors.",
        "",
        f"## `Lifter.predict` of {result['frames']} frames",
        "",
        "| | frames/s, processor time: best | median | frames/s, clock: best | median |",
        "|---|---|---|---|---|",
    ]
    keys = ("best_processor", "median_processor", "best_clock", "median_clock")
    lines += [
        f"| {name} | " + " | ".join(f"{row[key]:,}" for key in keys) + " |" for name, row in result["batch"].items()
    ]
    lines += [
        "",
        f"## `StreamingLifter.push` of {result['pushes']} frames",
        "",
        "| lookaheads | ms, processor time: best 50 | median | 99 % | ms, clock: best 50 | median | 99 % |",
        "|---|---|---|---|---|---|---|",
    ]
    keys = tuple(f"{kind}_{name}_ms" for name in ("processor", "clock") for kind in ("best", "median", "p99"))
    lines += [
        f"| {name} | " + " | ".join(f"{row[key]:.2f}" for key in keys) + " |"
        for name, row in result["streaming"].items()
    ]
    return "\n".join(lines) + "\n"


def main(arguments: list[str] | None = None) -> int:
    """Measure, write and print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks lifter_speed", description=__doc__)
    parser.add_argument("--lifter", default="live", help="a file, or a shipped one by name")
    parser.add_argument("--frames", type=int, default=6000, help="of the recording")
    parser.add_argument("--pushes", type=int, default=1500, help="frames pushed one by one")
    parser.add_argument("--repeats", type=int, default=5, help="of the recording")
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder for the results")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    lifter = Lifter.load(options.lifter)
    given = sys.argv[1:] if arguments is None else arguments
    result = {
        "command": " ".join(["OMP_NUM_THREADS=1 python -m benchmarks lifter_speed", *given]),
        "host": host(),
        "channels": lifter.description.network.channels,
        "receptive_field": lifter.receptive_field(),
        "frames": options.frames,
        "pushes": options.pushes,
        "batch": batch(lifter, options.frames, options.repeats),
        "streaming": streaming(lifter, options.pushes),
    }
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "lifter_speed.json").write_text(json.dumps(result, indent=1) + "\n")
    (options.out / "lifter_speed.md").write_text(markdown(result))
    print(markdown(result))
    return 0


if __name__ == "__main__":
    sys.exit(main())

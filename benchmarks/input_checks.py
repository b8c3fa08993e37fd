"""Is wrong input named, and only wrong input?

``python -m benchmarks.input_checks --corpus DIR`` plants the mistakes of `FAULTS` one by one in simulated
recordings of subjects no limit was set on, and counts how often a check fails, and how often the first
that fails names it. Recordings without a mistake are reconstructed as a whole and count false alarms.
Kinds of 2D, numbers of sensors and cameras take turns, and half of the recordings declare their floor.
``--detector FOLDER`` adds 33 points with errors drawn from a model of real ones
(``sample_detector_errors.py``).
"""

from __future__ import annotations

import argparse
import importlib.util
import time
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import track

from benchmarks import harness
from lifting.predict import Lifter
from rtof_kin.core.plausibility import Check
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.reconstruction.camera_checks import UNVERIFIED, check_camera_alone
from rtof_kin.reconstruction.image_checks import exchanged_axes, exchanged_sides, mirrored, upside_down
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.recording.recording import Recording
from rtof_kin.simulation.mocap import MocapClip, read_corpus, resample_clip
from rtof_kin.simulation.simulate import low_passed, simulate, standard_cameras
from rtof_kin.vision.detections import Detections
from rtof_kin.vision.keypoints import keypoints_from_detections

RESULTS = harness.HERE / "results"
SUBJECTS = {
    "tune": ["CMU005", "CMU006", "CMU008", "CMU010", "CMU131", "SNU"],
    "test": ["CMU002", "CMU003", "CMU007", "CMU009", "CMU012", "CMU014", "CMU016", "CMU035", "Meredith",
             "rokoko"],
}  # fmt: skip
"""Limits were set on the first."""
KINDS, SENSORS = ("perfect", "white", "realistic", "detector"), ("0", "4", "8", "10")
SECONDS, SHORTEST, CLIPS, CAMERAS = 5.0, 1.4, 8, 2
Plant = Callable[[Recording], Recording]


@dataclass(frozen=True)
class Fault:
    """One mistake, and how it is to be named."""

    plant: Plant
    named: str
    """A part of the first cause; empty where nothing may fail."""
    whole: bool = False
    """True if its checks need the reconstructed motion."""


def seen(change: Callable[[KeypointSequence], KeypointSequence]) -> Plant:
    """A mistake in the keypoints."""
    return lambda r: replace(r, keypoints=change(r.video))


def camera(**changes: Callable[[Any], Any]) -> Plant:
    """A mistake in fields of the camera."""

    def plant(recording: Recording) -> Recording:
        video = recording.video
        fields = {name: change(getattr(video.camera, name)) for name, change in changes.items()}
        return replace(recording, keypoints=replace(video, camera=replace(video.camera, **fields)))

    return plant


def focal(factor: float) -> Plant:
    """A wrong focal length."""
    return camera(K=lambda K: K * [[factor, factor, 1], [factor, factor, 1], [1, 1, 1]])


def floor(higher: float) -> Plant:
    """A floor that is not where the person stands."""
    return lambda r: replace(r, floor_height=(r.floor_height or 0.0) + higher)


def turned(clockwise: bool) -> Plant:
    """A video that was turned by 90 degrees."""

    def change(k: KeypointSequence) -> KeypointSequence:
        u, v = k.uv_px[..., 0], k.uv_px[..., 1]
        width, height = k.camera.width_px, k.camera.height_px
        uv = np.stack([height - v, u] if clockwise else [v, width - u], axis=-1)
        return replace(k, uv_px=uv)

    return seen(change)


def frozen(k: KeypointSequence) -> KeypointSequence:
    """A detector that repeats one frame for a second, or two thirds of a shorter recording."""
    first = len(k) // 3
    held = (k.times >= k.times[first]) & (k.times <= k.times[first] + 1.0)
    uv, confidence = k.uv_px.copy(), k.confidence.copy()
    uv[held], confidence[held] = uv[first], confidence[first]
    return replace(k, uv_px=uv, confidence=confidence)


FAULTS: dict[str, Fault] = {
    "none": Fault(lambda r: r, "", whole=True),
    "camera's translation in mm": Fault(camera(t_camera_world=lambda t: 1000 * t), "millimetres"),
    "focal length x 0.5": Fault(focal(0.5), "focal length"),
    "focal length x 1.2": Fault(focal(1.2), "focal length", whole=True),
    "bones x 1.2": Fault(lambda r: replace(r, joint_offsets=1.2 * r.joint_offsets), "bones", whole=True),
    "floor 1 m too high": Fault(floor(1.0), "floor"),
    "floor 1 m too low": Fault(floor(-1.0), "floor"),
    "keypoints of a half-size picture": Fault(
        seen(lambda k: replace(k, uv_px=k.uv_px / 2)), "picture 2 times smaller"
    ),
    "names of left and right exchanged": Fault(seen(exchanged_sides), "left and right"),
    "mirrored picture": Fault(seen(mirrored), "picture is mirrored"),
    "u and v exchanged": Fault(seen(exchanged_axes), "u and v"),
    "world y up": Fault(
        camera(R_camera_world=lambda R: R @ [[1, 0, 0], [0, 0, -1], [0, 1, 0]]), "+y points up"
    ),
    "upside down": Fault(seen(upside_down), "upside down"),
    "turned by 90 degrees": Fault(turned(True), "90 degrees clockwise"),
    "turned by -90 degrees": Fault(turned(False), "90 degrees anticlockwise"),
    "frozen keypoints": Fault(seen(frozen), "frozen"),
    "assumed pose of the camera": Fault(camera(assumed=lambda _: ("pose",)), UNVERIFIED),
}
"""Name -> mistake; sensors' need `whole=True`. A `plant` that finds nothing to spoil returns the
recording itself, which is then left out."""


def planted(fault: Fault, recording: Recording) -> Recording | None:
    """The recording with a mistake; None where it has nothing to make it with."""
    wrong = fault.plant(recording)
    return None if wrong is recording and fault.named else wrong


def recordings(corpus: Path, subjects: list[str], detector: Path | None, seed: int) -> Iterator[Recording]:
    """Clips of subjects, each watched by some cameras; kinds of 2D and sensors take turns."""
    sample = None if detector is None else _sampler(detector)
    kinds = KINDS if sample else KINDS[:-1]
    count, of_subject = 0, Counter[str]()
    for clip in read_corpus(corpus, subjects, output_rate_hz=120.0):
        of_subject[clip.subject] += 1
        short = len(clip.poses) < SHORTEST * clip.poses.rate_hz
        if "GLITCH" in clip.quality or of_subject[clip.subject] > CLIPS or short:
            continue
        clip = harness.middle(resample_clip(low_passed(clip, 10.0), 60.0), SECONDS)
        for _ in range(CAMERAS):
            kind = kinds[count % len(kinds)]
            sensors = SENSORS[(count // len(kinds) + count) % len(SENSORS)]
            r = _recorded(clip, kind, sensors, seed + count, sample)
            yield replace(r, floor_height=0.0 if count // 2 % 2 else None)
            count += 1


def _recorded(
    clip: MocapClip, kind: str, sensors: str, seed: int, sample: Callable[..., Any] | None
) -> Recording:
    seed += zlib.crc32(clip.name.encode()) % 100_000
    view = standard_cameras(clip.poses, seed)[seed % 4]
    settings = harness.KEYPOINTS["realistic" if kind == "detector" else kind]()
    r = simulate(
        clip.poses, clip.joint_offsets, camera=view, seed=seed, name=f"{clip.name}, {kind}, {sensors}",
        settings=replace(settings, sensors=harness.SENSOR_SETS.get(sensors, ())),
    )  # fmt: skip
    if kind != "detector" or sample is None:
        return r
    p, R = clip.poses.p_world_joint, clip.poses.R_world_bone
    uv, visibility = sample(p, R, view.K, view.R_camera_world, view.t_camera_world, seed)
    confidence = np.where(np.isfinite(uv).all(axis=-1), visibility, 0.0)
    found = keypoints_from_detections(
        Detections(uv[:, None], confidence[:, None]), clip.poses.times, view, "mediapipe33"
    )
    return replace(r, keypoints=found.keypoints, truth=None)


def _sampler(folder: Path) -> Callable[..., Any]:
    spec = importlib.util.spec_from_file_location("sampler", folder / "sample_detector_errors.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    sample: Callable[..., Any] = module.sample
    return sample


def checks_of(recording: Recording, fault: Fault, lifter: Lifter) -> tuple[Check, ...]:
    """Run the checks, with or without a reconstruction."""
    if not fault.whole:
        return check_camera_alone(recording, recording.skeleton, lifter)
    mode = "rto" if recording.imus is None else "rtof"
    return reconstruct(recording, mode=mode, lifter=lifter, calibrate=False).checks


def row_of(recording: Recording, name: str, lifter: Lifter) -> dict[str, Any] | None:
    """One recording with one mistake."""
    fault = FAULTS[name]
    wrong = planted(fault, recording)
    if wrong is None:
        return None
    started = time.perf_counter()
    failed = [check for check in checks_of(wrong, fault, lifter) if check.failed]
    first = failed[0].cause if failed else ""
    return {
        "recording": recording.name, "floor": recording.floor_height is not None, "fault": name,
        "failed": bool(failed), "named": fault.named in first if fault.named else not failed,
        "first": first, "seconds": round(time.perf_counter() - started, 3),
    }  # fmt: skip


def table(rows: list[dict[str, Any]]) -> str:
    """Shares of recordings, all and by sensors, as Markdown."""
    lines = [
        "| fault | recordings | a check fails | the first names it | with sensors | without |",
        "|---|---|---|---|---|---|",
    ]
    for fault in FAULTS:
        own = [row for row in rows if row["fault"] == fault]
        alone = [row for row in own if row["recording"].endswith(", 0")]
        sensed = [row for row in own if row not in alone]
        column = "failed" if fault == "none" else "named"
        cells = [_share(own, "failed"), _share(own, "named" if fault != "none" else "-"),
                 _share(sensed, column), _share(alone, column)]  # fmt: skip
        if own:
            lines.append(f"| {fault} | {len(own)} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _share(rows: list[dict[str, Any]], column: str) -> str:
    if not rows or column == "-":
        return "-"
    return f"{100 * float(np.mean([row[column] for row in rows])):.0f} %"


def main(arguments: list[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.input_checks", description=__doc__)
    parser.add_argument("--corpus", type=Path, required=True, help="folder of free motion")
    parser.add_argument("--detector", type=Path, help="folder of sample_detector_errors.py")
    parser.add_argument("--subset", choices=list(SUBJECTS), default="test")
    parser.add_argument("--faults", help="only these, separated by commas")
    parser.add_argument("--recordings", type=int, help="only the first so many")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=RESULTS / "input_checks.json")
    o = parser.parse_args(arguments)
    lifter = Lifter.load()
    chosen = [r for r in recordings(o.corpus, SUBJECTS[o.subset], o.detector, o.seed)][: o.recordings]
    names = o.faults.split(",") if o.faults else list(FAULTS)
    found = (row_of(r, name, lifter) for r in track(chosen, "recordings") for name in names)
    rows = [row for row in found if row is not None]
    text = (
        f"Mistakes planted in simulated recordings of the {o.subset} subjects, `python -m "
        "benchmarks.input_checks`. Of recordings without one, a check that fails is a false alarm.\n\n"
        + table(rows)
    )
    harness.write_results(o.out, rows, text)
    print(text)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

"""From raw files to a motion: what it costs that nothing is calibrated, synchronised or named.

``python -m benchmarks from_raw --corpus DIR --cameras 2``: recordings of 20 s of held-out people and rigs, 30 images a
second with a simulated detector's 33 points, eight sensors at 60 Hz and none. *given* has the true camera,
bones, clock, segments, and the sensors' usual errors of mounting and heading; *given, usual bones* has the
person's height instead of the bones, as *raw* does: rigs put the root elsewhere (up to 10 cm), which is
most of root-relative errors. *raw* has the files that a user has: the detector's points, a CSV of sensors
without names on a clock up to ten minutes off, each with a heading of its own and turned in its case at
random, and the person's height (1 % off). `rtof_kin.setup.init` makes the recording, and it is
reconstructed as ``rtof-kin run`` does. *raw, map* has a map of the sensors too. Errors of raw recordings
are in the world of the true camera's place and heading.
"""

from __future__ import annotations

import json
import tempfile
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.random import Generator

from benchmarks import harness, scoring
from benchmarks.command_line import study_parser
from benchmarks.uncalibrated_camera import clips
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.files.text import write_text
from rtof_kin.data.camera import Camera
from rtof_kin.data.poses import PoseSequence
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.recording.recording import Recording
from rtof_kin.setup.init import find_people, read_findings, write_recording
from rtof_kin.setup.settings import SetupSettings
from rtof_kin.setup.sources import Sources
from rtof_kin.simulation.detector_errors import simulate_detections
from rtof_kin.simulation.mocap import MocapClip
from rtof_kin.simulation.simulate import SimulationSettings, simulate, standard_cameras
from rtof_kin.vision.detections import Detections
from rtof_kin.vision.keypoints import keypoints_from_detections
from rtof_kin.vision.video import write_detections

Row = dict[str, Any]
REACH = 600.0
"""[s] Largest offset of the sensors' clock."""
CASES = ("given", "given, usual bones", "raw", "raw, map")
FIGURES = {
    "mpjpe_rr_mm": "rr mm",
    "mpjpe_mm": "abs mm",
    "flexion_deg": "flexion deg",
    "angle_deg": "joints deg",
    "hips_deg": "hips deg",
    "inside_relative": "relative inside 95 %",
    "inside_world": "world inside 95 %",
}


def simulated(clip: MocapClip, camera: int, sensors: str, rng: Generator) -> tuple[Recording, Detections]:
    """The recording as given, and what the detector found."""
    seed = zlib.crc32(clip.name.encode()) + camera
    settings = replace(SimulationSettings.realistic(), sensors=harness.SENSOR_SETS.get(sensors, ()))
    right = standard_cameras(clip.poses, seed)[camera]
    made = simulate(clip.poses, clip.joint_offsets, camera=right, settings=settings, seed=seed, name=clip.name)
    skeleton = SkeletonModel.default().with_offsets(clip.joint_offsets)
    shown = clip.poses[::2]
    found = simulate_detections(rng, shown, skeleton, right, settings.keypoints)  # type: ignore[arg-type]
    keypoints = keypoints_from_detections(found, shown.times, right).keypoints
    return replace(made, keypoints=keypoints, floor_height=0.0), replace(found, times=shown.times)


def write_raw(folder: Path, recording: Recording, found: Detections, rng: Generator) -> tuple[float, list[Path]]:
    """Write the files of a user; return the offset of the sensors' clock and the files, the map last."""
    write_detections(folder / "keypoints.npz", found)
    imus, calibration = recording.imus, recording.calibration
    if imus is None or calibration is None:
        return 0.0, [folder / "keypoints.npz"]
    S, offset = len(imus.names), float(rng.uniform(-REACH, REACH))
    order = rng.permutation(S)
    heading = so3.about_axis("z", rng.uniform(-np.pi, np.pi, S))
    case = so3.exp(rng.uniform(-np.pi, np.pi, (S, 3)) / np.sqrt(3))
    R = heading @ imus.R_inertial_sensor @ case
    f = np.einsum("sji,tsj->tsi", case, imus.f_sensor)
    columns, pairs = {"time": imus.times + offset}, []
    for number, s in enumerate(order):
        name = f"00B4{22000 + 7 * number}"
        quat = so3.to_quat_wxyz(R[:, s])
        columns |= {f"{name}_q{axis}": q for axis, q in zip("wxyz", quat.T, strict=True)}
        columns |= {f"{name}_f{axis}": a for axis, a in zip("xyz", f[:, s].T, strict=True)}
        pairs.append(f"{name},{calibration.joints[calibration.sensors.index(imus.names[s])]}\n")
    table = np.stack(list(columns.values()), axis=1)
    np.savetxt(folder / "sensors.csv", table, delimiter=",", header=",".join(columns), comments="", fmt="%.8g")
    write_text(folder / "map.csv", "".join(pairs))
    return offset, [folder / "keypoints.npz", folder / "sensors.csv", folder / "map.csv"]


def moved(truth: PoseSequence, camera: Camera) -> PoseSequence:
    """The truth in the world over whose floor an uncalibrated camera stands, looking along x."""
    axis, centre = camera.R_camera_world[2], camera.center_world * [1.0, 1.0, 0.0]
    R = so3.about_axis("z", -float(np.arctan2(axis[1], axis[0])))
    return replace(truth, p_world_joint=(truth.p_world_joint - centre) @ R.T, R_world_bone=R @ truth.R_world_bone)


def rows_of(name: str, clip: MocapClip, camera: int, sensors: str) -> Iterator[Row]:
    """One row for every case."""
    rng = np.random.default_rng(zlib.crc32(f"{name} {camera} raw".encode()))
    recording, found = simulated(clip, camera, sensors, rng)
    truth, true = recording.truth, recording.video.camera
    assert truth is not None
    mode = recording.usual_mode
    about: Row = {"motion": name, "camera": camera, "sensors": sensors}
    height = recording.skeleton.height * (1 + 0.01 * rng.standard_normal())
    usual = SkeletonModel.default().with_height(height).joint_offsets
    for case, one in zip(CASES, (recording, replace(recording, joint_offsets=usual)), strict=False):
        yield about | {"case": case} | _figures(reconstruct(one, mode=mode), mode)
    with tempfile.TemporaryDirectory() as place:
        offset, files = write_raw(Path(place), recording, found, rng)
        size = (true.width_px, true.height_px)
        settings = SetupSettings(height=height, size_px=size, person=1)
        for case in CASES[2:]:
            if case == "raw, map" and len(files) < 3:
                continue
            sources = Sources.of(files if case == "raw, map" else files[:2])
            folder = Path(place) / case
            find_people(sources, settings, folder, lambda path: found)
            write_recording(sources, settings, folder)
            own = replace(Recording.load(folder), truth=moved(truth, true))
            about["doubts"] = list(read_findings(folder).doubtful)
            result = reconstruct(own, mode=mode, calibrate=own.imus is not None)
            row = about | {"case": case} | _figures(result, mode)
            if own.imus is not None and own.calibration is not None and recording.imus is not None:
                row |= _of_sensors(own, recording, files[-1], offset)
            yield row


def _figures(result: Any, mode: str) -> Row:
    found = scoring.figures(result, mode)
    return {name: round(float(found[name]), 4) for name in FIGURES if name in found}


def _of_sensors(own: Recording, given: Recording, pairs: Path, offset: float) -> Row:
    """Share of the sensors that are used and right, and the error of the clock, ms."""
    assert own.imus is not None
    assert own.calibration is not None
    assert given.imus is not None
    truth = dict(line.split(",") for line in pairs.read_text(encoding="utf-8").split())
    used = dict(zip(own.calibration.sensors, own.calibration.joints, strict=True))
    right = sum(truth[name] == joint for name, joint in used.items())
    late = own.imus.times[0] - given.imus.times[0]
    return {"used": len(used), "right": right, "of": len(truth), "clock_ms": round(1e3 * late, 2)}


def report(rows: Sequence[Row]) -> str:
    """Tables as Markdown."""
    lines = [f"# From raw files\n\n{(__doc__ or '').partition(chr(10))[2].strip()}\n", "## Errors\n"]
    heads = ["sensors", "case", *FIGURES.values(), "recordings"]
    lines += [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for sensors in dict.fromkeys(row["sensors"] for row in rows):
        for case in CASES:
            own = [row for row in rows if (row["sensors"], row["case"]) == (sensors, case)]
            if own:
                means = [f"{np.mean([row[name] for row in own if name in row]):.3g}" for name in FIGURES]
                lines.append(f"| {' | '.join([sensors, case, *means, str(len(own))])} |")
    lines += ["\n## Recordings\n"]
    heads = ["motion", "camera", "sensors", "case", "rr mm", "flexion deg", "used, right", "clock ms", "doubts"]
    lines += [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for row in rows:
        used = f"{row['used']}, {row['right']} of {row['of']}" if "used" in row else ""
        about = [row["motion"], str(row["camera"]), row["sensors"], row["case"]]
        figures = [f"{row['mpjpe_rr_mm']:.1f}", f"{row['flexion_deg']:.1f}", used, str(row.get("clock_ms", ""))]
        doubts = "" if row["case"] in CASES[:2] else str(len(row["doubts"]))
        lines.append(f"| {' | '.join([*about, *figures, doubts])} |")
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> None:
    """Command line."""
    parser = study_parser("from_raw", __doc__)
    parser.add_argument("--cameras", type=int, default=1, choices=range(1, 5))
    options = parser.parse_args(arguments)
    rows: list[Row] = json.loads(options.out.read_text()) if options.out.exists() else []
    done = {(row["motion"], row["camera"], row["sensors"]) for row in rows}
    for camera in range(options.cameras):
        for name, clip in clips(options.corpus):
            for sensors in ("8", "none"):
                if (name, camera, sensors) in done:
                    continue
                rows += rows_of(name, clip, camera, sensors)
                options.out.write_text(json.dumps(rows, indent=1) + "\n")
                print(name, camera, sensors, [row["mpjpe_rr_mm"] for row in rows[-3:]], flush=True)
    options.out.with_suffix(".md").write_text(report(rows) + "\n")
    print(report(rows))


if __name__ == "__main__":
    main()

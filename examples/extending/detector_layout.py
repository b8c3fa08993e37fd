"""The layout of another detector: ``python examples/extending/detector_layout.py``.

CrowdPose's 14 points are all among those whose places in the body are known, so that nothing is trained.
The detections are made from the demo's true motion, with 4 px of noise.
"""

import tempfile
from pathlib import Path

import numpy as np

from rtof_kin import Recording
from rtof_kin.core.resources import model_path
from rtof_kin.data.keypoints import detector_point
from rtof_kin.vision.image_points import detector_points, image_points
from rtof_kin.vision.keypoints import read_detector_keypoints
from rtof_kin.vision.layouts import Layout, add_layout

# [layout]
CROWDPOSE = Layout.of(
    "crowdpose14",
    "CrowdPose, 14 points",
    [
        "left_shoulder",
        "right_shoulder",
        "left_elbow",
        "right_elbow",
        "left_wrist",
        "right_wrist",
        "left_hip",
        "right_hip",
        "left_knee",
        "right_knee",
        "left_ankle",
        "right_ankle",
        "top_head",
        "neck",
    ],
    {"top_head": "HeadTop", "neck": "UpperNeck"},
)
# [end]


def write_detections(path: Path, recording: Recording, frames: int = 60, noise_px: float = 4.0) -> None:
    """Write what a detector without names of its own would: frame by frame x, y, confidence."""
    skeleton, truth = recording.skeleton, recording.truth[:frames]
    points = image_points(skeleton, [detector_point(CROWDPOSE.name, point) for point in CROWDPOSE.points])
    uv = recording.video.camera.project(points.positions(truth.p_world_joint, truth.R_world_bone))
    uv += noise_px * np.random.default_rng(0).normal(size=uv.shape)
    np.savez(path, keypoints=uv, scores=np.full(uv.shape[:2], 0.9))


def main() -> None:
    """Add the layout, recognise it in a file, and compare the joints estimated from it with the truth."""
    add_layout(CROWDPOSE)
    recording = Recording.load(model_path("demo"))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "detections.npz"
        write_detections(path, recording)
        found = read_detector_keypoints(path, recording.video.camera, rate_hz=recording.rate_hz)
    print(found.recognition.reason)
    skeleton, truth = recording.skeleton, recording.truth[: len(found.keypoints)]
    uv = recording.video.camera.project(truth.p_world_joint)
    joints = found.keypoints.select(skeleton.names)
    error = np.linalg.norm(joints.uv_px - uv, axis=-1)
    print(f"{len(skeleton.names)} joints regressed from {len(CROWDPOSE)} points, {np.nanmean(error):.1f} px off")
    measured = detector_points(CROWDPOSE.name)
    print(f"{len(measured)} points are compared with the body; sizes of their errors, mm:")
    print({name: round(1000 * point.size) for name, point in measured.items() if not name.startswith("Left")})


if __name__ == "__main__":
    main()

"""A lifter as ONNX gives what it gives in torch."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import lifting_support as support
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from lifting.checkpoint import save_checkpoint
from lifting.onnx_export import INPUTS, OUTPUTS, LifterGraph, export_onnx
from lifting.predict import Lifter
from lifting.source import Source
from rtof_kin.cli import main
from rtof_kin.core.errors import RtofError

onnx = pytest.importorskip("onnx")
onnxruntime = pytest.importorskip("onnxruntime")
W, T = 27, 60


@pytest.fixture(scope="module")
def lifter() -> Lifter:
    return support.untrained_lifter(causal=True)


@pytest.fixture(scope="module")
def file(lifter: Lifter, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return export_onnx(lifter, tmp_path_factory.mktemp("onnx") / "lifter.onnx")


def session(file: Path) -> Any:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    return onnxruntime.InferenceSession(file, options, providers=["CPUExecutionProvider"])


def random_windows(lifter: Lifter, seed: int, batch: int) -> dict[str, NDArray[Any]]:
    """Random windows; a third lacks bones, a third the floor, and many rays and axes are missing."""
    rng = np.random.default_rng(seed)
    body = lifter.description.body
    J, S = len(body.names), len(body.sensors)
    rays = rng.normal(size=(batch, W, J, 3)) * [0.1, 0.1, 0.2] + rng.normal(size=(batch, 1, 1, 3))
    seen = rng.uniform(size=(batch, W, J)) < 0.8
    rays[~seen] = np.nan
    bones = np.tile(body.nominal_bones, (batch, 1)) * rng.uniform(0.8, 1.2, (batch, 1))
    bones[::3] = np.nan
    height = rng.uniform(0.5, 3, batch)
    height[1::3] = np.nan
    R = np.linalg.qr(rng.normal(size=(batch, W, S, 3, 3)))[0]
    sensed = rng.uniform(size=(batch, W, S)) < 0.5
    R[~sensed] = np.nan
    R_bone_shared = np.linalg.qr(rng.normal(size=(batch, len(body.names), 3, 3)))[0]
    values = [rays, seen, bones, height, R, sensed, R_bone_shared]
    return {
        name: value if value.dtype == bool else value.astype(np.float32)
        for name, value in zip(INPUTS, values, strict=True)
    }


@pytest.mark.parametrize("batch", [1, 7])
def test_onnx_and_torch_agree_on_random_windows(lifter: Lifter, file: Path, batch: int) -> None:
    given = random_windows(lifter, batch, batch)
    found = session(file).run(list(OUTPUTS), given)
    graph = LifterGraph(lifter.description.body, lifter.description.network, lifter.weights)
    with torch.inference_mode():
        wanted = graph(*(torch.from_numpy(value) for value in given.values()))
    for name, ours, theirs in zip(OUTPUTS, wanted, found, strict=True):
        assert np.isfinite(theirs).all(), name
        np.testing.assert_allclose(theirs, ours.numpy(), atol=1e-4, err_msg=name)


def test_onnx_gives_the_poses_that_predict_gives(lifter: Lifter, file: Path) -> None:
    camera, body = support.side_camera(), lifter.description.body
    keypoints = support.seen_by(camera, support.positions(0, T))
    imus = support.worn_by(0, T, ("LeftForeArm", "Hips"))
    offsets = support.TABLE.offsets
    source = Source.of(body, keypoints, imus)
    rows = np.clip(np.arange(T)[:, None] + np.arange(-W + 1, 1), 0, T - 1)
    R = np.tile(np.eye(3, dtype=np.float32), (T, W, len(body.sensors), 1, 1))
    for name in imus.joints:
        worn = np.array(imus.R_world_bone[:, imus.joints.index(name)])
        R[:, :, body.sensors.index(name)] = worn[rows]
    bones = np.tile(lifter.bones_of(offsets), (T, 1)).astype(np.float32)
    height = np.full(T, camera.center_world[2], np.float32)
    R_bone_shared = np.tile(lifter.shared_frames(offsets), (T, 1, 1, 1)).astype(np.float32)
    values = [source.rays[rows], source.seen[rows], bones, height, R, source.sensed[rows], R_bone_shared]
    pose, root, sigma, R_bone, sigma_rad = session(file).run(list(OUTPUTS), dict(zip(INPUTS, values, strict=True)))
    whole = lifter.predict(keypoints, offsets, bone_imus=imus, floor_height=0.0)
    p = camera.center_world + root[:, None] + pose
    np.testing.assert_allclose(p, whole.p_world_joint, atol=1e-4)
    np.testing.assert_allclose(sigma, whole.sigma_m, atol=1e-4)
    np.testing.assert_allclose(R_bone, whole.R_world_bone, atol=1e-3)
    np.testing.assert_allclose(sigma_rad, whole.sigma_rad, atol=1e-3)


def test_the_file_describes_its_inputs(lifter: Lifter, file: Path) -> None:
    facts = {p.key: json.loads(p.value) for p in onnx.load(file).metadata_props}
    body = lifter.description.body
    assert facts["joints"] == list(body.names)
    assert facts["sensors"] == list(body.sensors)
    assert (facts["rate_hz"], facts["receptive_field"], facts["estimated_frame"]) == (60.0, W, W - 1)
    assert len(facts["bones"]) == len(body.nominal_bones)
    assert "mocap.cs.cmu.edu" in facts["acknowledgement"]
    shapes = {i.name: i.shape for i in session(file).get_inputs()}
    assert shapes["rays_world"] == ["windows", W, len(body.names), 3]
    assert set(shapes) == set(INPUTS)
    assert [o.name for o in session(file).get_outputs()] == list(OUTPUTS)


def test_a_lifter_without_sensors_and_without_mirror_has_fewer_inputs(tmp_path: Path) -> None:
    lifter = support.untrained_lifter(table=support.TABLE_17)
    file = export_onnx(lifter, tmp_path / "17.onnx", flip=False)
    given = dict(list(random_windows(lifter, 0, 3).items())[:4])
    found = session(file).run(None, given)
    graph = LifterGraph(lifter.description.body, lifter.description.network, lifter.weights, flip=False)
    with torch.inference_mode():
        wanted = graph(*(torch.from_numpy(value) for value in given.values()))
    for ours, theirs in zip(wanted, found, strict=True):
        np.testing.assert_allclose(theirs, ours.numpy(), atol=1e-4)


def test_the_command_writes_the_file_and_overwrites_only_if_asked(
    lifter: Lifter, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    checkpoint = save_checkpoint(tmp_path / "lifter.npz", lifter.weights, lifter.description)
    file = tmp_path / "lifter.onnx"
    command = ["export", str(checkpoint), "-o", str(file), "--to", "onnx"]
    assert main(command) == 0
    assert session(file).get_inputs()[0].name == "rays_world"
    assert [path.name for path in tmp_path.glob("*.part")] == []
    assert main(command) == 2
    assert "is there already" in capsys.readouterr().err
    assert main([*command, "--overwrite"]) == 0


def test_without_onnx_the_error_names_the_package(
    lifter: Lifter, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(RtofError, match=r"needs onnx, which is not installed: .*rtof-kin\[onnx\]"):
        export_onnx(lifter, tmp_path / "lifter.onnx")

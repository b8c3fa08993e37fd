"""Tiny ONNX models that detect coloured dots, and videos with what a phone writes beside the images."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import onnx
from numpy.typing import NDArray

Array = NDArray[np.float64]
MEAN, STD = np.array([123.675, 116.28, 103.53]), np.array([58.395, 57.12, 57.375])


def colours(count: int) -> Array:
    """(K, 3) colours that are all as bright and far from each other."""
    i = np.arange(count) + 0.5
    height = i / count
    turn = np.pi / 2 * ((i * 0.618034) % 1)
    ring = np.sqrt(1 - height**2)
    return np.stack([ring * np.cos(turn), ring * np.sin(turn), height], axis=-1)


def saved(
    path: Path, nodes: list[Any], constants: dict[str, Any], size: tuple[int, int], outputs: dict[str, list[Any]]
) -> None:
    helper, kind = onnx.helper, onnx.TensorProto.FLOAT
    graph = helper.make_graph(
        nodes,
        "dots",
        [helper.make_tensor_value_info("input", kind, ["N", 3, *size])],
        [helper.make_tensor_value_info(name, kind, shape) for name, shape in outputs.items()],
        [onnx.numpy_helper.from_array(np.asarray(v), name) for name, v in constants.items()],
    )
    opset = [helper.make_opsetid("", 13)]
    onnx.save(helper.make_model(graph, opset_imports=opset, ir_version=8), path)


def pose_model(path: Path, count: int, kind: str = "RTMPose") -> None:
    """Like RTMPose: for each point, how much its colour is in each column and in each row; like RTMPose3d, a third such
    line too, or like ViTPose, an image of it.
    """
    node = onnx.helper.make_node
    kernel = (colours(count) * STD).astype(np.float32)[:, :, None, None] / 255
    shift = (colours(count) @ MEAN).astype(np.float32) / 255
    nodes = [
        node("Conv", ["input", "kernel", "shift"], ["near"]),
        node("ReduceMax", ["near"], ["columns"], axes=[2], keepdims=0),
        node("ReduceMax", ["near"], ["rows"], axes=[3], keepdims=0),
        node("Resize", ["columns", "", "twice"], ["simcc_x"], mode="linear"),
        node("Resize", ["rows", "", "twice"], ["simcc_y"], mode="linear"),
        node("Identity", ["simcc_x"], ["simcc_z"]),
        node("MaxPool", ["near"], ["heat"], kernel_shape=[4, 4], strides=[4, 4]),
    ]
    constants = {"kernel": kernel, "shift": shift, "twice": np.array([1, 1, 2], dtype=np.float32)}
    shapes = {"simcc_x": ["N", count, 384], "simcc_y": ["N", count, 512], "simcc_z": ["N", count, 384]}
    given = {"RTMPose": ("simcc_x", "simcc_y"), "RTMPose3d": ("simcc_x", "simcc_y", "simcc_z")}
    outputs = {name: shapes[name] for name in given.get(kind, ())} or {"heat": ["N", count, 64, 48]}
    saved(path, nodes, constants, (256, 192), outputs)


def people_model(path: Path, boxes: list[list[float]]) -> None:
    """Like YOLOX: always the same boxes of its input, with their scores."""
    node = onnx.helper.make_node
    nodes = [
        node("ReduceMin", ["input"], ["least"], axes=[1, 2, 3], keepdims=0),
        node("Mul", ["least", "zero"], ["nothing"]),
        node("Add", ["boxes", "nothing"], ["dets"]),
    ]
    constants = {"boxes": np.array([boxes], dtype=np.float32), "zero": np.zeros(1, dtype=np.float32)}
    saved(path, nodes, constants, (480, 640), {"dets": [1, len(boxes), 5]})


def transformer_model(path: Path, boxes: list[list[float]]) -> None:
    """Like RF-DETR: always the same boxes, of the centre and size in parts of the image, and the class of each."""
    node = onnx.helper.make_node
    nodes = [
        node("ReduceMin", ["input"], ["least"], axes=[1, 2, 3], keepdims=0),
        node("Mul", ["least", "zero"], ["nothing"]),
        node("Add", ["boxes", "nothing"], ["dets"]),
        node("Add", ["classes", "nothing"], ["labels"]),
    ]
    classes = np.full((1, len(boxes), 91), -9.0, dtype=np.float32)
    for i, box in enumerate(boxes):
        classes[0, i, int(box[4])] = 3.0
    constants = {"boxes": np.array([boxes], dtype=np.float32)[..., :4], "classes": classes}
    outputs = {"dets": [1, len(boxes), 4], "labels": [1, len(boxes), 91]}
    saved(path, nodes, constants | {"zero": np.zeros(1, dtype=np.float32)}, (480, 640), outputs)


def write_video(
    path: Path,
    images: list[Any],
    *,
    times_ms: list[int] | None = None,
    rotation: int = 0,
    metadata: dict[str, str] | None = None,
    codec: str = "mpeg4",
    aspect: Fraction | None = None,
) -> Path:
    """Write images (height, width, 3), BGR, at 25 Hz or at the given times, with a phone's metadata."""
    options = {"movflags": "use_metadata_tags"} if path.suffix == ".mp4" else {}
    with av.open(str(path), "w", options=options) as container:
        container.metadata.update(metadata or {})
        stream = container.add_stream(codec, rate=25)
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt = "bgr0" if codec == "ffv1" else "yuv420p"
        stream.bit_rate = 4_000_000
        stream.codec_context.time_base = stream.time_base = Fraction(1, 1000)
        if aspect is not None:
            stream.codec_context.sample_aspect_ratio = aspect
        if rotation:
            stream.set_display_rotation(rotation)
        for i, image in enumerate(images):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="bgr24")
            frame.pts, frame.time_base = 40 * i if times_ms is None else times_ms[i], Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path

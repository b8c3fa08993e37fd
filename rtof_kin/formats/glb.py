"""A motion as a binary glTF 2.0 (.glb): the skeleton's nodes with their animation, y up, +z forward, m.

Every joint is a node with an octahedron of two morph targets, whose weights are animated: the first reaches to its 95 %
band (position relative to the root), the second is grey where the position was not observed. Bones are octahedra too.
"""

from __future__ import annotations

import json
import struct
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np

from rtof_kin.body.kinematics import children_of
from rtof_kin.body.motion_source import MotionSource
from rtof_kin.core import rotations as so3
from rtof_kin.core.files.folder import new_file
from rtof_kin.data.confidence import BAND_95
from rtof_kin.formats.motion_views import joint_tree
from rtof_kin.formats.world_axes import METRES

_SIDES: Final = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0], [0, -1, 0], [0, 0, -1]])
_FACES: Final = [0, 1, 2, 1, 3, 2, 3, 4, 2, 4, 0, 2, 1, 0, 5, 3, 1, 5, 4, 3, 5, 0, 4, 5]
_BONE: Final = np.array([[0.5, 0, 0.2], [0, 0.5, 0.2], [0, 0, 1], [-0.5, 0, 0.2], [0, -0.5, 0.2], [0, 0, 0]])
"""Vertices of an octahedron, its faces counterclockwise from outside, and the vertices of a bone along z."""
_JOINT, _UNSEEN, _WIDTH = 0.012, 0.05, 0.04  #: [m] half sizes of joints and marks, width of a bone
_COLOURS: Final = ((0.0, 0.45, 0.7, 0.6), (0.6, 0.6, 0.6, 0.8), (0.8, 0.75, 0.7, 1.0))  #: Of bands, marks and bones
_WIDTHS: Final = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}


def write_glb(path: str | Path, motion: MotionSource) -> None:
    """Write a motion without gaps at even times, in blocks. Errors as `joint_tree` and `core.files.folder.new_file`."""
    accessors: list[dict[str, Any]] = []
    known, places = list[bytes](), [0]  # what is written first, and where each accessor begins and the last one ends

    def add(kind: str, count: int, values: Any = None, dtype: str = "<f4") -> int:
        """Return the number of a new accessor; values: (count, ...), where they are known."""
        about: dict[str, Any] = {}
        if values is not None:
            rows = np.asarray(values, dtype=dtype).reshape(count, -1)
            about = {"min": rows.min(axis=0).tolist(), "max": rows.max(axis=0).tolist()}
            known.append(rows.tobytes())
        about |= {"bufferView": len(accessors), "componentType": 5126 if dtype == "<f4" else 5125}
        accessors.append({"count": count, "type": kind, **about})
        places.append(places[-1] + 4 * count * _WIDTHS[kind])
        return len(accessors) - 1

    T, tree = len(motion), next(joint_tree(motion[:1]))
    J, offsets, ends = len(tree.names), tree.offsets * METRES["cm"], tree.end_offsets * METRES["cm"]
    below = [children_of(tree.parents, j) for j in range(J)]
    faces, time = add("SCALAR", len(_FACES), _FACES, "<u4"), add("SCALAR", T, motion.times - motion.times[0])
    nothing, ball, sides = (add("VEC3", 6, vertices) for vertices in (0 * _SIDES, _JOINT * _SIDES, _SIDES))

    def part(shape: int, colour: int, *targets: int) -> dict[str, Any]:
        more = [{"POSITION": target} for target in targets]
        return {"attributes": {"POSITION": shape}, "indices": faces, "material": colour, "targets": more}

    meshes, nodes = [], []
    for j, name in enumerate(tree.names):
        parts = [part(ball, 0, sides, nothing), part(nothing, 1, nothing, sides)]
        far = [end for parent, end in zip(tree.end_parents, ends, strict=True) if parent == j]
        for end in [*offsets[below[j]], *far]:
            bone = _BONE * [_WIDTH, _WIDTH, np.linalg.norm(end)] @ so3.minimal_rotation([0, 0, 1], end).T
            parts.append(part(add("VEC3", 6, bone), 2, nothing, nothing))
        meshes.append({"primitives": parts, "weights": [0, 0]})
        node = {"name": name, "mesh": j, "translation": offsets[j].tolist()}
        nodes.append(node | ({"children": below[j]} if below[j] else {}))
    tracks = [(add("VEC3", T), 0, "translation"), *((add("VEC4", T), j, "rotation") for j in range(J))]
    tracks += [(add("SCALAR", 2 * T), j, "weights") for j in range(J)]
    channels = [{"sampler": i, "target": {"node": j, "path": what}} for i, (_, j, what) in enumerate(tracks)]
    samplers = [{"input": time, "output": output} for output, _, _ in tracks]
    contents = {
        "asset": {"version": "2.0", "generator": "rtof_kin"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": nodes,
        "meshes": meshes,
        "materials": [{"pbrMetallicRoughness": {"baseColorFactor": c}, "alphaMode": "BLEND"} for c in _COLOURS],
        "animations": [{"name": "motion", "samplers": samplers, "channels": channels}],
        "accessors": accessors,
        "bufferViews": [{"buffer": 0, "byteOffset": a, "byteLength": b - a} for a, b in pairwise(places)],
        "buffers": [{"byteLength": places[-1]}],
    }
    text = json.dumps(contents).encode()
    text += b" " * (-len(text) % 4)
    base = 28 + len(text)
    with new_file(path, overwrite=True) as whole, whole.open("wb") as stream:
        stream.write(struct.pack("<4sIII4s", b"glTF", 2, base + places[-1], len(text), b"JSON") + text)
        stream.write(struct.pack("<I4s", places[-1], b"BIN\0") + b"".join(known))
        for block, poses in zip(motion.blocks(confidence=True), joint_tree(motion), strict=True):
            unseen, confidence = ~motion.masks.position_observed[block.frames], block.motion.confidence
            sigma = np.zeros(unseen.shape) if confidence is None else np.nan_to_num(confidence.relative_sigma)
            weights = np.stack([BAND_95 * sigma, _UNSEEN * unseen], axis=2)
            quat = np.roll(so3.to_quat_wxyz(poses.R_parent_joint), -1, axis=-1)
            values = [poses.p_root * METRES["cm"], *np.moveaxis(quat, 1, 0), *np.moveaxis(weights, 1, 0)]
            for (output, _, _), own in zip(tracks, values, strict=True):
                stream.seek(base + places[output] + block.start * 4 * own.shape[1])
                stream.write(own.astype("<f4").tobytes())

"""Pickles of public data as plain files: ``python examples/convert_pickles.py FILE... [--out FOLDER] [--up AXIS]``.

OpenCap's ``cameraIntrinsicsExtrinsics.pickle`` becomes a .json of the same name beside it: a camera in OpenCV's names,
in a world with z up, m. Up is the axis of the checkerboard that is nearest to the image's upward direction, unless --up
says otherwise. VideoPose3D's ``data_3d_h36m.npz`` and ``data_2d_h36m_*.npz`` become archives of plain arrays of the
same name in FOLDER. Loading a pickle runs what it says: convert only files that come from their publisher.
"""

import argparse
import json
import pickle
import sys
from pathlib import Path
from typing import Any

import numpy as np

from rtof_kin.formats.world_axes import UP

_LARGEST_TILT = np.radians(35.0)  # between the image's upward direction and the axis that is taken as up


def camera(path: Path, up: str | None) -> Path:
    """Write OpenCap's camera as OpenCV's; its translation is in mm, its image size height, width."""
    saved = pickle.loads(path.read_bytes())
    R = np.asarray(saved["rotation"])
    along = {axis: float(-R[1] @ R_world_file[2]) for axis, R_world_file in UP.items()}
    nearest = max(along, key=along.__getitem__)
    if up is None and along[nearest] < np.cos(_LARGEST_TILT):
        sys.exit(
            f"{path}: no axis of the checkerboard is upright in the image; name the one that points up, as --up -y"
        )
    height, width = np.ravel(saved["imageSize"]).astype(int).tolist()
    contents = {
        "camera_name": path.absolute().parent.name,
        "image_width": width,
        "image_height": height,
        "camera_matrix": np.asarray(saved["intrinsicMat"]).tolist(),
        "distortion_coefficients": np.ravel(saved["distortion"]).tolist(),
        "R": (R @ UP[up or nearest].T).tolist(),
        "T": (np.ravel(saved["translation"]) / 1000).tolist(),
    }
    written = path.with_suffix(".json")
    written.write_text(json.dumps(contents, indent=1) + "\n", encoding="utf-8")
    return written


def archive(path: Path, folder: Path) -> Path:
    """Write an archive of VideoPose3D as arrays ``positions_3d/SUBJECT/ACTION`` or ``positions_2d/.../CAMERA``."""
    arrays: dict[str, Any] = {}

    def add(name: str, value: Any) -> None:
        if isinstance(value, dict):
            for key, inner in value.items():
                add(f"{name}/{key}", inner)
        elif isinstance(value, list) and name.startswith("positions_2d"):
            for number, inner in enumerate(value):
                add(f"{name}/{number}", inner)
        else:
            arrays[name] = np.asarray(value)

    with np.load(path, allow_pickle=True) as saved:
        for name in saved.files:
            add(name, saved[name].item())
    folder.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(folder / path.name, **arrays)
    return folder / path.name


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="+", type=Path)
    parser.add_argument("--out", type=Path, default=Path("plain"))
    parser.add_argument("--up", choices=list(UP))
    given = parser.parse_args()
    for file in given.files:
        print("wrote", archive(file, given.out) if file.suffix == ".npz" else camera(file, given.up))

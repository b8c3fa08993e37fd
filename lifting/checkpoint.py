"""File format of a trained lifter: weights, pose prior, description and provenance.

An .npz archive of numbers and texts: nothing is unpickled, so that it cannot run code. A SHA-256 over weights, prior
and description detects damage.
"""

from __future__ import annotations

import hashlib
import json
import zipfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from lifting.body import Body, bone_groups
from lifting.model import NetworkConfig
from lifting.windows import sizes
from rtof_kin.body.pose_prior import PosePrior
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import FileFormatError, MissingPackageError, reading
from rtof_kin.core.files.arrays import check_sizes, npz_names, read_npz_as_saved, write_npz
from rtof_kin.core.packages import optional

FORMAT: Final = "rtof-kin lifter"
VERSION: Final = 4
READABLE: Final = (2, 3, 4)  #: Versions that are read, 2 and 3 with torch; files of version 2 have no pose prior
ACKNOWLEDGEMENT = (
    "The data used in this project was obtained from mocap.cs.cmu.edu. The database was created with "
    "funding from NSF EIA-0196217."
)
_MAX_CHANNELS, _MAX_JOINTS = 4096, 200
_LARGEST_BYTES = 4 * 2**30
_WEIGHTS, _PRIOR = "weights/", "prior/"


@dataclass(frozen=True)
class LifterDescription:
    """Description of a lifter without its weights."""

    body: Body  #: Joints, tree, nominal bones and sensors
    network: NetworkConfig  #: Shape of the network
    rate_hz: float = 60.0  #: Rate of the training windows, Hz
    recipe: dict[str, Any] = field(default_factory=dict)  #: Settings of the training, as plain values
    validation: dict[str, Any] = field(default_factory=dict)  #: Errors on the validation subjects, mm
    data: str = ACKNOWLEDGEMENT  #: Source of the motion, as its licence asks
    prior: PosePrior | None = None  #: Pose prior of the same motion; None for the shipped one


def save_checkpoint(
    path: str | Path, weights: Mapping[str, NDArray[Any]], description: LifterDescription, overwrite: bool = False
) -> Path:
    """Write a lifter of weights by name; raises OutputExistsError, WritingError: see `core.files.folder.new_file`."""
    path = Path(path)
    values = asdict(replace(description, prior=None))
    text = json.dumps({k: v for k, v in values.items() if k != "prior"}, sort_keys=True)
    prior = {} if description.prior is None else description.prior.arrays()
    facts = {"format": FORMAT, "version": VERSION, "description": text, "sha256": _digest(text, weights, prior)}
    arrays = {_WEIGHTS + k: v for k, v in weights.items()} | {_PRIOR + k: v for k, v in prior.items()}
    write_npz(path, {k: np.asarray(v) for k, v in (facts | arrays).items()}, overwrite, compressed=False)
    return path


def load_checkpoint(path: str | Path) -> tuple[dict[str, NDArray[Any]], LifterDescription]:
    """Read the weights of a lifter, by name, and its description.

    Raises:
        FileFormatError: missing, not a lifter, written by another version, damaged or altered.
        MissingPackageError: written by an earlier version, with torch, which is not installed.
    """
    path = Path(path)
    content = _read(path)
    weights, prior = (
        {k.removeprefix(group): v for k, v in content.items() if k.startswith(group)} for group in (_WEIGHTS, _PRIOR)
    )
    text = str(content.get("description", ""))
    if _digest(text, weights, prior) != str(content.get("sha256")):
        raise FileFormatError(path, "the checksum does not match: the file is damaged or was altered; copy it again")
    with reading(path, "the description of this lifter is wrong: {}", ValueError, TypeError, KeyError, AttributeError):
        description = _description(text, {name: value.astype(float) for name, value in prior.items()})
    wanted = description.network.weight_shapes()
    wrong = [k for k in sorted(weights | wanted) if k not in weights or weights[k].shape != wanted.get(k)]
    wrong += [k for k, v in weights.items() if v.dtype not in (np.float32, np.int64)]
    if wrong:
        raise FileFormatError(path, f"the weights do not fit the network described: {', '.join(wrong)[:200]}")
    if not all(np.isfinite(v).all() for v in weights.values()):
        raise FileFormatError(path, "the weights are not finite: its training failed; train again")
    return weights, description


def _read(path: Path) -> dict[str, NDArray[Any]]:
    """Arrays of a lifter's file, of a version that can be read."""
    if not path.is_file():
        raise FileFormatError(path, "no such file; give the path of a trained lifter")
    try:
        earlier = any(name.endswith("data.pkl") for name in npz_names(path))
        content = _written_by_torch(path) if earlier else read_npz_as_saved(path, _LARGEST_BYTES, "fiU")
    except MissingPackageError:
        raise
    except Exception as error:  # torch raises many types on damaged archives
        first = str(error).removeprefix(f"{path}: ").partition("\n")[0] or type(error).__name__
        raise FileFormatError(
            path, f"not a readable lifter ({first[:120]}); copy the file again or train a new one"
        ) from error
    if str(content.get("format")) != FORMAT:
        raise FileFormatError(path, "not a lifter of this package")
    if (version := str(content.get("version"))) not in map(str, READABLE):
        raise FileFormatError(
            path,
            f"lifter format {version}; this version of the package reads the formats "
            f"{', '.join(map(str, READABLE))}: install the version that wrote it, or train again",
        )
    return content


def _written_by_torch(path: Path) -> dict[str, NDArray[Any]]:
    """Arrays of a file of version 2 or 3, which `torch.save` wrote; ``weights_only`` runs no code in it."""
    torch = optional("torch", "train", f"{path}: a lifter in the format of earlier versions")
    with zipfile.ZipFile(path) as archive:
        check_sizes(path, archive.infolist(), _LARGEST_BYTES)
    content = torch.load(path, map_location="cpu", weights_only=True)
    groups = [{f"{name}/{k}": v for k, v in content.pop(name, {}).items()} for name in ("weights", "prior")]
    return {k: np.asarray(v) for k, v in (content | groups[0] | groups[1]).items()}


def _description(text: str, prior: dict[str, Array]) -> LifterDescription:
    """Parse and check a description; `ValueError` and others if it is wrong."""
    raw = json.loads(text)
    own, shape = raw["body"], dict(raw["network"])
    if (kind := shape.pop("model", "rays")) != "rays":  # earlier versions had another one
        raise ValueError(f"a network of the kind {kind}, which this version does not have; train again")
    names, sensors = tuple(map(str, own["names"])), tuple(map(str, own["sensors"]))
    parents, bones = tuple(map(int, own["parents"])), tuple(map(float, own["nominal_bones"]))
    body = Body(names, parents, bones, sensors)
    network = NetworkConfig(**{**shape, "filter_widths": tuple(shape["filter_widths"])})
    J = len(names)
    tree = all(parent < j for j, parent in enumerate(parents)) and parents[:1] == (-1,)
    if not 2 <= J <= _MAX_JOINTS or len(parents) != J or not tree:
        raise ValueError("names and parents are not a tree of joints")
    if len(bones) != 3 * len(bone_groups(names)):
        raise ValueError("the nominal bones do not fit the joints")
    if not set(sensors) <= set(names) or len(set(sensors)) < len(sensors):
        raise ValueError("the sensors' segments are not among the joints")
    if not {body.mirrored[j] for j in body.sensor_joints} <= set(body.sensor_joints):
        raise ValueError("a sensor's segment has no counterpart on the other side")
    if (network.inputs, network.constants, network.outputs) != sizes(body):
        raise ValueError("the network's inputs or outputs do not fit the joints")
    if not 1 <= network.channels <= _MAX_CHANNELS:
        raise ValueError(f"{network.channels} channels")
    widths = network.filter_widths
    if not 1 <= len(widths) <= 6 or not all(w in (1, 3, 5, 7) for w in widths):
        raise ValueError(f"filter widths {widths}")
    learned = PosePrior.from_arrays(names, prior) if prior else None
    description = LifterDescription(**{**raw, "body": body, "network": network, "prior": learned})
    if not description.rate_hz > 0:
        raise ValueError(f"a rate of {description.rate_hz} Hz")
    return description


def _digest(text: str, weights: Mapping[str, NDArray[Any]], prior: Mapping[str, NDArray[Any]]) -> str:
    """SHA-256, with torch's names of the types, so that it is the same in all versions of the format."""
    digest = hashlib.sha256(text.encode())
    for name, value in (*sorted(weights.items()), *sorted(prior.items())):
        digest.update(f"{name} torch.{value.dtype} {value.shape}".encode())
        digest.update(value.tobytes())
    return digest.hexdigest()

"""File format of a trained lifter: weights, pose prior, description and provenance.

Written by `torch.save` and read with ``weights_only=True``, so that it cannot run code. A SHA-256 over
weights, prior and description detects damage.
"""

from __future__ import annotations

import hashlib
import json
import zipfile
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import torch
from torch import Tensor

from lifting.body import Body, bone_groups
from lifting.model import NetworkConfig, TemporalNetwork
from lifting.windows import sizes
from rtof_kin.body.pose_prior import PosePrior
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import FileFormatError, WritingError, reading
from rtof_kin.core.files.arrays import check_sizes
from rtof_kin.core.files.folder import new_file

FORMAT: Final = "rtof-kin lifter"
VERSION: Final = 3
READABLE: Final = (2, 3)  #: Versions that are read; files of version 2 have no pose prior
ACKNOWLEDGEMENT = (
    "The data used in this project was obtained from mocap.cs.cmu.edu. The database was created with "
    "funding from NSF EIA-0196217."
)
_MAX_CHANNELS, _MAX_JOINTS = 4096, 200
_LARGEST_BYTES = 4 * 2**30


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
    path: str | Path, network: TemporalNetwork, description: LifterDescription, overwrite: bool = False
) -> Path:
    """Write a lifter; raises OutputExistsError, WritingError: see `save_tensors`."""
    path = Path(path)
    values = asdict(replace(description, prior=None))
    text = json.dumps({k: v for k, v in values.items() if k != "prior"}, sort_keys=True)
    weights = {k: v.detach().to("cpu").contiguous() for k, v in network.state_dict().items()}
    arrays = {} if description.prior is None else description.prior.arrays()
    prior = {name: torch.tensor(value) for name, value in arrays.items()}
    content = {"format": FORMAT, "version": VERSION, "description": text, "weights": weights, "prior": prior}
    save_tensors({**content, "sha256": _digest(text, weights, prior)}, path, overwrite)
    return path


def save_tensors(content: dict[str, Any], path: Path, overwrite: bool) -> None:
    """Write by `torch.save`, atomically; errors as `core.files.folder.new_file`."""
    with new_file(path, overwrite) as whole:
        try:
            torch.save(content, whole)
        except RuntimeError as error:  # torch's error for a full disk
            raise WritingError(f"{path}: cannot be written ({error}); name another file") from error


def load_checkpoint(path: str | Path) -> tuple[TemporalNetwork, LifterDescription]:
    """Read a lifter, on the CPU in evaluation mode.

    Raises:
        FileFormatError: missing, not a lifter, written by another version, damaged or altered.
    """
    path = Path(path)
    content = _read(path)
    text, weights, prior = content.get("description"), content.get("weights"), content.get("prior", {})
    if not isinstance(text, str) or not isinstance(weights, dict):
        raise FileFormatError(path, "this lifter lacks its description or weights; train it again")
    for tensors in (weights, prior):
        if not isinstance(tensors, dict) or not all(
            isinstance(k, str) and isinstance(v, Tensor) for k, v in tensors.items()
        ):
            raise FileFormatError(path, "the weights of this lifter are not tensors; train it again")
    if _digest(text, weights, prior) != content.get("sha256"):
        raise FileFormatError(path, "the checksum does not match: the file is damaged or was altered; copy it again")
    with reading(path, "the description of this lifter is wrong: {}", ValueError, TypeError, KeyError, AttributeError):
        description = _description(text, {name: value.double().numpy() for name, value in prior.items()})
    network = TemporalNetwork(description.network)
    with reading(path, "the weights do not fit the network described: {}", RuntimeError):
        network.load_state_dict(weights)
    if not all(bool(v.isfinite().all()) for v in weights.values()):
        raise FileFormatError(path, "the weights are not finite: its training failed; train again")
    return network.eval(), description


def _read(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise FileFormatError(path, "no such file; give the path of a trained lifter")
    try:
        with zipfile.ZipFile(path) as archive:
            check_sizes(path, archive.infolist(), _LARGEST_BYTES)
        content = torch.load(path, map_location="cpu", weights_only=True)
    except FileFormatError:
        raise
    except Exception as error:  # torch raises many types on damaged archives
        first = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise FileFormatError(
            path, f"not a readable lifter ({first[:120]}); copy the file again or train a new one"
        ) from error
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise FileFormatError(path, "a torch file, but not a lifter of this package")
    if content.get("version") not in READABLE:
        raise FileFormatError(
            path,
            f"lifter format {content.get('version')}; this version of the package reads format "
            f"{' or '.join(map(str, READABLE))}: install the version that wrote it, or train again",
        )
    return content


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


def _digest(text: str, weights: dict[str, Tensor], prior: dict[str, Tensor]) -> str:
    digest = hashlib.sha256(text.encode())
    for name, value in (*sorted(weights.items()), *sorted(prior.items())):
        tensor = value.detach().contiguous()
        digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode())
        digest.update(tensor.reshape(-1).view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()

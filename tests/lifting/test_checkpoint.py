from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import lifting_support as support
import numpy as np
import pytest
import torch

from lifting import checkpoint
from lifting.checkpoint import load_checkpoint, save_checkpoint
from lifting.predict import Lifter
from rtof_kin.body.pose_prior import PosePrior
from rtof_kin.core.errors import FileFormatError, MissingPackageError


@pytest.fixture(scope="module")
def lifter() -> Lifter:
    return support.untrained_lifter()


@pytest.fixture
def saved(lifter: Lifter, tmp_path: Path) -> Path:
    return save_checkpoint(tmp_path / "lifter.npz", lifter.weights, lifter.description)


def rewrite(path: Path, change: Callable[[dict[str, Any]], None], sign: bool = False) -> None:
    """Alter a lifter's file, with a checksum that fits again where `sign`."""
    with np.load(path) as archive:
        content = dict(archive)
    change(content)
    if sign:
        groups = [{k[len(g) :]: v for k, v in content.items() if k.startswith(g)} for g in ("weights/", "prior/")]
        content["sha256"] = checkpoint._digest(str(content["description"]), *groups)
    np.savez(path, **content)


def as_torch_wrote_it(path: Path, version: int) -> None:
    """Replace a file by that of an earlier version with the same content."""
    with np.load(path) as archive:
        content: dict[str, Any] = {k: str(v) for k, v in archive.items() if "/" not in k}
        tensors = {k: torch.from_numpy(v) for k, v in archive.items() if "/" in k}
    content |= {g: {k[len(g) + 1 :]: v for k, v in tensors.items() if k.startswith(g)} for g in ("weights", "prior")}
    torch.save(content | {"version": version}, path)


def redescribe(path: Path, change: Callable[[dict[str, Any]], None]) -> None:
    """Alter the description, with a checksum that fits."""

    def edit(content: dict[str, Any]) -> None:
        description = json.loads(str(content["description"]))
        change(description)
        content["description"] = json.dumps(description)

    rewrite(path, edit, sign=True)


def test_a_lifter_round_trips(lifter: Lifter, saved: Path) -> None:
    described = replace(lifter.description, recipe={"batch": 512}, validation={"perfect": {"rr_mm": 30.0}})
    save_checkpoint(saved, lifter.weights, described, overwrite=True)
    weights, description = load_checkpoint(saved)
    assert description == described
    assert len(description.body.sensors) == 13
    assert "mocap.cs.cmu.edu" in description.data
    assert [path.name for path in saved.parent.iterdir()] == ["lifter.npz"]
    assert weights.keys() == lifter.weights.keys()
    for name, value in lifter.weights.items():
        np.testing.assert_array_equal(weights[name], value, name, strict=True)


@pytest.mark.parametrize("version", [2, 3])
def test_files_of_earlier_versions_are_read_where_there_is_torch(
    version: int, lifter: Lifter, saved: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    as_torch_wrote_it(saved, version)
    weights, description = load_checkpoint(saved)
    assert description == lifter.description
    assert all(np.array_equal(weights[name], value) for name, value in lifter.weights.items())
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(MissingPackageError, match=r"lifter\.npz: .* earlier versions needs torch.*rtof-kin\[train\]"):
        load_checkpoint(saved)


def test_a_single_changed_weight_is_found(saved: Path) -> None:
    def nudge(content: dict[str, Any]) -> None:
        content["weights/shrink.bias"][0] += 1e-6

    rewrite(saved, nudge)
    with pytest.raises(FileFormatError, match="checksum does not match"):
        load_checkpoint(saved)


def test_other_versions_are_refused(saved: Path) -> None:
    for version in (1, 99):
        rewrite(saved, lambda content, version=version: content.update(version=np.array(version)))
        with pytest.raises(FileFormatError, match=f"format {version}; .* reads the formats 2, 3, 4: install"):
            load_checkpoint(saved)


def test_other_files_and_missing_files_are_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "other.npz", weights=np.zeros(3))
    with pytest.raises(FileFormatError, match="not a lifter of this package"):
        load_checkpoint(tmp_path / "other.npz")
    torch.save({"weights": {}}, tmp_path / "other.pt")
    with pytest.raises(FileFormatError, match="not a lifter of this package"):
        load_checkpoint(tmp_path / "other.pt")
    with pytest.raises(FileFormatError, match="no such file; give the path"):
        load_checkpoint(tmp_path / "nowhere.pt")
    with pytest.raises(FileFormatError, match="no such file"):
        load_checkpoint(tmp_path)


def test_a_file_has_the_prior_of_its_motion(lifter: Lifter, saved: Path) -> None:
    assert Lifter.load(saved).prior is None
    own = PosePrior.load(lifter.names)
    own = replace(own, covariance_about_posture=own.covariance / 2)
    save_checkpoint(saved, lifter.weights, replace(lifter.description, prior=own), overwrite=True)
    prior = Lifter.load(saved).prior
    assert prior is not None
    assert prior.joints == lifter.names
    for name, value in own.arrays().items():
        np.testing.assert_array_equal(prior.arrays()[name], value)
    rewrite(saved, lambda content: content["prior/covariance"].__imul__(2.0))
    with pytest.raises(FileFormatError, match="checksum"):
        load_checkpoint(saved)
    rewrite(saved, lambda content: content.pop("prior/sigma_jerk"), sign=True)
    with pytest.raises(FileFormatError, match="description of this lifter is wrong: 'sigma_jerk'"):
        load_checkpoint(saved)


class Harmful:
    """Runs when it is unpickled by a careless reader."""

    def __reduce__(self) -> tuple[Any, ...]:
        return (Path("harm").write_text, ("done",))


def test_code_in_a_file_is_not_executed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    torch.save({"format": checkpoint.FORMAT, "version": 2, "weights": Harmful()}, "lifter.pt")
    with pytest.raises(FileFormatError, match="not a readable lifter"):
        load_checkpoint("lifter.pt")
    assert not (tmp_path / "harm").exists()


def swap(description: dict[str, Any], joint: str, other: str) -> None:
    """A sensor on one side of the body that has no counterpart."""
    sensors = description["body"]["sensors"]
    sensors[sensors.index(joint)] = other


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d["network"].update(channels=10**9), "1000000000 channels"),
        (lambda d: d["network"].update(filter_widths=[3] * 40), "filter widths"),
        (lambda d: d["network"].update(inputs=5), "inputs or outputs do not fit"),
        (lambda d: d["body"]["sensors"].pop(), "no counterpart on the other side"),
        (lambda d: d["body"]["sensors"].append("Tail"), "sensors' segments are not among the joints"),
        (lambda d: swap(d, "LeftArm", "LeftHand"), "no counterpart"),
        (lambda d: d["body"].pop("sensors"), "'sensors'"),
        (lambda d: d["body"].update(parents=[-1, *range(1, 21)]), "not a tree of joints"),
        (lambda d: d["body"].update(nominal_bones=[0.1]), "nominal bones do not fit"),
        (lambda d: d.update(rate_hz=0.0), "a rate of 0.0 Hz"),
        (lambda d: d["network"].update(channels=8), "do not fit the network described"),
    ],
)
def test_wrong_descriptions_with_a_valid_checksum_are_refused(
    saved: Path, change: Callable[[dict[str, Any]], None], message: str
) -> None:
    redescribe(saved, change)
    with pytest.raises(FileFormatError, match=message):
        load_checkpoint(saved)


def test_weights_that_are_not_finite_are_refused(saved: Path) -> None:
    rewrite(saved, lambda c: c["weights/shrink.bias"].fill(np.nan), sign=True)
    with pytest.raises(FileFormatError, match="weights are not finite"):
        load_checkpoint(saved)

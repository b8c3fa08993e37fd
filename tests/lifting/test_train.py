from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import lifting_support as support
import numpy as np
import pytest

from lifting.checkpoint import load_checkpoint
from lifting.predict import Lifter
from lifting.training.corpus import Corpus
from lifting.training.data import plain
from lifting.training.noise import SensorConfig
from lifting.training.settings import TrainConfig, motions_of, postures_of, prior_of_corpus
from lifting.training.train import train
from rtof_kin.body import kinematics
from rtof_kin.body.pose_prior import shipped_prior
from rtof_kin.body.pose_prior_fit import fit_pose_prior
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import FileFormatError, InvalidInputError, OutputExistsError

pytestmark = pytest.mark.usefixtures("undrawn")
QUICK = TrainConfig(
    windows=640,
    batch=32,
    channels=16,
    skeletons=1,
    report_every=1,
    validations=2,
    validation_windows=64,
    bfloat16=False,
    augment=replace(plain(), mirror=0.5, sensors=SensorConfig()),
)


class Interruption(Exception):
    """Raised by a progress callback."""


@pytest.fixture(scope="module")
def corpus() -> Corpus:
    return support.tiny_corpus(frames=40)


def same(a: Path, b: Path) -> bool:
    first, second = load_checkpoint(a)[0], load_checkpoint(b)[0]
    return all(np.array_equal(first[name], second[name]) for name in first)


def test_training_overfits_a_small_motion(tmp_path: Path) -> None:
    corpus = support.tiny_corpus(clips=2, frames=60)
    corpus = replace(corpus, split=("train", "validation"))
    twins = replace(
        corpus,
        p_world_root=np.tile(corpus.p_world_root[:60], (2, 1)),
        R_world_bone=np.tile(corpus.R_world_bone[:60], (2, 1, 1, 1)),
        joint_offsets=np.tile(corpus.joint_offsets[:1], (2, 1, 1)),
    )
    config = replace(
        QUICK,
        windows=32_000,
        batch=128,
        channels=64,
        learning_rate=1e-2,
        ema=0.9,
        skeletons=0,
        report_every=50,
        augment=replace(plain(), mirror=0.5),
    )
    errors: list[dict[str, Any]] = []

    def progress(report: dict[str, Any]) -> None:
        if "validation" in report:
            errors.append(report["validation"]["perfect"])

    path = train(config, twins, tmp_path / "lifter.npz", progress)
    assert errors[-1]["rr_mm"] < 55
    assert errors[-1]["abs_mm"] < 120
    camera, p = support.side_camera(), corpus.positions(0).astype(float)
    lifted = Lifter.load(path).predict(support.seen_by(camera, p), corpus.joint_offsets[0])
    error = lifted.p_world_joint - p
    assert np.linalg.norm(error - error[:, :1], axis=-1).mean() < 0.08
    assert np.linalg.norm(error, axis=-1).mean() < 0.25


def test_a_resumed_training_equals_an_uninterrupted_one(corpus: Corpus, tmp_path: Path) -> None:
    config = replace(QUICK, dropout=0.2)
    whole = train(config, corpus, tmp_path / "whole.npz")
    assert not same(whole, train(replace(config, seed=1), corpus, tmp_path / "other.npz"))

    def interrupt(report: dict[str, Any]) -> None:
        if report["step"] == 9:
            raise Interruption

    parts = tmp_path / "parts.npz"
    with pytest.raises(Interruption):
        train(config, corpus, parts, interrupt)
    assert not parts.exists()
    steps: list[int] = []
    train(config, corpus, parts, lambda report: steps.append(report["step"]), resume=True)
    assert steps[0] == 10
    assert same(whole, parts)
    curves = [json.loads((tmp_path / f"{n}.npz.curves.json").read_text()) for n in ("whole", "parts")]
    measured = [[row["validation"] for row in curve["history"]] for curve in curves]
    assert measured[0] == measured[1]


def test_without_resume_the_state_is_not_read(corpus: Corpus, tmp_path: Path) -> None:
    config = replace(QUICK, windows=96)
    path = train(config, corpus, tmp_path / "lifter.npz")
    before = load_checkpoint(path)[0]
    steps: list[int] = []
    with pytest.raises(OutputExistsError, match=r"lifter\.npz: is there already"):
        train(config, corpus, path)
    path.unlink()
    with pytest.raises(OutputExistsError, match=r"lifter\.npz\.state: is there already"):
        train(config, corpus, path)
    train(config, corpus, path, lambda report: steps.append(report["step"]), overwrite=True)
    assert steps[0] == 1
    assert all(np.array_equal(before[name], value) for name, value in load_checkpoint(path)[0].items())


def test_states_of_other_settings_and_broken_states_are_refused(corpus: Corpus, tmp_path: Path) -> None:
    config = replace(QUICK, windows=64)
    path = train(config, corpus, tmp_path / "lifter.npz")
    with pytest.raises(FileFormatError, match="other settings; delete it or do not resume"):
        train(replace(config, learning_rate=1e-4), corpus, path, resume=True)
    (tmp_path / "lifter.npz.state").write_bytes(b"PK\x03\x04")
    with pytest.raises(FileFormatError, match="not a readable training state"):
        train(config, corpus, path, resume=True)


def test_only_training_subjects_change_the_weights(corpus: Corpus, tmp_path: Path) -> None:
    R = corpus.R_world_bone.copy()
    R[80:] = np.eye(3)  # the clips that validate and test
    elsewhere = replace(corpus, R_world_bone=R)
    config = replace(QUICK, windows=96)
    first = train(config, corpus, tmp_path / "1.npz")
    second = train(config, elsewhere, tmp_path / "2.npz")
    assert same(first, second)
    assert load_checkpoint(first)[1].validation != load_checkpoint(second)[1].validation


def test_the_lifter_contains_its_recipe_and_errors(corpus: Corpus, tmp_path: Path) -> None:
    path = train(replace(QUICK, windows=100), corpus, tmp_path / "lifter.npz")
    description = load_checkpoint(path)[1]
    assert description.recipe["windows_seen"] == 128
    assert description.recipe["augment"]["distance"] == [1.8, 7.5]
    assert description.recipe["frames_of_motion"] == 80
    assert description.recipe["augment"]["sensors"]["lag"] == [-1.0, 4.0]
    assert set(description.validation) >= {"perfect", "realistic", "realistic, 10 sensors"}
    assert set(description.validation["realistic, 8 sensors"]) == {"rr_mm", "abs_mm", "pelvis_deg", "upper_trunk_deg"}
    assert description.validation["perfect"]["abs_mm"] > 0


def test_minutes_end_a_training(corpus: Corpus, tmp_path: Path) -> None:
    reports: list[dict[str, Any]] = []
    config = replace(QUICK, windows=None, minutes=0.01)
    train(config, corpus, tmp_path / "lifter.npz", reports.append)
    assert "validation" in reports[-1]  # whose time counts too
    assert 0.3 < reports[-1]["seconds"] < 3.8


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({}, "number of windows, of minutes"),
        ({"windows": 0}, "windows is 0"),
        ({"minutes": -1.0}, "minutes is -1.0"),
        ({"windows": 5, "batch": 0}, "batch is 0"),
        ({"windows": 5, "learning_rate": float("nan")}, "learning_rate is nan"),
        ({"windows": 5, "minutes": 1.0, "deterministic": True}, "no minutes"),
    ],
)
def test_wrong_settings_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        TrainConfig(**settings)


QUICK_PRIOR = replace(
    QUICK, windows=32, batch=16, channels=8, skeletons=0, validations=1, validation_windows=8, augment=plain()
)
BODY = SkeletonModel.default()
CORPUS = support.tiny_corpus(frames=60)


def test_a_trained_model_has_the_prior_of_its_training_clips(tmp_path: Path) -> None:
    prior = Lifter.load(train(QUICK_PRIOR, CORPUS, tmp_path / "model.npz")).prior
    known = shipped_prior(CORPUS.names)
    expected = fit_pose_prior(CORPUS.names, CORPUS.parents, motions_of(CORPUS), False, known=known)
    assert prior is not None
    for name, value in expected.arrays().items():
        np.testing.assert_allclose(prior.arrays()[name], value, rtol=1e-12, err_msg=name)
    assert BODY.with_prior(prior).table.prior is prior
    config = replace(QUICK_PRIOR, prior="none")
    assert Lifter.load(train(config, CORPUS, tmp_path / "lifter.npz")).prior is None


def test_one_rig_keeps_its_spine_and_several_share_the_bend() -> None:
    offsets = CORPUS.joint_offsets.copy()
    offsets[1, BODY.index("Spine2")] *= 2.5
    mixed = replace(CORPUS, joint_offsets=offsets)
    auto, several = (prior_of_corpus(corpus) for corpus in (CORPUS, mixed))
    own, even = prior_of_corpus(CORPUS, "own"), prior_of_corpus(CORPUS, "even")
    assert auto
    assert several
    assert own
    assert even
    np.testing.assert_array_equal(auto.covariance, own.covariance)
    np.testing.assert_array_equal(several.covariance, even.covariance)
    assert not np.allclose(own.covariance, even.covariance)


def test_subjects_have_the_posture_of_their_first_t_pose() -> None:
    local = np.tile(np.eye(3), (len(CORPUS.R_world_bone), 21, 1, 1))
    spine, arms = BODY.names.index("Spine"), BODY.index("LeftArm", "RightArm")
    for clip, pitch in enumerate(np.radians([10.0, -5.0, 8.0, 8.0])):
        local[CORPUS.frames(clip), spine] = so3.about_axis("y", pitch)
    local[CORPUS.frames(1), arms[0]] = so3.about_axis("x", np.radians(-80.0))
    R = kinematics.world_rotations(CORPUS.parents, local).astype(np.float32)
    found = postures_of(replace(CORPUS, R_world_bone=R))
    assert list(found) == ["subject 0"]
    posture = dict(zip(found["subject 0"].joints, found["subject 0"].R_parent_bone, strict=True))
    np.testing.assert_allclose(so3.log(posture["Spine"]), [0, np.radians(10.0), 0], atol=1e-6)

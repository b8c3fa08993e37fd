"""The prior that a training learns beside the lifter."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import lifting_support as support
import numpy as np
import pytest

from lifting.predict import Lifter
from lifting.training.data import plain
from lifting.training.settings import TrainConfig, motions_of, postures_of, prior_of_corpus
from lifting.training.train import train
from rtof_kin.body import kinematics
from rtof_kin.body.pose_prior import shipped_prior
from rtof_kin.body.pose_prior_fit import fit_pose_prior
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3

QUICK = TrainConfig(
    windows=32,
    batch=16,
    channels=8,
    skeletons=0,
    report_every=1,
    validations=1,
    threads=1,
    validation_windows=8,
    bfloat16=False,
    augment=plain(),
)
BODY = SkeletonModel.default()
CORPUS = support.tiny_corpus(frames=60)


def test_a_trained_model_has_the_prior_of_its_training_clips(tmp_path: Path) -> None:
    prior = Lifter.load(train(QUICK, CORPUS, tmp_path / "model.pt")).prior
    known = shipped_prior(CORPUS.names)
    expected = fit_pose_prior(CORPUS.names, CORPUS.parents, motions_of(CORPUS), False, known=known)
    assert prior is not None
    for name, value in expected.arrays().items():
        np.testing.assert_allclose(prior.arrays()[name], value, rtol=1e-12, err_msg=name)
    assert BODY.with_prior(prior).table.prior is prior
    config = replace(QUICK, prior="none")
    assert Lifter.load(train(config, CORPUS, tmp_path / "lifter.pt")).prior is None


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


@pytest.mark.parametrize("table, frames", [(support.TABLE_17, 60), (support.TABLE, 20)])
def test_other_skeletons_and_short_clips_have_no_prior(table: object, frames: int) -> None:
    assert prior_of_corpus(support.tiny_corpus(frames=frames, table=table)) is None  # type: ignore[arg-type]


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

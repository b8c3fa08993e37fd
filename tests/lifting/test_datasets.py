from __future__ import annotations

from pathlib import Path

import human36m_files as h36m
import numpy as np
import pytest
import total_capture_support as tc

from lifting.training.corpus import HUMAN36M_VALIDATION, Corpus, human36m_corpus, total_capture_corpus
from rtof_kin.core.errors import FileFormatError
from rtof_kin.datasets.human36m import SUBJECTS_TRAIN
from rtof_kin.datasets.total_capture import TEST

FEW = (("S1", "rom1"), ("S3", "acting2"), ("S2", "walking1"))
"""Takes that train, validate, train."""


def lowest(corpus: Corpus, clip: int) -> float:
    feet = [j for j, name in enumerate(corpus.names) if name.endswith("Foot")]
    return float(np.percentile(corpus.positions(clip)[:, feet, 2].min(axis=1), 5))


# --- Total Capture -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def takes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three training takes, and test takes that must not be opened."""
    root = tmp_path_factory.mktemp("total_capture")
    tc.dataset(root, *(tc.take(*name) for name in FEW))
    for test in (("S1", "acting3"), ("S5", "walking2")):
        folder = root / test[0] / test[1]
        folder.mkdir(parents=True)
        (folder / "gt_skel_gbl_pos.txt").write_text("not to be opened")
    return root


def test_the_motion_of_training_takes_is_that_of_the_files(takes: Path) -> None:
    corpus = total_capture_corpus(takes)
    assert corpus.subjects == ("S1", "S2", "S3")
    assert corpus.split == ("train", "train", "validation")
    assert corpus.rate_hz == 60
    assert "Trumble" in corpus.acknowledgement
    assert "stay with its licensee" in corpus.acknowledgement
    for clip, name in enumerate((FEW[0], FEW[2], FEW[1])):
        truth = tc.take(*name)
        p = corpus.positions(clip)
        assert lowest(corpus, clip) == pytest.approx(0.07, abs=1e-5)
        shift = p - truth.poses.p_world_joint
        np.testing.assert_allclose(shift[..., :2], 0, atol=1e-4)
        np.testing.assert_allclose(shift[..., 2], shift[0, 0, 2], atol=1e-4)
        np.testing.assert_allclose(corpus.joint_offsets[clip], truth.joint_offsets, atol=1e-4)


def test_missing_takes_are_reported_and_test_takes_not_read(takes: Path) -> None:
    reports: list[tuple[int, int, str]] = []
    total_capture_corpus(takes, lambda *report: reports.append(report))
    assert [done for done, _, _ in reports] == list(range(1, 28))
    assert {total for _, total, _ in reports} == {27}
    assert [note for _, _, note in reports if "skipped" not in note] == [f"{s} {n}" for s, n in sorted(FEW)]
    (walking,) = (note for _, _, note in reports if note.startswith("S1 walking3"))
    assert "S1 walking3 skipped: unknown take" in walking
    assert not [note for _, _, note in reports if note.split(" skipped")[0].split() in map(list, TEST)]


def test_a_take_is_cut_where_the_reference_jumps_and_damage_is_skipped(tmp_path: Path) -> None:
    glitch = tc.take("S2", "acting2", frames=2180)
    paths = tc.dataset(tmp_path, tc.take("S1", "rom1"), glitch, tc.take("S3", "rom2"))
    assert paths["positions"].parent.name == "rom2"
    paths["positions"].write_text("broken")
    reports: list[str] = []
    corpus = total_capture_corpus(tmp_path, lambda done, total, note: reports.append(note))
    whole, after = len(tc.take("S1", "rom1").poses), len(glitch.poses) - 2132
    # The reference jumps in frames 2124 to 2129; two on either side go with them.
    assert np.diff(corpus.start).tolist() == [whole, 2122, after]
    assert corpus.subjects == ("S1", "S2", "S2")
    second = glitch.poses.p_world_joint[2132:]
    shift = corpus.positions(2) - second
    np.testing.assert_allclose(shift, np.broadcast_to(shift[:1, :1], shift.shape), atol=1e-3)
    (rom2,) = (note for note in reports if note.startswith("S3 rom2"))
    assert "skipped: " in rom2
    assert "gt_skel_gbl_pos.txt" in rom2


def test_validation_takes_may_be_chosen_but_some_must_train(takes: Path) -> None:
    assert set(total_capture_corpus(takes, validation=()).split) == {"train"}
    assert total_capture_corpus(takes, validation=FEW[:1]).split == ("validation", "train", "train")
    with pytest.raises(FileFormatError, match="no take to train on could be read; first of all: S1 "):
        total_capture_corpus(takes, validation=FEW)


# --- Human3.6M -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def positions() -> h36m.Positions:
    motion = h36m.motions(("S1", "S8", "S9", "S11"), actions=2, frames=40)
    names = {"Action 0": "Walking 1", "Action 1": "WalkTogether"}
    return {s: {names[a]: p for a, p in of.items()} for s, of in motion.items()}


@pytest.fixture(scope="module")
def archive(positions: h36m.Positions, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Positions alone: neither keypoints nor cameras."""
    root = tmp_path_factory.mktemp("human36m")
    h36m.write_positions(root, positions)
    return root


def test_test_subjects_are_not_read_and_some_actions_validate(archive: Path) -> None:
    reports: list[tuple[int, int, str]] = []
    corpus = human36m_corpus(archive, lambda *report: reports.append(report))
    assert [note for _, _, note in reports] == ["S1 WalkTogether", "S1 Walking 1", "S8 WalkTogether", "S8 Walking 1"]
    assert corpus.subjects == ("S1", "S1", "S8", "S8")
    assert corpus.split == ("train", "train", "train", "validation")
    assert {subject for subject, _ in HUMAN36M_VALIDATION} <= set(SUBJECTS_TRAIN)
    assert (corpus.rate_hz, len(corpus.names)) == (50.0, 17)
    assert "Academic use only" in corpus.acknowledgement


def test_gaps_are_cut_out_and_damaged_actions_skipped(positions: h36m.Positions, tmp_path: Path) -> None:
    p = np.concatenate([positions["S1"]["Walking 1"]] * 2)
    p[38:42, 5] = np.nan
    entries = {"S1": {"Walking 1": p, "Sitting": np.zeros((5, 3))}}
    h36m.write_positions(tmp_path, entries)
    reports: list[str] = []
    corpus = human36m_corpus(tmp_path, lambda done, total, note: reports.append(note))
    assert np.diff(corpus.start).tolist() == [38, 38]
    assert "S1 Sitting skipped: " in reports[0]

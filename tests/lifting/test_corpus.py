from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import human36m_files as h36m
import lifting_support as support
import numpy as np
import pytest
import total_capture_support as tc

from lifting.training import corpus as splits
from lifting.training.corpus import (
    HUMAN36M_VALIDATION,
    Corpus,
    find_split,
    human36m_corpus,
    join_clips,
    read_corpus,
    read_split,
    total_capture_corpus,
)
from rtof_kin.body import kinematics
from rtof_kin.body.kinematics import shared_frames, to_shared
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import FileFormatError, InvalidInputError
from rtof_kin.data.poses import PoseSequence
from rtof_kin.datasets.human36m import SUBJECTS_TRAIN
from rtof_kin.simulation.mocap import MocapClip, read_mocap

EXCERPT = Path(__file__).parents[1] / "fixtures" / "mocap" / "02_01_excerpt.bvh"


@pytest.fixture(scope="module")
def corpus() -> Corpus:
    return support.tiny_corpus()


def test_a_corpus_round_trips(corpus: Corpus, tmp_path: Path) -> None:
    back = read_corpus(corpus.save(tmp_path / "motion.npz"))
    np.testing.assert_allclose(back.R_world_bone, corpus.R_world_bone, atol=1e-6)
    np.testing.assert_array_equal(back.p_world_root, corpus.p_world_root)
    np.testing.assert_array_equal(back.joint_offsets, corpus.joint_offsets)
    assert (back.names, back.parents) == (corpus.names, corpus.parents)
    assert (back.subjects, back.split) == (corpus.subjects, corpus.split)
    assert back.body() == corpus.body()


def test_positions_are_those_of_the_clip_read(tmp_path: Path) -> None:
    clip = replace(read_mocap(EXCERPT), subject="s1")
    corpus = join_clips([(clip, "validation")])
    np.testing.assert_allclose(corpus.positions(0), clip.poses.p_world_joint, atol=1e-5)
    assert corpus.clips("validation") == [0]


def test_clips_at_another_rate_are_resampled() -> None:
    clip = read_mocap(EXCERPT, output_rate_hz=None)
    assert clip.poses.rate_hz == pytest.approx(30)
    corpus = join_clips([(clip, "train"), (read_mocap(EXCERPT), "test")])
    assert corpus.rate_hz == 60
    np.testing.assert_array_equal(corpus.positions(0)[::2], join_clips([(clip, "train")], rate_hz=30).positions(0))
    lengths = np.linalg.norm(corpus.positions(0)[:, 1:] - corpus.positions(0)[:, corpus.parents[1:]], axis=-1)
    np.testing.assert_allclose(lengths, np.broadcast_to(lengths[:1], lengths.shape), atol=1e-5)
    np.testing.assert_allclose(corpus.positions(0), corpus.positions(1), atol=1e-5)


def seventeen(bend: float = 0.0, rate_hz: float = 50.0) -> MocapClip:
    """A clip of the 17 joints whose left shoulder moves up and down by `bend`."""
    table = support.TABLE_17
    p_root, R = support.moving(3, 60, table, rate_hz)
    p = kinematics.positions(table.parents, table.offsets, p_root, R)
    times = np.arange(60) / rate_hz
    left = [table.names.index(name) for name in ("LShoulder", "LElbow", "LWrist")]
    p[:, left, 2] += bend * np.sin(20 * times)[:, None]
    return MocapClip("seventeen", PoseSequence(times, p, R, table.names), table.offsets, "s")


@pytest.mark.parametrize("rate_hz", [50.0, 60.0])
def test_nonrigid_joints_are_kept_as_recorded(rate_hz: float) -> None:
    clip = seventeen(bend=0.03)
    corpus = join_clips([(clip, "train")], support.TABLE_17.parents, rate_hz)
    assert corpus.beyond_rigid is not None
    assert join_clips([(seventeen(), "train")], support.TABLE_17.parents, 50.0).beyond_rigid is None
    at = np.arange(0, 50, 5)  # tenths of a second
    now = (at * rate_hz / 50).astype(int)
    np.testing.assert_allclose(
        corpus.positions(0)[now], clip.poses.p_world_joint[at], atol=1e-5 if rate_hz == 50 else 1e-3
    )


def test_clips_of_different_skeletons_are_refused() -> None:
    with pytest.raises(InvalidInputError, match="clip seventeen has the joints Hip, RHip.*each skeleton"):
        join_clips([(read_mocap(EXCERPT), "train"), (seventeen(), "train")])
    with pytest.raises(InvalidInputError, match="has the joints Hip, .*not the 21"):
        join_clips([(seventeen(), "train")])
    with pytest.raises(InvalidInputError, match="there is no clip"):
        join_clips([])


def test_in_shared_frames_the_same_motion_of_two_rigs_is_one(corpus: Corpus) -> None:
    R_bone_rig = shared_frames(corpus.names, corpus.joint_offsets[0])
    R_bone_rig[0] = so3.about_axis("y", np.radians(20.0))
    offsets = np.stack([to_shared(R_bone_rig, corpus.parents, own) for own in corpus.joint_offsets])
    other = replace(
        corpus,
        R_world_bone=(corpus.R_world_bone @ R_bone_rig).astype(np.float32),
        joint_offsets=offsets.astype(np.float32),
    )
    one, two = corpus.in_shared_frames(), other.in_shared_frames()
    np.testing.assert_allclose(one.R_world_bone, two.R_world_bone, atol=1e-5)
    np.testing.assert_allclose(one.joint_offsets, two.joint_offsets, atol=1e-6)
    np.testing.assert_allclose(one.positions(1), corpus.positions(1), atol=1e-5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"start": np.array([0, 5, 5, 180, 360])}, "start: must cut"),
        ({"split": ("train", "train", "train", "holdout")}, "no holdout; known: train"),
        ({"subjects": ("a", "b")}, "joint_offsets: expected shape"),
        ({"parents": (-1, 0)}, "parents: expected shape"),
        ({"rate_hz": 0.0}, "rate_hz: 0 Hz"),
        ({"p_world_root": np.full((360, 3), np.nan)}, "p_world_root: not finite"),
        ({"beyond_rigid": np.zeros((3, 21, 3))}, "beyond_rigid: expected shape"),
        ({"beyond_rigid": np.full((360, 21, 3), np.nan)}, "beyond_rigid: not finite"),
    ],
)
def test_inconsistent_corpora_are_refused(corpus: Corpus, change: dict, message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        replace(corpus, **change)


def test_a_missing_file_and_a_missing_field_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="there is no such file"):
        read_corpus(tmp_path / "nowhere.npz")
    np.savez(tmp_path / "half.npz", joint_names=["a"], parents=[-1])
    with pytest.raises(FileFormatError, match="quat_wxyz"):
        read_corpus(tmp_path / "half.npz")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('vaildation = ["a"]', "'vaildation' is not a list of one of: train"),
        ('test = "a"', "'test' is not a list"),
        ('test = ["a"]\nvalidation = ["a"]', "subject a is in two lists"),
        ("test = [", "not readable as TOML"),
    ],
)
def test_wrong_splits_are_refused(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "split.toml"
    path.write_text(text)
    with pytest.raises(FileFormatError, match=message):
        read_split(path)


def test_the_split_of_the_folder_comes_before_that_of_the_benchmarks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert find_split(tmp_path) == splits.BENCHMARK_SPLIT
    own = tmp_path / "split.toml"
    own.write_text("")
    assert find_split(tmp_path) == own
    monkeypatch.setattr(splits, "BENCHMARK_SPLIT", tmp_path / "none.toml")
    own.unlink()
    with pytest.raises(FileFormatError, match="needs a split of its subjects: write lists"):
        find_split(tmp_path)


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


def test_a_split_is_read_by_subject(tmp_path: Path) -> None:
    path = tmp_path / "split.toml"
    path.write_text('test = ["a"]\nvalidation = ["b", "c"]\n[benchmark]\nseconds = 10.0\n')
    assert read_split(path) == {"a": "test", "b": "validation", "c": "validation"}

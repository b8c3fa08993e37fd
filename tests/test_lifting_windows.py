from __future__ import annotations

import lifting_support as support
import numpy as np
import pytest
import torch
from torch import Tensor

from lifting.windows import (
    Body,
    bone_groups,
    decode,
    encode,
    mirror_features,
    mirror_output,
    side_of,
)
from rtof_kin import kinematics
from rtof_kin import rotations as so3
from rtof_kin.skeleton_table import SkeletonTable

W = 27


@pytest.fixture(scope="module")
def body() -> Body:
    return support.tiny_corpus().body()


@pytest.fixture(scope="module")
def body_17() -> Body:
    return support.tiny_corpus(table=support.TABLE_17).body()


@pytest.fixture(scope="module")
def scene() -> Tensor:
    """Points (B, 3, W, J) from the optical centre of a camera at 1.6 m, some way off along x."""
    p = np.stack([support.positions(seed, W) for seed in range(3)])
    p += np.array([4.0, 0.7, -1.6]) + np.arange(3)[:, None, None, None] * np.array([1.0, -0.4, 0.0])
    return torch.from_numpy(p).permute(0, 3, 1, 2).double()


def everything(scene: Tensor) -> Tensor:
    return torch.ones(scene.shape[0], *scene.shape[2:], dtype=torch.bool)


def known(body: Body, B: int) -> tuple[Tensor, Tensor]:
    bones = body.bones_of(torch.from_numpy(support.TABLE.offsets)).expand(B, -1)
    return bones, torch.full((B,), 1.6, dtype=torch.float64)


def turned(R: np.ndarray, p: Tensor) -> Tensor:
    return torch.einsum("ij,bj...->bi...", torch.from_numpy(R), p)


def true_output(body: Body, scene: Tensor, encoded: object) -> Tensor:
    """What a perfect network would answer."""
    middle = scene[:, :, W // 2]
    pose = torch.bmm(encoded.R_ray_world, middle - middle[:, :, :1])[:, :, 1:]
    root = torch.einsum("bij,bj->bi", encoded.R_view_world, middle[:, :, 0])
    shift = root[:, :2] / root[:, 2:] / encoded.scale[:, None]
    distance = (root.norm(dim=1) * encoded.scale).log()
    return torch.cat([pose.flatten(1), shift, distance[:, None]], dim=1)


@pytest.mark.parametrize(
    ("name", "side", "rest"),
    [
        ("LeftArm", "left", "Arm"),
        ("RightUpLeg", "right", "UpLeg"),
        ("LElbow", "left", "Elbow"),
        ("RHip", "right", "Hip"),
        ("Hip", "", "Hip"),
        ("Root", "", "Root"),
        ("Lumbar", "", "Lumbar"),
    ],
)
def test_both_ways_to_name_a_side_are_read(name: str, side: str, rest: str) -> None:
    assert side_of(name) == (side, rest)


@pytest.mark.parametrize(
    ("table", "arms", "legs"),
    [
        (support.TABLE, "RightArm RightForeArm RightHand LeftArm LeftForeArm LeftHand",
         "RightUpLeg RightLeg RightFoot LeftUpLeg LeftLeg LeftFoot"),
        (support.TABLE_17, "LShoulder LElbow LWrist RShoulder RElbow RWrist",
         "RHip RKnee RFoot LHip LKnee LFoot"),
    ],
)  # fmt: skip
def test_limbs_are_found_in_both_skeletons(table: SkeletonTable, arms: str, legs: str) -> None:
    body = Body(table.names, table.parents, ())
    assert [body.names[j] for limb in body.arms for j in limb] == arms.split()
    assert [body.names[j] for limb in body.legs for j in limb] == legs.split()
    assert body.feet == [leg[2] for leg in body.legs]
    assert body.hips == [leg[0] for leg in body.legs]


def test_every_joint_of_the_17_has_its_counterpart(body_17: Body) -> None:
    order = body_17.mirrored
    assert [order[j] for j in order] == list(range(17))
    for name, j in zip(body_17.names, order, strict=True):
        swapped = {"L": "R", "R": "L"}.get(name[0], name[0]) + name[1:]
        assert body_17.names[j] == swapped
    assert len(bone_groups(body_17.names)) == 10  # 4 in the middle, 6 of two sides


def test_a_joint_without_a_counterpart_is_its_own() -> None:
    assert Body(("Hips", "LeftArm", "RightHand"), (-1, 0, 0), ()).mirrored == [0, 1, 2]


def test_mirrored_scenes_of_17_joints_have_mirrored_features(body_17: Body) -> None:
    p_root, R = support.moving(5, W, support.TABLE_17)
    p = kinematics.positions(support.TABLE_17.parents, support.TABLE_17.offsets, p_root, R)
    scene = torch.from_numpy(p + np.array([4.0, 0.7, -1.6])).permute(2, 0, 1)[None]
    bones = body_17.bones_of(torch.from_numpy(support.TABLE_17.offsets))[None]
    height = torch.full((1,), 1.6, dtype=torch.float64)
    flip = torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64)[:, None, None]
    here = encode(body_17, scene, everything(scene), bones, height)
    there = encode(body_17, (scene * flip)[..., body_17.mirrored], everything(scene), bones, height)
    assert here.features.shape[-1] == body_17.inputs
    torch.testing.assert_close(mirror_features(body_17, here.features), there.features)
    assert not torch.allclose(here.features, there.features)


def test_left_and_right_bones_are_one(body: Body) -> None:
    groups = bone_groups(body.names)
    assert len(groups) == 13
    assert [body.names[j] for j in groups["ForeArm"]] == ["RightForeArm", "LeftForeArm"]
    assert len(groups["Head"]) == 1


def test_bones_do_not_change_when_left_and_right_are_exchanged(body: Body) -> None:
    offsets = torch.from_numpy(support.TABLE.offsets + np.random.default_rng(0).normal(size=(21, 3)))
    mirrored = offsets[body.mirrored] * torch.tensor([1.0, -1.0, 1.0])
    torch.testing.assert_close(body.bones_of(mirrored), body.bones_of(offsets))


def test_the_answer_read_back_is_the_scene(body: Body, scene: Tensor) -> None:
    encoded = encode(body, scene, everything(scene), *known(body, 3))
    pose, root = decode(body, true_output(body, scene, encoded), encoded)
    middle = scene[:, :, W // 2].float()
    torch.testing.assert_close(root.float(), middle[:, :, 0], atol=1e-5, rtol=0)
    torch.testing.assert_close(pose.float(), middle - middle[:, :, :1], atol=1e-5, rtol=0)


def test_with_the_root_seen_its_ray_is_the_view_axis(body: Body, scene: Tensor) -> None:
    encoded = encode(body, scene, everything(scene), *known(body, 3))
    on_axis = torch.einsum("bij,bj->bi", encoded.R_view_world, scene[:, :, W // 2, 0])
    assert on_axis[:, :2].abs().max() < 1e-9
    assert torch.all(on_axis[:, 2] > 0)
    assert encoded.features[:, W // 2, [0, 21]].abs().max() < 1e-6


def test_frames_of_a_window_are_rotations_with_no_roll(body: Body, scene: Tensor) -> None:
    encoded = encode(body, scene, everything(scene), *known(body, 3))
    assert so3.is_rotation(encoded.R_view_world.numpy())
    assert so3.is_rotation(encoded.R_ray_world.numpy())
    assert encoded.R_view_world[:, 0, 2].abs().max() < 1e-12  # right is level
    torch.testing.assert_close(
        encoded.R_ray_world[:, 2], torch.tensor([[0.0, 0, 1]] * 3, dtype=torch.float64)
    )


def test_turning_the_world_about_the_vertical_leaves_the_input_unchanged(
    body: Body, scene: Tensor
) -> None:
    R = so3.about_axis("z", 2.1)
    straight = encode(body, scene, everything(scene), *known(body, 3))
    rotated = encode(body, turned(R, scene), everything(scene), *known(body, 3))
    torch.testing.assert_close(rotated.features, straight.features, atol=1e-9, rtol=1e-9)
    _, root = decode(body, true_output(body, scene, straight), rotated)
    torch.testing.assert_close(
        root, turned(R, scene[:, :, W // 2, 0]).to(root.dtype), atol=1e-5, rtol=0
    )


def test_a_lean_of_the_world_does_change_the_input(body: Body, scene: Tensor) -> None:
    leaned = turned(so3.about_axis("y", 0.2), scene)
    straight = encode(body, scene, everything(scene), *known(body, 3))
    assert (encode(body, leaned, everything(scene), *known(body, 3)).features
            - straight.features).abs().max() > 0.1  # fmt: skip


def test_the_length_of_rays_carries_nothing(body: Body, scene: Tensor) -> None:
    unit = scene / scene.norm(dim=1, keepdim=True)
    torch.testing.assert_close(
        encode(body, unit, everything(scene), *known(body, 3)).features,
        encode(body, scene, everything(scene), *known(body, 3)).features,
    )


def test_the_mirrored_scene_has_the_mirrored_features_and_answer(body: Body, scene: Tensor) -> None:
    seen = torch.rand(everything(scene).shape, generator=torch.Generator().manual_seed(1)) > 0.2
    sign = torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64)[:, None, None]
    mirrored = (scene * sign)[..., body.mirrored]
    here = encode(body, scene, seen, *known(body, 3))
    there = encode(body, mirrored, seen[..., body.mirrored], *known(body, 3))
    torch.testing.assert_close(mirror_features(body, here.features), there.features)
    torch.testing.assert_close(
        mirror_output(body, true_output(body, scene, here)), true_output(body, mirrored, there)
    )


def test_mirroring_twice_changes_nothing(body: Body) -> None:
    features, output = torch.randn(2, W, body.inputs), torch.randn(2, body.outputs)
    torch.testing.assert_close(mirror_features(body, mirror_features(body, features)), features)
    torch.testing.assert_close(mirror_output(body, mirror_output(body, output)), output)


def test_what_is_unseen_is_not_read(body: Body, scene: Tensor) -> None:
    seen = everything(scene)
    seen[:, :, 10] = False
    seen[:, 20:] = False
    changed = torch.where(seen[:, None], scene, torch.tensor(7.0, dtype=torch.float64))
    torch.testing.assert_close(
        encode(body, changed, seen, *known(body, 3)).features,
        encode(body, scene, seen, *known(body, 3)).features,
    )


def test_hips_stand_in_for_an_unseen_root(body: Body, scene: Tensor) -> None:
    seen = everything(scene)
    seen[:, :, 0] = False
    encoded = encode(body, scene, seen, *known(body, 3))
    unit = scene / scene.norm(dim=1, keepdim=True)
    mean = unit[:, :, W // 2, body.hips].mean(dim=2)
    axis = torch.nn.functional.normalize(mean, dim=1)
    torch.testing.assert_close(encoded.R_view_world[:, 2], axis)


def test_the_nearest_frame_stands_in_for_an_unseen_one(body: Body, scene: Tensor) -> None:
    seen = everything(scene)
    seen[:, 10:17] = False  # 9 is nearer to 13 than 17 by nothing: the first of equals
    encoded = encode(body, scene, seen, *known(body, 3))
    root = torch.nn.functional.normalize(scene[:, :, 9, 0], dim=1)
    torch.testing.assert_close(encoded.R_view_world[:, 2], root)


def test_unknown_bones_and_height_are_zeros_with_a_flag(body: Body, scene: Tensor) -> None:
    bones, height = known(body, 3)
    nan = torch.tensor(float("nan"), dtype=torch.float64)
    told = encode(body, scene, everything(scene), bones, height).features
    untold = encode(body, scene, everything(scene), bones * nan, height * nan).features
    assert torch.isfinite(untold).all()
    assert torch.all(told[..., -1] == 1)
    assert untold[..., -40:].abs().max() == 0
    assert untold[..., 63:67].abs().max() == 0
    torch.testing.assert_close(told[..., :63], untold[..., :63])


def test_a_foot_on_the_floor_tells_its_distance(body: Body, scene: Tensor) -> None:
    lowest = scene.clone()
    lowest[:, 2, :, body.feet] = 0.08 - 1.6
    encoded = encode(body, lowest, everything(scene), *known(body, 3))
    away = lowest[:, :2, :, body.feet].norm(dim=1)
    expected = (away * encoded.scale[:, None, None]).log()
    torch.testing.assert_close(encoded.features[..., 63:65], expected)
    assert torch.all(encoded.features[..., 65:67] == 1)


def test_nothing_seen_and_degenerate_scenes_stay_finite(body: Body, scene: Tensor) -> None:
    bones, height = known(body, 3)
    nothing = encode(body, scene, ~everything(scene), bones, height)
    behind = encode(body, -scene + 2 * scene[..., :1], everything(scene), bones, height)
    point = encode(body, scene[..., :1].expand(scene.shape), everything(scene), bones, height)
    above = encode(body, scene * torch.tensor([0.0, 0.0, 1.0])[:, None, None].double(),
                   everything(scene), bones, height)  # fmt: skip
    for encoded in (nothing, behind, point, above):
        assert torch.isfinite(encoded.features).all()
        pose, root = decode(body, torch.full((3, body.outputs), 1e6), encoded)
        assert torch.isfinite(pose).all()
        assert torch.isfinite(root).all()

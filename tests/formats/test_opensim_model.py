"""Models as OpenSim loads them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import planted
import pytest
from opensim_support import read_by_opensim

from rtof_kin.body import urdf
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.formats.opensim import coordinates, to_osim, write_mot, write_osim

R_GROUND_WORLD = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])


@pytest.fixture
def body(any_skeleton: SkeletonModel) -> SkeletonModel:
    """A person of given height and mass, on either skeleton."""
    return any_skeleton.with_height(1.83).with_mass(68, "female")


def test_opensim_mass_and_inertia(body: SkeletonModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_osim(tmp_path / "skeleton.osim", body)
    found = read_by_opensim(tmp_path, tmp_path / "found.npz")
    # Without the light links between revolutes, which OpenSim does not need, it is the same mechanism.
    monkeypatch.setattr(urdf, "LIGHT_MASS_KG", 1e-12)
    monkeypatch.setattr(urdf, "LIGHT_INERTIA", 1e-15)
    model = pin.buildModelFromXML(body.to_urdf(), pin.JointModelFreeFlyer())
    data, q = model.createData(), pin.neutral(model)
    assert found["mass"] == pytest.approx(sum(inertia.mass for inertia in model.inertias), abs=1e-9)
    center = pin.centerOfMass(model, data, q)
    np.testing.assert_allclose(found["center_of_mass"], R_GROUND_WORLD @ center, atol=1e-9)

    every = {c.name: c for c in coordinates(body.table)}
    revolutes = {d.opensim.lstrip("-") or d.urdf: d.urdf for j in body.table.joints for d in j.dofs}
    names = [name for name in found["coordinates"] if name in revolutes]
    ours = [model.joints[model.getJointId(revolutes[name])].idx_v for name in names]
    theirs = [list(found["coordinates"]).index(name) for name in names]
    sign = np.array([every[name].sign for name in names])
    M = pin.crba(model, data, q)
    M = np.triu(M) + np.triu(M, 1).T
    expected = M[np.ix_(ours, ours)] * np.outer(sign, sign)
    np.testing.assert_allclose(found["mass_matrix"][np.ix_(theirs, theirs)], expected, atol=1e-9)


def test_opensim_finds_the_coordinates_and_their_ranges(body: SkeletonModel, tmp_path: Path) -> None:
    write_osim(tmp_path / "skeleton.osim", body)
    found = read_by_opensim(tmp_path, tmp_path / "found.npz")
    expected = {c.name: c.range for c in coordinates(body.table)}
    assert set(found["coordinates"]) == set(expected)
    for name, limits in zip(found["coordinates"], found["ranges"], strict=True):
        np.testing.assert_allclose(limits, expected[name])


def test_opensim_reproduces_the_motion_of_either_skeleton(body: SkeletonModel, tmp_path: Path) -> None:
    motion = planted.seen(body, 12)
    write_osim(tmp_path / "skeleton.osim", body)
    write_mot(tmp_path / "motion.mot", motion)
    found = read_by_opensim(tmp_path, tmp_path / "found.npz")
    p = body.landmark_positions(motion.poses.p_world_joint, motion.poses.R_world_bone)
    np.testing.assert_allclose(found["motion.mot/markers"], p @ R_GROUND_WORLD.T, atol=1e-9)


def test_file_states_axes_zero_and_standard_gravity(skeleton: SkeletonModel) -> None:
    text = to_osim(skeleton)
    assert "x forward, y left, z up in the T-pose, where every coordinate is zero" in text
    assert "<gravity>0.0 -9.80665 0.0</gravity>" in text
    assert "nan" not in text.lower()

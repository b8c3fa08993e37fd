"""Errors of joints regressed from a real detector's points: fixed in the body, correlated, larger if hidden.

The table ``models/joint_errors.npz`` is fitted by ``models/build_joint_errors.py`` to the simulated points of
a real detector. An error is in the image plane at the joint's depth, in m (pixels x depth / f):

    place in the segment + vector of the pelvis that depends on the view - where the rig has the joint
    + limb's mood x hidden x sum over parts of (front or back, left or right) factor x paths.

The first line is projected. A part has one time constant; that of the first is infinite. A detector's points
are of the person: regressed joints of the trunk lie where most rigs have them, whatever the rig at hand
(`rig_places`). Limbs jump and exchange sides besides.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cache, lru_cache
from typing import Final

import torch
from torch import Tensor

from lifting.body import Body, side_of
from rtof_kin.core.files.arrays import read_npz
from rtof_kin.core.resources import model_path


@dataclass(frozen=True)
class Draw:
    """Random tensors of one batch, all from one generator on one device."""

    batch: int
    generator: torch.Generator
    device: torch.device

    def uniform(self, *shape: int) -> Tensor:
        """Return uniform numbers in [0, 1)."""
        return torch.rand(shape, generator=self.generator, device=self.device)

    def normal(self, *shape: int) -> Tensor:
        """Return standard normal numbers."""
        return torch.randn(shape, generator=self.generator, device=self.device)

    def between(self, bounds: tuple[float, float], *shape: int) -> Tensor:
        """Return uniform numbers between two bounds."""
        return bounds[0] + (bounds[1] - bounds[0]) * self.uniform(*shape)

    def integers(self, below: int) -> Tensor:
        """Return integers (batch,) from 0 to below - 1."""
        return torch.randint(below, (self.batch,), generator=self.generator, device=self.device)


def about_axis(axis: int, angle: Tensor) -> Tensor:
    """Return rotations (B, 3, 3) about a coordinate axis. axis: 0, 1 or 2 for x, y or z. angle: (B,) rad."""
    c, s, o, i = angle.cos(), angle.sin(), torch.zeros_like(angle), torch.ones_like(angle)
    rows = ([[i, o, o], [o, c, -s], [o, s, c]], [[c, o, s], [o, i, o], [-s, o, c]], [[c, -s, o], [s, c, o], [o, o, i]])[
        axis
    ]
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def cross(a: Tensor, b: Tensor) -> Tensor:
    """Return the cross product of (B, 3, ...); faster than torch's for planar components."""
    (a1, a2, a3), (b1, b2, b3) = a.unbind(dim=1), b.unbind(dim=1)
    return torch.stack([a2 * b3 - a3 * b2, a3 * b1 - a1 * b3, a1 * b2 - a2 * b1], dim=1)


NEAREST_M: Final = 0.2  #: Least depth of a joint, m
MEMORY_S: Final = (float("inf"), 0.5, 0.08)  #: Time constants of the parts of an error, s
TRUNK_HEIGHT: Final = {
    "Hips": 0.1,
    "Spine": 0.3,
    "Spine1": 0.45,
    "Spine2": 0.6,
    "Spine3": 0.75,
    "Neck": 1.0,
    "Head": 1.0,
    "Shoulder": 1.0,
}
"""Height of a joint of the trunk between hips (0) and shoulders (1) that `rig_places` are relative to."""
LEG_M: Final = 0.8  #: Length of a leg, m
MOOD: Final = {"Arm": 0.35, "ForeArm": 0.6, "Hand": 0.7, "Leg": 0.4, "Foot": 0.4}
"""Standard deviation of the logarithm of a joint's amplitude, shared in a limb; of others `USUAL_MOOD`."""
USUAL_MOOD: Final = 0.3
RUN_S: Final = 0.033  #: Median duration of exchanges and jumps, s
RUN_SPREAD: Final = 0.85  #: Standard deviation of its logarithm
EXCHANGES_PER_MINUTE: Final = {"legs": 100.0, "arms": 170.0, "shoulders": 22.0, "hips": 9.0}
"""Most frequent exchanges of left and right, in profile with both sides at one place."""
JUMPS_PER_MINUTE: Final = {"arms": 26.0, "legs": 5.0}
"""Jumps of each arm and leg; three times as many where it is hidden."""
JUMP_M: Final = 0.17
"""Standard deviation of a jump per axis of wrists and ankles, m; of elbows and knees 0.6 times as much."""


@dataclass(frozen=True)
class JointErrors:
    """Fitted numbers for J joints. Views are front, back and left; the right is their mirror image."""

    place: Tensor  #: (J, 3) offset in the frame of the joint's segment, m
    view: Tensor  #: (J, 9, 3) offset in the pelvis frame by `harmonics` of the direction to the camera there, m
    usual: Tensor  #: (J, 3) the usual `rig_places`
    follows: Tensor  #: (J,) share of the rig's difference from them that is an error
    factor: Tensor  #: (3, parts, 2 J, rank) factor of the covariance of x and y of each joint, m
    rest: Tensor  #: (3, parts, 2 J) independent standard deviation, m
    hidden: Tensor  #: (J,) factor on the error of a hidden joint

    @classmethod
    @cache
    def fitted(cls) -> JointErrors:
        """Return the shipped table."""
        arrays = read_npz(model_path("joint_errors.npz"))
        return cls(**{field.name: torch.from_numpy(arrays[field.name]).float() for field in fields(cls)})

    def to(self, device: torch.device) -> JointErrors:
        """Return the table on a device."""
        return JointErrors(**{field.name: getattr(self, field.name).to(device) for field in fields(self)})

    def blended(self, body: Body, view: View) -> tuple[Tensor, Tensor]:
        """Return factor (B, parts, 2 J, 2 rank) and rest (B, parts, 2 J) of views between the fitted ones."""
        sin, cos = (x[:, None, None] for x in view.azimuth())
        ahead = (cos[:, 0, 0] < 0).long()
        factor = [cos.abs()[..., None] * self.factor[ahead], sin.abs()[..., None] * self.factor[2]]
        rest = torch.hypot(cos * self.rest[ahead], sin * self.rest[2])
        order = torch.arange(2 * len(body.names), device=sin.device).reshape(-1, 2)
        mirrored = order[body.mirrored].flatten()
        flip = sin.new_tensor([-1.0, 1.0]).repeat(len(body.names))[:, None]
        right, both = sin < 0, torch.cat(factor, dim=-1)
        both = torch.where(right[..., None], both[:, :, mirrored] * flip, both)
        return both, torch.where(right, rest[:, :, mirrored], rest)


@dataclass(frozen=True)
class View:
    """Bodies relative to a camera, in the estimated frames of B windows."""

    joints: Tensor  #: (B, 3, J) from the optical centre in the camera's frame, m
    axes: Tensor  #: (B, 3, 2, J) x and z axes of the segments there
    offsets: Tensor  #: (B, J, 3) joint offsets of the bodies, m

    def __getitem__(self, rows: slice) -> View:
        return View(self.joints[rows], self.axes[rows], self.offsets[rows])

    def turned(self, R: Tensor) -> View:
        """Return the bodies in frames turned by rotations (B, 3, 3)."""
        axes = (R @ self.axes.flatten(2)).reshape(self.axes.shape)
        return View(R @ self.joints, axes, self.offsets)

    def segments(self) -> Tensor:
        """Return the segments' rotations (B, J, 3, 3) into the camera's frame."""
        x, z = self.axes.unbind(dim=2)
        return torch.stack([x, cross(z, x), z], dim=-1).transpose(1, 2)

    def azimuth(self) -> tuple[Tensor, Tensor]:
        """Return the sine and cosine (B,) of the direction to the camera in the pelvis; left is positive."""
        toward = self.segments()[:, 0].transpose(1, 2) @ -self.joints[:, :, :1]
        x, y = toward[:, 0, 0], toward[:, 1, 0]
        away = (x * x + y * y).sqrt().clamp_min(1e-9)
        return y / away, x / away


def harmonics(v: Tensor) -> Tensor:
    """Return 1 and the spherical harmonics of first and second order (..., 9) of unit vectors (..., 3)."""
    x, y, z = v.unbind(dim=-1)
    parts = [torch.ones_like(x), x, y, z, x * y, y * z, x * z, x * x - y * y, 3 * z * z - 1]
    return torch.stack(parts, dim=-1)


def rig_places(body: Body, offsets: Tensor) -> Tensor:
    """Return where rigs with offsets (B, J, 3), m, have the joints of the trunk (B, J, 3), upright, from the line
    between the middles of hips and shoulders, in lengths of a leg; zero for limbs.
    """
    places = [torch.zeros_like(offsets[:, 0])]
    for j, parent in enumerate(body.parents[1:], start=1):
        places.append(places[parent] + offsets[:, j])
    p = torch.stack(places, dim=1)
    leg = offsets[:, [j for leg in body.legs for j in leg[1:]]].norm(dim=-1).sum(dim=1) / 2
    hips, shoulders = (p[:, [a[0] for a in limbs]].mean(dim=1) for limbs in (body.legs, body.arms))
    share = torch.tensor([TRUNK_HEIGHT.get(side_of(name)[1], 0.0) for name in body.names]).to(p)
    line = torch.lerp(hips[:, None], shoulders[:, None], share[:, None])
    trunk = torch.tensor([side_of(name)[1] in TRUNK_HEIGHT for name in body.names], device=p.device)
    return torch.where(trunk[:, None], (p - line) / leg[:, None, None], 0.0)


def designs(view: View) -> tuple[Tensor, Tensor, Tensor]:
    """Return what the mean error is linear in: segments (B, J, 3, 3) and pelvis (B, 3, 3) in the camera's frame,
    and harmonics (B, J, 9).
    """
    R = view.segments()
    p = view.joints.transpose(1, 2)
    toward = -p / p.norm(dim=-1, keepdim=True) @ R[:, 0]
    return R, R[:, 0], harmonics(toward)


def projected(view: View, offset: Tensor) -> Tensor:
    """Return offsets (B, J, 3) of the joints as errors (B, J, 2) in the image plane, m."""
    slope = view.joints[:, :2] / view.joints[:, 2:].clamp_min(NEAREST_M)
    error: Tensor = offset[..., :2] - slope.transpose(1, 2) * offset[..., 2:]
    return error


def mean_error(body: Body, table: JointErrors, view: View, amplitude: Tensor) -> Tensor:
    """Return the expected errors (B, J, 2), m; those of the detector times an amplitude (B,)."""
    R, R_pelvis, h = designs(view)
    size = amplitude[:, None, None]
    of_view = size * torch.einsum("bjh,jhc->bjc", h, table.view) @ R_pelvis.transpose(1, 2)
    rig = LEG_M * table.follows[:, None] * (rig_places(body, view.offsets) - table.usual)
    return projected(view, (R @ (size * table.place - rig)[..., None])[..., 0] + of_view)


def hidden_joints(body: Body, view: View) -> Tensor:
    """Return which joints (B, J) the trunk hides, or of a leg the other leg."""
    p = view.joints.transpose(1, 2)
    hidden = _behind(p, p[:, 0], p[:, body.names.index("Neck")], 0.11, 0.12)
    for leg, (hip, knee, ankle) in zip(body.legs, reversed(body.legs), strict=True):
        for start, stop in ((hip, knee), (knee, ankle)):
            hidden[:, leg[1:]] |= _behind(p[:, leg[1:]], p[:, start], p[:, stop], 0.06, 0.08)
    return hidden


def _behind(points: Tensor, start: Tensor, stop: Tensor, radius: float, margin: float) -> Tensor:
    """Which points (B, n, 3) lie behind a capsule around the line between two points (B, 3)."""
    length = points.norm(dim=-1, keepdim=True)
    share = torch.linspace(0, 1, 6, device=points.device, dtype=points.dtype)
    centres = torch.lerp(start[:, None], stop[:, None], share[:, None])
    along = (points / length) @ centres.transpose(1, 2)  # (B, n, 6)
    away = (centres * centres).sum(dim=-1)[:, None] - along * along
    behind: Tensor = (away < radius**2) & (along < length - margin)
    return behind.any(dim=-1)


def smooth_errors(
    body: Body, table: JointErrors, view: View, amplitude: Tensor, frames: int, draw: Draw, rate_hz: float
) -> Tensor:
    """Draw errors (B, 2, W, J) in the image planes of the joints, m, at a rate in Hz: all but exchanges and
    jumps; `amplitude` (B,) is a factor on what is the detector's.
    """
    B, J = draw.batch, len(body.names)
    factor, rest = table.blended(body, view)
    paths = view.joints.new_zeros(B, 2 * J, frames)
    for part, memory in enumerate(MEMORY_S):
        basis = path_basis(frames, rate_hz, memory).to(paths)
        common = factor[:, part] @ draw.normal(B, factor.shape[-1], basis.shape[1])
        own = rest[:, part, :, None] * draw.normal(B, 2 * J, basis.shape[1])
        paths += (common + own) @ basis.T
    mood = torch.tensor([MOOD.get(side_of(name)[1], USUAL_MOOD) for name in body.names]).to(paths)
    limb = torch.zeros(J, dtype=torch.long, device=paths.device)
    for i, joints in enumerate(body.arms + body.legs, start=1):
        limb[joints] = i
    size = amplitude[:, None] * (mood * draw.normal(B, 5)[:, limb] - mood**2).exp()
    size = size * torch.where(hidden_joints(body, view), table.hidden, 1.0)
    errors = paths.reshape(B, J, 2, frames) * size[..., None, None]
    errors += mean_error(body, table, view, amplitude)[..., None]
    return errors.permute(0, 2, 3, 1)


@lru_cache(maxsize=8)
def path_basis(frames: int, rate_hz: float, memory: float, rank: int = 8) -> Tensor:
    """Return (W, rank) whose product with white noise is a path of unit variance with the covariance
    exp(-|t| / memory), approximately; the memory, s, is infinite for a constant.
    """
    if memory == float("inf"):
        return torch.ones(frames, 1)
    time = torch.arange(frames) / rate_hz
    values, vectors = torch.linalg.eigh(torch.exp(-(time[:, None] - time).abs() / memory))
    basis: Tensor = vectors[:, -rank:] * values[-rank:].clamp_min(0).sqrt()
    basis /= basis.norm(dim=1, keepdim=True)
    return basis


def jumps(body: Body, view: View, frames: int, draw: Draw, rate_hz: float) -> Tensor:
    """Draw errors (B, 2, W, J) of limbs that are taken for something else, m."""
    limbs = body.arms + body.legs
    error = view.joints.new_zeros(draw.batch, 2, frames, len(body.names))
    hidden = hidden_joints(body, view)
    usual = [JUMPS_PER_MINUTE["arms" if limb in body.arms else "legs"] for limb in limbs]
    rates = [rate * (1 + 2 * hidden[:, limb[1:]].all(dim=1)) for rate, limb in zip(usual, limbs, strict=True)]
    there = _brief(torch.stack(rates, dim=1), frames, draw, rate_hz)
    size = JUMP_M * (0.5 * draw.normal(draw.batch, 1, 4)).exp() * draw.normal(draw.batch, 2, 4)
    for i, limb in enumerate(limbs):
        at = size[:, :, None, i] * there[:, None, :, i]
        error[..., limb[1]], error[..., limb[2]] = 0.6 * at, at
    return error


def exchanged(body: Body, view: View, xy: Tensor, draw: Draw, rate_hz: float) -> Tensor:
    """Return detections (B, 2, W, J) in units of focal length, with sides exchanged at times."""
    groups = {
        "legs": [j for leg in body.legs for j in leg[1:]],
        "arms": [j for arm in body.arms for j in arm[1:]],
        "shoulders": [arm[0] for arm in body.arms],
        "hips": [leg[0] for leg in body.legs],
    }
    at = view.joints[:, :2] / view.joints[:, 2:].clamp_min(NEAREST_M)
    apart = (at - at[..., body.mirrored]).norm(dim=1) * view.joints[:, 2]
    sin, _ = view.azimuth()
    rates = []
    for name, joints in groups.items():
        beyond = (apart[:, joints].mean(dim=1) - 0.06).clamp_min(0)
        rates.append(EXCHANGES_PER_MINUTE[name] * sin**2 * (0.06 + (-beyond / 0.06).exp()))
    which = _brief(torch.stack(rates, dim=1), xy.shape[2], draw, rate_hz)
    mask = torch.zeros(xy.shape[0], *xy.shape[2:], dtype=torch.bool, device=xy.device)
    for i, joints in enumerate(groups.values()):
        mask[..., joints] = which[..., i : i + 1]
    return torch.where(mask[:, None], xy[..., body.mirrored], xy)


def _brief(per_minute: Tensor, frames: int, draw: Draw, rate_hz: float) -> Tensor:
    """Draw a mask (B, W, n) of short runs with rates (B, n)."""
    shape = (draw.batch, per_minute.shape[1])
    length = RUN_S * (RUN_SPREAD * draw.normal(*shape)).exp() + 0.5 / rate_hz
    span = frames / rate_hz + length
    start = -length + span * draw.uniform(*shape)
    there = draw.uniform(*shape) < per_minute / 60 * span
    time = (torch.arange(frames, device=draw.device) + 0.5)[None, :, None] / rate_hz
    return there[:, None] & (time >= start[:, None]) & (time < (start + length)[:, None])

"""`Retargeter`: a person's poses to a robot's configurations, frame by frame, with contacts and limits (pink).

Targets. The robot's world is the person's, scaled by s, the ratio of the heights of the hips over the soles, with the
floor at 0. In the posture with hanging arms both face x; a link turns from there as its segment does. The first link
is where the person's hips are, scaled. A foot is from its hip where the person's is, scaled by s; a hand is from its
shoulder where the person's is, scaled by the ratio of their distances in that posture; shoulders and hips are fixed in
trunk and pelvis.

Weights. A residual has the tolerance of the map and the error of the person's pose, which are independent: its weight
is ``1 / sqrt(tolerance^2 + sigma^2)``. What nobody observed is a prior's, with a large sigma: it is followed weakly.

Contacts. A point of the sole, heel or ball, that is low and slow has landed; the robot's, heel or toe, is held where
it is then, on the floor, until the person's has left. Its foot has no target in that time but not to roll.

Each frame is a few steps of a quadratic program (`pink.solve_ik`, DAQP), within the limits of angles and velocities.
"""

from __future__ import annotations

import math
import time as clock
from collections import deque
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, Self

import numpy as np

from rtof_kin.body.motion_source import MotionSource
from rtof_kin.body.observability import NOTHING, WHOLE, ObservationMasks
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.body.soles import FEET, floor_levels, sole_offsets, sole_points
from rtof_kin.body.urdf import pin
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.core.errors import FileFormatError, InvalidInputError
from rtof_kin.core.packages import optional
from rtof_kin.data.confidence import Confidence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.robots.robot_map import Link, RobotMap

UNOBSERVED_M, UNOBSERVED, UNSEEN_TURN = 0.3, 1.0, 0.5
"""[m], [rad], [rad] sigma of a position, an orientation that nobody observed, and one of which the direction is."""
LOW, HIGH = 0.04, 0.06  #: [m] over the floor: a sole's point lands below the first, and has left above the second
SLOW, FAST = 0.35, 0.7  #: [m/s] the same of its speed
WITHIN: Final = 0.05  #: [s] over which the speed is measured
_FLOOR_FRAMES: Final = 1800  # Frames of which the floor of a live session is the median
_LONGEST_STEP: Final = 0.1  # [s] between two frames, for the limits of velocities
_FIRST_STEPS: Final = 100  # To the first pose
_EXCESS: Final = 1e-6  # [rad], and relative to a velocity limit, that counts as a violation


@dataclass(frozen=True)
class RetargetSettings:
    """Choices of the inverse kinematics."""

    contacts: bool = True  #: Hold feet that stand
    limits: bool = True  #: Keep the limits of angles and velocities
    steps: int = 3  #: Quadratic programs for a frame
    contact_mm: float = 1.0  #: Tolerance of a point that is held
    roll_deg: float = 2.0  #: Tolerance of the roll and pitch of a standing foot
    posture_deg: float = 60.0  #: Tolerance of the angles, about the posture with hanging arms
    damping: float = 0.5  #: [1/rad] weight of a step


@dataclass
class Tracking:
    """What was reached, as sums over frames."""

    frames: int = 0
    slips: list[float] = field(default_factory=list)  #: [m] largest way of each point along the floor in each stance
    outside: int = 0  #: Frames with an angle beyond its limits
    too_fast: int = 0  #: Frames with a joint beyond its velocity limit
    lowest: float = math.inf  #: [m] lowest point of the soles over the floor
    distances: list[float] = field(default_factory=list)  #: [m] of hands and soles from their targets, mean of a frame
    turns: list[float] = field(default_factory=list)  #: [rad] of links from their targets, mean of a frame
    seconds: list[float] = field(default_factory=list)  #: Time of each frame
    failures: list[str] = field(default_factory=list)  #: Sentences, with the time

    @property
    def plain(self) -> dict[str, float]:
        """Figures: mm, degrees, shares of the frames, ms."""
        slips, ms = 1000 * np.array(self.slips or [np.nan]), 1000 * np.array(self.seconds or [np.nan])
        return {
            "frames": self.frames,
            "stances": len(self.slips),
            "slip_mm": float(np.mean(slips)),
            "slip_largest_mm": float(np.max(slips)),
            "below_floor_mm": max(0.0, -1000 * self.lowest),
            "outside_limits": self.outside / max(self.frames, 1),
            "too_fast": self.too_fast / max(self.frames, 1),
            "ends_mm": 1000 * float(np.mean(self.distances or [np.nan])),
            "turns_deg": float(np.degrees(np.mean(self.turns or [np.nan]))),
            "p50_ms": float(np.percentile(ms, 50)),
            "p99_ms": float(np.percentile(ms, 99)),
        }

    def __str__(self) -> str:
        found = self.plain
        slip = (
            f"{found['slip_mm']:.1f} mm in a stance (largest {found['slip_largest_mm']:.1f}, {len(self.slips)} stances)"
        )
        broken = self.outside + self.too_fast
        limits = f"limits violated in {broken} of {self.frames} frames" if broken else "no limit violated"
        return (
            f"feet slip {slip if self.slips else 'nowhere: no foot stands'}; {limits}; hands and feet are "
            f"{found['ends_mm']:.0f} mm and links {found['turns_deg']:.1f} deg from their targets"
        )


class _Contacts:
    """Which points of the soles have landed, from the past alone."""

    def __init__(self, floor: float | None):
        self._given, self._past = floor, deque[tuple[float, Array]]()
        self._lowest = deque[float](maxlen=_FLOOR_FRAMES)
        self.standing: Mask = np.zeros((2, 2), dtype=np.bool_)
        self.floor = floor or 0.0

    def update(self, time: float, points: Array) -> Mask:
        """Return (2, 2) whether each heel and ball stands; points: (2, 2, 3) m."""
        while len(self._past) > 1 and time - self._past[1][0] >= WITHIN:
            self._past.popleft()
        speed = np.zeros((2, 2))
        if self._past and time > self._past[0][0]:
            speed = np.linalg.norm(points - self._past[0][1], axis=-1) / (time - self._past[0][0])
        self._past.append((time, points))
        if self._given is None:
            lowest = np.unravel_index(np.argmin(points[..., 2]), (2, 2))
            if speed[lowest] < SLOW or not self._lowest:
                self._lowest.append(float(points[lowest][2]))
            self.floor = float(np.median(self._lowest))
        height = points[..., 2] - self.floor
        lands, stays = (height < LOW) & (speed < SLOW), (height < HIGH) & (speed < FAST)
        self.standing = np.where(self.standing, stays, lands)
        return self.standing


class Retargeter:
    """Inverse kinematics of one robot for one person; `step` for each frame, in order.

    Attributes:
        model: of Pinocchio, with a free base. joints: J names. q: configuration, base position, quaternion x y z w,
            angles. scale: of the person's world. track: what was reached. map: the links.
    """

    def __init__(
        self,
        skeleton: SkeletonModel,
        urdf: str | Path,
        map: str | None = None,
        floor: float | None = None,
        settings: RetargetSettings | None = None,
    ):
        """Read the robot.

        Args:
            urdf: the robot's file; meshes are not read. map: see `RobotMap.choose`. floor: height in the person's
                world, m; None: it is found on the way.

        Raises:
            MissingPackageError: the extra robots is not installed. FileFormatError: not a URDF of joints with one angle
                each. UnknownNameError: a link of the map is not in it, or a segment is not one of the skeleton.
        """
        self._pink = optional("pink", "robots", "a robot's inverse kinematics")
        self._solvers = optional("qpsolvers", "robots", "a robot's inverse kinematics")
        optional("daqp", "robots", "a robot's inverse kinematics")
        self.settings, self.skeleton, self.track = settings or RetargetSettings(), skeleton, Tracking()
        path = Path(urdf)
        try:
            self.model = pin.buildModelFromUrdf(str(path), pin.JointModelFreeFlyer())
        except (ValueError, RuntimeError) as error:
            raise FileFormatError(path, f"not a readable URDF: {error}") from error
        self.joints = tuple(self.model.names[2:])
        if self.model.nq != 7 + len(self.joints):
            raise FileFormatError(path, "needs joints of one angle with limits; declare continuous joints as revolute")
        bodies = {one.name for one in self.model.frames if one.type == pin.FrameType.BODY}
        self.map = RobotMap.choose(map, bodies)
        self._contacts = _Contacts(floor)
        self._segments = [skeleton.index(one.segment)[0] for one in self.map.link]
        self._prepare()

    def _prepare(self) -> None:
        """Compare the robot and the person in the posture with hanging arms, and make frames and tasks."""
        model, links, pink = self.model, self.map.link, self._pink
        rest = pin.neutral(model)
        for name, angle in self.map.posture_deg.items():
            if name not in self.joints:
                raise InvalidInputError(f"posture_deg: the robot has no joint {name}; it has {', '.join(self.joints)}")
            rest[7 + self.joints.index(name)] = np.radians(angle)
        rest[7:] = np.clip(rest[7:], model.lowerPositionLimit[7:], model.upperPositionLimit[7:])
        data = model.createData()
        pin.framesForwardKinematics(model, data, rest)
        ids = [model.getFrameId(one.name, pin.FrameType.BODY) for one in links]
        at = [data.oMf[i].translation.copy() for i in ids]
        to_link = [data.oMf[i].rotation.T.copy() for i in ids]
        p, R = (rows[0] for rows in self.skeleton.forward_kinematics(self.skeleton.n_pose()[None]))
        soles = sole_points(self.skeleton, p[None], R[None])[0]
        self._R_rest = R
        self._parents = [next((i for i, other in enumerate(links) if other.name == one.parent), 0) for one in links]
        self._feet = [next(i for i, one in enumerate(links) if one.segment == foot and one.heel_mm) for foot in FEET]
        self._ends = [i for i, one in enumerate(links) if i and one.position_mm]
        self._points = [f"{links[i].name} {end}" for i in self._feet for end in ("heel", "toe")]
        for i, one in enumerate(links):
            offset = np.zeros(3)
            if i in self._feet:
                ends = np.array([one.heel_mm, one.toe_mm]) / 1000
                offset = ends.mean(axis=0)
                at[i] = at[i] + to_link[i].T @ offset
                for name, end in zip(self._points[2 * self._feet.index(i) :], ends, strict=False):
                    self._add_frame(name, ids[i], to_link[i], end)
            self._add_frame(f"{one.name} target", ids[i], to_link[i], offset)
        self._half = [float(np.linalg.norm(np.subtract(links[i].heel_mm, links[i].toe_mm))) / 2000 for i in self._feet]
        hips = [self._parents[i] for i in self._feet]
        height = np.mean([at[hip][2] - at[i][2] for hip, i in zip(hips, self._feet, strict=True)])
        self._human_hips = [self._segments[hip] for hip in hips]
        self.scale = float(height / (p[self._human_hips, 2].mean() - soles[..., 2].mean()))
        self._offsets = [point - at[parent] for point, parent in zip(at, self._parents, strict=True)]
        self._offsets[0] = at[0] - np.mean([at[hip] for hip in hips], axis=0)
        self._ratios = [1.0] * len(links)
        for i in self._ends:
            own = p[self._segments[i]] - p[self._segments[self._parents[i]]]
            self._ratios[i] = (
                self.scale if i in self._feet else float(np.linalg.norm(self._offsets[i]) / np.linalg.norm(own))
            )
        self.q: Array = rest
        self._configuration: Any = pink.Configuration(model, model.createData(), rest)
        self._tasks = [pink.FrameTask(f"{one.name} target", 0.0, 0.0, lm_damping=1e-3) for one in links]
        self._held = [pink.FrameTask(name, 1000 / self.settings.contact_mm, 0.0) for name in self._points]
        posture = pink.PostureTask(cost=1 / np.radians(self.settings.posture_deg))
        posture.set_target(rest)
        self._posture = posture
        angles, rates = pink.limits.ConfigurationLimit(model, 1.0), pink.limits.VelocityLimit(model)
        self._limits = [angles, rates] if self.settings.limits else []
        self._time, self._landed = math.nan, np.full((4, 3), np.nan)
        self._ways: Array = np.full(4, np.nan)

    def _add_frame(self, name: str, link: int, R_link_rest: Array, offset: Array) -> None:
        """Add a frame of a link that is parallel to world in the posture; offset: (3,) in the link, m."""
        body = self.model.frames[link]
        placement = body.placement * pin.SE3(R_link_rest, offset)
        self.model.addFrame(pin.Frame(name, body.parentJoint, link, placement, pin.FrameType.OP_FRAME))

    def step(self, time: float, p: Array, R: Array, sigma_p: Array, sigma_R: Array) -> Array:
        """Return the configuration (nq,) for the next frame; it stays where the pose is unknown or no step is possible,
        and `track` says why.

        Args:
            time: s. p, R: (J, 3), m, and (J, 3, 3) R_world_bone. sigma_p, sigma_R: (J,) m and rad.
        """
        began, first = clock.perf_counter(), math.isnan(self._time)
        if not (np.isfinite(p).all() and np.isfinite(R).all()):
            self._fail(time, "the person's pose is unknown, the robot stays")
            return self.q
        passed = min(time - self._time, _LONGEST_STEP) if not first else 1.0
        points = sole_points(self.skeleton, p[None], R[None])[0]
        standing = self._contacts.update(time, points).ravel()
        tasks = self._aim(p, R, points, standing & (not first), sigma_p, sigma_R)
        if first:
            start = self._configuration.q.copy()
            start[:7] = pin.SE3ToXYZQUAT(self._tasks[0].transform_target_to_world)
            self._configuration.update(start)
        before = self._configuration.q.copy()
        if not first:
            self._land(standing)
        if not first and self.settings.contacts:
            tasks += self._on_floor(standing)
        steps, damping = _FIRST_STEPS if first else self.settings.steps, self.settings.damping**2
        duration = 1e3 if first else passed / steps
        for _ in range(steps):
            problem = self._pink.build_ik(self._configuration, tasks, duration, damping, self._limits)
            found = self._solvers.solve_problem(problem, "daqp")
            if not found.found or found.x is None:
                self._configuration.update(before)
                self._fail(time, "no step keeps the limits, the robot stays")
                break
            self._configuration.integrate_inplace(found.x / duration, duration)
        self.q, self._time = self._configuration.q.copy(), time
        self.track.seconds.append(clock.perf_counter() - began)
        if first:
            self._land(standing)
        self._measure(before, None if first else passed, standing)
        return self.q

    def _fail(self, time: float, why: str) -> None:
        self.track.failures.append(f"{time:.2f} s: {why}")

    def _aim(self, p: Array, R: Array, points: Array, standing: Mask, sigma_p: Array, sigma_R: Array) -> list[Any]:
        """Set targets and weights; return the tasks that have any."""
        links, up = self.map.link, np.array([0.0, 0.0, self._contacts.floor])
        turns = [R[segment] @ self._R_rest[segment].T for segment in self._segments]
        places = [self.scale * (p[self._human_hips].mean(axis=0) - up) + turns[0] @ self._offsets[0]]
        for i, parent in enumerate(self._parents[1:], 1):
            if i in self._ends:
                own = points[self._feet.index(i)].mean(axis=0) if i in self._feet else p[self._segments[i]]
                places.append(places[parent] + self._ratios[i] * (own - p[self._segments[parent]]))
            else:
                places.append(places[parent] + turns[parent] @ self._offsets[i])
        tasks = [self._posture]
        for i, (task, one, segment) in enumerate(zip(self._tasks, links, self._segments, strict=True)):
            position = (
                1 / math.hypot(one.position_mm / 1000, self._ratios[i] * sigma_p[segment]) if one.position_mm else 0.0
            )
            turn = 1 / np.hypot(np.radians(one.orientation_deg or 1e9) * np.ones(3), sigma_R[segment])
            if i in self._feet:
                stands = standing.reshape(2, 2)[self._feet.index(i)]
                if self.settings.contacts and stands.any():
                    turns[i] = _level(turns[i], *stands)
                    position, turn[:2] = 0.0, np.degrees(1 / self.settings.roll_deg)
                places[i][2] = max(places[i][2], self._half[self._feet.index(i)] * abs(turns[i][2, 0]))
            task.set_target(pin.SE3(turns[i], places[i]))
            task.set_position_cost(float(position))
            task.set_orientation_cost(turn * bool(one.orientation_deg))
            if one.position_mm or one.orientation_deg:
                tasks.append(task)
        return tasks

    def _point(self, name: str) -> Array:
        return np.array(self._configuration.get_transform_frame_to_world(name).translation)

    def _land(self, standing: Mask) -> None:
        """Note where points are that have just landed, and let go of those that have left."""
        for i, (name, task) in enumerate(zip(self._points, self._held, strict=True)):
            known = not np.isnan(self._landed[i, 0])
            if standing[i] and not known:
                self._landed[i], self._ways[i] = self._point(name) * [1, 1, 0], 0.0
                task.set_target(pin.SE3(np.eye(3), self._landed[i]))
            elif known and not standing[i]:
                self.track.slips.append(float(self._ways[i]))
                self._landed[i] = np.nan

    def _on_floor(self, standing: Mask) -> list[Any]:
        """Return the tasks of points that stand, and of those that are below the floor, which are lifted."""
        tasks = []
        for name, task, stands in zip(self._points, self._held, standing, strict=True):
            place, cost = self._point(name), 1000 / self.settings.contact_mm
            task.set_position_cost((cost, cost, cost) if stands else (0.0, 0.0, cost / 5))
            if not stands:
                task.set_target(pin.SE3(np.eye(3), place * [1, 1, 0]))
            if stands or place[2] < 0:
                tasks.append(task)
        return tasks

    def _measure(self, before: Array, passed: float | None, standing: Mask) -> None:
        """Add a frame to what was reached."""
        track, model, configuration = self.track, self.model, self._configuration
        places = np.array([self._point(name) for name in self._points])
        track.lowest = min(track.lowest, float(places[:, 2].min()))
        ways = np.linalg.norm(places[:, :2] - self._landed[:, :2], axis=1)
        self._ways = np.where(standing, np.maximum(self._ways, ways), self._ways)
        track.frames += 1
        low, high, angles = model.lowerPositionLimit[7:], model.upperPositionLimit[7:], self.q[7:]
        track.outside += bool(((angles < low - _EXCESS) | (angles > high + _EXCESS)).any())
        if passed is not None:
            track.too_fast += bool(
                (np.abs(angles - before[7:]) > passed * model.velocityLimit[6:] * (1 + _EXCESS)).any()
            )
        errors = [task.compute_error(configuration) for task in self._tasks]
        track.distances.append(float(np.mean([np.linalg.norm(errors[i][:3]) for i in self._ends])))
        turned = [i for i, one in enumerate(self.map.link) if one.orientation_deg]
        track.turns.append(float(np.mean([np.linalg.norm(errors[i][3:]) for i in turned])))

    def finish(self) -> Tracking:
        """Count the stances that have not ended and return what was reached."""
        self._land(np.zeros(4, dtype=np.bool_))
        return self.track


def _level(R: Array, heel: bool, toe: bool) -> Array:
    """Return a standing foot's orientation without roll, pitched only about the end that stands."""
    up = 0.0 if heel and toe else max(R[2, 0], 0.0) if heel else min(R[2, 0], 0.0)
    x = np.array([*R[:2, 0], up])
    x = x / np.linalg.norm(x)
    y = np.cross([0.0, 0.0, 1.0], x)
    y = y / np.linalg.norm(y)
    return np.stack([x, y, np.cross(x, y)], axis=1)


def sigmas(poses: PoseSequence, skeleton: SkeletonModel, confidence: Confidence | None) -> tuple[Array, Array]:
    """Return standard deviations (T, J) of positions relative to the root, m, and orientations, rad."""
    masks = ObservationMasks.of_poses(poses, skeleton)
    if not masks.has_sources:
        return np.zeros(poses.valid.shape), np.zeros(poses.valid.shape)
    levels = masks.levels
    position = np.where(masks.position_observed, 0.0, UNOBSERVED_M)
    turn = np.select([levels == WHOLE, levels == NOTHING], [0.0, UNOBSERVED], UNSEEN_TURN)
    if confidence is not None:
        position = np.fmax(position, confidence.relative_sigma)
        stated = confidence.orientation_sigma
        turn = np.where(np.isfinite(stated), np.where(levels == NOTHING, np.fmax(turn, stated), stated), turn)
    return position, turn


@dataclass(frozen=True)
class RobotMotion:
    """A robot's motion."""

    joints: tuple[str, ...]  #: J names
    times: Array  #: (T,) s
    q: Array  #: (T, 7 + J) base position, m, and quaternion x y z w in world, angles, rad; the floor is at 0
    root: str  #: Name of the base link
    track: Tracking  #: What was reached

    @classmethod
    def of(
        cls, motion: MotionSource, urdf: str | Path, map: str | None = None, settings: RetargetSettings | None = None
    ) -> Self:
        """Retarget a motion; arguments and errors as for `Retargeter`."""
        robot = Retargeter(motion.skeleton, urdf, map, floor_levels(motion)[0], settings)
        q, row = np.empty((len(motion), robot.model.nq)), 0
        for block in motion.blocks(confidence=True):
            poses = block.motion.poses
            sigma_p, sigma_R = sigmas(poses, motion.skeleton, block.motion.confidence)
            for t in range(len(poses)):
                frame = poses.p_world_joint[t], poses.R_world_bone[t], sigma_p[t], sigma_R[t]
                q[row] = robot.step(float(poses.times[t]), *frame)
                row += 1
        return cls(robot.joints, motion.times, q, robot.map.link[0].name, robot.finish())

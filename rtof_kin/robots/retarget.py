"""`Retargeter`: a person's poses to a robot's configurations, frame by frame, with contacts and limits (pink).

Targets. The robot's world is the person's with the floor at 0, scaled by the ratio of the heights of the hips over the
soles. In the posture with hanging arms both face x; from there a link turns as its segment does. The first link is
where the person's hips are, scaled. A foot is from its hip where the person's is, scaled alike; a hand from its
shoulder, scaled by the ratio of their distances in that posture. Shoulders and hips are fixed in trunk and pelvis.

Weights. A residual has the tolerance of the map and the error of the person's pose, which are independent: its weight
is ``1 / sqrt(tolerance^2 + sigma^2)``. What nobody observed is a prior's, with a large sigma: it is followed weakly.

Contacts. A heel or ball that is low and slow stands: the robot's heel or toe is held where it was then, on the floor,
until the person's has left. Meanwhile its foot has no target but not to roll. No point may sink into the floor.

A frame is a few quadratic programs (`pink.build_ik`, solved by DAQP) within the limits of angles and velocities.
"""

from __future__ import annotations

import json
import math
import time as clock
import tomllib
from array import array
from collections import deque
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, PositiveFloat, ValidationError

from rtof_kin.body.motion_source import BLOCK, MotionSource
from rtof_kin.body.observability import NOTHING, WHOLE, ObservationMasks
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.body.soles import FEET, floor_levels, sole_points
from rtof_kin.body.urdf import pin
from rtof_kin.core.array_types import Array, Mask, blocks_of
from rtof_kin.core.errors import FileFormatError, InvalidInputError, UnknownNameError, reading
from rtof_kin.core.files.text import read_text, write_text
from rtof_kin.core.packages import optional
from rtof_kin.core.resources import model_path
from rtof_kin.data.confidence import Confidence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.formats.joint_trajectory import WORLD_FRAME, base_points, joint_points, new_message
from rtof_kin.formats.mjcf import write_qpos
from rtof_kin.formats.ros_log import RosLog

UNOBSERVED_M, UNOBSERVED, UNSEEN_TURN = 0.3, 1.0, 0.5
"""[m], [rad], [rad] sigma of a position and an orientation that nobody observed, and of one with a known direction."""
LOW, HIGH, SLOW, FAST, WITHIN = 0.04, 0.06, 0.15, 0.3, 0.05
"""[m] over the floor, [m/s]: a point stands from below `LOW` and `SLOW` to above `HIGH` or `FAST`; [s] of a speed."""
STEPS, FIRST_STEPS = 3, 100  #: Quadratic programs for a frame, and for the first, which has no limit of velocities
CONTACT_M, LEVEL = 0.001, np.radians(2.0)  #: [m] tolerance of a point that stands; [rad] of its foot's roll and pitch
POSTURE, DAMPING = np.radians(60.0), 0.5  #: [rad] tolerance of angles about the posture; [1/rad] weight of a step
FIGURES: Final = "retarget.json"  #: File of the figures
_FLOOR_FRAMES, _LONGEST_STEP = 1800, 0.1  # Of whose lowest points a live floor is the median; [s] that limits allow for
_EXCESS: Final = 1e-6  # [rad], and relative to a velocity limit, that counts as a violation


class Link(BaseModel):
    """A link and the segment that it follows; tolerances are standard deviations, whose inverses are the weights."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    name: str
    segment: str  #: Joint of the person's skeleton at which the segment begins
    parent: str = ""  #: Link that carries this one; '': the first of all
    position_mm: PositiveFloat | None = None  #: Tolerance of its position; None: it has no target
    orientation_deg: PositiveFloat | tuple[PositiveFloat, PositiveFloat, PositiveFloat] | None = None
    """Tolerance of its orientation, or of turns about x forward, y left and z up in the posture with hanging arms."""
    sole_mm: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None  #: Heel, toe, in its frame


class RobotMap(BaseModel):
    """Links, parents before children, and the angles of the posture in which the arms hang; other angles are 0."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    link: tuple[Link, ...]
    posture_deg: dict[str, float] = {}
    name: str = ""

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read a file, in which ``{side}`` and ``{Side}`` stand for left and right; `FileFormatError`: it is damaged, a
        parent does not come before its child, or there is not a sole of each foot.
        """
        try:
            text = read_text(path, "a table of a robot's links, TOML")
            head, *rows = text.split("[[link]]")
            pairs = [[row.replace("{side}", s.lower()).replace("{Side}", s) for s in ("Left", "Right")] for row in rows]
            both = [row for pair in pairs for row in dict.fromkeys(pair)]
            found = cls.model_validate(tomllib.loads("[[link]]".join([head, *both])) | {"name": path.stem})
        except (tomllib.TOMLDecodeError, LookupError, ValidationError) as error:
            raise FileFormatError(path, " ".join(str(error).split())) from error
        names = [one.name for one in found.link]
        for i, one in enumerate(found.link):
            if one.name in names[:i] or one.parent not in ("", *names[:i]):
                raise FileFormatError(path, f"link {one.name}: stands twice, or before its parent {one.parent}")
        if sorted(one.segment for one in found.link if one.sole_mm and one.position_mm) != [*FEET]:
            raise FileFormatError(path, "needs sole_mm and position_mm of one link for LeftFoot and one for RightFoot")
        return found

    @classmethod
    def choose(cls, word: str | None, links: set[str]) -> Self:
        """Return the map that a word names, a file or a shipped one; None: the shipped one of these links.
        `UnknownNameError`: a link is not known; `InvalidInputError`: no shipped map is of these links.
        """
        shipped = {path.stem: path for path in sorted(model_path("robots").glob("*.toml"))}
        for path in shipped.values() if word is None else [shipped.get(word, Path(word))]:
            found = cls.read(path)
            missing = [one.name for one in found.link if one.name not in links]
            if word is not None and missing:
                raise UnknownNameError(f"link of {path.name} in the robot", missing, sorted(links))
            if not missing:
                return found
        raise InvalidInputError(f"no map ships for this robot's links, only {', '.join(shipped)}; give --map FILE.toml")


@dataclass
class Tracking:
    """What was reached."""

    numbers: array[float] = field(default_factory=lambda: array("d"))
    """Six by frame: angle, velocity beyond its limit; lowest point of the soles, m; mean distance of hands and soles
    from their targets, m; mean turn of links from theirs, rad; time, s."""
    slips: list[float] = field(default_factory=list)  #: [m] farthest along the floor of each point, by stance
    failures: list[str] = field(default_factory=list)  #: Sentences, with the time
    farthest: tuple[float, str, float] = (0.0, "", 0.0)  #: Hand or foot farthest from its target: m, link, s

    def figures(self) -> dict[str, float]:
        """Return mm, degrees, shares of the frames and ms; NaN where there is none."""
        slips, rows = 1000 * np.array(self.slips or [np.nan]), np.array(self.numbers or [np.nan] * 6)
        outside, fast, lowest, ends, turns, seconds = rows.reshape(-1, 6).T
        found = {"frames": len(self.numbers) // 6, "broken": ((outside > 0) | (fast > 0)).sum()}
        found |= {"stances": len(self.slips), "slip_mm": slips.mean(), "most_mm": slips.max()}
        found |= {"outside": outside.mean(), "fast": fast.mean(), "below_mm": -1000 * min(lowest.min(), 0.0)}
        found |= {"ends_mm": 1000 * ends.mean(), "turns_deg": np.degrees(turns.mean())}
        return found | {f"p{p}_ms": 1000 * np.percentile(seconds, p) for p in (50, 99)}

    def __str__(self) -> str:
        found = self.figures()
        return (
            f"feet slip {found['slip_mm']:.1f} mm (most {found['most_mm']:.1f}) in {len(self.slips)} stances; limits "
            f"broken in {found['broken']} of {found['frames']} frames; hands and feet {found['ends_mm']:.0f} mm, links "
            f"{found['turns_deg']:.1f} deg from their targets, farthest {self.farthest[1]}, "
            f"{1000 * self.farthest[0]:.0f} mm at {self.farthest[2]:.1f} s; {found['p99_ms']:.0f} ms a frame (99 %)"
        )


class Contacts:
    """Which points of the soles stand, from the past alone. Attribute floor: its height so far, m."""

    def __init__(self, floor: float | None):
        self._given, self._past, self._lowest = floor, deque[tuple[float, Array]](), deque[float](maxlen=_FLOOR_FRAMES)
        self.floor, self._standing = floor or 0.0, np.zeros((2, 2), dtype=np.bool_)

    def update(self, time: float, points: Array) -> Mask:
        """Return (2, 2) whether left and right heel and ball stand; points: (2, 2, 3) m."""
        while len(self._past) > 1 and time - self._past[1][0] >= WITHIN:
            self._past.popleft()
        self._past.append((time, points))
        before, past = self._past[0]
        speed = np.linalg.norm(points - past, axis=-1) / max(time - before, 1e-3)
        if self._given is None:
            lowest = np.argmin(points[..., 2])
            if speed.flat[lowest] < SLOW or not self._lowest:
                self._lowest.append(float(points[..., 2].flat[lowest]))
            self.floor = float(np.median(self._lowest))
        height = points[..., 2] - self.floor
        lands, stays = (height < LOW) & (speed < SLOW), (height < HIGH) & (speed < FAST)
        self._standing = np.where(self._standing, stays, lands)
        return self._standing


@dataclass(frozen=True)
class _Floor:
    """Limit, as pink has them, of frames that may not sink into the floor."""

    points: list[str]

    def compute_qp_inequalities(self, configuration: Any, _: float) -> tuple[Array, Array]:
        """Return G and h of ``G dq <= h``."""
        frames = [configuration.get_transform_frame_to_world(name) for name in self.points]
        jacobians = [configuration.get_frame_jacobian(name)[:3] for name in self.points]
        slopes = np.array([T.rotation[2] @ J for T, J in zip(frames, jacobians, strict=True)])
        return -slopes, np.array([T.translation[2] for T in frames])


class Retargeter:
    """Inverse kinematics of one robot for one person; `step` for each frame, in order.

    Attributes:
        model: of Pinocchio, with a free base. joints: J names. root: the base link. scale: of the person's world.
        q: configuration (7 + J,), base position, quaternion x y z w, angles. map: of links. track: what was reached.
    """

    def __init__(
        self, skeleton: SkeletonModel, urdf: Path, map: str | None = None, floor: float | None = None, without: str = ""
    ):
        """Read the robot; its meshes are not needed. `MissingPackageError`: the extra robots is not installed;
        `FileFormatError`: not a URDF of joints with one angle each; `UnknownNameError`: a link, joint or segment of the
        map does not exist.

        Args:
            map: see `RobotMap.choose`. floor: height in the person's world, m; None: it is found on the way. without:
                'contacts', 'contacts, limits' for comparisons with the usual inverse kinematics.
        """
        need, self.urdf = ("robots", "a robot's inverse kinematics"), urdf
        self._pink, self._solvers, _ = (optional(name, *need) for name in ("pink", "qpsolvers", "daqp"))
        with reading(urdf, "not a readable URDF: {}", ValueError, RuntimeError):
            self.model = pin.buildModelFromUrdf(str(urdf), pin.JointModelFreeFlyer())
        self.joints, self.skeleton, self.track = tuple(self.model.names[2:]), skeleton, Tracking()
        if self.model.nq != 7 + len(self.joints):
            raise FileFormatError(urdf, "needs joints of one angle with limits; declare continuous ones as revolute")
        self.map = RobotMap.choose(map, {one.name for one in self.model.frames if one.type == pin.FrameType.BODY})
        self.root = str(self.map.link[0].name)
        self._contacts, self._holds = Contacts(floor), "contacts" not in without
        self._time, self._landed, self._ways = math.nan, np.full((4, 3), np.nan), np.full(4, np.nan)
        self._prepare()
        kinds = self._pink.limits
        joints = [kinds.ConfigurationLimit(self.model, 1.0), kinds.VelocityLimit(self.model)] * (
            "limits" not in without
        )
        self._limits = joints + [_Floor(self._points)] * self._holds

    def _prepare(self) -> None:
        """Compare robot and person with hanging arms; make frames, which are then parallel to world, and tasks."""
        model, links, pink = self.model, self.map.link, self._pink
        if unknown := sorted({*self.map.posture_deg} - {*self.joints}):
            raise UnknownNameError("joint of posture_deg in the robot", unknown, list(self.joints))
        rest: Array = pin.neutral(model)
        data = model.createData()
        angles = np.radians([self.map.posture_deg.get(name, 0.0) for name in self.joints])
        rest[7:] = np.clip(angles, model.lowerPositionLimit[7:], model.upperPositionLimit[7:])
        pin.framesForwardKinematics(model, data, rest)
        p, R = (rows[0] for rows in self.skeleton.forward_kinematics(self.skeleton.n_pose()[None]))
        names = [one.name for one in links]
        self._R_rest, self._segments = R, self.skeleton.index(*(one.segment for one in links))
        self._parents = [names.index(one.parent or names[0]) for one in links]
        self._feet = [[one.segment * bool(one.sole_mm) for one in links].index(foot) for foot in FEET]
        self._ends = [i for i, one in enumerate(links) if i and one.position_mm]
        at, self._half_soles = np.empty((len(links), 3)), []
        for i, one in enumerate(links):
            number = model.getFrameId(one.name, pin.FrameType.BODY)
            body, ends = model.frames[number], np.array(one.sole_mm or np.zeros((2, 3))) / 1000
            for name, offset in zip(("", " heel", " toe"), (ends.mean(axis=0), *ends), strict=True):
                placement = body.placement * pin.SE3(data.oMf[number].rotation.T, offset)
                model.addFrame(pin.Frame(f"{one.name}: aim{name}", body.parentJoint, number, placement, pin.OP_FRAME))
            at[i] = data.oMf[number].act(ends.mean(axis=0))
            self._half_soles.append(float(np.linalg.norm(ends[1] - ends[0])) / 2)
        hips = [self._parents[i] for i in self._feet]
        self._hips, heights = [self._segments[hip] for hip in hips], at[hips, 2] - at[self._feet, 2]
        ground = sole_points(self.skeleton, p[None], R[None])[..., 2].mean()
        self.scale = float(heights.mean() / (p[self._hips, 2].mean() - ground))
        self._offsets = at - at[self._parents]
        self._offsets[0] = at[0] - at[hips].mean(axis=0)
        arms = np.linalg.norm(p[self._segments] - p[np.array(self._segments)[self._parents]], axis=1)
        self._ratios = np.linalg.norm(self._offsets, axis=1) / np.maximum(arms, 1e-9)
        self._ratios[[0, *self._feet]] = self.scale
        self._tasks = [pink.FrameTask(f"{name}: aim", 0.0, 0.0, lm_damping=1e-3) for name in names]
        self._points = [f"{names[i]}: aim {end}" for i in self._feet for end in ("heel", "toe")]
        self._held = [pink.FrameTask(name, 1 / CONTACT_M, 0.0) for name in self._points]
        self._posture = pink.PostureTask(cost=1 / POSTURE)
        self._posture.set_target(rest)
        self.q, self._configuration = rest, pink.Configuration(model, model.createData(), rest)

    def follow(self, poses: PoseSequence, confidence: Confidence | None) -> Array:
        """Return the configurations (T, 7 + J) for the next frames."""
        spread = sigmas(poses, self.skeleton, confidence)
        frames = zip(poses.times.tolist(), poses.p_world_joint, poses.R_world_bone, *spread, strict=True)
        return np.array([self.step(*frame) for frame in frames])

    def step(self, time: float, p: Array, R: Array, sigma_p: Array, sigma_R: Array) -> Array:
        """Return the configuration for the next frame. Where the pose is unknown or no step is possible it stays, and
        `track` has the time and the reason.

        Args:
            time: s. p, R: (J, 3), m, and (J, 3, 3) R_world_bone. sigma_p, sigma_R: (J,) m and rad, see `sigmas`.
        """
        began, first = clock.perf_counter(), math.isnan(self._time)
        if not (np.isfinite(p).all() and np.isfinite(R).all()):
            self.track.failures.append(f"{time:.2f} s: the person's pose is unknown, the robot stays")
            return self.q
        passed = 1e3 if first else min(max(time - self._time, 1e-3), _LONGEST_STEP)
        points = sole_points(self.skeleton, p[None], R[None])[0]
        standing = self._contacts.update(time, points).ravel()
        held = standing & (self._holds and not first)
        tasks = self._aim(p, R, points, held.reshape(2, 2), sigma_p, sigma_R)
        if first:
            base = pin.SE3ToXYZQUAT(self._tasks[0].transform_target_to_world)
            self._configuration.update(np.concatenate([base, self.q[7:]]))
        else:
            self._land(standing)
            for i in np.flatnonzero(held):
                self._held[i].set_target(pin.SE3(np.eye(3), self._landed[i]))
                tasks.append(self._held[i])
        before, steps = self._configuration.q.copy(), FIRST_STEPS if first else STEPS
        for _ in range(steps):
            problem = self._pink.build_ik(self._configuration, tasks, passed / steps, DAMPING**2, self._limits)
            found = self._solvers.solve_problem(problem, "daqp")
            if not found.found or found.x is None:
                self._configuration.update(before)
                self.track.failures.append(f"{time:.2f} s: no step keeps the limits, the robot stays")
                break
            self._configuration.integrate_inplace(found.x / passed * steps, passed / steps)
        self.q, self._time = self._configuration.q.copy(), time
        self._land(standing)
        self._measure(np.abs(self.q[7:] - before[7:]) / passed * (not first), standing, clock.perf_counter() - began)
        return self.q

    def _aim(self, p: Array, R: Array, points: Array, held: Mask, sigma_p: Array, sigma_R: Array) -> list[Any]:
        """Set targets and weights; return the tasks that have any. held: (2, 2) points that stand."""
        up = np.array([0.0, 0.0, self._contacts.floor])
        turns = [R[segment] @ self._R_rest[segment].T for segment in self._segments]
        places = [self.scale * (p[self._hips].mean(axis=0) - up) + turns[0] @ self._offsets[0]]
        tasks = [self._posture]
        for i, (one, segment, task) in enumerate(zip(self.map.link, self._segments, self._tasks, strict=True)):
            parent, degrees = self._parents[i], one.orientation_deg
            if i in self._ends:
                own = points[self._feet.index(i)].mean(axis=0) if i in self._feet else p[segment]
                places.append(places[parent] + self._ratios[i] * (own - p[self._segments[parent]]))
            elif i:
                places.append(places[parent] + turns[parent] @ self._offsets[i])
            position = one.position_mm and 1 / math.hypot(one.position_mm / 1000, self._ratios[i] * sigma_p[segment])
            turn = 1 / np.hypot(np.radians(degrees) * np.ones(3), sigma_R[segment]) if degrees else np.zeros(3)
            if i in self._feet:
                stands = held[self._feet.index(i)]
                if stands.any():
                    turns[i], position, turn[:2] = _level(turns[i], *stands), 0.0, 1 / LEVEL
                places[i][2] = max(places[i][2], self._half_soles[i] * abs(turns[i][2, 0]))
            task.set_target(pin.SE3(turns[i], places[i]))
            task.set_position_cost(float(position or 0.0))
            task.set_orientation_cost(turn)
            if one.position_mm or degrees:
                tasks.append(task)
        return tasks

    def _places(self) -> Array:
        """Return heel and toe of both feet (4, 3) in world, m."""
        return np.array([self._configuration.get_transform_frame_to_world(name).translation for name in self._points])

    def _land(self, standing: Mask) -> None:
        """Note where points are that have begun to stand, and let go of those that have left. standing: (4,)."""
        known = ~np.isnan(self._landed[:, 0])
        self.track.slips += self._ways[known & ~standing].tolist()
        self._landed[~standing], new = np.nan, standing & ~known
        self._landed[new], self._ways[new] = self._places()[new] * [1, 1, 0], 0.0

    def _measure(self, rates: Array, standing: Mask, seconds: float) -> None:
        """Add a frame to what was reached; rates: (J,) rad/s."""
        model, places, track = self.model, self._places(), self.track
        ways = np.linalg.norm((places - self._landed)[:, :2], axis=1)
        self._ways = np.where(standing, np.fmax(self._ways, ways), self._ways)
        low, high = model.lowerPositionLimit[7:] - _EXCESS, model.upperPositionLimit[7:] + _EXCESS
        outside = ((self.q[7:] < low) | (self.q[7:] > high)).any()
        errors = np.array([task.compute_error(self._configuration) for task in self._tasks])
        turned = [i for i, one in enumerate(self.map.link) if one.orientation_deg]
        ends, turns = np.linalg.norm(errors[self._ends, :3], axis=1), np.linalg.norm(errors[turned, 3:], axis=1)
        fast = (rates > model.velocityLimit[6:] * (1 + _EXCESS)).any()
        track.farthest = max(track.farthest, (ends.max(), self.map.link[self._ends[ends.argmax()]].name, self._time))
        track.numbers.extend((outside, fast, places[:, 2].min(), ends.mean(), turns.mean(), seconds))

    def finish(self) -> None:
        """End the stances."""
        self._land(np.zeros(4, dtype=np.bool_))


def _level(R: Array, heel: bool, toe: bool) -> Array:
    """Return a standing foot's orientation without roll, pitched only about the end that stands."""
    up = 0.0 if heel and toe else max(R[2, 0], 0.0) if heel else min(R[2, 0], 0.0)
    x = np.array([*R[:2, 0], up]) / math.hypot(*R[:2, 0], up)
    y = np.array([-x[1], x[0], 0.0]) / math.hypot(*x[:2])
    return np.stack([x, y, np.cross(x, y)], axis=1)


def sigmas(poses: PoseSequence, skeleton: SkeletonModel, confidence: Confidence | None) -> tuple[Array, Array]:
    """Return standard deviations (T, J) of positions relative to the root, m, and orientations, rad."""
    masks = ObservationMasks.of_poses(poses, skeleton)
    if not masks.has_sources:
        return np.zeros(poses.valid.shape), np.zeros(poses.valid.shape)
    position = np.where(masks.position_observed, 0.0, UNOBSERVED_M)
    turn = np.select([masks.levels == WHOLE, masks.levels == NOTHING], [0.0, UNOBSERVED], UNSEEN_TURN)
    if confidence is not None:
        return np.fmax(position, confidence.relative_sigma), np.fmax(turn, confidence.orientation_sigma)
    return position, turn


@dataclass(frozen=True)
class RobotMotion:
    """A robot's motion on a floor at height 0."""

    robot: Retargeter
    times: Array  #: (T,) s
    q: Array  #: (T, 7 + J) see `Retargeter.q`

    @classmethod
    def of(cls, motion: MotionSource, urdf: Path, map: str | None = None, without: str = "") -> Self:
        """Retarget a motion; arguments and errors as for `Retargeter`."""
        robot = Retargeter(motion.skeleton, urdf, map, floor_levels(motion)[0], without)
        rows = np.empty((len(motion), robot.model.nq))
        for block in motion.blocks(confidence=True):
            rows[block.frames] = robot.follow(block.motion.poses, block.motion.confidence)
        robot.finish()
        return cls(robot, motion.times, rows)

    def write(self, folder: Path) -> None:
        """Write ``robot_joint_trajectory.json`` and ``robot_base_trajectory.json``, messages of ROS as of a person,
        ``robot_qpos.npz`` for MuJoCo, see `write_qpos`, ``retarget.json`` with the figures, and with the extra connect
        ``robot.mcap``, over existing files.
        """
        robot, angles, seconds = self.robot, self.q[:, 7:], self.times - self.times[0]
        rates = np.gradient(angles, self.times, axis=0) if len(angles) > 1 else np.zeros_like(angles)
        with new_message(folder / "robot_joint_trajectory.json", robot.joints) as add:
            add(joint_points(seconds, angles, rates))
        with new_message(folder / "robot_base_trajectory.json", [robot.root]) as add:
            add(base_points(seconds, self.q))
        write_qpos(folder / "robot_qpos.npz", self.times, self.q, robot.joints)
        figures = {name: float(one) if np.isfinite(one) else None for name, one in robot.track.figures().items()}
        found = {"map": robot.map.name, "scale": robot.scale, "failures": robot.track.failures} | figures
        write_text(folder / FIGURES, json.dumps(found, indent=2) + "\n", overwrite=True)
        if find_spec("mcap") and find_spec("rosbags"):
            self._write_mcap(folder / "robot.mcap")

    def _write_mcap(self, path: Path) -> None:
        """Write joint states and the transform of each link in the one that it hangs on."""
        model, data = self.robot.model, self.robot.model.createData()

        def above(frame: int) -> int:
            while (frame := model.frames[frame].parentFrame) and model.frames[frame].type != pin.FrameType.BODY:
                pass
            return frame

        pairs = [(above(i), i) for i, one in enumerate(model.frames) if one.type == pin.FrameType.BODY]
        names = [(model.frames[a].name if a else WORLD_FRAME, model.frames[i].name) for a, i in pairs]
        path.unlink(missing_ok=True)
        with RosLog(path, self.robot.urdf.read_text(encoding="utf-8"), self.robot.joints, names) as log:
            for own in blocks_of(len(self.q), BLOCK):
                placed = np.empty((len(self.q[own]), len(pairs), 7))
                for q, rows in zip(self.q[own], placed, strict=True):
                    pin.framesForwardKinematics(model, data, q)
                    rows[:] = [pin.SE3ToXYZQUAT(data.oMf[a].actInv(data.oMf[i])) for a, i in pairs]
                log.write(self.times[own] - self.times[0], self.q[own, 7:], placed[..., :3], placed[..., 3:])

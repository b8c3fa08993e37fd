"""Faults that are planted one by one, each in several sizes, and how the first line is to name them.

A fault changes what is declared or recorded, never the motion. Signs and directions are drawn.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.random import Generator

from benchmarks.accuracy.faults import with_changed_camera
from benchmarks.accuracy.sensor_faults import sensors, with_imus
from benchmarks.accuracy.video_faults import LEGS
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.recording.recording import Recording

Size = float | str
KNEES_DOWN: Final = tuple(name for name in LEGS if not name.endswith("UpLeg"))
_SEGMENTS: Final = {"UpLeg": "thigh", "Leg": "shank", "Arm": "upper arm", "ForeArm": "forearm"}


@dataclass
class Draws:
    """What is drawn for one fault, and what it befalls."""

    rng: Generator
    other: Callable[[str], Recording]
    """Another take with the same sensors, of the 'same person' or of 'another person'."""
    culprits: tuple[str, ...] = ()
    """Names of the one sensor that is wrong, of which the first line has to contain one; () for none."""
    joints: tuple[str, ...] = ()
    """Joints that bands are judged at; () for all."""
    start: float = -np.inf
    stop: float = np.inf
    """[s] Interval in which bands are judged."""

    def sign(self) -> float:
        """Draw a sign."""
        return float(self.rng.choice([-1.0, 1.0]))


Plant = Callable[[Recording, Any, Draws], Recording]


@dataclass(frozen=True)
class Fault:
    """Something to plant."""

    plant: Plant
    sizes: tuple[Size, ...]
    unit: str
    named: str
    """Regular expression of the nouns that name it, whatever their case."""
    band: str = "relative"
    """Band that is judged where it is not named: 'world', 'relative' or 'angles'."""
    sensors: bool | None = None
    """Whether it needs sensors, or that there are none; None if either will do."""
    floor: bool | None = None
    """The same of a declared floor."""
    sensor_clock: Callable[[Array, Any], Array] | None = None
    """Times of the sensors' clock by those of the video, and the size, where the fault parts them: the
    motion may be right on either."""
    accuses: bool = True
    """Whether a first line that names it in a right recording is a false alarm; bodies do get hidden."""

    def names(self, cause: str) -> bool:
        """Whether the cause that a first line says names it."""
        return re.search(self.named, cause, re.IGNORECASE) is not None


# --- camera, floor and body ------------------------------------------------------------------------


def focal(recording: Recording, factor: float, draws: Draws) -> Recording:
    """A focal length that is wrong by a factor."""
    K = recording.video.camera.K
    return with_changed_camera(recording, K=K * [[factor, factor, 1], [factor, factor, 1], [1, 1, 1]])


def principal_point(recording: Recording, px: float, draws: Draws) -> Recording:
    """A principal point that is off in a direction that is drawn."""
    K, angle = recording.video.camera.K.copy(), draws.rng.uniform(0, 2 * np.pi)
    K[:2, 2] += px * np.array([np.cos(angle), np.sin(angle)])
    return with_changed_camera(recording, K=K)


def _turned_camera(axis: str, of_world: bool = False) -> Plant:
    """A camera turned about an axis of its own, or of the world, through its centre."""

    def plant(recording: Recording, degrees: float, draws: Draws) -> Recording:
        camera = recording.video.camera
        turn = so3.about_axis(axis, np.radians(draws.sign() * degrees))
        R = camera.R_camera_world @ turn if of_world else turn @ camera.R_camera_world
        return with_changed_camera(recording, R_camera_world=R, t_camera_world=-R @ camera.center_world)

    return plant


def camera_height(recording: Recording, metres: float, draws: Draws) -> Recording:
    """A camera that stands higher or lower over the floor."""
    camera = recording.video.camera
    centre = camera.center_world + np.array([0.0, 0.0, draws.sign() * metres])
    return with_changed_camera(recording, t_camera_world=-camera.R_camera_world @ centre)


def floor(recording: Recording, metres: float, draws: Draws) -> Recording:
    """A floor that is higher or lower than the one stood on."""
    return replace(recording, floor_height=(recording.floor_height or 0.0) + draws.sign() * metres)


def bones(recording: Recording, factor: float, draws: Draws) -> Recording:
    """All bones too long or too short."""
    return replace(recording, joint_offsets=factor * recording.joint_offsets)


def height_alone(recording: Recording, factor: float, draws: Draws) -> Recording:
    """Bones that follow from a height, which is wrong by a factor, 1 for the true one: proportions are those
    of other people, 4 % for each bone (standard deviation), left and right alike."""
    height = factor * recording.skeleton.height
    bones = [name.removeprefix("Left").removeprefix("Right") for name in recording.skeleton.names]
    share = {bone: 1 + 0.04 * draws.rng.standard_normal() for bone in sorted(set(bones))}
    offsets = recording.joint_offsets * np.array([[share[bone]] for bone in bones])
    own = replace(recording, joint_offsets=offsets).skeleton.height
    return replace(recording, height=height, joint_offsets=offsets * (height / own))


# --- sensors ---------------------------------------------------------------------------------------


def late(recording: Recording, seconds: float, draws: Draws) -> Recording:
    """The sensors' stamps are late."""
    return with_imus(recording, times=_late(sensors(recording).times, seconds))


def _late(times: Array, seconds: float) -> Array:
    return times + seconds


def drift(recording: Recording, share: float, draws: Draws) -> Recording:
    """The sensors' clock runs too fast."""
    return with_imus(recording, times=_drifting(sensors(recording).times, share))


def _drifting(times: Array, share: float) -> Array:
    return np.asarray(times[0] + (1 + share) * (times - times[0]))


def _one(recording: Recording, draws: Draws) -> tuple[int, str]:
    """Draw a sensor on a limb; its number in the calibration and its segment."""
    given = recording.calibration
    assert given is not None
    limbs = [s for s, joint in enumerate(given.joints) if joint.startswith(("Left", "Right"))]
    s = int(draws.rng.choice(limbs))
    side = "Left" if given.joints[s].startswith("Left") else "Right"
    words = f"{side} {_SEGMENTS.get(given.joints[s].removeprefix(side), '')}"
    draws.culprits = (given.sensors[s], given.joints[s], words, words.replace("shank", "lower leg"))
    return s, given.joints[s]


def turned_sensor(recording: Recording, degrees: float, draws: Draws) -> Recording:
    """One sensor turned about its bone."""
    given = recording.calibration
    assert given is not None
    s, joint = _one(recording, draws)
    skeleton, R = recording.skeleton, given.R_sensor_bone.copy()
    child = skeleton.parents.index(skeleton.names.index(joint))
    bone = so3.unit(skeleton.joint_offsets[child])
    R[s] = R[s] @ so3.exp(np.radians(draws.sign() * degrees) * bone)
    return replace(recording, calibration=replace(given, R_sensor_bone=R))


def frozen_sensor(recording: Recording, after: float, draws: Draws) -> Recording:
    """One sensor that repeats one sample with noise after a share of the time."""
    imus, given = sensors(recording), recording.calibration
    assert given is not None
    s = imus.names.index(given.sensors[_one(recording, draws)[0]])
    R, f, first = imus.R_inertial_sensor.copy(), imus.f_sensor.copy(), round(after * len(imus))
    noise = draws.rng.standard_normal((2, len(imus) - first, 3))
    R[first:, s] = R[first, s] @ so3.exp(np.radians(0.03) * noise[0])
    f[first:, s] = f[first, s] + 0.03 * noise[1]
    return with_imus(recording, R_inertial_sensor=R, f_sensor=f)


def _turned_references(horizontal: bool) -> Plant:
    """All references turned alike, about a horizontal axis that is drawn or about the vertical."""

    def plant(recording: Recording, degrees: float, draws: Draws) -> Recording:
        given, angle = recording.calibration, draws.rng.uniform(0, 2 * np.pi)
        assert given is not None
        axis = np.array([np.cos(angle), np.sin(angle), 0.0]) if horizontal else np.array([0, 0, draws.sign()])
        R = so3.exp(np.radians(degrees) * axis) @ given.R_world_inertial
        return replace(recording, calibration=replace(given, R_world_inertial=R))

    return plant


def of_another_take(recording: Recording, whose: str, draws: Draws) -> Recording:
    """The sensors and their mounting are those of another take."""
    other, own = draws.other(whose), sensors(recording)
    theirs = sensors(other)
    n = min(len(theirs), len(own))
    times = own.times[0] + theirs.times[:n] - theirs.times[0]
    return replace(recording, imus=replace(theirs[:n], times=times), calibration=other.calibration)


def ending_sensors(recording: Recording, share: float, draws: Draws) -> Recording:
    """All sensors end after a share of the time."""
    imus = sensors(recording)
    draws.start = float(imus.times[0] + share * (imus.times[-1] - imus.times[0]))
    return replace(recording, imus=imus[: round(share * len(imus))])


# --- video -----------------------------------------------------------------------------------------


def legs_exchanged(recording: Recording, share: float, draws: Draws) -> Recording:
    """The legs' keypoints exchanged for a share of the time, from the beginning."""
    video, names = recording.video, recording.video.names
    below = [n for n in names if n.startswith("Left") and re.search("Leg|Foot|Toe|Heel|Ankle|Knee", n)]
    left = [names.index(n) for n in below]
    right = [names.index(n.replace("Left", "Right", 1)) for n in below]
    end = round(share * len(video))
    uv, confidence = video.uv_px.copy(), video.confidence.copy()
    for array in (uv, confidence):
        array[:end, left], array[:end, right] = array[:end, right], array[:end, left]
    return replace(recording, keypoints=replace(video, uv_px=uv, confidence=confidence))


def _of_legs(recording: Recording) -> Mask:
    return np.array([re.search("Leg|Foot|Toe|Heel|Ankle|Knee", n) is not None for n in recording.video.names])


def legs_off(recording: Recording, px: float, draws: Draws) -> Recording:
    """Knees and feet seen beside where they are, by a confident detector."""
    video, angle = recording.video, draws.rng.uniform(0, 2 * np.pi)
    below = _of_legs(recording) & ~np.array([n.endswith("UpLeg") for n in video.names])
    shift = px * np.array([np.cos(angle), np.sin(angle)])
    seen = video.confidence > 0
    draws.joints = KNEES_DOWN
    return replace(
        recording,
        keypoints=replace(
            video,
            uv_px=video.uv_px + below[:, None] * shift,
            confidence=np.where(below & seen, np.maximum(video.confidence, 0.9), video.confidence),
        ),
    )


def _hidden(recording: Recording, seconds: float, draws: Draws, points: Mask) -> Recording:
    video = recording.video
    middle = (video.times[0] + video.times[-1]) / 2
    draws.start, draws.stop = middle - seconds / 2, middle + seconds / 2
    gone = ((video.times >= draws.start) & (video.times < draws.stop))[:, None] & points
    uv = np.where(gone[..., None], np.nan, video.uv_px)
    return replace(recording, keypoints=replace(video, uv_px=uv, confidence=np.where(gone, 0.0, video.confidence)))


def gap(recording: Recording, seconds: float, draws: Draws) -> Recording:
    """Nobody seen in the middle."""
    return _hidden(recording, seconds, draws, np.ones(len(recording.video.names), dtype=bool))


def legs_unseen(recording: Recording, seconds: float, draws: Draws) -> Recording:
    """The legs unseen in the middle."""
    draws.joints = KNEES_DOWN
    return _hidden(recording, seconds, draws, _of_legs(recording))


def other_rate(recording: Recording, hz: float, draws: Draws) -> Recording:
    """A video of 30 Hz with another rate declared; what a frame shows is as it was."""
    video, truth = recording.video, recording.truth
    assert truth is not None
    step = round(1 / (30 * float(np.median(np.diff(video.times)))))
    kept = video.at(slice(0, None, step), video.uv_px[::step], video.confidence[::step])
    start, slower = video.times[0], 30.0 / hz
    return replace(
        recording,
        keypoints=replace(kept, times=start + slower * (kept.times - start)),
        truth=replace(truth, times=start + slower * (truth.times - start)),
    )


_CLOCK = r"clock|delay|\blate\b|\bearly\b|offset|synchron|time stamps|began .* (after|before)"
_RATE = r"frame rate|frames (a|per) second|frames/s|\bHz\b|sampling rate|speed of the video|video runs"
_BONES = r"\bbones? |bone length|bones are|\bheight of the (person|subject|body)|body height|stature|\bskeleton"
_BONES += r"|size of the (person|body|subject)|the (person|subject|body)'s (size|height)"
_TURN = r"camera.{0,40}(turn|rotat|orient|roll|tilt|lean|pitch|yaw|upright|level|pose)|\bhorizon\b"
_TURN += r"|(turn|rotat|orient|roll|tilt|pitch|yaw|pose).{0,40}camera|\btilt of|\broll of"
_SENSOR = r"turned|rotated|twist|mount|attach|slipped|slid|orientation of the sensor|about (its|the) bone"
_GONE = r"unseen|not seen|nobody|no keypoints|out of (the )?(image|sight|view|picture)|gap"
_GONE += r"|without (a )?(meas|obs)|nothing was seen|unobserved|hidden|missing"
_REFERENCE = r"tilt|gravity|vertical of the sensors|references? (of|are|is)|inertial (frame|reference)"
_HEADING = r"heading|azimuth|\bnorth|yaw"
FAULTS: Final[dict[str, Fault]] = {
    "sensors late": Fault(late, (0.05, 0.1, 0.2), "s", _CLOCK, "angles", True, sensor_clock=_late),
    "sensors early": Fault(late, (-0.05, -0.1, -0.2), "s", _CLOCK, "angles", True, sensor_clock=_late),
    "sensors' clock drifts": Fault(
        drift, (0.003, 0.01, 0.02), "", _CLOCK + r"|drift", "angles", True, sensor_clock=_drifting
    ),
    "focal length wrong": Fault(focal, (0.8, 0.9, 1.1, 1.2), "x", r"focal|field of view|zoom", "world", floor=False),
    "focal length wrong, floor known": Fault(
        focal, (0.8, 0.9, 1.1, 1.2), "x", r"focal|field of view|zoom", "world", floor=True
    ),
    "principal point off": Fault(
        principal_point,
        (50.0, 100.0, 200.0),
        "px",
        r"principal point|(centre|center) of the image|cropp|" + _TURN,
        "world",
    ),
    "bones too long": Fault(bones, (1.05, 1.1, 1.15), "x", _BONES, "world"),
    "bones too short": Fault(bones, (0.95, 0.9, 0.85), "x", _BONES, "world"),
    "height too large": Fault(height_alone, (1.05, 1.1, 1.15), "x", _BONES + r"|height", "world"),
    "height too small": Fault(height_alone, (0.95, 0.9, 0.85), "x", _BONES + r"|height", "world"),
    "camera too high or low, floor known": Fault(
        camera_height,
        (0.3, 0.6, 1.0),
        "m",
        r"camera.{0,40}(high|low|height|position|place|off)|(height|position|place) of the camera|lens height"
        r"|floor",
        "world",
        floor=True,
    ),
    "floor too high or low": Fault(
        floor,
        (0.05, 0.1, 0.3),
        "m",
        r"floor|(height|position) of the camera|camera.{0,20}(height|position)",
        "world",
        floor=True,
    ),
    "camera turned about the vertical": Fault(
        _turned_camera("z", of_world=True), (5.0, 10.0, 20.0), "deg", _TURN + "|" + _HEADING, "world", True
    ),
    "camera rolled": Fault(_turned_camera("z"), (3.0, 6.0, 10.0), "deg", _TURN, "world"),
    "camera tilted": Fault(_turned_camera("x"), (3.0, 6.0, 10.0), "deg", _TURN, "world"),
    "one sensor turned about its bone": Fault(turned_sensor, (15.0, 30.0, 60.0), "deg", _SENSOR, "angles", True),
    "one sensor frozen": Fault(
        frozen_sensor,
        (0.66, 0.33, 0.0),
        "of the time before",
        r"frozen|freez|stuck|stands still|does not move|constant|repeats|same sample",
        "angles",
        True,
    ),
    "references tilted": Fault(_turned_references(True), (5.0, 10.0, 20.0), "deg", _REFERENCE, "relative", True),
    "headings off": Fault(_turned_references(False), (15.0, 30.0, 60.0), "deg", _HEADING, "relative", True),
    "legs of the keypoints exchanged": Fault(
        legs_exchanged,
        (0.25, 0.5, 1.0),
        "of the time",
        r"exchang|swap|left and right|right and left|mirror|sides",
        "relative",
        accuses=False,
    ),
    "sensors of another take": Fault(
        of_another_take,
        ("same person", "another person"),
        "",
        r"another|belong to|no offset|(other|different|same) (take|recording|person|motion)",
        "angles",
        True,
    ),
    "30 Hz called": Fault(other_rate, (25.0, 50.0, 60.0), "Hz", _RATE, "relative"),
    "nobody seen": Fault(gap, (1.0, 2.0, 5.0), "s", _GONE, "relative", accuses=False),
    "sensors end": Fault(
        ending_sensors,
        (0.9, 0.7, 0.5),
        "of the time",
        r"sensors?.{0,40}(end|stop|missing|until|no samples|without)|(ends?|stops?|missing).{0,40}sensor"
        r"|samples missing",
        "angles",
        True,
    ),
    "legs unseen": Fault(legs_unseen, (1.0, 2.0, 5.0), "s", _GONE, "relative", False, accuses=False),
    "legs seen beside where they are": Fault(
        legs_off,
        (20.0, 40.0, 60.0),
        "px",
        r"(legs?|knees?|ankles?|foot|feet|toes?|heels?)\b.{0,60}(reprojection|beside|displaced|detector"
        r"|where (it|they) (was|were) seen|keypoints are (off|wrong))|keypoints.{0,30}of the (legs|feet"
        r"|knees).{0,30}(off|wrong|beside|displaced)",
        "relative",
    ),
}
"""Name -> fault. What nothing in a recording contradicts, like a room turned about the vertical without
sensors, is not among them: it is no error of the motion in the camera's room."""
RIGHT: Final = {"right": 0.0, "right, of the body the height alone": 1.0}
"""Recordings without a fault, by what is known of the body."""


def matching(cause: str) -> list[str]:
    """Faults that a cause names, without regard to the one sensor."""
    return [name for name, fault in FAULTS.items() if fault.accuses and fault.names(cause)]

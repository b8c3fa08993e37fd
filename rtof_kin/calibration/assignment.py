"""Which sensor is on which segment, from motion: `assign_sensors`, and `check_assignment` of a declared map.

With poses from an image, orientations and angular velocities of each sensor are compared with those of every
segment, mounting and heading unknown (`motion_score`). Sizes, spectra and correlations of the motion, and
which sensors have a joint in common, are scored as learned from motion capture (`motion_score`), with an
image or without. A motion that is the same in a mirror, such as a squat, does not tell left from right.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import NDArray
from scipy.special import logsumexp

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.calibration.motion_score import RATE_HZ, SensorMotions, image_scores, sensor_motions, shipped_score
from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import Check, indices_of
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.imu_stream import SensorLog
from rtof_kin.data.poses import PoseSequence
from rtof_kin.inertial.segment_names import other_side

Labels = NDArray[np.intp]
Score = Callable[[Labels], Array]  # Log-probabilities (C,) of assignments (C, S)
_CHAINS, _COOLING, _SAMPLING = 32, 300, 400  # chains, steps of each
_HOTTEST = 10.0  # [-] temperature at the start
_IMPOSSIBLE = -1e4  # [nats]


@dataclass(frozen=True, eq=False)
class Matching:
    """Posterior of the assignments of S sensors to K segments."""

    best: Labels  # (S,) segment of each sensor in the likeliest assignment
    probability: Array  # (S, K) of each sensor on each segment


def match(
    single: Array,
    pair: Array | None = None,
    *,
    allowed: NDArray[np.bool_] | None = None,
    mirrors: Sequence[Labels] = (),
    prior: Score | None = None,
) -> Matching:
    """Sample assignments of each sensor to a segment of its own.

    The scores add up to an assignment's log-probability. Metropolis-Hastings chains (Hastings 1970) move one sensor at
    a time, exchanging it with the one that is there, by proposals in proportion to the probabilities of the outcomes
    (locally informed, Zanella 2020), and now and then exchange the sides of whole limbs. They cool down before they
    count, and start at the best assignment of the single scores (Jonker and Volgenant 1987) and at random ones.

    Args:
        single: (S, K) scores, nats; S <= K. pair: (S, S, K, K) scores, symmetric, 0 of a sensor with itself.
        allowed: (S, K) segments that each sensor may be on; at least one assignment is possible.
        mirrors: permutations (K,) of segments that are proposed for all sensors at once.
        prior: log-probability (C,) of assignments (C, S), added.
    """
    S, K = single.shape
    single = np.where(np.ones((S, K), bool) if allowed is None else allowed, single, _IMPOSSIBLE)
    rng = np.random.default_rng(0)
    rows, (a, b) = np.arange(S), np.triu_indices(S, 1)

    def score(labels: Labels) -> Array:
        out = single[rows, labels].sum(axis=-1)
        if pair is not None:
            out = out + pair[a, b, labels[:, a], labels[:, b]].sum(axis=-1)
        return np.asarray(out if prior is None else out + prior(labels))

    starts = [scipy.optimize.linear_sum_assignment(-single)[1]]
    for _ in range(_CHAINS - 1):
        cost = rng.uniform(size=(S, K)) - np.where(single <= _IMPOSSIBLE, -1e3, 0)
        starts.append(scipy.optimize.linear_sum_assignment(cost)[1])
    at = np.array(starts)
    counts, seen = np.zeros((S, K)), set[tuple[int, ...]]()
    temperatures = np.append(np.geomspace(_HOTTEST, 1.0, _COOLING), np.ones(_SAMPLING))
    for step, temperature in enumerate(temperatures):
        at = _placed(rng, at, step % S, K, score, float(temperature))
        if len(mirrors) and step % S == 0:
            sides = np.asarray(mirrors)[rng.integers(len(mirrors), size=len(at))[:, None], at]
            better = np.log(rng.uniform(size=len(at))) < (score(sides) - score(at)) / temperature
            at = np.where(better[:, None], sides, at)
        if step >= _COOLING:
            np.add.at(counts, (rows, at), 1)
            seen.update(map(tuple, at.tolist()))
    every = np.array(sorted(seen))
    return Matching(every[score(every).argmax()], counts / counts.sum(axis=1, keepdims=True))


def _placed(rng: np.random.Generator, at: Labels, s: int, K: int, score: Score, temperature: float) -> Labels:
    """Return assignments (C, S) after a step that places sensor s."""

    def ways(of: Labels) -> tuple[Labels, Array]:
        """Return assignments (C, K, S) with sensor s on each segment, whose own takes its place, and scores (C, K)."""
        new = np.repeat(of[:, None], K, axis=1)
        new = np.where(new == np.arange(K)[:, None], of[:, s, None, None], new)
        new[:, :, s] = np.arange(K)
        return new, score(new.reshape(-1, of.shape[1])).reshape(-1, K) / temperature

    there, scores = ways(at)
    total = logsumexp(scores, axis=1)
    share = np.exp(scores - total[:, None]).cumsum(axis=1)
    drawn = np.minimum((share < rng.uniform(size=(len(at), 1))).sum(axis=1), K - 1)
    new = there[np.arange(len(at)), drawn]
    accepted = np.log(rng.uniform(size=len(at))) < total - logsumexp(ways(new)[1], axis=1)
    return np.where(accepted[:, None], new, at)


Candidates = Sequence[str] | Mapping[str, Sequence[str]]
_SURE = 0.95  # [-] probability from which a sensor's segment is not doubted
_POSSIBLE = 0.02  # [-] probability from which an alternative is named
_STILL = 0.05  # [rad/s] RMS angular speed of a sensor that does not move
_SHORT = 8.0  # [s] of motion alone, below which nothing is sure
_IMAGE_WEIGHT, _VIEW_MEMORY = 0.25, 10.0  # [-] of the image's log-likelihood; [s] beyond which it hardly
# grows, as errors of a lifted segment belong to the view
_MOTION_WEIGHT = 1.5  # [-] of the learned scores, chosen on the validation split
_UNPAIRED = 2.0  # [nats] against a sensor on one side of the body alone
_MOST_PROBABLE = 0.999  # [-] nothing is stated surer, as models are not exact


@dataclass(frozen=True)
class Assignment:
    """Segments of sensors, and how sure they are."""

    joints: dict[str, str]  # Sensor -> segment, by its proximal joint
    probabilities: dict[str, float]  # Sensor -> probability of that segment
    alternatives: dict[str, tuple[tuple[str, float], ...]]
    """Sensor -> other segments that are possible and their probabilities, falling."""
    doubt: str  # What is not sure and what to do about it, in one sentence; empty where all is sure


def assign_sensors(
    log: SensorLog, skeleton: SkeletonModel, poses: PoseSequence | None = None, *, candidates: Candidates | None = None
) -> Assignment:
    """Find the segment of each sensor from motion. Mountings and headings may be anything. `UnknownNameError`: an
    unknown segment or sensor; `InvalidInputError`: more sensors than segments, too little data, or without poses no
    acceleration.

    Args:
        log: the sensors; with poses, on their clock.
        poses: lifted from a video; None: motion alone.
        candidates: segments that may have a sensor, of all or by sensor (others: all); by default those of
            the skeleton's usual sensors. There may be fewer sensors than segments.
    """
    motions = sensor_motions(log)
    segments, allowed = _possible(motions.names, skeleton, candidates)
    found = match_sensors(motions, skeleton, segments, poses, allowed=allowed)
    joints, probabilities, alternatives = {}, {}, {}
    for sensor, k, row in zip(motions.names, found.best, found.probability, strict=True):
        joints[sensor], probabilities[sensor] = segments[k], min(float(row[k]), _MOST_PROBABLE)
        others = [int(i) for i in np.argsort(-row) if i != k and row[i] >= _POSSIBLE]
        alternatives[sensor] = tuple((segments[i], float(row[i])) for i in others)
    sure = Assignment(joints, probabilities, alternatives, "")
    return replace(sure, doubt=_doubt(sure, motions, poses is not None))


def usual_segments(skeleton: SkeletonModel) -> tuple[str, ...]:
    """Return the segments of the skeleton's usual sensors."""
    return tuple(dict.fromkeys(joint for joint, _ in skeleton.sensors.values()))


def match_sensors(
    motions: SensorMotions,
    skeleton: SkeletonModel,
    segments: tuple[str, ...],
    poses: PoseSequence | None = None,
    *,
    allowed: NDArray[np.bool_] | None = None,
    prior: Score | None = None,
) -> Matching:
    """Return the posterior of assignments of sensors to segments. `InvalidInputError`: without poses, a segment that
    nothing was learned of, or no accelerations.

    Args:
        allowed: (S, K).
        prior: log-probability (C,) of assignments (C, S); default: symmetric ones.
    """
    score = shipped_score()
    learned = motions.accelerated and set(segments) <= set(score.segments)
    if poses is None and not learned:
        unknown = sorted(set(segments) - set(score.segments))
        lacking = f"for {', '.join(unknown)}" if unknown else "without accelerations"
        raise InvalidInputError(
            f"which sensor is where cannot be told from motion alone {lacking}; give poses from a video"
        )
    single, pair = np.zeros((len(motions.names), len(segments))), None
    if learned:
        single, pair = (_MOTION_WEIGHT * table for table in score.tables(motions, segments))
    if poses is not None:
        weight = _IMAGE_WEIGHT / (1 + len(motions) / RATE_HZ / _VIEW_MEMORY)
        single = single + weight * image_scores(motions, poses, skeleton, segments)
    return match(single, pair, allowed=allowed, mirrors=_mirrors(segments), prior=prior or _symmetric(segments))


def _possible(
    sensors: Sequence[str], skeleton: SkeletonModel, candidates: Candidates | None
) -> tuple[tuple[str, ...], NDArray[np.bool_]]:
    """Return the segments (K) in question and which of them each sensor may be on (S, K)."""
    usual = usual_segments(skeleton)
    own: Mapping[str, Sequence[str]] = {}
    if isinstance(candidates, Mapping):
        indices_of("sensor", list(candidates), sensors)
        own = candidates
    elif candidates is not None:
        usual = tuple(dict.fromkeys(candidates))
    segments = tuple(dict.fromkeys([*usual, *(name for names in own.values() for name in names)]))
    indices_of("segment", segments, skeleton.names)
    if len(sensors) > len(segments):
        raise InvalidInputError(
            f"there are {len(sensors)} sensors for {len(segments)} segments ({', '.join(segments)}); name "
            "all segments that have one as candidates, or leave sensors out"
        )
    allowed = np.array([[name in own.get(sensor, usual) for name in segments] for sensor in sensors])
    rows, columns = scipy.optimize.linear_sum_assignment(~allowed)
    if not allowed[rows, columns].all():
        raise InvalidInputError("the candidates leave no segment of its own for each sensor; name more of them")
    return segments, allowed


def _symmetric(segments: Sequence[str]) -> Score:
    """Log-probability (C,) of assignments (C, S): people wear sensors on both sides rather than on one."""
    other = [(k, segments.index(o)) for k, o in enumerate(map(other_side, segments)) if o in segments]
    a, b = np.array([pair for pair in other if pair[0] < pair[1]], dtype=np.intp).reshape(-1, 2).T

    def score(labels: Labels) -> Array:
        used = np.zeros((len(labels), len(segments)), dtype=np.bool_)
        np.put_along_axis(used, labels, True, axis=1)
        return np.asarray(-_UNPAIRED * np.sum(used[:, a] != used[:, b], axis=1))

    return score


def _mirrors(segments: Sequence[str]) -> list[Labels]:
    """Return exchanges of left and right (K,): of all segments, and of arms and of legs alone."""
    other = [other_side(name) for name in segments]
    if not set(other) <= set(segments):
        return []
    both = np.array([segments.index(name) for name in other])
    leg = np.array([name.endswith(("Leg", "Foot")) for name in segments])
    own = np.arange(len(segments))
    return [both, np.where(leg, both, own), np.where(leg, own, both)]


def _doubt(found: Assignment, motions: SensorMotions, seen: bool) -> str:
    """What is not sure: sensors that do not move, segments, or a motion that is too short without an image."""
    speed = np.sqrt(np.mean(np.sum(motions.w**2, axis=-1), axis=0))
    if still := [name for name, own in zip(motions.names, speed, strict=True) if own < _STILL]:
        what = f"{', '.join(still)} {'does' if len(still) == 1 else 'do'} not move"
        return f"{what}: record a few steps, and raise and bend each arm and leg once"
    unsure, seconds = [sensor for sensor, p in found.probabilities.items() if p < _SURE], len(motions) / RATE_HZ
    if not unsure:
        least = f"record {_SHORT:g} s at least with steps and a turn, or give a video"
        short = not seen and seconds < _SHORT
        return f"{seconds:.0f} s are too short to be sure from motion alone; {least}" if short else ""
    remedy = "walk a few steps and raise each limb once" if seen else "give a video, or name one of them"
    other = {sensor: dict(found.alternatives[sensor]) for sensor in unsure}
    if all(found.probabilities[s] + other[s].get(other_side(found.joints[s]), 0) >= _SURE for s in unsure):
        return f"left and right of {', '.join(unsure)} are not sure; {remedy}"
    named = (f"{s} on {found.joints[s]} ({100 * found.probabilities[s]:.0f} %)" for s in unsure)
    return f"not sure: {', '.join(named)}; {remedy}"


NAME = "another place of sensors"
_FIRST_ERROR, _FURTHER_ERROR = 6.0, 0.5  # [nats] against a map with errors, and for each sensor concerned
_SURE_ELSEWHERE = 0.9  # [-] probability from which a sensor is said to be elsewhere


@dataclass(frozen=True)
class WrongSensor:
    """A sensor that is not where it is declared."""

    sensor: str
    declared: str  # Segment it is declared on
    likely: str  # Segment it is on
    probability: float  # Of that

    def __str__(self) -> str:
        where = f"declared on {self.declared}, is on {self.likely}"
        return f"{self.sensor}, {where} ({100 * self.probability:.0f} %)"


@dataclass(frozen=True)
class AssignmentCheck:
    """What motion tells of a map from sensors to segments."""

    joints: dict[str, str]  # Sensor -> segment, corrected where that is sure
    wrong: tuple[WrongSensor, ...]  # Sensors that are elsewhere
    probability: float  # That the map as declared is wrong somewhere
    doubt: str = ""  # What is possible but not sure, in one sentence; may be empty

    def check(self) -> Check:
        """Return the result as a check of plausibility."""
        advice = "; ".join(map(str, self.wrong)) + ". Write the corrected recording with --fix -o OUT"
        cause = "sensors are not where they are declared" if self.wrong else ""
        value = self.probability if self.wrong else min(self.probability, 1 - _SURE_ELSEWHERE)
        return Check(NAME, "sensors", value, 1 - _SURE_ELSEWHERE, "", advice if self.wrong else self.doubt, cause=cause)


def check_assignment(
    log: SensorLog, joints: Mapping[str, str], skeleton: SkeletonModel, poses: PoseSequence | None = None
) -> AssignmentCheck:
    """Check that sensors are where they are declared. A map without errors is taken to be likelier.

    The calibration is not used, so that neither a wrong mounting nor a wrong heading matters. How it has to change is
    then chosen by the likelihood of the calibrated motion (`inertial.setup_diagnosis`). `UnknownNameError`: a sensor or
    segment does not exist; `InvalidInputError`: two sensors on one segment, too little data, or no evidence without
    poses.

    Args:
        log: the sensors; with poses, on their clock. joints: sensor -> segment, by its proximal joint;
            others are ignored. skeleton: the subject's. poses: lifted from a video, if there is one.
    """
    indices_of("sensor", list(joints), log.names)
    indices_of("segment", list(joints.values()), skeleton.names)
    if len(set(joints.values())) < len(joints):
        twice = sorted({j for j in joints.values() if list(joints.values()).count(j) > 1})
        raise InvalidInputError(f"there are two sensors on {', '.join(twice)}; declare each where it is")
    motions = sensor_motions(log.select(list(joints)))
    segments = tuple(dict.fromkeys([*usual_segments(skeleton), *joints.values()]))
    declared = np.array([segments.index(joints[name]) for name in motions.names])

    def prior(labels: Labels) -> Array:
        errors = np.sum(labels != declared, axis=1)
        return np.asarray(-np.where(errors > 0, _FIRST_ERROR + _FURTHER_ERROR * errors, 0.0))

    found = match_sensors(motions, skeleton, segments, poses, prior=prior)
    wrong, unsure, corrected = [], [], dict(joints)
    for name, own, k, row in zip(motions.names, declared, found.best, found.probability, strict=True):
        if k != own and row[k] >= _SURE_ELSEWHERE:
            wrong.append(WrongSensor(name, segments[own], segments[k], float(min(row[k], 0.999))))
            corrected[name] = segments[k]
        elif row[own] < _SURE_ELSEWHERE:
            other = max((i for i in range(len(segments)) if i != own), key=lambda i: float(row[i]))
            unsure.append(f"{name} may be on {segments[other]} ({100 * row[other]:.0f} %)")
    if len(set(corrected.values())) < len(corrected):  # a part of an exchange alone is no correction
        unsure += [f"{sensor.sensor} may be on {sensor.likely}" for sensor in wrong]
        wrong, corrected = [], dict(joints)
    probability = 1 - float(np.prod(found.probability[np.arange(len(declared)), declared]))
    doubt = f"by its motion {', '.join(unsure)}; what is declared is kept" if unsure else ""
    return AssignmentCheck(corrected, tuple(wrong), probability, doubt)

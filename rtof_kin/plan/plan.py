"""`plan`: what to expect of a recording before it is made, and how to make it better."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

import numpy as np

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.clinical.angle_table import angle_table
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.plan.identifiability import Information, Weakness, information
from rtof_kin.plan.prediction import CalibrationTime, Prediction, calibration_time, predict
from rtof_kin.plan.protocol import Protocol
from rtof_kin.plan.setup import Setup, liveliest, seen_share
from rtof_kin.reconstruction.lift import LifterLike
from rtof_kin.reporting.angle_names import XZY, angle_name

Progress = Callable[[str, int, int], None]  #: Called with (stage, steps done, steps in all)
SEEN: Final = 0.95  #: Least share of the joints in the image that a place of the camera needs
_SEARCHED: Final = 8.0  #: [s] of the movement that cameras and further sensors are compared on
_UNOBSERVED: Final = np.radians(30.0)  #: [rad] counted for an unobserved angle in comparisons


@dataclass(frozen=True)
class Option:
    """Another camera place or one more sensor, compared on a part of the movement."""

    name: str  #: In words
    loss: float  #: [rad] mean standard deviation of the angles that matter, NaN where it is not possible
    gain: float  #: [rad] by which it is below that of the plan
    most: str = ""  #: Angle that gains most
    problem: str = ""  #: Why it is not possible; empty where it is


@dataclass(frozen=True)
class Plan:
    """What to expect of a recording."""

    protocol: Protocol
    setup: Setup
    prediction: Prediction  #: Of all clinical angles
    shown: tuple[str, ...]  #: Angles that matter: those wanted, else all in one convention that the model does not fix
    weaknesses: tuple[Weakness, ...]  #: Of these
    cameras: tuple[Option, ...]  #: Best first
    sensors: tuple[Option, ...]  #: Best first
    calibration: CalibrationTime | None  #: None without sensors
    seen: float  #: Share of the joints in the image

    @property
    def unreached(self) -> tuple[str, ...]:
        """Angles that miss the standard deviation wanted, unobserved ones among them."""
        wanted = self.protocol.wanted_sd_deg
        if wanted is None:
            return ()
        own = self.prediction.select(self.shown)
        return tuple(n for n, sd in zip(own.names, own.sigma, strict=True) if not sd <= np.radians(wanted))


def plan(
    protocol: Protocol,
    setup: Setup,
    *,
    draws: int = 3,
    seed: int = 0,
    lifter: LifterLike | None = None,
    search: bool = True,
    workers: int | None = None,
    progress: Progress | None = None,
) -> Plan:
    """Predict the errors of a recording, and compare other cameras and further sensors. `InvalidInputError`: the
    movement cannot be recorded so, for example because the person is not in view.

    Args:
        protocol, setup: what is to be recorded, see `planned`.
        draws: simulated recordings of the plan itself, each of another person with other errors. seed: of the first.
        lifter: as for `reconstruct`.
        search: compare cameras and sensors, and lengths for the calibration; else only the prediction.
        workers: processes, one per core if None.
    """
    report = progress or (lambda stage, done, total: None)
    part = replace(setup, poses=liveliest(setup.poses, _SEARCHED))
    places = _cameras(protocol, setup, part) if search else {}
    with_sensor = _sensors(protocol, part) if search else {}
    steps = {"cameras": 2 * len(places), "predict": draws, "sensors": 2 * len(with_sensor)}
    for stage, total in steps.items():
        if total:
            report(stage, 0, total)  # a bar for all that is to be done
    compare = partial(_compared, seed=seed, lifter=lifter, workers=workers)
    found = information(setup, seed, lifter)
    usual = usual_angles(setup.skeleton, found)
    shown = protocol.wanted or usual
    cameras = compare(part, places, shown=shown, progress=_staged(report, "cameras")) if places else ()
    best = cameras[0] if cameras and not cameras[0].problem else None
    if protocol.any_camera and best is not None and best.name != protocol.camera.words:
        place = next(place for place in protocol.further_cameras if place.words == best.name)
        protocol = replace(protocol, camera=place)
        setup, part = (replace(own, camera=place.camera(setup.poses)) for own in (setup, part))
        with_sensor, found = _sensors(protocol, part), information(setup, seed, lifter)
        cameras = tuple(
            replace(o, gain=best.loss - o.loss, most="" if o is best else o.most or best.most) for o in cameras
        )
    predicted = predict(
        {"plan": setup}, draws, seed, lifter=lifter, workers=workers, progress=_staged(report, "predict")
    )["plan"]
    if isinstance(predicted, str):
        raise InvalidInputError(f"plan: the simulated recording cannot be reconstructed: {predicted}")
    sensors: tuple[Option, ...] = ()
    calibration = None
    if search:
        sensors = compare(part, with_sensor, shown=shown, progress=_staged(report, "sensors"))
        if setup.sensors:
            calibration = calibration_time(
                setup, 2, seed, lifter=lifter, workers=workers, progress=_staged(report, "calibration")
            )
    seen = seen_share(setup)
    return Plan(protocol, setup, predicted, shown, found.weaknesses(shown, usual), cameras, sensors, calibration, seen)


def usual_angles(skeleton: SkeletonModel, found: Information) -> tuple[str, ...]:
    """Return the angles of one convention that the model does not fix."""
    free = {name for name, sigma in zip(found.names, found.sigma, strict=True) if np.isfinite(sigma)}
    rows = angle_table(skeleton.table).rows
    return tuple(row.name for row in rows if XZY in angle_name(row).shown.split() and row.name in free)


def _cameras(protocol: Protocol, whole: Setup, part: Setup) -> dict[str, Setup | str]:
    """Setups of a part of the movement by the place of the camera, which has to see the whole, or why a place
    is not possible.
    """
    out: dict[str, Setup | str] = {}
    for place in protocol.further_cameras:
        if place == protocol.camera:
            out[place.words] = part
            continue
        camera = place.camera(whole.poses)
        share = seen_share(replace(whole, camera=camera))
        possible = replace(part, camera=camera)
        out[place.words] = possible if share >= SEEN else f"only {100 * share:.0f} % of the body is in the image"
    return out


def _sensors(protocol: Protocol, part: Setup) -> dict[str, Setup | str]:
    """Setups with one more sensor."""
    own: dict[str, Setup | str] = {"": part}
    return own | {name: replace(part, sensors=(*part.sensors, name)) for name in protocol.further_sensors}


def _compared(
    part: Setup,
    options: Mapping[str, Setup | str],
    *,
    shown: Sequence[str],
    seed: int,
    lifter: LifterLike | None,
    workers: int | None,
    progress: Callable[[int, int, str], None],
) -> tuple[Option, ...]:
    """Options by their loss; the plan itself is the one whose setup is `part`."""
    setups = {f"option{i}": setup for i, setup in enumerate(options.values()) if isinstance(setup, Setup)}
    predicted = predict(setups, 2, seed, lifter=lifter, workers=workers, progress=progress)
    sigmas: dict[str, Array | str] = {}  # of the angles shown, or why there is none
    for i, (name, setup) in enumerate(options.items()):
        found = setup if isinstance(setup, str) else predicted[f"option{i}"]
        sigmas[name] = (
            found
            if isinstance(found, str)
            else np.nan_to_num(found.select(shown).sigma, nan=_UNOBSERVED, posinf=_UNOBSERVED)
        )
    own = next((name for name, setup in options.items() if setup is part), None)
    before, out = sigmas.get(own or ""), []
    for name, now in sigmas.items():
        if isinstance(now, str):
            out.append(Option(name, np.nan, np.nan, problem=now))
        elif name == own or before is None or isinstance(before, str):
            out.append(Option(name, float(np.mean(now)), 0.0))
        else:
            gain, most = float(np.mean(before)) - float(np.mean(now)), shown[int(np.argmax(before - now))]
            out.append(Option(name, float(np.mean(now)), gain, most))
    return tuple(sorted(out, key=lambda option: (np.isnan(option.loss), option.loss)))


def _staged(report: Progress, stage: str) -> Callable[[int, int, str], None]:
    return lambda done, total, _: report(stage, done, total)

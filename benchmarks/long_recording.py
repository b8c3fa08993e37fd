"""Makes a recording of any length from the demo, to measure memory and time.

    python -m benchmarks long_recording OUT --minutes 60

The person of the demo goes through its motion to and fro, with half a second of slowing down at either end,
before the demo's camera and with eight sensors at 60 Hz. Keypoints and sensors are exact but for noise that
never repeats: coloured and white on the pixels, slow slip and white noise on the sensors.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.random import Generator
from scipy.signal import lfilter

from rtof_kin.body import kinematics
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array
from rtof_kin.core.resources import model_path
from rtof_kin.data.imu import ImuSequence
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.recording.recording import Recording
from rtof_kin.simulation.simulate import SimulationSettings, simulate

RATE_HZ: Final = 60.0
TURN_S: Final = 1.0
"""[s] from full speed in one direction to full speed in the other."""
DRIFT_PX, WHITE_PX, DRIFT_S = 4.0, 1.0, 0.5
SLIP_DEG, SLIP_S = 3.0, 20.0
FORCE_WHITE: Final = 0.4  # [m/s^2]


def long_recording(folder: Path, minutes: float, seed: int = 0, overwrite: bool = False) -> None:
    """Write a recording of some length.

    Args:
        folder: to write. minutes: its length. seed: of the noise. overwrite: replace an earlier one.
    """
    whole, frames = _repeated(Recording.load(model_path("demo")))
    noise = _Noise(np.random.default_rng(seed), whole)
    total = round(minutes * 60 * RATE_HZ)
    parts = [noise.added(whole, start, min(frames, total - start)) for start in range(0, total, frames)]
    joined(parts).save(folder, overwrite)


def joined(parts: Sequence[Recording]) -> Recording:
    """Return recordings that follow one another as one."""
    streams = {}
    for name in ("keypoints", "imus", "truth"):
        own = [getattr(part, name) for part in parts]
        rows = [field.name for field in fields(own[0]) if np.shape(getattr(own[0], field.name))[:1] == (len(own[0]),)]
        streams[name] = replace(own[0], **{row: np.concatenate([getattr(one, row) for one in own]) for row in rows})
    return replace(parts[0], **streams)


def _repeated(demo: Recording) -> tuple[Recording, int]:
    """Return one period of the motion, exactly observed, and its number of frames."""
    poses, skeleton = demo.truth, demo.skeleton
    assert poses is not None
    assert demo.keypoints is not None
    once = _to_and_fro(float(poses.times[-1] - poses.times[0]))
    frames = len(once)
    at = poses.times[0] + np.tile(once, 3)  # the middle one has no ends
    R = signals.interpolate_rotations(poses.times, poses.R_world_bone, at)
    p_root = signals.interpolate(poses.times, poses.p_world_joint[:, 0], at)
    p_root = signals.low_pass(p_root, RATE_HZ, 10.0)
    p = kinematics.positions(skeleton.parents, demo.joint_offsets, p_root, R)
    moving = PoseSequence(np.arange(len(at)) / RATE_HZ, p, R, poses.names)
    exact = simulate(
        moving,
        demo.joint_offsets,
        camera=demo.keypoints.camera,
        seed=0,
        name="long",
        settings=SimulationSettings.noiseless(),
        acknowledgement=demo.acknowledgement,
    )
    middle = exact.between((frames - 0.5) / RATE_HZ, (2 * frames - 0.5) / RATE_HZ)
    return middle, frames


def _to_and_fro(seconds: float) -> Array:
    """Return the instants (N,), s, of a motion of some duration at the frames of one period."""
    reach = TURN_S / np.pi  # covered while turning
    steady = np.floor((seconds - 2 * reach) * RATE_HZ) / RATE_HZ
    t = np.arange(round(2 * (steady + TURN_S) * RATE_HZ)) / RATE_HZ
    bounds = np.cumsum([steady, TURN_S, steady])
    up = reach + t
    top = reach + steady + reach * np.sin(np.pi * (t - bounds[0]) / TURN_S)
    down = reach + steady - (t - bounds[1])
    bottom = reach - reach * np.sin(np.pi * (t - bounds[2]) / TURN_S)
    return np.select([t < bounds[0], t < bounds[1], t < bounds[2]], [up, top, down], bottom)


class _Noise:
    """Noise that goes on from one period to the next."""

    def __init__(self, rng: Generator, exact: Recording):
        assert exact.imus is not None
        self._rng = rng
        L, S = len(exact.video.names), len(exact.imus.names)
        self._drift = _Coloured(rng, (L, 2), DRIFT_S)
        self._slip = _Coloured(rng, (S, 3), SLIP_S)

    def added(self, exact: Recording, start: int, count: int) -> Recording:
        """Return a number of the period's frames from some frame of the recording on, with noise."""
        seen, imus, truth = exact.video, exact.imus, exact.truth
        assert imus is not None
        assert truth is not None
        times, rng = (start + np.arange(count)) / RATE_HZ, self._rng
        uv = seen.uv_px[:count] + DRIFT_PX * self._drift.next(count)
        uv += WHITE_PX * rng.standard_normal(uv.shape)
        confidence = np.clip(0.8 + 0.1 * rng.standard_normal(uv.shape[:2]), 0.05, 1)
        slip = so3.exp(np.radians(SLIP_DEG) * self._slip.next(count))
        f = imus.f_sensor[:count] + FORCE_WHITE * rng.standard_normal((count, len(imus.names), 3))
        return Recording(
            name=exact.name,
            keypoints=KeypointSequence(seen.camera, times, uv, confidence, seen.names),
            imus=ImuSequence(times, imus.R_inertial_sensor[:count] @ slip, f, imus.names, unit_checked=True),
            calibration=exact.calibration,
            joint_offsets=exact.joint_offsets,
            truth=PoseSequence(times, truth.p_world_joint[:count], truth.R_world_bone[:count], truth.names),
            acknowledgement=exact.acknowledgement,
        )


class _Coloured:
    """Ornstein-Uhlenbeck noise of unit variance, which goes on."""

    def __init__(self, rng: Generator, size: tuple[int, ...], memory_s: float):
        self._rng, self._share = rng, float(np.exp(-1 / (memory_s * RATE_HZ)))
        self._state = rng.standard_normal((1, *size))

    def next(self, count: int) -> Array:
        """Return the next samples (count, *size)."""
        kicks = np.sqrt(1 - self._share**2) * self._rng.standard_normal((count, *self._state.shape[1:]))
        out, _ = lfilter([1.0], [1.0, -self._share], kicks, axis=0, zi=self._share * self._state)
        self._state = out[-1:]
        return np.asarray(out)


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("output", type=Path, help="folder to write")
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--overwrite", action="store_true")
    options = parser.parse_args()
    long_recording(options.output, options.minutes, options.seed, options.overwrite)
    print(f"wrote {options.output}")


if __name__ == "__main__":
    main()

"""Calibration that goes on during a session; see `rtof_kin.calibration.sequential`.

Frames that leave the estimator's window are collected, as measured, without what was corrected. About once a
second those of the last second are given to the sequential calibration, which works in slices, one at each
frame. What it finds is applied to new samples with a limited speed.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from rtof_kin.calibration.priors import CalibrationPriors
from rtof_kin.calibration.residuals import CalibrationObservations
from rtof_kin.calibration.result import SelfCalibration
from rtof_kin.calibration.sequential import DELAY_ALONE, Corrections, SequentialCalibration, WindowObservations
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import SolverError, UnknownNameError
from rtof_kin.live.sensor_buffer import SensorBuffer
from rtof_kin.live.window import Window

_FRAMES: Final = 50  # Frames of a window of the calibration
_SETTLED: Final = 30  # Frames after a beginning that are not used
_OPEN: Final = {
    "delay": {"sigma_delay": 0.05},
    "heading": {"sigma_heading": np.radians(8.0)},
    "mounting": {"sigma_swing": np.radians(4.0), "sigma_twist": np.radians(5.0)},
}
"""Kind -> standard deviations before."""


def refinement_priors(kinds: Sequence[str]) -> CalibrationPriors | None:
    """Return the priors of what is refined during a session; None for nothing. `UnknownNameError`: there is no such
    kind.
    """
    if unknown := sorted({*kinds} - {*_OPEN}):
        raise UnknownNameError("kind of calibration", unknown, tuple(_OPEN))
    if not kinds:
        return None
    values = {name: value for kind in kinds for name, value in _OPEN[kind].items()}
    return replace(DELAY_ALONE, **({"sigma_delay": None} | values))


class Refinement:
    """Collects frames, calibrates by them, and says what to correct.

    Attributes:
        calibration: the estimate. corrections: to be applied now.
    """

    def __init__(
        self, window: Window, sensors: SensorBuffer, priors: CalibrationPriors, start: SelfCalibration | None = None
    ) -> None:
        """Begin. `sensors`: their samples, which are evaluated without corrections. `CalibrationError`: nothing is
        open.
        """
        self._window, self._sensors = window, sensors
        self._settings, self._rate_hz = window.data.settings, window.rate_hz
        self.calibration = SequentialCalibration(window.data.energy(_FRAMES), self._settings, priors, start)
        self.corrections = self.calibration.corrections(np.inf)
        smoother = window.smoother
        self._rows = {name: np.repeat(v[:1], _FRAMES, axis=0) for name, v in smoother.rows.items()}
        self._x = np.repeat(smoother.x[:1], _FRAMES, axis=0)
        self._times = np.zeros(_FRAMES)
        self._count = 0
        self._work: Generator[None, None, None] | None = None

    def step(self, time: float) -> Corrections:
        """Take the frame that leaves the window next, go on with the calibration, return the corrections.

        `time`: stamp of the frame on the uncorrected clock of the video, s.
        """
        smoother = self._window.smoother
        if smoother.inside[0]:
            rows = smoother.weighted_first()
            for name, values in self._rows.items():
                values[:-1] = values[1:]
                values[-1] = rows[name]
            for array, value in ((self._x, smoother.x[0]), (self._times, time)):
                array[:-1] = array[1:]
                array[-1] = value
            self._count += 1
        else:
            self._count = 0
        if self._work is None and self._count >= _SETTLED + _FRAMES:
            self._count = _SETTLED
            self._work = self._update()
        if self._work is not None:
            try:
                next(self._work)
            except (StopIteration, SolverError):
                self._work = None
        self.corrections = self.calibration.corrections(1 / self._rate_hz)
        return self.corrections

    def _update(self) -> Generator[None, None, None]:
        times = self._times.copy()
        q, w, a, w_a = self._sampled(times)
        yield
        rows = {name: values.copy() for name, values in self._rows.items()}
        rows |= {"quat_sensor": q, "w_sensor": w * float(np.max(self._rows["w_sensor"], initial=0.0) or 1.0)}
        constant = self._window.data.constant
        given = CalibrationObservations(times, rows, constant, a, w_a)
        yield from self.calibration.update(WindowObservations(given, self._x.copy(), self._sampled))

    def _sampled(self, times: Array) -> tuple[Array, Array, Array, Array]:
        """Sensors as measured; see `unknowns.Sampled`."""
        q, known, a, moved = self._sensors.at(times, corrected=False)
        own = self._window.order
        weight = moved[:, own] / self._settings.sigma_acceleration**2
        return q[:, own], known[:, own].astype(float), a[:, own], weight

"""Settings of the online estimator."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from rtof_kin.core.errors import InvalidInputError
from rtof_kin.solve.settings import JointSpaceSettings

if TYPE_CHECKING:
    from rtof_kin.calibration.priors import CalibrationPriors

_LONGEST_LAG_S: Final = 1.0
_LEAST_FRAMES: Final = 8  # of a window
_BEYOND_LAG: Final = 4  # frames of the window before the returned one
_SOLVED_S: Final = 0.35  # [s] of the newest frames, which are solved again at every step


@dataclass(frozen=True)
class OnlineSettings:
    """Settings of the online estimator."""

    rate_hz: float = 60.0
    """[Hz] Frames of the estimate; usually the rate of the video."""
    lag_s: float = 0.0
    """[s] Age of the returned poses, 0 to 1: the older, the more accurate."""
    window_s: float | None = None
    """[s] Length of the frames that are optimised. None: 8 frames, more for the lag and a late video."""
    video_delay_s: float = 0.0
    """[s] By how much the stamps of the video are late against the clock of the sensors."""
    video_latency_s: float = 0.0
    """[s] Greatest usual age of an image when it arrives: the window covers it."""
    confidence: bool = False
    """Whether to compute the covariance of every returned pose."""
    refined: CalibrationPriors | None = None
    """What is calibrated while the person moves, with its prior: delay, headings, mountings. None: nothing."""
    solver: JointSpaceSettings = field(
        default_factory=lambda: JointSpaceSettings(torso_inflation=1.4, robust_reprojection=1.2)
    )
    """Standard deviations of the residuals; the floor is that of the recording where none is given.
    Without the frames to come the lift of the torso counts more, and outliers of landmarks less."""

    def __post_init__(self) -> None:
        if not 5 <= self.rate_hz <= 500:
            raise InvalidInputError(f"rate_hz: {self.rate_hz:g} frames per second; give 5 to 500")
        if not 0 <= self.lag_s <= _LONGEST_LAG_S:
            raise InvalidInputError(f"lag_s: {self.lag_s:g} s is outside 0 to {_LONGEST_LAG_S:g} s")

    @property
    def lag_frames(self) -> int:
        """The lag in frames."""
        return round(self.lag_s * self.rate_hz)

    @property
    def frames(self) -> int:
        """N of the window."""
        return max(_LEAST_FRAMES, self.lag_frames + 1 + _BEYOND_LAG, self._asked)

    @property
    def solved(self) -> int:
        """How many of the newest frames of the window are solved; see `FixedLagSmoother`."""
        return min(self.frames, max(_LEAST_FRAMES, round(_SOLVED_S * self.rate_hz), self._asked))

    @property
    def _asked(self) -> int:
        """Frames that a late video or the setting asks for."""
        late = round((self.video_latency_s + self.video_delay_s) * self.rate_hz) + 1 + _BEYOND_LAG
        return max(late, 0 if self.window_s is None else round(self.window_s * self.rate_hz))

"""The estimator that is measured, and its settings."""

from __future__ import annotations

from typing import Any

from rtof_kin.recording.recording import Recording


def estimator(setup: Recording, landmarks: tuple[str, ...], own: Any) -> Any:
    """The online estimator."""
    from rtof_kin.live.estimator import OnlineEstimator

    return OnlineEstimator(setup, landmarks, own)


def settings(**changed: Any) -> Any:
    """Its default settings, but for some."""
    from rtof_kin.live.online_settings import OnlineSettings

    return OnlineSettings(**changed)

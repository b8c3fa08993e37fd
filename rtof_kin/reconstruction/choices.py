"""What was chosen for a reconstruction: space, solver, energy, lifter, calibration, threads."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any, Self

from rtof_kin.calibration.priors import CalibrationPriors
from rtof_kin.calibration.result import SelfCalibration
from rtof_kin.core.threads import threads
from rtof_kin.reconstruction.prepare import LifterLike, ReconstructionSettings
from rtof_kin.solve.cartesian.settings import CartesianSettings
from rtof_kin.solve.joint_space.settings import JointSpaceSettings

_BESIDE_THE_ENERGY = ("backend", "compile", "floor_height", "ankle_height", "tolerance", "max_iterations")
"""Fields of settings that a recording or a computer may differ in with the same energy."""


@dataclass(frozen=True)
class Choices:
    """How a reconstruction was made."""

    calibrate: str = "no"
    """'yes': from the recording itself; 'given': what it said before; 'no'."""
    known: bool = False
    """Whether something was known of another recording of the same person."""
    lifter: str | None = None
    """Name or file of what lifted the keypoints."""
    settings: ReconstructionSettings | None = None
    """As they were used; of the fragment solver in the modes that optimise."""

    @classmethod
    def of(
        cls, calibrate: bool | CalibrationPriors | SelfCalibration, known: SelfCalibration | None,
        lifter: LifterLike | None,
    ) -> Self:  # fmt: skip
        """What `reconstruct` was asked for, as it names its arguments."""
        how = "given" if isinstance(calibrate, SelfCalibration) else "no" if calibrate is False else "yes"
        name = "detections" if lifter is None else getattr(lifter, "name", type(lifter).__name__)
        return cls(how, known is not None, name)

    def with_settings(self, settings: ReconstructionSettings, mode: str) -> Self:
        """The same with the settings that a mode used."""
        unused = mode in ("lift", "sf2")
        return replace(self, settings=settings.with_fragment(None) if unused else settings)

    def plain(self) -> dict[str, Any]:
        """As JSON has them; null is what was not used."""
        s = self.settings or ReconstructionSettings()
        fragment = s.fragment
        space = {JointSpaceSettings: "joint", CartesianSettings: "cartesian"}.get(type(fragment))
        return {
            "space": space,
            "backend": None if fragment is None else fragment.backend,
            "energy": None if fragment is None else energy_name(fragment),
            "frames": None if fragment is None else s.frames,
            "guard_streams": s.guard_streams,
            "lift_with_sensors": s.lift_with_sensors,
            "lifter": self.lifter,
            "calibrate": self.calibrate,
            "known_of_another_recording": self.known,
            "threads": threads(),
            "fragment": None if fragment is None else asdict(fragment),
        }


def energy_name(settings: JointSpaceSettings | CartesianSettings) -> str:
    """'default', 'default, calibrated', 'as printed' or 'own', by the settings that make an energy."""
    usual: dict[str, JointSpaceSettings | CartesianSettings] = {
        "default": type(settings)(),
        "default, calibrated": JointSpaceSettings.calibrated(),
        "as printed": CartesianSettings.paper(),
    }
    for name, other in usual.items():
        if _energy(other) == _energy(settings):
            return name
    return "own"


def _energy(settings: JointSpaceSettings | CartesianSettings) -> dict[str, Any]:
    return {name: v for name, v in vars(settings).items() if name not in _BESIDE_THE_ENERGY}

"""Solver options of every command that reconstructs."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from rtof_kin.core.choices import GUARDS, SPACES, Space
from rtof_kin.core.environment import USUAL, limit_threads
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.solve.settings import CartesianSettings

if TYPE_CHECKING:
    from rtof_kin.reconstruction.settings import ReconstructionSettings


def add_solver_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options that `settings_of` and `use_threads` read."""
    group = parser.add_argument_group("solver")
    group.add_argument("--frames", type=int, default=50, metavar="N", help="frames in a fragment")
    group.add_argument(
        "--space",
        choices=SPACES,
        help="variables: configurations of the skeleton, or joint positions (the paper's); default: joint, "
        "where a pose prior is shipped for the skeleton",
    )
    group.add_argument(
        "--backend",
        choices=["realtime", "ipopt"],
        help="solver of the energy; default: realtime in joint space, ipopt in cartesian. Calibration "
        "has its own solver",
    )
    group.add_argument("--paper", action="store_true", help="the energy as printed, in cartesian space")
    group.add_argument(
        "--guards",
        default=GUARDS,
        type=lambda text: tuple(text.split(",")),
        metavar=",".join(GUARDS),
        help="which outliers of keypoints and sensors are rejected; default: all of these",
    )
    group.add_argument(
        "--no-guards",
        dest="guards",
        action="store_const",
        const=(),
        help="use keypoints and sensors as given, without outlier rejection",
    )
    group.add_argument(
        "--no-lift-with-sensors", dest="lift_with_sensors", action="store_false", help="lift from the image only"
    )
    group.add_argument(
        "--threads",
        type=int,
        metavar="N",
        help="threads of numerical libraries (BLAS, OpenMP, torch); more than a few gain nothing, since "
        f"matrices are small; default: OMP_NUM_THREADS, else {USUAL}",
    )


def use_threads(options: argparse.Namespace) -> None:
    """Limit the threads of numerical libraries, before the first of them is loaded.

    Args:
        options: parsed; `threads` may be None.
    """
    limit_threads(options.threads)


def settings_of(options: argparse.Namespace, mode: str = "rtof") -> ReconstructionSettings:
    """Return the settings that the options choose.

    Raises:
        InvalidInputError: options contradict each other.
    """
    from rtof_kin.reconstruction.settings import ReconstructionSettings

    if options.paper and options.space == "joint":
        raise InvalidInputError("--paper is an energy in cartesian space; leave out --space joint, or --paper")
    space: Space | None = "cartesian" if options.paper else options.space
    if mode in ("lift", "sf2") and (space or options.backend):
        raise InvalidInputError(f"mode {mode} optimises nothing; leave out --space, --backend and --paper")
    if space == "cartesian":
        named = "--paper" if options.paper else "--space cartesian"
        if mode == "imu":
            raise InvalidInputError(f"mode imu is solved in joint space; leave out {named}")
        if mode == "calibrate":
            raise InvalidInputError(f"calibration is solved in joint space; leave out {named}")
    settings = ReconstructionSettings(
        frames=options.frames,
        space=space,
        backend=options.backend,
        guards=options.guards,
        lift_with_sensors=options.lift_with_sensors,
    )
    if not options.paper:
        return settings
    return settings.with_fragment(CartesianSettings.paper(options.backend or "ipopt"))

"""Names that settings choose from, as types."""

from __future__ import annotations

from typing import Final, Literal, get_args

Mode = Literal["lift", "sf2", "rto", "rtof", "imu"]
"""lift: network only. sf2: lift corrected by IMUs frame by frame. rto: optimisation on video only.
rtof: SF2, then optimisation on video and IMUs. imu: sensors only, without a camera."""
Space = Literal["joint", "cartesian"]
"""Variables of the fragment solver: configurations of the skeleton, or joint positions."""
Calibrate = Literal["yes", "given", "no"]
"""'yes': from the recording itself. 'given': an earlier calibration of it was applied."""
Guard = Literal["sides", "person", "samples", "motion"]
"""What is rejected. sides: keypoints with left and right exchanged. person: keypoints of another person.
samples: stuck and saturated samples of sensors. motion: sensors that contradict the solved motion."""
Repeated = Literal["squat", "sit_to_stand"]  #: Movement that is counted
Provider = Literal["cpu", "cuda", "coreml", "openvino"]  #: What runs the .onnx models of a detector
Compile = Literal["auto", "never"]
"""auto: compile the energy to machine code if a C compiler exists. never: interpret it."""

MODES: Final[tuple[Mode, ...]] = get_args(Mode)
CAMERA_MODES: Final[tuple[Mode, ...]] = MODES[:-1]
SPACES: Final[tuple[Space, ...]] = get_args(Space)
GUARDS: Final[tuple[Guard, ...]] = get_args(Guard)
MARKERS: Final = "markers"  #: In place of a mode: a motion of optical markers

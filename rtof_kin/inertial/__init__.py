"""Inertial sensors: physics checks of files, orientation, calibration by a pose, contacts, root path.

`physics` checks a `SensorLog` by the `laws`; `orientation` estimates what a file
lacks; `pose_calibration` makes an `ImuCalibration` and `setup_diagnosis` tests it, both by the
`MotionLikelihood`; `contacts`, `root_path` and `initial_poses` are motion from sensors alone.
"""

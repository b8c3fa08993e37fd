"""Inertial sensors as people have them: what files declare, checks by physics, calibration by pose.

Data flows from a file (`rtof_kin.io`, one reader per format) through its `Declaration` into a
`SensorLog` of `SensorStream`s in SI units; checks look at these, never at what the file claims;
`SensorLog.imus` hands them to a recording.
"""

"""Inertial sensors as people have them: what files declare, checks by physics, calibration by pose.

Data flows from a file (recognised by `files`, read in `rtof_kin.formats` by one reader per format, with the
arithmetic of `packets`) as `Readings`, through its `Declaration`, into a `SensorLog` of `SensorStream`s
in SI units; `orientation` adds what a file lacks; checks look at these, never at what the file claims;
`SensorLog.imus` hands them to a recording.

`pose_calibration` and `functional` make an `ImuCalibration` of a log: from a pose (`poses`) held still
(`stillness`), from axes of movement (`axes`), with headings that movement tells (`headings`). `mounting`
says what is wrong with one (`faults`). Headings and faults are judged by the same `evidence`: how well
what sensors measure of segments (`segment_motion`) agrees with how people move (`free_motion`).
"""

"""Self-calibration: delay, sensor mounting, bone lengths and landmark offsets from the motion itself."""

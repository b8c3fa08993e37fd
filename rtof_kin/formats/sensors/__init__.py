"""One reader for each file format of inertial sensors."""

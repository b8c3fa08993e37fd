"""Inertial sensors: physics checks of files, orientation, calibration by a pose, contacts, root path."""

"""Pose optimisation: SF2, residuals, and the fragment solver in joint and Cartesian space."""

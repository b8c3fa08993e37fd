"""Errors, checks, rotations, signals and resources that every other folder uses."""

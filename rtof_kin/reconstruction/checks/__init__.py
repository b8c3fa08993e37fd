"""Checks of what a recording declares, by its samples, its image and the motion."""

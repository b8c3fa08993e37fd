"""Trials of optical laboratories: markers on the skin as motion of the skeleton."""

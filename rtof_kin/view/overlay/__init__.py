"""The skeleton, angles and provenance of a motion drawn on its video, or on a plain background."""

"""Plan of a recording before it is made: expected errors, what is not identifiable, camera and sensors."""

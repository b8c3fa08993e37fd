"""2D detectors: their files, layouts and people; their points turned into the skeleton's landmarks.

`rtof_kin.vision.keypoints.read_detector_keypoints` does all of it; each step has a module.
"""

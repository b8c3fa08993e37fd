"""Recordings made from motion capture: virtual cameras, detectors and sensors."""

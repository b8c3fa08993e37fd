"""Accuracy of lifters by camera placement and motion, and calibration of their uncertainties."""

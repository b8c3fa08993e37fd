"""Sensor study: accuracy of every joint angle with subsets of the sensors."""

"""Prediction of the accuracy of a recording before it is made: movements, set-up, operator's page."""

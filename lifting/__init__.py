"""Lifting of 2D landmarks to 3D poses with a temporal convolution network.

Arrays are float32 inside it. `predict.Lifter` is the way in for users and needs NumPy alone; `training.train.train`
makes a new lifter from motion capture, with torch.
"""

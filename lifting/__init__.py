"""Lifting of 2D landmarks to 3D poses with a temporal convolution network (torch).

Only this package imports torch; arrays are float32 inside it. `predict.Lifter` is the way in for users,
`training.train.train` makes a new lifter from motion capture.

Importing it without torch raises `MissingPackageError`, which says what to install.
"""

from rtof_kin.core.packages import optional

optional("torch", "lift", "the lifter, which takes keypoints to 3D,")

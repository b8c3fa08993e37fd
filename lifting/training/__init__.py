"""Training of lifters: motion, simulated detections and sensors, losses and the loop; not imported by inference.

Importing it without torch raises `MissingPackageError`, which says what to install.
"""

from rtof_kin.core.packages import optional

optional("torch", "train", "training a lifter")

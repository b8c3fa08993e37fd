"""The skeleton: its table, URDF, kinematics, pose prior, motions and error metrics."""

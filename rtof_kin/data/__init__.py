"""The arrays that travel through the package: camera, keypoints, IMUs, poses and their confidence."""

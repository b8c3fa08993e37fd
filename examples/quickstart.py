"""Reconstruction of a recording in a few lines: ``python examples/quickstart.py [FOLDER] [OUT]``."""

import sys

from rtof_kin import FragmentSolver, Recording, SkeletonModel, export, reconstruct
from rtof_kin.core.resources import model_path
from rtof_kin.solve.initial_guess import InertialGuidedIK

folder = sys.argv[1] if len(sys.argv) > 1 else model_path("demo")
out = sys.argv[2] if len(sys.argv) > 2 else "out/quickstart"

recording = Recording.load(folder)
skeleton = SkeletonModel.default().with_offsets(recording.joint_offsets)
result = reconstruct(recording, skeleton, mode="rtof")  # with the shipped lifter
if result.metrics is not None:  # None without truth
    print(f"root-relative error: {result.metrics['mpjpe_rr_mm']:.1f} mm")
print("configurations:", result.motion.q.shape)
export(result, out, overwrite=True)

# or stage by stage:
sf2 = InertialGuidedIK(skeleton).refine(result.stages["lift"], result.bone_imus)
solution = FragmentSolver(skeleton, frames=50).solve(sf2, result.keypoints, result.bone_imus)
print(solution.status, solution.energy, solution.poses.p_world_joint.shape)

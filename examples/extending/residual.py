"""Terms of one's own in the energy: ``python examples/extending/residual.py``.

A radio ranging anchor (UWB) at a known location measures its distance to a tag on the pelvis. One camera hardly sees
how far away the person is; the distance tells. One second of the demo is solved from a start that is 30 cm too far
away, without and with the distances. An inclinometer on the chest is a term of another kind.
"""

from dataclasses import dataclass, replace
from functools import partial

import casadi as ca
import numpy as np

from rtof_kin import FragmentSolver, Recording
from rtof_kin.core.resources import model_path
from rtof_kin.solve.joint_space.energy import Frame
from rtof_kin.solve.settings import CartesianSettings, JointSpaceSettings
from rtof_kin.solve.terms import ObservedTerm, PointData, PointTerm, pseudo_huber_loss, quat_matrix

FRAMES = 60


# [residual]
def to_anchor(p_world, observed):
    """Distance to an anchor minus the measured one, m: (3, 1) position; anchor's x, y, z and the distance."""
    return ca.norm_2(p_world - observed[:3]) - observed[3]


RANGE = PointTerm("anchor", "Hips", to_anchor, size=4, robust=2.0)
# [end]


# [term]
@dataclass(frozen=True)
class Inclination(ObservedTerm):
    """The vertical in a segment's axes minus that of an inclinometer on it."""

    joint: str
    size: int = 3
    unit = "1"

    def add(self, frame: Frame) -> None:
        """Add the residual of a frame: a function of a small rotation of the segment."""
        (segment,) = frame.index(self.joint)
        residual = partial(to_vertical, frame, segment, frame.O[self.observed])
        frame.turn(self, segment, residual, frame.O[self.weight], pseudo_huber_loss(3.0))


def to_vertical(frame: Frame, segment: int, observed, rotation):
    """Vertical in the axes of the turned segment minus the measured one (3, 1)."""
    return quat_matrix(frame.turned(segment, rotation))[2, :].T - observed


TILT = Inclination("tilt", "Spine3")
# [end]


def jacobian_error(term: PointTerm, p_world: np.ndarray, observed: np.ndarray, step: float = 1e-6) -> float:
    """Largest difference of CasADi's Jacobian of a residual from central differences."""
    p = ca.SX.sym("p", 3)
    r = ca.Function("r", [p], [term.residual(p, ca.DM(observed))])
    J = np.array(ca.Function("J", [p], [ca.jacobian(r(p), p)])(p_world))
    differences = [np.array(r(p_world + d) - r(p_world - d)) / (2 * step) for d in step * np.eye(3)]
    return float(np.abs(J - np.hstack(differences)).max())


def main() -> None:
    """Check the Jacobian, then solve in both spaces."""
    recording = Recording.load(model_path("demo"))
    skeleton, truth = recording.skeleton, recording.truth[:FRAMES]
    keypoints = recording.keypoints[:FRAMES]
    anchor, rng = np.array([3.0, -2.0, 2.2]), np.random.default_rng(0)
    distances = np.linalg.norm(truth.p_world_joint[:, 0] - anchor, axis=1) + 0.05 * rng.normal(size=FRAMES)
    distances[20:30] = np.nan  # out of sight
    values = np.column_stack([np.tile(anchor, (FRAMES, 1)), distances])
    error = jacobian_error(RANGE, truth.p_world_joint[0, 0], values[0])
    print(f"Jacobian: {error:.0e} from central differences")

    away = 0.3 * keypoints.camera.R_camera_world[2]
    start = replace(truth, p_world_joint=truth.p_world_joint + away)
    for settings in (JointSpaceSettings(), CartesianSettings()):
        solver = FragmentSolver(skeleton, frames=20, settings=settings, terms=[RANGE])
        for observed in ({}, {"anchor": PointData(values, sigma=0.05)}):
            solution = solver.solve(start, keypoints, observed=observed)
            off = np.linalg.norm(solution.poses.p_world_joint[:, 0] - truth.p_world_joint[:, 0], axis=1)
            name = f"{solver.space}, {'with' if observed else 'without'} distances"
            print(f"{name}: root {1000 * off.mean():.0f} mm off, {solution.energy['anchor']:.2f} of the energy")


if __name__ == "__main__":
    main()

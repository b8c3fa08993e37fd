"""Many independent jobs: engines that run them, their results in a folder, memory, and locks of a folder."""

from rtof_kin.core.jobs.engine import Ended, Engine, InThisProcess, RayCluster
from rtof_kin.core.jobs.processes import Processes, Workers, in_order, is_shared, side_by_side, work_shared
from rtof_kin.core.jobs.results import JobResult, Outcome, Progress, open_runs, run_jobs

__all__ = ["Ended", "Engine", "InThisProcess", "JobResult", "Outcome", "Processes", "Progress", "RayCluster"]
__all__ += ["Workers", "in_order", "is_shared", "open_runs", "run_jobs", "side_by_side", "work_shared"]

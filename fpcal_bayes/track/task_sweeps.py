"""Sweeps made where the tasks are: each joint over its range, the others as they stand at a point of a task.

A sweep elsewhere tells of a task only through the model of what lies between; a sweep at the task itself does so
whatever has moved. After a knock the aligned pose may be turned by degrees against the pose at joint vector zero.
"""

import numpy as np
from numpy.typing import NDArray

from fpcal_bayes.infer.planning.candidates import can_be_followed, visible_ranges
from fpcal_bayes.infer.planning.limits import SweepLimits
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.model.cavity import CavityModel

Floats = NDArray[np.float64]


def task_sweeps(model: CavityModel, values: Floats, poses: Floats) -> Sweeps:
    """Sweeps of one joint through points of tasks, as a plan.

    Parameters
    ----------
    model, values
        Where visibility is judged: free parameters, shape (n_free,), in um and rad.
    poses
        Joint vectors, shape (n_poses, n_joints), in um and rad.

    Returns
    -------
    Sweeps
        At most n_poses * n_joints rows, labelled by their joint; those that lose the fringes are left out.

    Raises
    ------
    InputError
        If the mirror is out of sight with all joints at zero.
    """
    limits = SweepLimits()
    low, high = visible_ranges(model, values, limits)
    n_poses, n_joints = poses.shape
    start = np.repeat(np.clip(poses, low, high), n_joints, axis=0)
    end = start.copy()
    rows, joint = np.arange(len(start)), np.tile(np.arange(n_joints), n_poses)
    start[rows, joint], end[rows, joint] = low[joint], high[joint]
    good = (high > low)[joint] & can_be_followed(model, values, start, end, limits)
    labels = [f"q{j + 1}" for j in joint[good]]
    return Sweeps.make(start[good], end[good], label=labels, file="task sweeps")

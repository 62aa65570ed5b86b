"""What a plan leaves undetermined of the tasks it serves, in words."""

import numpy as np

from fpcal_bayes.infer.planning.design import covariance_root
from fpcal_bayes.infer.planning.ground import Ground
from fpcal_bayes.measure.sweeps import Sweeps

#: A task is left undetermined if more than this share of its standard deviation is left.
LEFT_SHARE = 0.1
_NAMED = 3


def shortfalls(ground: Ground, sweeps: Sweeps, *, readings: int = 2, sigma: float = 0.005) -> list[str]:
    """A sentence for each task that the sweeps leave undetermined, with the parameters that make it so."""
    design = ground.design(sweeps, readings=readings, sigma=sigma)
    before, after = design.expected_variance(()), design.expected_variance(range(len(sweeps)))
    variance, roots = design.task_variance(range(len(sweeps))), design.roots(range(len(sweeps)))
    own = np.sqrt(np.diag(ground.covariance))
    safe = np.where(own > 0, own, 1.0)
    sentences = []
    for task, name in enumerate(design.names):
        if after[task] <= LEFT_SHARE**2 * before[task]:
            continue
        of_task = np.flatnonzero(design.task_of_point == task)
        draw, place = np.unravel_index(np.argmax(variance[:, of_task]), (len(variance), len(of_task)))
        # The way the parameters move when the error at this point is one standard deviation.
        point = design.tasks[draw, of_task[place]] @ roots[draw]
        direction = (covariance_root(ground.covariance) @ (roots[draw] @ point)) / safe / np.linalg.norm(point)
        names = [ground.model.free.names[i] for i in np.argsort(-np.abs(direction), kind="stable")[:_NAMED]]
        plural = "s leave" if len(sweeps) > 1 else " leaves"
        sentences.append(
            f"{len(sweeps)} sweep{plural} task {name} undetermined: {1e3 * np.sqrt(after[task]):.3g} nm expected, "
            f"{1e3 * np.sqrt(before[task]):.3g} nm before; what is missing moves {', '.join(names)}"
        )
    return sentences

"""Inference on a machine with error motions."""

from fpcal_bayes.infer.mechanics.fit import MechanicsDraws, MechanicsFit, fit_mechanics
from fpcal_bayes.infer.mechanics.scales import ScalePosterior
from fpcal_bayes.infer.mechanics.task import PATH_POINTS, MechanicsTaskErrors, mechanics_task_errors

__all__ = [
    "PATH_POINTS",
    "MechanicsDraws",
    "MechanicsFit",
    "MechanicsTaskErrors",
    "ScalePosterior",
    "fit_mechanics",
    "mechanics_task_errors",
]

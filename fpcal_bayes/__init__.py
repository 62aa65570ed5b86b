"""Bayesian calibration of micro- and nano-positioning robots from one-dimensional Fabry-Perot measurements.

The names of the whole workflow stand here; each is loaded when it is first used.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from fpcal_bayes.control.controller import Controller
    from fpcal_bayes.control.tasks import TASKS, find_task
    from fpcal_bayes.errors import InputError
    from fpcal_bayes.infer.identify import identify
    from fpcal_bayes.infer.observe import observe
    from fpcal_bayes.infer.posterior.sample import sample
    from fpcal_bayes.infer.task_prediction import predict_from_covariance
    from fpcal_bayes.measure.campaign import Campaign, read_campaign, write_campaign
    from fpcal_bayes.measure.protocol import paper_protocol
    from fpcal_bayes.measure.rig import simulate
    from fpcal_bayes.measure.sweep_files import read_sweeps, write_sweeps
    from fpcal_bayes.measure.sweeps import Sweeps
    from fpcal_bayes.measure.truth import paper_truth, read_truth
    from fpcal_bayes.model.cell import Cell, load_cell
    from fpcal_bayes.model.estimate import Estimate, read_estimate
    from fpcal_bayes.report.campaign_page import write_campaign_report
    from fpcal_bayes.track.decision import Costs
    from fpcal_bayes.track.horizon import Goal
    from fpcal_bayes.track.policy import decide_track
    from fpcal_bayes.track.tracker import track as follow

#: Module and name in it of each name of the package.
_PLACES = {
    "TASKS": "control.tasks",
    "Campaign": "measure.campaign",
    "Cell": "model.cell",
    "Controller": "control.controller",
    "Costs": "track.decision",
    "Estimate": "model.estimate",
    "Goal": "track.horizon",
    "InputError": "errors",
    "Sweeps": "measure.sweeps",
    "decide_track": "track.policy",
    "find_task": "control.tasks",
    # A package is called track already.
    "follow": "track.tracker:track",
    "identify": "infer.identify",
    "load_cell": "model.cell",
    "observe": "infer.observe",
    "paper_protocol": "measure.protocol",
    "paper_truth": "measure.truth",
    "predict_from_covariance": "infer.task_prediction",
    "read_campaign": "measure.campaign",
    "read_estimate": "model.estimate",
    "read_sweeps": "measure.sweep_files",
    "read_truth": "measure.truth",
    "sample": "infer.posterior.sample",
    "simulate": "measure.rig",
    "write_campaign": "measure.campaign",
    "write_campaign_report": "report.campaign_page",
    "write_sweeps": "measure.sweep_files",
}

__all__ = [
    "TASKS",
    "Campaign",
    "Cell",
    "Controller",
    "Costs",
    "Estimate",
    "Goal",
    "InputError",
    "Sweeps",
    "decide_track",
    "find_task",
    "follow",
    "identify",
    "load_cell",
    "observe",
    "paper_protocol",
    "paper_truth",
    "predict_from_covariance",
    "read_campaign",
    "read_estimate",
    "read_sweeps",
    "read_truth",
    "sample",
    "simulate",
    "write_campaign",
    "write_campaign_report",
    "write_sweeps",
]


def __getattr__(name: str) -> Any:
    """Load a name of the workflow from its module."""
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, _, within = _PLACES[name].partition(":")
    found = getattr(import_module(f"{__name__}.{module}"), within or name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})

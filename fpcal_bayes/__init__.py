"""Bayesian calibration of micro- and nano-positioning robots from one-dimensional Fabry-Perot measurements.

The names of the whole workflow stand here; each is loaded when it is first used.
"""

from typing import TYPE_CHECKING

from fpcal_bayes.core.lazy import lazy
from fpcal_bayes.core.version import __version__ as __version__

if TYPE_CHECKING:
    from fpcal_bayes.analysis.doctor import doctor as doctor
    from fpcal_bayes.core.errors import InputError as InputError
    from fpcal_bayes.decision.decision import Costs as Costs
    from fpcal_bayes.decision.forecast import Goal as Goal
    from fpcal_bayes.decision.policy import decide_track as decide_track
    from fpcal_bayes.fringes.ingest import ingest as ingest
    from fpcal_bayes.fringes.path_check import check as check
    from fpcal_bayes.infer.design.plan import plan as plan
    from fpcal_bayes.infer.fit.identify import identify as identify
    from fpcal_bayes.infer.observability.observe import observe as observe
    from fpcal_bayes.infer.posterior.netcdf import read_posterior as read_posterior
    from fpcal_bayes.infer.posterior.sample import sample as sample
    from fpcal_bayes.infer.tasks.prediction import predict_from_covariance as predict_from_covariance
    from fpcal_bayes.io.campaign import read_campaign as read_campaign
    from fpcal_bayes.io.campaign import write_campaign as write_campaign
    from fpcal_bayes.io.cell import load_cell as load_cell
    from fpcal_bayes.io.estimate import read_estimate as read_estimate
    from fpcal_bayes.io.recordings import read_recordings as read_recordings
    from fpcal_bayes.io.sweeps import append_sweeps as append_sweeps
    from fpcal_bayes.io.sweeps import read_sweeps as read_sweeps
    from fpcal_bayes.io.sweeps import write_sweeps as write_sweeps
    from fpcal_bayes.io.traces import read_path_trace as read_path_trace
    from fpcal_bayes.io.truth import read_truth as read_truth
    from fpcal_bayes.measure.campaign import Campaign as Campaign
    from fpcal_bayes.measure.protocol import paper_protocol as paper_protocol
    from fpcal_bayes.measure.sweeps import Sweeps as Sweeps
    from fpcal_bayes.measure.sweeps import pool as pool
    from fpcal_bayes.measure.truth import paper_truth as paper_truth
    from fpcal_bayes.model.cell.cell import Cell as Cell
    from fpcal_bayes.model.estimate import Estimate as Estimate
    from fpcal_bayes.model.trust import Trust as Trust
    from fpcal_bayes.motion.controller import Controller as Controller
    from fpcal_bayes.motion.tasks import TASKS as TASKS
    from fpcal_bayes.motion.tasks import find_task as find_task
    from fpcal_bayes.report.campaign.page import write_campaign_report as write_campaign_report
    from fpcal_bayes.simulator.sweeps import simulate as simulate
    from fpcal_bayes.tracking.tracker import track as track

#: Modules, and the names of each that are the package's.
_PLACES = {
    "analysis.doctor": "doctor",
    "core.errors": "InputError",
    "decision.decision": "Costs",
    "decision.forecast": "Goal",
    "decision.policy": "decide_track",
    "fringes.ingest": "ingest",
    "fringes.path_check": "check",
    "infer.design.plan": "plan",
    "infer.fit.identify": "identify",
    "infer.observability.observe": "observe",
    "infer.posterior.netcdf": "read_posterior",
    "infer.posterior.sample": "sample",
    "infer.tasks.prediction": "predict_from_covariance",
    "infer.verification.choice": "validation_plan",
    "infer.verification.verify": "verify",
    "io.campaign": "read_campaign write_campaign",
    "io.cell": "load_cell",
    "io.estimate": "read_estimate",
    "io.recordings": "read_recordings",
    "io.sweeps": "append_sweeps read_sweeps write_sweeps",
    "io.traces": "read_path_trace",
    "io.truth": "read_truth",
    "measure.campaign": "Campaign",
    "measure.protocol": "paper_protocol",
    "measure.sweeps": "Sweeps pool",
    "measure.truth": "paper_truth",
    "model.cell.cell": "Cell",
    "model.estimate": "Estimate",
    "model.trust": "Trust",
    "motion.controller": "Controller",
    "motion.tasks": "TASKS find_task",
    "report.campaign.page": "write_campaign_report",
    "simulator.sweeps": "simulate",
    "tracking.tracker": "track",
}

__all__, __getattr__, __dir__ = lazy(__name__, _PLACES)

"""What the data say: fit, observability, posterior, task errors, and the design of sweeps."""

from fpcal_bayes.core.lazy import lazy

#: Modules of the room, and the names of each that are used outside it.
_PLACES = {
    "design.candidates": "SweepLimits candidate_sweeps",
    "design.exchange": "choose_sweeps",
    "design.order": "in_short_order",
    "design.plan": "PlanSettings Planner",
    "design.problem": "DEFAULT_TASKS Ground estimate_ground measured_ground prior_ground",
    "design.rows": "sweep_rows",
    "fit.identify": "Identification identify",
    "fit.minimise": "curve_sd minimise",
    "fit.problem": "Problem",
    "fit.spectrum": "spectrum_of",
    "mechanics.fit": "MechanicsFit fit_mechanics",
    "mechanics.judge": "doubts_of",
    "mechanics.known": "covariance_of knowledge_of_fit",
    "mechanics.rows": "RowNoise",
    "mechanics.scales": "LOG_SD LOG_SD_NOISE",
    "observability.measures": "bounds_of",
    "observability.observe": "observe whitened_jacobian",
    "posterior.compare": "Comparison ModelResult compare parse_models",
    "posterior.draws": "independent_draws make_target",
    "posterior.netcdf": "slip_probabilities summarise",
    "posterior.proposal": "ProposalMixture",
    "posterior.sample": "sample",
    "posterior.target": "PosteriorTarget",
    "tasks.error": "linear_task_sd peak_to_peak task_errors task_jacobian task_rows",
    "tasks.pose": "FREEDOMS pose_errors",
    "tasks.prediction": "predict_from_covariance predict_from_draws",
    "tasks.source": "PATH_POINTS",
    "verification.choice": "validation_plan",
    "verification.verify": "kept_rows verify",
}

__all__, __getattr__, __dir__ = lazy(__name__, _PLACES)

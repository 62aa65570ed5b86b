"""What the data say: fit, observability, posterior, task errors, and the design of sweeps."""

from fpcal_bayes.core.lazy import lazy

#: Names that are used outside the package, and the module of the room in which each stands.
_PLACES = {
    "Comparison": "posterior.compare",
    "DEFAULT_TASKS": "design.problem",
    "Ground": "design.problem",
    "Identification": "fit.identify",
    "ModelResult": "posterior.compare",
    "PlanSettings": "design.plan",
    "Planner": "design.plan",
    "PosteriorTarget": "posterior.target",
    "Problem": "fit.problem",
    "ProposalMixture": "posterior.proposal",
    "SweepLimits": "design.candidates",
    "bounds_of": "observability.measures",
    "candidate_sweeps": "design.candidates",
    "choose_sweeps": "design.exchange",
    "compare": "posterior.compare",
    "estimate_ground": "design.problem",
    "fit_traces": "traces.fit",
    "identify": "fit.identify",
    "in_short_order": "design.plan",
    "linear_task_sd": "tasks.error",
    "make_target": "posterior.draws",
    "minimise": "fit.minimise",
    "observe": "observability.observe",
    "parse_models": "posterior.compare",
    "peak_to_peak": "tasks.error",
    "prior_ground": "design.problem",
    "read_often": "design.rows",
    "sample": "posterior.sample",
    "slip_probabilities": "posterior.netcdf",
    "spectrum_of": "fit.spectrum",
    "summarise": "posterior.netcdf",
    "sweep_rows": "design.rows",
    "task_errors": "tasks.error",
    "task_jacobian": "tasks.error",
    "task_rows": "tasks.error",
    "whitened_jacobian": "observability.observe",
}

__all__, __getattr__, __dir__ = lazy(__name__, _PLACES)

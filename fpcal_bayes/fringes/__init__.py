"""From recorded irradiance to changes of length, and to the error along a path."""

from fpcal_bayes.core.lazy import lazy

#: Names that are used outside the package, and the module of the room in which each stands.
_PLACES = {
    "CALM": "fit",
    "DisplacementProfile": "profile",
    "Ingested": "ingest",
    "Nuisance": "fit",
    "Reading": "count",
    "fading_priors": "ingest",
    "fit_course": "fit",
    "lay_out": "samples",
    "prior_profiles": "profile",
    "rows_along": "ingest",
}

__all__, __getattr__, __dir__ = lazy(__name__, _PLACES)

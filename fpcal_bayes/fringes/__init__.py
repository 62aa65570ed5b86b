"""From recorded irradiance to changes of length, and to the error along a path."""

from fpcal_bayes.core.lazy import lazy

#: Modules of the room, and the names of each that are used outside it.
_PLACES = {
    "count": "Reading",
    "fit": "CALM Nuisance fit_course",
    "ingest": "Ingested fading_priors read_index rows_along",
    "profile": "DisplacementProfile prior_profiles",
    "samples": "lay_out",
}

__all__, __getattr__, __dir__ = lazy(__name__, _PLACES)

"""One cell, forwards and backwards: from parameters and joints to the cavity length, and from a pose to joints."""

from fpcal_bayes.core.lazy import lazy

#: Modules of the room, and the names of each that are used outside it.
_PLACES = {
    "cavity": "CavityModel Rows",
    "cell.cell": "Cell make_parameters",
    "cell.error_motions": "JointMechanics Mechanics TERMS",
    "cell.joints": "Joint",
    "estimate": "Estimate",
    "interferometer": "fringe",
    "inverse": "InverseModel",
    "mechanics.design": "design",
    "mechanics.terms": "Terms group_of",
    "parameters": "EXTRINSICS LINK_SLOTS UNITS",
}

__all__, __getattr__, __dir__ = lazy(__name__, _PLACES)

"""One cell, forwards and backwards: from parameters and joints to the cavity length, and from a pose to joints."""

from fpcal_bayes.core.lazy import lazy

#: Names that are used outside the package, and the module of the room in which each stands.
_PLACES = {
    "CavityModel": "cavity",
    "Cell": "cell.cell",
    "EXTRINSICS": "parameters",
    "Estimate": "estimate",
    "InverseModel": "inverse",
    "Joint": "cell.joints",
    "JointMechanics": "cell.error_motions",
    "LINK_SLOTS": "parameters",
    "Mechanics": "cell.error_motions",
    "Rows": "cavity",
    "TERMS": "cell.error_motions",
    "Terms": "mechanics.terms",
    "UNITS": "parameters",
    "design": "mechanics.design",
    "fringe": "interferometer",
    "group_of": "mechanics.terms",
    "make_parameters": "cell.cell",
}

__all__, __getattr__, __dir__ = lazy(__name__, _PLACES)

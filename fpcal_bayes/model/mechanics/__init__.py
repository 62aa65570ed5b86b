"""Error motions of a real machine: their sizes, and what they do to the cavity length."""

from fpcal_bayes.model.cell.error_motions import JointMechanics, Mechanics
from fpcal_bayes.model.mechanics.design import Design, PathDesign, design, path_design, weight_rows
from fpcal_bayes.model.mechanics.drive import Drive, drive_of
from fpcal_bayes.model.mechanics.terms import Motion, Terms, group_of

__all__ = [
    "Design",
    "Drive",
    "JointMechanics",
    "Mechanics",
    "Motion",
    "PathDesign",
    "Terms",
    "design",
    "drive_of",
    "group_of",
    "path_design",
    "weight_rows",
]

"""Error motions of a real machine: their sizes, and what they do to the cavity length."""

from fpcal_bayes.model.mechanics.design import Design, PathDesign, design, path_design
from fpcal_bayes.model.mechanics.drive import Drive, drive_of
from fpcal_bayes.model.mechanics.sizes import JointMechanics, Mechanics, cell_mechanics, joint_mechanics
from fpcal_bayes.model.mechanics.terms import Motion, Terms, group_of

__all__ = [
    "Design",
    "Drive",
    "JointMechanics",
    "Mechanics",
    "Motion",
    "PathDesign",
    "Terms",
    "cell_mechanics",
    "design",
    "drive_of",
    "group_of",
    "joint_mechanics",
    "path_design",
]

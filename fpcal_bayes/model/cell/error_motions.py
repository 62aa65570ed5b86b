"""How large the error motions of a cell are: what data sheets of its parts state."""

from dataclasses import asdict, dataclass, fields, replace

from fpcal_bayes.core.files import content_sha256

#: Kinds of error motions that can be left out, and the sizes that they have.
TERMS = {
    "straightness": ("straightness_nm", "flatness_nm", "crosstalk_nm"),
    "tilts": ("pitch_urad", "yaw_urad", "roll_urad", "wobble_urad"),
    "runout": ("radial_runout_nm", "axial_runout_nm"),
    "linearity": ("linearity",),
    "reversal": ("reversal",),
    "return": ("return_sd",),
    "encoder": ("encoder",),
    "drift": (),
}


@dataclass(frozen=True)
class JointMechanics:
    """What a data sheet states of one joint, in the units of the sheet; zero is "none"."""

    # straightness_nm, flatness_nm, crosstalk_nm: Of a joint that moves along: peak to valley across the travel, without
    # its best line. `straightness_nm` holds for both directions across where there is no `flatness_nm`; else that holds
    # for the upward one (Zw; Yw for a joint along Zw). `crosstalk_nm` adds in square to both
    straightness_nm: float = 0.0
    flatness_nm: float | None = None
    crosstalk_nm: float = 0.0
    pitch_urad: float = 0.0  # peak to valley of the tilts, as of the next two
    yaw_urad: float = 0.0  # about the upward direction
    roll_urad: float = 0.0  # about the joint's own
    # radial_runout_nm, axial_runout_nm, wobble_urad: Of a joint that turns: half of peak to valley. An endless joint's
    # fundamental radial harmonic is eccentricity, a matter of geometry, and is not counted
    radial_runout_nm: float = 0.0
    axial_runout_nm: float = 0.0
    wobble_urad: float = 0.0
    linearity: float = 0.0  # along or about the joint's own axis: peak to valley, its gain included, in nm or urad
    reversal: float = 0.0  # Lost motion between the two directions of approach, in nm or urad
    return_sd: float = 0.0  # unidirectional repeatability, one standard deviation, in nm or urad
    encoder: float = 0.0  # amplitude of the encoder's periodic error, in nm or urad
    encoder_period: float | None = None  # in um or deg; None where it is not known
    # from the point that the data sheet speaks of to the mirror, in world axes at joint zero
    lever_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    source: str = ""  # where the sizes come from; ``assumed`` where nobody states them

    @property
    def any(self) -> bool:
        """Whether anything is stated."""
        return any(getattr(self, f.name) for f in fields(self) if f.name not in ("lever_mm", "source"))


@dataclass(frozen=True)
class Mechanics:
    """Sizes of a cell's error motions."""

    joints: tuple[JointMechanics, ...]  # one per joint, from base to tool
    # rate at which the fibre drifts within a session, one standard deviation in each direction
    drift_nm_per_min: float = 0.0
    minutes_per_sweep: float = 1.0  # time between the starts of two sweeps where the rows do not state their times
    # standard deviation of a reading error that changes slowly from row to row; None: four fifths of the readings' own
    # sigma
    correlated_nm: float | None = None

    @property
    def any(self) -> bool:
        """Whether anything is stated."""
        return self.drift_nm_per_min > 0 or any(joint.any for joint in self.joints)

    def without(self, term: str) -> "Mechanics":
        """The same without one of `TERMS`: its sizes are zero."""
        if term == "drift":
            return replace(self, drift_nm_per_min=0.0)
        zero = {name: None if name == "flatness_nm" else 0.0 for name in TERMS[term]}
        return replace(self, joints=tuple(replace(joint, **zero) for joint in self.joints))  # type: ignore[arg-type]

    @property
    def sha256(self) -> str:
        """Hash of the sizes; they stand outside the hash of the cell."""
        return content_sha256(asdict(self))

    def scaled(self, factor: float) -> "Mechanics":
        """The same with every error motion and the drift `factor` times as large."""
        kept, joints = ("encoder_period", "lever_mm", "source"), []
        for joint in self.joints:
            stated = {name: value for name, value in vars(joint).items() if name not in kept and value is not None}
            joints.append(replace(joint, **{name: factor * value for name, value in stated.items()}))
        return replace(self, joints=tuple(joints), drift_nm_per_min=factor * self.drift_nm_per_min)

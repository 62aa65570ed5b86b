"""The weights of a cell's error motions: which there are, how large they may be, which scale they share.

An unknown function of a joint's value is a sum of basis functions whose weights are independent normal: Legendre
polynomials k = 1 to 5 over the travel of a limited joint, for a tilt, which levers enlarge, k = 1 to 8, and harmonics
k = 1 to 4 of an endless one. They fall as 1/k, but a tilt of one peak to valley may be mostly slope, bow or wave: its
polynomials of order 2 to 4 are larger. A size on a sheet is what such a function shows at the median (a test draws
them anew).
"""

from collections.abc import Collection
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.polynomial import legendre

from fpcal_bayes.core.notebook import Brief
from fpcal_bayes.core.typing import Floats, Ints
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.cell.error_motions import JointMechanics, Mechanics
from fpcal_bayes.model.mechanics.response import ACROSS, OWN, PITCH, ROLL, UP, YAW, Directions, directions

Shape = Literal["legendre", "legendre-bent", "tilt", "fourier", "fourier-beyond-first"]

#: Standard deviations by k of the weights of a function whose median peak to valley is 1. "bent": its line is not
#: counted (a straightness is measured from the best line); "beyond-first": there is no fundamental. Those of a tilt are
#: in proportion root mean squares over functions of one peak to valley: half of these are sums of polynomials that fall
#: as 1/k, half are smooth waves with a slope and a kink.
WEIGHT_SD: dict[Shape, tuple[float, ...]] = {
    "legendre": (0.526, 0.263, 0.175, 0.131, 0.105),
    "legendre-bent": (0.962, 0.481, 0.321, 0.241, 0.192),
    "tilt": (0.411, 0.291, 0.224, 0.159, 0.115, 0.086, 0.069, 0.059),
    "fourier": (0.272, 0.136, 0.091, 0.068),
    "fourier-beyond-first": (0.0, 0.227, 0.151, 0.113),
}
#: Highest polynomial, of a tilt, and highest harmonic. What kinks of stage tilts leave beyond order 5 is, at levers of
#: some 80 mm, more than a session leaves of a circle; of displacements it is little.
LEGENDRE, HARMONICS = 8, 4


def polynomials(q: Floats, low: float | Floats, high: float | Floats) -> Floats:
    """Legendre polynomials 1 to 8 over a travel from `low` to `high`, shape (n, 8); of joints (n, m), (n, m, 8)."""
    return np.asarray(legendre.legvander((2.0 * q - low - high) / (high - low), LEGENDRE)[..., 1:], dtype=np.float64)


def harmonics(q: Floats) -> Floats:
    """Cosine and sine of one to four turns per turn, cos q, sin q, cos 2q, ..., shape (..., 8): a full turn closes."""
    angles = q[..., None] * np.arange(1, HARMONICS + 1)
    return np.asarray(np.stack([np.cos(angles), np.sin(angles)], axis=-1).reshape(*q.shape, 2 * HARMONICS))


#: Scales that are not those of error motions, in their order behind them.
SINGLE_KINDS = ("approach", "drift", "encoder", "slow noise", "return", "noise")
KINDS = ("along the beam", "other displacement", "tilt")
_NM, _URAD = 1e-3, 1e-6
#: Joints whose value changes by less than so many resolutions or return errors stand still.
_STILL = 5.0
#: Polynomials in time of a session's drift; each further one is half as large.
DRIFT_ORDER = 2


@dataclass(frozen=True)
class Motion:
    """One error motion of one joint, as a function of the joint's value."""

    joint: int  # position of the joint
    direction: int  # of `Responses.motion`
    name: str  # as residual tests and the budget speak of it
    scale: str  # the scale that it shares: group of joints and kind
    sd: Floats  # standard deviation of the weights in um or rad, in the order of the basis


@dataclass(frozen=True, repr=False)
class Terms(Brief):
    """Every weight of a cell's mechanics that acts on the cavity length."""

    cell: Cell
    sizes: Mechanics
    told: Directions  # directions of the error motions
    motions: tuple[Motion, ...]  # functions of joint values. A weight of sd zero is not there
    free: tuple[str, ...] = ()  # names of the geometric parameters that are identified

    @classmethod
    def of(cls, cell: Cell, sizes: Mechanics, free: Collection[str] = ()) -> "Terms":
        """The terms of a cell; a `free` gain_j takes the linear term of own travel out, a runout its first harmonic."""
        told = directions(cell, np.array([joint.lever_mm for joint in sizes.joints]))
        made = (motion for i, joint in enumerate(sizes.joints) for motion in _motions(cell, i, joint, told, free))
        return cls(cell, sizes, told, tuple(made), tuple(free))

    @cached_property
    def weights(self) -> tuple[Ints, Ints, Ints, Floats]:
        """Of every weight that is there: joint, direction, place in the basis, standard deviation; shape (n,) each."""
        places = [np.flatnonzero(motion.sd > 0) for motion in self.motions]
        counts = list(map(len, places))
        joint, direction = (
            np.repeat(np.array([getattr(motion, name) for motion in self.motions], dtype=np.int64), counts)
            for name in ("joint", "direction")
        )
        none = np.zeros(0, dtype=np.int64)
        sd = np.concatenate([none.astype(float), *(motion.sd[motion.sd > 0] for motion in self.motions)])
        return joint, direction, np.concatenate([none, *places]), sd

    @cached_property
    def last_path(self) -> dict[tuple[bytes, bytes, bytes], Any]:
        """The design of the path that was asked for last: compensation, and then the error left, ask for the same."""
        return {}

    @cached_property
    def elliptic(self) -> tuple[Motion, ...]:
        """Upward radial motions of endless joints, whose fundamental may run against the turn."""
        return tuple(m for m in self.motions if m.direction == UP and group_of(self.cell, m.joint) == "rotary")

    @cached_property
    def known_encoders(self) -> list[int]:
        """Joints whose encoder has an error of known period."""
        return np.flatnonzero((self.encoder > 0) & np.isfinite(self.encoder_period)).tolist()

    @cached_property
    def reversal(self) -> Floats:
        """Half of the lost motion of each joint, in um or rad, shape (n_joints,)."""
        return 0.5 * self._own([joint.reversal for joint in self.sizes.joints])

    @cached_property
    def return_sd(self) -> Floats:
        """Standard deviation of each joint's return error, by default its repeatability, in um or rad, (n_joints,)."""
        own = self._own([joint.return_sd for joint in self.sizes.joints])
        return np.where(own > 0, own, self.cell.repeatability)

    @cached_property
    def still(self) -> Floats:
        """Changes of joint values that may be noise of the values as they are read back, in um or rad, (n_joints,)."""
        return _STILL * np.maximum([joint.resolution for joint in self.cell.joints], self.return_sd)

    @cached_property
    def encoder(self) -> Floats:
        """Amplitude of each encoder's periodic error, in um or rad, shape (n_joints,)."""
        return self._own([joint.encoder for joint in self.sizes.joints])

    @cached_property
    def encoder_period(self) -> Floats:
        """Period of each encoder in um or rad, shape (n_joints,); NaN where it is not known."""
        periods = [np.nan if joint.encoder_period is None else joint.encoder_period for joint in self.sizes.joints]
        return np.array(periods) * self.cell.joint_scales

    @cached_property
    def scales(self) -> tuple[str, ...]:
        """Names of the scales: those of the motions that are there, then `SINGLE_KINDS`."""
        return (*dict.fromkeys(motion.scale for motion in self.motions), *SINGLE_KINDS)

    def _own(self, values: list[float]) -> Floats:
        return np.array(values) * np.where(self.cell.revolute, _URAD, _NM)


def group_of(cell: Cell, joint: int) -> str:
    """The group of a joint whose error motions share scales."""
    if cell.joints[joint].kind == "prismatic":
        return "stage"
    return "goniometers" if np.isfinite(cell.high[joint] - cell.low[joint]) else "rotary"


def _motions(cell: Cell, i: int, sizes: JointMechanics, told: Directions, free: Collection[str]) -> list[Motion]:
    number, group = i + 1, group_of(cell, i)
    endless = group == "rotary"
    if cell.joints[i].kind == "prismatic":
        flat = np.hypot(sizes.straightness_nm if sizes.flatness_nm is None else sizes.flatness_nm, sizes.crosstalk_nm)
        stated = {
            OWN: ("linearity", sizes.linearity),
            UP: ("flatness", flat),
            ACROSS: ("straightness", np.hypot(sizes.straightness_nm, sizes.crosstalk_nm)),
            ROLL: ("roll", sizes.roll_urad),
            YAW: ("yaw", sizes.yaw_urad),
            PITCH: ("pitch", sizes.pitch_urad),
        }
    else:
        stated = {
            OWN: ("axial runout", 2.0 * sizes.axial_runout_nm),
            UP: ("radial runout, upward", 2.0 * sizes.radial_runout_nm),
            ACROSS: ("radial runout, across", 2.0 * sizes.radial_runout_nm),
            ROLL: ("linearity", sizes.linearity),
            YAW: ("wobble, yaw", 2.0 * sizes.wobble_urad),
            PITCH: ("wobble, pitch", 2.0 * sizes.wobble_urad),
        }
    own_travel = OWN if cell.joints[i].kind == "prismatic" else ROLL
    made = []
    for direction, (word, size) in stated.items():
        if not size > 0:
            continue
        bent = direction in (UP, ACROSS) and cell.joints[i].kind == "prismatic"
        radial = direction in (UP, ACROSS) and endless
        tilts = direction >= ROLL and direction != own_travel
        shape: Shape = "legendre-bent" if bent else "tilt" if tilts else "legendre"
        if endless:
            shape = "fourier-beyond-first" if radial else "fourier"
        sd = size * (_NM if direction < ROLL else _URAD) * np.array(WEIGHT_SD[shape])
        if endless:
            sd = np.repeat(sd, 2)
        if direction == own_travel and f"gain_{number}" in free and not endless:
            sd[0] = 0.0
        if direction == OWN and endless and {f"runout_cos_{number}", f"runout_sin_{number}"} & set(free):
            sd[:2] = 0.0
        displacement = KINDS[0] if told.along_beam[i] == direction else KINDS[1]
        kind = KINDS[2] if direction >= ROLL else displacement
        made.append(Motion(i, direction, f"{word} of q{number}", f"{group}, {kind}", sd))
    return made

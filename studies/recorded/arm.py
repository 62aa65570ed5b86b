"""Recorded postures of an arm, and where its ball stands in them: the package's chain, and how its joints deviate."""

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fpcal_bayes import InputError, load_cell
from fpcal_bayes.model import EXTRINSICS, LINK_SLOTS, CavityModel

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

#: Mass in kg and centre of mass in um in each link's frame: Gaz, Cognetti, Oliva, Robuffo Giordano and De Luca, Dynamic
#: identification of the Franka Emika Panda robot, RA-L 2019 (none is needed along the first axis).
MASSES = (
    (4.970684, (3875, 2081, 0)),
    (0.646926, (-3141, -28720, 3495)),
    (3.228604, (27518, 39252, -66502)),
    (3.587895, (-53170, 104419, 27454)),
    (1.225946, (-11953, 41065, -38437)),
    (1.666555, (60149, -14117, -10517)),
    (0.735522, (10517, -4252, 61597 - 107000)),  # the last link's frame is the flange here
)
_GRAVITY = 9.81
_NUMBER = re.compile(r"\s*[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?\s*")
#: What a joint may do beside what the table says, and the stated size of one weight in rad: the twist under 10 Nm of
#: gravity, half the lost motion between the sides on which gravity leans, sine and cosine of once and twice a turn.
MECHANICS = {"compliance": 1e-3, "backlash": 3e-4, "harmonics": 5e-4}
_TWIST_NM, _LEAN_NM = 10.0, 1.0


@dataclass(frozen=True)
class Postures:
    """Joint vectors at which the ball stood in one of several sockets."""

    q: Floats  # in rad, shape (n, n_joints)
    socket: Ints  # position of each posture's socket among `places`, shape (n,)
    places: tuple[tuple[str, str], ...]  # position of the plate and name of the hole, of each socket

    @property
    def positions(self) -> tuple[str, ...]:
        """Positions of the plate."""
        return tuple(dict.fromkeys(position for position, _ in self.places))

    def at(self, *positions: str) -> "Postures":
        """Those of some positions."""
        kept = [i for i, (position, _) in enumerate(self.places) if position in positions]
        rows = np.isin(self.socket, kept)
        return Postures(self.q[rows], np.searchsorted(kept, self.socket[rows]), tuple(self.places[i] for i in kept))

    def means(self, values: Floats) -> Floats:
        """Mean of values (n, ...) in each socket, shape (n_sockets, ...)."""
        return np.array([values[self.socket == i].mean(axis=0) for i in range(len(self.places))])


def find_robots(folder: Path) -> list[Path]:
    """The folders of robots in a folder, or that folder if it is one robot's."""
    robots = [file.parents[1] for depth in ("*", "*/*") for file in folder.glob(f"{depth}/hole_?.csv")]
    if not robots:
        raise InputError(
            f"{folder}: expected POSITION/hole_0.csv of one robot or ROBOT/POSITION/hole_0.csv, found none"
        )
    return sorted(set(robots))


def read_robot(robot: Path, n_joints: int) -> Postures:
    """All postures of a robot: a folder for each position of the plate with a file for each hole, a row each."""
    files = sorted(robot.glob("*/hole_?.csv"))
    read = [_read(file, n_joints) for file in files]
    if len({file.parent for file in files}) < 2:
        raise InputError(f"{robot}: expected two positions of the plate or more, found one")
    places = tuple((file.parent.name, file.stem) for file in files)
    return Postures(np.concatenate(read), np.repeat(np.arange(len(read)), [len(q) for q in read]), places)


def _read(file: Path, n_joints: int) -> Floats:
    try:
        rows = list(csv.reader(file.read_text(encoding="utf-8").splitlines()))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{file}: not a table that can be read: {error}") from error
    for i, row in enumerate(rows, 1):
        for j, text in enumerate([*row, *["nothing"] * (n_joints - len(row))], 1):
            if j > n_joints or not (_NUMBER.fullmatch(text) and abs(float(text)) <= 4.0 * np.pi):
                what = f"expected {n_joints} angles in rad of at most two turns each, found {text[:40]!r}"
                raise InputError(f"{file}: row {i}: column {j}: {what}")
    if len(rows) < 2:
        raise InputError(f"{file}: expected two postures or more, found {len(rows)}")
    return np.array(rows, dtype=float)


class Deviations(NamedTuple):
    """Functions of a posture by which joints deviate: each acts on one joint, with a weight in rad."""

    values: Floats  # shape (n, n_weights)
    joint: Ints  # shape (n_weights,)
    kind: tuple[str, ...]  # of `MECHANICS`, of each weight


class Arm:
    """The Panda's chain, whose three beams x, y and z end on the ball."""

    def __init__(self) -> None:
        self.cell = load_cell(Path(__file__).parent / "panda.toml")
        self.free = self.cell.select([p.name for p in self.cell.parameters if p.prior_sd > 0])
        self.model = CavityModel.of(self.cell, self.free)
        # Heights of the centres of mass: a point on each link, seen by the upright beam.
        view, self._heights = self.cell.views[self.cell.beams.index("z")].cell, []
        for link, (_, (x, y, z)) in enumerate(MASSES, 1):
            start = view.parameters.nominal[-len(EXTRINSICS) :]
            held = [view.parameters.nominal[: link * len(LINK_SLOTS)], [x, y], start[2:4], [z], start[5:]]
            cell = replace(view, joints=view.joints[:link])
            self._heights.append(CavityModel(cell, view.parameters[:0], np.concatenate(held)))

    def points(self, values: Floats, q: Floats) -> tuple[Floats, Floats, Floats]:
        """Where the ball stands in postures `q`, and its derivatives by the free parameters `values` and by the joints.

        Returns shapes (n_postures, 3), (n_postures, 3, n_free) and (n_postures, 3, n_joints), in um and rad.
        """
        thrice, beam = np.repeat(q, 3, axis=0), np.tile(np.arange(3), len(q))
        lengths, jacobian = self.model.predict_with_jacobian(values, self.model.pose_rows(thrice, beam))
        moves = self.model.joint_jacobian(values, thrice, beam)
        return lengths.reshape(-1, 3), jacobian.reshape(len(q), 3, -1), moves.reshape(len(q), 3, -1)

    def torques(self, q: Floats) -> Floats:
        """Torque of the links' weight on each joint of the nominal chain, in Nm, shape (n_postures, n_joints)."""
        total = np.zeros_like(q)
        for link, ((mass, _), height) in enumerate(zip(MASSES, self._heights, strict=True), 1):
            total[:, :link] -= 1e-6 * mass * _GRAVITY * height.joint_jacobian(np.zeros(0), q[:, :link])
        return total

    def deviations(self, q: Floats, kinds: Sequence[str]) -> Deviations:
        """What the named kinds of mechanics may do in postures `q`."""
        torque = self.torques(q)
        made = []
        for joint in range(q.shape[1]):
            own = {
                "compliance": [torque[:, joint] / _TWIST_NM],
                "backlash": [np.tanh(torque[:, joint] / _LEAN_NM)],
                "harmonics": [f(k * q[:, joint]) / k for k in (1, 2) for f in (np.sin, np.cos)],
            }
            made += [(values, joint, kind) for kind in MECHANICS if kind in kinds for values in own[kind]]
        values = np.array([v for v, *_ in made]).T.reshape(len(q), len(made))
        return Deviations(values, np.array([j for _, j, _ in made], dtype=np.int64), tuple(kind for *_, kind in made))

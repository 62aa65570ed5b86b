"""Sweeps: what was moved from where to where, and how the cavity length changed."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import special

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.linalg import counted
from fpcal_bayes.core.notebook import html_table
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.model.cavity import CavityModel, Rows
from fpcal_bayes.model.cell.cell import Cell

Texts = NDArray[np.str_]

KINDS = ("sweep", "absolute", "path")
MAX_TEXT = 1000
#: Sessions share readings by chance with a larger probability than this.
_CHANCE = 1e-6
#: With a larger sigma, in um, fringes are counted: readings of one sweep then agree by chance.
_COUNTED = 0.1

#: What a column holds where nothing is said of it.
_DEFAULTS: dict[str, Any] = {
    "session": "session-1",
    "kind": "sweep",
    **dict.fromkeys(("label", "group", "trace", "utc", "approach", "beam", "shot"), ""),
    "time_h": 0.0,
    **dict.fromkeys(("dl", "sigma", "temperature_c", "t_start_h", "t_end_h", "scale_ppm"), np.nan),
    "signed": True,
}


@dataclass(frozen=True)
class Sweeps:
    """An ordered set of n sweeps; lengths in um, angles in rad, times in hours."""

    #: session, label: Rows of one session belong together, shape (n,).
    session: Texts
    label: Texts
    time_h: Floats  # since the campaign began, shape (n,)
    #: q_start, q_end: Joint vectors, shape (n, n_joints).
    q_start: Floats
    q_end: Floats
    #: dl, sigma: Measured change of cavity length and its standard deviation, shape (n,); NaN in a plan.
    dl: Floats
    sigma: Floats
    signed: NDArray[np.bool_]  # false where only the size of `dl` is known, or its rows up to one sign, shape (n,)
    group: Texts  # rows of one session with the same non-empty group share the reading at their start, shape (n,)
    kind: Texts  # ``sweep``, ``absolute`` (`dl` is L at `q_end`) or ``path`` (closed or multi-joint), shape (n,)
    trace: Texts  # file of the recorded trace, or empty, shape (n,)
    utc: Texts  # clock time as ISO 8601, or empty, shape (n,)
    temperature_c: Floats  # or NaN, shape (n,)
    #: t_start_h, t_end_h: When start and end were read, since the campaign began, or NaN, shape (n,).
    t_start_h: Floats
    t_end_h: Floats
    approach: Texts  # direction in which each joint reached the end, one of ``+-0`` per joint, or empty, shape (n,)
    beam: Texts  # name of the beam that read each row, shape (n,); empty: the only one
    shot: Texts  # rows of one session with the same non-empty shot were read at one moment, shape (n,)
    #: Standard deviation of one scale of all lengths, the laser's wavelength over the index of the air, that `sigma`
    #: does not hold, or NaN, shape (n,).
    scale_ppm: Floats
    #: What independent errors of unit variance that the rows of a group share add to each beside `sigma`, in um, shape
    #: (n, n_common); rows that have none share half of their variance. Files do not hold it. Unsigned rows of a group
    #: that have some have one sign together.
    common: Floats
    #: file, rows: Where the sweeps were read: file name and line of each, shape (n,); used in messages.
    file: str
    rows: NDArray[np.int64]

    @classmethod
    def of_um_deg(cls, cell: Cell, q_start: Floats, q_end: Floats, **columns: Any) -> "Sweeps":
        """Build sweeps from joint vectors as files hold them.

        Parameters
        ----------
        cell
            Says which joints turn.
        q_start, q_end
            Joint vectors in um and deg, shape (n, n_joints).
        **columns
            Other fields, single values for all rows or one per row: ``session``, ``label``, ``time_h``, ``dl`` and
            ``sigma`` in um, ``signed``, ``group``, ``kind``, ``utc``, ``temperature_c``.

        Raises
        ------
        InputError
            If a joint vector has another length than the cell has joints.
        """
        start, end = np.array(q_start, dtype=float), np.array(q_end, dtype=float)
        if start.ndim != 2 or start.shape != end.shape or start.shape[1] != len(cell.joints):
            raise InputError(f"joint vectors of shape {start.shape}: expected n rows of {len(cell.joints)} joints")
        return cls.of_um_rad(start * cell.joint_scales, end * cell.joint_scales, **columns)

    @classmethod
    def of_um_rad(
        cls,
        q_start: Floats,
        q_end: Floats,
        *,
        common: Floats | None = None,
        file: str = "sweeps",
        rows: NDArray[np.int64] | None = None,
        **columns: Any,
    ) -> "Sweeps":
        """Build sweeps from joint vectors (n, n_joints); single values of other columns hold for all rows."""
        q_start, q_end = np.array(q_start, dtype=float), np.array(q_end, dtype=float)
        n = len(q_start)
        others = {
            name: np.broadcast_to(np.asarray(value, dtype=type(_DEFAULTS.get(name))), n).copy()
            for name, value in (_DEFAULTS | columns).items()
        }
        common = np.zeros((n, 0)) if common is None else common
        rows = np.arange(2, n + 2) if rows is None else rows
        return cls(q_start=q_start, q_end=q_end, common=common, file=file, rows=rows, **others)

    def __len__(self) -> int:
        return len(self.dl)

    def __repr__(self) -> str:
        return f"Sweeps({counted(len(self), 'row')}, sessions {', '.join(self.sessions)})"

    def _repr_html_(self) -> str:
        rows = []
        for name in self.sessions:
            part = self.of_session(name)
            sigma = f"{1e3 * np.median(part.sigma):.3g}" if part.measured else "not measured"
            rows.append((name, f"{part.time_h.max():g}", len(part), int((~part.signed).sum()), sigma))
        return html_table(self.file, ["session", "time [h]", "rows", "without sign", "sigma, median [nm]"], rows)

    @property
    def measured(self) -> bool:
        """Whether every row carries a measurement (a plan carries none)."""
        return bool(np.isfinite(self.dl).all() and np.isfinite(self.sigma).all())

    @property
    def absolute(self) -> NDArray[np.bool_]:
        """Rows whose `dl` is the cavity length at `q_end`, shape (n,)."""
        return np.asarray(self.kind == "absolute")

    @property
    def scaled(self) -> Floats:
        """What one standard deviation of the common scale adds to each row, in um, shape (n,)."""
        return np.nan_to_num(1e-6 * self.scale_ppm * self.dl)

    def laid_out(self, model: CavityModel) -> Rows:
        """The rows laid out for the kernels of a model."""
        return model.rows(self.q_start, self.q_end, self.absolute, model.cell.beam_numbers(self.beam))

    @property
    def names(self) -> list[str]:
        """Labels for messages, with the session where there are several, and the beam where it is named."""
        sessions = self.session if len(self.sessions) > 1 else np.full(len(self), "")
        notes = [", ".join(filter(None, both)) for both in zip(sessions, self.beam, strict=True)]
        return [f"{label} ({note})" if note else label for label, note in zip(self.label, notes, strict=True)]

    def approach_signs(self) -> Floats:
        """Stated directions of approach as -1, 0 (not stated), +1, shape (n, n_joints)."""
        known = {text: [float("-0+".index(sign) - 1) for sign in text] for text in set(self.approach.tolist()) if text}
        return np.array([known.get(text, [0.0] * self.q_end.shape[1]) for text in self.approach.tolist()])

    @cached_property
    def sessions(self) -> tuple[str, ...]:
        """Names of the sessions in the order of their first time."""
        first: dict[str, float] = {}
        for name, time in zip(self.session.tolist(), self.time_h.tolist(), strict=True):
            first[name] = min(time, first.get(name, time))
        return tuple(sorted(first, key=first.__getitem__))

    def take(self, chosen: NDArray[Any]) -> "Sweeps":
        """The rows picked by a mask or by positions."""
        return replace(self, **{f.name: getattr(self, f.name)[chosen] for f in fields(self) if f.name != "file"})

    def of_session(self, name: str | None = None) -> "Sweeps":
        """The rows of one session, by default the first; of several, with commas between, those of an unchanged cell.

        Raises
        ------
        InputError
            If there is no such session, or two of them hold the same readings.
        """
        wanted = self.sessions[0] if name is None else name
        names = [wanted] if wanted in self.sessions else wanted.split(",")
        for each in names:
            if each not in self.sessions:
                raise InputError(f"{self.file}: no session {each!r}: expected one of {', '.join(self.sessions)}")
            if names.count(each) > 1:
                raise InputError(f"{self.file}: session {each!r} is named twice, expected each session once")
        own = np.isin(self.session, names)
        chosen = self if own.all() else self.take(own)
        _check_distinct(chosen)
        return chosen

    def with_measurement(self, dl: Floats, sigma: float | Floats) -> "Sweeps":
        """The same sweeps with measured changes (n,) and their standard deviations."""
        return replace(self, dl=np.asarray(dl, dtype=float), sigma=np.broadcast_to(sigma, len(self)).astype(float))


def join(parts: Sequence[Sweeps], file: str = "sweeps") -> Sweeps:
    """Sweeps of several sets, one after the other, counted anew as rows of `file`."""
    names = [f.name for f in fields(Sweeps) if f.name not in ("file", "rows")]
    most = max(part.common.shape[1] for part in parts)
    parts = [replace(part, common=np.pad(part.common, ((0, 0), (0, most - part.common.shape[1])))) for part in parts]
    joined = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    return Sweeps(**joined, file=file, rows=np.arange(2, sum(map(len, parts)) + 2))


def pool(parts: Sequence[Sweeps]) -> Sweeps:
    """The sessions of several sets as those of one unchanged cell; a session whose name is taken gets another one.

    Raises
    ------
    InputError
        If two sessions hold the same readings: data count once.
    """
    taken: set[str] = set()
    renamed = []
    for part in parts:
        session = part.session.astype(object)
        for name in part.sessions:
            free = name
            while free in taken:
                free += "'"
            session[part.session == name] = free
            taken.add(free)
        renamed.append(replace(part, session=session.astype(np.str_)))
    pooled = join(renamed, file=" and ".join(part.file for part in parts))
    _check_distinct(pooled)
    return pooled


def _check_distinct(sweeps: Sweeps) -> None:
    """Refuse sessions that share more readings than two measurements do by chance."""
    if len(sweeps.sessions) == 1:
        return
    rows = np.column_stack([sweeps.q_start, sweeps.q_end, sweeps.dl, sweeps.sigma]).round(9)
    keys = np.array([row.tobytes() for row in rows + 0.0])
    decimals = next((k for k in range(9) if np.allclose(sweeps.dl, sweeps.dl.round(k), rtol=0.0, atol=1e-9)), 9)
    for i, name in enumerate(sweeps.sessions):
        own = sweeps.session == name
        for other in sweeps.sessions[:i]:
            there = np.isin(keys[own], keys[sweeps.session == other])
            # Two readings of one length with this noise agree to the last decimal with that probability.
            alike = min(1.0, 10.0**-decimals / (2.0 * np.sqrt(np.pi) * float(np.median(sweeps.sigma[own]))))
            if there.any() and special.bdtrc(there.sum() - 1, len(there), alike) < _CHANCE:
                raise InputError(
                    f"{sweeps.file}: sessions {other!r} and {name!r} hold the same readings ({there.sum()} rows): data "
                    "count once, expected another measurement"
                )


def repeated_rows(sweeps: Sweeps) -> NDArray[np.bool_]:
    """Rows that stand earlier too, poses and dL to the last digit, shape (n,); counts of whole fringes do repeat."""
    beam = np.unique(sweeps.beam, return_inverse=True)[1]
    rows = np.ascontiguousarray(np.column_stack([sweeps.q_start, sweeps.q_end, sweeps.dl, beam])) + 0.0
    again = np.ones(len(sweeps), dtype=bool)
    again[np.unique(rows.view(f"V{8 * rows.shape[1]}"), return_index=True)[1]] = False
    return np.asarray(again & (sweeps.kind == "sweep") & (sweeps.sigma < _COUNTED))


def as_plan(sweeps: Sweeps, *, session: str, time_h: float, file: str = "plan") -> Sweeps:
    """The same sweeps to be measured in a session to come: nothing in them was measured."""
    kept = {name: getattr(sweeps, name) for name in ("label", "group", "kind", "beam", "shot")}
    return Sweeps.of_um_rad(sweeps.q_start, sweeps.q_end, session=session, time_h=time_h, file=file, **kept)

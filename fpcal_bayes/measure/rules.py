"""The rules of sweeps that no single field shows."""

import numpy as np
from numpy.typing import NDArray

from fpcal_bayes.core.errors import InputError, located
from fpcal_bayes.core.typing import Ints
from fpcal_bayes.measure.sweeps import KINDS, Sweeps
from fpcal_bayes.model.cell.cell import Cell, check_joints
from fpcal_bayes.model.envelope import behind_the_fibre

#: Absolute lengths that say where the fibre stands.
_SCANS = 100
#: Poses that are looked at together, so that their derivatives take little memory.
_AT_ONCE = 20_000


def check_sweeps(sweeps: Sweeps, cell: Cell) -> None:
    """Hold sweeps to the rules that no single field shows."""
    if len(sweeps) == 0:
        raise InputError(f"{sweeps.file}: no rows, expected at least one sweep")

    def refuse(bad: NDArray[np.bool_], column: str, expected: str) -> None:
        if bad.any():
            raise located(sweeps.file, expected, row=int(sweeps.rows[np.argmax(bad)]), column=column)

    columns = [c.split("_") for c in cell.joint_columns]
    for q, end in ((sweeps.q_start, "start"), (sweeps.q_end, "end")):
        check_joints(cell, q, sweeps.file, sweeps.rows.tolist(), [f"{joint}_{end}_{unit}" for joint, unit in columns])
    alike: dict[str, str] = {}
    for name in sweeps.sessions:
        other = alike.setdefault(" ".join(name.casefold().split()), name)
        differ = f"sessions {other!r:.60} and {name!r:.60} differ by case or blanks only, expected one name for each"
        refuse((sweeps.session == name) & (other != name), "session", differ)
    refuse(~np.isin(sweeps.kind, KINDS), "kind", f"expected one of {', '.join(KINDS)}")
    still = (sweeps.q_start == sweeps.q_end).all(axis=1) & (sweeps.kind == "sweep")
    refuse(still, f"{columns[0][0]}_end_{columns[0][1]}", "start and end are the same, expected a sweep that moves")
    refuse(sweeps.sigma <= 0, "sigma_um", "expected a standard deviation above zero")
    shared = (sweeps.group != "") & sweeps.absolute
    refuse(shared, "group", "an absolute length has no start to share, expected no group")

    refuse(np.isnan(sweeps.t_start_h) != np.isnan(sweeps.t_end_h), "t_end_h", "expected t_start_h and t_end_h together")
    refuse(sweeps.t_end_h < sweeps.t_start_h, "t_end_h", "expected a time at or after t_start_h")
    signs = {text: len(text) == len(cell.joints) and set(text) <= set("+-0") for text in set(sweeps.approach.tolist())}
    bad = np.array([bool(text) and not signs[text] for text in sweeps.approach.tolist()])
    n = len(cell.joints)
    refuse(bad, "approach", f"expected one of +-0 for each of {n} joints, as in {'+' * n}")

    beams = f"expected one of {', '.join(cell.beams)}" if cell.beam else f"cell {cell.name!r} names no beam"
    refuse(~np.isin(sweeps.beam, ("", *cell.beams)), "beam", f"{beams}, see [[beam]] of the cell")
    refuse((sweeps.beam == "") & (len(cell.beams) > 1), "beam", f"which beam read the row: {beams}")
    beam = cell.beam_numbers(sweeps.beam)
    _check_shots(sweeps, beam)

    # Rows that no cell gives. Lengths tell nothing of it: on the perpendicular path they are sizes.
    for number, (view, _) in enumerate(cell.views):
        mine = np.flatnonzero(beam == number)
        if view.target == "plane-mirror" and len(mine):
            _check_ahead(sweeps if len(mine) == len(sweeps) else sweeps.take(mine), view)

    # Rows of a group: compared with the first of them.
    keys: dict[tuple[str, str, str], int] = {}
    for i in np.flatnonzero(sweeps.group != ""):
        first = keys.setdefault((str(sweeps.session[i]), str(sweeps.group[i]), str(sweeps.beam[i])), int(i))
        same = (sweeps.q_start[first] == sweeps.q_start[i]).all()
        if not same or (sweeps.measured and not np.isclose(sweeps.sigma[first], sweeps.sigma[i], rtol=1e-9)):
            raise located(
                sweeps.file,
                f"group {str(sweeps.group[i])!r}: expected the start pose and sigma_um of its row {sweeps.rows[first]}",
                row=int(sweeps.rows[i]),
                column="group",
            )


def _check_ahead(sweeps: Sweeps, cell: Cell) -> None:
    """Refuse rows of one beam on which the mirror stands behind the fibre."""
    known = np.flatnonzero(sweeps.absolute & (sweeps.dl > 0) & np.isfinite(sweeps.sigma))[:_SCANS]
    poses = np.vstack([np.where(sweeps.absolute[:, None], sweeps.q_end, sweeps.q_start), sweeps.q_end])
    seen = (sweeps.q_end[known], sweeps.dl[known], sweeps.sigma[known])
    parts = [behind_the_fibre(cell, poses[i : i + _AT_ONCE], seen) for i in range(0, len(poses), _AT_ONCE)]
    behind, lengths = map(np.concatenate, zip(*parts, strict=True))
    if behind.any():
        worst = int(np.argmax(behind))
        what = (
            f"the mirror stands behind the fibre (L = {lengths[worst]:.4g} um expected): no cell gives such a row; "
            "check sign, unit and zero of the joints, and the gap of the cell"
        )
        raise located(sweeps.file, what, row=int(sweeps.rows[worst % len(sweeps)]))


def _check_shots(sweeps: Sweeps, beam: Ints) -> None:
    """Rows of one shot, read at one moment: several beams, each once, at one end of one motion."""
    if not beam.any():
        return
    first: dict[tuple[str, str], int] = {}
    seen: set[tuple[str, str, int]] = set()
    for i in np.flatnonzero(sweeps.shot != "").tolist():
        key = (str(sweeps.session[i]), str(sweeps.shot[i]))
        other = first.setdefault(key, i)
        moved = (sweeps.q_end[other] != sweeps.q_end[i]).any()
        begun = sweeps.absolute[other] or sweeps.absolute[i] or (sweeps.q_start[other] == sweeps.q_start[i]).all()
        what = ""
        if moved or not begun or sweeps.time_h[other] != sweeps.time_h[i]:
            what = f"expected the poses and time_h of its row {sweeps.rows[other]}, read at the same moment"
        elif (*key, int(beam[i])) in seen:
            what = f"the beam {str(sweeps.beam[i])!r} stands in it twice, expected each beam once"
        if what:
            raise located(sweeps.file, f"shot {key[1]!r:.60}: {what}", row=int(sweeps.rows[i]), column="shot")
        seen.add((*key, int(beam[i])))

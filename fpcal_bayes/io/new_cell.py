"""A new cell file, commented and ready to fill in, from a layout; and links from a table of modified DH parameters."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from fpcal_bayes.core.errors import InputError, located
from fpcal_bayes.core.resources import data_file
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.io.csv import read_records
from fpcal_bayes.model.axes import axis_words, direction_words
from fpcal_bayes.model.cell.joints import JOINT_UNITS, JointKind
from fpcal_bayes.model.cell.layout import Layout
from fpcal_bayes.model.parameters import EXTRINSICS, UNITS

_STEMS = ("beta", "alpha", "d", "theta", "r")
_DH_COLUMNS = ("kind", "alpha_deg", "a_um", "theta_deg", "d_um")
#: Priors of angles in deg and of lengths in um, far limits, and how much of the gap a motion along the beam may use.
_ANGLE_SD, _OFFSET_SD, _TRAVEL, _TILT, _SPIN, _SHARE = 1.0, 20.0, 150.0, 5.0, 90.0, 0.25
#: Random walk per square-root day, in deg and um.
_DRIFT = {"beta_et": 0.01, "theta_et": 0.02, "beta_wf": 0.01, "theta_wf": 0.016, "z_et": 0.2}
_DRIFT |= dict.fromkeys(("x_wf", "y_wf", "z_wf"), 0.5)
_MEASURED_GAP = "gap_um = {gap:g}\ngap_sd_um = {sd:g}"
_GAP = """\
# gap_um = {gap:g}                   # <- measured gap at joint zero and its standard deviation,
# gap_sd_um = 5.0                 #    unless the sweeps hold one: a wavelength scan (kind = absolute)"""


def read_dh_table(path: str | Path) -> tuple[tuple[JointKind, ...], Floats]:
    """Kinds and links (beta, alpha, d, theta, r in deg and um, shape (n, 5)) from a CSV of modified DH parameters.

    Craig's alpha and a of the link before, theta and d of the joint without its value; ``beta_deg`` may follow.
    """
    records = read_records(Path(path))
    texts = [[text.strip() for text in row] for row in records.texts]
    records = replace(records, header=[name.strip() for name in records.header], texts=texts)
    records.require_header(_DH_COLUMNS, ("beta_deg",))
    columns = records.columns()
    kinds: list[JointKind] = []
    for text, row in zip(columns["kind"], records.rows.tolist(), strict=True):
        found: JointKind | None = next((kind for kind in JOINT_UNITS if text in (kind, kind[0])), None)
        if found is None:
            raise located(path, f"expected prismatic or revolute, found {text!r:.40}", row=row, column="kind")
        kinds.append(found)
    if not kinds:
        raise InputError(f"{path}: expected a row for each joint")
    links = np.zeros((len(kinds), 5))
    for i, name in enumerate(("beta_deg", *_DH_COLUMNS[1:])):
        if name in columns:
            links[:, i] = records.numbers(name, columns[name], finite=True, expected="expected a finite number")
    return tuple(kinds), links


def new_cell_text(
    layout: Layout, name: str, *, wavelength_nm: float, opd: str = "axis", gap_sd_um: float | None = None
) -> str:
    """The text of a cell file; a gap without standard deviation was not measured, and is left to be filled in."""
    directions, side = layout.directions(), direction_words(layout.side)
    words = [axis_words(kind, along) for kind, along in zip(layout.kinds, directions, strict=True)]
    values = dict(zip(EXTRINSICS, (layout.beta_et, layout.theta_et, layout.beta_wf, layout.theta_wf), strict=False))
    values |= {"z_et": 0.0, **dict(zip(("x_wf", "y_wf", "z_wf"), layout.fibre.tolist(), strict=True))}
    beam = ("x_wf", "y_wf", "z_wf")[int(np.argmax(np.abs(layout.side)))]
    across_sd = round(min(200.0, max(20.0, layout.gap / 4.0)), 3)
    sds = {"z_et": _OFFSET_SD, **dict.fromkeys(("x_wf", "y_wf", "z_wf"), across_sd)}
    sds[beam] = round(min(200.0, layout.gap / 4.0), 3)
    drift = {stem: size for stem, size in _DRIFT.items() if stem in layout.free}
    return (
        data_file("new-cell.txt")
        .read_text(encoding="utf-8")
        .format(
            title="; ".join(f"q{i} {word}" for i, word in enumerate(words, 1)),
            name=name,
            wavelength=wavelength_nm,
            opd=f'"{opd}"'.ljust(28),
            joints="".join(_joint(layout, i, word, directions[i]) for i, word in enumerate(words)),
            side=side,
            extrinsic="\n".join(_parameter(s, values[s], s in layout.free, sds.get(s, _ANGLE_SD)) for s in EXTRINSICS),
            drift="\n".join(f"{stem} = {{ walk_{UNITS[stem]} = {size:g} }}" for stem, size in drift.items()),
            least_gap=f"{layout.gap / 4.0:g}".ljust(19),
            gap=(_GAP if gap_sd_um is None else _MEASURED_GAP).format(gap=layout.gap, sd=gap_sd_um),
        )
    )


def _joint(layout: Layout, i: int, word: str, direction: Floats) -> str:
    kind, unit = layout.kinds[i], JOINT_UNITS[layout.kinds[i]]
    along = abs(float(direction @ layout.side)) > 0.7
    if kind == "prismatic":
        far, speed = (round(min(_TRAVEL, _SHARE * layout.gap), 3) if along else _TRAVEL), 100.0
    else:
        far, speed = (_SPIN if along else _TILT), 2.0
    note = ", along the beam" if along and kind == "prismatic" else ", about the beam" if along else ""
    lines = [
        "[[joint]]".ljust(34) + f"# q{i + 1} {word}{note}",
        f'kind = "{kind}"',
        f"limits_{unit} = [{-far:.6g}, {far:.6g}]".ljust(34) + "# <- as far as it may go, from joint zero",
        f"repeatability_{unit} = 0.0".ljust(34) + "# <- data sheet, one standard deviation",
        f"speed_{unit}_per_s = {speed:g}".ljust(34) + "# <- as it is driven",
        f'# controller = {{ name = "?", channel = "{i + 1}", sign = 1, zero = 0.0, unit = "{unit}" }}  # <-',
    ]
    for slot, stem in enumerate(_STEMS):
        value, free = float(layout.links[i, slot]), f"{stem}_{i + 1}" in layout.free
        if value or free:
            lines.append(_parameter(stem, value, free, _OFFSET_SD if UNITS[stem] == "um" else _ANGLE_SD))
    return "\n".join(lines) + "\n\n"


def _parameter(stem: str, value: float, free: bool, sd: float) -> str:
    unit = UNITS[stem]
    prior = f", prior_sd_{unit} = {sd:g}" if free else ""
    return f"{stem} = {{ nominal_{unit} = {round(value, 9) + 0.0:.12g}{prior} }}"

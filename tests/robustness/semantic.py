"""Faults of meaning: files that can be read and say something else than was measured. Each is told, or does no harm.

    python tests/robustness/semantic.py [--draws 25] [--kinds NAME ...] [--seed 0]

Of each kind so many worlds are drawn: a cell from the prior, its sweeps with 5 nm of noise (end points or midpoints),
and the fault. It is *told* where a command refuses it or says something that it does not say without the fault. It is
*harmless* where no task moves by more than one standard deviation or 1 nm against the same data without the fault. The
rest is counted as silent, kind by kind.
"""

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from scipy.io import loadmat, savemat
from trace_fixtures import record_all
from track_fixtures import DRIFT, plan

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.files import CONTENT_HASH, write_json
from fpcal_bayes.core.resources import data_file
from fpcal_bayes.fringes.ingest import ingest
from fpcal_bayes.infer.fit.identify import identify
from fpcal_bayes.infer.posterior.netcdf import data_tree, read_posterior, write_netcdf
from fpcal_bayes.infer.posterior.sample import sample
from fpcal_bayes.infer.tasks.error import linear_task_sd, task_errors, task_jacobian
from fpcal_bayes.io.campaign import read_campaign, write_campaign
from fpcal_bayes.io.cell import load_cell
from fpcal_bayes.io.estimate import read_estimate
from fpcal_bayes.io.recordings import read_recordings
from fpcal_bayes.io.sweeps import read_sweeps, write_csv
from fpcal_bayes.measure.campaign import Campaign
from fpcal_bayes.measure.protocol import paper_protocol
from fpcal_bayes.measure.sweeps import Sweeps, join
from fpcal_bayes.measure.truth import Truth, paper_truth
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.estimate import SCHEMA, Estimate
from fpcal_bayes.motion.tasks import TASKS, find_task
from fpcal_bayes.simulator.sweeps import simulate_um
from fpcal_bayes.tracking.alarms import Limits
from fpcal_bayes.tracking.drift import likely_drift
from fpcal_bayes.tracking.record import record_of, resume
from fpcal_bayes.tracking.sessions import check_sessions
from fpcal_bayes.tracking.tracker import track

CELL = load_cell(mechanics="none")
CELL_TEXT = data_file("femto-st.toml").read_text(encoding="utf-8")
Rng = np.random.Generator


@dataclass(frozen=True)
class Seen:
    """What a reader of a file ends with: what was said, and the estimate."""

    said: frozenset[str]
    estimate: Estimate | None
    usable: bool = True


Reader = Callable[[Path], Seen]


def identified(path: Path, cell: Cell = CELL) -> Seen:
    """As ``fpcal identify``; kinds of reasons count, not their numbers."""
    found = identify(cell, read_sweeps(path, cell).of_session(), max_starts=3)
    said = {reason.kind for reason in found.estimate.trust.reasons}
    return Seen(frozenset(said), found.estimate, found.estimate.trust.usable)


def tracked(path: Path) -> Seen:
    """As ``fpcal track``."""
    found = track(CELL, read_sweeps(path, CELL))
    said = {f"{o.session}: {o.verdict}" for o in found.outcomes if o.verdict != "as-modelled"}
    said |= {f"{o.session}: {text[:12]}" for o in found.outcomes[1:] for text in o.warnings}
    said |= {reason.kind for reason in found.trust.reasons}
    return Seen(frozenset(said), found.estimate(), found.trust.usable)


def estimated(path: Path) -> Seen:
    """As any command that reads an estimate."""
    found = read_estimate(path, CELL)
    return Seen(frozenset(reason.kind for reason in found.trust.reasons), found, found.trust.usable)


def harmless(clean: Estimate, faulty: Estimate) -> bool:
    """Whether no task moves by more than a standard deviation or 1 nm."""
    names = clean.parameters.names
    if faulty.parameters.names != names:
        return False
    model = CavityModel.of(CELL, clean.parameters)
    for name in TASKS:
        task = find_task(CELL, clean.vector(), name, n_points=21).driven()
        moved = np.abs(task_errors(model, faulty.values, clean.values, task)[0])
        jacobian = task_jacobian(model, clean.values, task)
        sd = np.minimum(linear_task_sd(jacobian, faulty.covariance), 1e9)
        both = np.maximum(sd, linear_task_sd(jacobian, clean.covariance))
        if (moved > np.maximum(both, 1e-3)).any():
            return False
    return True


# Worlds ------------------------------------------------------------------------------------------------------------


def session(rng: Rng) -> Sweeps:
    """A full calibration, at end points or with midpoints."""
    truth = Truth(CELL.free, np.array([0.0]), (CELL.free.nominal + rng.standard_normal(21) * CELL.free.prior_sd)[None])
    protocol = paper_protocol(CELL, midpoints=bool(rng.random() < 0.5))
    return simulate_um(CELL, truth, protocol, sigma=0.005, seed=int(rng.integers(2**31)))


def campaign(rng: Rng) -> Sweeps:
    """A calibration, then six sessions of six sweeps every 8 h or so, each with its clock time."""
    times = np.concatenate([[0.0], np.cumsum(rng.uniform(6.0, 10.0, 6))])
    steps = rng.standard_normal((7, 21)) * DRIFT.walk * DRIFT.scale
    steps *= np.sqrt(np.diff(times, prepend=0.0) / 24.0)[:, None]
    truth = Truth(CELL.free, times, paper_truth(CELL).at(0.0) + np.cumsum(steps, axis=0))
    parts = [replace(paper_protocol(CELL), session=np.full(69, "full"), time_h=np.zeros(69))]
    for i, hours in enumerate(times[1:], 1):
        parts.append(replace(plan(6, rng), session=np.full(6, f"s{i}"), time_h=np.full(6, hours)))
    sweeps = simulate_um(CELL, truth, join(parts, file="campaign"), sigma=0.005, seed=int(rng.integers(2**31)))
    return replace(sweeps, utc=clocks(sweeps.time_h))


def clocks(hours: np.ndarray, zone: str = "Z") -> np.ndarray:
    begin = np.datetime64("2024-10-24T04:00:00")
    return np.array([f"{begin + np.timedelta64(round(3600 * h), 's')}{zone}" for h in hours.tolist()])


# Faults of sweeps --------------------------------------------------------------------------------------------------


def posed(sweeps: Sweeps, change: Callable[[np.ndarray], np.ndarray]) -> Sweeps:
    return replace(sweeps, q_start=change(sweeps.q_start), q_end=change(sweeps.q_end))


def negated(sweeps: Sweeps, joints: np.ndarray) -> Sweeps:
    way = np.ones(6)
    way[joints] = -1.0
    return posed(sweeps, lambda q: q * way)


def swapped(sweeps: Sweeps, rng: Rng) -> Sweeps:
    pair = rng.choice(3, 2, replace=False) + 3 * rng.integers(2)
    order = np.arange(6)
    order[pair] = pair[::-1]
    return posed(sweeps, lambda q: q[:, order])


def scaled(sweeps: Sweeps, joints: Any, factor: float) -> Sweeps:
    by = np.ones(6)
    by[joints] = factor
    return posed(sweeps, lambda q: q * by)


def at_rows(sweeps: Sweeps, rows: Any, **fields: Callable[[np.ndarray], np.ndarray]) -> Sweeps:
    changed = {}
    for name, change in fields.items():
        values = getattr(sweeps, name).copy()
        values[rows] = change(values[rows])
        changed[name] = values
    return replace(sweeps, **changed)


def some(sweeps: Sweeps, rng: Rng, n: int) -> np.ndarray:
    """A few rows of the file that move by a few fringes at least."""
    return rng.choice(np.flatnonzero(np.abs(sweeps.dl) > 1.0), n, replace=False)


def mixed(sweeps: Sweeps, rng: Rng) -> Sweeps:
    """The second half is of another cell."""
    other = Truth(CELL.free, np.array([0.0]), (CELL.free.nominal + rng.standard_normal(21) * CELL.free.prior_sd)[None])
    dl = simulate_um(CELL, other, sweeps, sigma=0.005, seed=1).dl
    half = np.arange(len(sweeps)) >= len(sweeps) // 2
    return replace(sweeps, dl=np.where(half, dl, sweeps.dl))


def typo(sweeps: Sweeps, rng: Rng) -> Sweeps:
    """Two digits of one length exchanged."""
    row = some(sweeps, rng, 1)
    return at_rows(sweeps, row, dl=lambda dl: dl + rng.choice([-1, 1]) * rng.choice([0.09, 0.9, 9.0]))


def other_path(sweeps: Sweeps, rng: Rng) -> Sweeps:
    truth = Truth(CELL.free, np.array([0.0]), (CELL.free.nominal + rng.standard_normal(21) * CELL.free.prior_sd)[None])
    return simulate_um(CELL.with_opd("perpendicular"), truth, sweeps, sigma=0.005, seed=1)


TURNS, MOVES = [3, 4, 5], [0, 1, 2]
SWEEP_FAULTS: dict[str, Callable[[Sweeps, Rng], Sweeps]] = {
    "axis negated": lambda s, r: negated(s, r.choice(6, 1)),
    "two axes negated": lambda s, r: negated(s, r.choice(6, 2, replace=False)),
    "columns swapped": swapped,
    "a joint in mm": lambda s, r: scaled(s, r.choice(3), 1e-3),
    "a joint in nm": lambda s, r: scaled(s, r.choice(3), 1e3),
    "all translations in mm": lambda s, r: scaled(s, MOVES, 1e-3),
    "a turn in rad": lambda s, r: scaled(s, r.choice(TURNS), np.radians(1.0)),
    "all turns in rad": lambda s, r: scaled(s, TURNS, np.radians(1.0)),
    "all turns in mdeg": lambda s, r: scaled(s, TURNS, 1e3),
    "a gain of 1 %": lambda s, r: scaled(s, r.choice(6), 1.01),
    "dl negated": lambda s, r: replace(s, dl=-s.dl),
    "dl in nm": lambda s, r: replace(s, dl=1e3 * s.dl),
    "dl in mm": lambda s, r: replace(s, dl=1e-3 * s.dl),
    "dl and sigma in nm": lambda s, r: replace(s, dl=1e3 * s.dl, sigma=1e3 * s.sigma),
    "dl and sigma in mm": lambda s, r: replace(s, dl=1e-3 * s.dl, sigma=1e-3 * s.sigma),
    "dl counted twice": lambda s, r: replace(s, dl=2.0 * s.dl),
    "another laser's wavelength": lambda s, r: replace(s, dl=s.dl * 1.31 / 1.56),
    "sigma in nm": lambda s, r: replace(s, sigma=1e3 * s.sigma),
    "sigma in mm": lambda s, r: replace(s, sigma=1e-3 * s.sigma),
    "sigma in m": lambda s, r: replace(s, sigma=1e-6 * s.sigma),
    "one sigma of 1,000 um": lambda s, r: at_rows(s, r.integers(len(s)), sigma=lambda x: 1e3),
    "starts and ends exchanged": lambda s, r: replace(s, q_start=s.q_end, q_end=s.q_start, group=np.full(len(s), "")),
    "dl a row late": lambda s, r: replace(s, dl=np.roll(s.dl, 1)),
    "two rows exchanged": lambda s, r: at_rows(s, some(s, r, 2), dl=lambda x: x[::-1]),
    "three signs lost": lambda s, r: at_rows(s, some(s, r, 3), dl=np.abs),
    "one dl with a typo": typo,
    "a slipped fringe": lambda s, r: at_rows(s, some(s, r, 1), dl=lambda x: x + r.choice([-1, 1]) * 0.78),
    "one pose at zero": lambda s, r: at_rows(s, r.integers(len(s)), q_end=lambda q: 0.5 * q),
    "another cell's rows": mixed,
    "the other path model": other_path,
    "rows twice": lambda s, r: join([s, s.take(r.choice(len(s), 10, replace=False))]),
    "groups lost": lambda s, r: replace(s, group=np.full(len(s), "")),
}


def of_session(name: str, change: Callable[[Sweeps], Sweeps]) -> Callable[[Sweeps, Rng], Sweeps]:
    """A fault in one session of a campaign."""

    def fault(sweeps: Sweeps, rng: Rng) -> Sweeps:
        return join([change(p) if p.session[0] == name else p for p in map(sweeps.of_session, sweeps.sessions)])

    return fault


def resent(sweeps: Sweeps, rng: Rng) -> Sweeps:
    again = sweeps.of_session("s3")
    late = float(sweeps.time_h.max()) + 5.0
    again = replace(again, session=np.full(6, "s3b"), time_h=np.full(6, late), utc=clocks(np.full(6, late)))
    return join([sweeps, again])


def exchanged(sweeps: Sweeps, rng: Rng) -> Sweeps:
    """Two sessions stand at each other's hours; their clocks are right."""
    two, four = (sweeps.session == name for name in ("s2", "s4"))
    hours = sweeps.time_h.copy()
    hours[two], hours[four] = sweeps.time_h[four][0], sweeps.time_h[two][0]
    return replace(sweeps, time_h=hours)


LATE = ("s4", "s5", "s6")
CAMPAIGN_FAULTS: dict[str, Callable[[Sweeps, Rng], Sweeps]] = {
    "time_h in minutes": lambda s, r: replace(s, time_h=60.0 * s.time_h),
    "time_h in days": lambda s, r: replace(s, time_h=s.time_h / 24.0),
    "time_h in epoch seconds": lambda s, r: replace(s, time_h=1.7e9 + 3600.0 * s.time_h),
    "summer time in utc": lambda s, r: replace(s, utc=clocks(s.time_h + 1.0 * np.isin(s.session, LATE))),
    "local time beside Z": lambda s, r: replace(
        s, utc=np.where(np.isin(s.session, LATE), clocks(s.time_h + 2.0, ""), s.utc)
    ),
    "hours of two sessions exchanged": exchanged,
    "a session resent": resent,
    "a session's name in capitals": of_session("s3", lambda p: replace(p, session=np.array(["s3"] * 3 + ["S3 "] * 3))),
    "a session's sigma x 1e6": of_session("s5", lambda p: replace(p, sigma=1e6 * p.sigma)),
    "a session's sigma / 100": of_session("s5", lambda p: replace(p, sigma=1e-2 * p.sigma)),
    "a session's dl negated": of_session("s5", lambda p: replace(p, dl=-p.dl)),
    "a session's dl in nm": of_session("s5", lambda p: replace(p, dl=1e3 * p.dl)),
    "a session's q1 negated": of_session("s5", lambda p: negated(p, np.array([0]))),
    "a session's q6 negated": of_session("s5", lambda p: negated(p, np.array([5]))),
    "a session's turns in rad": of_session("s5", lambda p: scaled(p, TURNS, np.radians(1.0))),
}


# Faults of estimates, cells, campaigns and posteriors --------------------------------------------------------------


def edited(change: Callable[[dict[str, Any], Rng], Any], *, rehash: bool = False) -> Callable[[Path, Rng], None]:
    """An estimate file edited by hand; `rehash`: by a program that writes no hash."""

    def fault(path: Path, rng: Rng) -> None:
        content = json.loads(path.read_text())
        change(content, rng)
        if rehash:
            del content[CONTENT_HASH]
        path.write_text(json.dumps(content))

    return fault


def moved(content: dict[str, Any], rng: Rng) -> None:
    content["parameters"]["z_wf"]["value"] += 5.0


def in_mm(content: dict[str, Any], rng: Rng) -> None:
    for entry in content["parameters"].values():
        if entry["unit"] == "um":
            entry["value"] /= 1e3


def reordered(content: dict[str, Any], rng: Rng) -> None:
    names = content["covariance"]["names"]
    names[0], names[-1] = names[-1], names[0]


def other_sd(content: dict[str, Any], rng: Rng) -> None:
    for entry in content["parameters"].values():
        entry["sd"] /= 2.0


def narrow(content: dict[str, Any], rng: Rng) -> None:
    content["covariance"]["matrix"] = (np.array(content["covariance"]["matrix"]) / 100.0).tolist()


JSON_FAULTS = {
    "estimate: a value + 5 um": edited(moved),
    "estimate: + 5 um, hash taken out": edited(moved, rehash=True),
    "estimate: mm for um, hash taken out": edited(in_mm, rehash=True),
    "estimate: names reordered": edited(reordered, rehash=True),
    "estimate: half the sd": edited(other_sd, rehash=True),
    "estimate: a hundredth of the covariance": edited(narrow, rehash=True),
    "estimate: said to have converged": edited(lambda c, r: c["fit"].update(converged=False)),
    "estimate: trust edited": edited(lambda c, r: c["trust"].update(verdict="unusable")),
}


def rewritten(old: str, new: str) -> Callable[[str], str]:
    def change(text: str) -> str:
        assert old in text, old
        return text.replace(old, new, 1)

    return change


CELL_FAULTS: dict[str, Callable[[str], str]] = {
    "cell: wavelength in um": rewritten("wavelength_nm = 1560.0", "wavelength_nm = 1.56"),
    "cell: limits in mm": rewritten("limits_um = [-150.0, 150.0]", "limits_um = [-0.15, 0.15]"),
    "cell: a prior of 1e150": rewritten("prior_sd_deg = 1.0", "prior_sd_deg = 1e150"),
    "cell: a prior of 1 mdeg": rewritten("prior_sd_deg = 1.0", "prior_sd_deg = 0.001"),
    "cell: the other path model": rewritten('opd = "axis"', 'opd = "perpendicular"'),
    "cell: the fibre on the other side": rewritten("nominal_um = 920", "nominal_um = -920"),
}


def in_file(name: str, change: Callable[[Any], Any]) -> Callable[[Path, Rng], None]:
    """A dataset of an HDF5 or netCDF file changed in place."""

    def fault(path: Path, rng: Rng) -> None:
        with h5py.File(path, "r+") as file:
            file[name][...] = change(file[name][...])

    return fault


def stated(name: str, key: str, value: Any) -> Callable[[Path, Rng], None]:
    def fault(path: Path, rng: Rng) -> None:
        with h5py.File(path, "r+") as file:
            file[name].attrs[key] = value

    return fault


def columns_exchanged(path: Path, rng: Rng) -> None:
    with h5py.File(path, "r+") as file:
        for end in ("start", "end"):
            one, other = (file[f"sweeps/q{j}_{end}_um"] for j in (1, 2))
            one[...], other[...] = other[...], one[...]


HDF5_FAULTS = {
    "campaign: dl in nm": in_file("sweeps/dl_um", lambda x: 1e3 * x),
    "campaign: the unit of dl says nm": stated("sweeps/dl_um", "unit", "nm"),
    "campaign: dl in another order": in_file("sweeps/dl_um", lambda x: x[::-1]),
    "campaign: columns exchanged": columns_exchanged,
}
STATE_FAULTS = {
    "saved track: the state moved": in_file("track/mean", lambda x: x + 0.01),
    "saved track: covariance / 100": in_file("track/covariance", lambda x: x / 100.0),
}
NETCDF_FAULTS = {
    "posterior: a parameter in mm": in_file("posterior/z_wf", lambda x: x / 1e3),
    "posterior: the unit says mm": stated("posterior/z_wf", "units", "mm"),
    "posterior: draws shuffled": in_file("posterior/alpha_2", lambda x: x.ravel()[::-1].reshape(x.shape)),
}


def mat_scaled(name: str, factor: float) -> Callable[[dict[str, Any]], None]:
    def change(content: dict[str, Any]) -> None:
        value = content[name]
        if value.dtype == object:
            for i in range(value.size):
                value.flat[i] = value.flat[i] * factor
        else:
            content[name] = value * factor

    return change


def mat_wavelength(content: dict[str, Any]) -> None:
    content["wavelength_nm"] = np.full((4, 1), 1.56)


MAT_FAULTS: dict[str, Callable[[dict[str, Any]], None]] = {
    "recordings: joint readings in mm": mat_scaled("joint", 1e-3),
    "recordings: poses in nm": mat_scaled("q1_end_um", 1e3),
    "recordings: wavelength in um": mat_wavelength,
    "recordings: time runs backwards": mat_scaled("t_s", -1.0),
}


# Trials ------------------------------------------------------------------------------------------------------------


def trial(kind: str, seed: int, folder: Path) -> str:
    """``told``, ``harmless`` or ``silent``."""
    rng = np.random.default_rng([seed, *kind.encode()])
    path = folder / "sweeps.csv"
    try:
        before, after = _pair(kind, rng, path, folder)
    except InputError:
        return "told"
    if not after.usable or after.said - before.said:
        return "told"
    if kind in ("axis negated", "two axes negated") and "second-solution" in after.said:
        return "told"
    assert before.estimate is not None
    same = after.estimate is not None and harmless(before.estimate, after.estimate)
    return "harmless" if same else "silent"


def _pair(kind: str, rng: Rng, path: Path, folder: Path) -> tuple[Seen, Seen]:
    """What is seen without the fault and with it; `InputError` where the fault is refused."""
    if kind in SWEEP_FAULTS or kind in CAMPAIGN_FAULTS:
        good = session(rng) if kind in SWEEP_FAULTS else campaign(rng)
        read = identified if kind in SWEEP_FAULTS else tracked
        write_csv(path, good, CELL)
        clean = read(path)
        fault = (SWEEP_FAULTS | CAMPAIGN_FAULTS)[kind]
        write_csv(path, fault(good, rng), CELL)
        return clean, read(path)
    good = session(rng)
    write_csv(path, good, CELL)
    clean = identified(path)
    assert clean.estimate is not None
    if kind in JSON_FAULTS:
        found = identify(CELL, good)
        write_json(folder / "a.json", {"schema": SCHEMA, "command": "identify", **found.content()})
        JSON_FAULTS[kind](folder / "a.json", rng)
        return estimated_before(found.estimate), estimated(folder / "a.json")
    if kind in CELL_FAULTS:
        (folder / "cell.toml").write_text(CELL_FAULTS[kind](CELL_TEXT))
        seen = identified(path, load_cell(folder / "cell.toml", mechanics="none"))
        return clean, seen
    if kind in HDF5_FAULTS:
        write_campaign(folder / "a.h5", Campaign.of(good, CELL), CELL)
        HDF5_FAULTS[kind](folder / "a.h5", rng)
        return clean, identified(folder / "a.h5")
    if kind in STATE_FAULTS:
        sweeps = campaign(rng)
        found_track = track(CELL, sweeps)
        record = record_of(found_track, sweeps, Limits())
        write_campaign(folder / "a.h5", replace(Campaign.of(sweeps, CELL), track=record), CELL)
        STATE_FAULTS[kind](folder / "a.h5", rng)
        held = read_campaign(folder / "a.h5", CELL)
        assert held.track is not None
        known, note = resume(held.track, CELL, likely_drift(CELL, sweeps), Limits(), check_sessions(sweeps), "a.h5")
        again = track(CELL, sweeps, known=known)
        return estimated_before(found_track.estimate()), Seen(frozenset([note] if note else []), again.estimate())
    if kind in NETCDF_FAULTS:
        found = identify(CELL, good)
        posterior = sample(found, draws=100, seed=1, max_steps=40)
        write_netcdf(data_tree(posterior, seed=1, command=""), folder / "a.nc")
        NETCDF_FAULTS[kind](folder / "a.nc", rng)
        drawn = read_posterior(folder / "a.nc", CELL)
        moved_to = replace(found.estimate, values=drawn.values.mean(axis=0))
        return estimated_before(found.estimate), Seen(frozenset(r.kind for r in drawn.trust.reasons), moved_to)
    few = good.take(rng.choice(np.flatnonzero(good.q_end[:, 0] != 0.0), 4, replace=False))
    index = record_all(CELL, CavityModel.of(CELL), paper_truth(CELL).at(0.0), few, int(rng.integers(2**31)))
    _write_mat(folder / "a.mat", index)
    first = ingest(read_recordings(folder / "a.mat", CELL), CELL)
    content = {name: value for name, value in loadmat(folder / "a.mat").items() if not name.startswith("__")}
    MAT_FAULTS[kind](content)
    savemat(folder / "a.mat", content)
    read = ingest(read_recordings(folder / "a.mat", CELL), CELL)
    same = len(read.sweeps) == len(first.sweeps) and np.allclose(read.sweeps.dl, first.sweeps.dl, atol=1e-3)
    said = frozenset(read.warnings) - frozenset(first.warnings)
    return clean, Seen(clean.said | said, clean.estimate if same else None)


def _write_mat(path: Path, index: Any) -> None:
    sweeps, content = index.sweeps, {}
    q = np.hstack([sweeps.q_start, sweeps.q_end]) / np.tile(CELL.joint_scales, 2)
    names = [f"q{j + 1}_{end}_{'um' if j < 3 else 'deg'}" for end in ("start", "end") for j in range(6)]
    content |= {name: column[:, None] for name, column in zip(names, q.T, strict=True)}
    for name, field in (("t_s", "time_s"), ("joint", "joint"), ("irradiance_v", "irradiance")):
        cells = np.empty((len(sweeps), 1), dtype=object)
        for i, trace in enumerate(index.traces):
            joint = int(np.argmax(sweeps.q_start[i] != sweeps.q_end[i]))
            scale = CELL.joint_scales[joint] if name == "joint" else 1.0
            cells[i, 0] = getattr(trace, field) / scale
        content[name] = cells
    savemat(path, content)


def estimated_before(estimate: Estimate) -> Seen:
    return Seen(frozenset(reason.kind for reason in estimate.trust.reasons), estimate)


KINDS = tuple(
    {
        **SWEEP_FAULTS, **CAMPAIGN_FAULTS, **JSON_FAULTS, **CELL_FAULTS, **HDF5_FAULTS, **STATE_FAULTS,
        **NETCDF_FAULTS, **MAT_FAULTS,
    }
)  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--draws", type=int, default=25, help="of each kind")
    parser.add_argument("--kinds", nargs="*", default=KINDS)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    total = {"told": 0, "harmless": 0, "silent": 0}
    for kind in options.kinds:
        began, counts = time.process_time(), dict.fromkeys(total, 0)
        for draw in range(options.draws):
            with tempfile.TemporaryDirectory() as folder:
                counts[trial(kind, options.seed + draw, Path(folder))] += 1
        total = {name: total[name] + counts[name] for name in total}
        told = ", ".join(f"{count} {name}" for name, count in counts.items() if count)
        print(f"{kind:42} {told}  ({time.process_time() - began:.0f} s)", flush=True)
    n = sum(total.values())
    print(f"{len(options.kinds)} kinds, {n} faults: {total}; silent {100.0 * total['silent'] / max(n, 1):.1f} %")
    return 1 if total["silent"] > 0.02 * n else 0


if __name__ == "__main__":
    raise SystemExit(main())

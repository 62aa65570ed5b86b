"""The simulated rig records: irradiance along sweeps, wavelength scans at rest, irradiance along paths of all joints.

The seed spawns one stream of random numbers for each sweep, so that a sweep's recording does not depend on how many
others are recorded with it.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fpcal_bayes.core.errors import InputError, located
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.fringes.reference import fit_fringe
from fpcal_bayes.measure.recordings import TraceIndex, moving_joint, no_trace
from fpcal_bayes.measure.rules import check_sweeps
from fpcal_bayes.measure.sharing import drive_of_sweeps
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.measure.traces import FEWEST, PathTrace, Trace, WavelengthScan
from fpcal_bayes.measure.truth import Truth
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell, check_joints
from fpcal_bayes.simulator.machine import Machine
from fpcal_bayes.simulator.optics import Chances, Reached, RecorderSettings, SimulatedOptics
from fpcal_bayes.simulator.sweeps import machine_of

#: Fringes that the reference scans before and after a path span, and samples for each of them.
_REFERENCE_FRINGES, _REFERENCE_SAMPLES = 3.0, 40


def check_recordable(sweeps: Sweeps) -> None:
    """Hold sweeps to what a trace can hold."""
    several = ((sweeps.q_start != sweeps.q_end).sum(axis=1) > 1) & (sweeps.kind == "sweep")
    refusals = (
        (sweeps.kind == "path", "kind", "expected a sweep or an absolute length: a path is recorded by itself"),
        (sweeps.group != "", "group", "expected no group: one trace holds all points of a sweep"),
        (several, None, "expected a sweep of one joint: a trace holds one"),
    )
    for bad, column, expected in refusals:
        if bad.any():
            raise located(sweeps.file, expected, row=int(sweeps.rows[np.argmax(bad)]), column=column)


def record_sweeps(
    cell: Cell,
    truth: Truth,
    sweeps: Sweeps,
    settings: RecorderSettings | None = None,
    *,
    seed: int = 0,
    scans: NDArray[np.bool_] | bool = True,
) -> TraceIndex:
    """Record a plan on the simulated cell, a machine drawn by `seed` where it has mechanics; traces hold commands.

    scans: which sweeps have a wavelength scan before and after, shape (n,); absolute lengths have one in any case.
    """
    settings = RecorderSettings() if settings is None else settings
    machine = None if cell.mechanics is None else machine_of(cell, truth, seed)
    rig, n = SimulatedOptics(cell, truth, settings, machine), len(sweeps)
    check_sweeps(sweeps, cell)
    check_recordable(sweeps)
    chances = Chances.several(seed, n, len(cell.joints))
    # A machine has return errors of its own.
    repeatability = cell.repeatability * (machine is None)
    q_start = sweeps.q_start + repeatability * np.array([c.start for c in chances])
    q_end = sweeps.q_end + repeatability * np.array([c.end for c in chances])
    at_start, at_end = (None, None) if machine is None else _reached(machine, sweeps, seed)

    counts = np.where(sweeps.absolute, 0, rig.counts(q_start, q_end, sweeps.time_h))
    done = [rig.progress(k, c.ripple) for k, c in zip(counts.tolist(), chances, strict=True)]
    sizes = [len(part) for part in done]
    first, share, of = np.concatenate([[0], np.cumsum(sizes)]), np.concatenate(done), np.repeat(np.arange(n), sizes)
    # Lost motion and return errors build up on the way.
    along = None
    if at_start is not None and at_end is not None:
        errors = at_start[0][of] + share[:, None] * (at_end[0] - at_start[0])[of]
        along = errors, at_start[1][of] + share * (at_end[1] - at_start[1])[of]
    views = rig.views(q_start[of] + (q_end - q_start)[of] * share[:, None], sweeps.time_h, of, along)
    traces = []
    for i, chance in enumerate(chances):
        if sweeps.absolute[i]:
            traces.append(no_trace())
            continue
        part, joint = slice(first[i], first[i + 1]), moving_joint(sweeps, i)
        start, end = sweeps.q_start[i, joint], sweeps.q_end[i, joint]
        believed = np.where(share[part] == 1.0, end, start + (end - start) * share[part])
        read = rig.voltages((views[0][part], views[1][part], views[2][part]), chance)
        traces.append(Trace(settings.duration_s / (counts[i] - 1) * np.arange(sizes[i]), believed, read))

    swept = np.broadcast_to(scans, n) & ~sweeps.absolute

    def scanned(q: Floats, wanted: NDArray[np.bool_], reached: Reached | None) -> list[WavelengthScan | None]:
        there = [None if reached is None else (reached[0][[i]], reached[1][[i]]) for i in range(n)]
        return [
            rig.scan(q[i], sweeps.time_h[i], chance, there[i]) if wanted[i] else None
            for i, chance in enumerate(chances)
        ]

    before, after = scanned(q_start, swept, at_start), scanned(q_end, swept | sweeps.absolute, at_end)
    # What an index does not hold: changes of length, and which signs are known; the scans tell these.
    plan = replace(sweeps.with_measurement(np.full(n, np.nan), np.nan), signed=np.ones(n, dtype=bool))
    air = (np.nan, settings.temperature_c, settings.pressure_hpa, settings.humidity_pct)
    time, celsius, pressure, humidity = (np.full(n, value) for value in air)
    return TraceIndex(plan, time, celsius, pressure, humidity, traces, before, after)


def _reached(machine: Machine, sweeps: Sweeps, seed: int) -> tuple[Reached, Reached]:
    """How a machine's joints have reached starts and ends of sweeps, session by session in the order of the rows."""
    shape, rng = (2, *sweeps.q_start.shape), np.random.default_rng([seed, 6])
    errors, minutes = np.zeros(shape), np.zeros(shape[:2])
    for name in sweeps.sessions:
        rows = np.flatnonzero(sweeps.session == name)
        assert machine.cell.mechanics is not None
        drive = drive_of_sweeps(sweeps.take(rows), machine.cell.mechanics.minutes_per_sweep)
        errors[:, rows] = replace(machine, rng=rng).reached(drive)
        minutes[:, rows] = drive.start_min, drive.end_min
    return (errors[0], minutes[0]), (errors[1], minutes[1])


def record_path(
    cell: Cell,
    truth: Truth,
    path: Floats,
    time_h: float = 0.0,
    settings: RecorderSettings | None = None,
    seed: int = 0,
    machine_seed: int | None = None,
) -> PathTrace:
    """Record a path of all joints, between two reference scans, out and back, of the joint that changes L most.

    Where `settings.quadrature` is set the first one is fitted with the nominal geometry, and that joint moved to the
    nearest point at half fringe height along the whole path; the second shows how gain and offset drifted.
    """
    path = np.asarray(path, dtype=float)
    if path.ndim != 2 or path.shape[1] != len(cell.joints) or len(path) < 2 or not np.isfinite(path).all():
        raise InputError(f"path of shape {path.shape}: expected two or more vectors of {len(cell.joints)} joint values")
    check_joints(cell, path, "path", range(1, len(path) + 1), cell.joint_columns)
    machine, errors = None, np.zeros_like(path)
    if cell.mechanics is not None:
        machine = machine_of(cell, truth, seed if machine_seed is None else machine_seed)
        machine = replace(machine, rng=np.random.default_rng([seed, 6]))
        errors = machine.reach(path, machine.side) - machine.periodic(path)
    rig = SimulatedOptics(cell, truth, RecorderSettings() if settings is None else settings, machine)
    chance = Chances.several(seed, 1, len(cell.joints))[0]
    n_reference = max(FEWEST, round(_REFERENCE_SAMPLES * _REFERENCE_FRINGES))
    n_path = max(FEWEST, round(rig.settings.rate_hz * rig.settings.duration_s) + 1)
    reference = np.repeat([True, False, True], [n_reference, n_path, n_reference])
    at = np.linspace(0.0, 1.0, len(reference))
    joint, slope = reference_joint(cell, path[0])
    places = np.linspace(0.0, len(path) - 1.0, n_path)

    def record(q: Floats, during: slice) -> tuple[Floats, Floats]:
        # On its way to a vector of the path a machine errs as it will there.
        towards = np.concatenate([np.zeros(n_reference), np.ceil(places), np.full(n_reference, len(path) - 1)])
        reached = errors[towards.astype(np.int64)[during]], np.zeros(len(q))
        seen = rig.views(q, np.array([time_h]), np.zeros(len(q), dtype=np.int64), reached)
        return seen[0], rig.voltages(seen, chance, at[during])

    def scan_at(pose: Floats) -> Floats:
        moved = np.repeat(pose[None], n_reference, axis=0)
        # The reference joint goes out and back, towards the middle of its range.
        low, high = cell.low[joint], cell.high[joint]
        inwards = -1.0 if np.isfinite(low + high) and pose[joint] > (low + high) / 2 else 1.0
        size = inwards * _REFERENCE_FRINGES * cell.wavelength / 2.0 / abs(slope)
        moved[:, joint] += size * np.sin(np.linspace(0.0, np.pi, n_reference)) ** 2
        return moved

    first = scan_at(path[0])
    length, read = record(first, slice(None, n_reference))
    along = np.column_stack([np.interp(places, np.arange(len(path)), column) for column in path.T])
    if rig.settings.quadrature:
        room = slope * (np.array([cell.low[joint], cell.high[joint]]) - [along[:, joint].min(), along[:, joint].max()])
        fitted = fit_fringe(slope * (first[:, joint] - path[0, joint]), read, cell.wavelength / rig.index)
        along[:, joint] += fitted.to_quadrature(room.min(), room.max()) / slope
    last = scan_at(along[-1])
    later, later_read = record(np.vstack([along, last]), slice(n_reference, None))
    time_s, q = np.arange(len(reference)) / rig.settings.rate_hz, np.vstack([first, along, last])
    irradiance, length = np.concatenate([read, later_read]), np.concatenate([length, later])
    return PathTrace(time_s=time_s, q=q, irradiance=irradiance, reference=reference, time_h=time_h, length=length)


def reference_joint(cell: Cell, q: Floats) -> tuple[int, float]:
    """The prismatic joint that changes the nominal cavity length most at a pose (n_joints,), and um of it per um."""
    if cell.revolute.all():
        raise InputError(f"cell {cell.name!r} has no prismatic joint for a reference scan")
    model = CavityModel.of(cell)
    slopes = np.where(cell.revolute, 0.0, model.joint_jacobian(model.free.nominal, q[None])[0])
    joint = int(np.argmax(np.abs(slopes)))
    return joint, float(slopes[joint])

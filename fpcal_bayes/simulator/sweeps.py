"""The simulated cell: what the interferometer would read."""

from dataclasses import replace

import numpy as np

from fpcal_bayes.core.errors import InputError
from fpcal_bayes.core.typing import Floats
from fpcal_bayes.measure.rules import check_sweeps
from fpcal_bayes.measure.sharing import Sharing, drive_of_sweeps
from fpcal_bayes.measure.sweeps import Sweeps
from fpcal_bayes.measure.truth import Truth
from fpcal_bayes.model.cavity import CavityModel
from fpcal_bayes.model.cell.cell import Cell
from fpcal_bayes.model.envelope import require_in_front, require_within_envelope
from fpcal_bayes.model.joint_path import sweep_path
from fpcal_bayes.simulator.machine import Machine


def require_drivable(cell: Cell, truth: Truth, sweeps: Sweeps) -> None:
    """Raise `InputError` at the first row that a cell could not make: behind the fibre, or outside its envelope."""
    model = CavityModel.of(cell, truth.parameters)
    for name in sweeps.sessions:
        part = sweeps.of_session(name)
        values = truth.at(float(np.clip(part.time_h[0], truth.times_h[0], truth.times_h[-1])))
        rows = part.rows.tolist()
        for number, (view, own) in enumerate(model.views):
            mine = part.take(cell.beam_numbers(part.beam) == number)
            if len(mine) and view.cell.target == "plane-mirror" and view.cell.optical_axis != "z":
                path = sweep_path(cell, mine.q_start, mine.q_end, ways=False)
                require_in_front(view, values[own], path, file=part.file, rows=mine.rows.tolist())
        require_within_envelope(model, values, part.q_start, part.q_end, file=part.file, rows=rows, exact=True)


def noise_free(
    cell: Cell, truth: Truth, sweeps: Sweeps, q_start: Floats | None = None, q_end: Floats | None = None
) -> Floats:
    """True changes of cavity length in um, (n,), at each row's time, between joints reached, by default commanded."""
    model = CavityModel.of(cell, truth.parameters)
    q_start = sweeps.q_start if q_start is None else q_start
    q_end = sweeps.q_end if q_end is None else q_end
    # Times outside the epochs see the same truth as the nearest epoch.
    times, epoch = np.unique(np.clip(sweeps.time_h, truth.times_h[0], truth.times_h[-1]), return_inverse=True)
    order = np.argsort(epoch, kind="stable")
    bounds = np.searchsorted(epoch[order], np.arange(len(times) + 1))
    dl, beam = np.empty(len(sweeps)), cell.beam_numbers(sweeps.beam)
    for i, values in enumerate(truth.at(times)):
        now = order[bounds[i] : bounds[i + 1]]
        dl[now] = model.predict(values, model.rows(q_start[now], q_end[now], sweeps.absolute[now], beam[now]))
    return dl


def simulate(cell: Cell, truth: Truth, sweeps: Sweeps, *, sigma_nm: float | Floats, seed: int) -> Sweeps:
    """Measure sweeps on the simulated cell with noise of `sigma_nm`; all else as in `simulate_um`.

    Parameters
    ----------
    sigma_nm
        Standard deviation of a row's noise: one, or one per row, shape (n,).

    Raises
    ------
    InputError
        As `simulate_um` and `require_drivable`.
    """
    require_drivable(cell, truth, sweeps)
    return simulate_um(cell, truth, sweeps, sigma=1e-3 * np.asarray(sigma_nm, dtype=float), seed=seed)


def simulate_um(
    cell: Cell, truth: Truth, sweeps: Sweeps, *, sigma: float | Floats, seed: int, machine_seed: int | None = None
) -> Sweeps:
    """Measure sweeps on the simulated cell; rows that are not signed get the size of their change.

    A cell with mechanics is a machine whose error motions are drawn by `machine_seed` (by default `seed`).

    A row's reading is the difference of one at its end and one at its start, each with the noise sigma / sqrt(2).
    Rows of a group share the reading and the pose reached at their start, so their noises have correlation 1/2.
    An absolute length is one reading with the noise sigma. Joints reach each pose with the cell's repeatability;
    the sweeps that come back hold the pose commanded, as a controller would.

    Standard normals are drawn whatever is used of them, one set per row: joints at the start, joints at the end,
    reading at the start, reading at the end. A group uses the start of its first row, a shot its end. Equal seeds thus
    give equal noise for any sigma and repeatability.
    """
    sigma = np.broadcast_to(np.asarray(sigma, dtype=float), len(sweeps))
    if not (np.isfinite(sigma).all() and (sigma > 0).all()):
        raise InputError("expected a noise sigma above zero")
    if seed < 0:
        raise InputError(f"seed {seed}: expected a whole number, zero or more")
    check_sweeps(sweeps.with_measurement(np.zeros(len(sweeps)), sigma), cell)
    if cell.mechanics is not None:
        machine = machine_of(cell, truth, seed if machine_seed is None else machine_seed)
        dl = _on_machine(machine, truth, sweeps, sigma, np.random.default_rng([seed, 6]))
        return sweeps.with_measurement(np.where(sweeps.signed | sweeps.absolute, dl, np.abs(dl)), sigma)
    generator, shape, sharing = np.random.default_rng(seed), sweeps.q_start.shape, Sharing.of(sweeps)
    start_joints = generator.standard_normal(shape)[sharing.start]
    end_joints = generator.standard_normal(shape)[sharing.end]
    start_reading = generator.standard_normal(len(sweeps))[sharing.reading]
    end_reading = generator.standard_normal(len(sweeps))

    q_start = sweeps.q_start + cell.repeatability * start_joints
    q_end = sweeps.q_end + cell.repeatability * end_joints
    noise = np.where(sweeps.absolute, end_reading, (end_reading - start_reading) / np.sqrt(2.0))
    dl = noise_free(cell, truth, sweeps, q_start, q_end) + sigma * noise
    return sweeps.with_measurement(np.where(sweeps.signed, dl, np.abs(dl)), sigma)


def machine_of(cell: Cell, truth: Truth, seed: int) -> Machine:
    """The machine of a cell with mechanics: the same for the same seed, at the first of the truth's times."""
    assert cell.mechanics is not None
    return Machine.draw(cell, cell.mechanics, vector_at(cell, truth, 0.0), np.random.default_rng([seed, 5]))


def vector_at(cell: Cell, truth: Truth, time_h: float) -> Floats:
    """The true model vector at a time."""
    vector = cell.parameters.nominal.copy()
    vector[truth.parameters.slots] = truth.at(float(np.clip(time_h, truth.times_h[0], truth.times_h[-1])))
    return vector


def _on_machine(machine: Machine, truth: Truth, sweeps: Sweeps, sigma: Floats, rng: np.random.Generator) -> Floats:
    """Changes of length that a machine shows, session by session in the order of the rows, in um, shape (n,)."""
    assert machine.cell.mechanics is not None
    dl = np.empty(len(sweeps))
    for name in sweeps.sessions:
        rows = np.flatnonzero(sweeps.session == name)
        part = sweeps.take(rows)
        now = replace(machine, vector=vector_at(machine.cell, truth, float(part.time_h[0])), rng=rng)
        # What several beams read at one moment follows each other.
        order = np.argsort(Sharing.of(part).end, kind="stable")
        rows, part = rows[order], part.take(order)
        dl[rows] = now.sweep(drive_of_sweeps(part, machine.cell.mechanics.minutes_per_sweep), sigma[rows])
    return dl
